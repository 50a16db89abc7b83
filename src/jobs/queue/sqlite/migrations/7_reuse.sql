-- What the result follows from, for jobs whose result may be another's and whose own may be that of others: tenant, build, options and files.
ALTER TABLE jobs ADD COLUMN result_key TEXT;
CREATE INDEX jobs_by_result ON jobs (result_key, seq) WHERE result_key IS NOT NULL;
