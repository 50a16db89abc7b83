//! How a submission comes in: streamed to the disk, counted while it streams, checked, handed to the queue.

use axum::body::{Body, BodyDataStream, Bytes};
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{HeaderMap, header};
use futures_util::{Stream, StreamExt};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::runtime::Handle;
use tokio::time::timeout;
use tracing::Instrument;
use utoipa::ToSchema;

use super::App;
use super::access::Caller;
use super::incoming::IncomingUpload;
use super::problem::{HandlerResult, Problem};
use super::references::{Sources, reference};
use super::trace;
use super::upload_slots::UploadSlot;
use crate::error::{Code, Failure};
use crate::jobs::Taken;
use crate::jobs::queue::NewJob;
use crate::jobs::record::Job;
use crate::params::{Problem as OptionProblem, typed};
use crate::refine::options::{Options, OptionsSchema};
use crate::refine::parse;

/// Bytes of the `options` of a submission.
pub(super) const MAX_OPTIONS_BYTES: usize = 1 << 20;
/// How much of a refused request is still read, and for how long.
const MAX_DRAINED_BYTES: usize = 32 << 20;
const MAX_DRAIN_TIME: Duration = Duration::from_secs(3);
/// From when on an upload must have the least rate.
pub(super) const RATE_GRACE: Duration = Duration::from_secs(20);
/// Bytes of an Idempotency-Key.
const MAX_KEY_BYTES: usize = 255;
/// Bytes of a file's relative path.
const MAX_PATH_BYTES: usize = 1024;

/// A model with its files.
#[derive(ToSchema)]
#[serde(deny_unknown_fields)]
#[expect(dead_code, reason = "describes the form in the OpenAPI document; its fields are read as a stream")]
pub(super) struct Submission {
    /// The model: .glb, .gltf, .obj, .b3dm, .i3dm or .zip. Several models share one atlas, and come out as `model-0`, `model-1`, …
    #[schema(value_type = Vec<String>, format = Binary, min_items = 1)]
    model: Vec<Vec<u8>>,
    /// Files that the models, or `importance.texture`, name; the file name may hold a relative path.
    #[schema(value_type = Vec<String>, format = Binary, required = false)]
    files: Vec<Vec<u8>>,
    /// The options, as JSON.
    #[schema(value_type = OptionsSchema, required = false)]
    options: Option<Options>,
}

/// What came of a submission.
pub(super) enum Received {
    /// A job.
    Job(Box<Job>, Taken),
    /// It would be a job.
    Valid(Validation),
}

/// What a submission would be as a job.
#[derive(Serialize, ToSchema)]
pub(super) struct Validation {
    /// `true`.
    #[schema(default = true)]
    valid: bool,
    /// The options, all defaults filled in.
    #[schema(value_type = OptionsSchema)]
    options: Value,
    /// Bytes of memory that the job would be expected to need.
    memory_bytes: u64,
    /// Bytes that were sent.
    upload_bytes: u64,
}

impl Validation {
    pub(super) fn new(options: Value, memory_bytes: u64, upload_bytes: u64) -> Self {
        Validation { valid: true, options, memory_bytes, upload_bytes }
    }
}

