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

#[test]
fn uploads_and_results_may_be_kept_elsewhere() {
    let (data, kept) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let store = kept.path().join("store");
    let flags = ["--store", store.to_str().unwrap()];
    let server = Server::start(data.path(), &flags);
    let job = server.wait(&server.accepted(&Form::sample()));
    assert_eq!(job["state"], "succeeded");
    let href = job["artifacts"][0]["href"].as_str().unwrap();
    let whole = bytes(&mut server.get(href, &[]));
    assert_eq!(whole.len() as u64, job["artifacts"][0]["bytes"].as_u64().unwrap());
    assert_eq!(bytes(&mut server.get(href, &[("range", "bytes=3-9")])), whole[3..10]);
    assert!(store.join("objects").is_dir() && store.join("identity").is_file());
    assert!(!data.path().join("objects").exists() && !data.path().join("uploads").exists());
    drop(server);

    // What is damaged is never given as a whole.
    let sha256 = job["artifacts"][0]["sha256"].as_str().unwrap();
    let object = store.join("objects").join(&sha256[..2]).join(sha256);
    let mut damaged = whole.clone();
    damaged[0] ^= 1;
    std::fs::write(&object, damaged).unwrap();
    let server = Server::start(data.path(), &flags);
    // It breaks off in the body, or, where all of it came at once, before the answer was sent.
    assert!(server.read(href).is_err());
    assert_eq!(
        server.delete(job["artifacts"][0]["href"].as_str().unwrap().split("/artifacts").next().unwrap()).status(),
        204
    );
    assert!(!object.exists());
}
