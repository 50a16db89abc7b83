-- What came of a job that succeeded: refined, partly_refined, kept_input or nothing_to_refine; null for jobs that do not say.
ALTER TABLE jobs ADD COLUMN outcome TEXT;

-- The store itself: one row.
CREATE TABLE store (
  one INTEGER PRIMARY KEY CHECK (one = 1),
  identity TEXT NOT NULL                     -- 128 random bits, made once
) STRICT;
INSERT INTO store (one, identity) VALUES (1, lower(hex(randomblob(16))));
