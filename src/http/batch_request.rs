//! What a batch asks for: each item is judged for itself before anything is stored.

use std::collections::{BTreeMap, BTreeSet};

use axum::extract::{FromRequest, Multipart, Request};
use serde::Deserialize;
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};
use tokio::time::timeout;
use utoipa::ToSchema;

use super::App;
use super::access::Caller;
use super::incoming::IncomingUpload;
use super::problem::{HandlerResult, Problem};
use super::references::{Source, Sources, reference};
use super::upload::{self, NamedFiles, OneOrMany, Validation, truncated};
use crate::error::{Code, Failure};
use crate::jobs::batches::NewBatch;
use crate::jobs::files::UploadedFile;
use crate::jobs::record::new_id;
use crate::params::{Problem as OptionProblem, typed};
use crate::refine::options::OptionsSchema;
use crate::refine::parse::MAX_METADATA_BYTES;

/// Items of a batch.
pub(super) const MAX_ITEMS: usize = 1000;
/// Bytes of the description of a batch.
const MAX_BYTES: usize = 8 << 20;
/// Problems that are told of.
const MAX_PROBLEMS: usize = 100;

/// Models to refine, with one status.
#[derive(ToSchema)]
#[serde(deny_unknown_fields)]
#[expect(dead_code, reason = "describes the body in the OpenAPI document; it is read by hand, for errors that help")]
pub(super) struct BatchRequest {
    /// What holds for each item; an item's own options are merged into them (RFC 7396).
    #[schema(value_type = OptionsSchema, required = false)]
    options: Option<Map<String, Value>>,
    /// One job each.
    #[schema(min_items = 1, max_items = 1000)]
    items: Vec<BatchItem>,
    /// Comes back with the batch.
    #[schema(required = false)]
    metadata: Option<Map<String, Value>>,
}

/// What becomes one job. A file is named by the file name that its part of the form has, or by `upload:` and the id of an upload. A file may be named
/// by several items.
#[derive(ToSchema)]
#[serde(deny_unknown_fields)]
#[expect(dead_code, reason = "describes the body in the OpenAPI document; it is read by hand, for errors that help")]
pub(super) struct BatchItem {
    /// The model. Several share one atlas.
    model: OneOrMany,
    /// Files that the model names: by their paths, or as a list.
    #[schema(required = false)]
    files: Option<NamedFiles>,
    /// Merged into those of the batch (RFC 7396).
    #[schema(value_type = Map<String, Value>, required = false)]
    options: Option<Map<String, Value>>,
    /// The client's name for this item: where a job was made under it, that is the item's job.
    #[schema(min_length = 1, max_length = 255, required = false)]
    idempotency_key: Option<String>,
    /// The `metadata` of its options, said here.
    #[schema(required = false)]
    metadata: Option<Map<String, Value>>,
}

/// A batch with its files.
#[derive(ToSchema)]
#[serde(deny_unknown_fields)]
#[expect(dead_code, reason = "describes the form in the OpenAPI document; its fields are read as a stream")]
pub(super) struct BatchForm {
    /// The batch, as JSON.
    batch: BatchRequest,
    /// Files that its items name by their file names.
    #[schema(value_type = Vec<String>, format = Binary, required = false)]
    files: Vec<Vec<u8>>,
}

/// The fields of [`BatchRequest`].
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Fields {
    #[serde(default)]
    options: Map<String, Value>,
    items: Vec<Value>,
    #[serde(default)]
    metadata: Map<String, Value>,
}

/// The fields of [`BatchItem`].
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ItemFields {
    model: Value,
    #[serde(default)]
    files: Value,
    #[serde(default)]
    options: Map<String, Value>,
    #[serde(default)]
    idempotency_key: Option<String>,
    #[serde(default)]
    metadata: Option<Map<String, Value>>,
}

/// What came of a batch that was received.
pub(super) enum ReceivedBatch {
    /// It can be stored.
    New(NewBatch),
    /// It could be stored: what each item would be.
    Valid(Vec<Validation>),
}

