//! What happens when processes die, stand still or are told to stop.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::server::{Form, Server, artifact, header, json, left};

/// A scan that takes some seconds.
fn long() -> Form {
    let scan = intarsia::asset::sample::sample("scan_10000").unwrap();
    Form::default().file("model", "scan.glb", &scan).text("options", r#"{"recipe": "scan"}"#)
}

fn running(job: &Value) -> bool {
    job["state"] == "running"
}

#[test]
fn jobs_survive_the_death_of_the_process_and_leave_nothing_else() {
    let data = tempfile::tempdir().unwrap();
    let mut server = Server::start(data.path(), &[]);
    let paths: Vec<String> = (0..24).map(|_| server.accepted(&Form::sample())).collect();
    for done in [2, 6] {
        // While at least one runs, and others wait.
        server.wait(&paths[done]);
        server.kill();
        server = Server::start(data.path(), &[]);
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
    let path = server.accepted(&long());
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
    let first = Server::start(data.path(), &["--lease", "1s"]);
    let path = first.accepted(&long());
    first.until(&path, running);
    first.signal("-STOP");
    // Its lease runs out, while its process is still there.
    std::thread::sleep(Duration::from_millis(1200));
    let second = Server::start(data.path(), &["--lease", "1s"]);
    let job = second.wait(&path);
    assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(2)), "{job:#}");
    first.signal("-CONT");
    std::thread::sleep(Duration::from_secs(3));
    let after = json(&mut first.get(&path, &[]));
    assert_eq!((&after["attempt"], &after["artifacts"]), (&job["attempt"], &job["artifacts"]), "published once");
    assert_eq!(second.get(artifact(&job, "model.glb")["href"].as_str().unwrap(), &[]).status(), 200);
}

#[cfg(unix)]
#[test]
fn a_service_that_is_told_to_stop_hands_its_job_back() {
    let data = tempfile::tempdir().unwrap();
    let first = Server::start(data.path(), &["--grace", "100ms"]);
    let path = first.accepted(&long());
    first.until(&path, running);
    first.signal("-TERM");
    first.ended(Duration::from_secs(8));
    let second = Server::start(data.path(), &[]);
    let job = second.wait(&path);
    assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(2)), "{job:#}");
}

#[test]
fn small_jobs_do_not_wait_for_large_ones() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--memory", "64MB"]);
    let limits = json(&mut server.get("/v1/limits", &[]));
    assert_eq!(limits["memory_bytes"], 64_000_000);
    let response = server.submit(&Form::sample());
    let job = server.wait(header(&response, "location"));
    assert_eq!(job["state"], "succeeded");
}
