//! Which addresses may be told anything: those of the open internet, and those that the operator allows. A webhook is a request that a
//! stranger makes this machine send, so it must not reach what only this machine can.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

use axum::http::Uri;
use ipnet::IpNet;

/// Characters of a URL.
const MAX_URL: usize = 2048;

/// Where webhooks may go.
#[derive(Debug, Clone, Default)]
pub struct TargetPolicy {
    /// Networks that may be reached although they are not of the open internet.
    pub allow: Vec<IpNet>,
}

impl TargetPolicy {
    /// Whether the address may be connected to.
    pub fn permits(&self, address: IpAddr) -> bool {
        let address = address.to_canonical();
        is_global(address) || self.allow.iter().any(|net| net.contains(&address))
    }

    /// A URL that may be a target; what its name leads to is looked at when it is connected to.
    ///
    /// # Errors
    /// A sentence that says why not.
    pub fn parse(&self, url: &str) -> Result<Uri, String> {
        if url.len() > MAX_URL {
            return Err(format!("a URL has at most {MAX_URL} characters"));
        }
        let uri: Uri = url.parse().map_err(|e| format!("this is no URL: {e}"))?;
        if !matches!(uri.scheme_str(), Some("http" | "https")) {
            return Err("a URL begins with https:// or http://".to_owned());
        }
        if uri.authority().is_some_and(|a| a.as_str().contains('@')) {
            return Err("a URL holds no user and no password: deliveries are signed".to_owned());
        }
        let host = uri.host().filter(|host| !host.is_empty()).ok_or("the URL has no host")?;
        match bare(host).parse::<IpAddr>() {
            Ok(address) if !self.permits(address) => Err(refusal(address)),
            _ => Ok(uri),
        }
    }
}

/// The host without the brackets of an IPv6 address.
pub(super) fn bare(host: &str) -> &str {
    host.strip_prefix('[').and_then(|h| h.strip_suffix(']')).unwrap_or(host)
}

/// Why an address is not connected to.
pub(super) fn refusal(address: IpAddr) -> String {
    format!(
        "{address} is not an address of the open internet; --webhook-allow of the service lets its network be reached"
    )
}

fn is_global(address: IpAddr) -> bool {
    match address {
        IpAddr::V4(v4) => is_global_v4(v4),
        IpAddr::V6(v6) => is_global_v6(v6),
    }
}

/// The special-purpose registry of IPv4 (RFC 6890), and multicast.
fn is_global_v4(address: Ipv4Addr) -> bool {
    let [a, b, c, _] = address.octets();
    let special = address.is_private()
        || address.is_loopback()
        || address.is_link_local()
        || address.is_broadcast()
        || address.is_documentation()
        || address.is_multicast()
        || a == 0
        || a >= 240
        // Shared by carriers; protocol assignments; relays of 6to4; benchmarks.
        || (a == 100 && (64..128).contains(&b))
        || (a, b, c) == (192, 0, 0)
        || (a, b, c) == (192, 88, 99)
        || (a == 198 && (18..20).contains(&b));
    !special
}

/// Global unicast without the blocks of other purpose; addresses that hold one of IPv4 are as that one.
fn is_global_v6(address: Ipv6Addr) -> bool {
    let s = address.segments();
    let embedded = |high: u16, low: u16| is_global_v4(Ipv4Addr::from_bits(u32::from(high) << 16 | u32::from(low)));
    match s {
        [0x64, 0xff9b, 0, 0, 0, 0, high, low] => embedded(high, low),
        [0x2002, high, low, ..] => embedded(high, low),
        // Teredo and other protocol assignments; documentation.
        [0x2001, 0..=0x1ff, ..] | [0x2001, 0xdb8, ..] | [0x3fff, 0..=0xfff, ..] => false,
        _ => s[0] & 0xe000 == 0x2000,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_that_only_this_machine_reaches_are_refused() {
        let none = TargetPolicy::default();
        for text in [
            "127.0.0.1",
            "10.1.2.3",
            "172.16.0.1",
            "172.31.255.255",
            "192.168.1.1",
            "169.254.169.254",
            "0.0.0.0",
            "100.64.0.1",
            "224.0.0.1",
            "255.255.255.255",
            "240.0.0.1",
            "192.0.0.1",
            "198.18.0.1",
            "192.0.2.1",
            "::1",
            "::",
            "fe80::1",
            "fd00::1",
            "ff02::1",
            "::ffff:127.0.0.1",
            "::ffff:10.0.0.1",
            "64:ff9b::7f00:1",
            "2002:7f00:1::",
            "2001:db8::1",
            "2001::1",
            "::127.0.0.1",
        ] {
            assert!(!none.permits(text.parse().unwrap()), "{text}");
        }
        for text in ["1.1.1.1", "172.32.0.1", "100.128.0.1", "2606:4700::1111", "::ffff:1.1.1.1", "64:ff9b::101:101"] {
            assert!(none.permits(text.parse().unwrap()), "{text}");
        }
        let some = TargetPolicy { allow: vec!["10.1.0.0/16".parse().unwrap(), "fd00::/8".parse().unwrap()] };
        for (text, wanted) in [("10.1.9.9", true), ("::ffff:10.1.9.9", true), ("10.2.0.1", false), ("fd12::1", true)] {
            assert_eq!(some.permits(text.parse().unwrap()), wanted, "{text}");
        }
    }

    #[test]
    fn urls_that_cannot_be_targets_are_told_why() {
        let policy = TargetPolicy::default();
        for (url, part) in [
            ("ftp://a.example/", "https://"),
            ("/hook", "https://"),
            ("https://user:word@a.example/", "signed"),
            ("http://127.0.0.1:9000/", "127.0.0.1"),
            ("http://[::1]/", "::1"),
            ("not a url", "no URL"),
            (&format!("https://a.example/{}", "x".repeat(3000)), "2048"),
        ] {
            let why = policy.parse(url).unwrap_err();
            assert!(why.contains(part), "{url}: {why}");
        }
        assert!(policy.parse("https://a.example:8443/hook?x=1").is_ok());
    }
}
