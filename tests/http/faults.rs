//! The machine's troubles: processes that die, disks that fill, queues that go.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::json;

use crate::server::{Form, PATIENCE, Server, artifact, header, json, left};

/// Waits until it is so.
fn eventually(what: &str, mut so: impl FnMut() -> bool) {
    let started = Instant::now();
    while !so() {
        assert!(started.elapsed() < PATIENCE, "not so in time: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn id(path: &str) -> &str {
    path.rsplit('/').next().unwrap()
}

/// The process of a job, if it has one.
#[cfg(target_os = "linux")]
fn process_of(job: &str) -> Option<u32> {
    let wanted = format!("\0attempt\0{job}\0");
    let processes = fs::read_dir("/proc").unwrap().filter_map(|e| e.unwrap().file_name().to_str()?.parse().ok());
    let is_it = |pid: &u32| {
        let alive = fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|s| !s.contains(") Z "));
        alive && fs::read_to_string(format!("/proc/{pid}/cmdline")).is_ok_and(|line| line.contains(&wanted))
    };
    processes.into_iter().find(is_it)
}

#[cfg(target_os = "linux")]
fn kill(pid: u32) {
    let status = Command::new("sh").args(["-c", "kill -KILL \"$0\"", &pid.to_string()]).status().unwrap();
    assert!(status.success());
}

#[cfg(target_os = "linux")]
#[test]
fn a_job_that_kills_its_process_fails_alone_and_a_service_that_dies_counts_against_nobody() {
    let data = tempfile::tempdir().unwrap();
    let start = || Server::start(data.path(), &["--jobs", "2"]);
    let mut server = start();
    let path = server.accepted(&Form::long());
    // However often the service dies, and whether the job runs in its process or in one of its own.
    for round in 0..4 {
        server.until(&path, |job| job["state"] == "running");
        if round > 0 {
            eventually("a suspect has a process of its own", || process_of(id(&path)).is_some());
        }
        server.kill();
        eventually("the process dies with its parent", || process_of(id(&path)).is_none());
        server = start();
    }
    for death in 1..=2 {
        let neighbour = server.accepted(&Form::sample());
        let mut process = None;
        eventually("it runs", || {
            process = process_of(id(&path));
            process.is_some()
        });
        kill(process.unwrap());
        assert_eq!(server.wait(&neighbour)["state"], "succeeded");
        let state = server.until(&path, |job| job["attempt"].as_u64() > Some(4 + death) || job["state"] == "failed");
        assert_eq!(state["state"] == "failed", death == 2, "{state:#}");
    }
    let job = server.wait(&path);
    assert_eq!(job["error"]["code"], "internal", "{job:#}");
    assert!(job["error"]["message"].as_str().unwrap().contains("died 2 times"), "{job:#}");
    let metrics = String::from_utf8(crate::server::bytes(&mut server.get("/metrics", &[]))).unwrap();
    assert!(metrics.contains("\nintarsia_job_deaths_total 2\n"), "{metrics}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_suspect_gives_the_result_that_any_job_gives_and_can_be_cancelled() {
    let data = tempfile::tempdir().unwrap();
    let first = Server::start(data.path(), &["--jobs", "2"]);
    let plain = first.wait(&first.accepted(&Form::sample()));
    let (long, short) = (first.accepted(&Form::long()), first.accepted(&Form::sample()));
    first.until(&long, |job| job["state"] == "running");
    first.until(&short, |job| job["state"] != "queued");
    first.kill();
    let second = Server::start(data.path(), &["--jobs", "2"]);
    let job = second.wait(&short);
    assert_eq!(job["state"], "succeeded");
    for name in ["model.glb", "report.json", "result.zip"] {
        assert_eq!(artifact(&job, name)["sha256"], artifact(&plain, name)["sha256"], "{name}");
    }
    assert_eq!(job["warnings"], plain["warnings"]);
    let stages = |job: &serde_json::Value| job["timings"].as_array().unwrap().len();
    assert_eq!(stages(&job), stages(&plain));
    eventually("it runs", || process_of(id(&long)).is_some());
    let started = Instant::now();
    assert_eq!(second.post(&format!("{long}/cancel"), "application/json", b"").status(), 202);
    assert_eq!(second.wait(&long)["state"], "canceled");
    assert!(started.elapsed() < Duration::from_secs(1), "{:?}", started.elapsed());
    eventually("its process is gone", || process_of(id(&long)).is_none());
    let owned: std::collections::BTreeSet<String> = [&plain, &job]
        .iter()
        .flat_map(|job| job["artifacts"].as_array().unwrap())
        .map(|a| a["sha256"].as_str().unwrap().to_owned())
        .collect();
    // What was uploaded for a cancelled job goes after its state is told.
    let owned: Vec<String> = owned.into_iter().collect();
    eventually("there is no file that no job owns", || left(data.path()) == owned);
}

/// Status and problem of /readyz.
fn readiness(server: &Server) -> (u16, String) {
    let mut response = server.get("/readyz", &[]);
    let status = response.status().as_u16();
    if status == 503 {
        assert!(header(&response, "retry-after").parse::<u32>().unwrap() > 0);
    }
    (status, json(&mut response)["detail"].as_str().unwrap_or_default().to_owned())
}

fn ready(server: &Server) -> bool {
    readiness(server).0 == 200
}

#[test]
fn a_result_that_cannot_be_stored_waits_until_it_can() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    // A file in the place of the folder: nothing can be stored below it, whoever the user is.
    let objects = data.path().join("objects");
    fs::remove_dir_all(&objects).unwrap();
    fs::write(&objects, "").unwrap();
    let path = server.accepted(&Form::sample());
    let job = server.until(&path, |job| job["progress"]["message"].as_str().unwrap().starts_with("waits: "));
    assert_eq!(job["state"], "running");
    fs::remove_file(&objects).unwrap();
    fs::create_dir(&objects).unwrap();
    let job = server.wait(&path);
    assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(1)), "{job:#}");
}

