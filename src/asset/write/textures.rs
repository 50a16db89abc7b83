//! Images, textures, samplers and materials of refined sets: replaced in place where nobody else reads them,
//! appended where somebody does.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Map, Value, json};

use super::{BakedImage, Refined};
use crate::asset::extensions::{self, TEXTURE_TRANSFORM, is_image_source};
use crate::asset::json::object_mut;
use crate::asset::material_index::{MaterialIndex, TextureUse};
use crate::asset::sets::class;
use crate::asset::sources::{drop_images, each_source};
use crate::asset::{Document, UvLayout};
use crate::error::{Failure, Result};
use crate::texture::Slot;
use crate::texture::{Format, Wrap};

/// glTF's number of the wrap mode CLAMP_TO_EDGE.
const CLAMP_TO_EDGE: u32 = 33071;

/// Decides where the images, textures and materials of the refined layouts go.
pub(super) struct Textures<'a> {
    index: &'a MaterialIndex,
    sets: &'a [Refined<'a>],
    /// By material: whether a primitive that is not refined may read it.
    shared_materials: Vec<bool>,
    /// By texture and by image: whether something reads it through another layout than the refined one.
    foreign_textures: Vec<bool>,
    foreign_images: Vec<bool>,
    /// Image by (set, slot, page).
    images: BTreeMap<(usize, usize, usize), usize>,
    /// Format of the images that were placed.
    formats: BTreeMap<usize, Format>,
    /// Image by the name that several sets give it.
    shared: BTreeMap<String, usize>,
    /// Images in whose place another set's stands.
    replaced: Vec<usize>,
    /// Texture by (texture, set, slot, page).
    textures: BTreeMap<(usize, usize, usize, usize), usize>,
    /// Textures changed in place.
    taken: BTreeSet<usize>,
    /// CLAMP_TO_EDGE sampler by the one that it replaces.
    samplers: BTreeMap<Option<usize>, usize>,
    /// Material by (material, page, owner).
    materials: BTreeMap<(usize, usize, Owner), usize>,
    /// Materials changed in place.
    in_place: BTreeSet<usize>,
}

/// The set that a primitive is refined in, and how.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Owner {
    /// Index into the refined sets.
    set: usize,
    /// The layout that was refined.
    layout: UvLayout,
    /// Number of the TEXCOORD set that has the new one.
    written: usize,
}

