//! Images, textures, samplers and materials of refined sets: replaced in place where nobody else reads them,
//! appended where somebody does.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::{BakedImage, Refined};
use crate::asset::json::object_mut;
use crate::asset::scan::{Scan, TextureUse};
use crate::asset::{Document, Slot};
use crate::error::{Failure, Result};
use crate::texture::Wrap;

/// glTF's number of the wrap mode CLAMP_TO_EDGE.
const CLAMP_TO_EDGE: u32 = 33071;

/// Decides where the images, textures and materials of the refined layouts go.
pub(super) struct Textures<'a> {
    scan: &'a Scan,
    sets: &'a [Refined<'a>],
    /// By material: whether a primitive that is not refined may read it.
    shared_materials: Vec<bool>,
    /// By texture and by image: whether something reads it through another layout than the refined one.
    foreign_textures: Vec<bool>,
    foreign_images: Vec<bool>,
    /// Image by (set, slot, page).
    images: BTreeMap<(usize, usize, usize), usize>,
    /// Image by the name that several sets give it.
    shared: BTreeMap<String, usize>,
    /// Images in whose place another set's stands.
    replaced: Vec<usize>,
    /// Texture by (texture, page).
    textures: BTreeMap<(usize, usize), usize>,
    /// CLAMP_TO_EDGE sampler by the one that it replaces.
    samplers: BTreeMap<Option<usize>, usize>,
    /// Material by (material, page, TEXCOORD set).
    materials: BTreeMap<(usize, usize, usize), usize>,
    /// TEXCOORD set of a material changed in place.
    in_place: BTreeMap<usize, usize>,
}

/// The set and layout that own a primitive.
type Owner = Option<(usize, usize)>;

