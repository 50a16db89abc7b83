//! What every backend of the queue must do.

use std::sync::{Arc, Mutex};

use serde_json::json;

use super::*;

const LEASE: Duration = Duration::from_secs(60);
/// The name of no object may be removed.
const UNEXPECTED: Remove<'static> = &|object| panic!("{object} is still needed");

/// Notes what is removed, by its hash.
fn noting(removed: &Mutex<Vec<String>>) -> impl Fn(&str) -> BoxFuture<'static, bool> + Send + Sync {
    |place| {
        let object = place.split('.').next().unwrap_or_default();
        removed.lock().unwrap().push(object.to_owned());
        Box::pin(std::future::ready(true))
    }
}

/// Runs all checks, each on a fresh queue.
pub(in crate::jobs) async fn suite<Q: Queue + 'static>(mut make: impl AsyncFnMut() -> Q) {
    every_job_is_claimed_once_and_in_order(Arc::new(make().await)).await;
    a_worker_that_lost_its_job_changes_nothing(&make().await).await;
    a_job_that_is_handed_back_keeps_its_turn(&make().await).await;
    a_silent_worker_loses_its_job_which_waits_behind_the_others_as_a_suspect(&make().await).await;
    a_job_whose_own_process_dies_is_given_up_at_the_second_time(&make().await).await;
    bytes_are_counted_while_they_are_stored(&make().await).await;
    cancelling_waits_for_nobody_and_wins_over_a_late_result(&make().await).await;
    a_full_queue_takes_no_more_and_old_jobs_expire(&make().await).await;
    a_key_names_one_request(&make().await).await;
    many_requests_of_one_key_make_one_job(Arc::new(make().await)).await;
    large_jobs_wait_for_capacity_but_not_for_ever(&make().await).await;
    objects_live_as_long_as_somebody_needs_them(&make().await).await;
    progress_stages_and_warnings_are_kept(&make().await).await;
    pages_hold_every_job_once(&make().await).await;
    an_equal_job_has_the_result_of_the_first(&make().await).await;
    tenants_see_their_own_jobs(&make().await).await;
    tenants_take_turns_and_small_jobs_come_first(&make().await).await;
    what_has_waited_for_too_long_comes_before_what_is_small(&make().await).await;
    a_tenant_runs_as_many_jobs_as_it_may(&make().await).await;
    every_store_has_an_identity_of_its_own(&make().await, &make().await).await;
}

fn new(id: &str) -> NewJob {
    NewJob { id: id.to_owned(), options: json!({"recipe": "pack", "metadata": {"a": 1}}), ..NewJob::default() }
}

async fn submit(queue: &impl Queue, id: &str) {
    assert_eq!(queue.submit(&new(id), 100).await, Ok(Submitted::New));
}

async fn claim(queue: &impl Queue, owner: &str) -> Option<Claim> {
    queue.claim(owner, LEASE, Capacity::ANY).await.unwrap()
}

fn ended(state: JobState) -> AttemptEnd {
    let progress = Progress { fraction: 1.0, ..Progress::default() };
    let status = AttemptStatus { progress, ..AttemptStatus::default() };
    AttemptEnd { state, error: None, outcome: None, artifacts: Vec::new(), status, timings: Vec::new() }
}

fn entry(sha256: &str) -> ArtifactEntry {
    let text = String::new;
    ArtifactEntry {
        name: "a".into(),
        role: text(),
        media_type: text(),
        bytes: 1,
        sha256: sha256.into(),
        href: None,
        expired: false,
    }
}

async fn every_job_is_claimed_once_and_in_order<Q: Queue + 'static>(queue: Arc<Q>) {
    for n in 0..40 {
        submit(&*queue, &format!("{n:02}")).await;
    }
    let workers = (0..4).map(|w| {
        let queue = queue.clone();
        tokio::spawn(async move {
            let mut mine = Vec::new();
            while let Some(claim) = claim(&*queue, &format!("w{w}")).await {
                mine.push(claim.id);
            }
            mine
        })
    });
    let mut all = Vec::new();
    for worker in workers.collect::<Vec<_>>() {
        let mine = worker.await.unwrap();
        assert!(mine.is_sorted(), "{mine:?}");
        all.extend(mine);
    }
    all.sort();
    assert_eq!(all, (0..40).map(|n| format!("{n:02}")).collect::<Vec<_>>());
    assert_eq!(queue.counts().await, Ok(vec![(JobState::Running, 40)]));
}

