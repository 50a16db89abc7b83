//! `intarsia serve`: the HTTP service.

use std::io::IsTerminal;
use std::net::{SocketAddr, TcpListener};
use std::time::Duration;

use axum_server::accept::NoDelayAcceptor;
use hyper_util::rt::TokioTimer;
use intarsia::config::{LogFormat, Role, Serve};
use intarsia::error::{Code, Failure, Result};
use intarsia::http::App;
use intarsia::http::router::router;
use intarsia::http::sites::Sites;
use intarsia::jobs::Jobs;
use intarsia::jobs::otlp::Otlp;
use tokio::time::timeout;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// How long, beyond the grace of running jobs, requests and jobs may take to end when the service is told to stop.
const PATIENCE: Duration = Duration::from_secs(10);

/// The file of the data folder that has the address of the service.
pub const ADDRESS: &str = "address";

/// How long the head of a request may take, and a connection may wait for the next one.
const HEADERS: Duration = Duration::from_secs(60);

/// Serves until it is told to stop (SIGINT, SIGTERM). The running job then goes back to the queue.
pub fn run(arguments: &Serve) -> Result<()> {
    log(arguments);
    // The runtime only moves bytes; what computes has the rayon pool.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .map_err(|e| Failure::internal(format!("no runtime: {e}")))?;
    let done = runtime.block_on(serve(arguments));
    runtime.shutdown_timeout(Duration::from_secs(1));
    done
}

async fn serve(arguments: &Serve) -> Result<()> {
    if arguments.exit_when_idle && arguments.role == Role::Api {
        let message = "--exit-when-idle is for who runs jobs, and --role api runs none";
        return Err(Failure::new(Code::InvalidRequest, message));
    }
    // A service with many listeners has many open files.
    if let Err(error) = rlimit::increase_nofile_limit(u64::MAX) {
        tracing::warn!(%error, "the limit of open files stays as it is");
    }
    let sites = Sites::new(&arguments.allow_origin, &arguments.allow_host, arguments.listen)?;
    let jobs = Jobs::open(
        &arguments.data_dir,
        &arguments.work,
        arguments.limits.clone(),
        &arguments.storage,
        &arguments.webhooks,
    )
    .await?;
    let endpoint = arguments.otlp_endpoint.clone().or_else(|| std::env::var("OTEL_EXPORTER_OTLP_ENDPOINT").ok());
    if let Some(endpoint) = endpoint.filter(|endpoint| !endpoint.is_empty()) {
        jobs.telemetry.spans.send_to(Otlp::new(&endpoint)?);
    }
    let service = router(App::new(jobs.clone(), arguments.access.clone()), sites, arguments.role);
    let failed =
        |e: std::io::Error| Failure::new(Code::InvalidRequest, format!("cannot listen on {}: {e}", arguments.listen));
    let listener = TcpListener::bind(arguments.listen).map_err(failed)?;
    listener.set_nonblocking(true).map_err(failed)?;
    let address = listener.local_addr().map_err(failed)?;
    let handle = axum_server::Handle::new();
    let mut server =
        axum_server::from_tcp(listener).map_err(failed)?.acceptor(NoDelayAcceptor::new()).handle(handle.clone());
    server = server.first_request_timeout(HEADERS);
    // Half a request holds its connection only for a while.
    server.http_builder().http1().timer(TokioTimer::new()).header_read_timeout(HEADERS);
    let (works, jobs_of_worker) = (arguments.role != Role::Api, jobs.clone());
    let exit_when_idle = arguments.exit_when_idle;
    let worker = tokio::spawn(async move {
        if works {
            jobs_of_worker.work(exit_when_idle).await;
        }
    });
    let maintenance = tokio::spawn(jobs.clone().run_maintenance());
    tokio::spawn(jobs.clone().watch());
    tokio::spawn(jobs.clone().listen());
    tokio::spawn(jobs.webhooks.clone().run(jobs.shutdown.clone()));
    // For `intarsia health`, which does not know how this process was started. Where it cannot be written, the service has other troubles.
    let _ = std::fs::write(arguments.data_dir.join(ADDRESS), format!("{address}\n"));
    super::print(&format!("listening on http://{address}\n"))?;

    let shutdown = jobs.shutdown.clone();
    tokio::spawn(async move {
        told_to_stop().await;
        tracing::info!("stopping");
        shutdown.cancel();
    });
    let server = tokio::spawn(server.serve(service.into_make_service_with_connect_info::<SocketAddr>()));
    jobs.shutdown.cancelled().await;
    // Whatever does not end in time is cut off: the queue is made for that.
    let limit = arguments.work.grace.saturating_add(PATIENCE);
    handle.graceful_shutdown(Some(limit));
    let _ = timeout(limit, async { tokio::join!(worker, maintenance, server) }).await;
    // It waits for the collector, for a while.
    let _ = tokio::task::spawn_blocking(move || jobs.telemetry.spans.flush()).await;
    Ok(())
}

#[cfg(unix)]
async fn told_to_stop() {
    use tokio::signal::unix::{SignalKind, signal};
    let Ok(mut terminate) = signal(SignalKind::terminate()) else { return std::future::pending().await };
    tokio::select! {
        _ = terminate.recv() => {}
        _ = tokio::signal::ctrl_c() => {}
    }
}

#[cfg(not(unix))]
async fn told_to_stop() {
    if tokio::signal::ctrl_c().await.is_err() {
        std::future::pending().await
    }
}

fn log(arguments: &Serve) {
    let level = arguments.log_level;
    // What a database answers while it restarts is told by whoever asked it, once.
    let database = if level > LevelFilter::INFO { level } else { level.min(LevelFilter::ERROR) };
    let targets = Targets::new().with_default(level).with_target("sqlx", database);
    let lines = tracing_subscriber::fmt().with_max_level(level).with_writer(std::io::stderr);
    let lines = lines.with_ansi(std::io::stderr().is_terminal());
    match arguments.log_format {
        LogFormat::Text => lines.finish().with(targets).init(),
        LogFormat::Json => lines.json().finish().with(targets).init(),
    }
}
