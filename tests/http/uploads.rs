//! Large files in pieces, by tus 1.0: they go on after a break of any kind, and stand for files of jobs.

use std::io::{Read, Write};
use std::time::Instant;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use ureq::Body;
use ureq::http::Response;

use crate::server::{Form, PATIENCE, Server, header, json, sample};

const PIECE: &str = "application/offset+octet-stream";

fn begin(server: &Server, length: usize, metadata: &str) -> String {
    let headers = [("upload-length", length.to_string()), ("upload-metadata", metadata.to_owned())];
    let headers = [0, 1].map(|n| (headers[n].0, headers[n].1.as_str()));
    let mut begun = server.send("POST", "/v1/uploads", &headers, b"");
    assert_eq!(begun.status(), 201, "{}", json(&mut begun));
    assert_eq!((header(&begun, "tus-resumable"), header(&begun, "upload-offset")), ("1.0.0", "0"));
    assert!(header(&begun, "upload-expires").ends_with(" GMT"));
    header(&begun, "location").to_owned()
}

fn patch(server: &Server, path: &str, offset: usize, bytes: &[u8], more: &[(&str, &str)]) -> Response<Body> {
    let offset = offset.to_string();
    let headers = [("tus-resumable", "1.0.0"), ("content-type", PIECE), ("upload-offset", &offset)];
    server.send("PATCH", path, &[&headers, more].concat(), bytes)
}

fn offset(server: &Server, path: &str) -> usize {
    let found = server.call("HEAD", path, &[("tus-resumable", "1.0.0")]);
    assert_eq!((found.status().as_u16(), header(&found, "cache-control")), (200, "no-store"));
    header(&found, "upload-offset").parse().unwrap()
}

fn declared(name: &str, bytes: &[u8]) -> String {
    let digits = hex::encode(Sha256::digest(bytes));
    format!("filename {},sha256 {}", STANDARD.encode(name), STANDARD.encode(digits))
}

fn reference(path: &str) -> String {
    path.replace("/v1/uploads/", "upload:")
}

#[test]
fn an_upload_goes_on_after_a_break_and_after_a_restart_and_becomes_a_job() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let model = sample();
    let path = begin(&server, model.len(), &declared("chair.glb", model));
    // The connection breaks in the middle of a request that promised more: what has come stays.
    let address = server.base.strip_prefix("http://").unwrap().to_owned();
    let half = model.len() / 2;
    let mut stream = std::net::TcpStream::connect(&address).unwrap();
    let head = format!(
        "PATCH {path} HTTP/1.1\r\nHost: {address}\r\nTus-Resumable: 1.0.0\r\nContent-Type: {PIECE}\r\nUpload-Offset: 0\r\n\
         Content-Length: {}\r\n\r\n",
        model.len()
    );
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(&model[..half]).unwrap();
    drop(stream);
    let started = Instant::now();
    while offset(&server, &path) != half {
        assert!(started.elapsed() < PATIENCE, "{} of {half} bytes", offset(&server, &path));
    }
    // The process dies.
    server.kill();
    let server = Server::start(data.path(), &[]);
    assert_eq!(offset(&server, &path), half);
    let early = json!({"model": reference(&path)}).to_string();
    let mut refused = server.post("/v1/jobs", "application/json", early.as_bytes());
    let problem = json(&mut refused);
    assert_eq!((refused.status().as_u16(), &problem["code"]), (422, &json!("missing_file")));
    assert_eq!(problem["errors"][0]["pointer"], "/model");
    let wrong = patch(&server, &path, half + 1, &model[half..], &[]);
    assert_eq!((wrong.status().as_u16(), header(&wrong, "upload-offset")), (409, half.to_string().as_str()));
    assert_eq!(patch(&server, &path, half, &model[half..half + 10], &[]).status(), 204);
    let last = patch(&server, &path, half + 10, &model[half + 10..], &[]);
    assert_eq!((last.status().as_u16(), header(&last, "upload-offset")), (204, model.len().to_string().as_str()));
    let told = json(&mut server.get(&path, &[]));
    assert_eq!((&told["complete"], &told["filename"]), (&json!(true), &json!("chair.glb")));
    assert_eq!(told["sha256"], hex::encode(Sha256::digest(model)));
    assert_eq!(patch(&server, &path, model.len(), b"", &[]).status(), 204, "nothing more");
    assert_eq!(patch(&server, &path, model.len(), b"x", &[]).status(), 413);

    // It stands for a file in a JSON body and in a form, and is the same submission as the file itself.
    let body = json!({"model": [reference(&path)], "options": {"metadata": {"by": "reference"}}}).to_string();
    let mut taken = server.post("/v1/jobs", "application/json", body.as_bytes());
    assert_eq!(taken.status(), 202, "{}", json(&mut taken));
    let job = server.wait(header(&taken, "location"));
    assert_eq!((&job["state"], &job["metadata"]["by"]), (&json!("succeeded"), &json!("reference")), "{job}");
    let keyed = |form: &Form| json(&mut server.submit_with(form, &[("idempotency-key", "same")]))["id"].clone();
    let by_reference = keyed(&Form::default().text("model", &reference(&path)).text("options", "{}"));
    // A part without a file name is called as the service calls it, with the format behind it.
    let by_name = Form::default().file("model", "model", model).text("options", "{}");
    assert_eq!(by_reference, keyed(&by_name));
    assert_eq!(server.delete(&path).status(), 204);
    assert_eq!(server.call("HEAD", &path, &[]).status(), 404);
    assert_eq!(std::fs::read_dir(data.path().join("pieces")).unwrap().count(), 0);
}

