//! From a document to its texture sets.

use glam::DVec3;

use super::accessor::{read_vec3, read_vec4};
use super::geometry::{GeometryReader, PrimitiveGeometry, weld};
use super::material_index::MaterialIndex;
use super::precision::{bounding_box, is_far};
use super::sets::{Planned, grid, plan, plan_unmapped, written_set};
use super::uv_tiles::{leaves_tile, normalise_tiles, tame};
use super::{Document, PrimitiveRef, ReadOptions, TextureSet};
use crate::atlas::{Atlas, FaceId, Provenance};
use crate::context::Context;
use crate::error::{Code, Result, Warning};

/// Longest name of a texture set, in characters.
const LONGEST_NAME: usize = 60;

/// Reads every texture set of the layout `options.uv_set`, and behind them one without a layout, of the triangles without
/// texture coordinates; `index` is that of the document. What cannot be refined passes through with a warning on
/// the context; the result is empty when nothing can.
///
/// # Errors
/// `invalid_model` with a pointer for indices out of range and attribute counts that differ; `too_large` when 32 bits cannot count
/// the corners; `canceled`.
pub fn read(doc: &Document, index: &MaterialIndex, options: ReadOptions, context: &Context) -> Result<Vec<TextureSet>> {
    let mut reader = GeometryReader::new(doc);
    let mut sets = Vec::new();
    for planned in plan(doc, index, options.uv_set, context)? {
        if let Some(set) = read_set(doc, index, planned, sets.len(), options, &mut reader, context)? {
            sets.push(set);
        }
    }
    if let Some(planned) = plan_unmapped(doc, index) {
        sets.extend(read_unmapped(doc, index, planned, sets.len(), options, &mut reader, context)?);
    }
    Ok(sets)
}

/// The set of the triangles without texture coordinates. Primitives whose geometry is broken are not in it: nothing touches them.
fn read_unmapped(
    doc: &Document,
    index: &MaterialIndex,
    mut planned: Planned,
    id: usize,
    options: ReadOptions,
    reader: &mut GeometryReader<'_>,
    context: &Context,
) -> Result<Option<TextureSet>> {
    let mut geometries = Vec::new();
    let mut whole = Vec::new();
    for (p, layout) in planned.primitives {
        let primitive = &index.primitives[p];
        match reader.read(primitive.mesh, primitive.primitive, None, context) {
            Ok(geometry) => {
                warn_of_held(&geometry, &primitive.pointer(), context);
                // Without a sound triangle nothing is left to lay out.
                if geometry.held.is_empty() || !geometry.corners.is_empty() {
                    geometries.push(geometry);
                    whole.push((p, layout));
                }
            }
            Err(failure) if failure.code == Code::Canceled => return Err(failure),
            Err(_) => {}
        }
    }
    planned.primitives = whole;
    let atlas = joined(&geometries, planned.reference, context)?;
    Ok(atlas.map(|atlas| texture_set(doc, index, planned, id, options, atlas, geometries)))
}

