//! The index of a document: its materials, textures and primitives with what they refer to, before anything is decided.

use std::collections::BTreeSet;

use gltf::json::texture::{MinFilter, Sampler, WrappingMode};
use serde_json::Value;

use super::accessor_layout::valid;
use super::document::Document;
use super::extensions::{self, ANIMATION_POINTER, ANISOTROPY, TEXTURE_TRANSFORM, VARIANTS, is_image_source};
use super::json::{array, checked, index, number, object, typed};
use super::primitive::primitive_pointer;
use super::transform::{TextureTransform, UvLayout};
use crate::error::{Code, Failure, Result};
use crate::texture::{Alpha, Role, Wrap};

/// Materials, textures and primitives of a document, by index.
#[derive(Debug)]
pub struct MaterialIndex {
    /// By material index.
    pub(crate) materials: Vec<Material>,
    /// By texture index.
    pub(crate) textures: Vec<Texture>,
    /// Every primitive of every mesh, points and lines too, in order.
    pub(crate) primitives: Vec<Primitive>,
    /// Images that something outside the materials names.
    pub(crate) named_images: BTreeSet<usize>,
    /// Textures that something outside the materials names.
    pub(crate) named_textures: BTreeSet<usize>,
    /// Whether every extension, declared or not, is understood.
    pub(crate) understood: bool,
}

/// A material's textures.
#[derive(Debug, Default)]
pub(crate) struct Material {
    /// Name, where it has one.
    pub(crate) name: Option<String>,
    /// Every texture that it reads.
    pub(crate) uses: Vec<TextureUse>,
    /// Treatment of alpha.
    pub(crate) alpha: Alpha,
    /// Whether an animation moves one of its texture transforms.
    pub(crate) animated: bool,
    /// Whether its highlights follow the tangents by themselves, without a texture (KHR_materials_anisotropy).
    pub(crate) untextured_anisotropy: bool,
}

/// One texture read by a material.
#[derive(Debug, Clone)]
pub(crate) struct TextureUse {
    /// JSON pointer of the texture info, below the material.
    pub(crate) path: String,
    /// Index into `/textures`.
    pub(crate) texture: usize,
    /// The TEXCOORD set that it reads, and its texture transform.
    pub(crate) layout: UvLayout,
    /// What it means; none in an extension that is not known.
    pub(crate) role: Option<Role>,
}

/// A texture: image and sampler.
#[derive(Debug, Clone, Default)]
pub(crate) struct Texture {
    /// Index into `/images`.
    pub(crate) image: Option<usize>,
    /// Index into `/samplers`.
    pub(crate) sampler: Option<usize>,
    /// Wrap modes (S, T).
    pub(crate) wrap: [Wrap; 2],
    /// Whether minification reads mipmaps.
    pub(crate) mipmaps: bool,
    /// The image for readers that do not know the extension that gives `image`.
    pub(crate) fallback: Option<usize>,
    /// Whether an extension that is not understood may give another source.
    pub(crate) extended: bool,
}

/// A primitive.
#[derive(Debug, Clone)]
pub(crate) struct Primitive {
    /// Index into `/meshes`.
    pub(crate) mesh: usize,
    /// Index into the mesh's primitives.
    pub(crate) primitive: usize,
    /// glTF mode; 4, 5 and 6 are triangles.
    pub(crate) mode: u64,
    /// Its material, then those of its variants, each once.
    pub(crate) materials: Vec<usize>,
    /// Whether it has a default material.
    pub(crate) default_material: Option<usize>,
    /// Accessor of POSITION.
    pub(crate) positions: Option<usize>,
}

impl Primitive {
    /// JSON pointer of the primitive.
    pub(crate) fn pointer(&self) -> String {
        primitive_pointer(self.mesh, self.primitive)
    }
    /// Whether it draws triangles.
    pub(crate) fn is_triangles(&self) -> bool {
        (4..=6).contains(&self.mode)
    }
}