#[test]
fn what_is_not_as_declared_is_refused() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--max-upload", "1000", "--max-kept-uploads", "3"]);
    let options = server.call("OPTIONS", "/v1/uploads", &[]);
    assert_eq!((options.status().as_u16(), header(&options, "tus-version")), (204, "1.0.0"));
    assert!(header(&options, "tus-extension").contains("checksum,termination"));
    assert_eq!(header(&options, "tus-max-size"), "1000");
    for (headers, status, part) in [
        (&[("upload-length", "1001")][..], 413, "1000"),
        (&[], 400, "Upload-Length"),
        (&[("upload-length", "ten")], 400, "whole number"),
        (&[("upload-defer-length", "1")], 400, "Upload-Length"),
        (&[("upload-length", "1"), ("upload-metadata", "sha256 YQ==")], 400, "64"),
        (&[("upload-length", "1"), ("upload-metadata", "filename Li4vYQ==")], 400, "leaves its folder"),
        (&[("upload-length", "1"), ("tus-resumable", "0.2.2")], 412, "1.0.0"),
    ] {
        let mut refused = server.send("POST", "/v1/uploads", headers, b"");
        let problem = json(&mut refused).to_string();
        assert!(refused.status() == status && problem.contains(part), "{problem}");
    }
    // A checksum of a request: its bytes count all or not at all.
    let path = begin(&server, 6, "");
    let sha1 = |bytes: &[u8]| format!("sha1 {}", STANDARD.encode(sha1::Sha1::digest(bytes)));
    let mut spoiled = patch(&server, &path, 0, b"abc", &[("upload-checksum", &sha1(b"abd"))]);
    assert_eq!((spoiled.status().as_u16(), json(&mut spoiled)["code"].clone()), (460, json!("checksum_mismatch")));
    assert_eq!(offset(&server, &path), 0);
    assert_eq!(patch(&server, &path, 0, b"abc", &[("upload-checksum", &sha1(b"abc"))]).status(), 204);
    assert_eq!(patch(&server, &path, 3, b"abc", &[("upload-checksum", "md5 YWJj")]).status(), 400);
    assert_eq!(patch(&server, &path, 3, b"abcd", &[]).status(), 413, "more than was declared");
    assert_eq!(server.send("PATCH", &path, &[("upload-offset", "3")], b"abc").status(), 415);
    assert_eq!(patch(&server, &path, 3, b"def", &[]).status(), 204);
    // A checksum of the whole: what is another is no upload any more.
    let path = begin(&server, 3, &declared("a.glb", b"abc"));
    let mut other = patch(&server, &path, 0, b"abd", &[]);
    let problem = json(&mut other);
    assert!(other.status() == 460 && problem["detail"].as_str().unwrap().contains("begin it again"), "{problem}");
    assert_eq!(server.get(&path, &[]).status(), 404);
    // With the first request all may be sent.
    let headers = [("upload-length", "3"), ("content-type", PIECE)];
    let mut whole = server.send("POST", "/v1/uploads", &headers, b"abc");
    assert_eq!((whole.status().as_u16(), &json(&mut whole)["complete"]), (201, &json!(true)));
    // As many as are kept.
    begin(&server, 0, "");
    let full = server.send("POST", "/v1/uploads", &[("upload-length", "3")], b"");
    assert_eq!(full.status(), 503);
    assert!(header(&full, "retry-after").parse::<u64>().unwrap() >= 1);
    for source in ["upload:00000000000000000000000000000000", "chair.glb"] {
        let mut refused = server.post("/v1/jobs", "application/json", json!({"model": source}).to_string().as_bytes());
        let problem = json(&mut refused);
        assert_eq!((refused.status().as_u16(), &problem["errors"][0]["pointer"]), (422, &json!("/model")), "{problem}");
    }
}

#[test]
fn a_newer_request_takes_an_upload_over_from_one_that_hangs() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let path = begin(&server, 8, "");
    let address = server.base.strip_prefix("http://").unwrap().to_owned();
    let mut hanging = std::net::TcpStream::connect(&address).unwrap();
    let head = format!(
        "PATCH {path} HTTP/1.1\r\nHost: {address}\r\nContent-Type: {PIECE}\r\nUpload-Offset: 0\r\nContent-Length: 8\r\n\
         Connection: close\r\n\r\nold "
    );
    hanging.write_all(head.as_bytes()).unwrap();
    std::thread::sleep(std::time::Duration::from_millis(200));
    assert_eq!(patch(&server, &path, 0, b"newer by", &[]).status(), 204);
    hanging.write_all(b"late").unwrap();
    let mut answer = String::new();
    hanging.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 409"), "{answer}");
    let told = json(&mut server.get(&path, &[]));
    assert_eq!(told["sha256"], hex::encode(Sha256::digest(b"newer by")));
}

#[test]
fn uploads_expire() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--keep-uploads", "1s"]);
    let path = begin(&server, 3, "");
    assert_eq!(patch(&server, &path, 0, b"ab", &[]).status(), 204);
    let started = Instant::now();
    let gone = |status: u16| [404, 410].contains(&status);
    while !gone(server.get(&path, &[]).status().as_u16()) {
        assert!(started.elapsed() < PATIENCE);
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    assert!(gone(patch(&server, &path, 2, b"c", &[]).status().as_u16()));
    while std::fs::read_dir(data.path().join("pieces")).unwrap().count() > 0 {
        assert!(started.elapsed() < PATIENCE, "its pieces stay");
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    let limits: Value = json(&mut server.get("/v1/limits", &[]));
    assert_eq!((&limits["keep_uploads_s"], &limits["max_kept_uploads"]), (&json!(1.0), &json!(1000)));
}
