//! tus 1.0, the protocol of uploads that go on after a break: its headers, and what holds for each of its requests.

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use sha1::Sha1;
use sha2::{Digest, Sha256};
use time::OffsetDateTime;
use time::format_description::parse_borrowed;

use super::App;
use super::problem::{HandlerResult, Problem};
use super::upload::{DrainOnDrop, relative, truncated};
use crate::error::Code;
use crate::jobs::record::Timestamp;

/// The media type of pieces.
pub(super) const MEDIA_TYPE: &str = "application/offset+octet-stream";

const RESUMABLE: HeaderName = HeaderName::from_static("tus-resumable");
const VERSION_HEADER: HeaderName = HeaderName::from_static("tus-version");
const EXTENSION: HeaderName = HeaderName::from_static("tus-extension");
const MAX_SIZE: HeaderName = HeaderName::from_static("tus-max-size");
const ALGORITHMS: HeaderName = HeaderName::from_static("tus-checksum-algorithm");
pub(super) const OFFSET: HeaderName = HeaderName::from_static("upload-offset");
pub(super) const LENGTH: HeaderName = HeaderName::from_static("upload-length");
pub(super) const METADATA: HeaderName = HeaderName::from_static("upload-metadata");
pub(super) const EXPIRES: HeaderName = HeaderName::from_static("upload-expires");
const CHECKSUM: HeaderName = HeaderName::from_static("upload-checksum");
const DEFER: HeaderName = HeaderName::from_static("upload-defer-length");

/// Headers that pages of other origins may send.
pub(super) const REQUEST_HEADERS: [HeaderName; 5] = [RESUMABLE, OFFSET, LENGTH, METADATA, CHECKSUM];
/// Headers that pages of other origins may read.
pub(super) const RESPONSE_HEADERS: [HeaderName; 9] =
    [RESUMABLE, VERSION_HEADER, EXTENSION, MAX_SIZE, ALGORITHMS, OFFSET, LENGTH, METADATA, EXPIRES];

/// The version of the protocol.
const VERSION: HeaderValue = HeaderValue::from_static("1.0.0");
const EXTENSIONS: HeaderValue =
    HeaderValue::from_static("creation,creation-with-upload,expiration,checksum,termination");
/// Bytes of `Upload-Metadata`.
const MAX_METADATA: usize = 4096;

/// Holds each request under `/v1/uploads` against the version of the protocol, and answers what it is that is spoken here.
pub(super) async fn protocol(State(app): State<App>, request: Request, next: Next) -> Response {
    let path = request.uri().path();
    if path != "/v1/uploads" && !path.starts_with("/v1/uploads/") {
        return next.run(request).await;
    }
    let preflight = request.headers().contains_key(header::ACCESS_CONTROL_REQUEST_METHOD);
    let mut response = if request.method() == Method::OPTIONS && !preflight {
        let mut response = StatusCode::NO_CONTENT.into_response();
        let headers = response.headers_mut();
        headers.insert(VERSION_HEADER, VERSION);
        headers.insert(EXTENSION, EXTENSIONS);
        headers.insert(MAX_SIZE, app.jobs.limits.max_upload.into());
        headers.insert(ALGORITHMS, HeaderValue::from_static("sha1,sha256"));
        response
    } else if request.headers().get(RESUMABLE).is_some_and(|version| version != VERSION) {
        drop(DrainOnDrop(Some(request.into_body().into_data_stream())));
        let problem = Problem::new(Code::InvalidRequest, "this service speaks version 1.0.0 of tus");
        let mut response = problem.with_status(StatusCode::PRECONDITION_FAILED).into_response();
        response.headers_mut().insert(VERSION_HEADER, VERSION);
        response
    } else {
        next.run(request).await
    };
    response.headers_mut().insert(RESUMABLE, VERSION);
    response
}

fn malformed(detail: impl Into<String>) -> Problem {
    Problem::new(Code::InvalidRequest, detail)
}

