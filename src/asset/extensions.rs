//! The table of glTF extensions: what Intarsia knows of each, asked wherever an extension matters.

use serde_json::{Map, Value};

use super::json::array;
use crate::texture::{Format, Role};

/// Where a document declares its extensions.
const DECLARATIONS: [&str; 2] = ["extensionsUsed", "extensionsRequired"];

/// Texture transforms of a texture info.
pub(crate) const TEXTURE_TRANSFORM: &str = "KHR_texture_transform";
/// WebP as the image of a texture.
pub(crate) const TEXTURE_WEBP: &str = "EXT_texture_webp";
/// KTX2 as the image of a texture.
pub(crate) const TEXTURE_BASISU: &str = "KHR_texture_basisu";
/// Materials of a primitive that a viewer chooses from.
pub(crate) const VARIANTS: &str = "KHR_materials_variants";
/// Highlights along a direction of the surface.
pub(crate) const ANISOTROPY: &str = "KHR_materials_anisotropy";
/// Animations of anything that a JSON pointer names.
pub(crate) const ANIMATION_POINTER: &str = "KHR_animation_pointer";
/// Copies of a node's mesh, placed by accessors.
pub(crate) const GPU_INSTANCING: &str = "EXT_mesh_gpu_instancing";
/// A centre that all positions are relative to (3D Tiles), far from the origin.
pub(crate) const RTC: &str = "CESIUM_RTC";
/// Primitives compressed with Draco.
pub(crate) const DRACO: &str = "KHR_draco_mesh_compression";
/// Buffer views compressed with meshopt: one layout under two names; the second also has colour filters.
pub(crate) const MESHOPT: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];
/// Begins the names of material extensions. One that is not in the table is read and written like those that are; the
/// textures that it names keep their layout.
const MATERIALS: &str = "KHR_materials_";

/// How an extension of a primitive stands to the primitive's layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum OnPrimitive {
    /// Not known, and it names textures or texture coordinates: the primitive stays as it is.
    Unknown,
    /// Not known, and nothing in it names textures or texture coordinates: it stays as long as the triangles are those that it was made for.
    OfTriangles,
    /// It reads vertices, the TEXCOORD sets among them: they stay, and the new layout becomes a set beside them.
    ReadsLayout,
    /// It has nothing to do with the layout.
    Independent,
}

/// What is known of one extension.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Extension {
    /// Its name.
    pub(crate) name: &'static str,
    /// Whether a model that requires it is read.
    pub(crate) read: bool,
    /// Whether refining takes it out of a document or puts it in, so that its declarations are kept true.
    pub(crate) written: bool,
    /// Whether every index in it is known, so that arrays may be compacted around it: none is left unseen.
    pub(crate) understood: bool,
    /// Whether it gives a texture its image; the core `source`, if any, stands in where it is not understood.
    pub(crate) image_source: bool,
    /// The textures that it owns: their keys in its object of a material, and what they mean.
    pub(crate) textures: &'static [(&'static str, Role)],
    /// How it stands to the layout of a primitive that has it.
    pub(crate) on_primitive: OnPrimitive,
}

impl Extension {
    /// Nothing is known but the name.
    const fn named(name: &'static str) -> Self {
        Extension {
            name,
            read: false,
            written: false,
            understood: false,
            image_source: false,
            textures: &[],
            on_primitive: OnPrimitive::Unknown,
        }
    }

    /// It is read and understood, and nothing need be done about it.
    const fn handled(name: &'static str) -> Self {
        Extension { read: true, understood: true, ..Self::named(name) }
    }

