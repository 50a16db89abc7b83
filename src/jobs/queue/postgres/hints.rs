//! What processes tell each other by `NOTIFY`, so that none has to wait for its next look. A notification takes a lock of the whole
//! database server while its transaction commits, and is lost while nobody listens: they are gathered, sent apart from what they are about,
//! and nothing depends on them.

use std::collections::BTreeSet;
use std::time::Duration;

use sqlx::postgres::{PgListener, PgPool};
use tokio::sync::{Mutex, mpsc};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

use crate::jobs::queue::Hint;

/// The channel of the notifications.
const CHANNEL: &str = "intarsia_jobs";
/// What is told of a job that waits; everything else is the id of a job.
const QUEUED: &str = "queued";
/// How long hints are gathered.
const GATHER: Duration = Duration::from_millis(20);
/// Hints in one notification, which has at most 8,000 bytes.
const AT_ONCE: usize = 200;
/// Hints that may wait; further ones are dropped.
const MOST: usize = 4096;
/// How long to wait after the connection broke off.
const BACKOFF: Duration = Duration::from_secs(1);

/// Hints of this process to others and of others to this one.
pub(super) struct Hints {
    outgoing: mpsc::Sender<Hint>,
    incoming: Mutex<mpsc::Receiver<Hint>>,
    tasks: [JoinHandle<()>; 2],
}

impl Hints {
    /// Sends and listens from now on.
    pub(super) fn new(pool: PgPool) -> Self {
        let ((outgoing, to_send), (received, incoming)) = (mpsc::channel(MOST), mpsc::channel(MOST));
        let tasks = [tokio::spawn(send_all(pool.clone(), to_send)), tokio::spawn(listen(pool, received))];
        Hints { outgoing, incoming: Mutex::new(incoming), tasks }
    }

    /// Tells other processes, soon.
    pub(super) fn send(&self, hint: Hint) {
        let _ = self.outgoing.try_send(hint);
    }

    /// What another process, or this one, has told.
    pub(super) async fn next(&self) -> Hint {
        match self.incoming.lock().await.recv().await {
            Some(hint) => hint,
            None => std::future::pending().await,
        }
    }
}

impl Drop for Hints {
    fn drop(&mut self) {
        self.tasks.iter().for_each(JoinHandle::abort);
    }
}

async fn send_all(pool: PgPool, mut hints: mpsc::Receiver<Hint>) {
    while let Some(first) = hints.recv().await {
        sleep(GATHER).await;
        let mut words = BTreeSet::from([word(first)]);
        while words.len() < AT_ONCE
            && let Ok(hint) = hints.try_recv()
        {
            words.insert(word(hint));
        }
        let payload = words.into_iter().collect::<Vec<_>>().join(" ");
        let told = sqlx::query("SELECT pg_notify($1, $2)").bind(CHANNEL).bind(payload).execute(&pool);
        let _ = timeout(super::PATIENCE, told).await;
    }
}

fn word(hint: Hint) -> String {
    match hint {
        Hint::Queued => QUEUED.to_owned(),
        Hint::Changed(job) => job,
    }
}

async fn listen(pool: PgPool, hints: mpsc::Sender<Hint>) {
    loop {
        // A connection of its own, not one of the pool's few.
        let options = pool.connect_options();
        let own = sqlx::postgres::PgPoolOptions::new().max_connections(1).connect_lazy_with((*options).clone());
        if let Ok(mut listener) = PgListener::connect_with(&own).await
            && listener.listen(CHANNEL).await.is_ok()
        {
            while let Ok(told) = listener.recv().await {
                for word in told.payload().split(' ') {
                    let hint = if word == QUEUED { Hint::Queued } else { Hint::Changed(word.to_owned()) };
                    let _ = hints.try_send(hint);
                }
            }
        }
        sleep(BACKOFF).await;
    }
}
