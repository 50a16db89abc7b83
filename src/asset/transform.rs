//! Texture transforms (KHR_texture_transform) and the layouts that they make of a TEXCOORD set.

use glam::DVec2;
use serde::Deserialize;
use serde_json::Value;

use super::extensions::TEXTURE_TRANSFORM;
use super::json::{index, read};
use crate::error::Result;

/// What is done to UVs before a texture is read: scaled, turned counter-clockwise as one sees the image, moved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TextureTransform {
    /// Translation, in images.
    pub offset: DVec2,
    /// Angle in radians.
    pub rotation: f64,
    /// Scale by axis.
    pub scale: DVec2,
}

/// The extension's object, but for the TEXCOORD set.
#[derive(Deserialize)]
#[serde(default)]
struct Fields {
    offset: [f64; 2],
    rotation: f64,
    scale: [f64; 2],
}

impl Default for Fields {
    fn default() -> Self {
        Fields { offset: [0.0; 2], rotation: 0.0, scale: [1.0; 2] }
    }
}

impl TextureTransform {
    /// UVs as they are.
    pub const IDENTITY: TextureTransform = TextureTransform { offset: DVec2::ZERO, rotation: 0.0, scale: DVec2::ONE };

    /// The transform of a texture info, and the TEXCOORD set that it names instead of the info's. `pointer` is that of the info.
    ///
    /// # Errors
    /// `invalid_model` with a pointer for a value of the wrong kind.
    pub(crate) fn of(info: &Value, pointer: &str) -> Result<(TextureTransform, Option<usize>)> {
        let Some(value) = info.get("extensions").and_then(|e| e.get(TEXTURE_TRANSFORM)) else {
            return Ok((TextureTransform::IDENTITY, None));
        };
        let at = format!("{pointer}/extensions/{TEXTURE_TRANSFORM}");
        let Fields { offset, rotation, scale } = read(value, || at.clone())?;
        let transform = TextureTransform { offset: offset.into(), rotation, scale: scale.into() };
        Ok((transform, index(value, "texCoord", 1 << 16, &at)?))
    }

    /// Whether it changes nothing.
    pub fn is_identity(&self) -> bool {
        *self == TextureTransform::IDENTITY
    }

    /// Where the image is read for a UV: T R S of the extension's text, with v down.
    pub fn apply(&self, uv: [f32; 2]) -> DVec2 {
        let uv = DVec2::from(uv.map(f64::from));
        if self.is_identity() {
            return uv;
        }
        let (sin, cos) = self.rotation.sin_cos();
        let p = uv * self.scale;
        DVec2::new(cos * p.x + sin * p.y, cos * p.y - sin * p.x) + self.offset
    }

    /// Bits by which equal transforms are told: -0 is 0.
    fn bits(&self) -> [u64; 5] {
        [self.offset.x, self.offset.y, self.rotation, self.scale.x, self.scale.y].map(|x| (x + 0.0).to_bits())
    }
}

impl Eq for TextureTransform {}

impl PartialOrd for TextureTransform {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for TextureTransform {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.bits().cmp(&other.bits())
    }
}

impl std::hash::Hash for TextureTransform {
    fn hash<H: std::hash::Hasher>(&self, state: &mut H) {
        self.bits().hash(state);
    }
}

/// How texture coordinates are read: a TEXCOORD set, transformed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct UvLayout {
    /// Number of the TEXCOORD set.
    pub uv_set: usize,
    /// What is done to it.
    pub transform: TextureTransform,
}

impl UvLayout {
    /// A TEXCOORD set as it is.
    pub fn plain(uv_set: usize) -> UvLayout {
        UvLayout { uv_set, transform: TextureTransform::IDENTITY }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn transform(value: Value) -> TextureTransform {
        TextureTransform::of(&json!({ "extensions": { TEXTURE_TRANSFORM: value } }), "").unwrap().0
    }

    #[test]
    fn scaled_then_turned_then_moved() {
        // By its definition, the homogeneous matrices multiplied out: a quarter turn takes +u to -v, which is up.
        let t = transform(json!({ "offset": [0.25, 0.5], "rotation": std::f64::consts::FRAC_PI_2, "scale": [2, 3] }));
        let apply = |u, v| t.apply([u, v]);
        assert!((apply(0.0, 0.0) - DVec2::new(0.25, 0.5)).length() < 1e-15);
        assert!((apply(1.0, 0.0) - DVec2::new(0.25, -1.5)).length() < 1e-15);
        assert!((apply(0.0, 1.0) - DVec2::new(3.25, 0.5)).length() < 1e-15);
    }

    #[test]
    fn what_says_nothing_is_the_identity() {
        assert!(transform(json!({})).is_identity());
        assert!(transform(json!({ "offset": [0, -0.0], "scale": [1, 1.0], "rotation": 0 })).is_identity());
        assert_eq!(transform(json!({ "rotation": -0.0 })).cmp(&TextureTransform::IDENTITY), std::cmp::Ordering::Equal);
        for wrong in [json!(3), json!({ "offset": [1] }), json!({ "rotation": "x" }), json!({ "texCoord": -1 })] {
            let info = json!({ "extensions": { TEXTURE_TRANSFORM: wrong } });
            let at = TextureTransform::of(&info, "/m").unwrap_err().pointer.unwrap();
            assert!(at.starts_with("/m/extensions/KHR_texture_transform"));
        }
    }
}
