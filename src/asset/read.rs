//! From a document to its texture sets.

use super::geometry::{Geometry, Reader, weld};
use super::home::bring_home;
use super::scan::{Scan, scan};
use super::sets::{Planned, grid, plan};
use super::{Document, PrimitiveRef, TextureSet};
use crate::atlas::{FaceId, Provenance};
use crate::context::Context;
use crate::error::Result;
use crate::refine::options::AtlasOptions;

/// Longest name of a texture set, in characters.
const LONGEST_NAME: usize = 60;

/// Reads every texture set of the layout `options.uv_set`. What cannot be refined passes through with a warning on
/// the context; the result is empty when nothing can.
///
/// # Errors
/// `invalid_model` with a pointer for indices out of range, attribute counts that differ and numbers that are not
/// finite; `too_large` when 32 bits cannot count the corners; `canceled`.
pub fn read(doc: &Document, options: &AtlasOptions, context: &Context) -> Result<Vec<TextureSet>> {
    let scan = scan(doc)?;
    let uv_set = options.uv_set as usize;
    let mut reader = Reader::new(doc);
    let mut sets = Vec::new();
    for planned in plan(doc, &scan, uv_set, context)? {
        if let Some(set) = read_set(doc, &scan, planned, sets.len(), options, &mut reader, context)? {
            sets.push(set);
        }
    }
    Ok(sets)
}

fn read_set(
    doc: &Document,
    scan: &Scan,
    planned: Planned,
    id: usize,
    options: &AtlasOptions,
    reader: &mut Reader<'_>,
    context: &Context,
) -> Result<Option<TextureSet>> {
    let uv_set = options.uv_set as usize;
    let mut geometries: Vec<Geometry> = Vec::new();
    for &p in &planned.primitives {
        let primitive = &scan.primitives[p];
        geometries.push(reader.read(primitive.mesh, primitive.primitive, uv_set, context)?);
    }
    let mut atlas = weld(&geometries, planned.reference, context)?;
    if atlas.corners.is_empty() {
        return Ok(None);
    }
    if let Err(warning) = bring_home(&mut atlas, &planned.slots, planned.reference, options.tiling) {
        let first = planned.primitives.first().map(|&p| &scan.primitives[p]);
        let at = planned.slots.first().map(|s| format!("/images/{}", s.image));
        let at = at.or_else(|| first.map(|p| p.pointer())).unwrap_or_default();
        context.warn(warning.at(at));
        return Ok(None);
    }
    let mut primitives = Vec::new();
    for (i, (geometry, &p)) in geometries.into_iter().zip(&planned.primitives).enumerate() {
        let first_face = atlas.provenance.len();
        let face_count = geometry.corners.len();
        atlas.provenance.extend((first_face..first_face + face_count).map(|f| Provenance::whole(FaceId::new(f), i as u32)));
        let scanned = &scan.primitives[p];
        primitives.push(PrimitiveRef {
            mesh: scanned.mesh,
            primitive: scanned.primitive,
            material: scanned.default_material,
            uv_set,
            first_face,
            face_count,
            corners: geometry.corners,
        });
    }
    atlas.page = vec![0; atlas.corners.len()];
    atlas.sheets = vec![planned.reference];
    let name = name(doc, scan, &planned);
    let grid = grid(planned.reference, &planned.slots);
    let Planned { slots, reference, .. } = planned;
    Ok(Some(TextureSet { id, name, atlas, reference, primitives, slots, grid }))
}