impl<'a> Textures<'a> {
    /// Finds out who reads what.
    pub(super) fn new(scan: &'a Scan, sets: &'a [Refined<'a>], images: usize) -> Self {
        let mut owners: BTreeMap<(usize, usize), (usize, usize)> = BTreeMap::new();
        for (s, refined) in sets.iter().enumerate() {
            for primitive in &refined.set.primitives {
                owners.insert((primitive.mesh, primitive.primitive), (s, primitive.uv_set));
            }
        }
        let count = scan.materials.len();
        let (mut used, mut shared, mut material_owner) = (vec![false; count], vec![false; count], vec![None; count]);
        for primitive in &scan.primitives {
            let owner: Owner = owners.get(&(primitive.mesh, primitive.primitive)).copied();
            for &m in &primitive.materials {
                used[m] = true;
                shared[m] |= owner.is_none();
                material_owner[m] = material_owner[m].or(owner);
            }
        }
        // An extension that is not understood may give a material to something.
        shared.iter_mut().zip(&used).for_each(|(shared, used)| *shared |= !used && !scan.understood);
        let mut out = Textures {
            scan,
            sets,
            shared_materials: shared,
            foreign_textures: vec![false; scan.textures.len()],
            foreign_images: vec![false; images],
            images: BTreeMap::new(),
            shared: BTreeMap::new(),
            replaced: Vec::new(),
            textures: BTreeMap::new(),
            samplers: BTreeMap::new(),
            materials: BTreeMap::new(),
            in_place: BTreeMap::new(),
        };
        for (m, (material, owner)) in scan.materials.iter().zip(material_owner).enumerate() {
            for used in &material.uses {
                let refined = owner.is_some_and(|owner| out.slot_of(owner, used).is_some());
                out.foreign_textures[used.texture] |= out.shared_materials[m] || !refined;
            }
        }
        for texture in scan.named_textures.iter().filter(|t| **t < scan.textures.len()) {
            out.foreign_textures[*texture] = true;
        }
        let foreign = scan.textures.iter().zip(&out.foreign_textures).filter(|(_, foreign)| **foreign);
        let foreign = foreign.filter_map(|(t, _)| t.image).chain(scan.named_images.iter().copied());
        for image in foreign.filter(|i| *i < images) {
            out.foreign_images[image] = true;
        }
        out
    }

    /// The slot that a material's texture is refined as.
    fn slot_of(&self, (set, uv_set): (usize, usize), used: &TextureUse) -> Option<usize> {
        let image = self.scan.textures.get(used.texture)?.image?;
        let slots = &self.sets.get(set)?.set.slots;
        let slot = slots.iter().position(|s: &Slot| s.image == image && !s.exempt)?;
        (used.role.is_some() && used.uv_set == uv_set).then_some(slot)
    }

    /// Puts the baked images into the document.
    ///
    /// # Errors
    /// `internal` where an image of a page is missing.
    pub(super) fn place_images(&mut self, out: &mut Document) -> Result<()> {
        for (s, refined) in self.sets.iter().enumerate() {
            for (i, slot) in refined.set.slots.iter().enumerate().filter(|(_, slot)| !slot.exempt) {
                for page in 0..refined.atlas.sheets.len() {
                    let baked =
                        refined.images.iter().find(|b| b.slot == i && b.page == page).ok_or_else(|| {
                            Failure::internal(format!("slot {} of page {page} was not baked", slot.name))
                        })?;
                    let foreign = self.foreign_images.get(slot.image).copied().unwrap_or(true);
                    let known = baked.shared.as_ref().and_then(|name| self.shared.get(name).copied());
                    if known.is_some() && page == 0 && !foreign {
                        self.replaced.push(slot.image);
                    }
                    let image = known.unwrap_or_else(|| place(out, slot.image, baked, page == 0 && !foreign));
                    if let Some(name) = &baked.shared {
                        self.shared.insert(name.clone(), image);
                    }
                    self.images.insert((s, i, page), image);
                }
            }
        }
        Ok(())
    }

    /// Takes out the images that the image of another set stands for, where every reader of their indices is known.
    pub(super) fn drop_replaced(&mut self, out: &mut Document) {
        let textures = out.json.get("textures").and_then(Value::as_array);
        let read: Vec<u64> = textures.into_iter().flatten().filter_map(|t| t.get("source")?.as_u64()).collect();
        // A texture that no material reads keeps its image.
        self.replaced.retain(|r| !read.contains(&(*r as u64)));
        self.replaced.sort_unstable();
        self.replaced.dedup();
        if !self.scan.understood || self.replaced.is_empty() {
            return;
        }
        let replaced = &self.replaced;
        let gone = |image: usize| replaced.binary_search(&image).is_ok();
        if let Some(images) = out.json.get_mut("images").and_then(Value::as_array_mut) {
            let mut index = 0;
            images.retain(|_| {
                index += 1;
                !gone(index - 1)
            });
        }
        let mut index = 0;
        out.images.retain(|_| {
            index += 1;
            !gone(index - 1)
        });
        for texture in out.json.get_mut("textures").and_then(Value::as_array_mut).into_iter().flatten() {
            let Some(source) = texture.get("source").and_then(Value::as_u64) else { continue };
            let before = replaced.partition_point(|r| (*r as u64) < source);
            texture["source"] = Value::from(source - before as u64);
        }
    }

    /// The material that stands for `material` on a page, reading TEXCOORD_`uv_set`, for a primitive of set
    /// `owner.0` whose layout `owner.1` was refined.
    ///
    /// # Errors
    /// `invalid_model` for JSON of the wrong shape.
    pub(super) fn material(
        &mut self,
        out: &mut Document,
        original: &Document,
        material: usize,
        owner: (usize, usize),
        page: usize,
        uv_set: usize,
    ) -> Result<usize> {
        if let Some(done) = self.materials.get(&(material, page, uv_set)) {
            return Ok(*done);
        }
        let scan = self.scan;
        let uses = scan.materials.get(material).map_or(&[][..], |m| &m.uses);
        let mut edits = Vec::new();
        for used in uses {
            if let Some(slot) = self.slot_of(owner, used) {
                let texture = self.texture(out, used.texture, owner.0, slot, page)?;
                if texture != used.texture || uv_set != used.uv_set {
                    edits.push((used, texture));
                }
            }
        }
        let shared = self.shared_materials.get(material).copied().unwrap_or(true);
        let target = if edits.is_empty() {
            material
        } else if page == 0 && !shared && !self.in_place.contains_key(&material) {
            self.in_place.insert(material, uv_set);
            edit(&mut out.json, &format!("/materials/{material}"), &edits, uv_set)?;
            material
        } else {
            let mut clone =
                original.json.pointer(&format!("/materials/{material}")).cloned().unwrap_or_else(|| json!({}));
            if let Some(Value::String(name)) = clone.get_mut("name")
                && page > 0
            {
                *name = format!("{name} (page {})", page + 1);
            }
            let number = out.push("materials", clone);
            edit(&mut out.json, &format!("/materials/{number}"), &edits, uv_set)?;
            number
        };
        self.materials.insert((material, page, uv_set), target);
        Ok(target)
    }

    /// The texture that stands for `texture` on a page.
    fn texture(&mut self, out: &mut Document, texture: usize, set: usize, slot: usize, page: usize) -> Result<usize> {
        if let Some(done) = self.textures.get(&(texture, page)) {
            return Ok(*done);
        }
        let scanned = self.scan.textures.get(texture).cloned().unwrap_or_default();
        let image = self.images.get(&(set, slot, page)).copied();
        let image = image.ok_or_else(|| Failure::internal("a refined texture has no image"))?;
        let sampler = match scanned.wrap {
            [Wrap::ClampToEdge, Wrap::ClampToEdge] => None,
            _ => Some(self.clamped(out, scanned.sampler)),
        };
        let mut number = texture;
        if page > 0 || self.foreign_textures.get(texture).copied().unwrap_or(true) {
            let clone = out.json.pointer(&format!("/textures/{texture}")).cloned().unwrap_or_else(|| json!({}));
            number = out.push("textures", clone);
        }
        let object = object_mut(&mut out.json, &format!("/textures/{number}"))?;
        object.insert("source".to_owned(), Value::from(image));
        if let Some(sampler) = sampler {
            object.insert("sampler".to_owned(), Value::from(sampler));
        }
        self.textures.insert((texture, page), number);
        Ok(number)
    }

    /// A sampler like the one given, but for CLAMP_TO_EDGE on both axes.
    fn clamped(&mut self, out: &mut Document, sampler: Option<usize>) -> usize {
        *self.samplers.entry(sampler).or_insert_with(|| {
            let uploaded = sampler.and_then(|s| out.json.pointer(&format!("/samplers/{s}")));
            let mut clone = uploaded.cloned().unwrap_or_else(|| json!({}));
            if let Some(object) = clone.as_object_mut() {
                object.insert("wrapS".to_owned(), Value::from(CLAMP_TO_EDGE));
                object.insert("wrapT".to_owned(), Value::from(CLAMP_TO_EDGE));
            }
            out.push("samplers", clone)
        })
    }
}

/// Puts a baked image in the place of image `index`, or behind the others.
fn place(out: &mut Document, index: usize, baked: &BakedImage, in_place: bool) -> usize {
    let mut number = index;
    if !in_place {
        let mut clone = out.json.pointer(&format!("/images/{index}")).cloned().unwrap_or_else(|| json!({}));
        if let Some(object) = clone.as_object_mut() {
            // The file of that name stays the other image's.
            object.shift_remove("uri");
        }
        number = out.push("images", clone);
    }
    out.set_image(number, baked.bytes.clone(), baked.format.media_type());
    if let Some(name) = &baked.shared
        && let Some(image) = out.json.pointer_mut(&format!("/images/{number}")).and_then(Value::as_object_mut)
    {
        image.insert("uri".to_owned(), Value::from(name.as_str()));
    }
    number
}

/// Points the texture infos of a material to other textures and TEXCOORD sets.
fn edit(json: &mut Value, pointer: &str, edits: &[(&TextureUse, usize)], uv_set: usize) -> Result<()> {
    for (used, texture) in edits {
        let info = object_mut(json, &format!("{pointer}{}", used.path))?;
        if *texture != used.texture {
            info.insert("index".to_owned(), Value::from(*texture));
        }
        if uv_set != used.uv_set {
            info.insert("texCoord".to_owned(), Value::from(uv_set));
        }
    }
    Ok(())
}
