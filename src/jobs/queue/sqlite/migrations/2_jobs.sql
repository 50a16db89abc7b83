CREATE TABLE jobs (
  seq INTEGER PRIMARY KEY AUTOINCREMENT,     -- the order of arrival
  id TEXT NOT NULL UNIQUE,                   -- 128 random bits
  state TEXT NOT NULL,
  turn INTEGER NOT NULL,                     -- the order of claims; equal ones by arrival
  options TEXT NOT NULL,                     -- JSON, all defaults filled in
  inputs TEXT NOT NULL,                      -- JSON: the manifest of the upload
  memory INTEGER NOT NULL,                   -- bytes that it is expected to need
  key TEXT UNIQUE,                           -- the client's Idempotency-Key
  fingerprint TEXT,                          -- of the request under that key
  request TEXT,                              -- the id of the request that brought it
  attempt INTEGER NOT NULL DEFAULT 0,        -- the fencing token: grows with every claim, never falls
  deaths INTEGER NOT NULL DEFAULT 0,         -- attempts whose process was gone
  owner TEXT,                                -- the worker that runs it
  lease_until INTEGER,                       -- milliseconds since 1970, as all times
  cancel_requested INTEGER NOT NULL DEFAULT 0,
  created_at INTEGER NOT NULL,
  queued_at INTEGER NOT NULL,                -- since when it waits
  started_at INTEGER,
  finished_at INTEGER,
  artifacts_expire_at INTEGER,
  artifacts_removed INTEGER NOT NULL DEFAULT 0,
  progress TEXT NOT NULL,                    -- JSON, as are the following
  stages TEXT NOT NULL DEFAULT '[]',
  timings TEXT NOT NULL DEFAULT '[]',
  warnings TEXT NOT NULL DEFAULT '[]',
  error TEXT,
  artifacts TEXT NOT NULL DEFAULT '[]'
) STRICT;
CREATE INDEX jobs_by_turn ON jobs (state, turn, seq);
CREATE INDEX jobs_by_arrival ON jobs (state, seq);
CREATE INDEX jobs_by_end ON jobs (finished_at) WHERE finished_at IS NOT NULL;

-- Which attempts store, or have published, which objects.
CREATE TABLE objects (
  sha256 TEXT NOT NULL,
  job TEXT NOT NULL,
  attempt INTEGER NOT NULL,
  PRIMARY KEY (sha256, job, attempt)
) STRICT, WITHOUT ROWID;
CREATE INDEX objects_by_job ON objects (job);
