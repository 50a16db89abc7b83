//! Which primitives and images form a texture set.
//!
//! Primitives (with the TEXCOORD set that is refined) and the images that their materials, variants
//! included, read through it are the nodes of a graph; its connected components are the texture sets.
//! What cannot be refined yet leaves by name, with a warning, and stays as it was uploaded.

use std::collections::BTreeMap;

use super::json::{array, object};
use super::scan::{Primitive, Scan, Texture, TextureUse};
use super::{Document, Slot, TextureSet};
use crate::context::Context;
use crate::error::{Result, Warning};
use crate::texture::{Alpha, Header, Role, Wrap, header};

/// A texture set before its geometry is read.
#[derive(Debug)]
pub(crate) struct Planned {
    /// Indices into the scan's primitives, ascending.
    pub(crate) primitives: Vec<usize>,
    /// Its images; empty for a virtual page.
    pub(crate) slots: Vec<Slot>,
    /// Size of the largest slot.
    pub(crate) reference: [u32; 2],
    /// The first image, if any, that is read with several wrap modes: they agree only inside the image.
    pub(crate) conflict: Option<usize>,
}

/// Sheet of a set without images.
const VIRTUAL_SHEET: [u32; 2] = [1024, 1024];

/// Primitive extensions that only read vertices, so that new ones may be added beside what they read.
const READERS: [&str; 2] = ["EXT_mesh_features", "EXT_structural_metadata"];

/// Forms the texture sets of layout `uv_set`, in the order of their first primitive.
///
/// # Errors
/// None but those of the context; what cannot be refined is a warning.
pub(crate) fn plan(doc: &Document, scan: &Scan, uv_set: usize, context: &Context) -> Result<Vec<Planned>> {
    context.check()?;
    let candidates: Vec<usize> =
        (0..scan.primitives.len()).filter(|&p| is_candidate(doc, scan, &scan.primitives[p], uv_set, context)).collect();
    let mut sets = Vec::new();
    for (primitives, images) in components(scan, &candidates, uv_set) {
        if let Some(set) = planned(doc, scan, primitives, &images, uv_set, context) {
            sets.push(set);
        }
    }
    if sets.is_empty() && array(&doc.json, "images").is_empty() && !candidates.is_empty() {
        sets.push(Planned { primitives: candidates, slots: Vec::new(), reference: VIRTUAL_SHEET, conflict: None });
    }
    Ok(sets)
}

/// The uses of a material that are refined with layout `uv_set`.
pub(crate) fn refined_uses(scan: &Scan, material: usize, uv_set: usize) -> impl Iterator<Item = &TextureUse> {
    let uses = scan.materials.get(material).map_or(&[][..], |m| &m.uses);
    uses.iter().filter(move |u| u.uv_set == uv_set && u.role.is_some())
}

/// Whether a primitive has triangles with UVs and nothing that stands in the way.
fn is_candidate(doc: &Document, scan: &Scan, primitive: &Primitive, uv_set: usize, context: &Context) -> bool {
    let pointer = primitive.pointer();
    let Some(value) = doc.json.pointer(&pointer) else { return false };
    let name = format!("TEXCOORD_{uv_set}");
    let has_uvs = value.get("attributes").is_some_and(|a| a.get(&name).is_some());
    if !primitive.is_triangles() || primitive.positions.is_none() || !has_uvs {
        return false;
    }
    let mut keys = object(value, "extensions").into_iter().flat_map(|e| e.keys());
    let strange = keys.find(|k| *k != "KHR_materials_variants" && !READERS.contains(&k.as_str()));
    if let Some(key) = strange {
        let text = format!("the primitive is left as it is: its extension {key} is not supported");
        context.warn(Warning::new("primitive_extension", text).at(format!("{pointer}/extensions/{key}")));
        return false;
    }
    if array(value, "targets").iter().any(|t| t.get(&name).is_some()) {
        let text = format!("the primitive is left as it is: a morph target moves its {name}");
        context.warn(Warning::new("texcoord_morph", text).at(format!("{pointer}/targets")));
        return false;
    }
    let mut free = true;
    for &m in &primitive.materials {
        let Some(material) = scan.materials.get(m) else { continue };
        if material.animated || material.uses.iter().any(|u| u.transformed) {
            let text = "the material is left as it is: texture transforms are not supported yet";
            context.warn(Warning::new("texture_transform_unsupported", text).at(format!("/materials/{m}")));
            free = false;
        }
        for other in material.uses.iter().filter(|u| u.uv_set != uv_set) {
            let text =
                format!("the texture keeps its layout: it reads TEXCOORD_{}, not TEXCOORD_{uv_set}", other.uv_set);
            context.warn(Warning::new("other_uv_set", text).at(format!("/materials/{m}{}", other.path)));
        }
        extension_texture(scan, m, uv_set, context);
    }
    free
}

