//! The Atlas: the one value that every stage takes and gives.
//!
//! An [`Atlas`] is a surface (welded 3D triangles), UV vertices in texels of the reference sheet,
//! the three UV corners of each face, and each face's [`Provenance`]. Charts, seams, loops and
//! adjacency are derived ([`Topology`], [`Charts`]), never stored beside it. Whatever cuts, joins or splits works on a [`Mesh`].

mod area;
pub(crate) mod bvh;
mod charts;
mod check;
mod clusters;
pub(crate) mod dynamic_triangles;
mod edit;
pub(crate) mod groups;
mod ids;
mod line_cutter;
mod mesh;
pub(crate) mod overlap;
pub(crate) mod rigid;
pub(crate) mod rounding;
pub(crate) mod seams;
#[cfg(test)]
pub(crate) mod testing;
mod topology;
mod trail;

pub use area::{Coverage, coverage, coverage_of_page};
pub use charts::{Charts, Loops};
pub(crate) use check::triangle_area;
pub use check::{Exactness, Violation, check, check_with};
pub use clusters::{Clusters, OverlapMode, clusters};
pub use edit::Move;
pub(crate) use groups::find_root;
pub use ids::{ChartId, FaceId, HalfEdge, UvId, VertexId};
pub use line_cutter::{LineCutter, Segment};
pub use mesh::{EdgeSplits, Mark, Mesh};
pub use overlap::{Overlaps, orientation, overlapping_charts, overlaps, penetration, triangles_overlap};
pub use topology::Topology;
pub use trail::{DividedTrail, Trail, TrailEnd, TrailPoint, TrailStart};

use glam::{DVec2, DVec3};

/// The welded 3D triangles. Positions are in mesh space; vertices of different meshes are never
/// welded together, even where they coincide.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Surface {
    /// Position by [`VertexId`].
    pub positions: Vec<DVec3>,
    /// The three vertices by [`FaceId`].
    pub triangles: Vec<[VertexId; 3]>,
}

/// Where a face comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Provenance {
    /// Face of the Atlas *as uploaded* that this face is a part of.
    pub source: FaceId,
    /// Index into the texture set's list of primitives.
    pub primitive: u32,
    /// Barycentric coordinates of the face's three corners in the source face.
    pub barycentric: [DVec3; 3],
}

impl Provenance {
    /// The three corners of an uncut face.
    pub const WHOLE: [DVec3; 3] = [DVec3::X, DVec3::Y, DVec3::Z];

    /// A face that is a whole uploaded triangle.
    pub fn whole(source: FaceId, primitive: u32) -> Self {
        Provenance { source, primitive, barycentric: Self::WHOLE }
    }

    /// Whether the face is a whole uploaded triangle with its corners in the uploaded order.
    pub fn is_whole(&self) -> bool {
        self.barycentric == Self::WHOLE
    }
}

/// A texture atlas of one texture set.
///
/// A surface that came without texture coordinates is an Atlas too, without a layout until a stage makes one: `uv` is empty,
/// and every corner of every face is [`Atlas::NO_UV`]. All arrays by face keep their length, so that faces, surface,
/// provenance and pages are what they are everywhere; whoever reads UVs asks [`Atlas::has_layout`] first. Either all faces have
/// UVs or none has: [`check`] finds a face that was left out, and holds a layout made from nothing against the surface alone.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Atlas {
    /// The 3D triangles.
    pub surface: Surface,
    /// UV positions by [`UvId`], in texels of the reference sheet, origin top left, y down. A UV vertex belongs
    /// to one surface vertex; two UV vertices of one surface vertex mean a seam.
    pub uv: Vec<DVec2>,
    /// The three UV corners by [`FaceId`], in the same order as the surface triangle's vertices.
    pub corners: Vec<[UvId; 3]>,
    /// Origin by [`FaceId`].
    pub provenance: Vec<Provenance>,
    /// Sheet on which the face lies, by [`FaceId`]; an index into `sheets`.
    pub page: Vec<u16>,
    /// Width and height of each sheet, in reference texels. As uploaded: one sheet.
    pub sheets: Vec<[u32; 2]>,
}

impl Atlas {
    /// The corner of a face that has no UVs.
    pub const NO_UV: UvId = UvId(u32::MAX);

    /// Whether its faces have UVs.
    pub fn has_layout(&self) -> bool {
        !self.uv.is_empty() || self.corners.is_empty()
    }

    /// Pixels of all sheets.
    pub fn pixels(&self) -> u64 {
        self.sheets.iter().map(|s| u64::from(s[0]) * u64::from(s[1])).sum()
    }

    /// Number of faces.
    pub fn face_count(&self) -> usize {
        self.corners.len()
    }

    /// All faces in order.
    pub fn faces(&self) -> impl ExactSizeIterator<Item = FaceId> + DoubleEndedIterator + use<> {
        (0..self.corners.len()).map(FaceId::new)
    }

    /// The UV corners of a face, in texels.
    pub fn uv_triangle(&self, face: FaceId) -> [DVec2; 3] {
        self.corners[face.index()].map(|c| self.uv[c.index()])
    }

    /// The 3D corners of a face.
    pub fn triangle(&self, face: FaceId) -> [DVec3; 3] {
        self.surface.triangles[face.index()].map(|v| self.surface.positions[v.index()])
    }

    /// Signed UV area of a face in square texels. With y down, positive means clockwise on screen.
    pub fn uv_area(&self, face: FaceId) -> f64 {
        let [a, b, c] = self.uv_triangle(face);
        0.5 * (b - a).perp_dot(c - a)
    }

    /// 3D area of a face in square mesh units.
    pub fn area(&self, face: FaceId) -> f64 {
        let [a, b, c] = self.triangle(face);
        0.5 * (b - a).cross(c - a).length()
    }
}
