//! What a stage broke is given back as it was uploaded, chart by chart; the rest of its result is kept.

use std::collections::HashMap;

use glam::DVec2;

use super::check;
use super::pack::lay_out;
use super::stage::StageInput;
use crate::atlas::{Atlas, Charts, FaceId, Topology, UvId, VertexId, Violation};
use crate::error::Result;

/// Rounds of giving back and checking again.
const ROUNDS: usize = 12;
/// How near corners lie that are one UV vertex, relative to the layout's extent.
const SAME: f64 = 1e-9;

/// A result without the charts that broke it.
pub(super) struct Mended {
    pub atlas: Atlas,
    /// Charts of the upload that lie as they were uploaded, on the new sheets.
    pub charts: usize,
}

/// A stage's result in which the uploaded charts that offend are charts of their own again, as they were uploaded, and all is packed
/// once more. `None` where that cannot help: what is wrong is not how charts lie, or the upload had no layout.
///
/// # Errors
/// `too_large` when a chart fits on no sheet, `canceled`.
pub(super) fn give_back(
    input: &StageInput<'_>,
    uploaded: &Atlas,
    result: Atlas,
    mut wrong: Vec<Violation>,
    self_overlaps: bool,
) -> Result<Option<Mended>> {
    if !uploaded.has_layout() || !result.has_layout() {
        return Ok(None);
    }
    let charts = Charts::new(&Topology::new(uploaded));
    let mut is_given = vec![false; charts.len()];
    let mut atlas = result;
    for _ in 0..ROUNDS {
        let chart = |f: FaceId| charts.of_face[atlas.provenance[f.index()].source.index()];
        let size = |f: FaceId| charts.faces[chart(f).index()].len();
        let before = is_given.iter().filter(|g| **g).count();
        for violation in &wrong {
            let offender = match *violation {
                Violation::NotFinite(f) | Violation::OutsideSheet(f, _) | Violation::Flipped(f) => f,
                // The smaller of two goes; where that has gone already, the other.
                Violation::Overlap(a, b) => {
                    let (small, large) = if (size(a), chart(a)) <= (size(b), chart(b)) { (a, b) } else { (b, a) };
                    if is_given[chart(small).index()] { large } else { small }
                }
                _ => return Ok(None),
            };
            is_given[chart(offender).index()] = true;
        }
        let given = is_given.iter().filter(|g| **g).count();
        if given == before {
            return Ok(None);
        }
        let is_back = |f: FaceId| is_given[charts.of_face[f.index()].index()];
        let restored = restored(uploaded, &atlas, &charts, &is_back);
        atlas = lay_out(&StageInput { atlas: &restored, ..*input }, &[], &[], 1.0)?.0;
        match check::violations(uploaded, &atlas, self_overlaps, input.context)? {
            Ok(()) => return Ok(Some(Mended { atlas, charts: given })),
            Err(still) => wrong = still,
        }
    }
    Ok(None)
}

/// The Atlas with some uploaded faces where they were uploaded, on pages behind its own. `is_back` by uploaded face.
fn restored(uploaded: &Atlas, atlas: &Atlas, charts: &Charts, is_back: &dyn Fn(FaceId) -> bool) -> Atlas {
    let mut next = atlas.clone();
    let first_page = next.sheets.len() as u16;
    next.sheets.extend(&uploaded.sheets);
    let extent = uploaded.uv.iter().map(|p| p.abs().max_element()).filter(|x| x.is_finite()).fold(1.0, f64::max);
    // By surface vertex and uploaded chart: the UV vertices that were made there.
    let mut made: HashMap<(VertexId, u32), Vec<UvId>> = HashMap::new();
    for f in atlas.faces() {
        let provenance = &atlas.provenance[f.index()];
        if !is_back(provenance.source) {
            continue;
        }
        let source = uploaded.uv_triangle(provenance.source);
        let chart = charts.of_face[provenance.source.index()].0;
        for k in 0..3 {
            let b = provenance.barycentric[k];
            // A corner of the source is that, to the last digit.
            let whole = (0..3).find(|i| b[*i] == 1.0);
            let at: DVec2 = whole.map_or(source[0] * b.x + source[1] * b.y + source[2] * b.z, |i| source[i]);
            let known = made.entry((atlas.surface.triangles[f.index()][k], chart)).or_default();
            let same = known.iter().find(|u| {
                let own = next.uv[u.index()];
                own == at || own.distance(at) <= SAME * extent
            });
            let corner = match same {
                Some(u) => *u,
                None => {
                    let u = UvId::new(next.uv.len());
                    next.uv.push(at);
                    known.push(u);
                    u
                }
            };
            next.corners[f.index()][k] = corner;
        }
        next.page[f.index()] = first_page + uploaded.page[provenance.source.index()];
    }
    next.drop_unused_uvs();
    next
}
