//! `Prefer: wait=N` (RFC 7240, section 4.3): an answer that waits for the end of a job.

use std::time::Duration;

use axum::http::{HeaderMap, HeaderName, HeaderValue};

/// The longest wait in seconds; proxies give up on idle connections soon after.
pub(super) const MAX_WAIT: u64 = 60;

/// The header that says which preference was followed.
const APPLIED: HeaderName = HeaderName::from_static("preference-applied");

/// How long the client wants to wait, at most [`MAX_WAIT`].
pub(super) fn wait(headers: &HeaderMap) -> Option<Duration> {
    let given = headers.get_all("prefer").iter().filter_map(|v| v.to_str().ok());
    let preferences = given.flat_map(|v| v.split(',')).filter_map(|p| p.split(';').next()?.trim().split_once('='));
    let mut waits = preferences.filter(|(name, _)| name.trim().eq_ignore_ascii_case("wait"));
    let seconds: u64 = waits.next()?.1.trim().trim_matches('"').parse().ok()?;
    Some(Duration::from_secs(seconds.min(MAX_WAIT)))
}

/// Says that the answer waited, or would have.
pub(super) fn applied(headers: &mut HeaderMap, wait: Duration) {
    if let Ok(value) = HeaderValue::from_str(&format!("wait={}", wait.as_secs())) {
        headers.insert(APPLIED, value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_are_found_among_other_preferences_and_bounded() {
        let of = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert("prefer", HeaderValue::from_str(text).unwrap());
            wait(&headers).map(|w| w.as_secs())
        };
        assert_eq!(of("wait=10"), Some(10));
        assert_eq!(of("respond-async, Wait = \"7\"; x=1, wait=9"), Some(7));
        assert_eq!(of("wait=100000"), Some(MAX_WAIT));
        for none in ["", "wait", "wait=-1", "wait=soon", "return=minimal"] {
            assert_eq!(of(none), None, "{none}");
        }
    }
}