/// Textures that one material may read: every primitive looks at those of its materials.
const MOST_TEXTURES: usize = 256;

/// Where a material names its textures by itself; the table of extensions has the others.
const CORE_TEXTURES: [(&str, Role); 5] = [
    ("/pbrMetallicRoughness/baseColorTexture", Role::BaseColor),
    ("/pbrMetallicRoughness/metallicRoughnessTexture", Role::MetallicRoughness),
    ("/normalTexture", Role::Normal),
    ("/occlusionTexture", Role::Occlusion),
    ("/emissiveTexture", Role::Emissive),
];

impl MaterialIndex {
    /// Reads materials, textures and primitives.
    ///
    /// # Errors
    /// `invalid_model` with the pointer of an index that is out of range or a value of the wrong kind.
    pub fn new(doc: &Document) -> Result<MaterialIndex> {
        let json = &doc.json;
        let textures = array(json, "textures").iter().enumerate();
        let textures = textures.map(|(i, t)| texture(json, i, t)).collect::<Result<Vec<_>>>()?;
        let animated = animated_transforms(json);
        let mut materials = Vec::new();
        for (i, value) in array(json, "materials").iter().enumerate() {
            let mut material = material(value, textures.len(), i)?;
            material.animated = animated.contains(&i);
            materials.push(material);
        }
        let primitives = primitives(json)?;
        let mut named = (BTreeSet::new(), BTreeSet::new());
        // What is not understood may read the images and textures that it names: they must stay as they are.
        for (_, value) in json.as_object().into_iter().flatten().filter(|(k, _)| *k != "materials" && *k != "textures")
        {
            extensions::used(value).iter().for_each(|own| collect_names(own, &mut named));
        }
        for texture in array(json, "textures") {
            let own = object(texture, "extensions").into_iter().flatten();
            for (_, value) in own.filter(|(name, _)| !is_image_source(name)) {
                collect_names(value, &mut named);
            }
        }
        if let Some(extensions) = json.get("extensions") {
            collect_names(extensions, &mut named);
        }
        let understood = extensions::all_understood(json);
        Ok(MaterialIndex {
            materials,
            textures,
            primitives,
            named_images: named.0,
            named_textures: named.1,
            understood,
        })
    }

    /// Follows an edit that appended textures and changed some materials.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub(crate) fn follow_materials(&mut self, json: &Value, changed: &[usize]) -> Result<()> {
        for (i, value) in array(json, "textures").iter().enumerate().skip(self.textures.len()) {
            self.textures.push(texture(json, i, value)?);
        }
        for &m in changed {
            if let (Some(own), Some(value)) = (self.materials.get_mut(m), array(json, "materials").get(m)) {
                *own = Material { animated: own.animated, ..material(value, self.textures.len(), m)? };
            }
        }
        Ok(())
    }

    /// Follows an edit that put primitives together.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub(crate) fn follow_primitives(&mut self, json: &Value) -> Result<()> {
        self.primitives = primitives(json)?;
        Ok(())
    }
}

fn primitives(json: &Value) -> Result<Vec<Primitive>> {
    let mut primitives = Vec::new();
    for (m, mesh) in array(json, "meshes").iter().enumerate() {
        for (p, value) in array(mesh, "primitives").iter().enumerate() {
            primitives.push(primitive(json, value, m, p)?);
        }
    }
    Ok(primitives)
}