/// Receives a submission and stores it as a job, unless it is only to be looked at.
pub(super) async fn receive(app: &App, request: Request) -> HandlerResult<Received> {
    let (told, caller) = (Told::by(&request), caller(&request)?);
    let request = draining(request);
    let key = key(request.headers())?;
    let UploadQuery { recipe, validate_only } = query(&request)?;
    admit(app, &caller, request.headers()).await?;
    let request = started(request, app.jobs.limits.upload_idle).await?;
    let _slot = slot(app, &caller)?;
    let mut incoming = IncomingUpload::new(app, &caller).await?;
    let media_type = media_type(request.headers());
    let mut options = match media_type.as_str() {
        "multipart/form-data" => form(&mut incoming, request).await?,
        "application/json" => by_reference(&mut incoming, request).await?,
        "model/gltf-binary" => raw(&mut incoming, request, "model.glb").await?,
        "model/gltf+json" => raw(&mut incoming, request, "model.gltf").await?,
        "application/zip" | "application/x-zip-compressed" => raw(&mut incoming, request, "model.zip").await?,
        "application/octet-stream" => raw(&mut incoming, request, "model").await?,
        other => {
            let detail = format!(
                "`{other}` is not taken; send multipart/form-data, application/json, model/gltf-binary, model/gltf+json, application/zip \
                 or application/octet-stream"
            );
            return Err(Problem::new(Code::UnsupportedMediaType, detail));
        }
    };
    if let Some(recipe) = recipe {
        named(&mut options, recipe)?;
    }
    let options = judged(app, &caller, &options)?;
    incoming.check().await?;
    check_room(app, &caller, incoming.bytes).await?;
    let memory = incoming.memory(options.demand()).await?;
    let options = serde_json::to_value(&options).map_err(|e| Failure::internal(e.to_string()))?;
    if validate_only {
        return Ok(Received::Valid(Validation::new(options, memory, incoming.bytes)));
    }
    let job = new_job(app, &caller, &incoming, options, (memory, key, told)).await;
    incoming.leave();
    let jobs = app.jobs.clone();
    app.jobs.telemetry.received.inc_by(incoming.sent);
    // A task of its own: a client that goes away now does not stop it half-way.
    let stored = tokio::spawn(async move { jobs.submit(&job).await }.in_current_span()).await;
    let (job, taken) = stored.map_err(|e| Failure::internal(format!("the submission was lost: {e}")))??;
    Ok(Received::Job(job.into(), taken))
}

/// The options of a job, as far as they can be judged without its files.
pub(super) fn judged(app: &App, caller: &Caller, options: &Value) -> HandlerResult<Options> {
    let options = parse::options(options).map_err(Problem::options)?;
    if let Some(url) = &options.webhook {
        check_webhook(app, caller, url)?;
    }
    Ok(options)
}

/// The job that a submission becomes, with the memory that it needs, the client's key and what the request tells of itself.
pub(super) async fn new_job(
    app: &App,
    caller: &Caller,
    incoming: &IncomingUpload<'_>,
    options: Value,
    (memory, key, told): (u64, Option<String>, Told),
) -> NewJob {
    let quotas = caller.quotas();
    NewJob {
        key: key.map(|key| (key, incoming.fingerprint(&options))),
        result_key: incoming.result_key(&options).await,
        id: incoming.id.clone(),
        options,
        bytes: incoming.bytes,
        inputs: incoming.manifest.clone(),
        memory,
        request: told.request,
        trace: told.trace,
        tenant: caller.tenant().to_owned(),
        max_queued: quotas.max_queued,
        max_running: quotas.max_running,
        keep: app.jobs.limits.keep_artifacts,
    }
}

/// Whether a job may name this URL to be told.
fn check_webhook(app: &App, caller: &Caller, url: &str) -> HandlerResult<()> {
    let refused = |why: String| Problem::options(vec![crate::params::Problem::new("/webhook", why)]);
    if app.jobs.webhooks.job_secret(caller.tenant()).is_none() {
        return Err(refused(
            "this service signs nothing for single jobs: it was started without `--webhook-secret`".to_owned(),
        ));
    }
    app.jobs.webhooks.check_url(url).map_err(|failure| refused(failure.message))
}

/// The client's name for its request: what is sent again under it is not done again.
pub(super) fn key(headers: &HeaderMap) -> HandlerResult<Option<String>> {
    let Some(value) = headers.get("idempotency-key") else { return Ok(None) };
    match value.to_str() {
        Ok(key) if is_key(key) => Ok(Some(key.to_owned())),
        _ => {
            let detail = format!("an Idempotency-Key has 1 to {MAX_KEY_BYTES} visible ASCII characters");
            Err(Problem::new(Code::InvalidRequest, detail))
        }
    }
}

