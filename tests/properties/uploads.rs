//! Damaged submissions to the service itself.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::fixture::{file, obj, tiny, zip};
use super::mutate::{self, Random};

const BOUNDARY: &str = "a-boundary-7d3f";

/// A form with a model, a side file and options.
fn form(model: &str, bytes: &[u8]) -> Vec<u8> {
    let mut body = Vec::new();
    let options = br#"{"recipe": "pack", "pack": {"gutter": 2}, "metadata": {"a": [1, null]}}"#;
    for (head, bytes) in [
        (format!("name=\"model\"; filename=\"{model}\"\r\nContent-Type: application/octet-stream"), bytes),
        ("name=\"files\"; filename=\"t/a b.png\"\r\nContent-Type: image/png".to_owned(), b"no picture"),
        ("name=\"options\"\r\nContent-Type: application/json".to_owned(), &options[..]),
    ] {
        body.extend(format!("--{BOUNDARY}\r\nContent-Disposition: form-data; {head}\r\n\r\n").bytes());
        body.extend(bytes);
        body.extend(b"\r\n");
    }
    body.extend(format!("--{BOUNDARY}--\r\n").bytes());
    body
}

/// The service, ended with the test.
struct Service(Child);

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn damaged_submissions_are_answered_and_the_service_lives_on() {
    let data = tempfile::tempdir().expect("a folder");
    let child = Command::new(env!("CARGO_BIN_EXE_intarsia"))
        .args(["serve", "--listen", "127.0.0.1:0", "--threads", "1", "--log-level", "off", "--max-upload", "4MiB"])
        .args(["--max-queued", "100000", "--data-dir"])
        .arg(data.path())
        .stdout(Stdio::piped())
        .spawn()
        .expect("the service starts");
    let mut service = Service(child);
    let mut line = String::new();
    BufReader::new(service.0.stdout.take().expect("its output")).read_line(&mut line).expect("a line");
    let base = line.trim().strip_prefix("listening on ").expect("an address").to_owned();
    let config = ureq::Agent::config_builder()
        .http_status_as_error(false)
        .timeout_global(Some(Duration::from_secs(60)))
        .build()
        .new_agent();

    let glb = tiny().to_glb().expect("a GLB");
    let bodies = [form("m.glb", &glb), form("m.obj", &obj()[0].bytes), form("m.zip", &zip(&[file("m.glb", &glb)]))];
    let mut answers = std::collections::BTreeMap::new();
    for number in 0..300 {
        let mut random = Random::new(number);
        let mut body = random.pick(&bodies).clone();
        // Half of the damage is dealt to the form around the model.
        if random.below(2) == 0 {
            mutate::bytes(&mut random, &mut body);
        } else {
            let end = if random.below(2) == 0 { 200 } else { body.len() };
            let mut part = body.split_off(body.len() - end.min(body.len()));
            mutate::bytes(&mut random, &mut part);
            body.extend(part);
        }
        let start = Instant::now();
        let answer = config
            .post(format!("{base}/v1/jobs"))
            .content_type(format!("multipart/form-data; boundary={BOUNDARY}"))
            .send(&body[..])
            .unwrap_or_else(|e| panic!("case {number}: {e}"));
        let status = answer.status().as_u16();
        assert!([202, 400, 413, 415, 422].contains(&status), "case {number}: {status}");
        assert!(start.elapsed().as_secs_f64() < 10.0, "case {number} takes {:?}", start.elapsed());
        *answers.entry(status).or_insert(0) += 1;
    }
    println!("answers by status: {answers:?}");
    assert!(answers.len() > 2, "the damage tries too little: {answers:?}");
    let health = config.get(format!("{base}/healthz")).call().expect("an answer").status();
    assert_eq!(health, 200, "the service lives on");
    let status = std::fs::read_to_string(format!("/proc/{}/status", service.0.id())).unwrap_or_default();
    let peak = status.lines().find_map(|l| l.strip_prefix("VmHWM:")?.trim().strip_suffix(" kB")?.parse::<u64>().ok());
    assert!(peak.is_none_or(|kib| kib < 400 << 10), "the service held {peak:?} KiB");
}