async fn a_worker_that_lost_its_job_changes_nothing(queue: &impl Queue) {
    submit(queue, "j").await;
    let stale = claim(queue, "a").await.unwrap();
    assert_eq!(queue.owners().await, Ok(vec!["a".to_owned()]));
    assert_eq!(queue.recover(Some("a"), "me").await.unwrap(), [("j".to_owned(), JobState::Queued)]);
    let fresh = claim(queue, "b").await.unwrap();
    assert_eq!((stale.attempt, fresh.attempt), (1, 2));
    let now = AttemptStatus::default();
    assert_eq!(queue.heartbeat(&stale, LEASE, &now).await, Ok(HeartbeatReply::Lost));
    assert_eq!(queue.reserve(&stale, &["x".into()]).await, Ok(None));
    assert_eq!(queue.finish(&stale, &ended(JobState::Succeeded), LEASE).await, Ok(false));
    assert_eq!(queue.release(&stale, &Progress::default()).await, Ok(false));
    assert_eq!(queue.heartbeat(&fresh, LEASE, &now).await, Ok(HeartbeatReply::Held));
    assert_eq!(queue.finish(&fresh, &ended(JobState::Succeeded), LEASE).await, Ok(true));
    assert_eq!(queue.finish(&fresh, &ended(JobState::Failed), LEASE).await, Ok(false));
    let job = queue.get("j").await.unwrap().unwrap();
    assert_eq!((job.state, job.attempt, job.metadata["a"].as_i64()), (JobState::Succeeded, 2, Some(1)));
}

async fn a_job_that_is_handed_back_keeps_its_turn(queue: &impl Queue) {
    for id in ["a", "b"] {
        submit(queue, id).await;
    }
    let first = claim(queue, "w").await.unwrap();
    let progress = Progress { fraction: 0.5, ..Progress::default() };
    assert_eq!(queue.release(&first, &progress).await, Ok(true));
    let again = claim(queue, "w").await.unwrap();
    assert_eq!((again.id.as_str(), again.attempt, again.floor), ("a", 2, 0.5));
}