fn read_set(
    doc: &Document,
    index: &MaterialIndex,
    planned: Planned,
    id: usize,
    options: ReadOptions,
    reader: &mut GeometryReader<'_>,
    context: &Context,
) -> Result<Option<TextureSet>> {
    let mut geometries: Vec<PrimitiveGeometry> = Vec::new();
    for &(p, layout) in &planned.primitives {
        let primitive = &index.primitives[p];
        geometries.push(reader.read(primitive.mesh, primitive.primitive, Some(layout), context)?);
        warn_of_held(&geometries[geometries.len() - 1], &primitive.pointer(), context);
    }
    let Some(mut atlas) = joined(&geometries, planned.reference, context)? else { return Ok(None) };
    let left = |warning: Warning| {
        let first = planned.primitives.first().map(|&(p, _)| &index.primitives[p]);
        let at = planned.slots.first().map(|s| format!("/images/{}", s.image));
        let at = at.or_else(|| first.map(|p| p.pointer())).unwrap_or_default();
        context.warn(if warning.pointer.is_some() { warning } else { warning.at(at) });
        Ok(None)
    };
    let wild = if planned.slots.is_empty() { Vec::new() } else { tame(&mut atlas, planned.reference) };
    if let Some(first) = wild.first() {
        let owner = planned.primitives.get(atlas.provenance[first.index()].primitive as usize);
        let at = owner.map(|&(p, _)| index.primitives[p].pointer()).unwrap_or_default();
        let text = format!(
            "{} faces have texture coordinates that are tens of thousands of images away, most likely an error of the program that wrote them. Their corners are taken into the image, each by itself, and the rest is refined",
            wild.len()
        );
        context.warn(Warning::new("wild_uvs", text).at(at));
    }
    if let Some(image) = leaves_conflict(&atlas, &planned) {
        let text = "the texture set is left as it is: UVs leave the image, which is read with several wrap modes (give its samplers one, or keep UVs inside)";
        return left(Warning::new("sampler_conflict", text).at(format!("/images/{image}")));
    }
    let constant = !planned.slots.is_empty() && planned.slots.iter().all(|s| doc.merging.constants.contains(&s.image));
    if let Err(warning) = normalise_tiles(&mut atlas, &planned.slots, planned.reference, options.tiling, constant) {
        if !planned.slots.is_empty() {
            return left(warning);
        }
        // Nothing reads coordinates that are no layout: they are as good as none.
        geometries.iter_mut().for_each(|geometry| geometry.uvs = None);
        let bare = joined(&geometries, planned.reference, context)?;
        return Ok(bare.map(|atlas| texture_set(doc, index, planned, id, options, atlas, geometries)));
    }
    Ok(Some(texture_set(doc, index, planned, id, options, atlas, geometries)))
}

/// Most triangles that a warning numbers.
const MOST_NUMBERED: usize = 8;

/// Names the triangles of a primitive that are held back.
fn warn_of_held(geometry: &PrimitiveGeometry, pointer: &str, context: &Context) {
    if geometry.held.is_empty() {
        return;
    }
    let count = geometry.held.len();
    let numbers = geometry.held.iter().enumerate().take(MOST_NUMBERED);
    let mut numbers: Vec<String> = numbers.map(|(others, (_, before))| (before + others).to_string()).collect();
    if count > MOST_NUMBERED {
        numbers.push("…".to_owned());
    }
    let text = format!(
        "{count} of {} triangles (numbered from 0: {}) have a position or texture coordinate that is NaN or infinite: they keep their vertices, with texture coordinates written as 0 where they are not finite, and the others are refined; delete them or give them finite numbers",
        count + geometry.corners.len(),
        numbers.join(", ")
    );
    context.warn(Warning::new("non_finite_triangles", text).at(pointer));
}

/// The Atlas of some primitives; none where they have no triangles. Every face is a whole triangle of the primitive that it came
/// from.
fn joined(geometries: &[PrimitiveGeometry], sheet: [u32; 2], context: &Context) -> Result<Option<Atlas>> {
    let mut atlas = weld(geometries, sheet, context)?;
    for (i, geometry) in geometries.iter().enumerate() {
        let first = atlas.provenance.len();
        let faces = first..first + geometry.corners.len();
        atlas.provenance.extend(faces.map(|f| Provenance::whole(FaceId::new(f), i as u32)));
    }
    Ok((!atlas.corners.is_empty()).then_some(atlas))
}

/// The set of a finished Atlas.
fn texture_set(
    doc: &Document,
    index: &MaterialIndex,
    planned: Planned,
    id: usize,
    options: ReadOptions,
    mut atlas: Atlas,
    geometries: Vec<PrimitiveGeometry>,
) -> TextureSet {
    let mut primitives = Vec::new();
    let mut first_face = 0;
    for (geometry, &(p, layout)) in geometries.into_iter().zip(&planned.primitives) {
        let indexed = &index.primitives[p];
        let value = doc.json.pointer(&indexed.pointer()).unwrap_or(&serde_json::Value::Null);
        let face_count = geometry.corners.len();
        primitives.push(PrimitiveRef {
            mesh: indexed.mesh,
            primitive: indexed.primitive,
            material: indexed.default_material,
            layout,
            written: written_set(index, value, &indexed.materials, layout, options.uv_set),
            first_face,
            face_count,
            along_edges: is_animated(value) || lies_far(&geometry),
            oblique_tangents: oblique_tangents(doc, value, &geometry.corners),
            corners: geometry.corners,
            held: geometry.held,
        });
        first_face += face_count;
    }
    atlas.page = vec![0; atlas.corners.len()];
    atlas.sheets = vec![planned.reference];
    let name = name(doc, index, &planned);
    let grid = grid(planned.reference, &planned.slots);
    let Planned { slots, reference, .. } = planned;
    TextureSet { id, name, atlas, reference, primitives, slots, grid }
}