/// Warns of a texture that a material extension reads with layout `uv_set`.
fn extension_texture(scan: &Scan, m: usize, uv_set: usize, context: &Context) -> bool {
    let uses = scan.materials.get(m).map_or(&[][..], |m| &m.uses);
    let found = uses.iter().find(|u| u.role.is_none() && u.uv_set == uv_set);
    if let Some(found) = found {
        let text = "the texture set is left as it is: textures of material extensions are not supported yet";
        context.warn(Warning::new("material_extension_texture", text).at(format!("/materials/{m}{}", found.path)));
    }
    found.is_some()
}

/// Connected components with at least one image, by first primitive: primitives and images, ascending.
fn components(scan: &Scan, candidates: &[usize], uv_set: usize) -> Vec<(Vec<usize>, Vec<usize>)> {
    let mut forest = Forest((0..candidates.len()).collect());
    let mut first_reader: BTreeMap<usize, usize> = BTreeMap::new();
    for (i, &p) in candidates.iter().enumerate() {
        for image in images_of(scan, &scan.primitives[p], uv_set) {
            let reader = *first_reader.entry(image).or_insert(i);
            forest.join(i, reader);
        }
    }
    let mut images: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (&image, &reader) in &first_reader {
        images.entry(forest.root(reader)).or_default().push(image);
    }
    let mut primitives: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (i, &p) in candidates.iter().enumerate() {
        primitives.entry(forest.root(i)).or_default().push(p);
    }
    // A root is its component's first primitive, so that the order of the map is the one wanted.
    images.into_iter().filter_map(|(root, images)| Some((primitives.remove(&root)?, images))).collect()
}

fn images_of(scan: &Scan, primitive: &Primitive, uv_set: usize) -> Vec<usize> {
    let uses = primitive.materials.iter().flat_map(|&m| refined_uses(scan, m, uv_set));
    uses.filter_map(|u| scan.textures.get(u.texture)?.image).collect()
}

/// Union-find; a root is the smallest of its tree.
struct Forest(Vec<usize>);

impl Forest {
    fn root(&mut self, mut i: usize) -> usize {
        while self.0[i] != i {
            self.0[i] = self.0[self.0[i]];
            i = self.0[i];
        }
        i
    }
    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b);
    }
}

/// The slots of a component, or a warning and nothing where it cannot be refined.
fn planned(
    doc: &Document,
    scan: &Scan,
    primitives: Vec<usize>,
    images: &[usize],
    uv_set: usize,
    context: &Context,
) -> Option<Planned> {
    let mut blocked = false;
    let mut readers: BTreeMap<usize, Readers> = BTreeMap::new();
    for (i, &p) in primitives.iter().enumerate() {
        for &m in &scan.primitives[p].materials {
            blocked |= extension_texture(scan, m, uv_set, context);
            for used in refined_uses(scan, m, uv_set) {
                let Some(texture) = scan.textures.get(used.texture) else { continue };
                if texture.extended {
                    let text = "the texture set is left as it is: an extension gives the texture another source";
                    let at = format!("/textures/{}/extensions", used.texture);
                    context.warn(Warning::new("texture_extension", text).at(at));
                    blocked = true;
                }
                if let (Some(image), Some(role)) = (texture.image, used.role) {
                    readers.entry(image).or_default().add(i as u32, role, texture, scan.materials[m].alpha);
                }
            }
        }
    }
    let (mut slots, mut conflict) = (Vec::new(), None);
    for &image in images {
        let readers = readers.remove(&image).unwrap_or_default();
        conflict = conflict.or((readers.wraps.len() > 1).then_some(image));
        match slot(doc, image, readers) {
            Ok(slot) => slots.push(slot),
            Err(warning) => {
                context.warn(warning);
                blocked = true;
            }
        }
    }
    if blocked {
        return None;
    }
    slots.sort_by_key(|s| (s.role, s.image));
    let mut count: BTreeMap<Role, usize> = BTreeMap::new();
    for slot in &mut slots {
        let n = count.entry(slot.role).or_default();
        *n += 1;
        slot.name = if *n == 1 { slot.role.as_str().to_owned() } else { format!("{}_{n}", slot.role.as_str()) };
    }
    // The first of the largest.
    let size = |h: &Header| u64::from(h.width) * u64::from(h.height);
    let largest = slots.iter().map(|s| &s.header).reduce(|a, b| if size(b) > size(a) { b } else { a });
    let reference = largest.map_or(VIRTUAL_SHEET, |h| [h.width, h.height]);
    Some(Planned { primitives, slots, reference, conflict })
}