/// The whole number in a header.
pub(super) fn number(headers: &HeaderMap, name: &HeaderName) -> HandlerResult<Option<u64>> {
    let Some(value) = headers.get(name) else { return Ok(None) };
    let digits = value.to_str().ok().filter(|v| !v.is_empty() && v.bytes().all(|b| b.is_ascii_digit()));
    let number = digits.and_then(|v| v.parse().ok()).filter(|n| i64::try_from(*n).is_ok());
    number.map(Some).ok_or_else(|| malformed(format!("`{name}` is a whole number of bytes")))
}

/// The length that is declared.
pub(super) fn length(headers: &HeaderMap) -> HandlerResult<u64> {
    if headers.contains_key(DEFER) {
        let detail = "the length of an upload is declared when it begins: send `Upload-Length`; `Upload-Defer-Length` is not taken";
        return Err(malformed(detail));
    }
    number(headers, &LENGTH)?
        .ok_or_else(|| malformed("`Upload-Length` is missing: the bytes that the upload will have"))
}

/// What `Upload-Metadata` tells.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Metadata {
    /// As it came.
    pub(super) text: String,
    /// The file's relative path.
    pub(super) filename: Option<String>,
    /// The SHA-256 that all bytes have.
    pub(super) sha256: Option<String>,
}

/// Reads `Upload-Metadata`: `filename` and `sha256` are understood, other keys are kept.
pub(super) fn metadata(headers: &HeaderMap) -> HandlerResult<Metadata> {
    let Some(value) = headers.get(METADATA) else { return Ok(Metadata::default()) };
    let text = value.to_str().ok().filter(|text| text.len() <= MAX_METADATA);
    let text =
        text.ok_or_else(|| malformed(format!("`Upload-Metadata` has at most {MAX_METADATA} ASCII characters")))?;
    let mut metadata = Metadata { text: text.to_owned(), ..Metadata::default() };
    let mut seen = Vec::new();
    for pair in text.split(',').map(str::trim).filter(|pair| !pair.is_empty()) {
        let (key, value) = pair.split_once(' ').unwrap_or((pair, ""));
        let decoded = STANDARD
            .decode(value.trim())
            .map_err(|_| malformed(format!("the value of `{}` in `Upload-Metadata` is not base64", truncated(key))))?;
        if seen.contains(&key) {
            return Err(malformed(format!("`{}` stands twice in `Upload-Metadata`", truncated(key))));
        }
        seen.push(key);
        let text = || String::from_utf8(decoded.clone()).map_err(|_| malformed(format!("`{key}` is not UTF-8")));
        match key {
            "filename" => metadata.filename = Some(relative(&text()?)?),
            "sha256" => {
                let digits = text()?.trim().to_ascii_lowercase();
                if digits.len() != 64 || !digits.bytes().all(|b| b.is_ascii_hexdigit()) {
                    return Err(malformed("`sha256` in `Upload-Metadata` is a SHA-256 in 64 hexadecimal digits"));
                }
                metadata.sha256 = Some(digits);
            }
            _ => {}
        }
    }
    Ok(metadata)
}

/// The checksum of a request's bytes.
pub(super) struct Checksum {
    hash: Hash,
    wanted: Vec<u8>,
}

enum Hash {
    Sha1(Sha1),
    Sha256(Sha256),
}

impl Checksum {
    /// What `Upload-Checksum` says, where it is there.
    pub(super) fn read(headers: &HeaderMap) -> HandlerResult<Option<Self>> {
        let Some(value) = headers.get(CHECKSUM) else { return Ok(None) };
        let (name, digest) = value.to_str().ok().and_then(|v| v.trim().split_once(' ')).unwrap_or_default();
        let (hash, bytes) = match name {
            "sha1" => (Hash::Sha1(Sha1::new()), 20),
            "sha256" => (Hash::Sha256(Sha256::new()), 32),
            _ => return Err(malformed("`Upload-Checksum` is `sha1` or `sha256`, a blank, and the digest in base64")),
        };
        let wanted = STANDARD.decode(digest.trim()).ok().filter(|digest| digest.len() == bytes);
        let wanted = wanted
            .ok_or_else(|| malformed(format!("the digest of `Upload-Checksum` is not {bytes} bytes in base64")))?;
        Ok(Some(Checksum { hash, wanted }))
    }

