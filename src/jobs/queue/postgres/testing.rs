//! Queues of tests, each in a database of its own.

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use sqlx::{AssertSqlSafe, ConnectOptions};

use super::Postgres;
use crate::config::Secret;
use crate::jobs::testing::{Server, postgres};

/// A server with databases.
pub(in crate::jobs) struct Databases {
    server: Server,
    count: AtomicU32,
}

impl Databases {
    /// Starts it; `None` where it is not wanted or missing.
    pub(in crate::jobs) fn start() -> Option<Self> {
        Some(Databases { server: postgres()?, count: AtomicU32::new(0) })
    }

    /// The URL of a database.
    pub(super) fn url(&self, password: &str, database: &str) -> Secret {
        format!("postgres://intarsia:{password}@{}/{database}", self.server.address).parse().unwrap()
    }

    /// A new database.
    pub(super) async fn create(&self) -> Secret {
        let name = format!("q{}", self.count.fetch_add(1, Ordering::Relaxed));
        let options: sqlx::postgres::PgConnectOptions = self.url("secret", "postgres").text().parse().unwrap();
        let mut connection = loop {
            match options.connect().await {
                Ok(connection) => break connection,
                // It listens a moment before it takes anybody.
                Err(_) => tokio::time::sleep(Duration::from_millis(50)).await,
            }
        };
        sqlx::raw_sql(AssertSqlSafe(format!("CREATE DATABASE {name}"))).execute(&mut connection).await.unwrap();
        self.url("secret", &name)
    }

    /// A new queue.
    pub(in crate::jobs) async fn queue(&self) -> Postgres {
        Postgres::open(&self.create().await).await.unwrap()
    }
}

impl Postgres {
    /// Runs SQL.
    pub(super) async fn run(&self, sql: &str) {
        sqlx::raw_sql(AssertSqlSafe(sql.to_owned())).execute(&self.pool).await.unwrap();
    }

    /// Moves the clock of the queue.
    pub(super) async fn later(&self, by: Duration) {
        let by = by.as_millis();
        self.run(&format!(
            "CREATE OR REPLACE FUNCTION intarsia_now() RETURNS bigint LANGUAGE sql STABLE PARALLEL SAFE
             AS $$ SELECT (extract(epoch FROM clock_timestamp()) * 1000)::bigint + {by} $$"
        ))
        .await;
    }
}
