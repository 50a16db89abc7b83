//! `/v1/jobs/{id}/artifacts/{name}`: the files of a result.

use std::ops::RangeInclusive;

use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::Response;
use futures_util::TryStreamExt;
use percent_encoding::{NON_ALPHANUMERIC, utf8_percent_encode};
use utoipa::openapi::{self, HeaderBuilder, RefOr};
use utoipa::{IntoParams, PartialSchema, ToResponse, ToSchema};

use super::App;
use super::document::Binary;
use super::examples;
use super::jobs::{JobPath, matches};
use super::problem::{HandlerResult, Problem};
use crate::error::{Code, Failure};
use crate::metrics::Report;
use crate::texture::Format;

/// What an artifact is asked for with.
#[derive(IntoParams)]
#[into_params(parameter_in = Header)]
#[expect(dead_code, reason = "describes the headers in the OpenAPI document")]
struct ArtifactHeaders {
    /// One range of bytes.
    #[param(rename = "Range", example = "bytes=0-1023")]
    range: Option<String>,
    /// ETag under which `Range` holds.
    #[param(rename = "If-Range", example = "\"5f70bf18\"")]
    if_range: Option<String>,
    /// ETags that the client has.
    #[param(rename = "If-None-Match", example = "\"5f70bf18\"")]
    if_none_match: Option<String>,
}

/// The bytes of an artifact.
pub(super) struct ArtifactBytes;

impl ToResponse<'_> for ArtifactBytes {
    fn response() -> (&'static str, RefOr<openapi::Response>) {
        // Generators take the first for all of them.
        let types =
            ["application/octet-stream", "model/gltf-binary", "model/gltf+json", "application/zip", "image/svg+xml"];
        let images = [Format::Png, Format::Jpeg, Format::Webp, Format::Ktx2].map(Format::media_type);
        let response = types
            .into_iter()
            .chain(images)
            .fold(openapi::ResponseBuilder::new().description("The bytes"), |response, media_type| {
                response.content(media_type, openapi::Content::new(Some(Binary::schema())))
            });
        let report = openapi::Content::new(Some(openapi::Ref::from_schema_name(Report::name())));
        let response = response.content("application/json", report);
        let header = |text: &str| HeaderBuilder::new().description(Some(text)).build();
        let response = response
            .header("ETag", header("Of the artifact: its SHA-256"))
            .header("Content-Disposition", header("Its name"))
            .header("Accept-Ranges", header("`bytes`"));
        ("Artifact", response.build().into())
    }
}

