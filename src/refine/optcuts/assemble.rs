//! The pieces and what was left out of them as one Atlas again, packed.

use glam::DVec2;

use super::params::Quality;
use super::pieces::Piece;
use crate::atlas::groups::sorted_unique;
use crate::atlas::{Atlas, Charts, FaceId, HalfEdge, Topology, UvId, VertexId};
use crate::error::Result;
use crate::packing::Pack;
use crate::refine::options::Options;
use crate::refine::pack::lay_out;
use crate::refine::stage::StageInput;
use crate::texture::{Size, Texture};

/// Longest side of the sheet of a layout without images, in texels.
const SIDE: f64 = 1024.0;
/// Part of such a sheet that charts are expected to cover, before they are scaled to fill it.
const COVERED: f64 = 0.5;

/// A piece with a layout.
pub(super) struct Solved {
    /// The piece as it was given.
    pub piece: Piece,
    /// With its layout, in the unit of the surface.
    pub atlas: Atlas,
}

/// Texels by unit of the surface where no piece says its own: as many as on average in the input, or on a sheet without images what
/// fills it about.
pub(super) fn mean_density(atlas: &Atlas) -> f64 {
    let area: f64 = atlas.faces().map(|f| atlas.area(f)).sum();
    let texels: f64 = match atlas.has_layout() {
        true => atlas.faces().map(|f| atlas.uv_area(f).abs()).sum(),
        false => COVERED * SIDE * SIDE,
    };
    let density = (texels / area).sqrt();
    if density.is_finite() && density > 0.0 { density } else { 1.0 }
}

/// The Atlas of a stage's input with the layouts of its pieces, packed; and the work of that. Faces that are in no piece keep their UVs
/// where these have an area or are `held` back, and else lie on a corner or an edge of their neighbours.
///
/// # Errors
/// Those of packing.
pub(super) fn assemble(
    input: &StageInput<'_>,
    solved: &[Solved],
    held: &[bool],
    quality: Quality,
) -> Result<(Atlas, u64)> {
    let atlas = input.atlas;
    let n = atlas.face_count();
    let mean = mean_density(atlas);
    let mut next = Atlas { uv: Vec::new(), corners: vec![[Atlas::NO_UV; 3]; n], page: vec![0; n], ..atlas.clone() };
    for Solved { piece, atlas: own } in solved {
        let (first, scale) = (next.uv.len() as u32, piece.density.unwrap_or(mean));
        // Texels run down.
        next.uv.extend(own.uv.iter().map(|p| *p * DVec2::new(scale, -scale)));
        for (corners, f) in own.corners.iter().zip(&piece.faces) {
            next.corners[f.index()] = corners.map(|u| UvId(first + u.0));
        }
    }
    let fresh: Vec<bool> = next.corners.iter().map(|c| c[0] != Atlas::NO_UV).collect();
    let stays = |f: &FaceId| !fresh[f.index()] && atlas.has_layout() && (held[f.index()] || atlas.uv_area(*f) != 0.0);
    let kept: Vec<FaceId> = atlas.faces().filter(stays).collect();
    let uvs = sorted_unique(kept.iter().flat_map(|f| atlas.corners[f.index()]));
    for f in &kept {
        let name = |u: UvId| UvId::new(next.uv.len() + uvs.partition_point(|x| *x < u));
        next.corners[f.index()] = atlas.corners[f.index()].map(name);
        next.page[f.index()] = atlas.page[f.index()];
    }
    next.uv.extend(uvs.iter().map(|u| atlas.uv[u.index()]));
    // Faces without area are put in when all else has its place.
    let laid: Vec<FaceId> = next.faces().filter(|f| next.corners[f.index()][0] != Atlas::NO_UV).collect();
    let moved: Vec<bool> = laid.iter().map(|f| !held[f.index()]).collect();
    let part = next.subset(&laid).set_apart(&moved, 1.0);
    let charts = Charts::new(&Topology::new(&part));
    let free: Vec<bool> = charts.faces.iter().map(|faces| moved[faces[0].index()]).collect();
    let options = options(input);
    let (part, work) = lay_out(&StageInput { atlas: &part, options: &options, ..*input }, &[], &free, effort(quality))?;
    for (i, f) in laid.iter().enumerate() {
        next.corners[f.index()] = part.corners[i];
        next.page[f.index()] = part.page[i];
    }
    next.uv = part.uv;
    next.sheets = part.sheets;
    collapse(&mut next);
    Ok((next, work))
}

/// Part of packing's own budget: whoever wants a layout soon does not wait for its packing either.
fn effort(quality: Quality) -> f64 {
    match quality {
        Quality::Fast => 0.1,
        Quality::Balanced | Quality::Best => 1.0,
    }
}

