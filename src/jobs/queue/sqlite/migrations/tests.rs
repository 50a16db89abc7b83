//! Stores of earlier versions, made by the SQL of their time: what stands here never changes.

use std::collections::BTreeSet;
use std::time::Duration;

use serde_json::json;

use super::*;
use crate::error::Code;
use crate::jobs::queue::sqlite::Sqlite;
use crate::jobs::queue::{Capacity, NewJob, Queue, Submitted};
use crate::jobs::record::{JobState, Timestamp};
use crate::jobs::stored_options;
use crate::refine::options::Options;

/// The tables of version 2.
const TABLES_2: &str = "
CREATE TABLE jobs (
  seq INTEGER PRIMARY KEY AUTOINCREMENT,
  id TEXT NOT NULL UNIQUE,
  state TEXT NOT NULL,
  turn INTEGER NOT NULL,
  options TEXT NOT NULL,
  inputs TEXT NOT NULL,
  memory INTEGER NOT NULL,
  key TEXT UNIQUE,
  fingerprint TEXT,
  request TEXT,
  attempt INTEGER NOT NULL DEFAULT 0,
  deaths INTEGER NOT NULL DEFAULT 0,
  owner TEXT,
  lease_until INTEGER,
  cancel_requested INTEGER NOT NULL DEFAULT 0,
  created_at INTEGER NOT NULL,
  queued_at INTEGER NOT NULL,
  started_at INTEGER,
  finished_at INTEGER,
  artifacts_expire_at INTEGER,
  artifacts_removed INTEGER NOT NULL DEFAULT 0,
  progress TEXT NOT NULL,
  stages TEXT NOT NULL DEFAULT '[]',
  timings TEXT NOT NULL DEFAULT '[]',
  warnings TEXT NOT NULL DEFAULT '[]',
  error TEXT,
  artifacts TEXT NOT NULL DEFAULT '[]'
) STRICT;
CREATE INDEX jobs_by_turn ON jobs (state, turn, seq);
CREATE INDEX jobs_by_arrival ON jobs (state, seq);
CREATE INDEX jobs_by_end ON jobs (finished_at) WHERE finished_at IS NOT NULL;
CREATE TABLE objects (
  sha256 TEXT NOT NULL,
  job TEXT NOT NULL,
  attempt INTEGER NOT NULL,
  PRIMARY KEY (sha256, job, attempt)
) STRICT, WITHOUT ROWID;
CREATE INDEX objects_by_job ON objects (job);
PRAGMA user_version = 2;
";

/// One job in every state that version 2 knew, and a second one that runs and shall stop.
const JOBS_2: &str = r#"
INSERT INTO jobs (id, state, turn, options, inputs, memory, key, fingerprint, request, attempt, created_at, queued_at, started_at,
  finished_at, artifacts_expire_at, progress, stages, timings, warnings, artifacts)
VALUES ('succeeded', 'succeeded', 1, '{OPTIONS}', '{INPUTS}', 128224858, 'key', 'print', 'request', 1, 1795724883855, 1795724883855,
  1795724883879, 1795724889914, 4102444800000, '{"fraction":1.0,"stage":"write","stage_index":3,"stage_count":4,"message":"done"}',
  '[{"fraction":0.0,"stage":"read","stage_index":0,"stage_count":4,"message":""}]', '[{"stage":"read","seconds":0.005291459}]',
  '[{"code":"decompressed","message":"m","pointer":"/meshes/0"}]',
  '[{"name":"model.glb","role":"model","media_type":"model/gltf-binary","bytes":3,"sha256":"48d4","href":"/v1/jobs/succeeded/artifacts/model.glb"}]');
INSERT INTO objects (sha256, job, attempt) VALUES ('48d4', 'succeeded', 1);
INSERT INTO jobs (id, state, turn, options, inputs, memory, attempt, created_at, queued_at, started_at, finished_at, progress, error)
VALUES ('failed', 'failed', 1, '{OPTIONS}', '{INPUTS}', 1, 1, 1, 1, 2, 4102444800000,
  '{"fraction":1.0,"stage":"write","stage_index":3,"stage_count":4,"message":"done"}',
  '{"code":"requirement_not_met","message":"not met: atlas.charts","pointer":"/require","failures":[{"path":"atlas.charts","wanted":"max 1","got":24.0}]}');