/// The report: the figures of every atlas, before and after.
#[utoipa::path(get, path = "/v1/jobs/{id}/artifacts/report.json", tag = "jobs", params(JobPath, ArtifactHeaders),
    responses(
        (status = 200, description = "The report", body = Report, example = json!(examples::report())),
        (status = 206, description = "The bytes of the range",
            headers(("Content-Range" = String, description = "Where they stand in the whole"))),
        (status = 304, description = "The client has it"),
        (status = 404, description = "No such job, or it has no report", body = Problem, content_type = "application/problem+json"),
        (status = 410, description = "The artifacts have been removed", body = Problem, content_type = "application/problem+json"),
        (status = 416, description = "The range is outside", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn report(app: State<App>, Path(id): Path<String>, headers: HeaderMap) -> HandlerResult {
    fetch(app, Path((id, "report.json".to_owned())), headers).await
}

/// The bytes of an artifact. They never change; a range of them can be asked for.
#[utoipa::path(get, path = "/v1/jobs/{id}/artifacts/{name}", tag = "jobs",
    params(JobPath, ("name" = String, Path, description = "Name of the artifact", example = "model.glb"), ArtifactHeaders),
    responses(
        (status = 200, response = ArtifactBytes),
        (status = 206, description = "The bytes of the range, in the media type of the whole",
            headers(("Content-Range" = String, description = "Where they stand in the whole"))),
        (status = 304, description = "The client has it"),
        (status = 404, description = "No such job or artifact", body = Problem, content_type = "application/problem+json"),
        (status = 410, description = "The artifacts have been removed", body = Problem, content_type = "application/problem+json"),
        (status = 416, description = "The range is outside", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn fetch(
    State(app): State<App>,
    Path((id, name)): Path<(String, String)>,
    headers: HeaderMap,
) -> HandlerResult {
    let entry = app.jobs.artifact(&id, &name).await?;
    let etag = format!("\"{}\"", entry.sha256);
    let builder = Response::builder()
        .header(header::ETAG, &etag)
        .header(header::CACHE_CONTROL, "private, max-age=31536000, immutable")
        .header(header::ACCEPT_RANGES, "bytes")
        .header(header::X_CONTENT_TYPE_OPTIONS, "nosniff");
    let built = |response: axum::http::Result<Response>| {
        response.map_err(|e| Problem::from(Failure::internal(format!("the answer cannot be built: {e}"))))
    };
    if matches(&headers, &etag) {
        return built(builder.status(StatusCode::NOT_MODIFIED).body(Body::empty()));
    }
    let same = headers.get(header::IF_RANGE).is_none_or(|v| v.as_bytes() == etag.as_bytes());
    let asked = headers.get(header::RANGE).filter(|_| same).and_then(|v| v.to_str().ok());
    let media_type = HeaderValue::from_str(&entry.media_type)
        .unwrap_or_else(|_| HeaderValue::from_static("application/octet-stream"));
    let builder =
        builder.header(header::CONTENT_TYPE, media_type).header(header::CONTENT_DISPOSITION, disposition(&entry.name));
    let (builder, range) = match asked.map_or(RequestedRange::All, |text| parse_range(text, entry.bytes)) {
        RequestedRange::All => (builder.status(StatusCode::OK), 0..=entry.bytes.saturating_sub(1)),
        RequestedRange::Part(part) => {
            let content = format!("bytes {}-{}/{}", part.start(), part.end(), entry.bytes);
            (builder.status(StatusCode::PARTIAL_CONTENT).header(header::CONTENT_RANGE, content), part)
        }
        RequestedRange::Unsatisfiable => {
            let problem = Problem::new(Code::InvalidRequest, format!("the artifact has {} bytes", entry.bytes));
            let mut response =
                axum::response::IntoResponse::into_response(problem.with_status(StatusCode::RANGE_NOT_SATISFIABLE));
            if let Ok(value) = HeaderValue::from_str(&format!("bytes */{}", entry.bytes)) {
                response.headers_mut().insert(header::CONTENT_RANGE, value);
            }
            return Ok(response);
        }
    };
    let range = if entry.bytes == 0 { 0..0 } else { *range.start()..range.end() + 1 };
    let length = range.end - range.start;
    // A client that is not given all that was announced knows that it has nothing.
    let parts = app.jobs.bytes(&entry, range).await?.map_err(std::io::Error::other);
    built(builder.header(header::CONTENT_LENGTH, length).body(Body::from_stream(parts)))
}

/// What a `Range` header asks for.
#[derive(Debug, PartialEq)]
enum RequestedRange {
    /// Everything; also what is not understood, as RFC 9110 (14.2) wants it.
    All,
    Part(RangeInclusive<u64>),
    Unsatisfiable,
}

fn parse_range(text: &str, length: u64) -> RequestedRange {
    let Some((first, last)) = text.strip_prefix("bytes=").and_then(|r| r.trim().split_once('-')) else {
        return RequestedRange::All;
    };
    let number = |t: &str| if t.bytes().all(|b| b.is_ascii_digit()) { t.parse::<u64>().ok() } else { None };
    let part = match (first.is_empty(), last.is_empty()) {
        (true, true) => return RequestedRange::All,
        (true, false) => match number(last) {
            Some(0) => return RequestedRange::Unsatisfiable,
            Some(n) => length.saturating_sub(n)..=length.saturating_sub(1),
            None => return RequestedRange::All,
        },
        (false, open) => match (number(first), if open { Some(u64::MAX) } else { number(last) }) {
            (Some(a), Some(b)) if a <= b => a..=b.min(length.saturating_sub(1)),
            _ => return RequestedRange::All,
        },
    };
    if *part.start() >= length { RequestedRange::Unsatisfiable } else { RequestedRange::Part(part) }
}

/// The file name, plain where it can be and in full beside it (RFC 6266).
fn disposition(name: &str) -> String {
    let plain: String = name
        .chars()
        .map(|c| if c.is_ascii_graphic() && !matches!(c, '"' | '\\' | '/' | '%') { c } else { '_' })
        .collect();
    if plain == name {
        return format!("attachment; filename=\"{plain}\"");
    }
    format!("attachment; filename=\"{plain}\"; filename*=UTF-8''{}", utf8_percent_encode(name, NON_ALPHANUMERIC))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_those_of_rfc_9110() {
        assert_eq!(parse_range("bytes=0-0", 10), RequestedRange::Part(0..=0));
        assert_eq!(parse_range("bytes=2-", 10), RequestedRange::Part(2..=9));
        assert_eq!(parse_range("bytes=2-99", 10), RequestedRange::Part(2..=9));
        assert_eq!(parse_range("bytes=-3", 10), RequestedRange::Part(7..=9));
        assert_eq!(parse_range("bytes=-30", 10), RequestedRange::Part(0..=9));
        for outside in ["bytes=10-", "bytes=10-12", "bytes=-0"] {
            assert_eq!(parse_range(outside, 10), RequestedRange::Unsatisfiable, "{outside}");
        }
        for all in ["bytes=3-2", "bytes=0-1,4-5", "lines=1-2", "bytes=-", "bytes=a-b", "bytes=+1-2"] {
            assert_eq!(parse_range(all, 10), RequestedRange::All, "{all}");
        }
        assert_eq!(parse_range("bytes=0-", 0), RequestedRange::Unsatisfiable);
    }

    #[test]
    fn names_stay_inside_their_header() {
        assert_eq!(disposition("model.glb"), "attachment; filename=\"model.glb\"");
        let odd = disposition("a\"b\r\nü.png");
        assert!(
            odd.starts_with("attachment; filename=\"a_b___.png\"; filename*=UTF-8''a%22b%0D%0A%C3%BC%2Epng"),
            "{odd}"
        );
    }
}
