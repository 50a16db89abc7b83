-- A job whose process died while it ran: its next attempts run in processes of their own. `deaths` counts only deaths of such processes,
-- which a living service has seen.
ALTER TABLE jobs ADD COLUMN suspect INTEGER NOT NULL DEFAULT 0;
UPDATE jobs SET suspect = (deaths > 0), deaths = 0 WHERE state IN ('queued', 'running');

-- Bytes of what was uploaded, 0 where that is not known, and of what was published.
ALTER TABLE jobs ADD COLUMN upload_bytes INTEGER NOT NULL DEFAULT 0;
ALTER TABLE jobs ADD COLUMN artifact_bytes INTEGER NOT NULL DEFAULT 0;
UPDATE jobs SET artifact_bytes = (SELECT coalesce(sum(json_extract(value, '$.bytes')), 0) FROM json_each(jobs.artifacts));
CREATE INDEX jobs_by_upload_bytes ON jobs (state, upload_bytes);
CREATE INDEX jobs_by_artifact_bytes ON jobs (artifacts_removed, artifact_bytes);
