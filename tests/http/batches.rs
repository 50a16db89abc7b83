//! Many models in one call, with one status.

use std::time::Instant;

use serde_json::{Value, json};
use ureq::Body;
use ureq::http::Response;

use crate::server::{Form, PATIENCE, Server, glb, header, json, left, sample};

fn batch(server: &Server, form: Form, headers: &[(&str, &str)]) -> Response<Body> {
    server.send_form("/v1/batches", &form, headers)
}

fn ended(server: &Server, path: &str) -> Value {
    let started = Instant::now();
    let mut last = 0.0;
    loop {
        let mut response = server.get(path, &[("prefer", "wait=20")]);
        let found = json(&mut response);
        let fraction = found["fraction"].as_f64().unwrap();
        assert!(fraction >= last, "{fraction} after {last}");
        last = fraction;
        if !["queued", "running"].contains(&found["state"].as_str().unwrap()) {
            assert!(response.headers().get("retry-after").is_none());
            return found;
        }
        assert!((1..=10).contains(&header(&response, "retry-after").parse::<u64>().unwrap()));
        assert!(started.elapsed() < PATIENCE, "the batch does not end: {found}");
    }
}

#[test]
fn many_models_are_one_batch() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let broken = glb(r#"{"asset": {"version": "2.0"}, "meshes": [{"primitives": [{"attributes": {"POSITION": 7}}]}]}"#);
    let description = json!({
        "options": {"metadata": {"night": 17}, "pack": {"gutter": 2}},
        "items": [
            {"model": "chair.glb", "metadata": {"asset": "chair"}},
            {"model": "chair.glb", "options": {"pack": {"gutter": 8}}, "idempotency_key": "chair/8"},
            {"model": "broken.glb"},
            {"model": ["chair.glb"], "options": {"pack": {"gutter": 8}}, "idempotency_key": "chair/8"},
        ],
        "metadata": {"by": "test"}
    });
    let form = || {
        let form = Form::default().text("batch", &description.to_string());
        form.file("files", "chair.glb", sample()).file("files", "broken.glb", &broken)
    };
    let mut taken = batch(&server, form(), &[("idempotency-key", "night-17")]);
    assert_eq!(taken.status(), 202, "{}", json(&mut taken));
    let (path, first) = (header(&taken, "location").to_owned(), json(&mut taken));
    let jobs = first["jobs"].as_array().unwrap();
    assert_eq!(jobs.len(), 4);
    assert_eq!(jobs[1]["id"], jobs[3]["id"], "one key, one job");
    assert_eq!(first["metadata"], json!({"by": "test"}));

    let done = ended(&server, &path);
    assert_eq!(done["state"], "failed", "{done}");
    assert_eq!((&done["counts"]["succeeded"], &done["counts"]["failed"]), (&json!(3), &json!(1)), "{done}");
    assert_eq!((&done["fraction"], &done["jobs"][2]["error"]["code"]), (&json!(1.0), &json!("invalid_model")));
    let outcomes: u64 = done["outcomes"].as_object().unwrap().values().map(|n| n.as_u64().unwrap()).sum();
    assert_eq!(outcomes, 3);
    let job = |n: usize| json(&mut server.get(done["jobs"][n]["href"].as_str().unwrap(), &[]));
    assert_eq!(job(0)["metadata"], json!({"night": 17, "asset": "chair"}));
    assert_eq!((&job(0)["options"]["pack"]["gutter"], &job(1)["options"]["pack"]["gutter"]), (&json!(2), &json!(8)));

    let found = server.get(&path, &[]);
    let etag = header(&found, "etag").to_owned();
    assert_eq!(server.get(&path, &[("if-none-match", &etag)]).status(), 304);
    let mut again = batch(&server, form(), &[("idempotency-key", "night-17")]);
    assert_eq!((again.status().as_u16(), header(&again, "idempotency-replayed")), (200, "true"));
    assert_eq!(json(&mut again)["id"], first["id"]);
    let other = Form::default().text("batch", r#"{"items": [{"model": "a.glb"}]}"#).file("files", "a.glb", sample());
    let mut mismatch = batch(&server, other, &[("idempotency-key", "night-17")]);
    assert_eq!((mismatch.status().as_u16(), json(&mut mismatch)["code"].clone()), (422, json!("idempotency_mismatch")));

    let ended = server.call("POST", &format!("{path}/cancel"), &[]);
    assert_eq!(ended.status(), 409);
    assert_eq!(server.delete(done["jobs"][0]["href"].as_str().unwrap()).status(), 204);
    let less = json(&mut server.get(&path, &[]));
    assert_eq!((&less["counts"]["deleted"], &less["jobs"][0]["state"]), (&json!(1), &Value::Null));
    assert_eq!(server.delete(&path).status(), 204);
    assert_eq!(server.get(&path, &[]).status(), 404);
    assert_eq!(server.get(done["jobs"][1]["href"].as_str().unwrap(), &[]).status(), 404);
    assert_eq!(left(data.path()), [""; 0], "nothing stays");
}

#[test]
fn a_batch_is_taken_whole_or_not_at_all() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--role", "api", "--max-queued", "3", "--list-jobs"]);
    let items = |items: Value| Form::default().text("batch", &json!({"items": items}).to_string());
    let same = |count: usize| Value::from(vec![json!({"model": "a.glb"}); count]);
    let with = |form: Form| form.file("files", "a.glb", sample());
    let bad = json!([
        {"model": "a.glb"},
        {"model": "b.glb"},
        {"model": "a.glb", "options": {"pack": {"grid": 65}}},
    ]);
    let mut refused = batch(&server, with(items(bad)), &[]);
    let problem = json(&mut refused);
    assert_eq!((refused.status().as_u16(), &problem["code"]), (422, &json!("invalid_batch")), "{problem}");
    let pointers: Vec<&str> =
        problem["errors"].as_array().unwrap().iter().map(|e| e["pointer"].as_str().unwrap()).collect();
    assert_eq!(pointers, ["/items/1/model", "/items/2/options/pack/grid"]);
    for (form, status, part) in [
        (items(json!([])), 422, "1 to 1000"),
        (with(items(json!([{"model": "a.glb"}, {"colour": 1}]))), 422, "/items/1"),
        (with(items(json!([{"model": "a.glb", "idempotency_key": ""}]))), 422, "/items/0/idempotency_key"),
        (with(items(json!([{"model": "a.glb", "files": {"../x": "a.glb"}}]))), 422, "/items/0/files/..~1x"),
        (with(items(same(4))), 413, "3 jobs"),
        (with(items(json!([{"model": "a.glb"}]))).file("files", "idle.png", b"x"), 422, "idle.png"),
        (items(json!([{"model": "upload:00000000000000000000000000000000"}])), 422, "/items/0/model"),
        (
            Form::default().file("files", "a.glb", b"not a model").text("batch", r#"{"items": [{"model": "a.glb"}]}"#),
            422,
            "magic",
        ),
        (with(Form::default()), 400, "`batch`"),
        (with(Form::default().text("batch", "{")), 400, "JSON"),
        (
            with(
                Form::default().text("batch", r#"{"options": {"pack": {"grid": 65}}, "items": [{"model": "a.glb"}]}"#),
            ),
            422,
            "\"/options/pack/grid\"",
        ),
    ] {
        let mut refused = batch(&server, form, &[]);
        let problem = json(&mut refused).to_string();
        assert!(refused.status() == status && problem.contains(part), "{status}, {part}: {problem}");
    }
    assert_eq!(left(data.path()), [""; 0], "nothing was stored");
    let valid = server.send_form("/v1/batches?validate_only=true", &with(items(same(2))), &[]);
    let mut valid = valid;
    let told = json(&mut valid);
    assert_eq!((valid.status().as_u16(), told["items"].as_array().unwrap().len()), (200, 2), "{told}");

    // Two fit, two more do not.
    let mut two = batch(&server, with(items(same(2))), &[]);
    assert_eq!((two.status().as_u16(), &json(&mut two)["state"]), (202, &json!("queued")));
    let path = header(&two, "location").to_owned();
    let mut more = batch(&server, with(items(same(2))), &[]);
    assert_eq!((more.status().as_u16(), &json(&mut more)["code"]), (503, &json!("queue_full")));
    assert!(header(&more, "retry-after").parse::<u64>().unwrap() >= 1);
    assert_eq!(json(&mut server.get("/v1/jobs", &[]))["jobs"].as_array().unwrap().len(), 2);
    let mut canceled = server.call("POST", &format!("{path}/cancel"), &[]);
    let status = canceled.status().as_u16();
    let told = json(&mut canceled);
    assert_eq!((status, &told["state"], &told["counts"]["canceled"]), (202, &json!("canceled"), &json!(2)));
    assert_eq!(left(data.path()), [""; 0], "their uploads are gone");
}

#[test]
fn uploads_stand_for_the_files_of_a_batch_without_a_form() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let length = sample().len().to_string();
    let headers = [("upload-length", length.as_str()), ("content-type", "application/offset+octet-stream")];
    let mut upload = server.send("POST", "/v1/uploads", &headers, sample());
    let upload = json(&mut upload)["reference"].clone();
    let headers = [("upload-length", "3"), headers[1]];
    let side = json(&mut server.send("POST", "/v1/uploads", &headers, b"abc"))["reference"].clone();
    let body = json!({"items": [{"model": upload}, {"model": {"chair.glb": upload}}]}).to_string();
    let mut wrong = server.post("/v1/batches", "application/json", body.as_bytes());
    assert_eq!(json(&mut wrong)["errors"][0]["pointer"], "/items/1/model");
    let body = json!({"items": [{"model": upload}, {"model": upload, "files": {"x/y.png": side}}]}).to_string();
    let mut taken = server.post("/v1/batches", "application/json", body.as_bytes());
    assert_eq!(taken.status(), 202, "{}", json(&mut taken));
    let done = ended(&server, header(&taken, "location"));
    assert_eq!((&done["state"], &done["counts"]["succeeded"]), (&json!("succeeded"), &json!(2)), "{done}");
}