INSERT INTO jobs (id, state, turn, options, inputs, memory, attempt, owner, lease_until, created_at, queued_at, started_at, progress)
VALUES ('running', 'running', 1, '{OPTIONS}', '{INPUTS}', 1, 1, 'worker', 4102444800000, 1, 1, 2,
  '{"fraction":0.25,"stage":"pack","stage_index":1,"stage_count":4,"message":""}');
INSERT INTO jobs (id, state, turn, options, inputs, memory, attempt, owner, lease_until, cancel_requested, created_at, queued_at, started_at, progress)
VALUES ('stopping', 'running', 1, '{OPTIONS}', '{INPUTS}', 1, 1, 'worker', 4102444800000, 1, 1, 1, 2,
  '{"fraction":0.25,"stage":"pack","stage_index":1,"stage_count":4,"message":""}');
INSERT INTO jobs (id, state, turn, options, inputs, memory, created_at, queued_at, progress)
VALUES ('queued', 'queued', 2, '{OPTIONS}', '{INPUTS}', 1, 4102444800000, 1, '{"fraction":0.0,"stage":"","stage_index":0,"stage_count":0,"message":""}');
INSERT INTO jobs (id, state, turn, options, inputs, memory, cancel_requested, created_at, queued_at, finished_at, progress, error)
VALUES ('canceled', 'canceled', 2, '{OPTIONS}', '{INPUTS}', 1, 1, 1, 1, 4102444800000,
  '{"fraction":0.0,"stage":"","stage_index":0,"stage_count":0,"message":""}',
  '{"code":"canceled","message":"the job was cancelled","pointer":null,"failures":[]}');
INSERT INTO jobs (id, state, turn, options, inputs, memory, created_at, queued_at, finished_at, progress)
VALUES ('expired', 'expired', 3, '{OPTIONS}', '{INPUTS}', 1, 1, 1, 4102444800000, '{"fraction":0.0,"stage":"","stage_index":0,"stage_count":0,"message":""}');
"#;

/// The options of a job of version 2 that said `{"recipe": [{"stage": "defrag"}, {"stage": "box_cutter"}], "metadata": {"a": 1}}`.
const OPTIONS_2: &str = r#"{"recipe":[{"stage":"defrag","alpha":null,"max_local_energy":null,"max_global_energy":null,"max_misalignment":2.0,"min_benefit":0.2,"max_resampled":1.0,"resampling_rate":9.0,"search":"partial","appeal":"full","retry":true,"island_area":256.0,"min_preserved":0.15},{"stage":"box_cutter","max_boundary_length":1.5,"target_packing_efficiency":null,"max_charts":null,"cuts":"auto","min_extent":0.01,"search":"beam","void_boxes":4,"void_overlap":0.1,"line_shift":0.05,"alpha":0.2,"min_improvement":0.001,"patience":4,"beam":6,"remove_overlaps":true,"weld":true,"weld_loss":0.1}],"pack":{"rotation":"quarter","mirror":false,"grid":1,"gutter":"auto","aspect":null,"search":"fast"},"box_cutter":{"max_boundary_length":1.5,"target_packing_efficiency":null,"max_charts":null,"cuts":"auto","min_extent":0.01,"search":"beam","void_boxes":4,"void_overlap":0.1,"line_shift":0.05,"alpha":0.2,"min_improvement":0.001,"patience":4,"beam":6,"remove_overlaps":true,"weld":true,"weld_loss":0.1},"defrag":{"alpha":null,"max_local_energy":null,"max_global_energy":null,"max_misalignment":2.0,"min_benefit":0.2,"max_resampled":1.0,"resampling_rate":9.0,"search":"partial","appeal":"full","retry":true,"island_area":256.0,"min_preserved":0.15},"texture":{"size":"keep_density","multiple_of":4,"power_of_two":false,"max_size":8192,"overflow":"pages","format":"keep","jpeg_quality":92},"atlas":{"merge":false,"overlaps":"stack","tiling":"bake","uv_set":0,"if_larger":"keep_input"},"importance":null,"fabrication":null,"output":"glb","require":{},"seed":0,"work_budget":null,"time_limit_s":null,"metadata":{"a":1}}"#;

/// The manifest of an upload of version 2.
const INPUTS_2: &str = r#"{"models":[{"path":"a.glb","number":0,"sha256":"2ea9"}],"files":[]}"#;

