//! Uploads that are sent in pieces, beside the queue in its database.

use async_trait::async_trait;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::{Sqlite, integer};
use crate::error::{Code, Failure, Result};
use crate::jobs::record::Timestamp;
use crate::jobs::resumable::{PREFIX, Piece, Upload, UploadBounds, UploadBytes, UploadStore};

#[async_trait]
impl UploadStore for Sqlite {
    async fn add_upload(&self, upload: &Upload, bounds: UploadBounds) -> Result<()> {
        let mut step = self.pool()?.begin_with("BEGIN IMMEDIATE").await?;
        let counts = sqlx::query(
            "SELECT (SELECT count(*) FROM uploads), (SELECT count(*) FROM uploads WHERE tenant = ?1),
               (SELECT count(*) FROM uploads WHERE tenant = ?1 AND sha256 IS NULL)",
        )
        .bind(&upload.tenant)
        .fetch_one(&mut *step)
        .await?;
        let count = |column: usize| Ok::<_, Failure>(counts.try_get::<i64, _>(column)?);
        if count(0)? >= i64::from(bounds.all) {
            let message = format!("this service keeps {} uploads, and so many are here; try again later", bounds.all);
            return Err(Failure::new(Code::QueueFull, message));
        }
        let (of_tenant, incomplete) = (count(1)?, count(2)?);
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
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)",
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
    }

    async fn upload(&self, id: &str) -> Result<Option<Upload>> {
        let row = sqlx::query("SELECT * FROM uploads WHERE id = ?1").bind(id).fetch_optional(&self.pool).await?;
        row.as_ref().map(upload).transpose()
    }

    async fn hold_upload(&self, id: &str, holder: &str, offset: u64) -> Result<bool> {
        let sql = "UPDATE uploads SET holder = ?2 WHERE id = ?1 AND received = ?3 AND sha256 IS NULL";
        let done = sqlx::query(sql).bind(id).bind(holder).bind(integer(offset)).execute(self.pool()?).await?;
        Ok(done.rows_affected() > 0)
    }

    async fn add_pieces(&self, id: &str, holder: &str, pieces: &[Piece], expires_at: Timestamp) -> Result<bool> {
        let Some(first) = pieces.first() else { return Ok(true) };
        let mut step = self.pool()?.begin_with("BEGIN IMMEDIATE").await?;
        let sql = "UPDATE uploads SET received = received + ?4, expires_at = ?5 WHERE id = ?1 AND holder = ?2 AND received = ?3";
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
            sqlx::query("INSERT INTO upload_pieces (upload, start, bytes, name) VALUES (?1, ?2, ?3, ?4)")
                .bind(id)
                .bind(integer(piece.start))
                .bind(integer(piece.bytes))
                .bind(&piece.name)
                .execute(&mut *step)
                .await?;
        }
        step.commit().await?;
        Ok(true)
    }

    async fn pieces(&self, id: &str) -> Result<Vec<Piece>> {
        let sql = "SELECT start, bytes, name FROM upload_pieces WHERE upload = ?1 ORDER BY start";
        let rows = sqlx::query(sql).bind(id).fetch_all(&self.pool).await?;
        let piece = |row: &SqliteRow| {
            Ok(Piece { start: whole(row, "start")?, bytes: whole(row, "bytes")?, name: row.try_get("name")? })
        };
        rows.iter().map(piece).collect()
    }

    async fn complete_upload(&self, id: &str, sha256: &str) -> Result<bool> {
        let sql = "UPDATE uploads SET sha256 = ?2, holder = NULL WHERE id = ?1";
        Ok(sqlx::query(sql).bind(id).bind(sha256).execute(self.pool()?).await?.rows_affected() > 0)
    }

    async fn remove_upload(&self, id: &str) -> Result<bool> {
        let mut step = self.pool()?.begin_with("BEGIN IMMEDIATE").await?;
        let removed = sqlx::query("DELETE FROM uploads WHERE id = ?1").bind(id).execute(&mut *step).await?;
        sqlx::query("DELETE FROM upload_pieces WHERE upload = ?1").bind(id).execute(&mut *step).await?;
        step.commit().await?;
        Ok(removed.rows_affected() > 0)
    }

    async fn expired_uploads(&self, now: Timestamp) -> Result<Vec<String>> {
        let sql = "SELECT id FROM uploads WHERE expires_at <= ?1 ORDER BY expires_at LIMIT 1000";
        let rows = sqlx::query(sql).bind(now.0).fetch_all(&self.pool).await?;
        rows.iter().map(|row| Ok(row.try_get(0)?)).collect()
    }

    async fn upload_bytes(&self, tenant: Option<&str>) -> Result<UploadBytes> {
        let sql = "SELECT coalesce(sum(length), 0) AS declared, coalesce(sum(received), 0) AS received FROM uploads
                   WHERE ?1 IS NULL OR tenant = ?1";
        let row = sqlx::query(sql).bind(tenant).fetch_one(&self.pool).await?;
        Ok(UploadBytes { declared: whole(&row, "declared")?, received: whole(&row, "received")? })
    }
}

fn whole(row: &SqliteRow, column: &str) -> Result<u64> {
    Ok(row.try_get::<i64, _>(column)?.unsigned_abs())
}

fn upload(row: &SqliteRow) -> Result<Upload> {
    let (id, sha256): (String, Option<String>) = (row.try_get("id")?, row.try_get("sha256")?);
    Ok(Upload {
        reference: format!("{PREFIX}{id}"),
        id,
        filename: row.try_get("filename")?,
        length: whole(row, "length")?,
        offset: whole(row, "received")?,
        complete: sha256.is_some(),
        sha256: match sha256 {
            Some(found) => Some(found),
            None => row.try_get("declared")?,
        },
        created_at: Timestamp(row.try_get("created_at")?),
        expires_at: Timestamp(row.try_get("expires_at")?),
        tenant: row.try_get("tenant")?,
        metadata: row.try_get("metadata")?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn it_keeps_uploads() {
        let root = tempfile::tempdir().unwrap();
        let queue = Sqlite::open(&root.path().join("q")).await.unwrap();
        crate::jobs::resumable::conformance::suite(&queue).await;
    }
}