/// Whether a text can be an Idempotency-Key.
pub(super) fn is_key(text: &str) -> bool {
    (1..=MAX_KEY_BYTES).contains(&text.len()) && text.bytes().all(|b| (0x20..0x7f).contains(&b))
}

/// Whoever sends the request.
pub(super) fn caller(request: &Request) -> HandlerResult<Caller> {
    let caller = request.extensions().get::<Caller>().cloned();
    Ok(caller.ok_or_else(|| Failure::internal("nobody has looked at who calls"))?)
}

/// What a request tells of itself.
#[derive(Debug, Clone)]
pub(super) struct Told {
    request: Option<String>,
    trace: Option<String>,
}

impl Told {
    pub(super) fn by(request: &Request) -> Self {
        let id = request.headers().get("x-request-id").and_then(|v| v.to_str().ok());
        Told { request: id.map(truncated), trace: trace::of(request) }
    }
}

/// The request, whose body is read on for a while when it is refused.
pub(super) fn draining(request: Request) -> Request {
    request.map(|body| Body::from_stream(DrainOnDrop(Some(body.into_data_stream()))))
}

/// What is refused before anything is read.
pub(super) async fn admit(app: &App, caller: &Caller, headers: &HeaderMap) -> HandlerResult<()> {
    let limits = &app.jobs.limits;
    app.jobs.ready()?;
    // A request with a key may be known: that shows only when all of it is here.
    if !headers.contains_key("idempotency-key") && app.jobs.waiting().await? >= u64::from(limits.max_queued) {
        return Err(crate::jobs::queue::queue_full().into());
    }
    let announced = headers.get(header::CONTENT_LENGTH).and_then(|v| v.to_str().ok()?.parse::<u64>().ok());
    // The form around the files may add a little.
    if announced.is_some_and(|n| n > limits.max_upload.saturating_add(MAX_OPTIONS_BYTES as u64 * 2)) {
        return Err(too_large(limits.max_upload));
    }
    check_room(app, caller, announced.unwrap_or(0)).await
}

/// Whether so many bytes more may be stored: by the quota of the tenant, and of all.
pub(super) async fn check_room(app: &App, caller: &Caller, bytes: u64) -> HandlerResult<()> {
    if let (Some(most), Some(tenant)) = (caller.quotas().max_stored, caller.tenant_if_any()) {
        let stored = app.jobs.queue.stored_bytes(Some(tenant)).await?;
        let pieces = app.jobs.resumable.bytes(Some(tenant)).await?.declared;
        let stored = stored.uploads.saturating_add(stored.artifacts).saturating_add(pieces);
        if stored.saturating_add(bytes) > most {
            let detail = format!(
                "the uploads and results of this tenant take {stored} bytes, and this key allows {most}: results expire by themselves, or are \
                 deleted with their jobs"
            );
            return Err(Problem::new(Code::QuotaExceeded, detail));
        }
    }
    check_waiting(app, bytes).await
}

/// Whether so many bytes more may wait, those of all clients together.
pub(super) async fn check_waiting(app: &App, bytes: u64) -> HandlerResult<()> {
    let limits = &app.jobs.limits;
    let stored = app.jobs.queue.stored_bytes(None).await?;
    let waiting = stored.uploads.saturating_add(app.jobs.resumable.bytes(None).await?.received);
    if waiting.saturating_add(bytes) > limits.max_waiting {
        let most = limits.max_waiting;
        let detail = format!("uploads, and the jobs that wait, hold {waiting} of {most} bytes; try again later");
        return Err(Problem::new(Code::QueueFull, detail));
    }
    if stored.artifacts >= limits.max_stored {
        let detail = format!(
            "the results that are kept take {} bytes, and {} are allowed: they expire by themselves, or are deleted with their jobs",
            stored.artifacts, limits.max_stored
        );
        return Err(Problem::new(Code::InsufficientStorage, detail));
    }
    Ok(())
}

