-- Jobs that were submitted together.
CREATE TABLE batches (
  id TEXT PRIMARY KEY,                       -- 128 random bits
  tenant TEXT NOT NULL,                      -- empty where the service knows no tenants
  key TEXT UNIQUE,                           -- the client's Idempotency-Key, as in `jobs`
  fingerprint TEXT,                          -- of the request under that key
  metadata TEXT NOT NULL,                    -- JSON
  created_at INTEGER NOT NULL
) STRICT;
CREATE INDEX batches_by_age ON batches (created_at);

CREATE TABLE batch_jobs (
  batch TEXT NOT NULL,
  item INTEGER NOT NULL,                     -- its place in the request
  job TEXT NOT NULL,
  made INTEGER NOT NULL,                     -- 0 where the job was known by its key
  PRIMARY KEY (batch, item)
) STRICT, WITHOUT ROWID;
