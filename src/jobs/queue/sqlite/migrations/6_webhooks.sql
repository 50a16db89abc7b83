-- Where tenants want to be told that their jobs have ended (Standard Webhooks).
CREATE TABLE webhooks (
  id TEXT PRIMARY KEY,                       -- 128 random bits
  tenant TEXT NOT NULL,
  url TEXT NOT NULL,
  events TEXT NOT NULL,                      -- JSON
  secrets TEXT NOT NULL,                     -- JSON: objects of `secret` and `until`, the newest first; several while they rotate
  created_at INTEGER NOT NULL,
  disabled_at INTEGER,
  disabled_because TEXT
) STRICT;
CREATE INDEX webhooks_by_tenant ON webhooks (tenant, created_at);

-- The outbox: what has been told, and what has not yet.
CREATE TABLE deliveries (
  seq INTEGER PRIMARY KEY AUTOINCREMENT,
  id TEXT NOT NULL UNIQUE,                   -- the same for each attempt
  tenant TEXT NOT NULL,
  webhook TEXT,                              -- null where the job itself named the URL
  url TEXT NOT NULL,
  job TEXT NOT NULL,
  event TEXT NOT NULL,
  payload TEXT NOT NULL,                     -- JSON, byte for byte as it is sent
  attempts INTEGER NOT NULL DEFAULT 0,
  next_at INTEGER,                           -- when it is tried next; null when it has ended
  created_at INTEGER NOT NULL,
  delivered_at INTEGER,
  status INTEGER,                            -- what the last attempt was answered
  error TEXT                                 -- why the last attempt failed
) STRICT;
CREATE INDEX deliveries_by_time ON deliveries (next_at, seq) WHERE next_at IS NOT NULL;
CREATE INDEX deliveries_by_webhook ON deliveries (webhook, seq);
CREATE INDEX deliveries_by_age ON deliveries (created_at);

-- In the transaction of the final state itself, whichever statement sets it, so that none is forgotten.
CREATE TRIGGER job_ended AFTER UPDATE OF state ON jobs
WHEN OLD.state IN ('queued', 'running') AND NEW.state NOT IN ('queued', 'running')
BEGIN
  INSERT INTO deliveries (id, tenant, webhook, url, job, event, payload, next_at, created_at)
  SELECT 'msg_' || lower(hex(randomblob(16))), NEW.tenant, target.webhook, target.url, NEW.id, 'job.' || NEW.state,
    json_object('type', 'job.' || NEW.state, 'timestamp', strftime('%Y-%m-%dT%H:%M:%fZ', NEW.finished_at / 1000.0, 'unixepoch'),
      'data', json_object('id', NEW.id, 'state', NEW.state, 'outcome', NEW.outcome, 'error', json(NEW.error),
        'metadata', json(coalesce(json_extract(NEW.options, '$.metadata'), '{}')))),
    NEW.finished_at, NEW.finished_at
  FROM (
    SELECT id AS webhook, url FROM webhooks WHERE tenant = NEW.tenant AND tenant <> '' AND disabled_at IS NULL
      AND EXISTS (SELECT 1 FROM json_each(events) WHERE value = 'job.' || NEW.state)
    UNION ALL
    SELECT NULL, json_extract(NEW.options, '$.webhook') WHERE json_extract(NEW.options, '$.webhook') IS NOT NULL) target;
END;
