//! Every flag, environment variable and limit, with its default.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum};
use ipnet::IpNet;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Refines the texture atlases of 3D models.
#[derive(Debug, Parser)]
#[command(name = "intarsia", version, about, propagate_version = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the HTTP service.
    Serve(Box<Serve>),
    /// Refine a model: repack its charts, resample its textures.
    Refine(Refine),
    /// Show the figures of every atlas in a model; nothing is written.
    Inspect(Inspect),
    /// Write a model made by code, to try things on.
    Sample(Sample),
    /// Print the OpenAPI document of the service.
    Openapi,
    /// Create, list and revoke the API keys of a service.
    Keys(Keys),
    /// Copy the data folder of a service, which may go on running, as of one moment.
    Backup(Backup),
    /// Compute one job for the service that starts this; not for people.
    #[command(hide = true)]
    Attempt {
        /// The job, for those who look at the list of processes.
        job: String,
    },
    /// Ask a running service on this machine whether it is alive; exit code 0 when it is.
    Health(Health),
}

/// `intarsia serve`: every flag is also an environment variable.
#[derive(Debug, Clone, Args)]
pub struct Serve {
    /// Address to listen on; port 0 takes a free one.
    #[arg(long, env = "INTARSIA_LISTEN", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
    /// Folder of the queue, the uploads and the results.
    #[arg(long, env = "INTARSIA_DATA_DIR", default_value = "./intarsia-data")]
    pub data_dir: PathBuf,
    /// What this process does; several may share a data folder.
    #[arg(long, env = "INTARSIA_ROLE", value_enum, default_value_t = Role::All)]
    pub role: Role,
    /// End when no job waits that this process could run, and none runs: for workers that an orchestrator starts as they are needed.
    #[arg(long, env = "INTARSIA_EXIT_WHEN_IDLE")]
    pub exit_when_idle: bool,
    /// How the data folder is looked after.
    #[command(flatten)]
    pub storage: Storage,
    /// How jobs are run.
    #[command(flatten)]
    pub work: Work,
    /// Origin that browsers may call from, or `*`; may be given several times.
    #[arg(long, env = "INTARSIA_ALLOW_ORIGIN", value_delimiter = ',')]
    pub allow_origin: Vec<String>,
    /// Further name that the service answers to where it listens on this machine alone, such as one that a proxy keeps; may be given several
    /// times.
    #[arg(long, env = "INTARSIA_ALLOW_HOST", value_delimiter = ',')]
    pub allow_host: Vec<String>,
    /// Who may call.
    #[command(flatten)]
    pub access: Access,
    /// Who is told.
    #[command(flatten)]
    pub webhooks: Webhooks,
    /// Collector that traces are sent to by OTLP over HTTP, such as http://127.0.0.1:4318; OTEL_EXPORTER_OTLP_ENDPOINT names it too. Without it, traces
    /// are in the logs and in webhooks alone.
    #[arg(long, env = "INTARSIA_OTLP_ENDPOINT", value_name = "URL")]
    pub otlp_endpoint: Option<String>,
    /// Form of the log lines on stderr.
    #[arg(long, env = "INTARSIA_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    pub log_format: LogFormat,
    /// Least severe log lines that are shown: error, warn, info, debug, trace or off.
    #[arg(long, env = "INTARSIA_LOG_LEVEL", default_value = "info")]
    pub log_level: tracing::level_filters::LevelFilter,
    /// What is refused, and what is kept how long.
    #[command(flatten)]
    pub limits: Limits,
}

/// Who may call the service, and how often.
#[derive(Debug, Clone, Default, PartialEq, Eq, Args)]
pub struct Access {
    /// Whether callers need an API key; keys are made by `intarsia keys create`.
    #[arg(long, env = "INTARSIA_AUTH", value_enum, default_value_t = Auth::None)]
    pub auth: Auth,
    /// Let anybody list all jobs (GET /v1/jobs). With keys, each tenant lists its own.
    #[arg(long, env = "INTARSIA_LIST_JOBS")]
    pub list_jobs: bool,
    /// Requests in a minute that each key, or each address without one, may send; without it, any number. A key may have a limit of its own.
    #[arg(long, env = "INTARSIA_RATE_LIMIT", value_parser = clap::value_parser!(u32).range(1..))]
    pub rate_limit: Option<u32>,
}

