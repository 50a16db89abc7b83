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