    /// Takes bytes.
    pub(super) fn update(&mut self, bytes: &[u8]) {
        match &mut self.hash {
            Hash::Sha1(hash) => hash.update(bytes),
            Hash::Sha256(hash) => hash.update(bytes),
        }
    }

    /// Whether the bytes are those that were meant.
    pub(super) fn matches(self) -> bool {
        match self.hash {
            Hash::Sha1(hash) => *hash.finalize() == *self.wanted,
            Hash::Sha256(hash) => *hash.finalize() == *self.wanted,
        }
    }
}

/// A time as HTTP writes it (RFC 9110, 5.6.7).
pub(super) fn http_date(time: Timestamp) -> HeaderValue {
    let format = "[weekday repr:short], [day] [month repr:short] [year] [hour]:[minute]:[second] GMT";
    let date = OffsetDateTime::from_unix_timestamp(time.0 / 1000).ok();
    let text = date.and_then(|date| date.format(&parse_borrowed::<2>(format).ok()?).ok());
    text.and_then(|text| HeaderValue::from_str(&text).ok())
        .unwrap_or(HeaderValue::from_static("Fri, 31 Dec 9999 23:59:59 GMT"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with(name: HeaderName, value: &str) -> HeaderMap {
        HeaderMap::from_iter([(name, HeaderValue::from_str(value).unwrap())])
    }

    #[test]
    fn numbers_and_lengths_are_whole_or_refused() {
        assert_eq!(number(&with(OFFSET, "17"), &OFFSET).unwrap(), Some(17));
        for bad in ["", "-1", "+1", "1.5", "1e3", "99999999999999999999", "9223372036854775808"] {
            assert!(number(&with(OFFSET, bad), &OFFSET).is_err(), "{bad}");
        }
        assert!(length(&HeaderMap::new()).is_err());
        assert!(length(&with(DEFER, "1")).unwrap_err().detail.contains("Upload-Length"));
    }

    #[test]
    fn metadata_names_the_file_and_its_hash() {
        let read = |text: &str| metadata(&with(METADATA, text));
        let digits = "AB".repeat(32);
        let text = format!("filename {}, sha256 {},note", STANDARD.encode("tex/ä.png"), STANDARD.encode(&digits));
        let found = read(&text).unwrap();
        assert_eq!((found.filename.as_deref(), found.sha256), (Some("tex/ä.png"), Some(digits.to_lowercase())));
        for bad in [
            "filename !".to_owned(),
            format!("filename {}", STANDARD.encode("../a")),
            format!("filename {}", STANDARD.encode([0xff])),
            format!("sha256 {}", STANDARD.encode("12")),
            "a YQ==,a YQ==".to_owned(),
            "x".repeat(5000),
        ] {
            assert!(read(&bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn checksums_are_those_of_the_bytes() {
        for (name, digest) in
            [("sha1", STANDARD.encode(Sha1::digest(b"ab"))), ("sha256", STANDARD.encode(Sha256::digest(b"ab")))]
        {
            let read = || Checksum::read(&with(CHECKSUM, &format!("{name} {digest}"))).unwrap().unwrap();
            let mut right = read();
            right.update(b"a");
            right.update(b"b");
            assert!(right.matches() && !read().matches());
        }
        for bad in ["md5 YQ==", "sha1 YQ==", "sha1", "sha256 !"] {
            assert!(Checksum::read(&with(CHECKSUM, bad)).is_err(), "{bad}");
        }
    }

    #[test]
    fn dates_are_those_of_http() {
        assert_eq!(http_date(Timestamp(784_111_777_000)), "Sun, 06 Nov 1994 08:49:37 GMT");
        assert_eq!(http_date(Timestamp(i64::MAX)), "Fri, 31 Dec 9999 23:59:59 GMT");
    }
}
