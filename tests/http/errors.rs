//! What the service refuses at the door, and how it says so.

use std::io::Write;

use serde_json::{Value, json};
use ureq::Body;
use ureq::http::Response;

use crate::server::{Form, Server, bytes, glb, header, json, sample};

/// The problem that an answer holds; its form is checked.
fn problem(mut response: Response<Body>) -> Value {
    assert_eq!(header(&response, "content-type"), "application/problem+json");
    let status = response.status().as_u16();
    let problem = json(&mut response);
    assert_eq!(problem["status"], status);
    assert_eq!(problem["type"], format!("urn:intarsia:problem:{}", problem["code"].as_str().unwrap()));
    for text in ["title", "detail"] {
        assert!(!problem[text].as_str().unwrap().is_empty(), "{problem:#}");
    }
    problem
}

#[test]
fn bad_submissions_are_told_what_is_wrong() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let model = |name: &str, bytes: &[u8]| Form::default().file("model", name, bytes);
    let whole = sample();
    let mut version = whole.to_vec();
    version[4] = 1;
    for (form, status, code, part) in [
        (model("m.glb", b""), 400, "invalid_model", "empty"),
        (model("m.glb", &whole[..whole.len() - 1]), 400, "invalid_model", "truncated"),
        (model("m.glb", &whole[..3]), 400, "invalid_model", "magic"),
        (model("m.glb", &version), 400, "invalid_model", "version 1"),
        (model("m.glb", &glb("{\"asset\": ")), 400, "invalid_model", "JSON"),
        (model("m.gltf", b"{\"asset\": {}"), 400, "invalid_model", "JSON"),
        (model("m.zip", b"PK\x03\x04"), 400, "invalid_model", "zip"),
        (model("m.txt", b"hello"), 415, "unsupported_media_type", "neither"),
        (Form::default(), 400, "invalid_request", "model"),
        (Form::default().text("options", "{}"), 400, "invalid_request", "model"),
        (Form::sample().text("options", "{"), 400, "invalid_request", "not JSON"),
        (Form::sample().text("options", "{}").text("options", "{}"), 400, "invalid_request", "twice"),
        (Form::sample().text("colour", "red"), 400, "invalid_request", "colour"),
        (Form::sample().file("files", "../a.png", b"x"), 400, "invalid_request", "leaves"),
        (Form::sample().file("files", "a.png", b"x").file("files", "a.png", b"y"), 400, "invalid_request", "two files"),
        (Form::sample().text("options", "[]"), 422, "invalid_options", "object"),
        (Form::sample().text("options", "{\"recipe\": \"bounded\"}"), 422, "invalid_options", "not available"),
    ] {
        let problem = problem(server.submit(&form));
        let detail = problem["detail"].as_str().unwrap();
        assert_eq!((&problem["status"], &problem["code"]), (&json!(status), &json!(code)), "{problem:#}");
        assert!(detail.contains(part), "`{part}` is not in: {detail}");
    }
    let left = std::fs::read_dir(data.path().join("uploads")).unwrap().count();
    assert_eq!(left, 0, "refused submissions leave no files");
}

#[test]
fn every_wrong_option_is_named() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let options = json!({"pack": {"guter": 2, "grid": 65}, "texture": {"max_size": "big"}});
    let problem = problem(server.submit(&Form::sample().text("options", &options.to_string())));
    assert_eq!(problem["status"], 422);
    let errors = problem["errors"].as_array().unwrap();
    let at = |pointer: &str| {
        let error =
            errors.iter().find(|e| e["pointer"] == pointer).unwrap_or_else(|| panic!("{pointer} not in {errors:#?}"));
        error["message"].as_str().unwrap()
    };
    assert!(at("/pack/guter").contains("did you mean `gutter`?"));
    assert!(at("/pack/grid").contains("1..=64"));
    assert!(at("/texture/max_size").contains("number"));
    assert_eq!(errors.len(), 3);
}

#[test]
fn raw_bodies_must_be_models() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    for (path, media_type, body, status) in [
        ("/v1/jobs", "text/html", &b"<p>"[..], 415),
        ("/v1/jobs", "application/octet-stream", b"hello", 415),
        ("/v1/jobs", "model/gltf-binary", b"", 400),
        ("/v1/jobs", "multipart/form-data", b"", 400),
        ("/v1/jobs", "multipart/form-data; boundary=x", b"--x\r\nbroken", 400),
        ("/v1/jobs?recipe=pak", "model/gltf-binary", sample(), 422),
        ("/v1/jobs?receipt=pack", "model/gltf-binary", sample(), 400),
    ] {
        assert_eq!(problem(server.post(path, media_type, body))["status"], status, "{path} {media_type}");
    }
}

#[test]
fn limits_hold() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--max-upload", "64KiB", "--max-files", "2"]);
    let large = problem(server.submit(&Form::default().file("model", "m.obj", &vec![b'#'; 70_000])));
    assert_eq!((&large["status"], &large["code"]), (&json!(413), &json!("too_large")));
    let small = || Form::default().file("model", "m.obj", b"v 0 0 0\n");
    let many = small().file("files", "a", b"").file("files", "b", b"");
    assert_eq!(problem(server.submit(&many))["code"], "too_large");
    assert_eq!(server.submit(&small()).status(), 202);
    // An archive counts by what is in it.
    let bomb = || {
        let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
        zip.start_file("m.obj", zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(&vec![b'#'; 70_000]).unwrap();
        zip.finish().unwrap().into_inner()
    };
    assert!(bomb().len() < 1000);
    let large = problem(server.submit(&Form::default().file("model", "m.zip", &bomb())));
    assert_eq!((&large["status"], &large["code"]), (&json!(413), &json!("too_large")));
    assert!(large["detail"].as_str().unwrap().contains("unpacks"), "{large:#}");
}

#[test]
fn a_full_queue_asks_to_come_back() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--max-queued", "0"]);
    let response = server.submit(&Form::sample());
    assert_eq!(header(&response, "retry-after"), "5");
    let problem = problem(response);
    assert_eq!((&problem["status"], &problem["code"]), (&json!(503), &json!("queue_full")));
}

#[test]
fn what_does_not_exist_is_not_found() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    for path in ["/nowhere", "/v1/jobs/0", "/v1/jobs/0/events", "/v1/jobs/0/artifacts/model.glb", "/v1/jobs"] {
        assert_eq!(problem(server.get(path, &[]))["code"], "not_found", "{path}");
    }
    assert_eq!(problem(server.delete("/v1/jobs"))["status"], 405);
    let path = server.accepted(&Form::sample());
    server.wait(&path);
    let secret = problem(server.get(&format!("{path}/artifacts/..%2F..%2Fqueue.sqlite"), &[]));
    assert_eq!(secret["status"], 404, "names are looked up, never opened");
    assert!(bytes(&mut server.get("/healthz", &[])).starts_with(b"{"));
}