/// Where webhooks may go, and how those are signed that a job names.
#[derive(Debug, Clone, Default, PartialEq, Eq, Args)]
pub struct Webhooks {
    /// Network (such as 10.1.0.0/16) that webhooks may reach although it is not of the open internet; may be given several times.
    #[arg(long, env = "INTARSIA_WEBHOOK_ALLOW", value_name = "CIDR", value_delimiter = ',')]
    pub webhook_allow: Vec<IpNet>,
    /// Secret (`whsec_` and 24 bytes or more in base64) of what is told to the `webhook` of a job; without it, jobs may name none. Several
    /// while they rotate, the newest first. Better given by the environment: others on the machine can read command lines.
    #[arg(long, env = "INTARSIA_WEBHOOK_SECRET", value_name = "SECRET", value_delimiter = ',', hide_env_values = true)]
    pub webhook_secret: Vec<Secret>,
}

/// What stands in no help, log or answer.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

impl Secret {
    /// The secret itself.
    pub fn text(&self) -> &str {
        &self.0
    }
}

impl std::str::FromStr for Secret {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(Secret(text.to_owned()))
    }
}

impl std::fmt::Debug for Secret {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("(secret)")
    }
}

/// Where the queue stands. It may hold a password, so nothing shows it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QueueAddress(Secret);

impl QueueAddress {
    /// The URL of PostgreSQL; `None` for the file in the data folder.
    ///
    /// # Errors
    /// `invalid_request` for anything else.
    pub fn postgres(&self) -> crate::error::Result<Option<&Secret>> {
        match self.0.text() {
            "sqlite" => Ok(None),
            url if url.starts_with("postgres://") || url.starts_with("postgresql://") => Ok(Some(&self.0)),
            // Not repeated: it may be a password with a typing error before it.
            _ => {
                let message = "--queue is neither `sqlite` nor `postgres://USER:PASSWORD@HOST:PORT/DATABASE`";
                Err(crate::error::Failure::new(crate::error::Code::InvalidRequest, message))
            }
        }
    }
}

impl Default for QueueAddress {
    fn default() -> Self {
        QueueAddress(Secret("sqlite".to_owned()))
    }
}

impl std::str::FromStr for QueueAddress {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(QueueAddress(Secret(text.to_owned())))
    }
}

/// Whether callers need an API key.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum Auth {
    /// Anybody may call; knowing the id of a job is the right to read it.
    #[default]
    None,
    /// Only who has a key; each tenant has its own jobs.
    Keys,
}

/// What a key is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Scope {
    /// Submit, cancel and delete jobs of the tenant.
    Submit,
    /// Read and list jobs of the tenant, and fetch their artifacts.
    Read,
    /// Make, list and revoke keys of all tenants, and read the metrics.
    Admin,
}

impl Scope {
    /// The name in JSON.
    pub fn as_str(self) -> &'static str {
        match self {
            Scope::Submit => "submit",
            Scope::Read => "read",
            Scope::Admin => "admin",
        }
    }
}

/// What a tenant may have while it uses a key; null is any number.
#[derive(Debug, Clone, Default, PartialEq, Eq, Args, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Quotas {
    /// Jobs of the tenant that wait.
    #[arg(long)]
    #[schema(minimum = 0)]
    pub max_queued: Option<u32>,
    /// Jobs of the tenant that run at once; further ones wait.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..))]
    #[schema(minimum = 1)]
    pub max_running: Option<u32>,
    /// Bytes of the tenant's uploads and artifacts that are kept.
    #[arg(long, value_parser = parse_size)]
    #[schema(minimum = 0)]
    pub max_stored: Option<u64>,
    /// Submissions of the tenant that are received at the same time, and its uploads in pieces that are not complete.
    #[arg(long)]
    #[schema(minimum = 0)]
    pub max_uploads: Option<u32>,
    /// Requests with this key in a minute.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..))]
    #[schema(minimum = 1)]
    pub rate_limit: Option<u32>,
}