/// The first image, if any, that a primitive reads with several wrap modes outside the image, where they disagree.
fn leaves_conflict(atlas: &Atlas, planned: &Planned) -> Option<usize> {
    let outside = |p: u32| {
        let own = atlas.faces().filter(|f| atlas.provenance[f.index()].primitive == p);
        leaves_tile(own.flat_map(|f| atlas.uv_triangle(f)), planned.reference)
    };
    planned.conflicts.iter().find(|(p, _)| outside(*p)).map(|(_, image)| *image)
}

/// Whether 32 bits hold no points between a primitive's vertices.
fn lies_far(geometry: &PrimitiveGeometry) -> bool {
    let used = geometry.corners.iter().flatten().map(|v| geometry.positions[*v as usize].map(f64::from));
    let (low, high) = bounding_box(used);
    is_far(low, high)
}

/// Whether a primitive is skinned or morphed.
fn is_animated(primitive: &serde_json::Value) -> bool {
    let morphed = primitive["targets"].as_array().is_some_and(|t| !t.is_empty());
    morphed || primitive["attributes"].get("JOINTS_0").is_some()
}

/// Sine of the angle by which a tangent may miss being perpendicular to its normal. A world-space normal is off by no more where a chart
/// is turned by a quarter, and by a third of it where the normal map is as steep as most are.
const OBLIQUE: f64 = 0.02;

/// By face, whether a tangent of it is far from perpendicular to its normal; empty where none is, or where one of the two is missing or
/// cannot be read: whoever writes the primitive says what is wrong with it.
fn oblique_tangents(doc: &Document, primitive: &serde_json::Value, corners: &[[u32; 3]]) -> Vec<bool> {
    let accessor = |name: &str| primitive["attributes"].get(name)?.as_u64().and_then(|a| usize::try_from(a).ok());
    let (Some(normal), Some(tangent)) = (accessor("NORMAL"), accessor("TANGENT")) else { return Vec::new() };
    let (Ok(normals), Ok(tangents)) = (read_vec3(doc, normal), read_vec4(doc, tangent)) else { return Vec::new() };
    let unit = |v: [f32; 3]| DVec3::from(v.map(f64::from)).normalize_or_zero();
    let is_oblique = |(normal, [x, y, z, _]): (&[f32; 3], &[f32; 4])| {
        let sine = unit(*normal).dot(unit([*x, *y, *z]));
        sine.abs() > OBLIQUE
    };
    let oblique: Vec<bool> = normals.iter().zip(&tangents).map(is_oblique).collect();
    if !oblique.contains(&true) {
        return Vec::new();
    }
    corners.iter().map(|face| face.iter().any(|v| oblique.get(*v as usize).is_some_and(|o| *o))).collect()
}

