//! Bodies that are small JSON documents.

use axum::body::to_bytes;
use axum::extract::Request;
use serde::de::DeserializeOwned;
use tokio::time::timeout;

use super::App;
use super::problem::{HandlerResult, Problem};
use super::upload::{media_type, stalled};
use crate::error::Code;
use crate::params::typed;
use crate::refine::parse;

/// Bytes of such a body.
const MAX_BYTES: usize = 64 << 10;

/// The value in the body of a request.
pub(super) async fn json<T: DeserializeOwned>(app: &App, request: Request) -> HandlerResult<T> {
    let given = media_type(request.headers());
    if given != "application/json" {
        let detail = format!("`{given}` is not taken; send application/json");
        return Err(Problem::new(Code::UnsupportedMediaType, detail));
    }
    let read = timeout(app.jobs.limits.upload_idle, to_bytes(request.into_body(), MAX_BYTES));
    let bytes = read.await.map_err(|_| stalled())?.map_err(|e| {
        Problem::new(Code::TooLarge, format!("the body broke off, or has more than {MAX_BYTES} bytes: {e}"))
    })?;
    let value =
        parse::json(&bytes).map_err(|e| Problem::new(Code::InvalidRequest, format!("the body is not JSON: {e}")))?;
    typed(&value, "").map_err(|problem| Problem::options(vec![problem]))
}
