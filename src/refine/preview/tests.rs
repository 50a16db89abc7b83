use serde_json::Value;

use super::container::{MAGIC, Sections, VERSION};
use super::*;
use crate::asset::{File, Limits, load, sample};
use crate::refine::options::Options;
use crate::refine::run::{Input, Outcome, refine};

/// The header of a file, and its sections behind.
fn opened(file: &[u8]) -> (Value, &[u8]) {
    assert_eq!(&file[..4], MAGIC);
    assert_eq!(u32::from_le_bytes(file[4..8].try_into().unwrap()), VERSION);
    let length = u32::from_le_bytes(file[8..12].try_into().unwrap()) as usize;
    (serde_json::from_slice(&file[12..12 + length]).unwrap(), &file[12 + length..])
}

fn number(value: &Value) -> usize {
    value.as_u64().unwrap() as usize
}

fn section<'a>(told: &Value, sections: &'a [u8]) -> &'a [u8] {
    &sections[number(&told["offset"])..][..number(&told["bytes"])]
}

/// The numbers of a section, read as the page reads them.
fn numbers(told: &Value, sections: &[u8]) -> Vec<u32> {
    let (n, width) = (number(&told["count"]), number(&told["width"]));
    let mut planes = vec![0; 4 * n];
    let size = libdeflater::Decompressor::new().zlib_decompress(section(told, sections), &mut planes).unwrap();
    assert_eq!(size, 4 * n);
    let mut values = vec![0u32; n];
    for i in 0..n {
        let zigzag = u32::from_le_bytes([0, 1, 2, 3].map(|k| planes[k * n + i]));
        let difference = (zigzag >> 1) ^ (zigzag & 1).wrapping_neg();
        values[i] = difference.wrapping_add(i.checked_sub(width).map_or(0, |b| values[b]));
    }
    values
}

fn refined(model: &str, recipe: &str) -> Outcome {
    refined_glb(sample::sample(model).unwrap(), recipe)
}

fn refined_glb(bytes: Vec<u8>, recipe: &str) -> Outcome {
    let input =
        Input { models: vec![vec![File { path: "model.glb".to_owned(), bytes }]], extras: true, ..Input::default() };
    refine(&input, &Options::preset(recipe), &Context::silent()).unwrap()
}

fn preview_of(outcome: &Outcome) -> &[u8] {
    &outcome.artifacts.iter().find(|a| a.name == NAME).unwrap().bytes
}

#[test]
fn numbers_come_back_whatever_they_are() {
    let values = [0, 7, u32::MAX, 1, i32::MAX as u32, i32::MIN as u32, 3, 3, 3];
    for width in [1, 2, 3] {
        let mut sections = Sections::default();
        let told = sections.numbers(&values, width).unwrap();
        let file = sections.file(&told).unwrap();
        let (told, sections) = opened(&file);
        assert_eq!(numbers(&told, sections), values, "{width}");
    }
}

#[test]
fn alpha_is_that_of_the_material() {
    for (material, told) in [
        (serde_json::json!({}), Value::Null),
        (serde_json::json!({ "alphaMode": "MASK" }), serde_json::json!(0.5)),
        (serde_json::json!({ "alphaMode": "MASK", "alphaCutoff": 0.25 }), serde_json::json!(0.25)),
        (serde_json::json!({ "alphaMode": "BLEND" }), serde_json::json!("blend")),
    ] {
        let sample = File { path: "model.glb".to_owned(), bytes: sample::sample("textured").unwrap() };
        let (mut doc, _) = load(&[sample], None, &Limits::default()).unwrap();
        doc.json["materials"][0].as_object_mut().unwrap().extend(material.as_object().unwrap().clone());
        let bytes = doc.to_glb().unwrap();
        let outcome = refined_glb(bytes, "pack");
        let (header, _) = opened(preview_of(&outcome));
        assert_eq!(header["atlases"][0]["before"]["parts"][0]["alpha"], told);
    }
}

#[test]
fn what_a_page_draws_is_what_the_report_counts() {
    let outcome = refined("textured", "defrag");
    let (header, sections) = opened(preview_of(&outcome));
    let told = outcome.report["atlases"].as_array().unwrap();
    let atlases = header["atlases"].as_array().unwrap();
    assert_eq!(atlases.len(), told.len());
    assert_eq!(header["triangles"], header["shown"]);
    for (atlas, told) in atlases.iter().zip(told) {
        assert_eq!(atlas["id"], told["id"]);
        for which in ["before", "after"] {
            let (side, counts) = (&atlas[which], &told[which]);
            assert_eq!((&side["triangles"], &side["charts"]), (&counts["triangles"], &counts["charts"]), "{which}");
            let (faces, layout) = (number(&side["triangles"]), &side["layout"]);
            let charts = numbers(&layout["charts"], sections);
            let different: std::collections::BTreeSet<u32> = charts.iter().copied().collect();
            assert_eq!((charts.len(), different.len()), (faces, number(&side["charts"])));
            let corners = numbers(&layout["corners"], sections);
            let uvs = numbers(&layout["uvs"], sections).len() / 2;
            assert!(corners.len() == 3 * faces && corners.iter().all(|c| (*c as usize) < uvs));
            let positions = numbers(&side["positions"], sections).len() / 3;
            assert!(numbers(&side["corners"], sections).iter().all(|c| (*c as usize) < positions));
            assert_eq!(number(&layout["flags"]["count"]), faces);
            let parts = side["parts"].as_array().unwrap();
            assert_eq!(parts.iter().map(|part| number(&part["count"])).sum::<usize>(), faces);
            assert!(parts.iter().all(|part| !part["matrices"].as_array().unwrap().is_empty()));
            // The mean over faces is the figure of the report; here with all faces alike in weight, so loosely.
            let distortion = numbers(&layout["distortion"], sections);
            assert!(distortion.iter().all(|d| (*d as i32) >= 2047), "no map is better than an isometric one");
        }
        for slot in atlas["slots"].as_array().unwrap() {
            let pictures = slot["before"].as_array().unwrap().iter().chain(slot["after"].as_array().unwrap());
            for picture in pictures {
                let header = crate::texture::header(section(picture, sections)).unwrap();
                assert_eq!(serde_json::json!([header.width, header.height]), picture["pixels"]);
            }
        }
    }
    assert_eq!(preview_of(&outcome), preview_of(&refined("textured", "defrag")), "equal input, equal bytes");
}