/// A slot for what is received now.
pub(super) fn slot(app: &App, caller: &Caller) -> HandlerResult<UploadSlot> {
    let most = caller.quotas().max_uploads;
    app.uploads.take(caller.client(), most).ok_or_else(|| {
        match most.filter(|most| app.uploads.taken_by(&caller.client()) >= *most as usize) {
            Some(most) => {
                let detail = format!("this key lets {most} submissions be received at the same time, and so many are");
                Problem::new(Code::QuotaExceeded, detail)
            }
            None => Problem::new(Code::QueueFull, "too many submissions at the same time; try again later"),
        }
    })
}

/// The same request when the first bytes of its body are here: one that only waits holds no slot.
pub(super) async fn started(request: Request, limit: Duration) -> HandlerResult<Request> {
    let (head, body) = request.into_parts();
    let mut body = body.into_data_stream();
    let first = timeout(limit, body.next()).await.map_err(|_| stalled())?;
    Ok(Request::from_parts(head, Body::from_stream(futures_util::stream::iter(first).chain(body))))
}

/// What the query of a submission says.
#[derive(Default)]
pub(super) struct UploadQuery {
    pub(super) recipe: Option<Value>,
    pub(super) validate_only: bool,
}

pub(super) fn query(request: &Request) -> HandlerResult<UploadQuery> {
    let query: axum::extract::Query<Vec<(String, String)>> = axum::extract::Query::try_from_uri(request.uri())
        .map_err(|e| Problem::new(Code::InvalidRequest, e.body_text()))?;
    let (mut recipe, mut validate_only) = (None, None);
    for (key, value) in query.0 {
        if key == "validate_only" {
            let wanted = match value.as_str() {
                "true" => true,
                "false" => false,
                _ => return Err(Problem::new(Code::InvalidRequest, "`validate_only` is true or false")),
            };
            if validate_only.replace(wanted).is_some() {
                return Err(Problem::new(Code::InvalidRequest, "`validate_only` stands twice in the query"));
            }
            continue;
        }
        if key != "recipe" {
            let detail = format!(
                "unknown parameter `{}`: the query takes `recipe` and `validate_only`, everything else stands in the `options` of a form or of a JSON body",
                truncated(&key)
            );
            return Err(Problem::new(Code::InvalidRequest, detail));
        }
        if recipe.replace(parse::recipe_named(&value)).is_some() {
            return Err(Problem::new(Code::InvalidRequest, "`recipe` stands twice in the query"));
        }
    }
    Ok(UploadQuery { recipe, validate_only: validate_only.unwrap_or(false) })
}

/// Options with the recipe that the query names.
fn named(options: &mut Value, recipe: Value) -> HandlerResult<()> {
    // What is no object is told by those who read the options.
    let Some(map) = options.as_object_mut() else { return Ok(()) };
    match map.get("recipe") {
        Some(other) if *other != recipe => {
            let detail = "the query names another `recipe` than the options; name it once";
            Err(Problem::new(Code::InvalidRequest, detail))
        }
        _ => {
            map.insert("recipe".to_owned(), recipe);
            Ok(())
        }
    }
}

/// The body of a request, whose rest is still read for a while when it is dropped before its end: a client that is
/// still sending would lose the answer when the connection closes under it.
pub(super) struct DrainOnDrop(pub(super) Option<BodyDataStream>);

impl Stream for DrainOnDrop {
    type Item = Result<Bytes, axum::Error>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let Some(body) = &mut self.0 else { return Poll::Ready(None) };
        let next = ready!(body.poll_next_unpin(context));
        if !matches!(next, Some(Ok(_))) {
            self.0 = None;
        }
        Poll::Ready(next)
    }
}

impl Drop for DrainOnDrop {
    fn drop(&mut self) {
        let (Some(mut body), Ok(runtime)) = (self.0.take(), Handle::try_current()) else { return };
        runtime.spawn(async move {
            let mut left = MAX_DRAINED_BYTES;
            let read = async {
                while let Some(Ok(chunk)) = body.next().await {
                    left = left.saturating_sub(chunk.len());
                    if left == 0 {
                        break;
                    }
                }
            };
            // Nobody waits for what was refused.
            let _ = timeout(MAX_DRAIN_TIME, read).await;
        });
    }
}

