-- Uploads that are sent in pieces. One is finished when its `sha256` is there.
CREATE TABLE uploads (
  seq INTEGER PRIMARY KEY AUTOINCREMENT,
  id TEXT NOT NULL UNIQUE,                   -- 128 random bits
  tenant TEXT NOT NULL,                      -- empty where the service knows no tenants
  filename TEXT,
  metadata TEXT NOT NULL,                    -- as its client gave it
  length INTEGER NOT NULL,                   -- bytes that were declared
  received INTEGER NOT NULL DEFAULT 0,       -- bytes that are stored
  declared TEXT,                             -- the SHA-256 that was declared
  sha256 TEXT,                               -- the SHA-256 of all bytes
  holder TEXT,                               -- who may add pieces: the fencing token
  created_at INTEGER NOT NULL,
  expires_at INTEGER NOT NULL
) STRICT;
CREATE INDEX uploads_by_expiry ON uploads (expires_at);
CREATE INDEX uploads_by_tenant ON uploads (tenant, sha256, length, received);

-- What is stored of them.
CREATE TABLE upload_pieces (
  upload TEXT NOT NULL,
  start INTEGER NOT NULL,                    -- the first byte's place in the upload
  bytes INTEGER NOT NULL,
  name TEXT NOT NULL,                        -- in the store of pieces
  PRIMARY KEY (upload, start)
) STRICT, WITHOUT ROWID;