#[test]
fn a_service_without_space_says_so_and_takes_nothing() {
    let data = tempfile::tempdir().unwrap();
    let flags = ["--min-free", "1000000TB", "--log-format", "json", "--log-level", "warn"];
    let server = Server::start_with_log(data.path(), &flags);
    let (status, detail) = readiness(&server);
    assert_eq!(status, 503);
    assert!(detail.contains("MiB are free on the volume"), "{detail}");
    let mut refused = server.submit(&Form::sample());
    assert_eq!((refused.status().as_u16(), &json(&mut refused)["code"]), (507, &json!("insufficient_storage")));
    header(&refused, "retry-after");
    assert_eq!(server.get("/healthz", &[]).status(), 200, "it is alive");
    std::thread::sleep(Duration::from_millis(2500));
    let told: Vec<_> = server.log().into_iter().filter(|l| l.to_string().contains("not ready")).collect();
    assert_eq!(told.len(), 1, "told once: {told:#?}");
}

/// A small disk, where this system lets one be made.
#[cfg(target_os = "linux")]
struct SmallDisk(tempfile::TempDir);

#[cfg(target_os = "linux")]
impl SmallDisk {
    fn new(mebibytes: u32) -> Option<SmallDisk> {
        let folder = tempfile::tempdir().unwrap();
        let size = format!("size={mebibytes}m");
        let made = Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs"]).arg(folder.path()).output();
        made.is_ok_and(|o| o.status.success()).then_some(SmallDisk(folder))
    }

    fn fill(&self) {
        let mut file = fs::File::create(self.0.path().join("filler")).unwrap();
        let written = std::io::copy(&mut std::io::repeat(0), &mut file);
        assert_eq!(written.unwrap_err().kind(), std::io::ErrorKind::StorageFull);
    }

    fn empty(&self) {
        fs::remove_file(self.0.path().join("filler")).unwrap();
    }
}

#[cfg(target_os = "linux")]
impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0.path()).status();
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_fills_and_empties_under_load_loses_nothing() {
    let Some(disk) = SmallDisk::new(192) else {
        eprintln!("SKIPPED: this system lets no small disk be mounted");
        return;
    };
    let data = disk.0.path().join("data");
    let server = Server::start(&data, &["--min-free", "1MiB", "--jobs", "2"]);
    let rounds = std::env::var("INTARSIA_DRILL").ok().and_then(|n| n.parse().ok()).unwrap_or(3);
    let mut paths = Vec::new();
    for _ in 0..rounds {
        paths.extend((0..4).map(|_| server.accepted(&Form::sample())));
        server.until(paths.last().unwrap(), |job| job["state"] != "expired");
        disk.fill();
        eventually("it is not ready", || !ready(&server));
        let mut refused = server.submit(&Form::sample());
        assert_eq!(refused.status().as_u16(), 507, "{}", json(&mut refused));
        // Long enough for what is computed to want to be stored.
        std::thread::sleep(Duration::from_millis(500));
        disk.empty();
        eventually("it is ready again", || ready(&server));
    }
    for path in &paths {
        let job = server.wait(path);
        assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(1)), "{job:#}");
        assert_eq!(server.get(artifact(&job, "model.glb")["href"].as_str().unwrap(), &[]).status(), 200);
    }
}

