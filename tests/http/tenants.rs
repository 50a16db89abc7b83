//! A service with keys: who may do what, and that nobody reaches what is another's.

use std::io::{Read, Write};
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use serde_json::{Value, json};
use ureq::Body;
use ureq::http::Response;

use crate::server::{Form, PATIENCE, Server, bytes, header, json};

/// A token from the command line, beside a service that may be running.
fn key(data: &Path, tenant: &str, flags: &[&str]) -> String {
    let made = Command::new(env!("CARGO_BIN_EXE_intarsia"))
        .args(["keys", "create", "--tenant", tenant, "--data-dir"])
        .arg(data)
        .args(flags)
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    String::from_utf8(made.stdout).unwrap().trim().to_owned()
}

fn keyed(data: &Path, flags: &[&str]) -> Server {
    Server::start(data, &[&["--auth", "keys"], flags].concat())
}

/// A request with a token.
fn call(server: &Server, method: &str, path: &str, token: &str) -> Response<Body> {
    server.call(method, path, &[("authorization", &format!("Bearer {token}"))])
}

fn submit(server: &Server, token: &str) -> Response<Body> {
    server.submit_with(&Form::sample(), &[("authorization", &format!("Bearer {token}"))])
}

/// A job when it is final.
fn ended(server: &Server, token: &str, id: &str) -> Value {
    let started = Instant::now();
    loop {
        let authorization = format!("Bearer {token}");
        let headers = [("authorization", authorization.as_str()), ("prefer", "wait=20")];
        let job = json(&mut server.get(&format!("/v1/jobs/{id}"), &headers));
        if !["queued", "running"].contains(&job["state"].as_str().unwrap()) {
            return job;
        }
        assert!(started.elapsed() < PATIENCE, "the job does not end: {job}");
    }
}

