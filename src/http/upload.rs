//! How a submission comes in: streamed to the disk, counted while it streams, checked, handed to the queue.

use axum::body::{Body, BodyDataStream, Bytes};
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{HeaderMap, header};
use futures_util::{Stream, StreamExt};
use serde::Serialize;
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};
use tokio::io::AsyncWriteExt;
use tokio::runtime::Handle;
use tokio::time::timeout;
use utoipa::ToSchema;

use super::App;
use super::access::Caller;
use super::preflight;
use super::problem::{HandlerResult, Problem};
use crate::asset::{Demand, estimate};
use crate::error::{Code, Failure};
use crate::jobs::files::{Manifest, UploadedFile, disk};
use crate::jobs::queue::NewJob;
use crate::jobs::record::{Job, new_id};
use crate::jobs::{Taken, build};
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

/// Receives a submission and stores it as a job, unless it is only to be looked at.
pub(super) async fn receive(app: &App, request: Request) -> HandlerResult<Received> {
    let request_id = request.headers().get("x-request-id").and_then(|v| v.to_str().ok()).map(truncated);
    let caller = request.extensions().get::<Caller>().cloned();
    let caller = caller.ok_or_else(|| Failure::internal("nobody has looked at who calls"))?;
    let quotas = caller.quotas();
    let request = request.map(|body| Body::from_stream(DrainOnDrop(Some(body.into_data_stream()))));
    let key = key(request.headers())?;
    let UploadQuery { recipe, validate_only } = query(&request)?;
    admit(app, &caller, request.headers()).await?;
    let request = started(request, app.jobs.limits.upload_idle).await?;
    let Some(_slot) = app.uploads.take(caller.client(), quotas.max_uploads) else {
        if let Some(most) = quotas.max_uploads.filter(|most| app.uploads.taken_by(&caller.client()) >= *most as usize) {
            let detail = format!("this key lets {most} submissions be received at the same time, and so many are");
            return Err(Problem::new(Code::QuotaExceeded, detail));
        }
        return Err(Problem::new(Code::QueueFull, "too many submissions at the same time; try again later"));
    };
    let mut incoming = IncomingUpload::new(app).await?;
    let media_type = media_type(request.headers());
    let mut options = match media_type.as_str() {
        "multipart/form-data" => form(&mut incoming, request).await?,
        "model/gltf-binary" => raw(&mut incoming, request, "model.glb").await?,
        "model/gltf+json" => raw(&mut incoming, request, "model.gltf").await?,
        "application/zip" | "application/x-zip-compressed" => raw(&mut incoming, request, "model.zip").await?,
        "application/octet-stream" => raw(&mut incoming, request, "model").await?,
        other => {
            let detail = format!(
                "`{other}` is not taken; send multipart/form-data, model/gltf-binary, model/gltf+json, application/zip \
                 or application/octet-stream"
            );
            return Err(Problem::new(Code::UnsupportedMediaType, detail));
        }
    };
    if let Some(recipe) = recipe {
        named(&mut options, recipe)?;
    }
    let options = parse::options(&options).map_err(Problem::options)?;
    if let Some(url) = &options.webhook {
        check_webhook(app, &caller, url)?;
    }
    incoming.check().await?;
    let memory = incoming.memory(options.demand()).await?;
    let options = serde_json::to_value(&options).map_err(|e| Failure::internal(e.to_string()))?;
    if validate_only {
        let upload_bytes = incoming.bytes;
        return Ok(Received::Valid(Validation { valid: true, options, memory_bytes: memory, upload_bytes }));
    }
    let key = key.map(|key| (key, incoming.fingerprint(&options)));
    let result_key = incoming.result_key(&options).await;
    let (jobs, id, inputs) = (app.jobs.clone(), incoming.id.clone(), incoming.take());
    let job = NewJob {
        id,
        options,
        inputs,
        memory,
        bytes: incoming.bytes,
        key,
        request: request_id,
        tenant: caller.tenant().to_owned(),
        max_queued: quotas.max_queued,
        max_running: quotas.max_running,
        result_key,
        keep: app.jobs.limits.keep_artifacts,
    };
    app.jobs.telemetry.received.inc_by(incoming.bytes);
    // A task of its own: a client that goes away now does not stop it half-way.
    let stored = tokio::spawn(async move { jobs.submit(&job).await }).await;
    let (job, taken) = stored.map_err(|e| Failure::internal(format!("the submission was lost: {e}")))??;
    Ok(Received::Job(job.into(), taken))
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
fn key(headers: &HeaderMap) -> HandlerResult<Option<String>> {
    let Some(value) = headers.get("idempotency-key") else { return Ok(None) };
    match value.to_str() {
        Ok(key) if (1..=MAX_KEY_BYTES).contains(&key.len()) => Ok(Some(key.to_owned())),
        _ => {
            let detail = format!("an Idempotency-Key has 1 to {MAX_KEY_BYTES} visible ASCII characters");
            Err(Problem::new(Code::InvalidRequest, detail))
        }
    }
}

/// What is refused before anything is read.
async fn admit(app: &App, caller: &Caller, headers: &HeaderMap) -> HandlerResult<()> {
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
    if let (Some(most), Some(tenant)) = (caller.quotas().max_stored, caller.tenant_if_any()) {
        let stored = app.jobs.queue.stored_bytes(Some(tenant)).await?;
        let stored = stored.uploads.saturating_add(stored.artifacts);
        if stored.saturating_add(announced.unwrap_or(0)) > most {
            let detail = format!(
                "the uploads and results of this tenant take {stored} bytes, and this key allows {most}: results expire by themselves, or are \
                 deleted with their jobs"
            );
            return Err(Problem::new(Code::QuotaExceeded, detail));
        }
    }
    let stored = app.jobs.queue.stored_bytes(None).await?;
    if stored.uploads.saturating_add(announced.unwrap_or(0)) > limits.max_waiting {
        let detail =
            format!("the jobs that wait hold {} of {} bytes; try again later", stored.uploads, limits.max_waiting);
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

/// The same request when the first bytes of its body are here: one that only waits holds no slot.
async fn started(request: Request, limit: Duration) -> HandlerResult<Request> {
    let (head, body) = request.into_parts();
    let mut body = body.into_data_stream();
    let first = timeout(limit, body.next()).await.map_err(|_| stalled())?;
    Ok(Request::from_parts(head, Body::from_stream(futures_util::stream::iter(first).chain(body))))
}

/// What the query of a submission says.
#[derive(Default)]
struct UploadQuery {
    recipe: Option<Value>,
    validate_only: bool,
}

fn query(request: &Request) -> HandlerResult<UploadQuery> {
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
                "unknown parameter `{}`: the query takes `recipe` and `validate_only`, everything else stands in the `options` of a form",
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
                incoming.manifest.models.push(stored);
            }
            "files" => {
                let Some(path) = field.file_name().map(str::to_owned) else {
                    return Err(Problem::new(Code::InvalidRequest, "a field `files` has no file name"));
                };
                let path = relative(&path)?;
                incoming.check_path_unused(&path)?;
                let stored = incoming.store(path, field).await?;
                incoming.manifest.files.push(stored);
            }
            "options" if options.is_none() => {
                let mut text = Vec::new();
                loop {
                    let chunk = timeout(incoming.patience(), field.chunk()).await.map_err(|_| stalled())?;
                    let Some(chunk) = chunk.map_err(|e| Problem::new(Code::InvalidRequest, e.body_text()))? else {
                        break;
                    };
                    if text.len() + chunk.len() > MAX_OPTIONS_BYTES {
                        let detail = format!("the options exceed {MAX_OPTIONS_BYTES} bytes");
                        return Err(Problem::new(Code::TooLarge, detail));
                    }
                    text.extend_from_slice(&chunk);
                }
                let parsed = parse::json(&text);
                options = Some(
                    parsed.map_err(|e| Problem::new(Code::InvalidRequest, format!("the options are not JSON: {e}")))?,
                );
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

/// An upload under way. When it is dropped before the queue has taken it, its files go.
struct IncomingUpload<'a> {
    app: &'a App,
    id: String,
    folder: PathBuf,
    manifest: Manifest,
    bytes: u64,
    started: Instant,
    taken: bool,
}

impl<'a> IncomingUpload<'a> {
    async fn new(app: &'a App) -> HandlerResult<Self> {
        let id = new_id()?;
        let folder = app.jobs.files.incoming(&id);
        tokio::fs::create_dir_all(&folder).await.map_err(|e| disk(&folder, &e))?;
        Ok(IncomingUpload {
            app,
            id,
            folder,
            manifest: Manifest::default(),
            bytes: 0,
            started: Instant::now(),
            taken: false,
        })
    }

    /// Streams one file to the disk.
    async fn store<E: std::fmt::Display>(
        &mut self,
        name: String,
        stream: impl Stream<Item = Result<Bytes, E>>,
    ) -> HandlerResult<UploadedFile> {
        let limits = &self.app.jobs.limits;
        let number = self.manifest.models.len() + self.manifest.files.len();
        if number >= limits.max_files {
            return Err(Problem::new(Code::TooLarge, format!("a submission has at most {} files", limits.max_files)));
        }
        let path = self.folder.join(number.to_string());
        let failed = |e: std::io::Error| Problem::from(disk(&path, &e));
        let mut file = tokio::fs::File::create_new(&path).await.map_err(failed)?;
        let mut hash = Sha256::new();
        let mut stream = std::pin::pin!(stream);
        while let Some(chunk) = timeout(self.patience(), stream.next()).await.map_err(|_| stalled())? {
            let chunk = chunk.map_err(|e| Problem::new(Code::InvalidRequest, format!("the upload broke off: {e}")))?;
            self.bytes += chunk.len() as u64;
            if self.bytes > limits.max_upload {
                return Err(too_large(limits.max_upload));
            }
            hash.update(&chunk);
            file.write_all(&chunk).await.map_err(failed)?;
        }
        file.flush().await.map_err(failed)?;
        file.sync_all().await.map_err(failed)?;
        Ok(UploadedFile { path: name, number, sha256: hex::encode(hash.finalize()) })
    }

    /// No two files have one path.
    fn check_path_unused(&self, path: &str) -> HandlerResult<()> {
        let taken = self.manifest.files.iter().any(|f| f.path == path);
        if taken { Err(Problem::new(Code::InvalidRequest, format!("two files are called `{path}`"))) } else { Ok(()) }
    }

    /// The cheap checks of every model.
    async fn check(&mut self) -> HandlerResult<()> {
        if self.manifest.models.is_empty() {
            return Err(Problem::new(Code::InvalidRequest, "the form has no field `model`"));
        }
        let most = self.app.jobs.limits.max_json;
        for model in &mut self.manifest.models {
            let (path, name) = (self.folder.join(model.number.to_string()), model.path.clone());
            let kind = tokio::task::spawn_blocking(move || preflight::check(&path, &name, most)).await;
            let kind = kind.map_err(|e| Failure::internal(format!("the check was lost: {e}")))??;
            // A body without a name gets the one that belongs to its contents.
            if !model.path.contains('.') {
                model.path = format!("{}.{kind}", model.path);
            }
        }
        Ok(())
    }

    /// Bytes that the job is expected to need, by the headers of its files and what its recipe does.
    async fn memory(&self, demand: Demand) -> HandlerResult<u64> {
        let (folder, manifest, limits) =
            (self.folder.clone(), self.manifest.clone(), crate::asset::Limits::from(&self.app.jobs.limits));
        let threads = self.app.jobs.slots.threads();
        let estimated = tokio::task::spawn_blocking(move || {
            let at = |stored: &UploadedFile| folder.join(stored.number.to_string());
            let files: Vec<(&str, PathBuf)> = manifest.files.iter().map(|f| (f.path.as_str(), at(f))).collect();
            let files: Vec<(&str, &Path)> = files.iter().map(|(name, path)| (*name, path.as_path())).collect();
            let mut models = manifest.models.iter();
            models.try_fold(0u64, |sum, model| -> Result<u64, Failure> {
                Ok(sum.saturating_add(estimate((&model.path, &at(model)), &files, &limits, threads, demand)?.bytes))
            })
        });
        let bytes = estimated.await.map_err(|e| Failure::internal(format!("the estimate was lost: {e}")))??;
        let most = self.app.jobs.slots.memory();
        if bytes > most {
            let detail =
                format!("the job would need about {bytes} bytes of memory; this service has {most} for all jobs");
            return Err(Problem::new(Code::TooLarge, detail));
        }
        Ok(bytes)
    }

    /// How long the next bytes may take: so long as an upload may stand still, and no longer than the least rate allows.
    fn patience(&self) -> Duration {
        let limits = &self.app.jobs.limits;
        let earned = Duration::from_secs_f64(self.bytes as f64 / limits.min_upload_rate.max(1) as f64);
        let left = RATE_GRACE.saturating_add(earned).saturating_sub(self.started.elapsed());
        limits.upload_idle.min(left)
    }

    /// Fingerprint of this request: its options, and its files by name and contents.
    fn fingerprint(&self, options: &Value) -> String {
        let mut hash = Sha256::new();
        hash.update(options.to_string());
        for (kind, files) in [("model", &self.manifest.models), ("file", &self.manifest.files)] {
            for file in files {
                hash.update(format!("\n{kind} {} {}", file.sha256, file.path));
            }
        }
        hex::encode(hash.finalize())
    }

    /// What the result follows from, where it may be reused: equal options, files, limits and programs give equal bytes, unless there is a
    /// limit on time. What is only returned or told is no part of it.
    async fn result_key(&self, options: &Value) -> Option<String> {
        if options.get("reuse") != Some(&Value::Bool(true)) || options.get("time_limit_s").is_some_and(|s| !s.is_null())
        {
            return None;
        }
        let build = build().await?;
        let mut options = options.as_object()?.clone();
        for told in ["reuse", "webhook", "metadata"] {
            options.remove(told);
        }
        let limits = crate::asset::Limits::from(&self.app.jobs.limits);
        let all = format!("{build}\n{limits:?}\n{}", self.fingerprint(&Value::Object(options)));
        Some(hex::encode(Sha256::digest(all)))
    }

    fn take(&mut self) -> Manifest {
        self.taken = true;
        std::mem::take(&mut self.manifest)
    }
}

impl Drop for IncomingUpload<'_> {
    fn drop(&mut self) {
        if !self.taken {
            self.app.jobs.files.remove_incoming(&self.id);
        }
    }
}

/// A relative path with forward slashes that stays where it is.
fn relative(path: &str) -> HandlerResult<String> {
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

fn truncated(text: &str) -> String {
    text.chars().take(100).collect()
}

pub(super) fn stalled() -> Problem {
    let problem = Problem::new(Code::InvalidRequest, "the upload stood still, or was too slow, for too long");
    problem.with_status(axum::http::StatusCode::REQUEST_TIMEOUT)
}

fn too_large(limit: u64) -> Problem {
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