/// A service that refuses to start: what it says.
fn refuses(data: &Path, flags: &[&str]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_intarsia"))
        .args(["serve", "--listen", "127.0.0.1:0", "--data-dir"])
        .arg(data)
        .args(flags)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Moves a queue with all that belongs to it.
fn rename(from: &Path, to: &Path) {
    for suffix in ["", "-wal", "-shm"] {
        let at = |path: &Path| format!("{}{suffix}", path.display());
        let _ = fs::remove_file(at(to));
        if Path::new(&at(from)).exists() {
            fs::rename(at(from), at(to)).unwrap();
        }
    }
}

/// A data folder with one job that has ended, and the job's path and model.
fn with_one_job(data: &Path) -> (String, Vec<u8>) {
    let server = Server::start(data, &[]);
    let path = server.accepted(&Form::sample());
    let job = server.wait(&path);
    let model = crate::server::bytes(&mut server.get(artifact(&job, "model.glb")["href"].as_str().unwrap(), &[]));
    server.kill();
    (path, model)
}

fn model_of(server: &Server, path: &str) -> Vec<u8> {
    crate::server::bytes(&mut server.get(&format!("{path}/artifacts/model.glb"), &[]))
}

#[test]
fn files_whose_queue_is_gone_stay_and_come_back_with_it() {
    let (data, aside) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (path, model) = with_one_job(data.path());
    let queue = data.path().join("queue.sqlite");
    rename(&queue, &aside.path().join("queue.sqlite"));
    let before = left(data.path());
    for _ in 0..2 {
        let server = Server::start_with_log(data.path(), &["--log-format", "json", "--log-level", "warn"]);
        assert_eq!(server.get(&path, &[]).status(), 404);
        let log = format!("{:?}", server.log());
        assert!(log.contains("the queue that knew them is gone"), "{log}");
        let new = server.wait(&server.accepted(&Form::sample()));
        assert_eq!(new["state"], "succeeded", "it goes on with a new queue");
        server.delete(&format!("/v1/jobs/{}", new["id"].as_str().unwrap()));
        std::thread::sleep(Duration::from_millis(300));
        assert!(before.iter().all(|file| left(data.path()).contains(file)), "nothing is removed");
        server.kill();
    }
    rename(&aside.path().join("queue.sqlite"), &queue);
    let server = Server::start(data.path(), &[]);
    assert_eq!(model_of(&server, &path), model);
    server.kill();
    // Given up in so many words, they go.
    rename(&queue, &aside.path().join("queue.sqlite"));
    let server = Server::start(data.path(), &["--adopt-store"]);
    eventually("nothing is left", || left(data.path()).is_empty());
    drop(server);
}

#[test]
fn a_queue_of_another_folder_or_a_damaged_one_is_refused_and_nothing_changes() {
    let (data, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (path, model) = with_one_job(data.path());
    with_one_job(other.path());
    let queue = data.path().join("queue.sqlite");
    let aside = data.path().join("aside");
    rename(&queue, &aside);
    rename(&other.path().join("queue.sqlite"), &queue);
    let before = left(data.path());
    let said = refuses(data.path(), &[]);
    assert!(said.contains("belongs to another data folder") && said.contains("--adopt-store"), "{said}");
    rename(&queue, &other.path().join("queue.sqlite"));
    for broken in [&b"no database at all, whatever its name says"[..], &[0; 5000]] {
        fs::write(&queue, broken).unwrap();
        let said = refuses(data.path(), &[]);
        assert!(said.contains("damaged") && said.contains("backup"), "{said}");
        assert_eq!(fs::read(&queue).unwrap(), broken);
        fs::remove_file(&queue).unwrap();
    }
    assert_eq!(left(data.path()), before);
    rename(&aside, &queue);
    let server = Server::start(data.path(), &[]);
    assert_eq!(model_of(&server, &path), model);
}

/// Loses the queue's file under a running service in the way of `lose`, and puts back what the service has saved of it.
#[cfg(unix)]
fn a_queue_lost_under_the_service(how: &str, lose: impl Fn(&Path)) {
    let data = tempfile::tempdir().unwrap();
    let flags = ["--log-format", "json", "--log-level", "warn"];
    let server = Server::start_with_log(data.path(), &flags);
    let path = server.accepted(&Form::sample());
    server.wait(&path);
    let waits = server.accepted(&Form::short());
    let queue = data.path().join("queue.sqlite");
    lose(&queue);
    let mut refused = server.submit(&Form::sample());
    assert_eq!((refused.status().as_u16(), &json(&mut refused)["code"]), (503, &json!("unavailable")));
    eventually("it is noticed", || !ready(&server));
    let (_, detail) = readiness(&server);
    assert!(detail.contains(&format!("was {how} while the service runs")) && detail.contains("rescued"), "{detail}");
    let rescued = data.path().join("queue.sqlite.rescued");
    eventually("what it held is saved", || rescued.exists());
    let before: Vec<String> = left(data.path()).into_iter().filter(|file| file != "probe").collect();
    std::thread::sleep(Duration::from_millis(2500));
    assert!(before.iter().all(|file| left(data.path()).contains(file)), "nothing is removed");
    for (part, times) in [("not ready", 1), ("what it held was written to", 1)] {
        let told = server.log().into_iter().filter(|l| l.to_string().contains(part)).count();
        assert_eq!(told, times, "{part}: {:#?}", server.log());
    }
    server.kill();
    rename(&rescued, &queue);
    let server = Server::start(data.path(), &[]);
    assert!(ready(&server));
    assert_eq!(json(&mut server.get(&path, &[]))["state"], "succeeded");
    assert_eq!(server.get(&format!("{path}/artifacts/model.glb"), &[]).status(), 200);
    assert_eq!(server.wait(&waits)["state"], "succeeded");
}

#[cfg(unix)]
#[test]
fn a_queue_that_is_removed_under_the_service_is_noticed_and_nothing_is_lost() {
    a_queue_lost_under_the_service("removed", |queue| fs::remove_file(queue).unwrap());
}

#[cfg(unix)]
#[test]
fn a_queue_that_is_replaced_under_the_service_is_noticed_and_nothing_is_lost() {
    a_queue_lost_under_the_service("replaced", |queue| {
        let other = tempfile::tempdir().unwrap();
        with_one_job(other.path());
        fs::rename(other.path().join("queue.sqlite"), queue).unwrap();
    });
}

#[cfg(unix)]
#[test]
fn a_queue_that_is_cut_short_under_the_service_is_noticed_and_nothing_is_lost() {
    a_queue_lost_under_the_service("cut short", |queue| {
        let length = fs::metadata(queue).unwrap().len();
        fs::File::options().write(true).open(queue).unwrap().set_len(length / 2).unwrap();
    });
}

#[test]
fn a_queue_that_was_cut_short_is_not_taken_for_a_new_one() {
    let data = tempfile::tempdir().unwrap();
    let (path, model) = with_one_job(data.path());
    let queue = data.path().join("queue.sqlite");
    let whole = fs::read(&queue).unwrap();
    // What the service wrote last stands beside it.
    let wal = fs::read(data.path().join("queue.sqlite-wal")).unwrap();
    assert!(!wal.is_empty());
    fs::write(&queue, "").unwrap();
    let said = refuses(data.path(), &[]);
    assert!(said.contains("cut short") && said.contains("backup"), "{said}");
    assert_eq!(fs::read(data.path().join("queue.sqlite-wal")).unwrap(), wal);
    fs::write(&queue, whole).unwrap();
    let server = Server::start(data.path(), &[]);
    assert_eq!(model_of(&server, &path), model);
}

#[test]
fn a_backup_made_while_the_service_runs_is_a_data_folder() {
    let (data, copies) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let to = copies.path().join("copy");
    let server = Server::start(data.path(), &[]);
    let done = server.accepted(&Form::sample());
    server.wait(&done);
    let model = model_of(&server, &done);
    let running = server.accepted(&Form::short());
    let waiting = server.accepted(&Form::sample());
    let output = Command::new(env!("CARGO_BIN_EXE_intarsia"))
        .args(["backup", to.to_str().unwrap(), "--data-dir", data.path().to_str().unwrap()])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // What happens to the original afterwards is nothing to the copy.
    for path in [&done, &running, &waiting] {
        assert_eq!(server.delete(path).status(), 204);
    }
    server.kill();
    let server = Server::start(&to, &["--jobs", "2"]);
    assert_eq!(model_of(&server, &done), model);
    for path in [&running, &waiting] {
        assert_eq!(server.wait(path)["state"], "succeeded");
    }
}

#[test]
fn what_is_stored_and_what_waits_have_caps() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--max-stored", "1KiB"]);
    let limits = json(&mut server.get("/v1/limits", &[]));
    assert_eq!(limits["max_stored_bytes"], 1024);
    let path = server.accepted(&Form::sample());
    server.wait(&path);
    let mut refused = server.submit(&Form::sample());
    assert_eq!((refused.status().as_u16(), &json(&mut refused)["code"]), (507, &json!("insufficient_storage")));
    server.delete(&path);
    server.accepted(&Form::sample());
    server.kill();
    let server = Server::start(data.path(), &["--max-waiting", "1KiB"]);
    let mut refused = server.submit(&Form::sample());
    assert_eq!((refused.status().as_u16(), &json(&mut refused)["code"]), (503, &json!("queue_full")));
}
