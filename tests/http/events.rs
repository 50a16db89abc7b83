//! Server-sent events.

use serde_json::Value;

use crate::server::{Form, Server, bytes, header};

/// An event: name, id, data.
type Event = (String, String, Value);

fn events(server: &Server, path: &str, last: Option<&str>) -> Vec<Event> {
    let headers: Vec<(&str, &str)> = last.iter().map(|id| ("last-event-id", *id)).collect();
    let mut response = server.get(&format!("{path}/events"), &headers);
    assert_eq!(header(&response, "content-type"), "text/event-stream");
    let text = String::from_utf8(bytes(&mut response)).unwrap();
    let field = |event: &str, name: &str| -> String {
        let line = event.lines().find_map(|l| l.strip_prefix(name)?.strip_prefix(": "));
        line.unwrap_or_else(|| panic!("no {name} in {event}")).to_owned()
    };
    let blocks = text.split("\n\n").filter(|b| b.lines().any(|l| l.starts_with("data: ")));
    blocks.map(|b| (field(b, "event"), field(b, "id"), serde_json::from_str(&field(b, "data")).unwrap())).collect()
}

fn stages(events: &[Event]) -> Vec<String> {
    let progress = events.iter().filter(|e| e.0 == "progress");
    let mut stages: Vec<String> = progress.map(|e| e.2["stage"].as_str().unwrap().to_owned()).collect();
    stages.dedup();
    stages
}

#[test]
fn every_listener_sees_every_stage_and_the_end() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let path = server.accepted(&Form::sample());
    // Some while it runs, and one that comes when all is over.
    let early: Vec<Vec<Event>> = std::thread::scope(|s| {
        let listeners: Vec<_> = (0..8).map(|_| s.spawn(|| events(&server, &path, None))).collect();
        listeners.into_iter().map(|l| l.join().unwrap()).collect()
    });
    let late = events(&server, &path, None);
    for told in early.iter().chain([&late]) {
        assert_eq!(told[0].0, "snapshot");
        assert_eq!(stages(told), ["read", "pack", "bake", "write"], "{told:#?}");
        let fractions: Vec<f64> = told.iter().filter_map(|e| e.2["fraction"].as_f64()).collect();
        assert!(fractions.is_sorted(), "{fractions:?}");
        let (name, _, job) = told.last().unwrap();
        assert_eq!((name.as_str(), &job["state"]), ("state", &Value::from("succeeded")));
    }
}

#[test]
fn who_comes_back_is_told_what_was_missed_and_no_more() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let path = server.accepted(&Form::sample());
    let all = events(&server, &path, None);
    let bake = all.iter().find(|e| e.2["stage"] == "bake").unwrap();
    let rest = events(&server, &path, Some(&bake.1));
    assert_eq!((rest[0].0.as_str(), stages(&rest)), ("snapshot", vec!["write".to_owned()]), "{rest:#?}");
    assert_eq!(rest.last().unwrap().0, "state");
    // An id of another attempt, or none of ours, is no reason to be silent.
    for other in ["7.2.0", "what"] {
        assert_eq!(stages(&events(&server, &path, Some(other))).len(), 4, "{other}");
    }
}
