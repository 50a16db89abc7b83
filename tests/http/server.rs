//! A server of one test: the program itself, on a free port, with a data folder of its own.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use serde_json::Value;
use ureq::http::Response;
use ureq::{Agent, Body};

/// How long what ends in seconds may take: the machine may have other work, and jobs make way for it.
pub const PATIENCE: Duration = Duration::from_secs(600);

pub struct Server {
    child: Child,
    agent: Agent,
    pub base: String,
    log: Option<PathBuf>,
}

impl Server {
    /// Starts a server over `data`.
    pub fn start(data: &Path, flags: &[&str]) -> Server {
        Server::spawn(data, &[flags, &["--log-level", "warn"]].concat(), Stdio::inherit())
    }

    /// Starts a server whose log is kept beside `data`, for [`Server::log`].
    pub fn start_with_log(data: &Path, flags: &[&str]) -> Server {
        let path = data.join("log");
        let log = std::fs::File::create(&path).unwrap();
        let mut server = Server::spawn(data, flags, log.into());
        server.log = Some(path);
        server
    }

    fn spawn(data: &Path, flags: &[&str], log: Stdio) -> Server {
        let mut child = Command::new(env!("CARGO_BIN_EXE_intarsia"))
            // As compose files pass on what they were not given.
            .envs(
                ["ALLOW_ORIGIN", "WEBHOOK_ALLOW", "WEBHOOK_SECRET", "RATE_LIMIT"]
                    .map(|n| (format!("INTARSIA_{n}"), "")),
            )
            .args(["serve", "--listen", "127.0.0.1:0", "--threads", "2", "--data-dir"])
            .arg(data)
            .args(flags)
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let base = line.trim().strip_prefix("listening on ").expect("the server tells its address").to_owned();
        let config = Agent::config_builder().http_status_as_error(false).timeout_global(Some(Duration::from_secs(60)));
        Server { child, agent: config.build().new_agent(), base, log: None }
    }

    /// GET with headers.
    pub fn get(&self, path: &str, headers: &[(&str, &str)]) -> Response<Body> {
        let request = self.agent.get(format!("{}{path}", self.base));
        headers.iter().fold(request, |r, (k, v)| r.header(*k, *v)).call().unwrap()
    }

    /// The whole body of a GET, or what kept it from coming.
    pub fn read(&self, path: &str) -> Result<Vec<u8>, ureq::Error> {
        self.agent.get(format!("{}{path}", self.base)).call().and_then(|mut r| r.body_mut().read_to_vec())
    }

    /// A request without a body.
    pub fn call(&self, method: &str, path: &str, headers: &[(&str, &str)]) -> Response<Body> {
        let request = ureq::http::Request::builder().method(method).uri(format!("{}{path}", self.base));
        let request = headers.iter().fold(request, |r, (k, v)| r.header(*k, *v));
        self.agent.run(request.body(()).unwrap()).unwrap()
    }

