-- The traceparent (W3C) of the request that brought the job: its trace goes on in the worker and in webhooks.
ALTER TABLE jobs ADD COLUMN trace TEXT;
-- What is told of one job.
CREATE INDEX deliveries_by_job ON deliveries (job, seq);
