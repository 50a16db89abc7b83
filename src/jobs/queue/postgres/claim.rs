//! The claim: one statement.

use std::time::Duration;

use sqlx::{AssertSqlSafe, Row};

use super::{Postgres, millis};
use crate::error::Result;
use crate::jobs::queue::rows::{self, integer};
use crate::jobs::queue::{Capacity, Claim};

/// Of a waiting job (`own`) of a tenant: whether it may be claimed.
const FREE: &str =
    "own.state = 'queued' AND own.tenant = tenants.name AND least(own.memory, $3) <= $4 AND own.memory <= $5
        AND NOT EXISTS (SELECT 1 FROM first WHERE (first.turn, first.seq) < (own.turn, own.seq))
        AND (own.max_running IS NULL OR own.max_running > tenants.running)";

/// How often a claim is tried of which another process took the place among the jobs of a tenant that may run.
const TRIES: u32 = 8;

/// The statement, as [`Queue::claim`](super::Queue::claim) says. Each tenant that waits is found by an index and offers one job, so that a long
/// queue of one costs the others nothing; the first tenant with an offer has its turn. Rows that other claims hold are skipped, and who is
/// at its limit is held back by an index: no two jobs of a tenant run in one slot. A job for which there is no capacity, and which has waited
/// for too long (`first`), is overtaken by nobody. What the statement sees of other claims may be a moment old, so turns are fair over time
/// and not between two claims at the same instant.
fn statement() -> String {
    format!(
        "WITH RECURSIVE
         names(name) AS (
           (SELECT min(tenant) FROM jobs WHERE state = 'queued')
           UNION ALL SELECT (SELECT min(tenant) FROM jobs WHERE state = 'queued' AND tenant > name) FROM names WHERE name IS NOT NULL),
         tenants AS MATERIALIZED (
           SELECT name, (SELECT count(*) FROM jobs WHERE state = 'running' AND tenant = name) AS running,
             (SELECT max(started_at) FROM jobs WHERE tenant = name) AS served,
             (SELECT min(seq) FROM jobs WHERE state = 'queued' AND tenant = name) AS oldest
           FROM names WHERE name IS NOT NULL ORDER BY running, served NULLS FIRST, oldest),
         first AS MATERIALIZED (
           SELECT turn, seq FROM jobs WHERE $4 < $3 AND state = 'queued' AND memory > $4 AND queued_at < intarsia_now() - $6
             AND (max_running IS NULL OR max_running > (SELECT running FROM tenants WHERE name = jobs.tenant))
           ORDER BY turn, seq LIMIT 1),
         next AS MATERIALIZED (
           SELECT offer.seq FROM tenants CROSS JOIN LATERAL (
             SELECT coalesce(
               (SELECT own.seq FROM jobs own WHERE tenants.name <> '' AND {FREE} AND own.queued_at < intarsia_now() - $6
                ORDER BY own.queued_at, own.turn, own.seq LIMIT 1 FOR UPDATE OF own SKIP LOCKED),
               (SELECT own.seq FROM jobs own WHERE {FREE}
                ORDER BY own.size, own.turn, own.seq LIMIT 1 FOR UPDATE OF own SKIP LOCKED)) AS seq
             OFFSET 0) offer
           WHERE offer.seq IS NOT NULL LIMIT 1),
         taken AS (
           UPDATE jobs SET state = 'running', attempt = attempt + 1, owner = $1, started_at = intarsia_now(),
             warnings = '[]', timings = '[]', stages = '[]',
             slot = CASE WHEN max_running IS NOT NULL THEN (
               SELECT min(slot) FROM generate_series(1, (SELECT count(*) + 1 FROM jobs r WHERE r.state = 'running' AND r.tenant = jobs.tenant)) slot
               WHERE NOT EXISTS (SELECT 1 FROM jobs r WHERE r.state = 'running' AND r.tenant = jobs.tenant AND r.slot = slot.slot)) END
           FROM next WHERE jobs.seq = next.seq AND jobs.state = 'queued'
           RETURNING jobs.id, jobs.attempt, options, inputs, progress, memory, request, trace, queued_at, suspect, lead),
         held AS (
           INSERT INTO heartbeats (job, attempt, lease_until) SELECT id, attempt, intarsia_now() + $2 FROM taken
           ON CONFLICT (job) DO UPDATE SET attempt = excluded.attempt, lease_until = excluded.lease_until, beaten = false,
             progress = NULL, stages = NULL, warnings = NULL)
         SELECT * FROM taken"
    )
}

impl Postgres {
    /// Claims a job.
    pub(super) async fn take(&self, owner: &str, lease: Duration, capacity: Capacity) -> Result<Option<Claim>> {
        let sql = statement();
        for tried in 1.. {
            let query = sqlx::query(AssertSqlSafe(sql.clone()))
                .bind(owner)
                .bind(millis(lease))
                .bind(integer(capacity.total))
                .bind(integer(capacity.free))
                .bind(integer(capacity.most))
                .bind(millis(capacity.patience));
            let found = self.step(async {
                match query.fetch_optional(&self.pool).await {
                    // Another process was given the same slot a moment ago.
                    Err(sqlx::Error::Database(e)) if e.is_unique_violation() && tried < TRIES => Ok(None),
                    found => Ok(Some(found?)),
                }
            });
            let Some(row) = found.await? else { continue };
            let Some(row) = row else { break };
            let mut claim = rows::claim(&row)?;
            let lead: f64 = row.try_get("lead")?;
            if lead > 0.0 {
                claim.floor = (claim.floor + lead).min(0.99);
            }
            return Ok(Some(claim));
        }
        Ok(None)
    }
}
