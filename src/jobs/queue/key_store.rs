//! API keys, beside the queue in its database. SQLite and PostgreSQL read these statements alike.

/// Makes a backend of the queue a [`KeyStore`](crate::jobs::keys::KeyStore). It has `reader()` and `writer()`, its connections, `begin()`, a
/// transaction that writes, and `step()`, in which a step runs.
macro_rules! key_store {
    ($backend:ident) => {
        mod key_store {
            use async_trait::async_trait;

            use crate::error::Result;
            use crate::jobs::keys::{Key, KeyStore};
            use crate::jobs::queue::Queue;
            use crate::jobs::queue::rows::{json, key};

            #[async_trait]
            impl KeyStore for super::$backend {
                    async fn add_key(&self, key: &Key, hash: &str) -> Result<()> {
                        self.step(async move {
                            sqlx::query(
                                "INSERT INTO keys (id, hash, name, tenant, scopes, quotas, created_at) VALUES ($1, $2, $3, $4, $5, $6, $7)",
                            )
                            .bind(&key.id)
                            .bind(hash)
                            .bind(&key.name)
                            .bind(&key.tenant)
                            .bind(json(&key.scopes)?)
                            .bind(json(&key.quotas)?)
                            .bind(key.created_at.0)
                            .execute(self.writer()?)
                            .await?;
                            Ok(())
                        }).await
                    }

                    async fn key_of(&self, hash: &str) -> Result<Option<Key>> {
                        self.step(async move {
                            let sql = "SELECT * FROM keys WHERE hash = $1 AND revoked_at IS NULL";
                            let row = sqlx::query(sql).bind(hash).fetch_optional(self.reader()).await?;
                            row.as_ref().map(key).transpose()
                        }).await
                    }

                    async fn keys(&self) -> Result<Vec<Key>> {
                        self.step(async move {
                            let rows = sqlx::query("SELECT * FROM keys ORDER BY created_at DESC, id").fetch_all(self.reader()).await?;
                            rows.iter().map(key).collect()
                        }).await
                    }

                    async fn revoke_key(&self, id: &str) -> Result<bool> {
                        self.step(async move {
                            let now = Queue::now(self).await?;
                            let done = sqlx::query("UPDATE keys SET revoked_at = $2 WHERE id = $1 AND revoked_at IS NULL")
                                .bind(id)
                                .bind(now.0)
                                .execute(self.writer()?)
                                .await?;
                            Ok(done.rows_affected() > 0)
                        }).await
                    }
            }
        }
    };
}

pub(super) use key_store;
