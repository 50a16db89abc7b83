//! The trace that a request brings goes on in logs and in webhooks; what was told of a job can be listed and told again.

use std::io::{Read, Write};
use std::net::TcpListener;
use std::sync::mpsc;
use std::time::Instant;

use serde_json::{Value, json};

use crate::server::{Form, PATIENCE, Server, header, json, sample};

const TRACE: &str = "0af7651916cd43dd8448eb211c80319c";

/// A receiver that takes everything; its requests, each as text.
pub fn receiver() -> (String, mpsc::Receiver<String>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let (sender, received) = mpsc::channel();
    std::thread::spawn(move || {
        for mut stream in listener.incoming().flatten() {
            let (mut request, mut part) = (Vec::new(), [0; 65536]);
            while !is_whole(&request) {
                match stream.read(&mut part) {
                    Ok(0) | Err(_) => break,
                    Ok(n) => request.extend(&part[..n]),
                }
            }
            let _ = sender.send(String::from_utf8_lossy(&request).into_owned());
            let _ = stream.write_all(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
        }
    });
    (url, received)
}

/// Whether all of a request is there.
fn is_whole(request: &[u8]) -> bool {
    let Some(end) = request.windows(4).position(|w| w == b"\r\n\r\n") else { return false };
    let head = String::from_utf8_lossy(&request[..end]).to_ascii_lowercase();
    let length = head.lines().find_map(|line| line.strip_prefix("content-length: ")?.trim().parse().ok());
    request.len() - end - 4 >= length.unwrap_or(0)
}

#[test]
fn a_trace_goes_on_and_deliveries_of_a_job_are_told_again() {
    let data = tempfile::tempdir().unwrap();
    let secret = "whsec_MDEyMzQ1Njc4OWFiY2RlZjAxMjM0NTY3ODlhYmNkZWY=";
    let flags = ["--webhook-secret", secret, "--webhook-allow", "127.0.0.0/8", "--log-format", "json"];
    let server = Server::start_with_log(data.path(), &flags);
    let (url, received) = receiver();
    let form = Form::default().file("model", "a.glb", sample()).text("options", &json!({"webhook": url}).to_string());
    let parent = format!("00-{TRACE}-b7ad6b7169203331-01");
    let taken = server.submit_with(&form, &[("traceparent", &parent)]);
    let path = header(&taken, "location").to_owned();
    assert_eq!(server.wait(&path)["state"], "succeeded");
    let told = received.recv_timeout(PATIENCE).unwrap();
    assert!(told.contains(&format!("traceparent: 00-{TRACE}-")) && !told.contains("b7ad6b7169203331"), "{told}");
    let started = Instant::now();
    let words = |lines: &[Value]| -> Vec<String> {
        lines.iter().filter_map(|line| line["fields"]["message"].as_str().map(str::to_owned)).collect()
    };
    loop {
        let lines: Vec<Value> = server.log().into_iter().filter(|line| line["span"]["trace_id"] == TRACE).collect();
        assert!(lines.iter().all(|line| line["span"]["span_id"].as_str().unwrap().len() == 16));
        let words = words(&lines);
        if ["job is queued", "job starts", "job ends"].iter().all(|wanted| words.iter().any(|word| word == wanted)) {
            break;
        }
        assert!(started.elapsed() < PATIENCE, "{words:?}");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }

    let list = || json(&mut server.get(&format!("{path}/deliveries"), &[]));
    while list()["deliveries"][0]["state"] != "delivered" {
        assert!(started.elapsed() < PATIENCE, "{}", list());
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let delivery = list()["deliveries"][0].clone();
    assert_eq!((&delivery["event"], &delivery["webhook"]), (&json!("job.succeeded"), &json!(null)));
    let id = delivery["id"].as_str().unwrap();
    assert!(told.contains(id));
    assert_eq!(server.call("POST", &format!("{path}/deliveries/{id}/replay"), &[]).status(), 202);
    let again = received.recv_timeout(PATIENCE).unwrap();
    assert!(again.contains(id), "under the same id: {again}");
    assert_eq!(server.call("POST", &format!("{path}/deliveries/msg_1/replay"), &[]).status(), 404);
    let none = "0".repeat(32);
    assert_eq!(server.get(&format!("/v1/jobs/{none}/deliveries"), &[]).status(), 404);
    assert_eq!(server.get(&format!("{path}/deliveries?limit=0"), &[]).status(), 400);
    assert_eq!(json(&mut server.get(&format!("{path}/deliveries?limit=1"), &[]))["deliveries"][0]["id"], id);
}

#[test]
fn a_collector_is_told_of_one_trace_a_job() {
    let (url, received) = receiver();
    let data = tempfile::tempdir().unwrap();
    let flags = ["--otlp-endpoint", &url];
    let api = Server::start(data.path(), &[&flags[..], &["--role", "api"]].concat());
    let parent = format!("00-{TRACE}-b7ad6b7169203331-01");
    let taken = api.submit_with(&Form::sample(), &[("traceparent", &parent)]);
    let path = header(&taken, "location").to_owned();
    // One whose client does not want it traced.
    let unwanted = format!("00-{}-b7ad6b7169203331-00", "5".repeat(32));
    let other = header(&api.submit_with(&Form::sample(), &[("traceparent", &unwanted)]), "location").to_owned();
    let worker = Server::start(data.path(), &[&flags[..], &["--role", "worker"]].concat());
    assert_eq!((&api.wait(&path)["state"], &api.wait(&other)["state"]), (&json!("succeeded"), &json!("succeeded")));
    // What is not sent yet is sent when they stop.
    for server in [worker, api] {
        server.signal("-TERM");
        server.ended(PATIENCE);
    }
    let mut bodies = Vec::new();
    while let Ok(request) = received.try_recv() {
        assert!(
            request.starts_with("POST /v1/traces HTTP/1.1") && request.contains("application/x-protobuf"),
            "{request}"
        );
        bodies.push(request);
    }
    let all = bodies.concat();
    for name in
        ["POST /v1/jobs", "queue wait", "stage read", "stage pack", "stage write", "intarsia.job.state", "succeeded"]
    {
        assert!(all.contains(name), "no span tells of `{name}`");
    }
    // The ids are bytes in there: each span has that trace, and the request has the client's span for its parent.
    let told = |bytes: &str| all.matches(&String::from_utf8_lossy(&hex::decode(bytes).unwrap()).into_owned()).count();
    assert!(told(TRACE) >= 7, "{}", told(TRACE));
    assert_eq!((told("b7ad6b7169203331"), told(&"5".repeat(32))), (1, 0));
    assert!(bodies.len() >= 2, "both processes tell");
}
