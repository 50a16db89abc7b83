//! The examples of the OpenAPI document: files of `api/examples`, and what is made of them.

use serde_json::{Value, json};

/// A file of `api/examples` as JSON; a test holds each against its schema.
macro_rules! example {
    ($file:literal) => {
        serde_json::from_str::<Value>(include_str!(concat!("../../api/examples/", $file))).unwrap_or_default()
    };
}

/// A submission with the options of `pack-gate.json`.
pub(super) fn pack() -> Value {
    submission(example!("pack-gate.json"))
}

/// A submission with the options of `scan.json`.
pub(super) fn scan() -> Value {
    submission(example!("scan.json"))
}

/// A submission with the options of `box_cutter.json`.
pub(super) fn box_cutter() -> Value {
    submission(example!("box_cutter.json"))
}

fn submission(options: Value) -> Value {
    json!({"model": ["(the bytes of model.glb)"], "options": options})
}

/// A job that has succeeded.
pub(super) fn job() -> Value {
    example!("answers/job.json")
}

/// The same job before it runs.
pub(super) fn queued() -> Value {
    example!("answers/queued.json")
}

/// The same job when it was stopped.
pub(super) fn canceled() -> Value {
    let mut job = queued();
    job["state"] = json!("canceled");
    job["queue_position"] = Value::Null;
    job["finished_at"] = job["created_at"].clone();
    job
}

/// A page with that job.
pub(super) fn page() -> Value {
    json!({"jobs": [job()], "next": 17})
}

/// The events of that job, from its snapshot to its end.
pub(super) fn events() -> Value {
    let (queued, done) = (queued(), job());
    let event = |id: &str, name: &str, data: &Value| format!("event: {name}\nid: {id}\ndata: {data}\n\n");
    let text = [
        event("0.0.0", "snapshot", &queued),
        event("1.4.0", "progress", &done["progress"]),
        event("1.4.0", "state", &done),
    ];
    Value::String(text.concat())
}

/// That job's report.
pub(super) fn report() -> Value {
    example!("answers/report.json")
}

/// What is listed of recipes, shortened.
pub(super) fn recipes() -> Value {
    example!("answers/recipes.json")
}

/// The limits of a service with the defaults.
pub(super) fn limits() -> Value {
    example!("answers/limits.json")
}

/// A key to make.
pub(super) fn new_key() -> Value {
    example!("requests/new-key.json")
}

/// That key when it is made.
pub(super) fn made_key() -> Value {
    example!("answers/made-key.json")
}

/// All keys: that one.
pub(super) fn keys() -> Value {
    json!({"keys": [made_key()["key"]]})
}

/// A receiver to make.
pub(super) fn new_webhook() -> Value {
    example!("requests/new-webhook.json")
}

/// That receiver when it is made.
pub(super) fn made_webhook() -> Value {
    example!("answers/made-webhook.json")
}

/// All receivers: that one.
pub(super) fn webhooks() -> Value {
    json!({"webhooks": [made_webhook()["webhook"]], "job_secret": null})
}

/// A secret that takes the place of another.
pub(super) fn new_secret() -> Value {
    json!({"secret": made_webhook()["secret"], "previous_until": "2026-11-28T08:30:00Z"})
}

/// What that receiver was told.
pub(super) fn deliveries() -> Value {
    example!("answers/deliveries.json")
}

/// An upload on its way.
pub(super) fn upload() -> Value {
    example!("answers/upload.json")
}

/// A submission whose files were uploaded before.
pub(super) fn by_reference() -> Value {
    json!({"model": upload()["reference"], "options": example!("pack-gate.json")})
}

/// A batch of uploads.
pub(super) fn new_batch() -> Value {
    example!("requests/new-batch.json")
}

/// A batch whose files stand beside it.
pub(super) fn batch_form() -> Value {
    let items = json!([{"model": "chair.glb"}, {"model": "table.glb", "options": {"pack": {"gutter": 8}}}]);
    let files = json!(["(the bytes of chair.glb)", "(the bytes of table.glb)"]);
    json!({"batch": {"options": {"recipe": "scan"}, "items": items}, "files": files})
}

/// That batch on its way.
pub(super) fn batch() -> Value {
    example!("answers/batch.json")
}

/// Why a batch is refused.
pub(super) fn invalid_batch() -> Value {
    let why = "no part `files` of the form has the file name `tabel.glb`, and it is not `upload:` and an id";
    let detail = format!("1 of 2 items cannot be taken, and nothing was stored; the first: {why}");
    json!(super::problem::Problem {
        errors: vec![crate::params::Problem::new("/items/1/model", why)],
        ..super::problem::Problem::new(crate::error::Code::InvalidBatch, detail)
    })
}

/// What was told of a job, to the URL that it named.
pub(super) fn job_deliveries() -> Value {
    let mut page = deliveries();
    page["deliveries"][0]["webhook"] = Value::Null;
    page
}

/// A service that is well.
pub(super) fn health() -> Value {
    json!({"status": "ok", "version": env!("CARGO_PKG_VERSION")})
}

/// Why options are refused.
pub(super) fn invalid_options() -> Value {
    json!(super::problem::Problem::options(vec![crate::params::Problem::new(
        "/pack/grid",
        "must be \"auto\" or a whole number in 1..=64"
    )]))
}
