//! Memory that trials use again: nothing in it outlives one.

use crate::refine::defrag::mesh::MergeMesh;
use crate::refine::defrag::topology::BoundaryLoops;

/// What a trial knows of vertices and faces, by number: what was written in an earlier epoch is not there.
#[derive(Debug, Default)]
pub(crate) struct Workspace {
    epoch: u32,
    /// (epoch, node) by UV vertex.
    node: Vec<(u32, u32)>,
    /// Epoch by face.
    deformable: Vec<u32>,
    /// For tests of topology.
    pub loops: BoundaryLoops,
}

impl Workspace {
    /// Empties it for a trial.
    pub(super) fn begin(&mut self, mesh: &MergeMesh) {
        self.epoch += 1;
        self.node.resize(mesh.vertex_count(), (0, 0));
        self.deformable.resize(mesh.faces().len(), 0);
    }

    /// The node of a UV vertex.
    pub(super) fn node(&self, vertex: u32) -> Option<u32> {
        let (epoch, node) = self.node[vertex as usize];
        (epoch == self.epoch).then_some(node)
    }

    /// Says which node a UV vertex is part of.
    pub(super) fn set_node(&mut self, vertex: u32, node: u32) {
        self.node[vertex as usize] = (self.epoch, node);
    }

    /// Whether a face is deformable.
    pub(super) fn is_deformable(&self, face: u32) -> bool {
        self.deformable[face as usize] == self.epoch
    }

    /// Makes a face deformable; says whether it was not.
    pub(super) fn make_deformable(&mut self, face: u32) -> bool {
        std::mem::replace(&mut self.deformable[face as usize], self.epoch) != self.epoch
    }
}
