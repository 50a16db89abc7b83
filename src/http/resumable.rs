//! `/v1/uploads`: large files, sent in pieces by tus 1.0, which go on after a break of any kind.

use std::time::Instant;

use axum::body::BodyDataStream;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use futures_util::StreamExt;
use tokio::time::timeout;
use tracing::Instrument;
use utoipa::IntoParams;

use super::access::Caller;
use super::document::Binary;
use super::incoming::patience;
use super::problem::{HandlerResult, Problem};
use super::tus::{self, Checksum, http_date};
use super::upload::{self, draining, media_type, stalled, started};
use super::upload_slots::UploadSlot;
use super::{App, examples};
use crate::error::{Code, Failure};
use crate::jobs::resumable::{NewUpload, Upload, UploadBounds};

/// Which upload is meant.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "describes the path in the OpenAPI document")]
struct UploadPath {
    /// Id of the upload.
    #[param(example = "5f0d2c7b9a1e4836b0c4d8e2f6a19573")]
    id: String,
}

/// Begins an upload: its length is declared, and held against limits and quotas at once. Its bytes are sent by PATCH, in any number of requests;
/// the first of them may be the body of this one. Then `upload:` and its id stand for it wherever a submission names a file.
#[utoipa::path(post, path = "/v1/uploads", tag = "uploads", operation_id = "create_upload",
    params(("Upload-Length" = u64, Header, description = "Bytes that it will have", example = 73400320),
        ("Upload-Metadata" = Option<String>, Header, description = "Pairs of a key and a value in base64, with commas between them: `filename`, a relative path, \
            and `sha256`, the hexadecimal SHA-256 of all bytes, are understood", example = "filename Y2hhaXIuZ2xi"),
        ("Tus-Resumable" = Option<String>, Header, description = "The version of tus: `1.0.0`", example = "1.0.0"),
        ("Upload-Checksum" = Option<String>, Header, description = "`sha1` or `sha256`, a blank, and the digest of this body in base64")),
    responses(
        (status = 201, description = "It is there", body = Upload,
            headers(("Location" = String, description = "The upload"), ("Upload-Offset" = u64, description = "Bytes that are here"),
                ("Upload-Expires" = String, description = "When it is removed"), ("Tus-Resumable" = String, description = "`1.0.0`")),
            example = json!(examples::upload())),
        (status = 400, description = "A malformed header", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "It would be larger than a submission may be", body = Problem, content_type = "application/problem+json"),
        (status = 429, description = "A quota of the key is used up", body = Problem, content_type = "application/problem+json",
            headers(("Retry-After" = u32, description = "Seconds"))),
        (status = 503, description = "The service holds as much as it may", body = Problem, content_type = "application/problem+json",
            headers(("Retry-After" = u32, description = "Seconds")))))]
pub(super) async fn create(
    State(app): State<App>,
    Extension(caller): Extension<Caller>,
    request: Request,
) -> HandlerResult {
    let request = draining(request);
    let headers = request.headers();
    let (length, metadata, checksum) = (tus::length(headers)?, tus::metadata(headers)?, Checksum::read(headers)?);
    let limits = &app.jobs.limits;
    if length > limits.max_upload {
        return Err(upload::too_large(limits.max_upload));
    }
    app.jobs.ready()?;
    upload::check_room(&app, &caller, length).await?;
    let bounds = UploadBounds {
        all: limits.max_kept_uploads,
        of_tenant: limits.max_kept_uploads.div_ceil(2),
        incomplete: caller.quotas().max_uploads,
    };
    let new = NewUpload {
        tenant: caller.tenant().to_owned(),
        filename: metadata.filename,
        metadata: metadata.text,
        length,
        sha256: metadata.sha256,
    };
    let with_bytes = media_type(headers) == tus::MEDIA_TYPE;
    let mut upload = app.jobs.resumable.create(new, bounds).await?;
    if with_bytes && length > 0 {
        // What breaks off here goes on with PATCH.
        upload = append_body(&app, &caller, upload, checksum, request).await?;
    }
    let location = HeaderValue::from_str(&format!("/v1/uploads/{}", upload.id))
        .map_err(|e| Failure::internal(format!("an id cannot stand in a header: {e}")))?;
    let mut response = (StatusCode::CREATED, Json(&upload)).into_response();
    response.headers_mut().insert(header::LOCATION, location);
    Ok(told(response, &upload))
}