fn texture(json: &Value, i: usize, value: &Value) -> Result<Texture> {
    let pointer = format!("/textures/{i}");
    let images = array(json, "images").len();
    let mut image = index(value, "source", images, &pointer)?;
    let mut fallback = None;
    let own = object(value, "extensions");
    for name in extensions::all().filter(|e| e.image_source).map(|e| e.name) {
        if let Some(extension) = own.and_then(|e| e.get(name)) {
            let given = index(extension, "source", images, &format!("{pointer}/extensions/{name}"))?;
            if given.is_some() {
                fallback = fallback.or(image);
                image = given;
                break;
            }
        }
    }
    let sampler = index(value, "sampler", array(json, "samplers").len(), &pointer)?;
    let settings: Sampler = sampler.map(|s| typed(json, "samplers", s)).transpose()?.unwrap_or_default();
    let wrap = |mode| match valid(mode) {
        Some(WrappingMode::ClampToEdge) => Wrap::ClampToEdge,
        Some(WrappingMode::MirroredRepeat) => Wrap::MirroredRepeat,
        Some(WrappingMode::Repeat) | None => Wrap::Repeat,
    };
    let filter = settings.min_filter.and_then(valid);
    Ok(Texture {
        image,
        sampler,
        wrap: [wrap(settings.wrap_s), wrap(settings.wrap_t)],
        mipmaps: !matches!(filter, Some(MinFilter::Nearest | MinFilter::Linear)),
        fallback,
        extended: own.is_some_and(|e| !e.keys().all(|name| is_image_source(name))),
    })
}

fn material(value: &Value, textures: usize, i: usize) -> Result<Material> {
    let pointer = format!("/materials/{i}");
    let mut uses = Vec::new();
    for (path, role) in CORE_TEXTURES {
        if let Some(info) = value.pointer(path) {
            uses.push(texture_use(info, path.to_owned(), Some(role), textures, &pointer)?);
        }
    }
    if let Some(own) = value.get("extensions") {
        for extension in extensions::all() {
            let Some(object) = own.get(extension.name) else { continue };
            for (key, role) in extension.textures {
                if let Some(info) = object.get(key) {
                    let path = format!("/extensions/{}/{key}", extension.name);
                    uses.push(texture_use(info, path, Some(*role), textures, &pointer)?);
                }
            }
        }
        unknown_uses(own, "/extensions", textures, &pointer, &mut uses)?;
    }
    if uses.len() > MOST_TEXTURES {
        let text = format!("the material reads {} textures, more than {MOST_TEXTURES}", uses.len());
        return Err(Failure::new(Code::TooLarge, text).at(pointer));
    }
    let anisotropy = value.get("extensions").and_then(|e| e.get(ANISOTROPY));
    let untextured_anisotropy = anisotropy.is_some_and(|a| {
        let strength = a.get("anisotropyStrength").and_then(Value::as_f64).unwrap_or(0.0);
        strength != 0.0 && a.get("anisotropyTexture").is_none()
    });
    let alpha = match value.get("alphaMode").and_then(Value::as_str) {
        Some("BLEND") => Alpha::Blend,
        Some("MASK") => Alpha::Mask(value.get("alphaCutoff").and_then(Value::as_f64).unwrap_or(0.5)),
        _ => Alpha::Opaque,
    };
    let name = value.get("name").and_then(Value::as_str).filter(|n| !n.is_empty()).map(str::to_owned);
    Ok(Material { name, uses, alpha, animated: false, untextured_anisotropy })
}

fn texture_use(info: &Value, path: String, role: Option<Role>, textures: usize, pointer: &str) -> Result<TextureUse> {
    let at = format!("{pointer}{path}");
    let texture = index(info, "index", textures, &at)?
        .ok_or_else(|| Failure::model("a texture is named without an index").at(at.clone()))?;
    let uv_set = index(info, "texCoord", 1 << 16, &at)?.unwrap_or(0);
    let (transform, other) = TextureTransform::of(info, &at)?;
    Ok(TextureUse { path, texture, layout: UvLayout { uv_set: other.unwrap_or(uv_set), transform }, role })
}

