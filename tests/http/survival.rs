//! What happens when processes die, stand still or are told to stop.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::server::{Form, PATIENCE, Server, artifact, json, left};

fn number(server: &Server, state: &str) -> usize {
    let page = json(&mut server.get(&format!("/v1/jobs?limit=200&state={state}"), &[]));
    page["jobs"].as_array().unwrap().len()
}

fn running(job: &Value) -> bool {
    job["state"] == "running"
}

#[test]
fn jobs_survive_the_death_of_the_process_and_leave_nothing_else() {
    let data = tempfile::tempdir().unwrap();
    let start = || Server::start(data.path(), &["--list-jobs"]);
    let mut server = start();
    let paths: Vec<String> = (0..40).map(|_| server.accepted(&Form::sample())).collect();
    for _ in 0..2 {
        // While at least one runs, and many wait: what died with the process waits behind them.
        let started = Instant::now();
        let before = number(&server, "succeeded");
        while number(&server, "succeeded") < before + 3 || number(&server, "running") == 0 {
            assert!(started.elapsed() < PATIENCE);
        }
        assert!(number(&server, "queued") >= 10);
        server.kill();
        server = start();
    }
    let mut objects = BTreeSet::new();
    for path in &paths {
        let job = server.wait(path);
        assert_eq!(job["state"], "succeeded", "{job:#}");
        assert!(job["attempt"].as_u64().unwrap() <= 2, "{job:#}");
        let href = artifact(&job, "model.glb")["href"].as_str().unwrap();
        assert_eq!(server.get(href, &[]).status(), 200);
        objects.extend(job["artifacts"].as_array().unwrap().iter().map(|a| a["sha256"].as_str().unwrap().to_owned()));
    }
    assert_eq!(left(data.path()), objects.into_iter().collect::<Vec<_>>(), "no file that no job owns");
}

#[test]
fn a_running_job_is_cancelled_within_a_second() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let path = server.accepted(&Form::long());
    server.until(&path, |job| running(job) && job["progress"]["stage"] == "defrag");
    let started = Instant::now();
    assert_eq!(server.post(&format!("{path}/cancel"), "application/json", b"").status(), 202);
    let job = server.wait(&path);
    assert!(started.elapsed() < Duration::from_secs(1), "{:?}", started.elapsed());
    assert_eq!((&job["state"], &job["error"]["code"]), (&json!("canceled"), &json!("canceled")));
    assert_eq!(left(data.path()), [] as [String; 0]);
}

#[cfg(unix)]
#[test]
fn a_worker_that_stands_still_loses_its_job_and_its_late_result() {
    let data = tempfile::tempdir().unwrap();
    let first = Server::start_with_log(data.path(), &["--lease", "1s", "--log-level", "warn", "--log-format", "json"]);
    let path = first.accepted(&Form::long());
    first.until(&path, running);
    first.signal("-STOP");
    // Its lease runs out, while its process is still there.
    std::thread::sleep(Duration::from_millis(1200));
    let second = Server::start(data.path(), &["--lease", "1s"]);
    let job = second.wait(&path);
    assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(2)), "{job:#}");
    first.signal("-CONT");
    let late = |line: &Value| line["fields"]["message"].as_str().is_some_and(|m| m.contains("does not count"));
    let started = Instant::now();
    while !first.log().iter().any(late) {
        assert!(started.elapsed() < PATIENCE, "the late job does not end");
        std::thread::sleep(Duration::from_millis(20));
    }
    let after = json(&mut first.get(&path, &[]));
    assert_eq!((&after["attempt"], &after["artifacts"]), (&job["attempt"], &job["artifacts"]), "published once");
    assert_eq!(second.get(artifact(&job, "model.glb")["href"].as_str().unwrap(), &[]).status(), 200);
}

#[cfg(unix)]
#[test]
fn a_service_that_is_told_to_stop_hands_its_job_back() {
    let data = tempfile::tempdir().unwrap();
    let first = Server::start(data.path(), &["--grace", "100ms"]);
    let path = first.accepted(&Form::long());
    first.until(&path, running);
    first.signal("-TERM");
    first.ended(Duration::from_secs(8));
    let second = Server::start(data.path(), &[]);
    let job = second.wait(&path);
    assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(2)), "{job:#}");
}

#[test]
fn jobs_run_beside_each_other_and_small_ones_do_not_wait_for_large_ones() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--jobs", "2", "--list-jobs"]);
    let large: Vec<String> = (0..3).map(|_| server.accepted(&Form::long())).collect();
    server.until(&large[0], running);
    let small = server.wait(&server.accepted(&Form::sample()));
    assert_eq!(small["state"], "succeeded");
    assert_eq!((number(&server, "running"), number(&server, "queued")), (1, 2), "the others had no part in it");
    large.iter().for_each(|path| drop(server.delete(path)));
}

#[test]
fn what_needs_more_memory_than_there_is_is_refused() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--memory", "200MB"]);
    assert_eq!(json(&mut server.get("/v1/limits", &[]))["memory_bytes"], 200_000_000);
    let mut refused = server.submit(&Form::long());
    assert_eq!((refused.status().as_u16(), &json(&mut refused)["code"]), (413, &json!("too_large")));
    assert_eq!(left(data.path()), [] as [String; 0]);
    assert_eq!(server.wait(&server.accepted(&Form::sample()))["state"], "succeeded");
}