/// A JSON document that is received in pieces.
pub(super) async fn json<E: std::fmt::Display>(
    incoming: &IncomingUpload<'_>,
    what: &str,
    most: usize,
    stream: impl Stream<Item = Result<Bytes, E>>,
) -> HandlerResult<Value> {
    let mut text = Vec::new();
    let mut stream = std::pin::pin!(stream);
    while let Some(chunk) = timeout(incoming.patience(), stream.next()).await.map_err(|_| stalled())? {
        let chunk = chunk.map_err(|e| Problem::new(Code::InvalidRequest, format!("the upload broke off: {e}")))?;
        if text.len() + chunk.len() > most {
            return Err(Problem::new(Code::TooLarge, format!("{what} exceed {most} bytes")));
        }
        text.extend_from_slice(&chunk);
    }
    parse::json(&text).map_err(|e| Problem::new(Code::InvalidRequest, format!("{what} are not JSON: {e}")))
}

/// A JSON body that names uploads.
async fn by_reference(incoming: &mut IncomingUpload<'_>, request: Request) -> HandlerResult<Value> {
    let body = request.into_body().into_data_stream();
    let body = json(incoming, "the names of the files and the options", 2 * MAX_OPTIONS_BYTES, body).await?;
    let fields: Fields = typed(&body, "").map_err(|problem| Problem::options(vec![problem]))?;
    let sources = Sources::read(&fields.model, &fields.files, "").map_err(|problem| Problem::options(vec![problem]))?;
    for (source, is_model) in sources.iter() {
        let Some(id) = reference(&source.from) else {
            let why = format!("`{}` is not `upload:` and the id of an upload", truncated(&source.from));
            return Err(Problem::options(vec![OptionProblem::new(&source.pointer, why)]));
        };
        let path = source.path.as_deref().map(relative).transpose()?;
        let stored = incoming.take_upload(id, path, &source.pointer).await?;
        incoming.add(stored, is_model)?;
    }
    Ok(fields.options)
}

/// The fields of a JSON submission.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Fields {
    #[serde(default)]
    model: Value,
    #[serde(default)]
    files: Value,
    #[serde(default = "no_options")]
    options: Value,
}

fn no_options() -> Value {
    Value::Object(serde_json::Map::new())
}

/// A submission whose files were uploaded before.
#[derive(ToSchema)]
#[serde(deny_unknown_fields)]
#[expect(dead_code, reason = "describes the body in the OpenAPI document; it is read by hand, for errors that help")]
pub(super) struct JsonSubmission {
    /// The models: `upload:` and the id of a complete upload, each. Several models share one atlas.
    #[schema(value_type = OneOrMany)]
    model: OneOrMany,
    /// Files that the models, or `importance.texture`, name: by their paths, or as a list of uploads that were given their paths when they
    /// began.
    #[schema(value_type = NamedFiles, required = false)]
    files: Option<NamedFiles>,
    /// The options.
    #[schema(value_type = OptionsSchema, required = false)]
    options: Option<Options>,
}

/// The name of a file, or several.
#[derive(ToSchema)]
#[serde(untagged)]
#[expect(dead_code, reason = "describes a body in the OpenAPI document")]
pub(super) enum OneOrMany {
    /// One.
    One(String),
    /// Several.
    Many(Vec<String>),
}

/// Files by their paths, or with the paths that they have.
#[derive(ToSchema)]
#[serde(untagged)]
#[expect(dead_code, reason = "describes a body in the OpenAPI document")]
pub(super) enum NamedFiles {
    /// By their paths.
    Paths(BTreeMap<String, String>),
    /// As they are called.
    Names(Vec<String>),
}