/// The materials' names, each once, or the model's.
fn name(doc: &Document, index: &MaterialIndex, planned: &Planned) -> String {
    let mut names: Vec<&str> = Vec::new();
    let mut length = 0;
    let materials = planned.primitives.iter().flat_map(|&(p, _)| &index.primitives[p].materials);
    for name in materials.filter_map(|&m| index.materials.get(m)?.name.as_deref()) {
        if !names.contains(&name) && length < LONGEST_NAME {
            length += name.chars().count();
            names.push(name);
        }
    }
    let joined = if names.is_empty() { doc.name.clone() } else { names.join(", ") };
    if joined.chars().count() <= LONGEST_NAME {
        return joined;
    }
    joined.chars().take(LONGEST_NAME - 1).chain(['…']).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::asset::fixture::{attribute, bowtie, document, mesh, png, primitive};
    use crate::asset::{RawAccessor, UvLayout, UvSet, mark_uniform, small_slot_warning};
    use crate::error::Failure;
    use crate::texture::Wrap;
    use serde_json::{Value, json};

    fn read_all(doc: &Document) -> (Result<Vec<TextureSet>>, Vec<String>) {
        let context = Context::silent();
        let sets = MaterialIndex::new(doc).and_then(|index| read(doc, &index, ReadOptions::default(), &context));
        (
            sets,
            context.warnings().iter().map(|w| format!("{} {}", w.code, w.pointer.as_deref().unwrap_or(""))).collect(),
        )
    }

    fn sets_of(doc: &Document) -> Vec<TextureSet> {
        let (sets, warnings) = read_all(doc);
        assert_eq!(warnings, Vec::<String>::new());
        sets.unwrap()
    }

    /// Nothing is refined, and this is why.
    fn left(doc: &Document) -> Vec<String> {
        let (sets, warnings) = read_all(doc);
        assert!(sets.unwrap().is_empty());
        warnings
    }

    fn model(images: &[[u32; 2]]) -> Document {
        let mut doc = document(images);
        let p = bowtie(&mut doc);
        mesh(&mut doc, vec![p]);
        doc
    }

    #[test]
    fn a_set_is_what_images_connect() {
        let mut doc = document(&[[16, 8], [8, 8], [4, 4]]);
        let texture = |i: usize| json!({ "pbrMetallicRoughness": { "baseColorTexture": { "index": i } } });
        // 0 and 2 share image 0; material 3 joins image 1 to them; image 2 stands alone.
        let mut both = texture(1);
        both["emissiveTexture"] = json!({ "index": 0 });
        doc.json["materials"] = json!([texture(0), texture(2), texture(0), both, {}]);
        let primitives = [0, 1, 2, 3, 4].map(|m| {
            let mut p = bowtie(&mut doc);
            p["material"] = Value::from(m);
            p
        });
        mesh(&mut doc, primitives.to_vec());
        let sets = sets_of(&doc);
        let parts: Vec<Vec<usize>> = sets.iter().map(|s| s.primitives.iter().map(|p| p.primitive).collect()).collect();
        assert_eq!(parts, [vec![0, 2, 3], vec![1], vec![4]]);
        assert_eq!((sets[2].id, sets[2].slots.len(), sets[2].reference), (2, 0, [1024, 1024]), "what reads no image");
        let slots: Vec<_> = sets[0].slots.iter().map(|s| (s.image, s.name.as_str(), s.primitives.clone())).collect();
        assert_eq!(slots, [(0, "base_color", vec![0, 1, 2]), (1, "base_color_2", vec![2])]);
        assert_eq!((sets[0].reference, sets[0].grid), ([16, 8], Some([2, 1])));
        // Welded within the mesh: three primitives on the same five places, with the same UVs.
        assert_eq!((sets[0].atlas.surface.positions.len(), sets[0].atlas.uv.len()), (5, 5));
        assert_eq!(sets[0].primitives[1].first_face, 2);
        assert_eq!(sets[0].atlas.uv[0], glam::DVec2::new(8.0, 4.0));
    }

    #[test]
    fn small_slots_are_told_apart_by_their_texels() {
        let mut doc = model(&[[90, 90], [60, 60], [7, 7]]);
        doc.json["materials"][0]["emissiveTexture"] = json!({ "index": 1 });
        doc.json["materials"][0]["normalTexture"] = json!({ "index": 2 });
        let mut set = sets_of(&doc).remove(0);
        assert_eq!(set.grid, None);
        mark_uniform(&mut set, 2);
        assert_eq!(set.grid, Some([1, 1]), "the small slot does not count");
        assert!(small_slot_warning(&set, 1).is_some() && small_slot_warning(&set, 0).is_none());
        assert!(small_slot_warning(&set, 2).is_none());
    }

    #[test]
    fn what_cannot_be_refined_passes_through_by_name() {
        let change = |pointer: &str, value: Value| {
            let mut doc = model(&[[16, 8], [16, 8]]);
            let (parent, key) = pointer.rsplit_once('/').unwrap();
            doc.json.pointer_mut(parent).unwrap()[key] = value;
            left(&doc)
        };
        let info = "/materials/0/pbrMetallicRoughness/baseColorTexture";
        let mut doc = model(&[[16, 8]]);
        doc.json.pointer_mut(info).unwrap()["texCoord"] = json!(1);
        let (sets, warnings) = read_all(&doc);
        assert_eq!(warnings, [format!("other_uv_set {info}")]);
        let sets = sets.unwrap();
        assert_eq!((sets.len(), sets[0].slots.len()), (1, 0), "no image is read through the layout");
        let untextured_anisotropy = json!({ "KHR_materials_anisotropy": { "anisotropyStrength": 0.5 } });
        let expected = "anisotropy_without_texture /materials/0";
        assert_eq!(change("/materials/0/extensions", untextured_anisotropy), [expected]);
        let huge = json!({ "KHR_texture_transform": { "scale": [1e300, 1e300], "offset": [1e308, 0] } });
        assert_eq!(change(&format!("{info}/extensions"), huge), ["uv_out_of_range /images/0"]);
        let at = "/meshes/0/primitives/0/extensions";
        assert_eq!(change(at, json!({ "X_y": { "texture": 0 } })), [format!("primitive_extension {at}/X_y")]);
        let at = "/meshes/0/primitives/0/targets";
        assert_eq!(change(at, json!([{ "TEXCOORD_0": 2 }])), [format!("texcoord_morph {at}")]);
        let source = json!({ "MSFT_texture_dds": { "source": 1 } });
        assert_eq!(change("/textures/0/extensions", source), ["texture_extension /textures/0/extensions"]);
        let target = json!({ "extensions": { "KHR_animation_pointer": {
            "pointer": "/materials/0/pbrMetallicRoughness/baseColorTexture/extensions/KHR_texture_transform/offset" } } });
        let animation = json!([{ "channels": [{ "target": target }] }]);
        assert_eq!(change("/animations", animation), ["animated_texture_transform /materials/0"]);
        let identity = json!({ "KHR_texture_transform": { "offset": [0, 0.0], "rotation": 0 } });
        let mut doc = model(&[[16, 8]]);
        doc.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = identity;
        assert_eq!(sets_of(&doc).len(), 1);
        for (bytes, code) in [(None, "missing_image"), (Some(b"no image".to_vec()), "invalid_image")] {
            let mut doc = model(&[[16, 8]]);
            doc.images[0] = bytes;
            assert_eq!(left(&doc), [format!("{code} /images/0")]);
        }
    }

    #[test]
    fn wrap_modes_may_differ_by_primitive_and_inside_the_image() {
        for (shift, one) in [(0.0, true), (0.6, true), (0.0, false), (0.6, false)] {
            let mut doc = document(&[[16, 16]]);
            doc.json["samplers"] = json!([{ "wrapS": 33071 }]);
            doc.push("textures", json!({ "source": 0, "sampler": 0 }));
            doc.push("materials", json!({ "emissiveTexture": { "index": 1 } }));
            let mut first = bowtie(&mut doc);
            let mut second = first.clone();
            second["material"] = Value::from(1);
            let places = [[0.5, 0.5], [0.25, 0.75], [0.25, 0.25], [0.75, 0.25], [0.75, 0.75]];
            let uvs = attribute(&mut doc, &places.map(|[u, v]| [u + shift, v]));
            second["attributes"]["TEXCOORD_0"] = Value::from(uvs);
            if one {
                // The primitive that leaves the image reads it in both ways.
                doc.json["materials"][1]["occlusionTexture"] = json!({ "index": 1 });
                doc.json["materials"][1]["emissiveTexture"] = json!({ "index": 0 });
                doc.json["materials"][1]["pbrMetallicRoughness"] = json!({ "baseColorTexture": { "index": 1 } });
                first["material"] = Value::from(1);
            }
            mesh(&mut doc, vec![first, second]);
            let (sets, warnings) = read_all(&doc);
            let sets = sets.unwrap();
            if one && shift > 0.0 {
                assert_eq!((sets.len(), warnings), (0, vec!["sampler_conflict /images/0".to_owned()]));
                continue;
            }
            assert_eq!((sets.len(), warnings.len()), (1, 0));
            if !one {
                let wraps: Vec<_> =
                    sets[0].slots[0].readings.iter().map(|r| (r.wrap[0], r.primitives.clone())).collect();
                assert_eq!(wraps, [(Wrap::Repeat, vec![0]), (Wrap::ClampToEdge, vec![1])]);
                // Clamped, its stretched texels stay its own.
                let corner = sets[0].atlas.uv_triangle(FaceId::new(2))[0];
                assert_eq!(corner, glam::DVec2::new((0.5 + f64::from(shift)) * 16.0, 8.0));
            }
        }
    }

    #[test]
    fn a_texture_transform_is_part_of_the_layout() {
        let mut doc = model(&[[16, 8], [32, 32]]);
        let moved = json!({ "KHR_texture_transform": { "offset": [0.5, 0.25], "scale": [0.5, 0.5], "texCoord": 0 } });
        let info = json!({ "index": 1, "texCoord": 3, "extensions": moved });
        doc.json["materials"][0]["emissiveTexture"] = info;
        let (sets, warnings) = read_all(&doc);
        let set = sets.unwrap().remove(0);
        // The emissive image has more texels: its layout is refined, and the base colour keeps its own.
        assert_eq!(warnings, ["other_texture_transform /materials/0/pbrMetallicRoughness/baseColorTexture"]);
        let names: Vec<&str> = set.slots.iter().map(|s| s.name.as_str()).collect();
        assert_eq!((names, set.reference), (vec!["emissive"], [32, 32]));
        assert_eq!(set.atlas.uv[0], glam::DVec2::new(0.75 * 32.0, 0.5 * 32.0));
        assert_eq!((set.primitives[0].layout.uv_set, set.primitives[0].written), (0, 1));
        // Read in one way only, the set that is refined is written.
        doc.json["materials"][0]["pbrMetallicRoughness"] = json!({});
        let set = sets_of(&doc).remove(0);
        assert_eq!((set.primitives[0].layout.uv_set, set.primitives[0].written), (0, 0));
    }

    #[test]
    fn an_image_of_two_meanings_is_two_slots_and_extensions_have_slots() {
        let mut doc = model(&[[16, 8], [16, 8]]);
        doc.json["materials"][0]["normalTexture"] = json!({ "index": 0 });
        doc.json["materials"][0]["occlusionTexture"] = json!({ "index": 1 });
        doc.json["materials"][0]["extensions"] = json!({
            "KHR_materials_clearcoat": { "clearcoatTexture": { "index": 1 } },
            "KHR_materials_sheen": { "sheenColorTexture": { "index": 1 } },
        });
        let slots: Vec<_> = sets_of(&doc)[0].slots.iter().map(|s| (s.image, s.name.clone())).collect();
        let expected = [(0, "base_color"), (0, "normal"), (1, "occlusion"), (1, "sheen_color")];
        assert_eq!(slots, expected.map(|(i, name)| (i, name.to_owned())));
        // What an unknown extension reads keeps the uploaded layout.
        doc.json["materials"][0]["extensions"] = json!({ "ACME_grime": { "grimeTexture": { "index": 1 } } });
        let (sets, warnings) = read_all(&doc);
        assert_eq!(warnings, ["material_extension_texture /materials/0/extensions/ACME_grime/grimeTexture"]);
        let set = sets.unwrap().remove(0);
        assert_eq!((set.slots.len(), set.primitives[0].written), (3, 1));
    }

    #[test]
    fn models_without_images_get_a_virtual_page() {
        let set = sets_of(&model(&[])).remove(0);
        assert_eq!((set.reference, set.slots.len(), set.atlas.face_count()), ([1024, 1024], 0, 2));
        // An image that nothing reads is nobody's.
        let mut doc = model(&[]);
        doc.json["images"] = json!([{}]);
        doc.images.push(Some(png(2, 2)));
        assert_eq!(sets_of(&doc).remove(0).slots.len(), 0);
        // Coordinates without area are as good as none.
        let flat = attribute(&mut doc, &[[0.5, 0.5]; 5]);
        doc.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = Value::from(flat);
        let set = sets_of(&doc).remove(0);
        assert_eq!((set.atlas.has_layout(), set.atlas.face_count(), set.primitives[0].written), (false, 2, 0));
    }

    #[test]
    fn a_layout_of_its_own_takes_no_image_along() {
        // Two textured primitives that share no image, one with two sets, one without any, one whose coordinates a target moves.
        let mut doc = document(&[[16, 8], [4, 4]]);
        let mut textured = [0, 1, 0, 0].map(|_| bowtie(&mut doc));
        doc.push("materials", json!({ "emissiveTexture": { "index": 1 } }));
        textured[1]["material"] = Value::from(doc.json["materials"].as_array().unwrap().len() - 1);
        textured[2]["attributes"]["TEXCOORD_1"] = textured[2]["attributes"]["TEXCOORD_0"].clone();
        textured[3]["targets"] = json!([{ "TEXCOORD_0": textured[3]["attributes"]["TEXCOORD_0"] }]);
        let mut bare = bowtie(&mut doc);
        bare.as_object_mut().unwrap().shift_remove("material");
        bare["attributes"].as_object_mut().unwrap().shift_remove("TEXCOORD_0");
        mesh(&mut doc, textured.into_iter().chain([bare]).collect());
        let (context, options) = (Context::silent(), ReadOptions { uv_set: UvSet::New, ..ReadOptions::default() });
        let sets = MaterialIndex::new(&doc).and_then(|index| read(&doc, &index, options, &context)).unwrap();
        assert_eq!(context.warnings().len(), 0);
        let found: Vec<_> = sets
            .iter()
            .map(|s| {
                let written: Vec<usize> = s.primitives.iter().map(|p| p.written).collect();
                (s.atlas.has_layout(), s.slots.len(), s.reference, written)
            })
            .collect();
        let sheet = [1024, 1024];
        assert_eq!(found, [(true, 0, sheet, vec![1, 1, 2, 1]), (false, 0, sheet, vec![0])]);
        assert_eq!(sets[0].primitives[0].layout, UvLayout::plain(0));
    }

    #[test]
    fn surfaces_without_texture_coordinates_are_a_set_behind_the_others() {
        let mut doc = model(&[[16, 8]]);
        doc.push("materials", json!({ "name": "bare" }));
        let positions = attribute(&mut doc, &[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        let mut bare = primitive(&mut doc, &[("POSITION", positions)], &[]);
        bare["material"] = Value::from(1);
        let textured = primitive(&mut doc, &[("POSITION", positions)], &[]);
        let broken = attribute(&mut doc, &[[f32::NAN; 3]; 3]);
        let mut broken = primitive(&mut doc, &[("POSITION", broken)], &[]);
        broken["material"] = Value::from(1);
        let mut strange = bare.clone();
        strange["extensions"] = json!({ "ACME_x": { "texture": 0 } });
        doc.json["meshes"][0]["primitives"].as_array_mut().unwrap().insert(0, bare);
        mesh(&mut doc, vec![textured, broken, strange]);
        let (sets, warnings) = read_all(&doc);
        assert_eq!(warnings, ["non_finite_triangles /meshes/1/primitives/1"]);
        let sets = sets.unwrap();
        assert_eq!(sets.iter().map(|s| s.atlas.has_layout()).collect::<Vec<_>>(), [true, false]);
        let set = &sets[1];
        assert_eq!((set.id, set.name.as_str(), set.slots.len(), set.reference), (1, "bare", 0, [1024, 1024]));
        let places: Vec<_> = set.primitives.iter().map(|p| (p.mesh, p.primitive, p.written)).collect();
        assert_eq!(places, [(0, 0, 0)], "one that reads a texture, one that is broken and one with an extension stay");
        assert_eq!((set.atlas.face_count(), set.atlas.corners[0]), (1, [Atlas::NO_UV; 3]));
        assert_eq!((set.atlas.uv.len(), set.atlas.surface.positions.len()), (0, 3));
        assert_eq!((set.atlas.provenance.len(), set.atlas.page.len()), (1, 1));
    }

    #[test]
    fn broken_geometry_is_named() {
        fn failure(change: impl FnOnce(&mut Document)) -> Failure {
            let mut doc = model(&[[16, 8]]);
            change(&mut doc);
            read_all(&doc).0.unwrap_err()
        }
        let set = |doc: &mut Document, name: &str, accessor: usize| {
            doc.json["meshes"][0]["primitives"][0]["attributes"][name] = Value::from(accessor);
        };
        let few = failure(|doc| {
            let a = attribute(doc, &[[0.0, 0.5]; 4]);
            set(doc, "TEXCOORD_0", a);
        });
        assert_eq!(few.pointer.as_deref(), Some("/meshes/0/primitives/0/attributes/TEXCOORD_0"));
        let range = failure(|doc| {
            let i = doc.append_accessor(&RawAccessor::from_indices(&[0, 1, 5]), None, false);
            doc.json["meshes"][0]["primitives"][0]["indices"] = Value::from(i);
        });
        assert_eq!(range.pointer.as_deref(), Some("/accessors/4"));
        for pointer in ["/meshes/0/primitives/0/material", "/textures/0/source"] {
            let wrong = failure(|doc| *doc.json.pointer_mut(pointer).unwrap() = json!(99));
            assert_eq!(wrong.pointer.as_deref(), Some(pointer));
        }
    }

    #[test]
    fn triangles_that_are_not_finite_are_held_back_alone() {
        let with = |name: &str, values: RawAccessor| {
            let mut doc = model(&[[16, 8]]);
            let a = doc.append_accessor(&values, None, false);
            doc.json["meshes"][0]["primitives"][0]["attributes"][name] = Value::from(a);
            let (sets, warnings) = read_all(&doc);
            (sets.unwrap().first().map(|s| (s.primitives[0].corners.len(), s.primitives[0].held.clone())), warnings)
        };
        let named = vec!["non_finite_triangles /meshes/0/primitives/0".to_owned()];
        let mut uvs = [[0.5, 0.5], [0.25, 0.75], [0.25, 0.25], [0.75, 0.25], [0.75, 0.75]];
        for (vertex, bad, place) in [(1, f32::NAN, 0), (3, f32::INFINITY, 1), (4, f32::NEG_INFINITY, 1)] {
            let kept = std::mem::replace(&mut uvs[vertex][0], bad);
            let (set, warnings) = with("TEXCOORD_0", RawAccessor::from_floats(&uvs));
            let (corners, held) = set.unwrap();
            assert_eq!((corners, held.len(), held[0].1, warnings), (1, 1, place, named.clone()));
            uvs[vertex][0] = kept;
        }
        let (set, warnings) = with("POSITION", RawAccessor::from_floats(&[[0.0, f32::NAN, 0.0]; 5]));
        assert_eq!((set, warnings), (None, named));
    }

    /// Where 32 bits hold halves, a point between two vertices would be somewhere else.
    #[test]
    fn what_lies_far_from_the_origin_is_cut_along_edges() {
        for (away, far) in [(0.0, false), (20.0, false), (5_500_000.0, true)] {
            let mut doc = model(&[[16, 8]]);
            let places = [[0.5, 0.5], [0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
            let a = attribute(&mut doc, &places.map(|[x, y]: [f32; 2]| [2.0 * x, 2.0 * y + away, 0.0]));
            doc.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = Value::from(a);
            assert_eq!(sets_of(&doc)[0].primitives[0].along_edges, far, "{away}");
        }
    }

    #[test]
    fn strips_fans_and_leftovers() {
        let faces = |mode: u64, indices: &[u32]| {
            let mut doc = document(&[[16, 8]]);
            let mut p = bowtie(&mut doc);
            p["mode"] = Value::from(mode);
            p["indices"] = Value::from(doc.append_accessor(&RawAccessor::from_indices(indices), None, false));
            mesh(&mut doc, vec![p]);
            let (sets, warnings) = read_all(&doc);
            (sets.unwrap().first().map_or_else(Vec::new, |s| s.primitives[0].corners.clone()), warnings.len())
        };
        assert_eq!(faces(5, &[0, 1, 2, 3]), (vec![[0, 1, 2], [1, 3, 2]], 0));
        assert_eq!(faces(6, &[0, 1, 2, 3]), (vec![[1, 2, 0], [2, 3, 0]], 0));
        assert_eq!(faces(4, &[0, 1, 2, 3]), (vec![[0, 1, 2]], 1));
        assert_eq!(faces(4, &[0, 1]), (vec![], 1));
        assert_eq!(faces(1, &[0, 1]), (vec![], 0));
        let mut doc = document(&[[16, 8]]);
        let p = attribute(&mut doc, &[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        let t = attribute(&mut doc, &[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]);
        let plain = primitive(&mut doc, &[("POSITION", p), ("TEXCOORD_0", t)], &[]);
        mesh(&mut doc, vec![plain]);
        assert_eq!(sets_of(&doc)[0].primitives[0].corners, [[0, 1, 2]]);
    }
}
