//! The one failure type, and the closed lists of codes: those of failures, and those of warnings.

mod warnings;

pub use warnings::{WARNINGS, Warning};

use serde::{Deserialize, Serialize};

/// Whose fault a failure is, and what it is about. The names are part of the contract.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Code {
    /// The container, JSON, accessors, indices or numbers of the model are broken.
    InvalidModel,
    /// `extensionsRequired` names something that is not supported.
    UnsupportedExtension,
    /// A file that the model names was not uploaded.
    MissingFile,
    /// An image cannot be decoded.
    InvalidImage,
    /// A stated limit is exceeded.
    TooLarge,
    /// An option is unknown, of the wrong type or out of its range.
    InvalidOptions,
    /// A `require` entry is not met.
    RequirementNotMet,
    /// There was a warning that `strict` names.
    StrictWarning,
    /// The job was cancelled.
    Canceled,
    /// The request itself is malformed (HTTP).
    InvalidRequest,
    /// The media type of a request is not supported (HTTP).
    UnsupportedMediaType,
    /// The request has no valid API key (HTTP).
    Unauthorized,
    /// Whoever asks may not (HTTP).
    Forbidden,
    /// No such job, upload, artifact or route (HTTP).
    NotFound,
    /// The artifact or upload existed and has been removed (HTTP).
    Gone,
    /// The job or upload is in a state that does not allow the request (HTTP).
    Conflict,
    /// The `Idempotency-Key` was used for another request (HTTP).
    IdempotencyMismatch,
    /// Items of a batch cannot be taken (HTTP).
    InvalidBatch,
    /// Bytes do not have the checksum that was sent with them, or declared (HTTP).
    ChecksumMismatch,
    /// The queue is full (HTTP).
    QueueFull,
    /// A quota of the API key is used up (HTTP).
    QuotaExceeded,
    /// Too many requests in a minute (HTTP).
    RateLimited,
    /// The service has no space left to store anything (HTTP).
    InsufficientStorage,
    /// The disk or the database of the service fails for now (HTTP).
    Unavailable,
    /// Intarsia is at fault.
    Internal,
}

impl Code {
    /// The code as users see it.
    pub fn as_str(self) -> &'static str {
        match self {
            Code::InvalidModel => "invalid_model",
            Code::UnsupportedExtension => "unsupported_extension",
            Code::MissingFile => "missing_file",
            Code::InvalidImage => "invalid_image",
            Code::TooLarge => "too_large",
            Code::InvalidOptions => "invalid_options",
            Code::RequirementNotMet => "requirement_not_met",
            Code::StrictWarning => "strict_warning",
            Code::Canceled => "canceled",
            Code::InvalidRequest => "invalid_request",
            Code::UnsupportedMediaType => "unsupported_media_type",
            Code::Unauthorized => "unauthorized",
            Code::Forbidden => "forbidden",
            Code::NotFound => "not_found",
            Code::Gone => "gone",
            Code::Conflict => "conflict",
            Code::IdempotencyMismatch => "idempotency_mismatch",
            Code::InvalidBatch => "invalid_batch",
            Code::ChecksumMismatch => "checksum_mismatch",
            Code::QueueFull => "queue_full",
            Code::QuotaExceeded => "quota_exceeded",
            Code::RateLimited => "rate_limited",
            Code::InsufficientStorage => "insufficient_storage",
            Code::Unavailable => "unavailable",
            Code::Internal => "internal",
        }
    }
}

/// A failure with a stable code, a sentence that helps and, where possible, the JSON pointer of
/// the offending glTF node or option.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error, Serialize, Deserialize)]
#[error("{}: {message}", code.as_str())]
pub struct Failure {
    /// Stable code.
    pub code: Code,
    /// One sentence for a person.
    pub message: String,
    /// JSON pointer into the glTF document or the options.
    pub pointer: Option<String>,
}

impl Failure {
    /// A failure without a pointer.
    pub fn new(code: Code, message: impl Into<String>) -> Self {
        Failure { code, message: message.into(), pointer: None }
    }
    /// The same failure, at a JSON pointer.
    pub fn at(mut self, pointer: impl Into<String>) -> Self {
        self.pointer = Some(pointer.into());
        self
    }
    /// The model is broken.
    pub fn model(message: impl Into<String>) -> Self {
        Self::new(Code::InvalidModel, message)
    }
    /// Whether the machine is in trouble, which will pass: no job ends for it.
    pub fn is_of_the_machine(&self) -> bool {
        matches!(self.code, Code::InsufficientStorage | Code::Unavailable)
    }
    /// Intarsia is at fault.
    pub fn internal(message: impl Into<String>) -> Self {
        Self::new(Code::Internal, message)
    }
}

/// Result with [`Failure`].
pub type Result<T> = std::result::Result<T, Failure>;
