//! API keys, beside the queue in its database.

use async_trait::async_trait;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::Sqlite;
use super::rows::{json, parsed};
use crate::error::Result;
use crate::jobs::keys::{Key, KeyStore};
use crate::jobs::record::Timestamp;

#[async_trait]
impl KeyStore for Sqlite {
    async fn add_key(&self, key: &Key, hash: &str) -> Result<()> {
        sqlx::query(
            "INSERT INTO keys (id, hash, name, tenant, scopes, quotas, created_at) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)",
        )
        .bind(&key.id)
        .bind(hash)
        .bind(&key.name)
        .bind(&key.tenant)
        .bind(json(&key.scopes)?)
        .bind(json(&key.quotas)?)
        .bind(key.created_at.0)
        .execute(self.pool()?)
        .await?;
        Ok(())
    }

    async fn key_of(&self, hash: &str) -> Result<Option<Key>> {
        let sql = "SELECT * FROM keys WHERE hash = ?1 AND revoked_at IS NULL";
        let row = sqlx::query(sql).bind(hash).fetch_optional(&self.pool).await?;
        row.as_ref().map(key).transpose()
    }

    async fn keys(&self) -> Result<Vec<Key>> {
        let rows = sqlx::query("SELECT * FROM keys ORDER BY created_at DESC, id").fetch_all(&self.pool).await?;
        rows.iter().map(key).collect()
    }

    async fn revoke_key(&self, id: &str) -> Result<bool> {
        let done = sqlx::query("UPDATE keys SET revoked_at = ?2 WHERE id = ?1 AND revoked_at IS NULL")
            .bind(id)
            .bind(Timestamp::now().0)
            .execute(self.pool()?)
            .await?;
        Ok(done.rows_affected() > 0)
    }
}

fn key(row: &SqliteRow) -> Result<Key> {
    Ok(Key {
        id: row.try_get("id")?,
        name: row.try_get("name")?,
        tenant: row.try_get("tenant")?,
        scopes: parsed(row, "scopes")?,
        quotas: parsed(row, "quotas")?,
        created_at: Timestamp(row.try_get("created_at")?),
        revoked_at: row.try_get::<Option<i64>, _>("revoked_at")?.map(Timestamp),
    })
}
