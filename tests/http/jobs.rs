//! The way of a job: in, followed, out.

use std::time::Duration;

use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::server::{Form, Server, artifact, bytes, glb, header, json, left, sample};

#[test]
fn a_model_goes_in_and_comes_out() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let options = json!({"texture": {"format": "png"}, "metadata": {"ticket": 7}});
    let form = Form::sample().text("options", &options.to_string());
    let mut response = server.submit(&form);
    assert_eq!(response.status(), 202);
    assert_eq!(header(&response, "retry-after"), "1");
    let path = header(&response, "location").to_owned();
    let job = json(&mut response);
    assert_eq!(path, format!("/v1/jobs/{}", job["id"].as_str().unwrap()));
    assert_eq!(job["id"].as_str().unwrap().len(), 32);

    let job = server.wait(&path);
    assert_eq!(job["state"], "succeeded", "{job:#}");
    assert_eq!(job["progress"]["fraction"], 1.0);
    assert_eq!(job["recipe"], "pack");
    assert_eq!(job["options"]["texture"]["format"], "png");
    assert_eq!(job["options"]["texture"]["jpeg_quality"], "keep", "defaults are filled in");
    assert_eq!(job["metadata"], json!({"ticket": 7}));
    assert_eq!((&job["error"], &job["queue_position"], &job["attempt"]), (&Value::Null, &Value::Null, &json!(1)));
    for time in ["created_at", "started_at", "finished_at", "artifacts_expire_at"] {
        assert!(job[time].as_str().unwrap().ends_with('Z'), "{time} in {job:#}");
    }

    let model = artifact(&job, "model.glb");
    let href = model["href"].as_str().unwrap();
    let mut response = server.get(href, &[]);
    assert_eq!(response.status(), 200);
    assert_eq!(header(&response, "content-type"), "model/gltf-binary");
    assert_eq!(header(&response, "content-disposition"), "attachment; filename=\"model.glb\"");
    let etag = header(&response, "etag").to_owned();
    let whole = bytes(&mut response);
    assert!(whole.starts_with(b"glTF"));
    assert_eq!(model["bytes"], whole.len());
    assert_eq!(model["sha256"], hex::encode(Sha256::digest(&whole)));

    assert_eq!(server.get(href, &[("if-none-match", &etag)]).status(), 304);
    let mut part = server.get(href, &[("range", "bytes=4-7")]);
    assert_eq!(part.status(), 206);
    assert_eq!(header(&part, "content-range"), format!("bytes 4-7/{}", whole.len()));
    assert_eq!(bytes(&mut part), whole[4..8]);
    let stale = server.get(href, &[("range", "bytes=4-7"), ("if-range", "\"other\"")]);
    assert_eq!(stale.status(), 200);
    let outside = server.get(href, &[("range", "bytes=999999999999-")]);
    assert_eq!(outside.status(), 416);
    assert_eq!(header(&outside, "content-range"), format!("bytes */{}", whole.len()));

    let report = json(&mut server.get(artifact(&job, "report.json")["href"].as_str().unwrap(), &[]));
    assert_eq!(report["schema"], 1);
    assert!(bytes(&mut server.get(artifact(&job, "result.zip")["href"].as_str().unwrap(), &[])).starts_with(b"PK"));
}