    /// A material extension with its textures.
    const fn material(name: &'static str, textures: &'static [(&'static str, Role)]) -> Self {
        Extension { textures, ..Self::handled(name) }
    }

    /// It gives textures their images.
    const fn image_source(name: &'static str) -> Self {
        Extension { image_source: true, written: true, ..Self::handled(name) }
    }

    /// It is gone once a model is loaded.
    const fn decoded(name: &'static str) -> Self {
        Extension { read: true, ..Self::named(name) }
    }

    /// It names no index, and a reader that does not know it may ignore it.
    const fn ignored(name: &'static str) -> Self {
        Extension { understood: true, ..Self::named(name) }
    }
}

/// Every extension that something is known of. Textures of materials are used in the order of this table.
const TABLE: [Extension; 31] = [
    // Geometry.
    Extension::decoded(DRACO),
    Extension::decoded(MESHOPT[0]),
    Extension::decoded(MESHOPT[1]),
    Extension::handled("KHR_mesh_quantization"),
    Extension::handled(GPU_INSTANCING),
    Extension { on_primitive: OnPrimitive::ReadsLayout, ..Extension::named("EXT_mesh_features") },
    Extension { on_primitive: OnPrimitive::ReadsLayout, ..Extension::named("EXT_structural_metadata") },
    // Textures.
    Extension { written: true, ..Extension::handled(TEXTURE_TRANSFORM) },
    Extension::image_source(TEXTURE_BASISU),
    Extension::image_source(TEXTURE_WEBP),
    Extension::ignored("EXT_texture_avif"),
    // Materials.
    Extension { on_primitive: OnPrimitive::Independent, ..Extension::handled(VARIANTS) },
    Extension::material(
        "KHR_materials_clearcoat",
        &[
            ("clearcoatTexture", Role::Clearcoat),
            ("clearcoatRoughnessTexture", Role::ClearcoatRoughness),
            ("clearcoatNormalTexture", Role::ClearcoatNormal),
        ],
    ),
    Extension::material(
        "KHR_materials_sheen",
        &[("sheenColorTexture", Role::SheenColor), ("sheenRoughnessTexture", Role::SheenRoughness)],
    ),
    Extension::material(
        "KHR_materials_specular",
        &[("specularTexture", Role::Specular), ("specularColorTexture", Role::SpecularColor)],
    ),
    Extension::material("KHR_materials_transmission", &[("transmissionTexture", Role::Transmission)]),
    Extension::material("KHR_materials_volume", &[("thicknessTexture", Role::Thickness)]),
    Extension::material(
        "KHR_materials_iridescence",
        &[("iridescenceTexture", Role::Iridescence), ("iridescenceThicknessTexture", Role::IridescenceThickness)],
    ),
    Extension::material(ANISOTROPY, &[("anisotropyTexture", Role::Anisotropy)]),
    Extension::material(
        "KHR_materials_diffuse_transmission",
        &[
            ("diffuseTransmissionTexture", Role::DiffuseTransmission),
            ("diffuseTransmissionColorTexture", Role::DiffuseTransmissionColor),
        ],
    ),
    Extension::material(
        "KHR_materials_pbrSpecularGlossiness",
        &[("diffuseTexture", Role::Diffuse), ("specularGlossinessTexture", Role::SpecularGlossiness)],
    ),
    Extension::material("KHR_materials_dispersion", &[]),
    Extension::material("KHR_materials_emissive_strength", &[]),
    Extension::material("KHR_materials_ior", &[]),
    Extension::material("KHR_materials_unlit", &[]),
    // The scene.
    Extension::handled("KHR_lights_punctual"),
    Extension::handled(RTC),
    Extension::ignored(ANIMATION_POINTER),
    Extension::handled("KHR_node_visibility"),
    Extension::handled("KHR_xmp_json_ld"),
    // Any other material extension.
    Extension::material(MATERIALS, &[]),
];

/// All extensions of the table.
pub(crate) fn all() -> impl Iterator<Item = &'static Extension> {
    TABLE.iter()
}

/// What is known of an extension.
pub(crate) fn find(name: &str) -> Option<&'static Extension> {
    let own = TABLE.iter().find(|e| e.name == name);
    own.or_else(|| TABLE.iter().find(|e| e.name == MATERIALS).filter(|_| name.starts_with(MATERIALS)))
}

/// Whether a model that requires an extension is read.
pub(crate) fn is_read(name: &str) -> bool {
    find(name).is_some_and(|e| e.read)
}

/// Whether every index in an extension is known.
pub(crate) fn is_understood(name: &str) -> bool {
    find(name).is_some_and(|e| e.understood)
}

/// Whether an extension gives a texture its image.
pub(crate) fn is_image_source(name: &str) -> bool {
    find(name).is_some_and(|e| e.image_source)
}

/// The extension by which a texture names an image of a format; none where it needs none.
pub(crate) fn image_source(format: Format) -> Option<&'static str> {
    match format {
        Format::Webp => Some(TEXTURE_WEBP),
        Format::Ktx2 => Some(TEXTURE_BASISU),
        Format::Png | Format::Jpeg => None,
    }
}

/// How an extension of a primitive, `value`, stands to its layout. One that is not in the table is asked what it names.
pub(crate) fn on_primitive(name: &str, value: &Value) -> OnPrimitive {
    match find(name).map(|e| e.on_primitive) {
        Some(known) if known != OnPrimitive::Unknown => known,
        _ if names_layout(value) => OnPrimitive::Unknown,
        _ => OnPrimitive::OfTriangles,
    }
}

