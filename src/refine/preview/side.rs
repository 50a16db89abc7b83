//! One side of an atlas, before or after: surface, layout, and figures of every face.

use serde_json::{Value, json};

use super::super::refinement::Refinement;
use super::container::Sections;
use super::simplify::{ShownFace, simplified};
use crate::atlas::{Atlas, Charts, FaceId, Topology, orientation};
use crate::error::Result;
use crate::metrics::{chart_orientations, distortion_by_face, texel_density};
use crate::texture::Alpha;

/// Parts of a texel that UVs are told in.
const UV_STEPS: f64 = 256.0;
/// Steps of a doubling, in which texel density and distortion are told.
const LOG_STEPS: f64 = 1024.0;
/// What stands for a figure that a face does not have, and for a chart that it has no counterpart in.
const NONE: u32 = i32::MAX as u32;

/// Bits of a face, behind those of its edges: whether it is flipped, and whether its texels were resampled.
const FLIPPED: u8 = 1 << 6;
const RESAMPLED: u8 = 1 << 7;

/// What of a side does not follow from its Atlas.
pub(super) struct Extras<'a> {
    /// By face, its chart on the other side.
    pub counterparts: &'a [u32],
    /// By face, whether it was resampled; empty where none was.
    pub resampled: &'a [bool],
    /// By primitive, how it is shown.
    pub primitive: &'a dyn Fn(usize) -> ShownPrimitive,
}

/// How a primitive is shown.
#[derive(Default)]
pub(super) struct ShownPrimitive {
    /// The transforms of the nodes that show it.
    pub matrices: Vec<[f32; 16]>,
    /// What its material does with alpha.
    pub alpha: Alpha,
}

/// By face, the chart on the other side that it lies in.
pub(super) struct Counterparts {
    pub of_before: Vec<u32>,
    pub of_after: Vec<u32>,
}

impl Counterparts {
    pub fn new(r: &Refinement<'_>, before: Option<&Charts>, after: Option<&Charts>) -> Self {
        let mut of_before = vec![NONE; r.group.set().atlas.face_count()];
        let mut of_after = vec![NONE; r.atlas.face_count()];
        for (f, provenance) in r.atlas.provenance.iter().enumerate() {
            let source = provenance.source.index();
            if let Some(chart) = before.and_then(|b| b.of_face.get(source)) {
                of_after[f] = chart.0;
            }
            if let (Some(chart), Some(own)) = (after.and_then(|a| a.of_face.get(f)), of_before.get_mut(source)) {
                *own = chart.0;
            }
        }
        Counterparts { of_before, of_after }
    }
}

/// Adds the sections of a side with at most `most` faces; gives what the header says of it, and the number of faces.
pub(super) fn side(
    atlas: &Atlas,
    (topology, charts): &(Topology, Option<Charts>),
    extras: &Extras<'_>,
    most: usize,
    sections: &mut Sections,
) -> Result<(Value, usize)> {
    let faces = simplified(atlas, topology, most);
    let (positions, triangles) = vertices(atlas, &faces);
    let mut told = json!({
        "triangles": atlas.face_count(), "shown": faces.len(), "sheets": atlas.sheets, "parts": parts(atlas, &faces, extras),
        "positions": sections.numbers(&positions, 3)?,
        "corners": sections.numbers(&triangles, 3)?,
        "charts": charts.as_ref().map_or(0, Charts::len),
    });
    if let Some(charts) = charts {
        let (uvs, corners) = uv_vertices(atlas, &faces);
        let of_face = |pick: &dyn Fn(FaceId) -> u32| faces.iter().map(|f| pick(f.face)).collect::<Vec<u32>>();
        let distortion = distortion_by_face(atlas);
        let log = |figure: Option<f64>| {
            let steps = figure.filter(|f| *f > 0.0).map(|f| (f.log2() * LOG_STEPS).round().clamp(-1e6, 1e6) as i32);
            steps.map_or(NONE, |steps| steps as u32)
        };
        let signs = chart_orientations(atlas, charts);
        let flags: Vec<u8> =
            faces.iter().map(|f| flags(atlas, f, signs[charts.of_face[f.face.index()].index()], extras)).collect();
        let layout = json!({
            "uvs": sections.numbers(&uvs, 2)?,
            "corners": sections.numbers(&corners, 3)?,
            "pages": sections.numbers(&of_face(&|f| u32::from(atlas.page[f.index()])), 1)?,
            "charts": sections.numbers(&of_face(&|f| charts.of_face[f.index()].0), 1)?,
            "counterparts": sections.numbers(&of_face(&|f| extras.counterparts.get(f.index()).copied().unwrap_or(NONE)), 1)?,
            "density": sections.numbers(&of_face(&|f| log(texel_density(atlas, f))), 1)?,
            "distortion": sections.numbers(&of_face(&|f| log(distortion[f.index()])), 1)?,
            "flags": sections.octets(&flags)?,
        });
        told["layout"] = layout;
    }
    Ok((told, faces.len()))
}

