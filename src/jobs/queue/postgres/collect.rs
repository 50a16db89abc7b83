//! Which objects are needed, and which go. The store itself is never waited for inside a transaction.

use std::time::Duration;

use sqlx::postgres::{PgConnection, PgPool};

use super::{BATCH, Postgres, Remove, millis, within};
use crate::error::Result;
use crate::jobs::queue::rows::{self, Columns};
use crate::jobs::queue::{Claim, NewJob};

/// Whether somebody needs the object of a row of `blobs`.
const NEEDED: &str = "EXISTS (SELECT 1 FROM objects WHERE objects.sha256 = blobs.sha256)";

/// Notes what an attempt is about to store, and where. An object that is marked is kept; one that is being removed gets another name.
pub(super) async fn reserve(pool: &PgPool, claim: &Claim, objects: &[String]) -> Result<Option<Vec<String>>> {
    let mut step = pool.begin().await?;
    // While this lasts, nobody takes the job from its attempt.
    let sql =
        "SELECT id FROM jobs WHERE id = $1 AND attempt = $2 AND state = 'running' AND NOT cancel_requested FOR SHARE";
    let held = sqlx::query(sql).bind(&claim.id).bind(i64::from(claim.attempt)).fetch_optional(&mut *step).await?;
    if held.is_none() {
        return Ok(None);
    }
    let mut sorted = objects.to_vec();
    sorted.sort_unstable();
    sorted.dedup();
    // All in one order, so that no two wait for each other.
    let rows = sqlx::query(
        "INSERT INTO blobs (sha256, place)
         SELECT sha256, sha256 || '.' || left(replace(gen_random_uuid()::text, '-', ''), 12) FROM unnest($1::text[]) sha256 ORDER BY sha256
         ON CONFLICT (sha256) DO UPDATE SET marked_at = NULL RETURNING sha256, place",
    );
    let rows = rows.bind(&sorted).fetch_all(&mut *step).await?;
    sqlx::query("INSERT INTO objects (sha256, job, attempt) SELECT sha256, $2, $3 FROM unnest($1::text[]) sha256 ON CONFLICT DO NOTHING")
        .bind(&sorted)
        .bind(&claim.id)
        .bind(i64::from(claim.attempt))
        .execute(&mut *step)
        .await?;
    step.commit().await?;
    let places = rows.iter().map(|row| Ok((row.text("sha256")?, row.text("place")?)));
    let places = places.collect::<Result<std::collections::BTreeMap<_, _>>>()?;
    Ok(Some(objects.iter().filter_map(|object| places.get(object).cloned()).collect()))
}

/// Gives a new job the result of an equal one, where there is one; its artifacts stay as long as either job needs them.
pub(super) async fn reuse(step: &mut PgConnection, job: &NewJob, key: &str) -> Result<bool> {
    // Locked, so that it neither goes nor expires before its objects are reserved for this job too.
    let source = sqlx::query(
        "SELECT id, attempt, artifacts FROM jobs WHERE result_key = $1 AND tenant = $2 AND state = 'succeeded'
           AND NOT artifacts_removed AND artifacts_expire_at > intarsia_now() ORDER BY seq DESC LIMIT 1 FOR SHARE",
    );
    let source = source.bind(key).bind(&job.tenant).fetch_optional(&mut *step).await?;
    let Some(source) = source else { return Ok(false) };
    let (id, attempt) = (source.text("id")?, source.integer("attempt")?);
    sqlx::query(
        "INSERT INTO objects (sha256, job, attempt) SELECT sha256, $1, 0 FROM objects WHERE job = $2 AND attempt = $3",
    )
    .bind(&job.id)
    .bind(&id)
    .bind(attempt)
    .execute(&mut *step)
    .await?;
    sqlx::query(
        "UPDATE jobs SET state = 'succeeded', finished_at = intarsia_now(), artifacts_expire_at = intarsia_now() + $3, artifacts = $4,
           (progress, stages, warnings, artifact_bytes, outcome)
             = (SELECT progress, stages, warnings, artifact_bytes, outcome FROM jobs WHERE id = $2)
         WHERE id = $1",
    )
    .bind(&job.id)
    .bind(&id)
    .bind(millis(job.keep))
    .bind(rows::reused(&source, job)?)
    .execute(&mut *step)
    .await?;
    Ok(true)
}

