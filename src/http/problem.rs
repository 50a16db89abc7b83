//! Errors as users of the service see them: problem details (RFC 9457) with `code` and `errors`.

use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use crate::config::Scope;
use crate::error::{Code, Failure};
use crate::refine::parse::Problem as OptionProblem;

/// Seconds after which a client that was turned away may come back.
const RETRY_AFTER: HeaderValue = HeaderValue::from_static("5");

/// The one table from code to status and title.
pub fn status(code: Code) -> (StatusCode, &'static str) {
    match code {
        Code::InvalidModel => (StatusCode::BAD_REQUEST, "The model is broken"),
        Code::UnsupportedExtension => (StatusCode::UNPROCESSABLE_ENTITY, "The model requires an unsupported extension"),
        Code::MissingFile => (StatusCode::UNPROCESSABLE_ENTITY, "A file that the model names is missing"),
        Code::InvalidImage => (StatusCode::UNPROCESSABLE_ENTITY, "An image is broken"),
        Code::TooLarge => (StatusCode::PAYLOAD_TOO_LARGE, "A limit is exceeded"),
        Code::InvalidOptions => (StatusCode::UNPROCESSABLE_ENTITY, "The options are not valid"),
        Code::RequirementNotMet => (StatusCode::UNPROCESSABLE_ENTITY, "A requirement is not met"),
        Code::StrictWarning => (StatusCode::UNPROCESSABLE_ENTITY, "There is a warning that `strict` names"),
        Code::Canceled => (StatusCode::CONFLICT, "The job was cancelled"),
        Code::InvalidRequest => (StatusCode::BAD_REQUEST, "The request is malformed"),
        Code::UnsupportedMediaType => (StatusCode::UNSUPPORTED_MEDIA_TYPE, "The media type is not supported"),
        Code::Unauthorized => (StatusCode::UNAUTHORIZED, "A valid API key is needed"),
        Code::Forbidden => (StatusCode::FORBIDDEN, "Not allowed"),
        Code::NotFound => (StatusCode::NOT_FOUND, "Not found"),
        Code::Gone => (StatusCode::GONE, "Removed"),
        Code::Conflict => (StatusCode::CONFLICT, "The present state does not allow this"),
        Code::IdempotencyMismatch => (StatusCode::UNPROCESSABLE_ENTITY, "The key belongs to another request"),
        Code::InvalidBatch => (StatusCode::UNPROCESSABLE_ENTITY, "Items of the batch cannot be taken"),
        // The status that tus 1.0 has for it.
        Code::ChecksumMismatch => (checksum_mismatch(), "The checksum does not match"),
        Code::QueueFull => (StatusCode::SERVICE_UNAVAILABLE, "The service is busy"),
        Code::QuotaExceeded => (StatusCode::TOO_MANY_REQUESTS, "A quota is used up"),
        Code::RateLimited => (StatusCode::TOO_MANY_REQUESTS, "Too many requests"),
        Code::InsufficientStorage => (StatusCode::INSUFFICIENT_STORAGE, "The service has no space left"),
        Code::Unavailable => (StatusCode::SERVICE_UNAVAILABLE, "The service is in trouble"),
        Code::Internal => (StatusCode::INTERNAL_SERVER_ERROR, "Intarsia is at fault"),
    }
}

fn checksum_mismatch() -> StatusCode {
    StatusCode::from_u16(460).unwrap_or(StatusCode::BAD_REQUEST)
}

/// Body of an error, `application/problem+json` (RFC 9457).
#[derive(Debug, Clone, Serialize, ToSchema)]
pub struct Problem {
    /// Names the kind of problem: `urn:intarsia:problem:` and the code.
    #[serde(rename = "type")]
    pub kind: String,
    /// The kind of problem for people.
    pub title: &'static str,
    /// HTTP status.
    pub status: u16,
    /// This problem for people.
    pub detail: String,
    /// Stable code.
    pub code: Code,
    /// Every single thing that is wrong, with its JSON pointer into the options or the model.
    pub errors: Vec<OptionProblem>,
    /// Seconds after which it may be tried again, where that is known.
    #[serde(skip)]
    pub retry_after: Option<u64>,
    /// How the client can prove who it is (`WWW-Authenticate`, RFC 6750), where that is why.
    #[serde(skip)]
    pub challenge: Option<Challenge>,
}

/// What a client lacks that may not do something: a `WWW-Authenticate` header (RFC 6750, section 3).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Challenge {
    /// It sent no key.
    Missing,
    /// It sent one that is not valid.
    Invalid,
    /// Its key has not this scope.
    Scope(Scope),
}

impl Challenge {
    fn as_str(self) -> &'static str {
        match self {
            Challenge::Missing => "Bearer realm=\"intarsia\"",
            Challenge::Invalid => "Bearer realm=\"intarsia\", error=\"invalid_token\"",
            Challenge::Scope(Scope::Submit) => {
                "Bearer realm=\"intarsia\", error=\"insufficient_scope\", scope=\"submit\""
            }
            Challenge::Scope(Scope::Read) => "Bearer realm=\"intarsia\", error=\"insufficient_scope\", scope=\"read\"",
            Challenge::Scope(Scope::Admin) => {
                "Bearer realm=\"intarsia\", error=\"insufficient_scope\", scope=\"admin\""
            }
        }
    }
}

impl Problem {
    /// A problem of that code.
    pub fn new(code: Code, detail: impl Into<String>) -> Self {
        let (status, title) = status(code);
        let kind = format!("urn:intarsia:problem:{}", code.as_str());
        Problem {
            kind,
            title,
            status: status.as_u16(),
            detail: detail.into(),
            code,
            errors: Vec::new(),
            retry_after: None,
            challenge: None,
        }
    }

    /// The same problem with another status than its code's.
    pub fn with_status(mut self, status: StatusCode) -> Self {
        self.status = status.as_u16();
        self
    }

    /// What is wrong with the options of a request.
    pub fn options(problems: Vec<OptionProblem>) -> Self {
        let mut problem = Self::from(crate::refine::parse::failure(&problems));
        problem.errors = problems;
        problem
    }
}

impl From<Failure> for Problem {
    fn from(failure: Failure) -> Self {
        let mut problem = Problem::new(failure.code, failure.message.clone());
        if let Some(pointer) = failure.pointer {
            problem.errors.push(OptionProblem::new(pointer, failure.message));
        }
        problem
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let body = serde_json::to_vec(&self).unwrap_or_default();
        let mut response = (status, body).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
        if let Some(challenge) = self.challenge {
            headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static(challenge.as_str()));
        }
        let later = [StatusCode::SERVICE_UNAVAILABLE, StatusCode::INSUFFICIENT_STORAGE, StatusCode::TOO_MANY_REQUESTS];
        if later.contains(&status) {
            headers.insert(header::RETRY_AFTER, self.retry_after.map_or(RETRY_AFTER, HeaderValue::from));
        }
        response
    }
}

/// What handlers return.
pub type HandlerResult<T = Response> = std::result::Result<T, Problem>;