#[test]
fn several_models_share_one_atlas() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let other = intarsia::asset::sample::sample("two_materials").unwrap();
    let white = intarsia::texture::neutral(intarsia::texture::Role::BaseColor, 1, 8).unwrap();
    let picture = intarsia::texture::encode(&white, &intarsia::texture::Coding::Png).unwrap();
    let options = json!({"importance": {"texture": "maps/weight.png"}, "fabrication": {"seams": "flaps"}});
    let form = Form::sample().file("model", "other.glb", &other).file("files", "maps/weight.png", &picture);
    let job = server.wait(&server.accepted(&form.text("options", &options.to_string())));
    assert_eq!(job["state"], "succeeded", "{job:#}");
    let fetch = |name: &str| bytes(&mut server.get(artifact(&job, name)["href"].as_str().unwrap(), &[]));
    let texture = fetch("atlas-0.page-0.base_color.png");
    for model in ["model-0.glb", "model-1.glb"] {
        let glb = fetch(model);
        assert!(glb.windows(texture.len()).any(|w| w == texture), "{model} holds the shared texture");
    }
    let report: Value = serde_json::from_slice(&fetch("report.json")).unwrap();
    let refined = report["atlases"].as_array().unwrap().iter().filter(|a| a["refined"] == true);
    assert_eq!(refined.count(), 1);
    assert_eq!(report["atlases"][0]["models"], json!([0, 1]));
    assert_eq!(report["atlases"][0]["importance"], json!([100.0, 100.0]));
    let names: Vec<&Value> = report["input"]["models"].as_array().unwrap().iter().map(|m| &m["name"]).collect();
    assert_eq!(names, ["sample", "other"]);
    assert_eq!(artifact(&job, "panels-0.svg")["media_type"], "image/svg+xml");
    assert!(fetch("panels-0.svg").starts_with(b"<svg "));
}

#[test]
fn a_job_that_has_not_changed_is_not_sent_again() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let path = server.accepted(&Form::sample());
    server.wait(&path);
    let response = server.get(&path, &[]);
    let etag = header(&response, "etag").to_owned();
    assert!(response.headers().get("retry-after").is_none(), "a final job need not be asked for again");
    assert_eq!(server.get(&path, &[("if-none-match", &format!("\"x\", W/{etag}"))]).status(), 304);
    assert_eq!(server.get(&path, &[("if-none-match", "\"x\"")]).status(), 200);
}

#[test]
fn a_raw_model_is_a_job_too() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    for media_type in ["model/gltf-binary", "application/octet-stream"] {
        let response = server.post("/v1/jobs?recipe=pack", media_type, sample());
        assert_eq!(response.status(), 202);
        assert_eq!(server.wait(header(&response, "location"))["state"], "succeeded");
    }
}

#[test]
fn a_bare_model_comes_back_with_texture_coordinates() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let bare = intarsia::asset::sample::sample("defects").unwrap();
    let response = server.post("/v1/jobs?recipe=unwrap", "model/gltf-binary", &bare);
    assert_eq!(response.status(), 202);
    let job = server.wait(header(&response, "location"));
    assert_eq!(job["state"], "succeeded", "{job:#}");
    assert_eq!(job["options"]["optcuts"]["start"], "fresh");
    let model = bytes(&mut server.get(artifact(&job, "model.glb")["href"].as_str().unwrap(), &[]));
    let model = gltf::Gltf::from_slice_without_validation(&model).unwrap();
    let primitive = model.meshes().next().unwrap().primitives().next().unwrap();
    assert!(primitive.get(&gltf::Semantic::TexCoords(0)).is_some());
    artifact(&job, "atlas-0.after.png");

    let bound = r#"{"recipe": "unwrap", "optcuts": {"max_distortion": 4}}"#;
    let mut response = server.submit(&Form::default().file("model", "bare.glb", &bare).text("options", bound));
    assert_eq!(response.status(), 422);
    assert_eq!(json(&mut response)["errors"][0]["pointer"], "/optcuts/max_distortion");
}

#[test]
fn same_input_same_bytes() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let run = || server.wait(&server.accepted(&Form::sample()));
    let sums = |job: &Value| -> Vec<(String, String)> {
        assert_eq!(job["state"], "succeeded", "{job:#}");
        let all = job["artifacts"].as_array().unwrap().iter();
        all.map(|a| (a["name"].to_string(), a["sha256"].to_string())).collect()
    };
    assert_eq!(sums(&run()), sums(&run()));
}

#[test]
fn what_is_wrong_inside_the_model_fails_the_job() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let broken = glb(r#"{"asset": {"version": "2.0"}, "meshes": [{"primitives": [{"attributes": {"POSITION": 3}}]}]}"#);
    let job = server.wait(&server.accepted(&Form::default().file("model", "broken.glb", &broken)));
    assert_eq!(job["state"], "failed");
    assert_eq!(job["error"]["code"], "invalid_model", "{job:#}");
    assert!(!job["error"]["message"].as_str().unwrap().is_empty());
    assert_eq!((&job["error"]["failures"], &job["artifacts"]), (&json!([]), &json!([])));
}

