-- The time by which the queue goes, in milliseconds since 1970, as all times. Every statement asks this and no process's own clock.
CREATE FUNCTION intarsia_now() RETURNS bigint LANGUAGE sql STABLE PARALLEL SAFE
  AS $$ SELECT (extract(epoch FROM clock_timestamp()) * 1000)::bigint $$;

-- The store itself: one row.
CREATE TABLE store (
  one integer PRIMARY KEY CHECK (one = 1),
  identity text NOT NULL                     -- random, made once
);
INSERT INTO store (one, identity) VALUES (1, replace(gen_random_uuid()::text, '-', ''));

-- The order of claims; equal sizes by it, then by arrival.
CREATE SEQUENCE turns;

-- JSON is kept as text, as it was written: PostgreSQL looks into none that holds an escaped NUL.
CREATE TABLE jobs (
  seq bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY, -- the order of arrival
  id text NOT NULL UNIQUE,                   -- 128 random bits
  state text NOT NULL,
  tenant text NOT NULL DEFAULT '',           -- whose it is; empty where the service knows no tenants
  size bigint NOT NULL DEFAULT 0,            -- the order within a tenant, before `turn`
  turn bigint NOT NULL DEFAULT nextval('turns'),
  memory bigint NOT NULL,                    -- bytes that it is expected to need
  max_running bigint,                        -- jobs of its tenant that may run when it starts; null is any number
  slot bigint,                               -- which of them it is while it runs
  attempt bigint NOT NULL DEFAULT 0,         -- the fencing token: grows with every claim, never falls
  deaths bigint NOT NULL DEFAULT 0,          -- attempts whose own process died
  suspect boolean NOT NULL DEFAULT false,    -- it runs in a process of its own
  owner text,                                -- the worker that runs it
  cancel_requested boolean NOT NULL DEFAULT false,
  created_at bigint NOT NULL,
  queued_at bigint NOT NULL,                 -- since when it waits
  started_at bigint,
  finished_at bigint,
  artifacts_expire_at bigint,
  artifacts_removed boolean NOT NULL DEFAULT false,
  upload_bytes bigint NOT NULL DEFAULT 0,
  artifact_bytes bigint NOT NULL DEFAULT 0,
  lead double precision NOT NULL DEFAULT 0,  -- by how much users may have seen more than the fraction of `progress`
  outcome text,
  request text,                              -- the id of the request that brought it
  key text UNIQUE,                           -- the client's Idempotency-Key, behind the name of its tenant and a line end
  fingerprint text,                          -- of the request under that key
  result_key text,                           -- what the result follows from, where it may be another's
  webhook text,                              -- the URL of its options that is told of its end
  metadata text NOT NULL DEFAULT '{}',       -- that of its options: JSON, as all that follows
  options text NOT NULL,
  inputs text NOT NULL,
  progress text NOT NULL,
  stages text NOT NULL DEFAULT '[]',
  timings text NOT NULL DEFAULT '[]',
  warnings text NOT NULL DEFAULT '[]',
  error text,
  artifacts text NOT NULL DEFAULT '[]'
) WITH (fillfactor = 85, autovacuum_vacuum_scale_factor = 0.02, autovacuum_analyze_scale_factor = 0.02, autovacuum_vacuum_cost_delay = 0);

-- What waits, and what runs, is little of what there is.
CREATE INDEX jobs_waiting_by_size ON jobs (tenant, size, turn, seq) WHERE state = 'queued';
CREATE INDEX jobs_waiting_by_arrival ON jobs (tenant, seq) WHERE state = 'queued';
CREATE INDEX jobs_waiting_by_time ON jobs (tenant, queued_at, turn, seq) WHERE state = 'queued';
CREATE INDEX jobs_waiting_since ON jobs (queued_at) WHERE state = 'queued';
CREATE INDEX jobs_waiting_by_memory ON jobs (memory) WHERE state = 'queued';
CREATE INDEX jobs_running ON jobs (tenant) WHERE state = 'running';
CREATE UNIQUE INDEX jobs_slots ON jobs (tenant, slot) WHERE state = 'running' AND slot IS NOT NULL;
CREATE INDEX jobs_by_start ON jobs (tenant, started_at) WHERE started_at IS NOT NULL;
CREATE INDEX jobs_by_tenant ON jobs (tenant, seq);
CREATE INDEX jobs_by_state ON jobs (state, seq);
CREATE INDEX jobs_by_end ON jobs (finished_at) WHERE finished_at IS NOT NULL;
CREATE INDEX jobs_by_expiry ON jobs (artifacts_expire_at) WHERE NOT artifacts_removed;
CREATE INDEX jobs_uploads ON jobs (tenant, upload_bytes) WHERE state IN ('queued', 'running');
CREATE INDEX jobs_stored ON jobs (tenant, artifact_bytes) WHERE NOT artifacts_removed AND artifact_bytes > 0;
CREATE INDEX jobs_by_result ON jobs (result_key, seq) WHERE result_key IS NOT NULL;