/// Receives a batch. All that is not taken over by [`ReceivedBatch::New`] is removed again.
pub(super) async fn receive(app: &App, request: Request) -> HandlerResult<ReceivedBatch> {
    let (told, caller) = (upload::Told::by(&request), upload::caller(&request)?);
    let request = upload::draining(request);
    let key = upload::key(request.headers())?;
    let query = upload::query(&request)?;
    if query.recipe.is_some() {
        let detail =
            "the query of a batch takes `validate_only`; the recipe stands in its `options`, or in those of its items";
        return Err(Problem::new(Code::InvalidRequest, detail));
    }
    upload::admit(app, &caller, request.headers()).await?;
    let request = upload::started(request, app.jobs.limits.upload_idle).await?;
    let _slot = upload::slot(app, &caller)?;
    let mut pool = IncomingUpload::pool(app, &caller).await?;
    let body = match upload::media_type(request.headers()).as_str() {
        "application/json" => {
            upload::json(&pool, "the batch", MAX_BYTES, request.into_body().into_data_stream()).await?
        }
        "multipart/form-data" => form(&mut pool, request).await?,
        other => {
            let detail = format!("`{other}` is not taken; send multipart/form-data or application/json");
            return Err(Problem::new(Code::UnsupportedMediaType, detail));
        }
    };
    app.jobs.telemetry.received.inc_by(pool.sent);
    let fields: Fields = typed(&body, "").map_err(|problem| Problem::options(vec![problem]))?;
    let mut items = Items::new(app, &caller, pool, fields.options, fields.items.len())?;
    check_metadata(&fields.metadata, "/metadata").map_err(|problem| Problem::options(vec![problem]))?;
    for (number, item) in fields.items.iter().enumerate() {
        items.judge(number, item).await?;
    }
    let (prepared, count) = (items.finish()?, fields.items.len());
    let bytes = prepared.iter().fold(0u64, |sum, item| sum.saturating_add(item.incoming.bytes));
    if bytes > app.jobs.limits.max_waiting {
        let most = app.jobs.limits.max_waiting;
        let detail =
            format!("the {count} items have {bytes} bytes together, and this service lets {most} wait: send fewer");
        return Err(Problem::new(Code::TooLarge, detail));
    }
    upload::check_room(app, &caller, bytes).await?;
    if query.validate_only {
        let valid = |item: Prepared<'_>| Validation::new(item.options, item.memory, item.incoming.bytes);
        return Ok(ReceivedBatch::Valid(prepared.into_iter().map(valid).collect()));
    }
    let mut fingerprint = Sha256::new();
    let mut jobs = Vec::with_capacity(count);
    let mut uploads = Vec::with_capacity(count);
    for Prepared { incoming, options, memory, key } in prepared {
        fingerprint.update(format!("{}\n{}\n", incoming.fingerprint(&options), key.as_deref().unwrap_or_default()));
        let of_item = (memory, key, told.clone());
        jobs.push(upload::new_job(app, &caller, &incoming, options, of_item).await);
        uploads.push(incoming);
    }
    let metadata = Value::Object(fields.metadata);
    fingerprint.update(metadata.to_string());
    let key = key.map(|key| (key, hex::encode(fingerprint.finalize())));
    let id = new_id()?;
    uploads.iter_mut().for_each(IncomingUpload::leave);
    Ok(ReceivedBatch::New(NewBatch { id, tenant: caller.tenant().to_owned(), metadata, key, jobs }))
}

/// A form: `batch` once, any number of `files`.
async fn form(pool: &mut IncomingUpload<'_>, request: Request) -> HandlerResult<Value> {
    let malformed = |text: String| Problem::new(Code::InvalidRequest, text);
    let mut form = Multipart::from_request(request, &()).await.map_err(|e| malformed(e.body_text()))?;
    let mut batch = None;
    loop {
        let field = timeout(pool.patience(), form.next_field()).await.map_err(|_| upload::stalled())?;
        let Some(mut field) = field.map_err(|e| malformed(e.body_text()))? else { break };
        match field.name().unwrap_or_default() {
            "files" => {
                let Some(path) = field.file_name().map(str::to_owned) else {
                    return Err(malformed(
                        "a field `files` has no file name, by which an item could name it".to_owned(),
                    ));
                };
                let path = upload::relative(&path)?;
                pool.check_path_unused(&path)?;
                let stored = pool.store(path, field).await?;
                pool.add(stored, false)?;
            }
            "batch" if batch.is_none() => batch = Some(upload::json(pool, "the batch", MAX_BYTES, &mut field).await?),
            "batch" => return Err(malformed("`batch` stands twice in the form".to_owned())),
            other => {
                return Err(malformed(format!(
                    "unknown field `{}`; the form has `batch` and `files`",
                    truncated(other)
                )));
            }
        }
    }
    batch.ok_or_else(|| malformed("the form has no field `batch`".to_owned()))
}

