//! Waiting for a job, and asking twice for the same.

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::server::{Form, Server, artifact, bytes, header, json};

#[test]
fn an_answer_waits_for_the_end_where_that_is_preferred() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let mut response = server.submit_with(&Form::sample(), &[("prefer", "wait=30")]);
    assert_eq!((response.status().as_u16(), header(&response, "preference-applied")), (200, "wait=30"));
    let path = header(&response, "location").to_owned();
    assert!(response.headers().get("retry-after").is_none());
    assert_eq!(json(&mut response)["state"], "succeeded");
    // Nothing to wait for any more.
    let started = Instant::now();
    let mut response = server.get(&path, &[("prefer", "wait=30")]);
    assert_eq!(json(&mut response)["state"], "succeeded");
    assert!(started.elapsed() < Duration::from_secs(5));
    // Not long enough.
    let response = server.submit_with(&Form::sample(), &[("prefer", "wait=0")]);
    assert_eq!((response.status().as_u16(), header(&response, "retry-after")), (202, "1"));
}

#[test]
fn a_request_sent_again_under_its_key_is_not_done_again() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let key = [("idempotency-key", "build-17")];
    let mut first = server.submit_with(&Form::sample(), &key);
    assert!(first.headers().get("idempotency-replayed").is_none());
    let mut again = server.submit_with(&Form::sample(), &key);
    assert_eq!(header(&again, "idempotency-replayed"), "true");
    assert!([200, 202].contains(&again.status().as_u16()));
    assert_eq!(header(&first, "location"), header(&again, "location"));
    assert_eq!(json(&mut first)["id"], json(&mut again)["id"]);
    for other in [Form::sample().text("options", r#"{"seed": 1}"#), Form::sample().file("files", "a.png", b"x")] {
        let mut refused = server.submit_with(&other, &key);
        assert_eq!((refused.status().as_u16(), &json(&mut refused)["code"]), (422, &json!("idempotency_mismatch")));
    }
    // What has ended need not be asked for again.
    server.wait(header(&first, "location"));
    let done = server.submit_with(&Form::sample(), &key);
    assert_eq!((done.status().as_u16(), header(&done, "idempotency-replayed")), (200, "true"));
    assert!(done.headers().get("retry-after").is_none());
    let other = server.submit_with(&Form::sample(), &[("idempotency-key", "build-18")]);
    assert_ne!(header(&other, "location"), header(&first, "location"));
    let long = "k".repeat(256);
    assert_eq!(server.submit_with(&Form::sample(), &[("idempotency-key", &long)]).status(), 400);
}

#[test]
fn an_equal_job_has_the_result_of_the_first_at_once() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let form = |options: Value| Form::sample().text("options", &options.to_string());
    let first = server.wait(&server.accepted(&form(json!({"reuse": true, "metadata": {"n": 1}}))));
    let mut answer = server.submit(&form(json!({"reuse": true, "metadata": {"n": 2}})));
    assert_eq!((answer.status().as_u16(), header(&answer, "result-reused")), (200, "true"));
    let second = json(&mut answer);
    assert_eq!(
        (&second["state"], &second["attempt"], &second["metadata"]["n"]),
        (&json!("succeeded"), &json!(0), &json!(2))
    );
    assert_ne!(first["id"], second["id"]);
    assert_eq!(artifact(&first, "result.zip")["sha256"], artifact(&second, "result.zip")["sha256"]);
    assert_eq!(server.delete(&format!("/v1/jobs/{}", first["id"].as_str().unwrap())).status(), 204);
    let href = artifact(&second, "model.glb")["href"].as_str().unwrap().to_owned();
    assert!(bytes(&mut server.get(&href, &[])).starts_with(b"glTF"), "it has the result also without the first");
    for other in [json!({}), json!({"reuse": true, "seed": 1}), json!({"reuse": true, "time_limit_s": 100.0})] {
        assert_eq!(server.submit(&form(other.clone())).status(), 202, "{other}");
    }
}

#[test]
fn equal_results_are_stored_once() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let paths: Vec<String> = (0..3).map(|_| server.accepted(&Form::sample())).collect();
    let jobs: Vec<Value> = paths.iter().map(|p| server.wait(p)).collect();
    let mut hashes: Vec<String> =
        jobs[0]["artifacts"].as_array().unwrap().iter().map(|a| a["sha256"].as_str().unwrap().to_owned()).collect();
    hashes.sort();
    hashes.dedup();
    assert_eq!(crate::server::left(data.path()), hashes);
    // What one job gives up, the others keep.
    server.delete(&paths[0]);
    let href = artifact(&jobs[1], "model.glb")["href"].as_str().unwrap();
    assert!(bytes(&mut server.get(href, &[])).starts_with(b"glTF"));
    paths[1..].iter().for_each(|p| drop(server.delete(p)));
    assert_eq!(crate::server::left(data.path()), [] as [String; 0]);
}
