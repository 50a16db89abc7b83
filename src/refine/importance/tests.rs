//! Weights from every source, and what is said of those that are wrong.

use glam::DVec3;
use serde_json::{Value, json};

use super::*;
use crate::asset::ReadOptions;
use crate::asset::{ARRAY_BUFFER, RawAccessor, fixture};
use crate::atlas::FaceId;
use crate::texture::{Coding, encode, from_samples};

/// A bowtie with an attribute of floats by vertex.
fn model(attribute: Option<[f32; 5]>) -> (Document, Vec<TextureSet>) {
    let mut doc = fixture::document(&[[16, 16]]);
    let mut primitive = fixture::bowtie(&mut doc);
    if let Some(values) = attribute {
        let accessor = fixture::attribute(&mut doc, &values.map(|v| [0.5, v]));
        primitive["attributes"]["_WEIGHT"] = Value::from(accessor);
    }
    let ids = RawAccessor::from_indices(&[1, 2, 3, 4, 5]);
    primitive["attributes"]["_ID"] = Value::from(doc.append_accessor(&ids, Some(ARRAY_BUFFER), false));
    fixture::mesh(&mut doc, vec![primitive]);
    let sets = asset::read(&doc, &asset::MaterialIndex::new(&doc).unwrap(), ReadOptions::default(), &Context::silent())
        .unwrap();
    (doc, sets)
}

fn weights(source: Value, attribute: Option<[f32; 5]>, files: &[File]) -> Result<Importance> {
    let (doc, sets) = model(attribute);
    let source: ImportanceSource = serde_json::from_value(source).unwrap();
    let subjects: Vec<Subject<'_>> = sets.iter().map(|set| Subject { doc: &doc, files, set }).collect();
    importances(&source, &subjects, &Limits::default(), &Context::silent()).map(|mut all| all.remove(0))
}

fn failure(source: Value, attribute: Option<[f32; 5]>) -> (Code, String) {
    let failure = weights(source, attribute, &[]).unwrap_err();
    (failure.code, failure.pointer.unwrap_or_default())
}

#[test]
fn attributes_are_spread_unless_they_are_weights_already() {
    let source = || json!({"attribute": "_WEIGHT.y"});
    let spread = weights(source(), Some([0.0, 1.0, 0.5, 0.25, 0.0]), &[]).unwrap();
    assert_eq!(spread.corners, [[1.0, 100.0, 50.5], [1.0, 25.75, 1.0]]);
    let plain = weights(source(), Some([0.0, 1.0, 8.0, 0.5, 0.0]), &[]).unwrap();
    assert_eq!(plain.corners, [[0.0, 1.0, 8.0], [0.0, 0.5, 0.0]]);
    assert_eq!(plain.range(), Some([0.0, 8.0]));
    // A part of face 0, with a corner in its middle.
    let mut part = Provenance::whole(FaceId(0), 0);
    part.barycentric[2] = DVec3::splat(1.0 / 3.0);
    assert_eq!(plain.at(&part), [0.0, 1.0, 3.0]);
    let joined = Importance::join([&spread, &plain]);
    assert_eq!(joined.at(&Provenance::whole(FaceId(2), 0)), [0.0, 1.0, 8.0]);
}

#[test]
fn pictures_are_read_at_the_uploaded_texture_coordinates() {
    // Left half black, right half white: u is x.
    let texels = (0..16 * 16).map(|i| if i % 16 < 8 { 0u8 } else { 255 }).collect();
    let image = from_samples([16, 16], 1, texels).unwrap();
    let file = File { path: "maps/Weight.png".to_owned(), bytes: encode(&image, &Coding::Png).unwrap() };
    let found = weights(json!({"texture": "weight.png"}), None, &[file]).unwrap();
    assert_eq!(found.corners, [[50.5, 1.0, 1.0], [50.5, 100.0, 100.0]]);
    assert_eq!(first_channel(&image, glam::DVec2::new(-7.25, 3.0)), 1.0);
}

#[test]
fn materials_are_named() {
    let found = weights(json!({"materials": {"m": 7.5}}), None, &[]).unwrap();
    assert_eq!(found.corners, [[7.5; 3]; 2]);
    let unknown = weights(json!({"materials": {"mm": 7.5}}), None, &[]).unwrap_err();
    assert_eq!(unknown.pointer.as_deref(), Some("/importance/materials/mm"));
    assert!(unknown.message.contains("there are: m"), "{}", unknown.message);
}

#[test]
fn what_is_wrong_is_told_at_its_place() {
    let attribute = "/importance/attribute".to_owned();
    let options = |source: Value| failure(source, Some([0.0; 5]));
    for name in ["COLOR_0.r", "_WEIGHT.z", "_WEIGHT", "_ID.x"] {
        assert_eq!(options(json!({ "attribute": name })), (Code::InvalidOptions, attribute.clone()), "{name}");
    }
    assert_eq!(options(json!({"texture": "x.png"})), (Code::InvalidOptions, "/importance/texture".to_owned()));
    for bad in [-0.5, f32::NAN, f32::INFINITY] {
        let (code, pointer) = failure(json!({"attribute": "_WEIGHT.y"}), Some([0.0, 1.0, bad, 0.0, 0.0]));
        assert_eq!(code, Code::InvalidModel);
        assert!(pointer.starts_with("/accessors/"), "{pointer}");
    }
}
