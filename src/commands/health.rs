//! `intarsia health`: asks a running service whether it is alive, where there is no other program to ask with.

use std::io::{Read, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream};
use std::time::Duration;

use intarsia::config::Health;
use intarsia::error::{Code, Failure, Result};

/// How long an answer may take.
const PATIENCE: Duration = Duration::from_secs(3);

/// Succeeds when the service says that it is alive.
pub fn run(arguments: &Health) -> Result<()> {
    let noted = || {
        let path = arguments.data_dir.join(super::serve::ADDRESS);
        let text = std::fs::read_to_string(&path);
        let noted = text.ok().and_then(|text| text.trim().parse().ok());
        noted.ok_or_else(|| {
            Failure::new(
                Code::Internal,
                format!("no service has noted its address in {}: is one running with that --data-dir?", path.display()),
            )
        })
    };
    let address = reachable(arguments.listen.map_or_else(noted, Ok)?);
    let unwell = |why: String| Failure::new(Code::Internal, format!("the service at {address} {why}"));
    let ask = || -> std::io::Result<Vec<u8>> {
        let mut stream = TcpStream::connect_timeout(&address, PATIENCE)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream
            .write_all(format!("GET /healthz HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").as_bytes())?;
        let mut head = vec![0; 12];
        stream.read_exact(&mut head)?;
        Ok(head)
    };
    match ask() {
        Ok(head) if head == b"HTTP/1.1 200" => super::print("ok\n"),
        Ok(head) => Err(unwell(format!("answers {}", String::from_utf8_lossy(&head)))),
        Err(error) => Err(unwell(format!("does not answer: {error}"))),
    }
}

/// Where a service that listens on all addresses can be asked from this machine.
fn reachable(listen: SocketAddr) -> SocketAddr {
    let ip = match listen.ip() {
        ip if !ip.is_unspecified() => ip,
        IpAddr::V4(_) => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(_) => Ipv6Addr::LOCALHOST.into(),
    };
    SocketAddr::new(ip, listen.port())
}