/// The materials' names, each once, or the model's.
fn name(doc: &Document, scan: &Scan, planned: &Planned) -> String {
    let mut names: Vec<&str> = Vec::new();
    let mut length = 0;
    let materials = planned.primitives.iter().flat_map(|&p| &scan.primitives[p].materials);
    for name in materials.filter_map(|&m| scan.materials.get(m)?.name.as_deref()) {
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
    use crate::asset::{Limits, load, read_paths};
    use crate::atlas::{Charts, Topology};

    /// A real model, where the data is at hand.
    fn model(path: &str) -> Option<Document> {
        let root = std::env::var_os("INTARSIA_DATA").map_or_else(
            || std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
            std::path::PathBuf::from,
        );
        let path = root.join(path);
        if !path.exists() {
            println!("skipped: {} is not there", path.display());
            return None;
        }
        let files = read_paths(std::slice::from_ref(&path)).unwrap();
        Some(load(&files, None, &Limits::default()).unwrap().0)
    }

    #[test]
    fn explore() {
        for path in [
            "scans/meshroom_esp32cam/texturedMesh.obj",
            "scans/planeopt_copyroom/copyroom_c2000_opt.obj",
            "scans/ycb_002_master_chef_can/textured.obj",
            "scans/ycb_025_mug/textured.obj",
            "scans/ycb_035_power_drill/textured.obj",
            "scans/ycb_059_chain/textured.obj",
            "scans/ycb_061_foam_brick/textured.obj",
            "scans/ycb_072-a_toy_airplane/textured.obj",
            "pbr/gltft_chr_knight/chr_knight.glb",
            "pbr/khr_AnimatedCube/AnimatedCube.gltf",
            "pbr/khr_AnimatedMorphCube/AnimatedMorphCube.glb",
            "pbr/khr_Avocado/Avocado.gltf",
            "pbr/khr_BoomBoxWithAxes/BoomBoxWithAxes.gltf",
            "pbr/khr_Suzanne/Suzanne.gltf",
            "pbr/khr_CesiumMan/CesiumMan.glb",
            "pbr/khr_CesiumMilkTruck/CesiumMilkTruck.glb",
            "pbr/khr_Duck/Duck.glb",
            "pbr/khr_Monster/Monster.glb",
            "pbr/khr_NormalTangentTest/NormalTangentTest.glb",
            "pbr/khr_TextureSettingsTest/TextureSettingsTest.glb",
            "pbr/khr_WaterBottle/WaterBottle.gltf",
            "pbr/trimesh_AlphaBlendModeTest/AlphaBlendModeTest.glb",
            "pbr/trimesh_fuze/fuze.obj",
            "pbr/draco_Fox/Fox.gltf",
            "pbr/draco_TextureTransformTest/TextureTransformTest.gltf",
            "uv/spot.obj",
            "uv/camel_f_withSUV.obj",
            "hostile/toy.obj",
            "hostile/ArtDemo.obj",
            "hostile/Corset_missing_images/Corset.gltf",
        ] {
            let doc = match std::panic::catch_unwind(|| model(path)) {
                Ok(Some(doc)) => doc,
                _ => continue,
            };
            let context = Context::silent();
            let start = std::time::Instant::now();
            let sets = read(&doc, &AtlasOptions::default(), &context);
            let time = start.elapsed();
            println!("{path} {time:?}");
            match sets {
                Err(e) => println!("   {e:?}"),
                Ok(sets) => for set in &sets {
                    let charts = Charts::new(&Topology::new(&set.atlas));
                    let keys: std::collections::BTreeSet<_> = set.atlas.corners.iter().flatten().zip(set.atlas.surface.triangles.iter().flatten()).map(|(c, v)| (v.0, set.atlas.uv[c.index()].to_array().map(f64::to_bits))).collect();
                    let (mut low, mut high) = (glam::DVec2::INFINITY, glam::DVec2::NEG_INFINITY);
                    for p in &set.atlas.uv { low = low.min(*p); high = high.max(*p); }
                    let area: f64 = set.atlas.faces().map(|f| set.atlas.uv_area(f).abs()).sum();
                    println!("   {} {:?}: {} faces {} charts, replication {:.3} (shared {:.3}) sum/bbox {:.3} grid {:?} box {low} {high}", set.id, set.name, set.atlas.face_count(), charts.len(),
                        set.atlas.uv.len() as f64 / set.atlas.surface.positions.len() as f64,
                        keys.len() as f64 / set.atlas.surface.positions.len() as f64, area / (high - low).element_product(), set.grid);
                    println!("      {}", set.slots.iter().map(|s| format!("{}={}:{}x{}{} ", s.name, s.image, s.header.width, s.header.height, if s.exempt {"!"} else {""})).collect::<String>());
                },
            }
            for w in context.warnings() { println!("   warning {} {} {:?}", w.code, w.message, w.pointer); }
        }
    }
}
