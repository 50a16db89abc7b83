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
fn a_submission_can_be_checked_without_being_stored() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--list-jobs"]);
    let mut valid = server.submit_to("/v1/jobs?validate_only=true", &Form::sample().text("options", r#"{"seed": 7}"#));
    assert_eq!(valid.status(), 200);
    let told = json(&mut valid);
    assert_eq!(
        (&told["valid"], &told["options"]["seed"], &told["options"]["recipe"]),
        (&json!(true), &json!(7), &json!("pack"))
    );
    assert!(told["memory_bytes"].as_u64().unwrap() > told["upload_bytes"].as_u64().unwrap());
    let refused = server.submit_to("/v1/jobs?validate_only=true", &Form::sample().text("options", r#"{"sed": 7}"#));
    assert_eq!(problem(refused)["code"], "invalid_options");
    assert_eq!(server.submit_to("/v1/jobs?validate_only=maybe", &Form::sample()).status(), 400);
    assert_eq!(json(&mut server.get("/v1/jobs", &[]))["jobs"], json!([]));
    assert!(crate::server::left(data.path()).is_empty());
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
        (Form::sample().text("options", "{\"recipe\": \"bonded\"}"), 422, "invalid_options", "did you mean `bounded`"),
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
fn what_the_query_says_beside_a_form_is_honoured_or_refused() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let taken = |query: &str, form: Form| server.submit_to(&format!("/v1/jobs?{query}"), &form);
    let mut named = taken("recipe=scan", Form::sample().text("options", r#"{"seed": 3}"#));
    assert_eq!(named.status(), 202);
    let job = json(&mut named);
    assert_eq!((&job["recipe"], &job["options"]["seed"]), (&json!("scan"), &json!(3)));
    assert_eq!(taken("recipe=scan", Form::sample().text("options", r#"{"recipe": "scan"}"#)).status(), 202);
    for (query, form, part) in [
        ("recipe=scan", Form::sample().text("options", r#"{"recipe": "pack"}"#), "another `recipe`"),
        ("pack.gutter=3", Form::sample(), "pack.gutter"),
        ("recipe=scan&strict=1", Form::sample(), "strict"),
    ] {
        let problem = problem(taken(query, form));
        assert_eq!(problem["status"], 400);
        assert!(problem["detail"].as_str().unwrap().contains(part), "{problem:#}");
    }
    let twice = Form::sample().text("options", r#"{"seed": 1, "seed": 2}"#);
    let problem = problem(server.submit(&twice));
    assert_eq!(problem["status"], 400);
    assert!(problem["detail"].as_str().unwrap().contains("`seed` stands twice"), "{problem:#}");
}

/// An archive of files.
fn zip(files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for (name, bytes) in files {
        zip.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

#[test]
fn of_an_archive_with_several_models_one_can_be_taken() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let both = zip(&[("a/one.glb", sample()), ("b/two.glb", sample())]);
    let form = |options: &str| Form::default().file("model", "m.zip", &both).text("options", options);
    let job = server.wait(&server.accepted(&form("{}")));
    let message = job["error"]["message"].as_str().unwrap();
    assert!(message.contains("a/one.glb") && message.contains("`model`"), "{message}");
    assert_eq!(server.wait(&server.accepted(&form(r#"{"model": "b/two.glb"}"#)))["state"], "succeeded");
    let job = server.wait(&server.accepted(&form(r#"{"model": "c.glb"}"#)));
    assert_eq!(job["error"]["code"], "missing_file", "{job:#}");
}

#[test]
fn files_that_no_model_names_are_named() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let job = server.wait(&server.accepted(&Form::sample().file("files", "textures/a.png", b"x")));
    let warning = job["warnings"].as_array().unwrap().iter().find(|w| w["code"] == "unused_file").unwrap();
    assert!(warning["message"].as_str().unwrap().contains("textures/a.png"), "{warning}");
}

#[test]
fn what_headers_show_is_refused_at_once() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--max-image-pixels", "1000", "--max-triangles", "1000000"]);
    let limits = json(&mut server.get("/v1/limits", &[]));
    let large = problem(server.submit(&Form::sample()));
    assert_eq!((&large["status"], &limits["max_image_pixels"]), (&json!(413), &json!(1000)));
    assert!(large["detail"].as_str().unwrap().contains("the limit is 1000"), "{large:#}");
    let levels = limits["max_json_nesting"].as_u64().unwrap() as usize;
    let nested = |depth: usize| glb(&format!("{{\"asset\": {}{}}}", "[".repeat(depth - 1), "]".repeat(depth - 1)));
    assert_eq!(server.submit(&Form::default().file("model", "m.glb", &nested(levels))).status(), 202);
    let deep = problem(server.submit(&Form::default().file("model", "m.glb", &nested(levels + 1))));
    assert_eq!(deep["status"], 400, "{deep:#}");
    let most = limits["max_archive_entries"].as_u64().unwrap() as usize;
    let names: Vec<String> = (0..=most).map(|n| format!("{n}.obj")).collect();
    let files: Vec<(&str, &[u8])> = names.iter().map(|n| (n.as_str(), &b""[..])).collect();
    let full = problem(server.submit(&Form::default().file("model", "m.zip", &zip(&files))));
    assert_eq!((&full["status"], &full["code"]), (&json!(413), &json!("too_large")));
}

#[test]
fn strangers_pages_and_names_are_refused() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--allow-host", "atlas.example"]);
    let (form, port) = (Form::sample(), server.base.rsplit(':').next().unwrap().to_owned());
    let own = format!("http://localhost:{port}");
    for (headers, status, code) in [
        (vec![("origin", "https://evil.example")], 403, "forbidden"),
        (vec![("origin", "null")], 403, "forbidden"),
        (vec![("host", "evil.example")], 421, "invalid_request"),
        (vec![("host", "evil.example"), ("origin", "http://evil.example")], 421, "invalid_request"),
    ] {
        let problem = problem(server.submit_with(&form, &headers));
        assert_eq!((&problem["status"], &problem["code"]), (&json!(status), &json!(code)), "{headers:?}");
    }
    let local = format!("localhost:{port}");
    for headers in [
        vec![("host", local.as_str()), ("origin", own.as_str())],
        vec![("host", "atlas.example"), ("origin", "https://atlas.example")],
        vec![],
    ] {
        assert_eq!(server.submit_with(&form, &headers).status(), 202, "{headers:?}");
    }
}

#[test]
fn slow_uploads_of_one_client_leave_others_their_part() {
    use std::io::Read;
    use std::net::TcpStream;
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--max-uploads", "8", "--upload-idle", "5s"]);
    let address = server.base.strip_prefix("http://").unwrap().to_owned();
    let begin = |body: &[u8]| {
        let mut stream = TcpStream::connect(&address).unwrap();
        let head = format!(
            "POST /v1/jobs HTTP/1.1\r\nHost: {address}\r\nContent-Type: model/gltf-binary\r\nContent-Length: 100000\r\n\r\n"
        );
        stream.write_all(head.as_bytes()).unwrap();
        stream.write_all(body).unwrap();
        stream
    };
    // Those that have sent nothing hold no slot; those that have hold at most half.
    let waiting: Vec<TcpStream> = (0..20).map(|_| begin(b"")).collect();
    let slow: Vec<TcpStream> = (0..12).map(|_| begin(b"glTF")).collect();
    std::thread::sleep(std::time::Duration::from_millis(300));
    let other = server.submit_from("127.0.0.2", &Form::sample());
    assert!(other.starts_with("HTTP/1.1 202"), "{other}");
    let refused = slow.into_iter().filter(|stream| {
        let (mut stream, mut answer) = (stream.try_clone().unwrap(), [0; 12]);
        stream.set_read_timeout(Some(std::time::Duration::from_millis(200))).unwrap();
        stream.read_exact(&mut answer).is_ok_and(|()| &answer == b"HTTP/1.1 503")
    });
    assert_eq!(refused.count(), 8, "of twelve, four are received");
    drop(waiting);
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
        ("/v1/jobs?recipe=pack&recipe=scan", "model/gltf-binary", sample(), 400),
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
    let bomb = || zip(&[("m.obj", &[b'#'; 70_000])]);
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
    let seconds: u64 = header(&response, "retry-after").parse().unwrap();
    assert!((1..=60).contains(&seconds), "{seconds}");
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