#[test]
fn a_tenants_key_reaches_nothing_of_anothers_on_any_route() {
    let data = tempfile::tempdir().unwrap();
    let owner = key(data.path(), "owner", &[]);
    let server = keyed(data.path(), &["--list-jobs"]);
    let other = key(data.path(), "other", &[]);
    let mut response = submit(&server, &owner);
    assert_eq!(response.status(), 202);
    let submitted = json(&mut response);
    let id = submitted["id"].as_str().unwrap();
    let job = ended(&server, &owner, id);
    assert_eq!(job["state"], "succeeded");
    let none = "0".repeat(32);

    let headers = [("authorization", format!("Bearer {owner}")), ("content-type", "application/json".to_owned())];
    let headers = [0, 1].map(|n| (headers[n].0, headers[n].1.as_str()));
    let mut hook = server.post_with("/v1/webhooks", &headers, br#"{"url": "https://owner.example/hook"}"#);
    assert_eq!(hook.status(), 201);
    let hook = json(&mut hook)["webhook"]["id"].as_str().unwrap().to_owned();

    let bearer = format!("Bearer {owner}");
    let headers = [("authorization", bearer.as_str()), ("upload-length", "3")];
    let mut upload = server.send("POST", "/v1/uploads", &headers, b"");
    assert_eq!(upload.status(), 201);
    let upload = json(&mut upload)["id"].as_str().unwrap().to_owned();
    let form = Form::default().text("batch", r#"{"items": [{"model": "a.glb"}]}"#);
    let form = form.file("files", "a.glb", crate::server::sample());
    let mut batch = server.send_form("/v1/batches", &form, &headers[..1]);
    assert_eq!(batch.status(), 202);
    let batch = json(&mut batch)["id"].as_str().unwrap().to_owned();

    let contract = json(&mut server.get("/openapi.json", &[]));
    let mut walked = 0;
    for (route, item) in contract["paths"].as_object().unwrap() {
        for method in ["get", "post", "patch", "delete"].into_iter().filter(|m| item.get(m).is_some()) {
            let of_hook = route.starts_with("/v1/webhooks");
            let at = |id: &str| {
                let own = [("/v1/webhooks", &hook), ("/v1/uploads", &upload), ("/v1/batches", &batch)];
                let own = own.into_iter().find(|(prefix, _)| route.starts_with(prefix)).map(|(_, id)| id.as_str());
                let id = own.filter(|_| id != none).unwrap_or(id);
                let name = if route.starts_with("/page/") { "app.js" } else { "model.glb" };
                route.replace("{id}", id).replace("{name}", name).replace("{delivery}", "msg_1")
            };
            let method = method.to_uppercase();
            let mut found = call(&server, &method, &at(id), &other);
            let (status, text) = (found.status().as_u16(), bytes(&mut found));
            let text = String::from_utf8_lossy(&text);
            assert!(!text.contains("\"owner\""), "{method} {route} names another tenant: {text}");
            walked += 1;
            let public =
                !route.starts_with("/v1/") && route != "/metrics" || ["/v1/recipes", "/v1/limits"].contains(&&**route);
            let anonymous = server.call(&method, &at(id), &[]);
            if public {
                assert_eq!((anonymous.status().as_u16(), status), (200, 200), "{method} {route}");
                continue;
            }
            assert_eq!(anonymous.status(), 401, "{method} {route}");
            assert!(header(&anonymous, "www-authenticate").starts_with("Bearer "));
            let unknown = call(&server, &method, &at(id), &"x".repeat(64));
            assert_eq!(unknown.status(), 401);
            assert!(header(&unknown, "www-authenticate").contains("invalid_token"));
            let own =
                ["/v1/jobs/", "/v1/uploads/", "/v1/batches/"].into_iter().find(|prefix| route.starts_with(prefix));
            if let Some(prefix) = own {
                let id = match prefix {
                    "/v1/jobs/" => id,
                    "/v1/uploads/" => &upload,
                    _ => &batch,
                };
                // As if there were no such job.
                let mut missing = call(&server, &method, &at(&none), &other);
                let missing = (missing.status().as_u16(), String::from_utf8(bytes(&mut missing)).unwrap());
                assert_eq!((status, text.replace(id, &none)), missing, "{method} {route}");
                assert_eq!(status, 404, "{method} {route}");
                // However it is spelled.
                let odd = format!("%{:02x}{}", id.as_bytes()[0], &id[1..]);
                assert_eq!(call(&server, &method, &at(id).replace(id, &odd), &other).status(), 404, "{method} {route}");
            } else if route == "/v1/webhooks" {
                match method.as_str() {
                    "GET" => assert!(text.contains("\"webhooks\":[]"), "{text}"),
                    _ => assert_eq!(status, 415, "it may make receivers of its own"),
                }
            } else if of_hook {
                assert_eq!(status, 404, "{method} {route}");
            } else if route == "/v1/uploads" {
                assert_eq!(status, 400, "it may begin uploads of its own");
            } else if route == "/v1/batches" {
                assert_eq!(status, 415, "it may submit batches of its own");
            } else if route == "/v1/jobs" {
                match method.as_str() {
                    "GET" => assert_eq!(serde_json::from_str::<Value>(&text).unwrap()["jobs"], json!([])),
                    _ => assert_eq!(status, 415, "it may submit jobs of its own"),
                }
            } else {
                assert_eq!(status, 403, "{method} {route} is for administrators");
            }
        }
    }
    assert!(walked > 25, "{walked}");

    // What another has uploaded is as if it were not there, however it is named.
    for (path, body) in [
        ("/v1/jobs", json!({"model": format!("upload:{upload}")})),
        ("/v1/batches", json!({"items": [{"model": format!("upload:{upload}")}]})),
    ] {
        let bearer = format!("Bearer {other}");
        let headers = [("authorization", bearer.as_str()), ("content-type", "application/json")];
        let mut refused = server.post_with(path, &headers, body.to_string().as_bytes());
        let text = json(&mut refused).to_string();
        assert!(refused.status() == 422 && text.contains("there is no upload"), "{text}");
    }
    let mut mine = call(&server, "GET", &format!("/v1/uploads/{upload}"), &owner);
    assert_eq!(json(&mut mine)["offset"], 0);
    let mut mine = call(&server, "GET", &format!("/v1/batches/{batch}"), &owner);
    assert_eq!(json(&mut mine)["jobs"].as_array().unwrap().len(), 1);

    // Nothing has become of it, and its owner reaches all of it.
    let mut mine = call(&server, "GET", &format!("/v1/jobs/{id}"), &owner);
    assert_eq!(json(&mut mine), job);
    let hooks = json(&mut call(&server, "GET", "/v1/webhooks", &owner));
    assert_eq!(hooks["webhooks"][0]["id"], hook.as_str());
    let mut listed = call(&server, "GET", "/v1/jobs", &owner);
    assert!(json(&mut listed)["jobs"].as_array().unwrap().iter().any(|job| job["id"] == id));
    for artifact in job["artifacts"].as_array().unwrap() {
        let href = artifact["href"].as_str().unwrap();
        assert_eq!(call(&server, "GET", href, &owner).status(), 200);
        assert_eq!(call(&server, "GET", href, &other).status(), 404);
    }
    let mut events = call(&server, "GET", &format!("/v1/jobs/{id}/events"), &owner);
    assert!(String::from_utf8(bytes(&mut events)).unwrap().contains("event: state"));
    // One key of a client is another with another tenant.
    let again = |token: &str| {
        let authorization = format!("Bearer {token}");
        let headers = [("authorization", authorization.as_str()), ("idempotency-key", "build-17")];
        json(&mut server.submit_with(&Form::sample(), &headers))["id"].clone()
    };
    let (first, second) = (again(&owner), again(&other));
    assert_ne!(first, second);
    assert_eq!(first, again(&owner));
    assert_eq!(call(&server, "DELETE", &format!("/v1/jobs/{id}"), &owner).status(), 204);
}

#[test]
fn scopes_hold_and_a_revoked_key_stops() {
    let data = tempfile::tempdir().unwrap();
    let admin = key(data.path(), "ops", &["--scope", "admin"]);
    let server = keyed(data.path(), &[]);
    let post = |body: Value| {
        let headers = [("authorization", format!("Bearer {admin}")), ("content-type", "application/json".to_owned())];
        let headers: Vec<(&str, &str)> = headers.iter().map(|(k, v)| (*k, v.as_str())).collect();
        server.post_with("/v1/keys", &headers, body.to_string().as_bytes())
    };
    let mut made = post(json!({"tenant": "studio", "scopes": ["read"], "name": "viewer"}));
    assert_eq!(made.status(), 201);
    let made = json(&mut made);
    let (reader, id) = (made["token"].as_str().unwrap(), made["key"]["id"].as_str().unwrap());
    assert_eq!(call(&server, "GET", "/v1/jobs", reader).status(), 200);
    let refused = submit(&server, reader);
    assert_eq!(refused.status(), 403);
    assert!(header(&refused, "www-authenticate").contains("scope=\"submit\""));
    // One scope is not another, the highest not either.
    assert_eq!(call(&server, "GET", "/v1/jobs", &admin).status(), 403);
    assert_eq!(call(&server, "GET", "/metrics", &admin).status(), 200);
    for (body, status, part) in [
        (json!({"tenant": "a b", "scopes": ["read"]}), 422, "/tenant"),
        (json!({"tenant": "a", "scopes": []}), 422, "/scopes"),
        (json!({"tenant": "a", "scopes": ["write"]}), 422, "/scopes/0"),
        (json!({"tenant": "a", "scopes": ["read"], "colour": 1}), 422, "colour"),
        (json!({"tenant": "a", "scopes": ["read"], "name": "x".repeat(70_000)}), 413, "65536"),
    ] {
        let mut answer = post(body);
        let text = json(&mut answer).to_string();
        assert!(answer.status() == status && text.contains(part), "{text}");
    }
    // No token is told twice, by nothing.
    let listed = json(&mut call(&server, "GET", "/v1/keys", &admin)).to_string();
    assert!(listed.contains(id) && !listed.contains("intarsia_"), "{listed}");
    let stored = std::fs::read(data.path().join("queue.sqlite")).unwrap();
    let wal = std::fs::read(data.path().join("queue.sqlite-wal")).unwrap();
    let secret = &reader.as_bytes()["intarsia_".len()..];
    assert!(![stored, wal].iter().any(|file| file.windows(secret.len()).any(|w| w == secret)));

    assert_eq!(call(&server, "DELETE", &format!("/v1/keys/{id}"), &admin).status(), 204);
    assert_eq!(call(&server, "GET", "/v1/jobs", reader).status(), 401, "at once");
    assert_eq!(call(&server, "DELETE", &format!("/v1/keys/{id}"), &admin).status(), 404);
}

#[test]
fn a_stream_ends_when_its_key_is_revoked() {
    let data = tempfile::tempdir().unwrap();
    let token = key(data.path(), "studio", &[]);
    let server = keyed(data.path(), &[]);
    let authorization = format!("Bearer {token}");
    let mut accepted = server.submit_with(&Form::long(), &[("authorization", &authorization)]);
    let path = header(&accepted, "location").to_owned();
    assert_eq!(json(&mut accepted)["state"], "queued");
    let address = server.base.strip_prefix("http://").unwrap();
    let mut stream = std::net::TcpStream::connect(address).unwrap();
    write!(stream, "GET {path}/events HTTP/1.1\r\nHost: {address}\r\nAuthorization: {authorization}\r\n\r\n").unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut head = [0; 12];
    stream.read_exact(&mut head).unwrap();
    assert_eq!(&head, b"HTTP/1.1 200");

    let keys = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_intarsia"));
        command.arg("keys").args(arguments).arg("--data-dir").arg(data.path()).output().unwrap()
    };
    let listed: Value = serde_json::from_slice(&keys(&["list", "--json"]).stdout).unwrap();
    let id = listed["keys"][0]["id"].as_str().unwrap();
    assert!(keys(&["revoke", id]).status.success());
    assert_eq!(call(&server, "GET", &path, &token).status(), 401);
    // The job goes on and has events; this stream tells none of its end.
    let mut told = Vec::new();
    let _ = stream.read_to_end(&mut told);
    let told = String::from_utf8_lossy(&told);
    assert!(!told.contains("\"succeeded\""), "{told}");
    let other = key(data.path(), "studio", &[]);
    assert_eq!(json(&mut call(&server, "GET", &path, &other))["finished_at"], Value::Null);
    assert_eq!(call(&server, "DELETE", &path, &other).status(), 204);
}

#[test]
fn quotas_and_rates_are_told_and_kept() {
    let data = tempfile::tempdir().unwrap();
    let small = key(data.path(), "small", &["--max-queued", "0"]);
    let full = key(data.path(), "full", &["--max-stored", "10"]);
    let idle = key(data.path(), "idle", &["--max-uploads", "0"]);
    let slow = key(data.path(), "slow", &["--rate-limit", "2"]);
    let server = keyed(data.path(), &["--rate-limit", "1000"]);
    for token in [&small, &full, &idle] {
        let mut answer = submit(&server, token);
        assert_eq!(answer.status(), 429);
        assert!(header(&answer, "retry-after").parse::<u64>().unwrap() >= 1);
        assert_eq!(json(&mut answer)["code"], "quota_exceeded");
    }
    for (n, wanted) in [200, 200, 429].into_iter().enumerate() {
        let mut answer = call(&server, "GET", "/v1/jobs", &slow);
        assert_eq!(answer.status(), wanted);
        assert_eq!(header(&answer, "ratelimit-limit"), "2");
        assert_eq!(header(&answer, "ratelimit-remaining"), 1usize.saturating_sub(n).to_string());
        if wanted == 429 {
            assert_eq!(json(&mut answer)["code"], "rate_limited");
            assert!((1..=60).contains(&header(&answer, "retry-after").parse::<u64>().unwrap()));
        }
    }
    // Others have their own, those without a key by their address; probes are not counted.
    assert_eq!(header(&call(&server, "GET", "/v1/jobs", &full), "ratelimit-limit"), "1000");
    assert_eq!(header(&server.get("/v1/limits", &[]), "ratelimit-limit"), "1000");
    assert!(server.get("/healthz", &[]).headers().get("ratelimit-limit").is_none());
}

#[test]
fn without_keys_the_service_knows_no_tenants() {
    let data = tempfile::tempdir().unwrap();
    let token = key(data.path(), "studio", &["--scope", "admin"]);
    let server = Server::start(data.path(), &[]);
    for authorization in ["Bearer nonsense".to_owned(), format!("Bearer {token}")] {
        let headers = [("authorization", authorization.as_str())];
        let mut answer = server.submit_with(&Form::sample(), &headers);
        let id = json(&mut answer)["id"].as_str().unwrap().to_owned();
        assert_eq!(server.get(&format!("/v1/jobs/{id}"), &[]).status(), 200);
        assert_eq!(server.get("/v1/jobs", &headers[..1]).status(), 404, "jobs are not listed");
        assert_eq!(server.get("/v1/keys", &headers[..1]).status(), 404);
        assert_eq!(server.get("/metrics", &[]).status(), 200);
    }
}
