CREATE TABLE jobs (
  seq INTEGER PRIMARY KEY AUTOINCREMENT,     -- the order of arrival
  id TEXT NOT NULL UNIQUE,                   -- 128 random bits
  state TEXT NOT NULL,
  options TEXT NOT NULL,                     -- JSON, all defaults filled in
  inputs TEXT NOT NULL,                      -- JSON: the manifest of the upload
  attempt INTEGER NOT NULL DEFAULT 0,        -- the fencing token: grows with every claim, never falls
  deaths INTEGER NOT NULL DEFAULT 0,         -- attempts whose process was gone
  owner TEXT,                                -- the worker that runs it
  lease_until INTEGER,                       -- milliseconds since 1970, as all times
  cancel_requested INTEGER NOT NULL DEFAULT 0,
  created_at INTEGER NOT NULL,
  started_at INTEGER,
  finished_at INTEGER,
  artifacts_expire_at INTEGER,
  artifacts_removed INTEGER NOT NULL DEFAULT 0,
  progress TEXT NOT NULL DEFAULT '{}',       -- JSON, as are the following
  timings TEXT NOT NULL DEFAULT '[]',
  warnings TEXT NOT NULL DEFAULT '[]',
  error TEXT,
  artifacts TEXT NOT NULL DEFAULT '[]'
) STRICT;
CREATE INDEX jobs_by_state ON jobs (state, seq);
CREATE INDEX jobs_by_end ON jobs (finished_at) WHERE finished_at IS NOT NULL;