/// An item that can become a job.
struct Prepared<'a> {
    incoming: IncomingUpload<'a>,
    options: Value,
    memory: u64,
    key: Option<String>,
}

/// The items of a batch, while they are judged.
struct Items<'a> {
    app: &'a App,
    caller: &'a Caller,
    /// The files of the form, and the uploads that items have named.
    pool: IncomingUpload<'a>,
    /// Which of the pool's files a name stands for.
    names: BTreeMap<String, UploadedFile>,
    used: BTreeSet<String>,
    options: Value,
    prepared: Vec<Prepared<'a>>,
    problems: Vec<OptionProblem>,
    refused: usize,
}

impl<'a> Items<'a> {
    fn new(
        app: &'a App,
        caller: &'a Caller,
        pool: IncomingUpload<'a>,
        options: Map<String, Value>,
        count: usize,
    ) -> HandlerResult<Self> {
        let wrong = |pointer: &str, why: String| Problem::options(vec![OptionProblem::new(pointer, why)]);
        if !(1..=MAX_ITEMS).contains(&count) {
            return Err(wrong("/items", format!("a batch has 1 to {MAX_ITEMS} items, and this one has {count}")));
        }
        let most = app.jobs.limits.max_queued;
        if count as u64 > u64::from(most) {
            let detail = format!("the batch has {count} items, and this service lets {most} jobs wait: send fewer");
            return Err(Problem::new(Code::TooLarge, detail));
        }
        let options = Value::Object(options);
        // What is wrong for all of them is told once.
        upload::judged(app, caller, &options).map_err(|problem| within(problem, "/options"))?;
        let names = pool.manifest.files.iter().map(|file| (file.path.clone(), file.clone())).collect();
        let (used, prepared, problems) = (BTreeSet::new(), Vec::new(), Vec::new());
        Ok(Items { app, caller, pool, names, used, options, prepared, problems, refused: 0 })
    }

    /// Judges an item. What is wrong with it is kept, so that all are told at once.
    ///
    /// # Errors
    /// What is no fault of the item.
    async fn judge(&mut self, number: usize, item: &Value) -> HandlerResult<()> {
        let pointer = format!("/items/{number}");
        match self.prepare(&pointer, item).await {
            Ok(prepared) => self.prepared.push(prepared),
            Err(problem) => {
                let of_item = !matches!(
                    problem.code,
                    Code::Internal
                        | Code::Unavailable
                        | Code::InsufficientStorage
                        | Code::QueueFull
                        | Code::QuotaExceeded
                );
                if !of_item {
                    return Err(problem);
                }
                self.refused += 1;
                let room = MAX_PROBLEMS.saturating_sub(self.problems.len());
                let told = if problem.errors.is_empty() {
                    vec![OptionProblem::new(&pointer, problem.detail)]
                } else {
                    problem.errors
                };
                self.problems.extend(told.into_iter().take(room));
            }
        }
        Ok(())
    }

