//! What an accessor's elements are made of.

/// Type of one component; the discriminant is glTF's `componentType`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
pub enum ComponentType {
    /// Signed byte.
    I8 = 5120,
    /// Unsigned byte.
    U8 = 5121,
    /// Signed 16-bit integer.
    I16 = 5122,
    /// Unsigned 16-bit integer.
    U16 = 5123,
    /// Unsigned 32-bit integer.
    U32 = 5125,
    /// 32-bit float.
    F32 = 5126,
}

impl ComponentType {
    /// From glTF's number.
    pub fn from_gl(number: u64) -> Option<Self> {
        use ComponentType::{F32, I8, I16, U8, U16, U32};
        [I8, U8, I16, U16, U32, F32].into_iter().find(|c| u64::from(c.gl()) == number)
    }

    /// glTF's number.
    pub fn gl(self) -> u32 {
        self as u32
    }

    /// Bytes of one component.
    pub fn size(self) -> usize {
        match self {
            ComponentType::I8 | ComponentType::U8 => 1,
            ComponentType::I16 | ComponentType::U16 => 2,
            ComponentType::U32 | ComponentType::F32 => 4,
        }
    }
}

/// Shape of one element.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    /// One component.
    Scalar,
    /// Two components.
    Vec2,
    /// Three components.
    Vec3,
    /// Four components.
    Vec4,
    /// 2 x 2, column by column.
    Mat2,
    /// 3 x 3, column by column.
    Mat3,
    /// 4 x 4, column by column.
    Mat4,
}

impl Kind {
    const NAMES: [(Kind, &'static str); 7] = [
        (Kind::Scalar, "SCALAR"),
        (Kind::Vec2, "VEC2"),
        (Kind::Vec3, "VEC3"),
        (Kind::Vec4, "VEC4"),
        (Kind::Mat2, "MAT2"),
        (Kind::Mat3, "MAT3"),
        (Kind::Mat4, "MAT4"),
    ];

    /// From glTF's `type`.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::NAMES.iter().find(|(_, n)| *n == name).map(|(kind, _)| *kind)
    }

    /// glTF's `type`.
    pub fn name(self) -> &'static str {
        Self::NAMES.iter().find(|(kind, _)| *kind == self).map_or("SCALAR", |(_, name)| name)
    }

    /// Number of components.
    pub fn components(self) -> usize {
        let (columns, rows) = self.shape();
        columns * rows
    }

    /// Bytes of one element. Columns of matrices start at multiples of four bytes (glTF 2.0, section 3.6.2.4).
    pub fn element_size(self, component: ComponentType) -> usize {
        let (columns, rows) = self.shape();
        let column = rows * component.size();
        if columns > 1 { columns * column.next_multiple_of(4) } else { column }
    }

    fn shape(self) -> (usize, usize) {
        match self {
            Kind::Scalar => (1, 1),
            Kind::Vec2 => (1, 2),
            Kind::Vec3 => (1, 3),
            Kind::Vec4 => (1, 4),
            Kind::Mat2 => (2, 2),
            Kind::Mat3 => (3, 3),
            Kind::Mat4 => (4, 4),
        }
    }
}