    /// A request with a body and headers.
    pub fn send(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Response<Body> {
        let request = ureq::http::Request::builder().method(method).uri(format!("{}{path}", self.base));
        let request = headers.iter().fold(request, |r, (k, v)| r.header(*k, *v));
        self.agent.run(request.body(body.to_vec()).unwrap()).unwrap()
    }

    /// POST of a form to a path with headers.
    pub fn send_form(&self, path: &str, form: &Form, headers: &[(&str, &str)]) -> Response<Body> {
        let (media_type, body) = form.encoded();
        self.send("POST", path, &[&[("content-type", media_type.as_str())], headers].concat(), &body)
    }

    /// POST of a body with headers.
    pub fn post_with(&self, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Response<Body> {
        let request = self.agent.post(format!("{}{path}", self.base));
        headers.iter().fold(request, |r, (k, v)| r.header(*k, *v)).send(body).unwrap()
    }

    /// POST of a form with headers.
    pub fn submit_with(&self, form: &Form, headers: &[(&str, &str)]) -> Response<Body> {
        let (media_type, body) = form.encoded();
        let request = self.agent.post(format!("{}/v1/jobs", self.base)).content_type(media_type);
        headers.iter().fold(request, |r, (k, v)| r.header(*k, *v)).send(&body[..]).unwrap()
    }

    /// POST of a body.
    pub fn post(&self, path: &str, media_type: &str, body: &[u8]) -> Response<Body> {
        self.agent.post(format!("{}{path}", self.base)).content_type(media_type).send(body).unwrap()
    }

    /// What a browser asks before a page of `origin` may POST.
    pub fn preflight(&self, path: &str, origin: &str) -> Response<Body> {
        let request = ureq::http::Request::builder().method("OPTIONS").uri(format!("{}{path}", self.base));
        let request = request.header("origin", origin).header("access-control-request-method", "POST");
        self.agent.run(request.body(()).unwrap()).unwrap()
    }

    /// DELETE.
    pub fn delete(&self, path: &str) -> Response<Body> {
        self.agent.delete(format!("{}{path}", self.base)).call().unwrap()
    }

    /// Submits a form.
    pub fn submit(&self, form: &Form) -> Response<Body> {
        self.submit_to("/v1/jobs", form)
    }

    /// Submits a form to a path.
    pub fn submit_to(&self, path: &str, form: &Form) -> Response<Body> {
        let (media_type, body) = form.encoded();
        self.post(path, &media_type, &body)
    }

    /// Submits a form from another address of this machine, and returns the answer as text.
    pub fn submit_from(&self, from: &str, form: &Form) -> String {
        use std::io::{Read, Write};
        let address = self.base.strip_prefix("http://").unwrap();
        let (media_type, body) = form.encoded();
        let socket = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None).unwrap();
        socket.bind(&format!("{from}:0").parse::<std::net::SocketAddr>().unwrap().into()).unwrap();
        socket.connect(&address.parse::<std::net::SocketAddr>().unwrap().into()).unwrap();
        let mut stream = std::net::TcpStream::from(socket);
        let head = format!(
            "POST /v1/jobs HTTP/1.1\r\nHost: {address}\r\nContent-Type: {media_type}\r\nContent-Length: {}\r\n\
             Connection: close\r\n\r\n",
            body.len()
        );
        stream.write_all(head.as_bytes()).unwrap();
        stream.write_all(&body).unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }

    /// Submits a form that is taken, and returns where its job is.
    pub fn accepted(&self, form: &Form) -> String {
        let mut response = self.submit(form);
        assert_eq!(response.status(), 202, "{}", json(&mut response));
        header(&response, "location").to_owned()
    }

    /// Follows a job to its end. Its progress never falls on the way.
    pub fn wait(&self, path: &str) -> Value {
        self.until(path, |job| !["queued", "running"].contains(&job["state"].as_str().unwrap()))
    }

    /// Follows a job until it is as wanted. Its progress never falls on the way.
    pub fn until(&self, path: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        let started = Instant::now();
        let mut last = 0.0;
        loop {
            let mut response = self.get(path, &[]);
            let job = json(&mut response);
            let fraction = job["progress"]["fraction"].as_f64().unwrap_or_else(|| panic!("no progress in {job}"));
            assert!(fraction >= last, "progress fell from {last} to {fraction}");
            last = fraction;
            if wanted(&job) {
                return job;
            }
            let seconds: u64 = header(&response, "retry-after").parse().unwrap();
            assert!(if job["state"] == "running" { seconds == 1 } else { (1..=60).contains(&seconds) }, "{seconds}");
            assert!(started.elapsed() < PATIENCE, "the job does not end: {job}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Most memory that the process has held, in bytes.
    #[cfg(target_os = "linux")]
    pub fn peak_memory(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:")).unwrap();
        line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
    }

    /// The lines of the log so far.
    pub fn log(&self) -> Vec<Value> {
        let text = std::fs::read_to_string(self.log.as_ref().unwrap()).unwrap();
        text.lines().map(|l| serde_json::from_str(l).unwrap()).collect()
    }

    /// Sends the process a signal.
    #[cfg(unix)]
    pub fn signal(&self, name: &str) {
        // The shell's own `kill`: the program of that name is not on every machine.
        let pid = self.child.id().to_string();
        let status = Command::new("sh").args(["-c", "kill \"$0\" \"$1\"", name, &pid]).status().unwrap();
        assert!(status.success());
    }

    /// Waits until the process has ended by itself, in time and without a complaint.
    pub fn ended(mut self, limit: Duration) {
        let started = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                assert!(status.success(), "{status}");
                return;
            }
            assert!(started.elapsed() < limit, "the service does not stop");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Ends the process at once, as a loss of power would.
    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A multipart form.
#[derive(Default)]
pub struct Form(Vec<u8>);

const BOUNDARY: &str = "a-boundary-that-no-file-holds-7d3f";

impl Form {
    /// A form with the sample model.
    pub fn sample() -> Form {
        Form::default().file("model", "sample.glb", sample())
    }

    /// A form with a scan that takes half a minute: for jobs that are not waited for.
    pub fn long() -> Form {
        static SCAN: LazyLock<Vec<u8>> = LazyLock::new(|| intarsia::asset::sample::sample("scan_10000").unwrap());
        Form::scan(&SCAN)
    }

    /// A form with a scan that takes some seconds: long enough to be at work when something happens, short enough to be waited for.
    pub fn short() -> Form {
        static SCAN: LazyLock<Vec<u8>> = LazyLock::new(|| intarsia::asset::sample::sample("scan_2000").unwrap());
        Form::scan(&SCAN)
    }

    fn scan(model: &[u8]) -> Form {
        Form::default().file("model", "scan.glb", model).text("options", r#"{"recipe": "scan"}"#)
    }

    pub fn file(mut self, field: &str, name: &str, bytes: &[u8]) -> Form {
        let head = format!(
            "--{BOUNDARY}\r\nContent-Disposition: form-data; name=\"{field}\"; filename=\"{name}\"\r\n\
             Content-Type: application/octet-stream\r\n\r\n"
        );
        self.0.extend(head.bytes().chain(bytes.iter().copied()).chain(*b"\r\n"));
        self
    }

    pub fn text(mut self, field: &str, text: &str) -> Form {
        let part = format!("--{BOUNDARY}\r\nContent-Disposition: form-data; name=\"{field}\"\r\n\r\n{text}\r\n");
        self.0.extend(part.bytes());
        self
    }

    fn encoded(&self) -> (String, Vec<u8>) {
        let mut body = self.0.clone();
        body.extend(format!("--{BOUNDARY}--\r\n").bytes());
        (format!("multipart/form-data; boundary={BOUNDARY}"), body)
    }
}

/// A model that the program makes itself; of those with charts enough to be packed anew it takes the least time.
pub fn sample() -> &'static [u8] {
    static SAMPLE: LazyLock<Vec<u8>> = LazyLock::new(|| intarsia::asset::sample::sample("skinned").unwrap());
    &SAMPLE
}

/// A GLB of that JSON and nothing else.
pub fn glb(json: &str) -> Vec<u8> {
    let json = format!("{json:<width$}", width = json.len().next_multiple_of(4));
    let mut out = b"glTF\x02\0\0\0".to_vec();
    out.extend((20 + json.len() as u32).to_le_bytes());
    out.extend((json.len() as u32).to_le_bytes());
    out.extend(b"JSON");
    out.extend(json.bytes());
    out
}

pub fn bytes(response: &mut Response<Body>) -> Vec<u8> {
    response.body_mut().with_config().limit(1 << 30).read_to_vec().unwrap()
}

pub fn json(response: &mut Response<Body>) -> Value {
    let body = bytes(response);
    serde_json::from_slice(&body).unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&body)))
}

pub fn header<'a>(response: &'a Response<Body>, name: &str) -> &'a str {
    let value = response.headers().get(name).unwrap_or_else(|| panic!("no header {name} in {:?}", response.headers()));
    value.to_str().unwrap()
}

/// An artifact of a job.
pub fn artifact<'a>(job: &'a Value, name: &str) -> &'a Value {
    let all = job["artifacts"].as_array().unwrap();
    all.iter().find(|a| a["name"] == name).unwrap_or_else(|| panic!("no artifact {name} in {all:#?}"))
}

/// The files of jobs in a data folder: uploads, and objects by their hashes.
pub fn left(data: &Path) -> Vec<String> {
    let mut files = Vec::new();
    let mut folders: Vec<_> = ["incoming", "uploads", "objects"].map(|f| data.join(f)).into();
    while let Some(folder) = folders.pop() {
        // A folder may go while it is looked for.
        for entry in std::fs::read_dir(folder).into_iter().flatten() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                files.push(path.file_name().unwrap().to_str().unwrap().to_owned());
            }
        }
    }
    files.sort();
    files
}