/// Runs of faces of one primitive, and how they are shown.
fn parts(atlas: &Atlas, faces: &[ShownFace], extras: &Extras<'_>) -> Vec<Value> {
    let primitive = |f: &ShownFace| atlas.provenance[f.face.index()].primitive;
    let mut first = 0;
    let runs = faces.chunk_by(|a, b| primitive(a) == primitive(b));
    runs.map(|run| {
        let shown = (extras.primitive)(primitive(&run[0]) as usize);
        let alpha = match shown.alpha {
            Alpha::Opaque => Value::Null,
            Alpha::Mask(cutoff) => json!(cutoff),
            Alpha::Blend => json!("blend"),
        };
        first += run.len();
        json!({ "first": first - run.len(), "count": run.len(), "matrices": shown.matrices, "alpha": alpha })
    })
    .collect()
}

/// Numbers of things in the order of their first use.
struct Renumbering {
    new: Vec<u32>,
    used: Vec<usize>,
}

impl Renumbering {
    fn new(count: usize) -> Self {
        Renumbering { new: vec![u32::MAX; count], used: Vec::new() }
    }

    fn of(&mut self, old: usize) -> u32 {
        if self.new[old] == u32::MAX {
            self.new[old] = self.used.len() as u32;
            self.used.push(old);
        }
        self.new[old]
    }
}

/// The positions that the faces use, as bits of floats, and their corners.
fn vertices(atlas: &Atlas, faces: &[ShownFace]) -> (Vec<u32>, Vec<u32>) {
    let mut numbers = Renumbering::new(atlas.surface.positions.len());
    let corners = faces.iter().flat_map(|f| f.vertices);
    let corners = corners.map(|v| numbers.of(v.index())).collect();
    let bits = |v: &usize| atlas.surface.positions[*v].to_array().map(|x| (x as f32).to_bits());
    (numbers.used.iter().flat_map(bits).collect(), corners)
}

/// The UVs that the faces use, in parts of texels, and their corners.
fn uv_vertices(atlas: &Atlas, faces: &[ShownFace]) -> (Vec<u32>, Vec<u32>) {
    let mut numbers = Renumbering::new(atlas.uv.len());
    let corners = faces.iter().flat_map(|f| f.uvs);
    let corners = corners.map(|c| numbers.of(c.index())).collect();
    let steps = |x: f64| (x * UV_STEPS).round().clamp(-1e9, 1e9) as i32 as u32;
    (numbers.used.iter().flat_map(|c| atlas.uv[*c].to_array().map(steps)).collect(), corners)
}

fn flags(atlas: &Atlas, face: &ShownFace, chart_sign: i8, extras: &Extras<'_>) -> u8 {
    let mut flags = face.edges;
    let [a, b, c] = face.uvs.map(|c| atlas.uv[c.index()]);
    if orientation(a, b, c) * chart_sign < 0 {
        flags |= FLIPPED;
    }
    if extras.resampled.get(face.face.index()).copied().unwrap_or(false) {
        flags |= RESAMPLED;
    }
    flags
}