async fn a_silent_worker_loses_its_job_which_waits_behind_the_others_as_a_suspect(queue: &impl Queue) {
    for id in ["j", "other"] {
        submit(queue, id).await;
    }
    let first = queue.claim("a", Duration::ZERO, Capacity::ANY).await.unwrap().unwrap();
    assert_eq!((first.id.as_str(), first.suspect), ("j", false));
    tokio::time::sleep(Duration::from_millis(5)).await;
    assert_eq!(queue.recover(None, "a").await.unwrap(), [], "who asks is alive");
    // However often a service dies, no job is given up for it.
    for death in 1..=MAX_DEATHS + 2 {
        assert_eq!(queue.recover(None, "b").await.unwrap(), [("j".to_owned(), JobState::Queued)]);
        if death == 1 {
            let other = claim(queue, "a").await.unwrap();
            assert_eq!((other.id.as_str(), other.suspect), ("other", false));
        }
        let again = queue.claim("a", Duration::ZERO, Capacity::ANY).await.unwrap().unwrap();
        assert_eq!((again.id.as_str(), again.attempt, again.suspect), ("j", death + 1, true));
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

async fn a_job_whose_own_process_dies_is_given_up_at_the_second_time(queue: &impl Queue) {
    submit(queue, "j").await;
    for death in 1..=MAX_DEATHS {
        let claim = claim(queue, "a").await.unwrap();
        assert_eq!((claim.attempt, claim.suspect), (death, death > 1));
        let wanted = if death < MAX_DEATHS { JobState::Queued } else { JobState::Failed };
        assert_eq!(queue.died(&claim).await, Ok(Some(wanted)));
        assert_eq!(queue.died(&claim).await, Ok(None), "each death counts once");
    }
    let job = queue.get("j").await.unwrap().unwrap();
    assert_eq!(job.error.unwrap().code, Code::Internal);
    assert!(claim(queue, "a").await.is_none());
    submit(queue, "k").await;
    let running = claim(queue, "a").await.unwrap();
    queue.cancel("k").await.unwrap();
    assert_eq!(queue.died(&running).await, Ok(Some(JobState::Canceled)));
}

async fn bytes_are_counted_while_they_are_stored(queue: &impl Queue) {
    for id in ["a", "b"] {
        queue.submit(&NewJob { bytes: 10, ..new(id) }, 9).await.unwrap();
    }
    assert_eq!(queue.stored_bytes(None).await, Ok(StoredBytes { uploads: 20, artifacts: 0 }));
    assert!(queue.waits_since().await.unwrap().is_some_and(|since| since <= Timestamp::now()));
    let first = claim(queue, "w").await.unwrap();
    let end = AttemptEnd { artifacts: vec![entry("1"), entry("2")], ..ended(JobState::Succeeded) };
    assert_eq!(queue.finish(&first, &end, Duration::ZERO).await, Ok(true));
    assert_eq!(queue.stored_bytes(None).await, Ok(StoredBytes { uploads: 10, artifacts: 2 }));
    queue.expire_artifacts().await.unwrap();
    assert_eq!(queue.stored_bytes(None).await, Ok(StoredBytes { uploads: 10, artifacts: 0 }));
}

async fn cancelling_waits_for_nobody_and_wins_over_a_late_result(queue: &impl Queue) {
    submit(queue, "runs").await;
    submit(queue, "waits").await;
    let claim = claim(queue, "a").await.unwrap();
    assert_eq!(queue.get("waits").await.unwrap().unwrap().queue_position, Some(1));
    assert_eq!(queue.cancel("waits").await, Ok(CancelReply::AtOnce));
    assert_eq!(queue.cancel("waits").await, Ok(CancelReply::Final));
    assert_eq!(queue.cancel("none").await, Ok(CancelReply::Unknown));
    assert_eq!(queue.cancel("runs").await, Ok(CancelReply::Asked));
    assert_eq!(queue.heartbeat(&claim, LEASE, &AttemptStatus::default()).await, Ok(HeartbeatReply::Cancel));
    assert_eq!(queue.reserve(&claim, &["x".into()]).await, Ok(None));
    assert_eq!(queue.finish(&claim, &ended(JobState::Succeeded), LEASE).await, Ok(false));
    assert_eq!(queue.finish(&claim, &ended(JobState::Canceled), LEASE).await, Ok(true));
}

async fn a_full_queue_takes_no_more_and_old_jobs_expire(queue: &impl Queue) {
    submit(queue, "a").await;
    assert_eq!(queue.submit(&new("b"), 1).await.unwrap_err().code, Code::QueueFull);
    assert_eq!(queue.expire(Timestamp::now().minus(LEASE)).await.unwrap(), []);
    assert_eq!(queue.needs_upload("a").await, Ok(true));
    assert_eq!(queue.expire(Timestamp::now().plus(LEASE)).await.unwrap(), [("a".to_owned(), JobState::Expired)]);
    assert_eq!(queue.needs_upload("a").await, Ok(false));
    assert_eq!(queue.purge(Timestamp::now().plus(LEASE)).await, Ok(1));
    assert!(queue.get("a").await.unwrap().is_none());
    assert_eq!(queue.delete("a").await, Ok(false));
}

async fn a_key_names_one_request(queue: &impl Queue) {
    let keyed = |id: &str, print: &str| NewJob { key: Some(("k".into(), print.into())), ..new(id) };
    assert_eq!(queue.submit(&keyed("a", "1"), 1).await, Ok(Submitted::New));
    // What is known is answered even where nothing more is taken.
    assert_eq!(queue.submit(&keyed("b", "1"), 1).await, Ok(Submitted::Known("a".into())));
    assert_eq!(queue.submit(&keyed("b", "2"), 9).await.unwrap_err().code, Code::IdempotencyMismatch);
    assert!(queue.get("b").await.unwrap().is_none());
    // With its job the key is forgotten.
    assert_eq!(queue.delete("a").await, Ok(true));
    assert_eq!(queue.submit(&keyed("b", "2"), 9).await, Ok(Submitted::New));
}

async fn many_requests_of_one_key_make_one_job<Q: Queue + 'static>(queue: Arc<Q>) {
    let requests: Vec<_> = (0..16)
        .map(|n| {
            let queue = queue.clone();
            tokio::spawn(async move {
                let job = NewJob { key: Some(("k".into(), "f".into())), ..new(&n.to_string()) };
                queue.submit(&job, 100).await.unwrap()
            })
        })
        .collect();
    let mut made = 0;
    for request in requests {
        made += u32::from(request.await.unwrap() == Submitted::New);
    }
    assert_eq!((made, queue.counts().await.unwrap()), (1, vec![(JobState::Queued, 1)]));
}

async fn large_jobs_wait_for_capacity_but_not_for_ever(queue: &impl Queue) {
    for (id, memory) in [("huge", 500), ("large", 80), ("small", 10), ("tiny", 1)] {
        assert_eq!(queue.submit(&NewJob { memory, ..new(id) }, 100).await, Ok(Submitted::New));
    }
    let capacity = Capacity { total: 100, free: 50, most: u64::MAX, patience: LEASE };
    let take = async |capacity| queue.claim("w", LEASE, capacity).await.unwrap().map(|c| (c.id, c.memory));
    assert_eq!(take(capacity).await, Some(("small".into(), 10)));
    // Those that have waited for too long are overtaken no more.
    tokio::time::sleep(Duration::from_millis(5)).await;
    let impatient = Capacity { patience: Duration::ZERO, ..capacity };
    assert_eq!(take(impatient).await, None);
    // A lane for small ones does not wait for the large ones.
    assert_eq!(take(Capacity { free: 100, most: 5, ..impatient }).await, Some(("tiny".into(), 1)));
    // What needs more than there is runs when everything is free.
    assert_eq!(take(Capacity { free: 99, ..impatient }).await, None);
    assert_eq!(take(Capacity { free: 100, ..impatient }).await, Some(("huge".into(), 500)));
    assert_eq!(take(Capacity { free: 80, ..impatient }).await, Some(("large".into(), 80)));
}

async fn objects_live_as_long_as_somebody_needs_them(queue: &impl Queue) {
    for id in ["a", "b"] {
        submit(queue, id).await;
    }
    let removed = Mutex::new(Vec::new());
    let remove = noting(&removed);
    let first = claim(queue, "w").await.unwrap();
    let second = claim(queue, "w").await.unwrap();
    let places = queue.reserve(&first, &["2".into(), "1".into(), "2".into()]).await.unwrap().unwrap();
    let [two, one, again] = &places[..] else { panic!("{places:?}") };
    assert!(two.starts_with('2') && one.starts_with('1') && again == two, "{places:?}");
    assert_eq!(queue.place("2").await.as_ref(), Ok(two));
    assert_eq!(queue.reserve(&second, &["2".into()]).await, Ok(Some(vec![two.clone()])), "both have the same");
    // While attempts run, nothing goes but what nobody asked for.
    queue.collect(None, std::slice::from_ref(one), Duration::ZERO, UNEXPECTED).await.unwrap();
    queue.collect(None, &["3".into()], Duration::ZERO, &remove).await.unwrap();
    assert_eq!(std::mem::take(&mut *removed.lock().unwrap()), ["3"]);
    let outcome = Some(RefinementOutcome::PartlyRefined);
    let end = AttemptEnd { outcome, artifacts: vec![entry("2")], ..ended(JobState::Succeeded) };
    assert_eq!(queue.finish(&second, &end, Duration::ZERO).await, Ok(true));
    queue.collect(None, &[], Duration::ZERO, UNEXPECTED).await.unwrap();
    // An attempt that died leaves what others need.
    assert_eq!(queue.recover(Some("w"), "me").await.unwrap(), [("a".to_owned(), JobState::Queued)]);
    queue.collect(Some("a"), &[], Duration::ZERO, &remove).await.unwrap();
    assert_eq!(std::mem::take(&mut *removed.lock().unwrap()), ["1"]);
    // A result goes when it expires.
    assert_eq!(queue.get("b").await.unwrap().unwrap().outcome, Some(RefinementOutcome::PartlyRefined));
    assert_eq!(queue.expire_artifacts().await, Ok(vec!["b".to_owned()]));
    queue.collect(None, &[], Duration::ZERO, &remove).await.unwrap();
    assert_eq!(*removed.lock().unwrap(), ["2"]);
}

async fn progress_stages_and_warnings_are_kept(queue: &impl Queue) {
    queue.submit(&NewJob { request: Some("r".into()), ..new("j") }, 9).await.unwrap();
    let claim = claim(queue, "w").await.unwrap();
    assert_eq!(claim.request.as_deref(), Some("r"));
    let stage = Progress { fraction: 0.25, stage: "read".into(), ..Progress::default() };
    let now =
        AttemptStatus { progress: stage.clone(), stages: vec![stage], warnings: vec![Warning::new("kept_input", "m")] };
    queue.heartbeat(&claim, LEASE, &now).await.unwrap();
    let job = queue.get("j").await.unwrap().unwrap();
    assert_eq!((job.progress, job.stages, job.warnings), (now.progress, now.stages, now.warnings));
    queue.recover(Some("w"), "me").await.unwrap();
    let job = queue.get("j").await.unwrap().unwrap();
    assert_eq!((job.state, job.progress.fraction), (JobState::Queued, 0.25 + MAX_PROGRESS_LEAD));
}

async fn pages_hold_every_job_once(queue: &impl Queue) {
    for n in 0..5 {
        submit(queue, &n.to_string()).await;
    }
    let (mut seen, mut cursor) = (Vec::new(), None);
    loop {
        let (page, next) =
            queue.list(Listing { state: Some(JobState::Queued), cursor, limit: 2, tenant: None }).await.unwrap();
        seen.extend(page.into_iter().map(|j| j.id));
        let Some(next) = next else { break };
        cursor = Some(next);
    }
    assert_eq!(seen, ["4", "3", "2", "1", "0"]);
    assert_eq!(
        queue.list(Listing { state: Some(JobState::Failed), limit: 9, ..Listing::default() }).await.unwrap().0.len(),
        0
    );
}

async fn an_equal_job_has_the_result_of_the_first(queue: &impl Queue) {
    let equal =
        |tenant: &str, id: &str, key: &str| NewJob { result_key: Some(key.into()), keep: LEASE, ..of(tenant, id, 1) };
    let (removed, none) = (Mutex::new(Vec::new()), Vec::<String>::new());
    let remove = noting(&removed);
    assert_eq!(queue.submit(&equal("a", "first", "k"), 9).await, Ok(Submitted::New));
    assert_eq!(queue.submit(&equal("a", "early", "k"), 9).await, Ok(Submitted::New), "there is no result yet");
    let first = claim(queue, "w").await.unwrap();
    queue.reserve(&first, &["1".into()]).await.unwrap();
    let end = AttemptEnd {
        artifacts: vec![entry("1")],
        outcome: Some(RefinementOutcome::Refined),
        ..ended(JobState::Succeeded)
    };
    assert_eq!(queue.finish(&first, &end, LEASE).await, Ok(true));
    assert_eq!(queue.delete("early").await, Ok(true));

    assert_eq!(queue.submit(&equal("a", "second", "k"), 9).await, Ok(Submitted::Reused));
    assert_eq!(queue.submit(&equal("b", "third", "k"), 9).await, Ok(Submitted::New), "another tenant's");
    assert_eq!(queue.submit(&equal("a", "fourth", "l"), 9).await, Ok(Submitted::New), "another job's");
    let second = queue.get("second").await.unwrap().unwrap();
    assert_eq!(
        (second.state, second.attempt, second.outcome),
        (JobState::Succeeded, 0, Some(RefinementOutcome::Refined))
    );
    assert_eq!(second.artifacts[0].href.as_deref(), Some("/v1/jobs/second/artifacts/a"));
    assert_eq!(second.progress.fraction, 1.0);
    // What both have stays until neither is there.
    assert_eq!(queue.delete("first").await, Ok(true));
    queue.collect(None, &[], Duration::ZERO, UNEXPECTED).await.unwrap();
    assert_eq!(queue.submit(&equal("a", "fifth", "k"), 9).await, Ok(Submitted::Reused), "of the second");
    for id in ["second", "fifth"] {
        assert_eq!(*removed.lock().unwrap(), none);
        assert_eq!(queue.delete(id).await, Ok(true));
        queue.collect(None, &[], Duration::ZERO, &remove).await.unwrap();
    }
    assert_eq!(*removed.lock().unwrap(), ["1"]);
    assert_eq!(queue.submit(&equal("a", "sixth", "k"), 9).await, Ok(Submitted::New), "there is none any more");
}

fn of(tenant: &str, id: &str, memory: u64) -> NewJob {
    NewJob { tenant: tenant.into(), memory, bytes: 1, ..new(id) }
}

async fn tenants_see_their_own_jobs(queue: &impl Queue) {
    let keyed = |tenant: &str, id: &str| NewJob { key: Some(("k".into(), "1".into())), ..of(tenant, id, 1) };
    for (tenant, id) in [("a", "a1"), ("b", "b1"), ("", "n1")] {
        assert_eq!(queue.submit(&keyed(tenant, id), 9).await, Ok(Submitted::New), "a key is its tenant's");
        assert_eq!(queue.submit(&keyed(tenant, "x"), 9).await, Ok(Submitted::Known(id.into())));
        assert_eq!(queue.tenant_of(id).await, Ok(Some(tenant.into())));
    }
    assert_eq!(queue.tenant_of("x").await, Ok(None));
    for (tenant, wanted) in [(Some("a"), &["a1"][..]), (Some("c"), &[]), (None, &["n1", "b1", "a1"])] {
        let (page, _) = queue.list(Listing { tenant, limit: 9, ..Listing::default() }).await.unwrap();
        assert_eq!(page.iter().map(|j| j.id.as_str()).collect::<Vec<_>>(), wanted);
        assert!(page.iter().all(|j| j.queue_position == Some(1)), "the place is among one's own");
        let bytes = queue.stored_bytes(tenant).await.unwrap();
        assert_eq!(bytes.uploads, wanted.len() as u64);
    }
    let third = NewJob { max_queued: Some(1), ..of("a", "a2", 1) };
    assert_eq!(queue.submit(&third, 9).await.unwrap_err().code, Code::QuotaExceeded);
    assert_eq!(queue.submit(&third, 3).await.unwrap_err().code, Code::QueueFull);
    assert_eq!(queue.submit(&NewJob { max_queued: Some(2), ..third }, 9).await, Ok(Submitted::New));
}

async fn tenants_take_turns_and_small_jobs_come_first(queue: &impl Queue) {
    for (tenant, id, memory) in [
        ("a", "a-large", 100),
        ("a", "a-small", 1),
        ("a", "a-mid", 10),
        ("b", "b1", 50),
        ("", "n-large", 9),
        ("", "n-small", 1),
    ] {
        queue.submit(&of(tenant, id, memory), 9).await.unwrap();
    }
    let mut order = Vec::new();
    let patient = Capacity { patience: LEASE, ..Capacity::ANY };
    while let Some(claimed) = queue.claim("w", LEASE, patient).await.unwrap() {
        // Each has its own time, so that who was served last is known.
        tokio::time::sleep(Duration::from_millis(3)).await;
        order.push(claimed.id.clone());
        queue.finish(&claimed, &ended(JobState::Succeeded), LEASE).await.unwrap();
    }
    assert_eq!(order, ["a-small", "b1", "n-large", "a-mid", "n-small", "a-large"]);
}

async fn what_has_waited_for_too_long_comes_before_what_is_small(queue: &impl Queue) {
    queue.submit(&of("a", "large", 100), 9).await.unwrap();
    tokio::time::sleep(Duration::from_millis(30)).await;
    queue.submit(&of("a", "small", 1), 9).await.unwrap();
    let capacity = Capacity { patience: Duration::from_millis(20), ..Capacity::ANY };
    assert_eq!(queue.claim("w", LEASE, capacity).await.unwrap().unwrap().id, "large");
}

async fn a_tenant_runs_as_many_jobs_as_it_may(queue: &impl Queue) {
    for (tenant, id) in [("a", "a1"), ("a", "a2"), ("b", "b1")] {
        queue.submit(&NewJob { max_running: Some(1), ..of(tenant, id, 1) }, 9).await.unwrap();
    }
    let first = claim(queue, "w").await.unwrap();
    let second = claim(queue, "w").await.unwrap();
    assert_eq!((first.id.as_str(), second.id.as_str()), ("a1", "b1"));
    assert!(claim(queue, "w").await.is_none());
    queue.finish(&first, &ended(JobState::Succeeded), LEASE).await.unwrap();
    assert_eq!(claim(queue, "w").await.unwrap().id, "a2");
}

async fn every_store_has_an_identity_of_its_own(queue: &impl Queue, other: &impl Queue) {
    let identity = queue.identity().await.unwrap();
    assert!(identity.len() == 32 && identity.bytes().all(|b| b.is_ascii_hexdigit()), "{identity}");
    assert_eq!(queue.identity().await, Ok(identity.clone()));
    assert_ne!(other.identity().await, Ok(identity));
}