/// A folder with a store of version 2 whose process died: all that it holds is in its WAL. The connection keeps it there.
async fn store_2() -> (tempfile::TempDir, PathBuf, SqliteConnection) {
    let root = tempfile::tempdir().unwrap();
    let path = root.path().join("queue.sqlite");
    let options = SqliteConnectOptions::new().filename(&path).create_if_missing(true);
    let mut connection = options.pragma("journal_mode", "wal").connect().await.unwrap();
    let jobs = JOBS_2.replace("{OPTIONS}", OPTIONS_2).replace("{INPUTS}", INPUTS_2);
    for sql in ["PRAGMA wal_autocheckpoint = 0", TABLES_2, &jobs] {
        sqlx::raw_sql(AssertSqlSafe(sql.to_owned())).execute(&mut connection).await.unwrap();
    }
    let length = std::fs::metadata(&path).unwrap().len();
    assert!(length <= 4096, "nothing was checkpointed: {length}");
    (root, path, connection)
}

/// Version, jobs with their states, and all that the schema holds.
async fn look(path: &Path) -> (i64, Vec<(String, String)>, BTreeSet<String>) {
    let mut reader = SqliteConnectOptions::new().filename(path).read_only(true).connect().await.unwrap();
    let rows = sqlx::query("SELECT id, state FROM jobs ORDER BY seq").fetch_all(&mut reader).await.unwrap();
    let schema = sqlx::query("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL").fetch_all(&mut reader).await;
    let jobs = rows.iter().map(|r| (r.get(0), r.get(1))).collect();
    (version(&mut reader).await.unwrap(), jobs, schema.unwrap().iter().map(|r| r.get(0)).collect())
}

fn files(root: &tempfile::TempDir) -> BTreeSet<String> {
    let entries = std::fs::read_dir(root.path()).unwrap();
    let names = entries.map(|e| e.unwrap().file_name().into_string().unwrap());
    names.filter(|n| !n.ends_with("-wal") && !n.ends_with("-shm")).collect()
}

fn names<const N: usize>(names: [&str; N]) -> BTreeSet<String> {
    names.map(str::to_owned).into()
}

#[tokio::test]
async fn a_store_of_version_2_opens_with_all_its_jobs() {
    let (root, path, _other) = store_2().await;
    let before = look(&path).await;
    let queue = Sqlite::open(&path).await.unwrap();

    assert_eq!(files(&root), names(["queue.sqlite", "queue.sqlite.v2"]));
    let copy = look(&path.with_extension("sqlite.v2")).await;
    assert_eq!((copy.0, &copy.1, copy.2.len()), (2, &before.1, before.2.len()), "what was in the WAL is copied");

    for id in ["succeeded", "failed", "running", "queued", "canceled", "expired"] {
        let job = queue.get(id).await.unwrap().unwrap();
        assert_eq!((job.state.as_str(), &job.metadata), (id, &json!({"a": 1})));
    }
    let job = queue.get("succeeded").await.unwrap().unwrap();
    assert_eq!((job.created_at, job.finished_at), (Timestamp(1795724883855), Some(Timestamp(1795724889914))));
    assert_eq!((job.stages[0].stage.as_str(), job.timings[0].seconds), ("read", 0.005291459));
    assert_eq!((job.warnings[0].pointer.as_deref(), job.artifacts[0].sha256.as_str()), (Some("/meshes/0"), "48d4"));
    let error = queue.get("failed").await.unwrap().unwrap().error.unwrap();
    assert_eq!((error.code, error.failures[0].got), (Code::RequirementNotMet, Some(24.0)));

    // It goes on where it stood: those that ran come back, those that wait are claimed, keys are known.
    let back = queue.recover(Some("worker"), "me").await.unwrap();
    assert_eq!(back, [("running".to_owned(), JobState::Queued), ("stopping".to_owned(), JobState::Canceled)]);
    for id in ["queued", "running"] {
        let claim = queue.claim("w", Duration::from_secs(60), Capacity::ANY).await.unwrap().unwrap();
        assert_eq!((claim.id.as_str(), claim.inputs.models[0].path.as_str()), (id, "a.glb"));
        let (options, ignored) = stored_options::read(&claim.options).unwrap();
        assert_eq!((options, ignored.len()), (serde_json::from_str::<Options>(OPTIONS_2).unwrap(), 0));
    }
    let again = NewJob { id: "new".into(), key: Some(("key".into(), "print".into())), ..NewJob::default() };
    assert_eq!(queue.submit(&again, 9).await, Ok(Submitted::Known("succeeded".into())));
}

