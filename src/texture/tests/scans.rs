//! Bakes of real scans, where the data is at hand: whole texels stay exact, any turn stays over 40 dB.

use std::path::PathBuf;
use std::time::Instant;

use glam::{DMat2, DVec2, DVec3};
use image::DynamicImage;

use super::*;
use crate::atlas::{Atlas, FaceId, Provenance, UvId, VertexId};
use crate::context::Context;

fn data_folder() -> PathBuf {
    std::env::var_os("INTARSIA_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from)
}

/// That something was tried where there are models.
#[track_caller]
fn something_was(tried: usize) {
    assert!(tried > 0 || !data_folder().is_dir(), "models are at hand, and none was tried");
}

/// Vertices, texture coordinates and triangles of an OBJ file, on a sheet of the size of its texture.
fn load(folder: &str, mesh: &str, texture: &str) -> Option<(Atlas, DynamicImage)> {
    let folder = data_folder().join("scans").join(folder);
    let (Ok(text), Ok(bytes)) = (std::fs::read_to_string(folder.join(mesh)), std::fs::read(folder.join(texture)))
    else {
        println!("skipped: {} is not at hand", folder.display());
        return None;
    };
    let started = Instant::now();
    let image = decode(&bytes, 1 << 26).unwrap();
    println!("{texture}: {} x {} decoded in {:?}", image.width(), image.height(), started.elapsed());
    let size = DVec2::new(f64::from(image.width()), f64::from(image.height()));
    let mut atlas = Atlas { sheets: vec![[image.width(), image.height()]], ..Atlas::default() };
    for line in text.lines() {
        let mut words = line.split_whitespace();
        let kind = words.next();
        let words: Vec<&str> = words.collect();
        let number = |i: usize| words[i].parse::<f64>().unwrap();
        match kind {
            Some("v") => atlas.surface.positions.push(DVec3::new(number(0), number(1), number(2))),
            Some("vt") => atlas.uv.push(DVec2::new(number(0), 1.0 - number(1)) * size),
            Some("f") => {
                let index = |word: &str, k: usize| word.split('/').nth(k).unwrap().parse::<usize>().unwrap() - 1;
                let face = FaceId::new(atlas.corners.len());
                atlas.surface.triangles.push([0, 1, 2].map(|i| VertexId::new(index(words[i], 0))));
                atlas.corners.push([0, 1, 2].map(|i| UvId::new(index(words[i], 1))));
                atlas.page.push(0);
                atlas.provenance.push(Provenance::whole(face, 0));
            }
            _ => {}
        }
    }
    Some((atlas, image))
}

fn turned(before: &Atlas, angle: f64) -> Atlas {
    let m = DMat2::from_angle(angle);
    let m =
        DMat2::from_cols_array(&m.to_cols_array().map(|v| if (v - v.round()).abs() < 1e-12 { v.round() } else { v }));
    let [w, h] = before.sheets[0].map(f64::from);
    let size = m.x_axis.abs() * w + m.y_axis.abs() * h;
    let mut after = before.clone();
    let middle = DVec2::new(w, h) * 0.5;
    after.sheets = vec![[size.x.ceil() as u32, size.y.ceil() as u32]];
    after.uv.iter_mut().for_each(|uv| *uv = m * (*uv - middle) + size * 0.5);
    after
}

#[test]
fn scans_stay_exact_when_moved_by_whole_texels_and_close_under_any_turn() {
    let mut tried = 0;
    for (folder, mesh, texture) in [
        ("meshroom_esp32cam", "texturedMesh.obj", "texture_1001.png"),
        ("planeopt_copyroom", "copyroom_c2000_opt.obj", "copyroom_c2000_opt_0_1024.jpg"),
    ] {
        let Some((before, image)) = load(folder, mesh, texture) else { continue };
        tried += 1;
        let slot = slot(Role::BaseColor, &image);
        let reference = [image.width(), image.height()];
        for angle in [std::f64::consts::FRAC_PI_2, 0.5] {
            let after = turned(&before, angle);
            let job = Bake::single(&before, &after, reference, &slot, &image, 8);
            let context = Context::silent();
            let started = Instant::now();
            let baked = bake(&job, &context).unwrap();
            let baking = started.elapsed();
            let started = Instant::now();
            let figures = fidelity(&job, &baked, 100_000, &context).unwrap();
            println!("{folder} turned by {angle:.2}: bake {baking:?}, fidelity {:?}, {figures:?}", started.elapsed());
            if angle == 0.5 {
                assert!(figures.psnr_db > 40.0, "{folder}: {figures:?}");
            } else {
                assert_eq!(baked.resampled_area, 0.0, "{folder}");
                assert!(figures.max_error < 0.5, "{folder}: {figures:?}");
            }
        }
    }
    something_was(tried);
}

#[test]
fn ktx2_textures_are_what_the_reference_transcoder_makes_of_them() {
    use sha2::{Digest, Sha256};
    let mut tried = 0;
    // First digits of the SHA-256 of the RGBA that the transcoder of Basis Universal itself gives.
    for (file, expected) in [
        ("scans/loaders_agi_ktx2.glb", &["e61efbf639cf3f9b"][..]),
        (
            "pbr/cesium_Balloon_ktx2/CesiumBalloonKTX2Hacky.glb",
            &["83bf34dd8ea4e49a", "326c42a5a33e0072", "7802fc7e099d7f59"],
        ),
    ] {
        let Ok(bytes) = std::fs::read(data_folder().join(file)) else {
            println!("skipped: {file} is not at hand");
            continue;
        };
        tried += 1;
        let starts = (0..bytes.len()).filter(|i| bytes[*i..].starts_with(b"\xabKTX 20\xbb"));
        let found: Vec<String> = starts
            .map(|start| {
                let image = decode(&bytes[start..], 1 << 24).unwrap().into_rgba8();
                hex::encode(&Sha256::digest(image.as_raw())[..8])
            })
            .collect();
        let mut expected: Vec<&str> = expected.to_vec();
        let mut found: Vec<&str> = found.iter().map(String::as_str).collect();
        expected.sort_unstable();
        found.sort_unstable();
        assert_eq!(found, expected, "{file}");
    }
    something_was(tried);
}