    async fn prepare(&mut self, pointer: &str, item: &Value) -> HandlerResult<Prepared<'a>> {
        let one = |problem: OptionProblem| Problem::options(vec![problem]);
        let item: ItemFields = typed(item, pointer).map_err(one)?;
        let sources = Sources::read(&item.model, &item.files, pointer).map_err(one)?;
        let key = item.idempotency_key;
        if let Some(key) = key.as_ref().filter(|key| !upload::is_key(key)) {
            let why = format!("`{}` is no key: one has 1 to 255 visible ASCII characters", truncated(key));
            return Err(one(OptionProblem::new(format!("{pointer}/idempotency_key"), why)));
        }
        let mut options = self.options.clone();
        merge(&mut options, &Value::Object(item.options));
        if let Some(metadata) = item.metadata {
            check_metadata(&metadata, &format!("{pointer}/metadata")).map_err(one)?;
            merge(&mut options, &Value::Object(Map::from_iter([("metadata".to_owned(), Value::Object(metadata))])));
        }
        let options = upload::judged(self.app, self.caller, &options)
            .map_err(|problem| within(problem, &format!("{pointer}/options")))?;
        let mut incoming = IncomingUpload::new(self.app, self.caller).await?;
        for (source, is_model) in sources.iter() {
            let file = self.find(source).await?;
            let at = |problem: Problem| pointed(problem, &source.pointer);
            let path = source.path.as_deref().map(upload::relative).transpose().map_err(at)?;
            let path = path.unwrap_or_else(|| file.path.clone());
            let linked = incoming.link(&self.pool, &file, path).await.map_err(at)?;
            incoming.add(linked, is_model).map_err(at)?;
        }
        let model = |problem: Problem| pointed(problem, &format!("{pointer}/model"));
        incoming.check().await.map_err(model)?;
        let memory = incoming.memory(options.demand()).await.map_err(model)?;
        let options = serde_json::to_value(&options).map_err(|e| Failure::internal(e.to_string()))?;
        Ok(Prepared { incoming, options, memory, key })
    }

    /// The file that an item names.
    async fn find(&mut self, source: &Source) -> HandlerResult<UploadedFile> {
        let found = match (self.names.get(&source.from), reference(&source.from)) {
            (Some(file), _) => file.clone(),
            (None, Some(id)) => {
                let file = self.pool.take_upload(id, None, &source.pointer).await?;
                self.pool.add_unnamed(file.clone());
                upload::check_room(self.app, self.caller, self.pool.bytes).await?;
                self.names.insert(source.from.clone(), file.clone());
                file
            }
            (None, None) => {
                let why = format!(
                    "no part `files` of the form has the file name `{}`, and it is not `upload:` and an id",
                    truncated(&source.from)
                );
                return Err(Problem::options(vec![OptionProblem::new(&source.pointer, why)]));
            }
        };
        self.used.insert(source.from.clone());
        Ok(found)
    }

    /// All items, if each can become a job.
    fn finish(mut self) -> HandlerResult<Vec<Prepared<'a>>> {
        if self.refused == 0 {
            let idle = self.names.keys().filter(|name| !self.used.contains(*name)).take(MAX_PROBLEMS);
            let why = |name: &String| {
                OptionProblem::new("/items", format!("no item names the file `{}` that was sent", truncated(name)))
            };
            self.problems = idle.map(why).collect();
        }
        let Some(first) = self.problems.first() else { return Ok(self.prepared) };
        let all = self.refused + self.prepared.len();
        let detail = match self.refused {
            0 => format!("{}; nothing was stored", first.message),
            refused => {
                format!(
                    "{refused} of {all} items cannot be taken, and nothing was stored; the first: {}",
                    first.message
                )
            }
        };
        Err(Problem { errors: self.problems, ..Problem::new(Code::InvalidBatch, detail) })
    }
}

/// The same problem, whose pointers go on from another.
fn within(mut problem: Problem, pointer: &str) -> Problem {
    for error in &mut problem.errors {
        error.pointer.insert_str(0, pointer);
    }
    problem
}

/// The same problem, at that pointer: one into the file itself would be taken for one into the request.
fn pointed(problem: Problem, pointer: &str) -> Problem {
    let errors = vec![OptionProblem::new(pointer, problem.detail.clone())];
    Problem { errors, ..problem }
}

fn check_metadata(metadata: &Map<String, Value>, pointer: &str) -> Result<(), OptionProblem> {
    let bytes = serde_json::to_vec(metadata).map_or(usize::MAX, |text| text.len());
    if bytes > MAX_METADATA_BYTES {
        let why = format!("`metadata` has {bytes} bytes as JSON; the limit is {MAX_METADATA_BYTES}");
        return Err(OptionProblem::new(pointer, why));
    }
    Ok(())
}

/// Merges a patch into a value (RFC 7396). Both have passed the limit of nesting of the JSON reader.
fn merge(value: &mut Value, patch: &Value) {
    let Value::Object(patch) = patch else {
        value.clone_from(patch);
        return;
    };
    if !value.is_object() {
        *value = Value::Object(Map::new());
    }
    let Value::Object(map) = value else { return };
    for (key, patch) in patch {
        if patch.is_null() {
            map.remove(key);
        } else {
            merge(map.entry(key.clone()).or_insert(Value::Null), patch);
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn options_of_an_item_are_merged_into_those_of_all() {
        let mut value = json!({"recipe": "scan", "pack": {"gutter": 4, "grid": 2}, "strict": ["a"]});
        merge(&mut value, &json!({"pack": {"gutter": 8, "grid": null}, "strict": ["b"], "atlas": {"merge": true}}));
        let merged = json!({"recipe": "scan", "pack": {"gutter": 8}, "strict": ["b"], "atlas": {"merge": true}});
        assert_eq!(value, merged);
    }
}