/// What the readers of one image say of it, in order.
#[derive(Default)]
struct Readers {
    primitives: Vec<u32>,
    roles: Vec<Role>,
    wraps: Vec<[Wrap; 2]>,
    mipmaps: bool,
    alphas: Vec<Alpha>,
}

impl Readers {
    fn add(&mut self, primitive: u32, role: Role, texture: &Texture, alpha: Alpha) {
        if self.primitives.last() != Some(&primitive) {
            self.primitives.push(primitive);
        }
        self.mipmaps |= texture.mipmaps;
        if !self.roles.contains(&role) {
            self.roles.push(role);
        }
        if !self.wraps.contains(&texture.wrap) {
            self.wraps.push(texture.wrap);
        }
        if role == Role::BaseColor && self.alphas.len() < 64 && !self.alphas.contains(&alpha) {
            self.alphas.push(alpha);
        }
    }
}

/// One image with what its readers say of it.
fn slot(doc: &Document, image: usize, mut readers: Readers) -> std::result::Result<Slot, Warning> {
    let at = format!("/images/{image}");
    let left = "the texture set is left as it is:";
    let bytes = doc.images.get(image).and_then(Option::as_ref);
    let bytes = bytes.ok_or_else(|| Warning::new("missing_image", format!("{left} the image is missing")).at(&*at))?;
    let header = header(bytes).map_err(|e| Warning::new("invalid_image", format!("{left} {}", e.message)).at(&*at))?;
    readers.roles.sort_unstable();
    let role = readers.roles.first().copied().unwrap_or(Role::BaseColor);
    if readers.roles.iter().any(|r| (r.is_srgb(), r.direction()) != (role.is_srgb(), role.direction())) {
        let text = format!("{left} the image is read both as {} and as other data", role.as_str());
        return Err(Warning::new("image_role_conflict", text).at(at));
    }
    Ok(Slot {
        image,
        role,
        name: String::new(),
        header,
        wrap: readers.wraps.first().copied().unwrap_or_default(),
        mipmaps: readers.mipmaps,
        alpha: common_alpha(&readers.alphas),
        primitives: readers.primitives,
        exempt: false,
    })
}

/// The treatment of alpha that serves all readers: where they disagree colour stays independent of it.
fn common_alpha(alphas: &[Alpha]) -> Alpha {
    match alphas {
        [first, rest @ ..] if rest.iter().all(|a| a == first) => *first,
        [Alpha::Mask(cutoff), rest @ ..] if rest.iter().all(|a| matches!(a, Alpha::Mask(_))) => Alpha::Mask(*cutoff),
        _ => Alpha::Opaque,
    }
}

/// Whether a slot is under 1/8 of the reference on an axis: exempt if it is of one colour, and
/// resampled otherwise; either way the grid does not heed it.
pub fn is_small(slot: &Slot, reference: [u32; 2]) -> bool {
    let [w, h] = reference;
    u64::from(slot.header.width) * 8 < u64::from(w) || u64::from(slot.header.height) * 8 < u64::from(h)
}

/// The smallest translation for which the texels of all slots stay whole: per axis the least common multiple
/// of reference / slot size; none where a ratio is no integer.
pub(crate) fn grid(reference: [u32; 2], slots: &[Slot]) -> Option<[u32; 2]> {
    let mut grid = [1u32; 2];
    for slot in slots.iter().filter(|s| !s.exempt && !is_small(s, reference)) {
        for (k, size) in [slot.header.width, slot.header.height].into_iter().enumerate() {
            let ratio = reference[k].checked_rem(size).filter(|r| *r == 0).map(|_| reference[k] / size)?;
            grid[k] = lcm(grid[k], ratio)?;
        }
    }
    Some(grid)
}

fn lcm(a: u32, b: u32) -> Option<u32> {
    let (mut x, mut y) = (a, b);
    while y != 0 {
        (x, y) = (y, x % y);
    }
    (a / x.max(1)).checked_mul(b).filter(|n| *n > 0)
}

/// Marks a slot whose image turned out to be of one colour: any UVs fit it, so that it is not baked and
/// the grid need not heed it.
pub fn mark_uniform(set: &mut TextureSet, slot: usize) {
    if let Some(slot) = set.slots.get_mut(slot) {
        slot.exempt = true;
        set.grid = grid(set.reference, &set.slots);
    }
}

/// The warning due for a small slot that is not of one colour.
pub fn small_slot_warning(set: &TextureSet, slot: usize) -> Option<Warning> {
    let slot = set.slots.get(slot).filter(|s| !s.exempt && is_small(s, set.reference))?;
    let text = format!("{} is under 1/8 of the largest texture: its texels are resampled", slot.name);
    Some(Warning::new("small_slot_resampled", text).at(format!("/images/{}", slot.image)))
}