/// `intarsia keys`.
#[derive(Debug, Clone, Args)]
pub struct Keys {
    /// Folder of the queue, the uploads and the results.
    #[arg(long, env = "INTARSIA_DATA_DIR", default_value = "./intarsia-data", global = true)]
    pub data_dir: PathBuf,
    /// The service's `--queue`: its keys are there.
    #[arg(
        long,
        env = "INTARSIA_QUEUE",
        value_name = "ADDRESS",
        default_value = "sqlite",
        hide_env_values = true,
        global = true
    )]
    pub queue: QueueAddress,
    /// What to do.
    #[command(subcommand)]
    pub command: KeysCommand,
}

/// What to do with keys.
#[derive(Debug, Clone, Subcommand)]
pub enum KeysCommand {
    /// Make a key. Its token goes to stdout, this once.
    Create {
        /// Whose jobs it works on: 1 to 64 letters, digits, `.`, `_` or `-`.
        #[arg(long)]
        tenant: String,
        /// What it is for; may be given several times.
        #[arg(long, value_enum, value_delimiter = ',', default_values_t = [Scope::Submit, Scope::Read])]
        scope: Vec<Scope>,
        /// What people call it.
        #[arg(long, default_value = "")]
        name: String,
        /// What its tenant may have.
        #[command(flatten)]
        quotas: Quotas,
    },
    /// List all keys; no token is shown.
    List {
        /// Print them as JSON.
        #[arg(long)]
        json: bool,
    },
    /// Revoke a key: it stops within a second.
    Revoke {
        /// Its id.
        id: String,
    },
}

/// What a process of the service does.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum Role {
    /// Takes jobs and runs them.
    #[default]
    All,
    /// Takes jobs, tells of them, and runs none.
    Api,
    /// Runs jobs; answers only /healthz, /readyz, /metrics and /openapi.json.
    Worker,
}

/// Form of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// For people.
    Text,
    /// One JSON object a line.
    Json,
}

/// `intarsia health`.
#[derive(Debug, Clone, Args)]
pub struct Health {
    /// Address that the service listens on; without it, the one that the service has noted in its data folder.
    #[arg(long)]
    pub listen: Option<SocketAddr>,
    /// Folder of the queue, the uploads and the results.
    #[arg(long, env = "INTARSIA_DATA_DIR", default_value = "./intarsia-data")]
    pub data_dir: PathBuf,
}

/// How the service looks after its data folder.
#[derive(Debug, Clone, Default, PartialEq, Eq, Args)]
pub struct Storage {
    /// Bytes that must be free on the volume of the data folder; with fewer, the service takes and starts no jobs, and says on /readyz that
    /// it is not ready. Without it, 64MiB, or a tenth of the volume where that is less.
    #[arg(long, env = "INTARSIA_MIN_FREE", value_parser = parse_size)]
    pub min_free: Option<u64>,
    /// Where the queue stands: `sqlite`, a file in the data folder, for any number of processes on one machine; or
    /// `postgres://USER:PASSWORD@HOST:PORT/DATABASE`, for any number of machines, with API keys and webhooks. Better given by the environment:
    /// others on the machine can read command lines.
    #[arg(long, env = "INTARSIA_QUEUE", value_name = "ADDRESS", default_value = "sqlite", hide_env_values = true)]
    pub queue: QueueAddress,
    /// Where uploads wait and results are kept: a folder, or `s3://BUCKET/PREFIX`, which machines can share; the endpoint and the credentials
    /// come from the usual AWS_ variables of the environment. Without it, the data folder.
    #[arg(long, env = "INTARSIA_STORE", value_name = "ADDRESS")]
    pub store: Option<String>,
    /// Take over stored files whose own queue is lost: what this queue does not know is removed.
    #[arg(long, env = "INTARSIA_ADOPT_STORE")]
    pub adopt_store: bool,
}

/// `intarsia backup`.
#[derive(Debug, Clone, Args)]
pub struct Backup {
    /// A folder that does not exist yet, or is empty.
    pub to: PathBuf,
    /// Folder of the queue, the uploads and the results.
    #[arg(long, env = "INTARSIA_DATA_DIR", default_value = "./intarsia-data")]
    pub data_dir: PathBuf,
}

