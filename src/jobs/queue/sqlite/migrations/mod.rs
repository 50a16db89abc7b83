//! The schema of the queue's database, and how a store of an earlier version becomes one of today's.
//!
//! The version stands in the database's `user_version`, 0 in a new file. Migrations run in order and in one transaction; a store that is
//! not new is copied first. To change the schema, add a file and a line to [`MIGRATIONS`]; what is there already never changes. Processes
//! of the version before may still be at work on the store, so a migration adds what they need not know.

use std::io;
use std::path::{Path, PathBuf};

use sqlx::sqlite::{SqliteConnectOptions, SqlitePool};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, Row, SqliteConnection};

use crate::error::{Code, Failure, Result};
use crate::jobs::files::{disk, sync_folder};
use crate::jobs::queue::schema::{Migration, outstanding};

/// All of them, in order. A new store takes every step, so that it has the same tables as one that grew.
pub(super) const MIGRATIONS: &[Migration] = &[
    Migration { version: 2, sql: include_str!("2_jobs.sql") },
    Migration { version: 3, sql: include_str!("3_outcome_and_identity.sql") },
    Migration { version: 4, sql: include_str!("4_suspects_and_bytes.sql") },
    Migration { version: 5, sql: include_str!("5_tenants_and_keys.sql") },
    Migration { version: 6, sql: include_str!("6_webhooks.sql") },
    Migration { version: 7, sql: include_str!("7_reuse.sql") },
    Migration { version: 8, sql: include_str!("8_uploads.sql") },
    Migration { version: 9, sql: include_str!("9_batches.sql") },
    Migration { version: 10, sql: include_str!("10_traces.sql") },
];

/// Fails for a store that this program cannot use. It is only read: a newer version's stays as it is.
///
/// # Errors
/// `internal`: the disk, or a store of a version that is not known.
pub(super) async fn check(options: &SqliteConnectOptions, migrations: &[Migration]) -> Result<()> {
    let path = options.get_filename();
    if !tokio::fs::try_exists(path).await.map_err(|e| disk(path, &e))? {
        return Ok(());
    }
    // SQLite takes an empty file for a new database, and removes what is beside it: that may be all that is left of the queue.
    let length = async |path: &Path| tokio::fs::metadata(path).await.map_or(0, |found| found.len());
    if length(path).await == 0 && length(&beside(path, "-wal")).await > 0 {
        return Err(Failure::new(Code::Unavailable, "the file of the job queue was cut short"));
    }
    let mut reader = options.clone().create_if_missing(false).read_only(true).connect().await?;
    let version = version(&mut reader).await?;
    reader.close().await?;
    outstanding(version, migrations).map(|_| ())
}

/// Brings the store to the version of the last migration, unless it has it already.
///
/// # Errors
/// `internal`: the disk, a store of a version that is not known, or a migration that fails; then the store is as it was.
pub(super) async fn migrate(pool: &SqlitePool, path: &Path, migrations: &[Migration]) -> Result<()> {
    if outstanding(version(&mut *pool.acquire().await?).await?, migrations)?.is_empty() {
        return Ok(());
    }
    // Of several processes that open the store one migrates it; the others wait here and find it done.
    let mut step = pool.begin_with("BEGIN IMMEDIATE").await?;
    let from = version(&mut step).await?;
    let outstanding = outstanding(from, migrations)?;
    let Some(to) = outstanding.last().map(|m| m.version) else { return Ok(()) };
    if from > 0 {
        let kept = beside(path, &format!(".v{from}"));
        copy(pool, &kept).await?;
        tracing::info!(from, to, copy = %kept.display(), "migrating the job queue");
    }
    for migration in outstanding {
        sqlx::raw_sql(migration.sql).execute(&mut *step).await?;
    }
    sqlx::raw_sql(AssertSqlSafe(format!("PRAGMA user_version = {to}"))).execute(&mut *step).await?;
    Ok(step.commit().await?)
}

async fn version(connection: &mut SqliteConnection) -> Result<i64> {
    Ok(sqlx::query("PRAGMA user_version").fetch_one(connection).await?.try_get(0)?)
}

/// Copies the store as it is, with what is in its WAL, to a file that appears whole or not at all. The caller holds the lock for writing, so
/// that nothing comes in between the copy and what it does next.
pub(super) async fn copy(pool: &SqlitePool, to: &Path) -> Result<()> {
    let to = std::path::absolute(to).map_err(|e| disk(to, &e))?;
    let young = beside(&to, ".new");
    let failed = |e: io::Error| disk(&to, &e);
    // What a process has left that died on the way.
    match tokio::fs::remove_file(&young).await {
        Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(failed(e)),
        _ => {}
    }
    let name = young.to_str().ok_or_else(|| Failure::internal("the path of the data folder is not UTF-8"))?;
    sqlx::query("VACUUM INTO ?1").bind(name).execute(pool).await?;
    // SQLite does not sync what it vacuums into.
    let file = tokio::fs::File::options().write(true).open(&young).await.map_err(failed)?;
    file.sync_all().await.map_err(failed)?;
    tokio::fs::rename(&young, &to).await.map_err(failed)?;
    sync_folder(to.parent().unwrap_or(&to)).map_err(failed)
}

/// The path with something after its name.
fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.to_owned().into_os_string();
    name.push(suffix);
    PathBuf::from(name)
}

#[cfg(test)]
mod tests;