#[test]
fn a_requirement_that_is_not_met_keeps_the_artifacts() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let options = json!({"require": {"atlas.packing_efficiency": {"min": 0.9999}}});
    let job = server.wait(&server.accepted(&Form::sample().text("options", &options.to_string())));
    assert_eq!((&job["state"], &job["error"]["code"]), (&json!("failed"), &json!("requirement_not_met")));
    assert_eq!(job["error"]["failures"][0]["path"], "atlas.packing_efficiency");
    let href = artifact(&job, "model.glb")["href"].as_str().unwrap();
    assert_eq!(server.get(href, &[]).status(), 200);
}

#[test]
fn a_warning_that_strict_names_fails_the_job_with_its_artifacts() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let bare = glb(r#"{"asset": {"version": "2.0"}}"#);
    let form = |options: &Value| Form::default().file("model", "bare.glb", &bare).text("options", &options.to_string());
    let job = server.wait(&server.accepted(&form(&json!({"recipe": "gate"}))));
    assert_eq!((&job["state"], &job["error"]["code"]), (&json!("failed"), &json!("strict_warning")), "{job:#}");
    assert_eq!((&job["error"]["pointer"], &job["outcome"]), (&json!("/strict"), &json!("nothing_to_refine")));
    let href = artifact(&job, "model.glb")["href"].as_str().unwrap();
    assert_eq!(server.get(href, &[]).status(), 200);
    let job = server.wait(&server.accepted(&form(&json!({}))));
    assert_eq!((&job["state"], &job["outcome"]), (&json!("succeeded"), &json!("nothing_to_refine")));
    let job = server.wait(&server.accepted(&Form::sample()));
    assert_eq!(job["outcome"], "refined");
}

#[test]
fn a_requirement_that_the_recipe_is_bound_to_is_met() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let options = json!({
        "recipe": "bounded",
        "bounded": {"packing_efficiency": 0.8},
        "pack": {"gutter": 0},
        "atlas": {"overlaps": "separate", "if_larger": "accept"},
        "require": {"atlas.packing_efficiency": {"min": 0.8}},
    });
    // Its charts have to be cut for that.
    let model = intarsia::asset::sample::sample("quantized").unwrap();
    let form = Form::default().file("model", "quantized.glb", &model).text("options", &options.to_string());
    let job = server.wait(&server.accepted(&form));
    assert_eq!(job["state"], "succeeded", "{job:#}");
    let report = json(&mut server.get(artifact(&job, "report.json")["href"].as_str().unwrap(), &[]));
    assert_eq!(report["stages"][0]["bound_met"], true, "{report:#}");
    assert!(report["atlases"][0]["before"]["packing_efficiency"].as_f64() < Some(0.8), "{report:#}");
}

#[test]
fn ended_jobs_cannot_be_cancelled_and_deleted_jobs_are_gone() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let path = server.accepted(&Form::sample());
    let job = server.wait(&path);
    let mut response = server.post(&format!("{path}/cancel"), "application/json", b"");
    assert_eq!(response.status(), 409);
    assert_eq!(json(&mut response)["code"], "conflict");
    assert_eq!(server.delete(&path).status(), 204);
    let href = artifact(&job, "model.glb")["href"].as_str().unwrap();
    for gone in [&path, href, &format!("{path}/events")] {
        assert_eq!(server.get(gone, &[]).status(), 404, "{gone}");
    }
    assert_eq!(server.delete(&path).status(), 404);
    assert_eq!(server.post(&format!("{path}/cancel"), "application/json", b"").status(), 404);
    assert_eq!(left(data.path()), [] as [String; 0], "no file of a deleted job stays");
}

#[test]
fn a_job_that_is_cancelled_while_it_waits_never_begins() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--jobs", "1"]);
    // The one place is taken, for longer than the rest of this takes.
    let long = server.accepted(&Form::long());
    server.until(&long, |job| job["state"] == "running");
    let waiting = server.accepted(&Form::sample());
    assert_eq!(server.post(&format!("{waiting}/cancel"), "application/json", b"").status(), 202);
    let job = server.wait(&waiting);
    assert_eq!((&job["state"], &job["error"]["code"]), (&json!("canceled"), &json!("canceled")));
    assert_eq!(job["started_at"], Value::Null, "{job:#}");
    assert_ne!(json(&mut server.get(&long, &[]))["state"], "canceled", "the other had no part in it");
}