/// Every `…Texture: {index}` below a material's extensions that the table of extensions does not have.
fn unknown_uses(value: &Value, path: &str, textures: usize, pointer: &str, uses: &mut Vec<TextureUse>) -> Result<()> {
    match value {
        Value::Object(map) => {
            for (key, child) in map {
                let below = format!("{path}/{}", key.replace('~', "~0").replace('/', "~1"));
                let known = is_known(&below);
                if !known && key.ends_with("exture") && child.get("index").is_some_and(Value::is_u64) {
                    uses.push(texture_use(child, below.clone(), None, textures, pointer)?);
                }
                unknown_uses(child, &below, textures, pointer, uses)?;
            }
        }
        Value::Array(items) => {
            for (i, child) in items.iter().enumerate() {
                unknown_uses(child, &format!("{path}/{i}"), textures, pointer, uses)?;
            }
        }
        _ => {}
    }
    Ok(())
}

/// Whether the table of extensions has the texture at a path below a material.
fn is_known(path: &str) -> bool {
    let names = path.strip_prefix("/extensions/").and_then(|path| path.split_once('/'));
    names.is_some_and(|(name, key)| {
        extensions::find(name).is_some_and(|e| e.textures.iter().any(|(texture, _)| *texture == key))
    })
}

fn primitive(json: &Value, value: &Value, m: usize, p: usize) -> Result<Primitive> {
    let pointer = primitive_pointer(m, p);
    let count = array(json, "materials").len();
    let default_material = index(value, "material", count, &pointer)?;
    let mut materials: Vec<usize> = default_material.into_iter().collect();
    let mut known: BTreeSet<usize> = default_material.into_iter().collect();
    if let Some(variants) = value.get("extensions").and_then(|e| e.get(VARIANTS)) {
        for (i, mapping) in array(variants, "mappings").iter().enumerate() {
            let at = format!("{pointer}/extensions/{VARIANTS}/mappings/{i}");
            if let Some(material) = index(mapping, "material", count, &at)?
                && known.insert(material)
            {
                materials.push(material);
            }
        }
    }
    let mode = match value.get("mode") {
        None => 4,
        Some(mode) => checked(mode, 7, || format!("{pointer}/mode"))? as u64,
    };
    let accessors = array(json, "accessors").len();
    let attributes = value
        .get("attributes")
        .filter(|a| a.is_object())
        .ok_or_else(|| Failure::model("the primitive has no attributes").at(format!("{pointer}/attributes")))?;
    let positions = index(attributes, "POSITION", accessors, &format!("{pointer}/attributes"))?;
    index(value, "indices", accessors, &pointer)?;
    Ok(Primitive { mesh: m, primitive: p, mode, materials, default_material, positions })
}

/// Materials of which an animation moves a texture transform (KHR_animation_pointer).
fn animated_transforms(json: &Value) -> BTreeSet<usize> {
    let pointer = format!("/target/extensions/{ANIMATION_POINTER}/pointer");
    let channels = array(json, "animations").iter().flat_map(|a| array(a, "channels"));
    channels
        .filter_map(|c| c.pointer(&pointer).and_then(Value::as_str))
        .filter(|p| p.contains(TEXTURE_TRANSFORM))
        .filter_map(|p| p.strip_prefix("/materials/")?.split('/').next()?.parse().ok())
        .collect()
}

/// Integers below keys that speak of images or textures.
fn collect_names(value: &Value, named: &mut (BTreeSet<usize>, BTreeSet<usize>)) {
    let Some(map) = value.as_object() else {
        value.as_array().into_iter().flatten().for_each(|child| collect_names(child, named));
        return;
    };
    for (key, child) in map {
        let key = key.to_ascii_lowercase();
        if key.contains("image") || key == "source" {
            integers(child, &mut named.0);
        } else if key.contains("texture") {
            integers(child, &mut named.1);
        }
        collect_names(child, named);
    }
}

fn integers(value: &Value, into: &mut BTreeSet<usize>) {
    match value {
        Value::Number(_) => into.extend(number(value)),
        Value::Array(items) => items.iter().for_each(|child| integers(child, into)),
        Value::Object(map) => map.values().for_each(|child| integers(child, into)),
        _ => {}
    }
}
