//! The usual way to remove overlaps, as a measure for ours (Levy et al. 2002, section 4; compared in Box Cutter, Figure 16).

use std::collections::{BTreeMap, VecDeque};

use intarsia::atlas::{Atlas, Charts, FaceId, HalfEdge, Mesh, overlaps};

/// Cuts charts that overlap themselves along the outlines of the overlapping regions: the triangles that overlap others form regions,
/// bounded by the edges nearest to where the border of one sheet falls on the other, and become charts of their own. A region that
/// overlaps itself is grown apart.
pub fn remove_overlaps_along_outlines(atlas: &Atlas) -> Atlas {
    let mut mesh = Mesh::new(atlas.clone());
    let charts = Charts::new(mesh.topology());
    let mut others: BTreeMap<FaceId, Vec<FaceId>> = BTreeMap::new();
    for (a, b) in overlaps(atlas, &charts, usize::MAX).intra {
        others.entry(a).or_default().push(b);
        others.entry(b).or_default().push(a);
    }
    // 0 is what remains of a chart.
    let mut sheet = vec![0; atlas.face_count()];
    let mut count = 0;
    let neighbours = |mesh: &Mesh, f: FaceId| [0, 1, 2].map(|k| mesh.topology().uv_twin(HalfEdge::of(f, k)));
    for &seed in others.keys() {
        if sheet[seed.index()] != 0 {
            continue;
        }
        count += 1;
        let mut queue = VecDeque::from([seed]);
        while let Some(face) = queue.pop_front() {
            let clashes = |own: &[FaceId]| own.iter().any(|other| sheet[other.index()] == count);
            if sheet[face.index()] == 0 && others.get(&face).is_some_and(|own| !clashes(own)) {
                sheet[face.index()] = count;
                queue.extend(neighbours(&mesh, face).into_iter().flatten().map(HalfEdge::face));
            }
        }
    }
    let topology = mesh.topology();
    let parts =
        |h: &HalfEdge| topology.uv_twin(*h).is_some_and(|twin| sheet[h.face().index()] != sheet[twin.face().index()]);
    let cuts: Vec<HalfEdge> = topology.half_edges().filter(parts).collect();
    mesh.cut(&cuts);
    mesh.into_atlas()
}
