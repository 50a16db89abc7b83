//! The schema of the queue in PostgreSQL, and how a database of an earlier version becomes one of today's.
//!
//! The version stands in the table `schema_version`. Migrations run in order and in one transaction; one process runs them, and the others
//! wait. To change the schema, add a file and a line to [`MIGRATIONS`]; what is there already never changes. Processes of the version before
//! may still be at work, so a migration adds what they need not know.

use sqlx::postgres::PgPool;
use sqlx::{PgConnection, Row};

use crate::error::Result;
use crate::jobs::queue::schema::{Migration, outstanding};

/// All of them, in order.
const MIGRATIONS: &[Migration] = &[
    Migration { version: 1, sql: include_str!("1_queue.sql") },
    Migration { version: 2, sql: include_str!("2_uploads_and_batches.sql") },
];

/// What those hold who migrate: the first bytes of "intarsia".
const LOCK: i64 = 0x696e_7461_7273;

/// Brings the database to the version of the last migration, unless it has it already; true where it was empty.
///
/// # Errors
/// `unavailable`; `internal`: a database of a version that is not known, or a migration that fails; then it is as it was.
pub(super) async fn migrate(pool: &PgPool) -> Result<bool> {
    // A database that is up to date is only read.
    let mut connection = pool.acquire().await?;
    if let Some(version) = version(&mut connection).await?
        && outstanding(version, MIGRATIONS)?.is_empty()
    {
        return Ok(false);
    }
    drop(connection);
    let mut step = pool.begin().await?;
    sqlx::query("SET LOCAL statement_timeout = 0").execute(&mut *step).await?;
    sqlx::query("SELECT pg_advisory_xact_lock($1)").bind(LOCK).execute(&mut *step).await?;
    let from = version(&mut step).await?;
    let outstanding = outstanding(from.unwrap_or(0), MIGRATIONS)?;
    let Some(to) = outstanding.last().map(|m| m.version) else { return Ok(false) };
    if let Some(from) = from {
        tracing::info!(from, to, "migrating the job queue");
    } else {
        sqlx::raw_sql("CREATE TABLE schema_version (version bigint NOT NULL)").execute(&mut *step).await?;
        sqlx::raw_sql("INSERT INTO schema_version VALUES (0)").execute(&mut *step).await?;
    }
    for migration in outstanding {
        sqlx::raw_sql(migration.sql).execute(&mut *step).await?;
    }
    sqlx::query("UPDATE schema_version SET version = $1").bind(to).execute(&mut *step).await?;
    step.commit().await?;
    Ok(from.is_none())
}

/// The version; `None` where there is no queue yet.
async fn version(connection: &mut PgConnection) -> Result<Option<i64>> {
    let known = sqlx::query("SELECT to_regclass('schema_version') IS NOT NULL").fetch_one(&mut *connection).await?;
    if !known.try_get::<bool, _>(0)? {
        return Ok(None);
    }
    Ok(Some(sqlx::query("SELECT version FROM schema_version").fetch_one(connection).await?.try_get(0)?))
}