#[test]
fn expired_artifacts_are_gone_and_the_job_stays() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &["--keep-artifacts", "1ms"]);
    let path = server.accepted(&Form::sample());
    let job = server.wait(&path);
    std::thread::sleep(Duration::from_millis(10));
    let mut response = server.get(&format!("{path}/artifacts/model.glb"), &[]);
    assert_eq!((response.status().as_u16(), &json(&mut response)["code"]), (410, &json!("gone")));
    assert!(!job["artifacts"].as_array().unwrap().is_empty());
    let job = json(&mut server.get(&path, &[]));
    let model = artifact(&job, "model.glb");
    assert_eq!((&model["expired"], &model["href"]), (&json!(true), &Value::Null), "marked, and not linked");
}

#[test]
fn a_model_with_side_files_has_each_texture_once() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let job = server.wait(&server.accepted(&Form::sample().text("options", r#"{"output": "gltf"}"#)));
    let artifacts = job["artifacts"].as_array().unwrap();
    let mut hashes: Vec<&str> = artifacts.iter().map(|a| a["sha256"].as_str().unwrap()).collect();
    hashes.sort_unstable();
    let count = hashes.len();
    hashes.dedup();
    assert_eq!(hashes.len(), count, "{artifacts:#?}");
    let fetch = |name: &str| bytes(&mut server.get(artifact(&job, name)["href"].as_str().unwrap(), &[]));
    let model: Value = serde_json::from_slice(&fetch("model.gltf")).unwrap();
    for image in model["images"].as_array().unwrap() {
        let texture = artifact(&job, image["uri"].as_str().unwrap());
        assert_eq!(texture["role"], "texture");
    }
    let archive = zip::ZipArchive::new(std::io::Cursor::new(fetch("result.zip"))).unwrap();
    assert_eq!(archive.len(), artifacts.len() - 2, "everything but the archive itself and the preview");
}

/// A tile comes back as a tile, by its name and by its magic; what is no tile to be refined is told at once.
#[test]
fn tiles_come_back_as_tiles() {
    let data = tempfile::tempdir().unwrap();
    let server = Server::start(data.path(), &[]);
    let table = br#"{"BATCH_LENGTH":0}                    "#.get(..20).unwrap();
    let word = |n: usize| u32::try_from(n).unwrap().to_le_bytes();
    let glb = sample();
    let length = word(28 + table.len() + glb.len());
    let tile = [b"b3dm", &word(1)[..], &length, &word(table.len()), &[0; 12], table, glb].concat();
    let mut response = server.post("/v1/jobs?recipe=pack", "application/octet-stream", &tile);
    assert_eq!(response.status(), 202, "{:#}", json(&mut response));
    let path = header(&response, "location").to_owned();
    let job = server.wait(&path);
    assert_eq!(job["state"], "succeeded", "{job:#}");
    let model = artifact(&job, "model.b3dm");
    assert_eq!(model["role"], "model");
    let mut response = server.get(model["href"].as_str().unwrap(), &[]);
    assert_eq!(header(&response, "content-type"), "application/octet-stream");
    assert_eq!(header(&response, "content-disposition"), "attachment; filename=\"model.b3dm\"");
    let whole = bytes(&mut response);
    assert!(whole.starts_with(b"b3dm") && whole[8..12] == word(whole.len()) && whole.len().is_multiple_of(8));

    for (bytes, status, words) in [
        (&b"cmpt\x01\0\0\0\x10\0\0\0\x02\0\0\0"[..], 415, "splitCmpt"),
        (&tile[..200], 400, "truncated"),
        (&tile[..20], 400, "header is truncated"),
    ] {
        let mut response = server.post("/v1/jobs?recipe=pack", "application/octet-stream", bytes);
        assert_eq!(response.status(), status);
        let problem = json(&mut response);
        assert!(problem["detail"].as_str().unwrap().contains(words), "{problem:#}");
    }
}