#[tokio::test]
async fn a_store_that_grew_is_as_a_new_one_and_each_is_itself() {
    let (root, old, _other) = store_2().await;
    let new = root.path().join("new.sqlite");
    let (grown, made) = (Sqlite::open(&old).await.unwrap(), Sqlite::open(&new).await.unwrap());
    let text = |schema: BTreeSet<String>| -> BTreeSet<String> {
        // Comments are kept in the schema, and are no part of it.
        let line = |l: &str| l.split("--").next().unwrap_or_default().split_whitespace().collect::<String>();
        schema.iter().map(|sql| sql.lines().map(line).collect()).collect()
    };
    let (of_old, of_new) = (look(&old).await, look(&new).await);
    assert_eq!((of_old.0, text(of_old.2)), (of_new.0, text(of_new.2)));
    let identity = made.identity().await.unwrap();
    assert_eq!(identity.len(), 32);
    assert_ne!(grown.identity().await.unwrap(), identity);
    drop(made);
    assert_eq!(Sqlite::open(&new).await.unwrap().identity().await.unwrap(), identity);
    assert_eq!(files(&root), names(["new.sqlite", "queue.sqlite", "queue.sqlite.v2"]), "a new store is not copied");
}

#[tokio::test]
async fn a_store_of_a_version_that_is_not_known_is_refused_and_stays_as_it_is() {
    for (version, part) in [(99, "made by a newer version of Intarsia (schema 99, this one knows 10)"), (1, "too old")]
    {
        let (root, path, mut other) = store_2().await;
        let sql = format!("PRAGMA user_version = {version}; PRAGMA wal_checkpoint(TRUNCATE)");
        sqlx::raw_sql(AssertSqlSafe(sql)).execute(&mut other).await.unwrap();
        other.close().await.unwrap();
        let before = std::fs::read(&path).unwrap();
        let failure = Sqlite::open(&path).await.unwrap_err();
        assert!(failure.message.contains(part), "{failure}");
        assert!(std::fs::read(&path).unwrap() == before);
        assert_eq!(files(&root), names(["queue.sqlite"]));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn of_many_that_open_a_store_one_migrates_it() {
    let (_root, path, _other) = store_2().await;
    let openings: Vec<_> = (0..8)
        .map(|_| {
            let path = path.clone();
            tokio::spawn(async move { Sqlite::open(&path).await.unwrap().identity().await.unwrap() })
        })
        .collect();
    let mut identities = BTreeSet::new();
    for opening in openings {
        identities.insert(opening.await.unwrap());
    }
    assert_eq!(identities.len(), 1, "{identities:?}");
    // One that came later would have copied a store of version 10.
    assert_eq!((look(&path).await.0, look(&path.with_extension("sqlite.v2")).await.0), (10, 2));
}

#[tokio::test]
async fn a_migration_that_fails_leaves_store_and_copy() {
    let (root, path, _other) = store_2().await;
    let before = look(&path).await;
    let broken = Migration { version: 11, sql: "DELETE FROM jobs; INSERT INTO jobs (state) VALUES (1);" };
    let migrations = [MIGRATIONS, &[broken]].concat();
    let pool = SqlitePool::connect_with(SqliteConnectOptions::new().filename(&path)).await.unwrap();
    assert!(migrate(&pool, &path, &migrations).await.is_err());
    pool.close().await;
    assert_eq!(look(&path).await, before);
    assert_eq!(look(&path.with_extension("sqlite.v2")).await.1, before.1);
    assert_eq!(files(&root), names(["queue.sqlite", "queue.sqlite.v2"]));
    // The next program that knows better finds all of it, even where one died while it copied.
    std::fs::write(path.with_extension("sqlite.v2.new"), "half").unwrap();
    Sqlite::open(&path).await.unwrap();
    assert_eq!(look(&path).await.1, before.1);
    assert_eq!(files(&root), names(["queue.sqlite", "queue.sqlite.v2"]));
}