/// What packing is asked for: on a sheet without images charts are scaled to fill a square, because what is to be painted on it is of no
/// aspect yet.
fn options(input: &StageInput<'_>) -> Options {
    let options = input.options;
    if !input.sheet_info.is_virtual || options.texture.size != Size::KeepDensity {
        return options.clone();
    }
    let side = SIDE.min(f64::from(options.texture.max_size));
    let aspect = options.pack.aspect.unwrap_or(1.0);
    let size = [side * aspect.min(1.0), side / aspect.max(1.0)].map(|s| s.round().max(1.0) as u32);
    let pack = Pack { aspect: None, ..options.pack.clone() };
    Options { pack, texture: Texture { size: Size::Fixed(size), ..options.texture.clone() }, ..options.clone() }
}

/// Gives UVs to the faces that have none, which have no area: on an edge of a neighbour, or its corner, or anywhere. All their corners
/// are where UVs are already, so that they cover nothing.
fn collapse(atlas: &mut Atlas) {
    let left: Vec<FaceId> = atlas.faces().filter(|f| atlas.corners[f.index()][0] == Atlas::NO_UV).collect();
    if left.is_empty() {
        return;
    }
    // Of the faces with UVs: half edges by the surface edge, and corners by the surface vertex.
    let laid = || atlas.faces().filter(|f| atlas.corners[f.index()][0] != Atlas::NO_UV);
    let mut edges: Vec<([VertexId; 2], HalfEdge)> = laid()
        .flat_map(|f| [0, 1, 2].map(|k| HalfEdge::of(f, k)))
        .map(|h| (sorted([h.corner(), h.end_corner()].map(|k| atlas.surface.triangles[h.face().index()][k])), h))
        .collect();
    edges.sort_unstable();
    let mut vertices: Vec<(VertexId, HalfEdge)> =
        laid().flat_map(|f| [0, 1, 2].map(|k| (atlas.surface.triangles[f.index()][k], HalfEdge::of(f, k)))).collect();
    vertices.sort_unstable();
    let somewhere = laid().next();
    for f in left {
        let triangle = atlas.surface.triangles[f.index()];
        let length = |k: usize| {
            let [a, b] = [k, (k + 1) % 3].map(|k| atlas.surface.positions[triangle[k].index()]);
            a.distance_squared(b)
        };
        let mut longest = [0, 1, 2];
        longest.sort_by(|&k, &l| length(l).total_cmp(&length(k)).then(k.cmp(&l)));
        let known = longest.iter().find_map(|&k| {
            let edge = sorted([triangle[k], triangle[(k + 1) % 3]]);
            edges.get(edges.partition_point(|e| e.0 < edge)).filter(|e| e.0 == edge).map(|e| e.1)
        });
        let at_corner = || {
            let corner = |v: &VertexId| vertices.get(vertices.partition_point(|c| c.0 < *v)).filter(|c| c.0 == *v);
            triangle.iter().find_map(corner).map(|c| c.1)
        };
        // The UV corners of a neighbour that the face may share, by surface vertex.
        let shared: Vec<(VertexId, UvId)> = match known {
            Some(h) => [h.corner(), h.end_corner()].map(|k| corner_of(atlas, h.face(), k)).to_vec(),
            None => at_corner().map(|h| corner_of(atlas, h.face(), h.corner())).into_iter().collect(),
        };
        let neighbour = known.or_else(at_corner).map(HalfEdge::face).or(somewhere);
        let place = match (shared.first(), somewhere) {
            (Some((_, uv)), _) => atlas.uv[uv.index()],
            (None, Some(f)) => atlas.uv_triangle(f)[0],
            (None, None) => DVec2::ZERO,
        };
        let mut own: Vec<(VertexId, UvId)> = shared;
        atlas.corners[f.index()] = triangle.map(|v| match own.iter().find(|(known, _)| *known == v) {
            Some((_, uv)) => *uv,
            None => {
                atlas.uv.push(place);
                own.push((v, UvId::new(atlas.uv.len() - 1)));
                UvId::new(atlas.uv.len() - 1)
            }
        });
        atlas.page[f.index()] = neighbour.map_or(0, |g| atlas.page[g.index()]);
    }
}

fn sorted(mut edge: [VertexId; 2]) -> [VertexId; 2] {
    edge.sort_unstable();
    edge
}

fn corner_of(atlas: &Atlas, face: FaceId, k: usize) -> (VertexId, UvId) {
    (atlas.surface.triangles[face.index()][k], atlas.corners[face.index()][k])
}