/// How the service runs jobs.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
pub struct Work {
    /// Threads of one job; 0 takes all cores.
    #[arg(long, env = "INTARSIA_THREADS", default_value_t = 0)]
    pub threads: usize,
    /// Jobs that run at once; where there are several, one of them is always a small one.
    #[arg(long, env = "INTARSIA_JOBS", default_value_t = 3, value_parser = clap::value_parser!(u16).range(1..=256))]
    pub jobs: u16,
    /// Bytes that running jobs may need together, by an estimate from the headers of their files; without it, three quarters of what the
    /// machine (or its control group) has.
    #[arg(long, env = "INTARSIA_MEMORY", value_parser = parse_size)]
    pub memory: Option<u64>,
    /// How long a worker that does not move is believed to be alive.
    #[arg(long, env = "INTARSIA_LEASE", default_value = "30s", value_parser = parse_duration)]
    pub lease: Duration,
    /// How long running jobs may go on when the service is told to stop; then they go back to the queue.
    #[arg(long, env = "INTARSIA_GRACE", default_value = "5s", value_parser = parse_duration)]
    pub grace: Duration,
}

impl Work {
    /// Bytes that running jobs may need together.
    pub fn memory(&self) -> u64 {
        self.memory.unwrap_or_else(|| machine_memory().unwrap_or(8 << 30) / 4 * 3).max(1)
    }
}

/// Bytes of memory of the machine, or of the control group that the process is in, where that is less.
fn machine_memory() -> Option<u64> {
    let info = std::fs::read_to_string("/proc/meminfo").ok()?;
    let total =
        info.lines().find_map(|l| l.strip_prefix("MemTotal:"))?.trim().strip_suffix(" kB")?.parse::<u64>().ok()? * 1024;
    let group =
        std::fs::read_to_string("/sys/fs/cgroup/memory.max").ok().and_then(|text| text.trim().parse::<u64>().ok());
    Some(group.map_or(total, |group| group.min(total)))
}

/// What the service refuses, and what it keeps how long.
#[derive(Debug, Clone, PartialEq, Eq, Args)]
pub struct Limits {
    /// Bytes of one submission, all files together.
    #[arg(long, env = "INTARSIA_MAX_UPLOAD", default_value = "1GiB", value_parser = parse_size)]
    pub max_upload: u64,
    /// Files of one submission.
    #[arg(long, env = "INTARSIA_MAX_FILES", default_value_t = 1000)]
    pub max_files: usize,
    /// Submissions that are received at the same time; further ones are told to come back.
    #[arg(long, env = "INTARSIA_MAX_UPLOADS", default_value_t = 32)]
    pub max_uploads: usize,
    /// Seconds (or 30s, 5m) that an upload may stand still.
    #[arg(long, env = "INTARSIA_UPLOAD_IDLE", default_value = "60s", value_parser = parse_duration)]
    pub upload_idle: Duration,
    /// Bytes of the uploads of all jobs that wait or run; further ones are told to come back.
    #[arg(long, env = "INTARSIA_MAX_WAITING", default_value = "32GiB", value_parser = parse_size)]
    pub max_waiting: u64,
    /// Bytes of all artifacts that are kept; where there are more, submissions are told to come back.
    #[arg(long, env = "INTARSIA_MAX_STORED", default_value = "100GiB", value_parser = parse_size)]
    pub max_stored: u64,
    /// Bytes a second that an upload must send on average, from its twentieth second on.
    #[arg(long, env = "INTARSIA_MIN_UPLOAD_RATE", default_value = "4KiB", value_parser = parse_size)]
    pub min_upload_rate: u64,
    /// Jobs that wait; further ones are told to come back.
    #[arg(long, env = "INTARSIA_MAX_QUEUED", default_value_t = 1000)]
    pub max_queued: u32,
    /// Texels of one image.
    #[arg(long, env = "INTARSIA_MAX_IMAGE_PIXELS", default_value_t = 16384 * 16384)]
    pub max_image_pixels: u64,
    /// Triangles of one model.
    #[arg(long, env = "INTARSIA_MAX_TRIANGLES", default_value_t = 20_000_000)]
    pub max_triangles: u64,
    /// Bytes of a model's JSON.
    #[arg(long, env = "INTARSIA_MAX_JSON", default_value = "256MiB", value_parser = parse_size)]
    pub max_json: u64,
    /// How long a job may wait before it expires.
    #[arg(long, env = "INTARSIA_MAX_WAIT", default_value = "1d", value_parser = parse_duration)]
    pub max_wait: Duration,
    /// How long artifacts are kept after a job ends.
    #[arg(long, env = "INTARSIA_KEEP_ARTIFACTS", default_value = "7d", value_parser = parse_duration)]
    pub keep_artifacts: Duration,
    /// Uploads in pieces (/v1/uploads) that are kept, complete or not; a tenant may have half of them.
    #[arg(long, env = "INTARSIA_MAX_KEPT_UPLOADS", default_value_t = 1000)]
    pub max_kept_uploads: u32,
    /// How long an upload in pieces is kept after its last byte came.
    #[arg(long, env = "INTARSIA_KEEP_UPLOADS", default_value = "1d", value_parser = parse_duration)]
    pub keep_uploads: Duration,
    /// How long a job can be asked for after it ends; at least as long as its artifacts.
    #[arg(long, env = "INTARSIA_KEEP_JOBS", default_value = "30d", value_parser = parse_duration)]
    pub keep_jobs: Duration,
}

