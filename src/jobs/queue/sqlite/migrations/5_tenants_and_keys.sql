-- Whose a job is; empty where the service knows no tenants. A tenant's Idempotency-Key stands in `key` behind its name and a line end.
ALTER TABLE jobs ADD COLUMN tenant TEXT NOT NULL DEFAULT '';
-- The order within a tenant, before `turn`: the bytes that it is expected to need, and 0 for jobs of no tenant, which run as they came.
ALTER TABLE jobs ADD COLUMN size INTEGER NOT NULL DEFAULT 0;
-- How many jobs of its tenant may run when it starts; null is any number.
ALTER TABLE jobs ADD COLUMN max_running INTEGER;
CREATE INDEX jobs_by_size ON jobs (state, tenant, size, turn, seq);
CREATE INDEX jobs_by_wait ON jobs (state, tenant, queued_at);
CREATE INDEX jobs_by_tenant ON jobs (tenant, seq);
CREATE INDEX jobs_by_start ON jobs (tenant, started_at);
CREATE INDEX jobs_by_tenant_bytes ON jobs (tenant, artifacts_removed, artifact_bytes);

-- API keys. A token is 256 random bits, so that its SHA-256 tells nothing of it.
CREATE TABLE keys (
  id TEXT PRIMARY KEY,                       -- 128 random bits
  hash TEXT NOT NULL UNIQUE,                 -- SHA-256 of the token
  name TEXT NOT NULL,
  tenant TEXT NOT NULL,
  scopes TEXT NOT NULL,                      -- JSON, as are the quotas
  quotas TEXT NOT NULL,
  created_at INTEGER NOT NULL,
  revoked_at INTEGER
) STRICT;
