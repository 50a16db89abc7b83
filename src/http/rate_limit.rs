//! How many requests a client may send in a minute: a bucket of tokens each, told in `RateLimit-*` headers.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use axum::http::{HeaderMap, HeaderValue};

use super::access::Client;

/// Seconds in which an empty bucket is full again.
const WINDOW: f64 = 60.0;
/// Clients that are remembered. Where there are more, those that have all their tokens are forgotten, and new ones share a bucket.
const MAX_CLIENTS: usize = 50_000;

/// The buckets of all clients.
#[derive(Default)]
pub(super) struct RateLimiter(Mutex<BTreeMap<Client, Bucket>>);

/// Tokens as of a time.
#[derive(Clone, Copy)]
struct Bucket {
    limit: f64,
    tokens: f64,
    at: Instant,
}

/// What is left to a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Allowance {
    /// Requests in a minute.
    limit: u32,
    /// Requests that are left now.
    remaining: u32,
    /// Seconds until all are there again.
    reset: u64,
    /// Seconds until there is one; `None` where this one was allowed.
    pub(super) wait: Option<u64>,
}

impl RateLimiter {
    /// Counts a request of a client that may send `limit` in a minute.
    pub(super) fn count(&self, client: Client, limit: u32, now: Instant) -> Allowance {
        let most = f64::from(limit.max(1));
        let rate = most / WINDOW;
        let mut buckets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if buckets.len() >= MAX_CLIENTS && !buckets.contains_key(&client) {
            buckets.retain(|_, bucket| bucket.at(now).tokens < bucket.limit);
        }
        let client =
            if buckets.len() >= MAX_CLIENTS && !buckets.contains_key(&client) { Client::Other } else { client };
        let bucket = buckets.entry(client).or_insert(Bucket { limit: most, tokens: most, at: now });
        // A key's limit may have changed.
        *bucket = Bucket { limit: most, ..bucket.at(now) }.at(now);
        // What was earned in parts may lack a rounding error.
        let allowed = bucket.tokens > 1.0 - 1e-9;
        if allowed {
            bucket.tokens = (bucket.tokens - 1.0).max(0.0);
        }
        let seconds = |tokens: f64| (tokens / rate - 1e-6).ceil().max(0.0) as u64;
        Allowance {
            limit,
            remaining: bucket.tokens as u32,
            reset: seconds(most - bucket.tokens),
            wait: (!allowed).then(|| seconds(1.0 - bucket.tokens).max(1)),
        }
    }
}

impl Bucket {
    /// The bucket as it is then.
    fn at(self, now: Instant) -> Self {
        let earned = now.saturating_duration_since(self.at).as_secs_f64() * self.limit / WINDOW;
        Bucket { tokens: (self.tokens + earned).min(self.limit), at: now, ..self }
    }
}

impl Allowance {
    /// Tells it to the client.
    pub(super) fn tell(&self, headers: &mut HeaderMap) {
        headers.insert("ratelimit-limit", self.limit.into());
        headers.insert("ratelimit-remaining", self.remaining.into());
        headers.insert("ratelimit-reset", self.reset.into());
        if let Ok(policy) = HeaderValue::from_str(&format!("{};w={WINDOW}", self.limit)) {
            headers.insert("ratelimit-policy", policy);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn key(id: &str) -> Client {
        Client::Key(id.to_owned())
    }

    #[test]
    fn each_client_has_its_requests_and_gets_new_ones_with_time() {
        let (limiter, start) = (RateLimiter::default(), Instant::now());
        let told: Vec<(u32, u64, Option<u64>)> =
            (0..4).map(|_| limiter.count(key("a"), 3, start)).map(|a| (a.remaining, a.reset, a.wait)).collect();
        assert_eq!(told, [(2, 20, None), (1, 40, None), (0, 60, None), (0, 60, Some(20))]);
        assert_eq!(limiter.count(key("b"), 3, start).wait, None, "others have their own");
        assert_eq!(limiter.count(key("a"), 3, start + Duration::from_secs(19)).wait, Some(1));
        assert_eq!(limiter.count(key("a"), 3, start + Duration::from_secs(20)).wait, None);
        assert_eq!(
            limiter.count(key("a"), 3, start + Duration::from_secs(3600)).remaining,
            2,
            "never more than the limit"
        );
        let mut headers = HeaderMap::new();
        limiter.count(key("b"), 3, start).tell(&mut headers);
        assert_eq!(
            (&headers["ratelimit-policy"], &headers["ratelimit-remaining"]),
            (&"3;w=60".parse().unwrap(), &1.into())
        );
    }

    #[test]
    fn the_number_of_clients_that_are_remembered_is_bounded() {
        let (limiter, start) = (RateLimiter::default(), Instant::now());
        for n in 0..MAX_CLIENTS + 10 {
            limiter.count(key(&n.to_string()), 2, start);
        }
        let remembered = || limiter.0.lock().unwrap().len();
        assert_eq!(remembered(), MAX_CLIENTS + 1);
        limiter.count(key("x"), 2, start + Duration::from_secs(60));
        assert_eq!(remembered(), 1, "whoever has all tokens is forgotten");
    }
}