/// Options of a job, as the command line gives them.
#[derive(Debug, Clone, Default, Args)]
pub struct OptionFlags {
    /// A preset, a stage, or stages joined by commas.
    #[arg(long, value_name = "NAME")]
    pub recipe: Option<String>,
    /// Options as JSON.
    #[arg(long, value_name = "FILE", conflicts_with = "recipe")]
    pub options: Option<PathBuf>,
    /// One option by its dotted path, such as pack.rotation=any; wins over the file; may be given several times.
    #[arg(long, value_name = "PATH=VALUE")]
    pub set: Vec<String>,
}

/// `intarsia refine`.
#[derive(Debug, Clone, Args)]
pub struct Refine {
    /// Models (.glb, .gltf, .obj, .b3dm, .i3dm, .zip), which share one atlas where there are several; other files are taken as
    /// files that they name.
    #[arg(required = true)]
    pub input: Vec<PathBuf>,
    /// The refined model: .glb, .gltf with its files beside it, or the .b3dm or .i3dm that the input was. Several become NAME-0, NAME-1, … in the order of the
    /// input.
    #[arg(short, long)]
    pub output: PathBuf,
    /// What to do with it.
    #[command(flatten)]
    pub options: OptionFlags,
    /// Write the report here.
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
    /// Write pictures of the atlases, before and after, into this folder.
    #[arg(long, value_name = "DIR")]
    pub pictures: Option<PathBuf>,
    /// Write the page of the job here: figures, views of the atlas and of the model, before and after, in one file that opens without a service.
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
    /// Print the report to stdout.
    #[arg(long)]
    pub json: bool,
    /// Threads that compute; 0 takes all cores.
    #[arg(long, env = "INTARSIA_THREADS", default_value_t = 0)]
    pub threads: usize,
    /// No progress and no summary on stderr; warnings and errors stay.
    #[arg(short, long)]
    pub quiet: bool,
}

/// `intarsia inspect`.
#[derive(Debug, Clone, Args)]
pub struct Inspect {
    /// Models (.glb, .gltf, .obj, .b3dm, .i3dm, .zip), each measured as it is; other files are taken as files that they name.
    #[arg(required = true)]
    pub input: Vec<PathBuf>,
    /// Print the figures as JSON.
    #[arg(long)]
    pub json: bool,
    /// Print only the bytes of memory that a service will expect a job on these models to need, by the headers of their files.
    #[arg(long, conflicts_with_all = ["json", "require"])]
    pub memory: bool,
    /// A bound on a figure, such as 'atlas.packing_efficiency>=0.8'; exit code 4 where it is not met.
    #[arg(long, value_name = "PATH>=N")]
    pub require: Vec<String>,
    /// What is one atlas: options of `refine`.
    #[command(flatten)]
    pub options: OptionFlags,
    /// Threads that compute; 0 takes all cores.
    #[arg(long, env = "INTARSIA_THREADS", default_value_t = 0)]
    pub threads: usize,
}