/// How far an upload is. HEAD is answered with the headers alone, as tus wants it.
#[utoipa::path(get, path = "/v1/uploads/{id}", tag = "uploads", operation_id = "read_upload", params(UploadPath), responses(
    (status = 200, description = "As it is now", body = Upload,
        headers(("Upload-Offset" = u64, description = "Bytes that are here"), ("Upload-Length" = u64, description = "Bytes that it will have"),
            ("Upload-Metadata" = Option<String>, description = "As it was declared"), ("Upload-Expires" = String, description = "When it is removed")),
        example = json!(examples::upload())),
    (status = 404, description = "No such upload", body = Problem, content_type = "application/problem+json"),
    (status = 410, description = "It has expired", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn read(State(app): State<App>, Path(id): Path<String>) -> HandlerResult {
    let upload = app.jobs.resumable.get(&id).await?;
    let mut response = told(Json(&upload).into_response(), &upload);
    let headers = response.headers_mut();
    headers.insert(tus::LENGTH, upload.length.into());
    if let Ok(metadata) = HeaderValue::from_str(&upload.metadata)
        && !metadata.is_empty()
    {
        headers.insert(tus::METADATA, metadata);
    }
    Ok(response)
}

/// Adds bytes to an upload. What has come when a request breaks off stays, unless it has an `Upload-Checksum`. With the last byte the whole is held
/// against the `sha256` that was declared; where it is another, the upload is removed.
#[utoipa::path(patch, path = "/v1/uploads/{id}", tag = "uploads", operation_id = "append_upload",
    params(UploadPath, ("Upload-Offset" = u64, Header, description = "Bytes that are here", example = 0),
        ("Upload-Checksum" = Option<String>, Header, description = "`sha1` or `sha256`, a blank, and the digest of this body in base64"),
        ("Tus-Resumable" = Option<String>, Header, description = "The version of tus: `1.0.0`", example = "1.0.0")),
    request_body(description = "The bytes from there on", content((inline(Binary) = "application/offset+octet-stream"))),
    responses(
        (status = 204, description = "They are stored", headers(("Upload-Offset" = u64, description = "Bytes that are here"),
            ("Upload-Expires" = String, description = "When it is removed"))),
        (status = 400, description = "A malformed header, or the request broke off", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "No such upload", body = Problem, content_type = "application/problem+json"),
        (status = 408, description = "The request stood still", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "Another number of bytes is here, or another request adds to it", body = Problem,
            content_type = "application/problem+json"),
        (status = 410, description = "It has expired", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "There are more bytes than were declared", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "Not `application/offset+octet-stream`", body = Problem, content_type = "application/problem+json"),
        (status = 429, description = "A quota of the key is used up", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The service is busy", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn append(
    State(app): State<App>,
    Extension(caller): Extension<Caller>,
    Path(id): Path<String>,
    request: Request,
) -> HandlerResult {
    let request = draining(request);
    let headers = request.headers();
    let given = media_type(headers);
    if given != tus::MEDIA_TYPE {
        let detail = format!("`{given}` is not taken; send {}", tus::MEDIA_TYPE);
        return Err(Problem::new(Code::UnsupportedMediaType, detail));
    }
    let offset = tus::number(headers, &tus::OFFSET)?;
    let offset = offset.ok_or_else(|| {
        Problem::new(Code::InvalidRequest, "`Upload-Offset` is missing: the bytes that are here already")
    })?;
    let checksum = Checksum::read(headers)?;
    app.jobs.ready()?;
    let upload = app.jobs.resumable.get(&id).await?;
    if upload.offset != offset {
        let detail = format!("{} bytes of this upload are here, and `Upload-Offset` is {offset}", upload.offset);
        return Ok(told(Problem::new(Code::Conflict, detail).into_response(), &upload));
    }
    let upload = append_body(&app, &caller, upload, checksum, request).await?;
    Ok(told(StatusCode::NO_CONTENT.into_response(), &upload))
}

/// Removes an upload. Jobs that were submitted with it have their own copy.
#[utoipa::path(delete, path = "/v1/uploads/{id}", tag = "uploads", operation_id = "delete_upload", params(UploadPath), responses(
    (status = 204, description = "It is gone"),
    (status = 404, description = "No such upload", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn remove(State(app): State<App>, Path(id): Path<String>) -> HandlerResult<StatusCode> {
    app.jobs.resumable.remove(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// An answer that tells where the upload stands.
fn told(mut response: Response, upload: &Upload) -> Response {
    let headers: &mut HeaderMap = response.headers_mut();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    headers.insert(tus::OFFSET, upload.offset.into());
    headers.insert(tus::EXPIRES, http_date(upload.expires_at));
    response
}

/// Adds the body of a request to an upload.
async fn append_body(
    app: &App,
    caller: &Caller,
    upload: Upload,
    checksum: Option<Checksum>,
    request: Request,
) -> HandlerResult<Upload> {
    let left = upload.length - upload.offset;
    let announced = request.headers().get(header::CONTENT_LENGTH).and_then(|v| v.to_str().ok()?.parse::<u64>().ok());
    if announced.is_some_and(|bytes| bytes > left) {
        return Err(too_many(&upload));
    }
    if left == 0 {
        return if upload.complete { Ok(upload) } else { Ok(app.jobs.resumable.finish(&upload).await?) };
    }
    // Declared bytes are counted already; here it is about what all clients have sent.
    upload::check_waiting(app, announced.unwrap_or(0)).await?;
    if announced == Some(0) {
        return Ok(upload);
    }
    let request = started(request, app.jobs.limits.upload_idle).await?;
    let slot = upload::slot(app, caller)?;
    let (app, body) = (app.clone(), request.into_body().into_data_stream());
    // A task of its own: when the connection breaks, what has come is stored before it ends.
    let received = tokio::spawn(receive(app, upload, body, checksum, slot).in_current_span()).await;
    received.map_err(|e| Failure::internal(format!("the upload was lost: {e}")))?
}

async fn receive(
    app: App,
    upload: Upload,
    mut body: BodyDataStream,
    mut checksum: Option<Checksum>,
    _slot: UploadSlot,
) -> HandlerResult<Upload> {
    let (resumable, began) = (app.jobs.resumable.clone(), Instant::now());
    let mut writer = resumable.hold(&upload, checksum.is_none()).await?;
    let ended = loop {
        let patience = patience(&app.jobs.limits, writer.offset() - upload.offset, began);
        match timeout(patience, body.next()).await {
            Err(_) => break Err(stalled()),
            Ok(None) => break Ok(()),
            Ok(Some(Err(e))) => {
                break Err(Problem::new(Code::InvalidRequest, format!("the request broke off: {e}")));
            }
            Ok(Some(Ok(chunk))) => {
                if chunk.len() as u64 > upload.length - writer.offset() {
                    break Err(too_many(&upload));
                }
                if let Some(checksum) = &mut checksum {
                    checksum.update(&chunk);
                }
                writer.write(&chunk).await?;
            }
        }
    };
    if let Some(checksum) = checksum {
        let why = match ended {
            Ok(()) if checksum.matches() => None,
            Ok(()) => {
                let detail = "the bytes do not have the `Upload-Checksum`, and none of them was taken; send them again";
                Some(Problem::new(Code::ChecksumMismatch, detail))
            }
            Err(ref problem) => Some(problem.clone()),
        };
        if let Some(problem) = why {
            writer.discard().await;
            return Err(problem);
        }
    }
    let offset = writer.commit().await?;
    app.jobs.telemetry.received.inc_by(offset - upload.offset);
    ended?;
    let upload = resumable.get(&upload.id).await?;
    if upload.offset == upload.length { Ok(resumable.finish(&upload).await?) } else { Ok(upload) }
}

fn too_many(upload: &Upload) -> Problem {
    let detail = format!("{} bytes were declared for this upload, and more were sent", upload.length);
    Problem::new(Code::TooLarge, detail)
}
