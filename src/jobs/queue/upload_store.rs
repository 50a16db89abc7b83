//! Uploads that are sent in pieces, beside the queue in its database. SQLite and PostgreSQL read these statements alike.

/// Makes a backend of the queue an [`UploadStore`](crate::jobs::resumable::UploadStore); of it this needs what [`key_store`] does.
///
/// [`key_store`]: super::key_store
macro_rules! upload_store {
    ($backend:ident) => {
        mod upload_store {
            use async_trait::async_trait;

            use crate::error::{Code, Failure, Result};
            use crate::jobs::queue::rows::{Columns, integer, piece, upload};
            use crate::jobs::record::Timestamp;
            use crate::jobs::resumable::{Piece, Upload, UploadBounds, UploadBytes, UploadStore};

            #[async_trait]
            impl UploadStore for super::$backend {
                async fn add_upload(&self, upload: &Upload, bounds: UploadBounds) -> Result<()> {
                    self.step(async move {
                        let mut step = self.begin().await?;
                        let counts = sqlx::query(
                            "SELECT (SELECT count(*) FROM uploads) AS everybodys, (SELECT count(*) FROM uploads WHERE tenant = $1) AS own,
                               (SELECT count(*) FROM uploads WHERE tenant = $1 AND sha256 IS NULL) AS incomplete",
                        )
                        .bind(&upload.tenant)
                        .fetch_one(&mut *step)
                        .await?;
                        let count = |column: &str| counts.integer(column);
                        if count("everybodys")? >= i64::from(bounds.all) {
                            let message = format!("this service keeps {} uploads, and so many are here; try again later", bounds.all);
                            return Err(Failure::new(Code::QueueFull, message));
                        }
                        let (of_tenant, incomplete) = (count("own")?, count("incomplete")?);
                        if !upload.tenant.is_empty() && of_tenant >= i64::from(bounds.of_tenant) {
                            let message = format!(
                                "a tenant may have {} uploads, and so many are here: delete what is not needed, or wait until it expires",
                                bounds.of_tenant
                            );
                            return Err(Failure::new(Code::QuotaExceeded, message));
                        }
                        if let Some(most) = bounds.incomplete.filter(|most| incomplete >= i64::from(*most)) {
                            let message =
                                format!("this key lets {most} uploads be received at the same time, and so many are not complete");
                            return Err(Failure::new(Code::QuotaExceeded, message));
                        }
                        sqlx::query(
                            "INSERT INTO uploads (id, tenant, filename, metadata, length, declared, created_at, expires_at)
                             VALUES ($1, $2, $3, $4, $5, $6, $7, $8)",
                        )
                        .bind(&upload.id)
                        .bind(&upload.tenant)
                        .bind(&upload.filename)
                        .bind(&upload.metadata)
                        .bind(integer(upload.length))
                        .bind(&upload.sha256)
                        .bind(upload.created_at.0)
                        .bind(upload.expires_at.0)
                        .execute(&mut *step)
                        .await?;
                        Ok(step.commit().await?)
                    }).await
                }

                async fn upload(&self, id: &str) -> Result<Option<Upload>> {
                    self.step(async move {
                        let row = sqlx::query("SELECT * FROM uploads WHERE id = $1").bind(id).fetch_optional(self.reader()).await?;
                        row.as_ref().map(upload).transpose()
                    }).await
                }

                async fn hold_upload(&self, id: &str, holder: &str, offset: u64) -> Result<bool> {
                    self.step(async move {
                        let sql = "UPDATE uploads SET holder = $2 WHERE id = $1 AND received = $3 AND sha256 IS NULL";
                        let done = sqlx::query(sql).bind(id).bind(holder).bind(integer(offset)).execute(self.writer()?).await?;
                        Ok(done.rows_affected() > 0)
                    }).await
                }

                async fn add_pieces(&self, id: &str, holder: &str, pieces: &[Piece], expires_at: Timestamp) -> Result<bool> {
                    self.step(async move {
                        let Some(first) = pieces.first() else { return Ok(true) };
                        let mut step = self.begin().await?;
                        let sql = "UPDATE uploads SET received = received + $4, expires_at = $5 WHERE id = $1 AND holder = $2 AND received = $3";
                        let done = sqlx::query(sql)
                            .bind(id)
                            .bind(holder)
                            .bind(integer(first.start))
                            .bind(integer(pieces.iter().map(|piece| piece.bytes).sum()))
                            .bind(expires_at.0)
                            .execute(&mut *step)
                            .await?;
                        if done.rows_affected() == 0 {
                            return Ok(false);
                        }
                        for piece in pieces {
                            sqlx::query("INSERT INTO upload_pieces (upload, start, bytes, name) VALUES ($1, $2, $3, $4)")
                                .bind(id)
                                .bind(integer(piece.start))
                                .bind(integer(piece.bytes))
                                .bind(&piece.name)
                                .execute(&mut *step)
                                .await?;
                        }
                        step.commit().await?;
                        Ok(true)
                    }).await
                }

                async fn pieces(&self, id: &str) -> Result<Vec<Piece>> {
                    self.step(async move {
                        let sql = "SELECT start, bytes, name FROM upload_pieces WHERE upload = $1 ORDER BY start";
                        let rows = sqlx::query(sql).bind(id).fetch_all(self.reader()).await?;
                        rows.iter().map(piece).collect()
                    }).await
                }

                async fn complete_upload(&self, id: &str, sha256: &str) -> Result<bool> {
                    self.step(async move {
                        let sql = "UPDATE uploads SET sha256 = $2, holder = NULL WHERE id = $1";
                        Ok(sqlx::query(sql).bind(id).bind(sha256).execute(self.writer()?).await?.rows_affected() > 0)
                    }).await
                }

                async fn remove_upload(&self, id: &str) -> Result<bool> {
                    self.step(async move {
                        let mut step = self.begin().await?;
                        let removed = sqlx::query("DELETE FROM uploads WHERE id = $1").bind(id).execute(&mut *step).await?;
                        sqlx::query("DELETE FROM upload_pieces WHERE upload = $1").bind(id).execute(&mut *step).await?;
                        step.commit().await?;
                        Ok(removed.rows_affected() > 0)
                    }).await
                }

                async fn expired_uploads(&self, now: Timestamp) -> Result<Vec<String>> {
                    self.step(async move {
                        let sql = "SELECT id FROM uploads WHERE expires_at <= $1 ORDER BY expires_at LIMIT 1000";
                        let rows = sqlx::query(sql).bind(now.0).fetch_all(self.reader()).await?;
                        rows.iter().map(|row| row.text("id")).collect()
                    }).await
                }

                async fn upload_bytes(&self, tenant: Option<&str>) -> Result<UploadBytes> {
                    self.step(async move {
                        let sql = "SELECT CAST(coalesce(sum(length), 0) AS bigint) AS declared, CAST(coalesce(sum(received), 0) AS bigint) AS received FROM uploads
                                   WHERE $1 IS NULL OR tenant = $1";
                        let row = sqlx::query(sql).bind(tenant).fetch_one(self.reader()).await?;
                        Ok(UploadBytes { declared: row.number("declared")?, received: row.number("received")? })
                    }).await
                }
            }
        }
    };
}

pub(super) use upload_store;
