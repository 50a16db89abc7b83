//! Several processes with different work over one data folder.

use serde_json::json;

use crate::server::{Form, PATIENCE, Server, bytes, header, json};

#[test]
fn one_process_takes_jobs_and_others_run_them() {
    let data = tempfile::tempdir().unwrap();
    let api = Server::start(data.path(), &["--role", "api"]);
    let path = api.accepted(&Form::sample());
    let metrics = |server: &Server| String::from_utf8(bytes(&mut server.get("/metrics", &[]))).unwrap();
    std::thread::sleep(std::time::Duration::from_millis(50));
    assert!(!metrics(&api).contains("intarsia_queue_oldest_age_seconds 0\n"), "it waits, and nobody runs it");
    assert_eq!(json(&mut api.get(&path, &[]))["state"], "queued");

    let worker = Server::start(data.path(), &["--role", "worker"]);
    assert_eq!(api.wait(&path)["state"], "succeeded");
    let mut events = api.get(&format!("{path}/events"), &[]);
    assert!(String::from_utf8(bytes(&mut events)).unwrap().contains("event: state"));
    let mut done = api.get(&path, &[("prefer", "wait=30")]);
    assert_eq!(json(&mut done)["state"], "succeeded");
    assert!(metrics(&api).contains("intarsia_queue_oldest_age_seconds 0\n"));
    assert!(metrics(&worker).contains("intarsia_leases_lost_total 0\n"));
    assert_eq!(worker.get(&path, &[]).status(), 404, "a worker takes no jobs and tells of none");
    assert_eq!(json(&mut worker.get("/readyz", &[]))["status"], "ok");
}

#[test]
fn a_worker_that_is_started_as_needed_ends_when_nothing_waits() {
    let data = tempfile::tempdir().unwrap();
    let api = Server::start(data.path(), &["--role", "api"]);
    let paths: Vec<String> = (0..3).map(|_| api.accepted(&Form::sample())).collect();
    Server::start(data.path(), &["--role", "worker", "--exit-when-idle"]).ended(PATIENCE);
    for path in paths {
        let mut job = api.get(&path, &[]);
        assert!(job.headers().get("retry-after").is_none() && json(&mut job)["state"] == json!("succeeded"));
    }
    assert_eq!(header(&api.get("/healthz", &[]), "content-type"), "application/json");
}
