//! Typed indices, so that a UV vertex cannot stand for a face.

macro_rules! id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
        pub struct $name(pub u32);
        impl $name {
            /// From a position in the array that the index addresses.
            pub fn new(index: usize) -> Self {
                debug_assert!(index <= u32::MAX as usize);
                $name(index as u32)
            }
            /// The position in the array.
            pub fn index(self) -> usize {
                self.0 as usize
            }
        }
    };
}

id! {
    /// A welded vertex of the surface.
    VertexId
}
id! {
    /// A UV vertex.
    UvId
}
id! {
    /// A triangle, in 3D and in UV alike.
    FaceId
}
id! {
    /// A chart: a connected component of faces over UV edges.
    ChartId
}

id! {
    /// An edge of a face, from one of its corners to the next: three of each face, numbered `3 * face + corner`.
    HalfEdge
}

impl HalfEdge {
    /// No half edge: nothing lies across.
    pub const NONE: HalfEdge = HalfEdge(u32::MAX);

    /// The half edge that leaves corner `corner` (0..3) of a face.
    pub fn of(face: FaceId, corner: usize) -> Self {
        HalfEdge(3 * face.0 + corner as u32)
    }

    /// Its face.
    pub fn face(self) -> FaceId {
        FaceId(self.0 / 3)
    }

    /// The corner of its face at which it starts, 0..3.
    pub fn corner(self) -> usize {
        self.0 as usize % 3
    }

    /// The corner of its face at which it ends, 0..3.
    pub fn end_corner(self) -> usize {
        (self.0 as usize + 1) % 3
    }

    /// The next one about its face.
    pub fn next(self) -> Self {
        HalfEdge(self.0 - self.0 % 3 + (self.0 + 1) % 3)
    }

    /// The one before it about its face.
    pub fn previous(self) -> Self {
        HalfEdge(self.0 - self.0 % 3 + (self.0 + 2) % 3)
    }

    /// Itself, or `None` for [`HalfEdge::NONE`].
    pub fn some(self) -> Option<Self> {
        (self != Self::NONE).then_some(self)
    }
}