/// Marks what nobody needs, and removes what has been marked for long enough.
pub(super) async fn collect(
    queue: &Postgres,
    of: Option<&str>,
    present: &[String],
    grace: Duration,
    remove: Remove<'_>,
) -> Result<()> {
    let of_job = if of.is_some() { "objects.job = $1" } else { "$1::text IS NULL" };
    let dropped = format!(
        "DELETE FROM objects WHERE {of_job} AND NOT EXISTS (
           SELECT 1 FROM jobs WHERE jobs.id = objects.job AND jobs.attempt = objects.attempt AND (jobs.state = 'running'
             OR jobs.finished_at IS NOT NULL AND NOT jobs.artifacts_removed AND jobs.artifacts <> '[]'))
         RETURNING sha256"
    );
    let dropped = queue.rows(sqlx::query(sqlx::AssertSqlSafe(dropped)).bind(of)).await?;
    let dropped = dropped.iter().map(|row| row.text("sha256")).collect::<Result<Vec<_>>>()?;
    // Of one job only what it had is looked at.
    let of_these = if of.is_some() { "sha256 = ANY($1)" } else { "$1::text[] IS NOT NULL" };
    let marked = format!(
        "UPDATE blobs SET marked_at = intarsia_now() WHERE sha256 IS NOT NULL AND marked_at IS NULL AND {of_these} AND NOT {NEEDED}"
    );
    execute(queue, sqlx::query(sqlx::AssertSqlSafe(marked)).bind(&dropped)).await?;
    if of.is_none() {
        let kept = format!(
            "UPDATE blobs SET marked_at = NULL WHERE sha256 IS NOT NULL AND marked_at IS NOT NULL AND {NEEDED}"
        );
        execute(queue, sqlx::query(sqlx::AssertSqlSafe(kept))).await?;
    }
    for strangers in present.chunks(usize::try_from(BATCH).unwrap_or(1)) {
        // Objects that the queue has never named, or not any more.
        let sql = "INSERT INTO blobs (place, marked_at) SELECT place, intarsia_now() FROM unnest($1::text[]) place ON CONFLICT DO NOTHING";
        execute(queue, sqlx::query(sql).bind(strangers)).await?;
    }
    // From here on the name is nobody's: who reserves the object now gets another.
    let taken = format!(
        "UPDATE blobs SET sha256 = NULL WHERE sha256 IS NOT NULL AND marked_at <= intarsia_now() - $1 AND NOT {NEEDED}"
    );
    execute(queue, sqlx::query(sqlx::AssertSqlSafe(taken)).bind(millis(grace))).await?;
    let mut after = String::new();
    loop {
        let sql = "SELECT place FROM blobs WHERE sha256 IS NULL AND marked_at <= intarsia_now() - $1 AND place > $2 ORDER BY place LIMIT $3";
        let rows = queue.rows(sqlx::query(sql).bind(millis(grace)).bind(&after).bind(BATCH)).await?;
        let mut gone = Vec::with_capacity(rows.len());
        for row in &rows {
            let place = row.text("place")?;
            if remove(&place).await {
                gone.push(place.clone());
            }
            after = place;
        }
        // What is still there is tried again at the next collection.
        execute(queue, sqlx::query("DELETE FROM blobs WHERE sha256 IS NULL AND place = ANY($1)").bind(&gone)).await?;
        if rows.len() < usize::try_from(BATCH).unwrap_or(1) {
            return Ok(());
        }
    }
}

async fn execute(queue: &Postgres, query: super::Statement<'_>) -> Result<()> {
    within(async {
        query.execute(&queue.pool).await?;
        Ok(())
    })
    .await
}
