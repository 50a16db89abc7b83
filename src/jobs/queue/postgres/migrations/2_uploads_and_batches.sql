-- Uploads that are sent in pieces. One is finished when its `sha256` is there.
CREATE TABLE uploads (
  id text PRIMARY KEY,                       -- 128 random bits
  tenant text NOT NULL,                      -- empty where the service knows no tenants
  filename text,
  metadata text NOT NULL,                    -- as its client gave it
  length bigint NOT NULL,                    -- bytes that were declared
  received bigint NOT NULL DEFAULT 0,        -- bytes that are stored
  declared text,                             -- the SHA-256 that was declared
  sha256 text,                               -- the SHA-256 of all bytes
  holder text,                               -- who may add pieces: the fencing token
  created_at bigint NOT NULL,
  expires_at bigint NOT NULL
) WITH (autovacuum_vacuum_scale_factor = 0.05);
CREATE INDEX uploads_by_expiry ON uploads (expires_at);
CREATE INDEX uploads_by_tenant ON uploads (tenant);

-- What is stored of them.
CREATE TABLE upload_pieces (
  upload text NOT NULL,
  start bigint NOT NULL,                     -- the first byte's place in the upload
  bytes bigint NOT NULL,
  name text NOT NULL,                        -- in the store of pieces
  PRIMARY KEY (upload, start)
) WITH (autovacuum_vacuum_scale_factor = 0.05);

-- Jobs that were submitted together.
CREATE TABLE batches (
  id text PRIMARY KEY,                       -- 128 random bits
  tenant text NOT NULL,                      -- empty where the service knows no tenants
  key text UNIQUE,                           -- the client's Idempotency-Key, as in `jobs`
  fingerprint text,                          -- of the request under that key
  metadata text NOT NULL,                    -- JSON
  created_at bigint NOT NULL
);
CREATE INDEX batches_by_age ON batches (created_at);

CREATE TABLE batch_jobs (
  batch text NOT NULL,
  item bigint NOT NULL,                      -- its place in the request
  job text NOT NULL,
  made boolean NOT NULL,                     -- false where the job was known by its key
  PRIMARY KEY (batch, item)
);

-- The traceparent (W3C) of the request that brought the job: its trace goes on in the worker and in webhooks.
ALTER TABLE jobs ADD COLUMN trace text;
-- What is told of one job.
CREATE INDEX deliveries_by_job ON deliveries (job, seq);
