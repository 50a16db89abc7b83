use glam::DVec2;

use super::*;
use crate::atlas::testing::sheet;
use crate::atlas::{Charts, Topology, UvId, VertexId};
use crate::refine::defrag::attempt::Attempt;
use crate::refine::defrag::speculation::Speculation;

#[test]
fn a_seam_that_failed_within_a_chart_is_one_of_the_chart_that_takes_it_in() {
    // Three rows of squares, and a fourth that is a chart of its own, twice as high, closed to a ring on the surface: a seam within it.
    let mut atlas = sheet(3, 4, DVec2::ZERO);
    let above: Vec<DVec2> = atlas.uv[12..].iter().map(|p| DVec2::new(p.x + 10.0, 2.0 * p.y)).collect();
    let offset = atlas.uv.len() - 12;
    atlas.uv.extend(above);
    for corners in &mut atlas.corners[18..] {
        *corners = corners.map(|u| UvId::new(u.index() + offset));
    }
    let closed = |v: VertexId| if v.index() >= 12 && v.index() % 4 == 3 { VertexId(v.0 - 3) } else { v };
    for triangle in &mut atlas.surface.triangles[18..] {
        *triangle = triangle.map(closed);
    }
    for triangle in &mut atlas.surface.triangles[12..18] {
        *triangle = triangle.map(closed);
    }
    let charts = Charts::new(&Topology::new(&atlas));
    let mut mesh = MergeMesh::new(&atlas, &charts, &vec![true; charts.len()], false);
    let params = Defrag::default();
    let mut queue = OperationQueue::new(&mesh, &params, 1.0, 0);
    let find = |queue: &OperationQueue<'_>, within: bool| {
        let ids = 0..queue.candidates.len() as u32;
        ids.into_iter().find(|&id| queue.operation(id).is_within() == within).expect("there is one")
    };
    let within = find(&queue, true);
    let failed = Attempt::failed(&mesh, queue.operation(within), &params, Reason::Fold);
    queue.failed(&mesh, within, Reason::Fold, failed.footprint, failed.work);

    let id = find(&queue, false);
    let op = queue.operation(id).clone();
    let attempt = Speculation::new(&params).attempt(&mesh, &queue, id);
    let merge = attempt.outcome.expect("it fits");
    mesh.commit(&op, &merge, attempt.footprint.region);
    queue.merged(&mesh, id, &merge, attempt.footprint.region);
    let left: Vec<&Candidate> = queue.candidates.iter().filter(|c| c.status != OperationStatus::Gone).collect();
    assert!(left.iter().any(|c| c.op.is_within()));
    assert!(left.iter().all(|c| c.op.kept == op.kept && c.op.moved == op.kept), "{left:?}");
}