/// `intarsia sample`.
#[derive(Debug, Clone, Args)]
pub struct Sample {
    /// Name of the model; without it, the names are listed.
    pub name: Option<String>,
    /// The file to write (.glb).
    #[arg(short, long, requires = "name")]
    pub output: Option<PathBuf>,
    /// Side of its textures in texels, which are scaled; up to 16384.
    #[arg(long, requires = "output", value_parser = clap::value_parser!(u32).range(16..=16384))]
    pub texture_size: Option<u32>,
    /// Write its textures as JPEG.
    #[arg(long, requires = "output")]
    pub jpeg: bool,
}

/// Bytes from `500`, `64KB`, `1.5GiB`: decimal or binary units, at most 2^60.
pub fn parse_size(text: &str) -> Result<u64, String> {
    let (number, unit) = number_and_unit(text)?;
    let factor: f64 = match unit.to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "k" | "kib" => 1024.0,
        "m" | "mib" => 1024.0 * 1024.0,
        "g" | "gib" => 1024.0 * 1024.0 * 1024.0,
        "t" | "tib" => 1024.0 * 1024.0 * 1024.0 * 1024.0,
        "kb" => 1e3,
        "mb" => 1e6,
        "gb" => 1e9,
        "tb" => 1e12,
        other => return Err(format!("`{other}` is no unit of size; use B, KiB, MiB, GiB, TiB, KB, MB, GB or TB")),
    };
    let bytes = number * factor;
    if bytes > (1u64 << 60) as f64 { Err(format!("`{text}` is too large")) } else { Ok(bytes as u64) }
}

/// A time span from `90` (seconds), `500ms`, `5m`, `12h`, `7d`: at most 100 years.
pub fn parse_duration(text: &str) -> Result<Duration, String> {
    let (number, unit) = number_and_unit(text)?;
    let factor = match unit {
        "ms" => 1e-3,
        "" | "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        "d" => 86400.0,
        other => return Err(format!("`{other}` is no unit of time; use ms, s, m, h or d")),
    };
    let seconds = number * factor;
    if seconds > 3.16e9 { Err(format!("`{text}` is too long")) } else { Ok(Duration::from_secs_f64(seconds)) }
}

fn number_and_unit(text: &str) -> Result<(f64, &str), String> {
    let text = text.trim();
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(end);
    let number = number.parse().map_err(|_| format!("`{text}` does not start with a number"))?;
    Ok((number, unit.trim()))
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        Cli::command().debug_assert();
    }

    #[test]
    fn sizes_and_spans_have_units() {
        assert_eq!(parse_size("1GiB"), Ok(1 << 30));
        assert_eq!(parse_size("1.5 kb"), Ok(1500));
        assert_eq!(parse_size("12"), Ok(12));
        assert!(parse_size("-1").is_err() && parse_size("9999999TB").is_err() && parse_size("1 acre").is_err());
        assert_eq!(parse_duration("500ms"), Ok(Duration::from_millis(500)));
        assert_eq!(parse_duration("7d"), Ok(Duration::from_secs(604_800)));
        assert!(parse_duration("").is_err() && parse_duration("1 fortnight").is_err());
    }

    #[test]
    fn every_serve_flag_is_an_environment_variable() {
        let cli = Cli::command();
        let serve = cli.find_subcommand("serve").unwrap();
        for arg in serve.get_arguments().filter(|a| !["help", "version"].contains(&a.get_id().as_str())) {
            let long = arg.get_long().unwrap().replace('-', "_").to_uppercase();
            let env = arg.get_env().map(|e| e.to_string_lossy().into_owned());
            assert_eq!(env, Some(format!("INTARSIA_{long}")));
        }
    }
}