-- What changes all the time while a job runs: narrow, with room in each page, and no index on what changes.
CREATE TABLE heartbeats (
  job text PRIMARY KEY,
  attempt bigint NOT NULL,
  lease_until bigint NOT NULL,
  beaten boolean NOT NULL DEFAULT false,     -- whether its worker knows that it has it
  progress text,                             -- null before the first
  stages text,
  warnings text
) WITH (fillfactor = 50, autovacuum_vacuum_scale_factor = 0.05, autovacuum_vacuum_threshold = 100, autovacuum_vacuum_cost_delay = 0);

-- Which attempts store, or have published, which objects.
CREATE TABLE objects (
  sha256 text NOT NULL,
  job text NOT NULL,
  attempt bigint NOT NULL,
  PRIMARY KEY (sha256, job, attempt)
) WITH (autovacuum_vacuum_scale_factor = 0.05);
CREATE INDEX objects_by_job ON objects (job);

-- What the store holds. A name is given to one object and never again: whoever removes it late removes nobody else's.
CREATE TABLE blobs (
  place text PRIMARY KEY,                    -- its name in the store
  sha256 text UNIQUE,                        -- null when it is nobody's any more
  marked_at bigint                           -- since when nobody needs it
) WITH (autovacuum_vacuum_scale_factor = 0.05);
CREATE INDEX blobs_marked ON blobs (marked_at) WHERE marked_at IS NOT NULL;

-- API keys. A token is 256 random bits, so that its SHA-256 tells nothing of it.
CREATE TABLE keys (
  id text PRIMARY KEY,                       -- 128 random bits
  hash text NOT NULL UNIQUE,                 -- SHA-256 of the token
  name text NOT NULL,
  tenant text NOT NULL,
  scopes text NOT NULL,                      -- JSON, as are the quotas
  quotas text NOT NULL,
  created_at bigint NOT NULL,
  revoked_at bigint
);

-- Where tenants want to be told that their jobs have ended (Standard Webhooks).
CREATE TABLE webhooks (
  id text PRIMARY KEY,                       -- 128 random bits
  tenant text NOT NULL,
  url text NOT NULL,
  events text NOT NULL,                      -- JSON
  secrets text NOT NULL,                     -- JSON: objects of `secret` and `until`, the newest first; several while they rotate
  created_at bigint NOT NULL,
  disabled_at bigint,
  disabled_because text
);
CREATE INDEX webhooks_by_tenant ON webhooks (tenant, created_at);

-- The outbox: what has been told, and what has not yet.
CREATE TABLE deliveries (
  seq bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
  id text NOT NULL UNIQUE,                   -- the same for each attempt
  tenant text NOT NULL,
  webhook text,                              -- null where the job itself named the URL
  url text NOT NULL,
  job text NOT NULL,
  event text NOT NULL,
  payload text NOT NULL,                     -- JSON, byte for byte as it is sent
  attempts bigint NOT NULL DEFAULT 0,
  next_at bigint,                            -- when it is tried next; null when it has ended
  created_at bigint NOT NULL,
  delivered_at bigint,
  status bigint,                             -- what the last attempt was answered
  error text                                 -- why the last attempt failed
) WITH (autovacuum_vacuum_scale_factor = 0.05);
CREATE INDEX deliveries_by_time ON deliveries (next_at, seq) WHERE next_at IS NOT NULL;
CREATE INDEX deliveries_by_webhook ON deliveries (webhook, seq);
CREATE INDEX deliveries_by_age ON deliveries (created_at);

-- In the transaction of the final state itself, whichever statement sets it, so that none is forgotten.
CREATE FUNCTION job_ended() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
  told text;
BEGIN
  told := json_build_object('type', 'job.' || NEW.state,
    'timestamp', to_char(to_timestamp(NEW.finished_at / 1000.0) AT TIME ZONE 'UTC', 'YYYY-MM-DD"T"HH24:MI:SS.MS"Z"'),
    'data', json_build_object('id', NEW.id, 'state', NEW.state, 'outcome', NEW.outcome, 'error', NEW.error::json,
      'metadata', NEW.metadata::json))::text;
  INSERT INTO deliveries (id, tenant, webhook, url, job, event, payload, next_at, created_at)
  SELECT 'msg_' || replace(gen_random_uuid()::text, '-', ''), NEW.tenant, target.webhook, target.url, NEW.id, 'job.' || NEW.state, told,
    NEW.finished_at, NEW.finished_at
  FROM (
    SELECT id AS webhook, url FROM webhooks WHERE tenant = NEW.tenant AND tenant <> '' AND disabled_at IS NULL
      AND events::jsonb ? ('job.' || NEW.state)
    UNION ALL
    SELECT NULL, NEW.webhook WHERE NEW.webhook IS NOT NULL) target;
  RETURN NULL;
END $$;
CREATE TRIGGER job_ended AFTER UPDATE OF state ON jobs FOR EACH ROW
  WHEN (OLD.state IN ('queued', 'running') AND NEW.state NOT IN ('queued', 'running')) EXECUTE FUNCTION job_ended();
