//! What the service says about itself.

use serde_json::json;

use crate::server::{Form, Server, bytes, header, json};

#[test]
fn it_tells_its_health_its_contract_and_its_limits() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--max-queued", "7"]);
    assert_eq!(json(&mut server.get("/healthz", &[]))["status"], "ok");
    assert_eq!(json(&mut server.get("/readyz", &[]))["status"], "ok");
    assert_eq!(json(&mut server.get("/v1/limits", &[]))["max_queued"], 7);
    let recipes = json(&mut server.get("/v1/recipes", &[]));
    assert_eq!(recipes["recipes"][0]["name"], "pack");
    assert_eq!(recipes["stages"][0]["parameters"]["$defs"]["Grid"]["oneOf"][1]["type"], "integer");
    let contract = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/api/openapi.json")).unwrap();
    assert!(bytes(&mut server.get("/openapi.json", &[])) == contract, "the contract served is the one on file");
}

#[test]
fn it_counts_what_it_does_and_compresses_what_it_says() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    server.wait(&server.accepted(&Form::sample()));
    server.get("/v1/jobs/none", &[]);
    let told = || String::from_utf8(bytes(&mut server.get("/metrics", &[]))).unwrap();
    // A slot is free a moment after its job has ended.
    let started = std::time::Instant::now();
    let mut text = told();
    while !text.contains("intarsia_jobs_running 0\n") && started.elapsed() < crate::server::PATIENCE {
        text = told();
    }
    for line in [
        "intarsia_jobs{state=\"succeeded\"} 1",
        "intarsia_jobs{state=\"queued\"} 0",
        "intarsia_jobs_ended_total{code=\"\",state=\"succeeded\"} 1",
        "intarsia_stage_seconds_count{stage=\"bake\"} 1",
        "intarsia_http_requests_total{method=\"GET\",route=\"/v1/jobs/{id}\",status=\"404\"} 1",
        "intarsia_jobs_running 0",
    ] {
        assert!(text.lines().any(|l| l == line), "{line} is not in\n{text}");
    }
    let small = server.get("/openapi.json", &[("accept-encoding", "gzip")]);
    assert_eq!(header(&small, "content-encoding"), "gzip");
}

#[test]
fn what_a_job_does_is_logged_with_its_request() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start_with_log(data.path(), &["--log-level", "info", "--log-format", "json"]);
    let response = server.submit_with(&Form::sample(), &[("x-request-id", "build-17/step-2")]);
    assert_eq!(header(&response, "x-request-id"), "build-17/step-2");
    let job = server.wait(header(&response, "location"));
    let log = server.log();
    let end = log.iter().find(|l| l["fields"]["message"] == "job ends").unwrap_or_else(|| panic!("{log:#?}"));
    assert_eq!((&end["span"]["id"], &end["span"]["request"]), (&job["id"], &json!("build-17/step-2")));
}

#[test]
fn jobs_are_listed_only_on_demand() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--list-jobs"]);
    let paths: Vec<String> = (0..3).map(|_| server.accepted(&Form::sample())).collect();
    paths.iter().for_each(|p| drop(server.wait(p)));
    let first = json(&mut server.get("/v1/jobs?limit=2&state=succeeded", &[]));
    assert_eq!(first["jobs"].as_array().unwrap().len(), 2);
    assert_eq!(format!("/v1/jobs/{}", first["jobs"][0]["id"].as_str().unwrap()), paths[2], "the newest first");
    let rest = json(&mut server.get(&format!("/v1/jobs?limit=2&cursor={}", first["next"]), &[]));
    assert_eq!((rest["jobs"].as_array().unwrap().len(), &rest["next"]), (1, &json!(null)));
    for bad in ["limit=0", "limit=201", "state=done", "sort=up"] {
        assert_eq!(server.get(&format!("/v1/jobs?{bad}"), &[]).status(), 400, "{bad}");
    }
}

#[test]
fn browsers_may_call_from_allowed_origins_only() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--allow-origin", "https://a.example"]);
    let allowed = server.get("/nowhere", &[("origin", "https://a.example")]);
    assert_eq!(header(&allowed, "access-control-allow-origin"), "https://a.example");
    let exposed = header(&allowed, "access-control-expose-headers").to_lowercase();
    for name in ["location", "retry-after", "etag", "content-disposition"] {
        assert!(exposed.contains(name), "{name} is not in {exposed}");
    }
    let preflight = server.preflight("/v1/jobs", "https://a.example");
    assert_eq!(header(&preflight, "access-control-max-age"), "7200", "browsers ask once");
    let other = server.get("/healthz", &[("origin", "https://b.example")]);
    assert_eq!(other.status(), 403);
    assert!(other.headers().get("access-control-allow-origin").is_none());
}

#[cfg(target_os = "linux")]
#[test]
fn one_submission_does_not_fill_the_memory() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--max-queued", "1"]);
    // Refused at the end, after all of it was streamed: the options stand behind the model.
    let large = vec![b'#'; 96 << 20];
    let form = Form::default().file("model", "m.obj", &large).text("options", "[]");
    assert_eq!(server.submit(&form).status(), 422);
    assert!(server.peak_memory() < 64 << 20, "peak memory {} bytes", server.peak_memory());
}