/// The raw model as the body; its options are in the query.
async fn raw(incoming: &mut IncomingUpload<'_>, request: Request, path: &str) -> HandlerResult<Value> {
    let stored = incoming.store(path.to_owned(), request.into_body().into_data_stream()).await?;
    incoming.manifest.models.push(stored);
    Ok(Value::Object(serde_json::Map::new()))
}

/// A form: `model` once or several times, any number of `files`, `options` at most once.
async fn form(incoming: &mut IncomingUpload<'_>, request: Request) -> HandlerResult<Value> {
    let mut form =
        Multipart::from_request(request, &()).await.map_err(|e| Problem::new(Code::InvalidRequest, e.body_text()))?;
    let mut options = None;
    loop {
        let field = timeout(incoming.patience(), form.next_field()).await.map_err(|_| stalled())?;
        let Some(mut field) = field.map_err(|e| Problem::new(Code::InvalidRequest, e.body_text()))? else { break };
        let name = field.name().unwrap_or_default().to_owned();
        match name.as_str() {
            "model" => {
                let path = relative(field.file_name().filter(|n| !n.is_empty()).unwrap_or("model"))?;
                incoming.check_path_unused(&path)?;
                let stored = incoming.store(path, field).await?;
                incoming.add(stored, true)?;
            }
            "files" => {
                let Some(path) = field.file_name().map(str::to_owned) else {
                    return Err(Problem::new(Code::InvalidRequest, "a field `files` has no file name"));
                };
                let path = relative(&path)?;
                incoming.check_path_unused(&path)?;
                let stored = incoming.store(path, field).await?;
                incoming.add(stored, false)?;
            }
            "options" if options.is_none() => {
                options = Some(json(incoming, "the options", MAX_OPTIONS_BYTES, &mut field).await?);
            }
            "options" => return Err(Problem::new(Code::InvalidRequest, "`options` stands twice in the form")),
            other => {
                let detail =
                    format!("unknown field `{}`; the form has `model`, `files` and `options`", truncated(other));
                return Err(Problem::new(Code::InvalidRequest, detail));
            }
        }
    }
    Ok(options.unwrap_or_else(|| Value::Object(serde_json::Map::new())))
}

/// A relative path with forward slashes that stays where it is.
pub(super) fn relative(path: &str) -> HandlerResult<String> {
    let bad = |why: &str| Err(Problem::new(Code::InvalidRequest, format!("the file name `{}` {why}", truncated(path))));
    let path = path.replace('\\', "/");
    let path = path.strip_prefix("./").unwrap_or(&path);
    if path.is_empty() || path.len() > MAX_PATH_BYTES {
        return bad("is empty or too long");
    }
    if path.starts_with('/') || path.contains(':') {
        return bad("is not a relative path");
    }
    if path.split('/').any(|part| matches!(part, "" | "." | "..")) {
        return bad("leaves its folder");
    }
    if path.chars().any(char::is_control) {
        return bad("holds control characters");
    }
    Ok(path.to_owned())
}

pub(super) fn media_type(headers: &HeaderMap) -> String {
    let value = headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or("");
    truncated(value.split(';').next().unwrap_or("").trim()).to_ascii_lowercase()
}

pub(super) fn truncated(text: &str) -> String {
    text.chars().take(100).collect()
}

pub(super) fn stalled() -> Problem {
    let problem = Problem::new(Code::InvalidRequest, "the upload stood still, or was too slow, for too long");
    problem.with_status(axum::http::StatusCode::REQUEST_TIMEOUT)
}

pub(super) fn too_large(limit: u64) -> Problem {
    Problem::new(Code::TooLarge, format!("a submission has at most {limit} bytes"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_stay_inside() {
        assert_eq!(relative("./tex\\a.png").unwrap(), "tex/a.png");
        for bad in ["", "/etc/passwd", "../a", "a/../b", "C:\\a", "a//b", "a\nb", "tex/"] {
            assert!(relative(bad).is_err(), "{bad:?}");
        }
    }
}
