//! What a failure of the database is for those who wait for it: mostly the machine's trouble, which ends no job.

use sqlx::postgres::PgDatabaseError;
use sqlx::sqlite::SqliteError;

use crate::error::{Code, Failure};

/// What a damaged file is answered.
pub(super) const DAMAGED: &str =
    "the file of the job queue is damaged: stop the service, put a copy from a backup in its place, start it again";

/// The machine's trouble.
pub(super) fn unavailable(why: &str) -> Failure {
    Failure::new(Code::Unavailable, why)
}

impl From<sqlx::Error> for Failure {
    fn from(error: sqlx::Error) -> Self {
        tracing::debug!(%error, "the queue failed");
        let of_database = error.as_database_error();
        if let Some(found) = of_database.and_then(|e| e.try_downcast_ref::<PgDatabaseError>()) {
            return of_postgres(found);
        }
        let code = of_database
            .and_then(|e| e.try_downcast_ref::<SqliteError>())
            .and_then(|e| sqlx::error::DatabaseError::code(e)?.parse::<u32>().ok());
        // The primary result codes of SQLite.
        match (code.map(|code| code & 0xFF), &error) {
            (Some(13), _) => Failure::new(Code::InsufficientStorage, "the disk of the job queue is full"),
            (Some(5 | 6), _)
            | (_, sqlx::Error::PoolTimedOut | sqlx::Error::InvalidSavePointStatement | sqlx::Error::BeginFailed) => {
                unavailable("the job queue is busy")
            }
            (Some(8), _) => unavailable("the job queue cannot be written: its file or folder is read-only"),
            (Some(11 | 26), _) => unavailable(DAMAGED),
            (Some(10 | 14), _) => unavailable("the file of the job queue cannot be used"),
            (Some(_), _) => unavailable(&format!("the job queue failed: {error}")),
            (None, sqlx::Error::Io(e)) => unavailable(&format!("the job queue cannot be reached: {}", e.kind())),
            (
                None,
                sqlx::Error::Tls(_) | sqlx::Error::Protocol(_) | sqlx::Error::PoolClosed | sqlx::Error::WorkerCrashed,
            ) => unavailable("the connection to the job queue broke off"),
            (None, _) => Failure::internal(format!("the job queue failed: {error}")),
        }
    }
}

/// By the classes of SQLSTATE.
fn of_postgres(error: &PgDatabaseError) -> Failure {
    let code = error.code();
    match (code.get(..2).unwrap_or_default(), code) {
        (_, "53100") => {
            Failure::new(Code::InsufficientStorage, "the disk of PostgreSQL, which holds the job queue, is full")
        }
        (_, "53300") => unavailable(
            "PostgreSQL, which holds the job queue, takes no more connections: raise its max_connections, or run fewer processes",
        ),
        ("08" | "57" | "58", _) => {
            unavailable("PostgreSQL, which holds the job queue, has ended the connection or does not answer in time")
        }
        ("40" | "55", _) => unavailable("the job queue is busy"),
        (_, "25006") => {
            unavailable("PostgreSQL, which holds the job queue, can only be read: --queue must name the primary")
        }
        ("28", _) => unavailable("PostgreSQL refuses the user or the password of --queue"),
        (_, "3D000") => unavailable("PostgreSQL has no database of the name that --queue gives: make it with createdb"),
        (_, "42501") => {
            unavailable("the user of --queue may not do in its database what the job queue needs: make it the owner")
        }
        ("53" | "XX", _) => unavailable(&format!("PostgreSQL, which holds the job queue, failed: {}", error.message())),
        _ => Failure::internal(format!("the job queue failed: {} ({code})", error.message())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_the_machines_ends_no_job() {
        let broken = || std::io::Error::from(std::io::ErrorKind::ConnectionRefused);
        for error in [sqlx::Error::PoolTimedOut, sqlx::Error::Io(broken()), sqlx::Error::Protocol("x".into())] {
            assert!(Failure::from(error).is_of_the_machine());
        }
        assert!(!Failure::from(sqlx::Error::RowNotFound).is_of_the_machine());
    }
}