impl Owner {
    /// The owner of primitive `p` of set `s`.
    pub(super) fn of(sets: &[Refined<'_>], s: usize, p: usize) -> Owner {
        let primitive = &sets[s].set.primitives[p];
        Owner { set: s, layout: primitive.layout, written: primitive.written }
    }
}

impl<'a> Textures<'a> {
    /// Finds out who reads what.
    pub(super) fn new(index: &'a MaterialIndex, sets: &'a [Refined<'a>], images: usize) -> Self {
        let mut owners: BTreeMap<(usize, usize), Owner> = BTreeMap::new();
        for (s, refined) in sets.iter().enumerate() {
            for (p, primitive) in refined.set.primitives.iter().enumerate() {
                owners.insert((primitive.mesh, primitive.primitive), Owner::of(sets, s, p));
            }
        }
        let count = index.materials.len();
        let (mut used, mut shared) = (vec![false; count], vec![false; count]);
        let mut readers: Vec<BTreeSet<Owner>> = vec![BTreeSet::new(); count];
        for primitive in &index.primitives {
            let owner = owners.get(&(primitive.mesh, primitive.primitive));
            for &m in &primitive.materials {
                used[m] = true;
                shared[m] |= owner.is_none();
                readers[m].extend(owner);
            }
        }
        // An extension that is not understood may give a material to something.
        shared.iter_mut().zip(&used).for_each(|(shared, used)| *shared |= !used && !index.understood);
        let mut out = Textures {
            index,
            sets,
            shared_materials: shared,
            foreign_textures: vec![false; index.textures.len()],
            foreign_images: vec![false; images],
            images: BTreeMap::new(),
            formats: BTreeMap::new(),
            shared: BTreeMap::new(),
            replaced: Vec::new(),
            textures: BTreeMap::new(),
            taken: BTreeSet::new(),
            samplers: BTreeMap::new(),
            materials: BTreeMap::new(),
            in_place: BTreeSet::new(),
        };
        for (m, (material, readers)) in index.materials.iter().zip(readers).enumerate() {
            for used in &material.uses {
                let refined = !readers.is_empty() && readers.iter().all(|owner| out.slot_of(*owner, used).is_some());
                out.foreign_textures[used.texture] |= out.shared_materials[m] || !refined;
            }
        }
        for texture in index.named_textures.iter().filter(|t| **t < index.textures.len()) {
            out.foreign_textures[*texture] = true;
        }
        let foreign = index.textures.iter().zip(&out.foreign_textures).filter(|(_, foreign)| **foreign);
        let foreign = foreign.flat_map(|(t, _)| t.image.into_iter().chain(t.fallback));
        let foreign = foreign.chain(index.named_images.iter().copied());
        for image in foreign.filter(|i| *i < images) {
            out.foreign_images[image] = true;
        }
        out
    }

    /// The slot that a material's texture is refined as.
    fn slot_of(&self, owner: Owner, used: &TextureUse) -> Option<usize> {
        let image = self.index.textures.get(used.texture)?.image?;
        let role = used.role.filter(|_| used.layout == owner.layout)?;
        let slots = &self.sets.get(owner.set)?.set.slots;
        slots.iter().position(|s: &Slot| s.image == image && class(s.role) == class(role) && !s.exempt)
    }

    /// Puts the baked images into the document.
    ///
    /// # Errors
    /// `internal` where an image of a page is missing.
    pub(super) fn place_images(&mut self, out: &mut Document) -> Result<()> {
        // An image that is read as colour and as data has a slot of each: the first takes its place.
        let mut taken = BTreeSet::new();
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
                    let image = known.unwrap_or_else(|| {
                        place(out, slot.image, baked, page == 0 && !foreign && taken.insert(slot.image))
                    });
                    if let Some(name) = &baked.shared {
                        self.shared.insert(name.clone(), image);
                    }
                    self.formats.insert(image, baked.format);
                    self.images.insert((s, i, page), image);
                }
            }
        }
        Ok(())
    }

    /// Takes out the images that the image of another set stands for, where every reader of their indices is known.
    pub(super) fn drop_replaced(&mut self, out: &mut Document) {
        let mut read = BTreeSet::new();
        each_source(&mut out.json, |source| read.extend(source.as_u64()));
        // A texture that no material reads keeps its image, and an extension what it names.
        let foreign = |r: &usize| self.foreign_images.get(*r).copied().unwrap_or(true);
        self.replaced.retain(|r| !read.contains(&(*r as u64)) && !foreign(r));
        self.replaced.sort_unstable();
        self.replaced.dedup();
        if !self.index.understood || self.replaced.is_empty() {
            return;
        }
        drop_images(out, &self.replaced);
    }

    /// The material that stands for `material` on a page, for a primitive with this owner.
    ///
    /// # Errors
    /// `invalid_model` for JSON of the wrong shape.
    pub(super) fn material(
        &mut self,
        out: &mut Document,
        original: &Document,
        material: usize,
        owner: Owner,
        page: usize,
    ) -> Result<usize> {
        let key = (material, page, owner);
        if let Some(done) = self.materials.get(&key) {
            return Ok(*done);
        }
        let index = self.index;
        let uses = index.materials.get(material).map_or(&[][..], |m| &m.uses);
        let mut edits = Vec::new();
        for used in uses {
            if let Some(slot) = self.slot_of(owner, used) {
                let texture = self.texture(out, used.texture, owner.set, slot, page)?;
                let moved = UvLayout::plain(owner.written) != used.layout;
                if texture != used.texture || moved {
                    edits.push(Edit { used, texture, uv_set: moved.then_some(owner.written) });
                }
            }
        }
        let shared = self.shared_materials.get(material).copied().unwrap_or(true);
        let target = if edits.is_empty() {
            material
        } else if page == 0 && !shared && self.in_place.insert(material) {
            edit(&mut out.json, &format!("/materials/{material}"), &edits)?;
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
            edit(&mut out.json, &format!("/materials/{number}"), &edits)?;
            number
        };
        self.materials.insert(key, target);
        Ok(target)
    }

    /// The texture that stands for `texture` on a page.
    fn texture(&mut self, out: &mut Document, texture: usize, set: usize, slot: usize, page: usize) -> Result<usize> {
        let key = (texture, set, slot, page);
        if let Some(done) = self.textures.get(&key) {
            return Ok(*done);
        }
        let indexed = self.index.textures.get(texture).cloned().unwrap_or_default();
        let image = self.images.get(&(set, slot, page)).copied();
        let image = image.ok_or_else(|| Failure::internal("a refined texture has no image"))?;
        let sampler = match indexed.wrap {
            [Wrap::ClampToEdge, Wrap::ClampToEdge] => None,
            _ => Some(self.clamped(out, indexed.sampler)),
        };
        let mut number = texture;
        let foreign = self.foreign_textures.get(texture).copied().unwrap_or(true);
        if page > 0 || foreign || !self.taken.insert(texture) {
            let clone = out.json.pointer(&format!("/textures/{texture}")).cloned().unwrap_or_else(|| json!({}));
            number = out.push("textures", clone);
        } else if let Some(fallback) = indexed.fallback {
            self.replaced.push(fallback);
        }
        let object = object_mut(&mut out.json, &format!("/textures/{number}"))?;
        set_source(object, image, self.formats.get(&image).copied());
        if let Some(sampler) = sampler {
            object.insert("sampler".to_owned(), Value::from(sampler));
        }
        self.textures.insert(key, number);
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

/// Gives a texture its image: as its core source, or where the format needs it by extension.
fn set_source(texture: &mut Map<String, Value>, image: usize, format: Option<Format>) {
    extensions::retain(texture, |name| !is_image_source(name));
    if let Some(name) = format.and_then(extensions::image_source) {
        texture.shift_remove("source");
        let extensions = texture.entry("extensions").or_insert_with(|| json!({}));
        extensions[name] = json!({ "source": image });
    } else {
        texture.insert("source".to_owned(), Value::from(image));
    }
}

/// What changes in one texture info.
struct Edit<'a> {
    used: &'a TextureUse,
    /// The texture that it names.
    texture: usize,
    /// The TEXCOORD set that it reads, untransformed, where that is another.
    uv_set: Option<usize>,
}

/// Points the texture infos of a material to other textures and layouts.
fn edit(json: &mut Value, pointer: &str, edits: &[Edit<'_>]) -> Result<()> {
    for Edit { used, texture, uv_set } in edits {
        let info = object_mut(json, &format!("{pointer}{}", used.path))?;
        if *texture != used.texture {
            info.insert("index".to_owned(), Value::from(*texture));
        }
        let Some(uv_set) = uv_set else { continue };
        if info.get("texCoord").and_then(Value::as_u64).unwrap_or(0) != *uv_set as u64 {
            info.insert("texCoord".to_owned(), Value::from(*uv_set));
        }
        extensions::retain(info, |name| name != TEXTURE_TRANSFORM);
    }
    Ok(())
}
