//! On Debian's PostgreSQL, which the tests start: see `jobs::testing`.

use std::sync::{Arc, Mutex};
use std::time::Instant;

use futures_util::future::BoxFuture;
use serde_json::json;

use super::testing::Databases;
use super::*;
use crate::jobs::queue::conformance;
use crate::jobs::{batches, keys, resumable};

const LEASE: Duration = Duration::from_secs(60);

fn new(id: &str) -> NewJob {
    NewJob { id: id.to_owned(), options: json!({}), ..NewJob::default() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn it_conforms() {
    let Some(databases) = Databases::start() else { return };
    conformance::suite(async || databases.queue().await).await;
    keys::conformance::suite(&databases.queue().await).await;
    batches::conformance::suite(&databases.queue().await).await;
    resumable::conformance::suite(&databases.queue().await).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn its_own_promises_hold() {
    let Some(databases) = Databases::start() else { return };
    it_is_opened_again_and_tells_no_password(&databases).await;
    only_its_own_clock_counts(&databases.queue().await).await;
    objects_go_when_they_have_been_marked_for_long_enough(&databases.queue().await).await;
    a_name_that_is_being_removed_is_given_to_nobody(&databases.queue().await).await;
    a_tenant_runs_no_more_than_it_may_whoever_claims_at_the_same_time(Arc::new(databases.queue().await)).await;
    a_claim_whose_answer_was_lost_is_taken_back(&databases.queue().await).await;
    processes_tell_each_other(&databases).await;
    outcomes_are_told_in_json(&databases.queue().await).await;
}

async fn it_is_opened_again_and_tells_no_password(databases: &Databases) {
    let url = databases.create().await;
    let (first, others) = (
        Postgres::open(&url).await.unwrap(),
        futures_util::future::join_all([Postgres::open(&url), Postgres::open(&url)]).await,
    );
    assert!(first.is_fresh() && first.check(true).await.is_ok());
    for other in others {
        let other = other.unwrap();
        assert!(!other.is_fresh() && other.identity().await == first.identity().await);
    }
    for (wrong, says) in [
        (databases.url("wr0ng-pass", "postgres"), "refuses the user or the password"),
        (databases.url("secret", "none"), "no database of the name"),
        ("postgres://intarsia:wr0ng-pass@127.0.0.1:1/x".parse().unwrap(), "cannot be reached"),
        ("postgres://intarsia:wr0ng-pass@[/x".parse().unwrap(), "is no URL"),
    ] {
        let Err(failure) = Postgres::open(&wrong).await else { panic!("{says}") };
        assert!(failure.message.contains(says) && !failure.message.contains("wr0ng-pass"), "{failure}");
        assert!(!format!("{wrong:?}").contains("wr0ng-pass"));
    }
    // A newer version's stays as it is.
    first.run("UPDATE schema_version SET version = 999").await;
    let Err(failure) = Postgres::open(&url).await else { panic!("it was made by a newer version") };
    assert!(failure.message.contains("newer version"), "{failure}");
}

async fn only_its_own_clock_counts(queue: &Postgres) {
    for id in ["runs", "waits"] {
        queue.submit(&new(id), 9).await.unwrap();
    }
    let claim = queue.claim("a", LEASE, Capacity::ANY).await.unwrap().unwrap();
    queue.heartbeat(&claim, LEASE, &AttemptStatus::default()).await.unwrap();
    assert_eq!(queue.recover(None, "b").await.unwrap(), []);
    queue.later(LEASE - Duration::from_secs(2)).await;
    assert_eq!(queue.recover(None, "b").await.unwrap(), []);
    queue.later(LEASE + Duration::from_secs(1)).await;
    assert_eq!(queue.recover(None, "a").await.unwrap(), [], "who asks is alive");
    assert_eq!(queue.recover(None, "b").await.unwrap(), [("runs".to_owned(), JobState::Queued)]);
    assert_eq!(queue.heartbeat(&claim, LEASE, &AttemptStatus::default()).await, Ok(HeartbeatReply::Lost));
    let now = queue.now().await.unwrap();
    assert!(now.0 - Timestamp::now().0 > 59_000, "{now}");
    assert_eq!(queue.get("runs").await.unwrap().unwrap().queue_position, Some(2), "behind all that wait");
}

/// Notes what is removed.
fn noting(removed: &Mutex<Vec<String>>) -> impl Fn(&str) -> BoxFuture<'static, bool> + Send + Sync {
    |place| {
        removed.lock().unwrap().push(place.to_owned());
        Box::pin(std::future::ready(true))
    }
}

/// Claims the next job, reserves `object` for it and gives it up.
async fn abandoned(queue: &Postgres, id: &str, object: &str) -> String {
    queue.submit(&new(id), 99).await.unwrap();
    let claim = queue.claim("w", LEASE, Capacity::ANY).await.unwrap().unwrap();
    let places = queue.reserve(&claim, &[object.to_owned()]).await.unwrap().unwrap();
    assert!(queue.delete(id).await.unwrap());
    places.into_iter().next().unwrap()
}

async fn objects_go_when_they_have_been_marked_for_long_enough(queue: &Postgres) {
    let removed = Mutex::new(Vec::new());
    let remove = noting(&removed);
    let place = abandoned(queue, "a", "1").await;
    let collect = async || queue.collect(None, &["stranger".to_owned()], LEASE, &remove).await.unwrap();
    collect().await;
    queue.later(LEASE / 2).await;
    assert_eq!(abandoned(queue, "b", "1").await, place, "who reserves it revives it");
    queue.later(LEASE + Duration::from_secs(1)).await;
    queue.submit(&new("c"), 9).await.unwrap();
    let claim = queue.claim("w", LEASE, Capacity::ANY).await.unwrap().unwrap();
    assert_eq!(queue.reserve(&claim, &["1".into()]).await, Ok(Some(vec![place.clone()])));
    collect().await;
    assert_eq!(std::mem::take(&mut *removed.lock().unwrap()), ["stranger"]);
    assert!(queue.delete("c").await.unwrap());
    queue.collect(Some("c"), &[], LEASE, &remove).await.unwrap();
    queue.later(LEASE * 2).await;
    assert_eq!(*removed.lock().unwrap(), Vec::<String>::new(), "marked only now");
    queue.later(LEASE * 3).await;
    queue.collect(Some(""), &[], LEASE, &remove).await.unwrap();
    assert_eq!(*removed.lock().unwrap(), [place]);
}

async fn a_name_that_is_being_removed_is_given_to_nobody(queue: &Postgres) {
    let place = abandoned(queue, "a", "1").await;
    // The store fails: it is tried again.
    let fails = |_: &str| -> BoxFuture<'static, bool> { Box::pin(std::future::ready(false)) };
    queue.collect(None, &[], Duration::ZERO, &fails).await.unwrap();
    // Meanwhile somebody needs the object.
    queue.submit(&new("b"), 9).await.unwrap();
    let claim = queue.claim("w", LEASE, Capacity::ANY).await.unwrap().unwrap();
    let again = queue.reserve(&claim, &["1".into()]).await.unwrap().unwrap();
    assert!(again[0] != place && queue.place("1").await.as_ref() == Ok(&again[0]), "{again:?}");
    let removed = Mutex::new(Vec::new());
    queue.collect(None, &again, Duration::ZERO, &noting(&removed)).await.unwrap();
    assert_eq!(*removed.lock().unwrap(), [place]);
}

async fn a_tenant_runs_no_more_than_it_may_whoever_claims_at_the_same_time(queue: Arc<Postgres>) {
    for n in 0..60 {
        let job = NewJob { tenant: "a".into(), max_running: Some(2), ..new(&n.to_string()) };
        queue.submit(&job, 99).await.unwrap();
    }
    let (running, most) = (Arc::new(Mutex::new(0)), Arc::new(Mutex::new(0)));
    let workers = (0..8).map(|w| {
        let (queue, running, most) = (queue.clone(), running.clone(), most.clone());
        tokio::spawn(async move {
            let mut done = 0;
            loop {
                let Some(claim) = queue.claim(&format!("w{w}"), LEASE, Capacity::ANY).await.unwrap() else {
                    if queue.waiting().await.unwrap() == 0 {
                        return done;
                    }
                    tokio::time::sleep(Duration::from_millis(5)).await;
                    continue;
                };
                {
                    let (mut running, mut most) = (running.lock().unwrap(), most.lock().unwrap());
                    *running += 1;
                    *most = (*most).max(*running);
                }
                tokio::time::sleep(Duration::from_millis(2)).await;
                *running.lock().unwrap() -= 1;
                assert!(queue.finish(&claim, &ended(), LEASE).await.unwrap());
                done += 1;
            }
        })
    });
    let mut done = 0;
    for worker in workers.collect::<Vec<_>>() {
        done += worker.await.unwrap();
    }
    assert_eq!((done, *most.lock().unwrap()), (60, 2));
}

fn ended() -> AttemptEnd {
    let status = AttemptStatus::default();
    let state = JobState::Succeeded;
    AttemptEnd { state, error: None, outcome: None, artifacts: Vec::new(), status, timings: Vec::new() }
}

async fn a_claim_whose_answer_was_lost_is_taken_back(queue: &Postgres) {
    queue.submit(&new("j"), 9).await.unwrap();
    queue.claim("me", LEASE, Capacity::ANY).await.unwrap().unwrap();
    queue.later(LEASE + Duration::from_secs(59)).await;
    assert_eq!(queue.recover(None, "me").await.unwrap(), []);
    queue.later(LEASE + Duration::from_secs(62)).await;
    assert_eq!(queue.recover(None, "me").await.unwrap(), [("j".to_owned(), JobState::Queued)]);
}

async fn processes_tell_each_other(databases: &Databases) {
    let url = databases.create().await;
    let (one, other) = (Postgres::open(&url).await.unwrap(), Postgres::open(&url).await.unwrap());
    let heard = async { timeout(Duration::from_secs(20), other.hint()).await.unwrap() };
    let submitted = async {
        // Until the other listens.
        for n in 0.. {
            one.submit(&new(&n.to_string()), 999).await.unwrap();
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::select! {
        hint = heard => assert_eq!(hint, Hint::Queued),
        () = submitted => {}
    }
    one.cancel("0").await.unwrap();
    let changed = async { while other.hint().await != Hint::Changed("0".into()) {} };
    timeout(Duration::from_secs(20), changed).await.unwrap();
}

async fn outcomes_are_told_in_json(queue: &Postgres) {
    let options = json!({"metadata": {"nul": "\u{0}", "n": 1.0e-7}, "webhook": "http://x/"});
    queue.submit(&NewJob { options: options.clone(), ..new("j") }, 9).await.unwrap();
    let claim = queue.claim("w", LEASE, Capacity::ANY).await.unwrap().unwrap();
    assert_eq!(claim.options, options);
    assert!(queue.finish(&claim, &ended(), LEASE).await.unwrap());
    let told = sqlx::query("SELECT payload, url, created_at FROM deliveries").fetch_one(&queue.pool).await.unwrap();
    let payload: serde_json::Value = told.parsed("payload").unwrap();
    let at = Timestamp(told.integer("created_at").unwrap());
    let wanted = json!({"type": "job.succeeded", "timestamp": payload["timestamp"],
        "data": {"id": "j", "state": "succeeded", "outcome": null, "error": null, "metadata": options["metadata"]}});
    assert_eq!((payload.clone(), told.text("url").unwrap()), (wanted, "http://x/".to_owned()));
    let timestamp = payload["timestamp"].as_str().unwrap();
    let parsed = time::OffsetDateTime::parse(timestamp, &time::format_description::well_known::Rfc3339).unwrap();
    assert_eq!(i128::from(at.0), parsed.unix_timestamp_nanos() / 1_000_000);
}

/// Figures for the notes: `INTARSIA_TEST_SERVERS=1 cargo test --lib figures_of_the_queue -- --ignored --nocapture`.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[ignore = "takes minutes, and asserts nothing about time"]
async fn figures_of_the_queue() {
    let Some(databases) = Databases::start() else { return };
    let queue = Arc::new(databases.queue().await);
    let insert = |state: &str, count: u32| {
        format!(
            "INSERT INTO jobs (id, state, memory, created_at, queued_at, started_at, finished_at, options, inputs, progress, tenant, attempt)
             SELECT md5('{state}' || n), '{state}', n % 1000, intarsia_now(), intarsia_now(), intarsia_now(),
               CASE WHEN '{state}' = 'queued' THEN NULL ELSE intarsia_now() END, '{{}}', '{{\"models\":[],\"files\":[]}}', '{{}}',
               't' || n % 10, 1 FROM generate_series(1, {count}) n; ANALYZE jobs"
        )
    };
    let claims = async |what: &str| {
        let mut took = Vec::new();
        for _ in 0..500 {
            let start = Instant::now();
            let claim = queue.claim("w", LEASE, Capacity::ANY).await.unwrap().unwrap();
            took.push(start.elapsed().as_secs_f64() * 1e3);
            queue.finish(&claim, &ended(), LEASE).await.unwrap();
        }
        took.sort_by(f64::total_cmp);
        println!("claim, {what}: median {:.2} ms, 95 % {:.2} ms, most {:.2} ms", took[250], took[475], took[499]);
    };
    for n in 0..500 {
        queue.submit(&new(&format!("few{n}")), 999).await.unwrap();
    }
    claims("500 waiting").await;
    queue.run(&format!("SET statement_timeout = 0; {}", insert("queued", 100_000))).await;
    claims("100,000 waiting").await;
    for _ in 0..4 {
        let sql = insert("succeeded", 250_000).replace("md5('succeeded' || n)", "md5(random()::text || n)");
        sqlx::raw_sql(AssertSqlSafe(format!("SET statement_timeout = 0; {sql}"))).execute(&queue.pool).await.unwrap();
    }
    claims("100,000 waiting, a million finished").await;
    let start = Instant::now();
    let polls = (0..8).map(|_| {
        let queue = queue.clone();
        tokio::spawn(async move {
            for n in 0..1000 {
                queue.get(&format!("few{}", n % 500)).await.unwrap().unwrap();
            }
        })
    });
    futures_util::future::join_all(polls.collect::<Vec<_>>()).await;
    println!("reads of jobs: {:.0} a second", 8000.0 / start.elapsed().as_secs_f64());

    let queue = Arc::new(databases.queue().await);
    let (jobs, start) = (4000, Instant::now());
    let submitters = (0..2).map(|s| {
        let queue = queue.clone();
        tokio::spawn(async move {
            for n in 0..jobs / 2 {
                queue.submit(&new(&format!("{s}.{n}")), 100_000).await.unwrap();
            }
            0
        })
    });
    let workers = (0..4).map(|w| {
        let queue = queue.clone();
        tokio::spawn(async move {
            let (mut done, mut idle) = (0, 0);
            while idle < 100 {
                match queue.claim(&format!("w{w}"), LEASE, Capacity::ANY).await.unwrap() {
                    Some(claim) => {
                        queue.heartbeat(&claim, LEASE, &AttemptStatus::default()).await.unwrap();
                        queue.finish(&claim, &ended(), LEASE).await.unwrap();
                        (done, idle) = (done + 1, 0);
                    }
                    None => {
                        idle += 1;
                        tokio::time::sleep(Duration::from_millis(2)).await;
                    }
                }
            }
            done
        })
    });
    let all: Vec<_> = submitters.chain(workers.collect::<Vec<_>>()).collect();
    let mut done = 0;
    for part in all {
        done += part.await.unwrap();
    }
    let seconds = start.elapsed().as_secs_f64() - 0.2;
    assert_eq!(done, jobs, "each once");
    println!("empty jobs: {:.0} a second with 4 workers and 2 submitters", f64::from(jobs) / seconds);
}