/// Whether a key or a text in it names a texture or texture coordinates.
fn names_layout(value: &Value) -> bool {
    let is_layout = |text: &str| {
        let text = text.to_ascii_lowercase();
        ["texture", "texcoord", "image"].iter().any(|word| text.contains(word)) || text.starts_with("uv")
    };
    match value {
        Value::String(text) => is_layout(text),
        Value::Array(values) => values.iter().any(names_layout),
        Value::Object(map) => map.iter().any(|(key, value)| is_layout(key) || names_layout(value)),
        _ => false,
    }
}

/// Every `extensions` of a document outside its extras.
pub(crate) fn used(json: &Value) -> Vec<&Value> {
    let mut used = Vec::new();
    let mut stack = vec![json];
    while let Some(value) = stack.pop() {
        match value {
            Value::Array(values) => stack.extend(values),
            Value::Object(object) => {
                used.extend(object.get("extensions"));
                stack.extend(object.iter().filter(|(key, _)| *key != "extras").map(|(_, value)| value));
            }
            _ => {}
        }
    }
    used
}

/// Whether every extension of a document, declared or not, is understood: no array of it is referred to unseen.
pub(crate) fn all_understood(json: &Value) -> bool {
    let mut declared = DECLARATIONS.into_iter().flat_map(|key| array(json, key)).filter_map(Value::as_str);
    let mut used = used(json).into_iter().filter_map(Value::as_object).flat_map(|e| e.keys());
    declared.all(is_understood) && used.all(|name| is_understood(name))
}

/// Leaves of the extensions of a glTF object those that are to be kept.
pub(crate) fn retain(owner: &mut Map<String, Value>, kept: impl Fn(&str) -> bool) {
    let Some(own) = owner.get_mut("extensions").and_then(Value::as_object_mut) else { return };
    let before = own.len();
    own.retain(|name, _| kept(name));
    if own.is_empty() && before > 0 {
        owner.shift_remove("extensions");
    }
}

/// Removes an extension from the lists of those that are used and required.
pub(crate) fn undeclare(json: &mut Value, name: &str) {
    let Some(root) = json.as_object_mut() else { return };
    for key in DECLARATIONS {
        let Some(list) = root.get_mut(key).and_then(Value::as_array_mut) else { continue };
        let before = list.len();
        list.retain(|n| n.as_str() != Some(name));
        if list.is_empty() && before > 0 {
            root.shift_remove(key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn each_extension_stands_once() {
        for (i, extension) in TABLE.iter().enumerate() {
            assert!(TABLE[..i].iter().all(|e| e.name != extension.name), "{}", extension.name);
        }
    }

    #[test]
    fn rows_agree_with_themselves() {
        for e in all() {
            assert!(!e.written || e.read, "{}: what is written can be read", e.name);
            assert!(e.textures.is_empty() || e.understood, "{}: textures are indices that are known", e.name);
            assert!(!e.image_source || e.read && e.understood, "{}: images are indices that are known", e.name);
        }
        assert!([DRACO, MESHOPT[0], MESHOPT[1]].into_iter().all(is_read));
    }

    #[test]
    fn material_extensions_that_are_not_in_the_table_are_read() {
        assert!(is_read("KHR_materials_of_tomorrow") && is_understood("KHR_materials_of_tomorrow"));
        assert!(!is_read("ACME_materials") && !is_understood("ACME_materials"));
    }

    #[test]
    fn what_an_unknown_extension_of_a_primitive_names_decides() {
        let bvh = json!({ "roots": [3], "index": { "bufferView": 7 }, "heuristic": "sah" });
        assert_eq!(on_primitive("ACME_bvh", &bvh), OnPrimitive::OfTriangles);
        for layout in [
            json!({ "texture": 0 }),
            json!({ "inner": [{ "attributes": { "TEXCOORD_1": 4 } }] }),
            json!({ "reads": "TEXCOORD_0" }),
            json!({ "uvScale": 2.0 }),
        ] {
            assert_eq!(on_primitive("ACME_paint", &layout), OnPrimitive::Unknown, "{layout}");
        }
        assert_eq!(on_primitive(VARIANTS, &json!({ "texture": 0 })), OnPrimitive::Independent);
    }

    #[test]
    fn extensions_count_wherever_they_stand() {
        assert!(all_understood(&json!({ "extensionsUsed": ["KHR_node_visibility", "KHR_materials_ior"] })));
        assert!(!all_understood(&json!({ "extensionsUsed": ["ACME_x"] })));
        assert!(!all_understood(&json!({ "nodes": [{ "extensions": { "ACME_x": {} } }] })), "used, not declared");
        assert!(all_understood(&json!({ "nodes": [{ "extras": { "extensions": { "ACME_x": {} } } }] })));
    }
}
