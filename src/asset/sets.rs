//! Which primitives and images form a texture set.
//!
//! Primitives (with the TEXCOORD set that is refined) and the images that their materials, variants
//! included, read through it are the nodes of a graph; its connected components are the texture sets.
//! What cannot be refined leaves by name, with a warning, and stays as it was uploaded.

use std::collections::{BTreeMap, BTreeSet};

use super::document::Document;
use super::extensions::{OnPrimitive, on_primitive};
use super::json::{array, object};
use super::material_index::{MaterialIndex, Primitive, Texture, TextureUse};
use super::options::UvSet;
use super::primitive::declared_triangles;
use super::texture_set::TextureSet;
use super::transform::{TextureTransform, UvLayout};
use crate::atlas::find_root;
use crate::context::Context;
use crate::error::{Result, Warning};
use crate::texture::{Alpha, BASIS_BLOCK, Direction, Format, Header, Role, header, jpeg_coding};
use crate::texture::{Reading, Slot};

/// A texture set before its geometry is read.
#[derive(Debug)]
pub(crate) struct Planned {
    /// Indices into the index's primitives, ascending, and the layout of each that is refined.
    pub(crate) primitives: Vec<(usize, UvLayout)>,
    /// Its images; empty for a virtual page.
    pub(crate) slots: Vec<Slot>,
    /// Size of the largest slot.
    pub(crate) reference: [u32; 2],
    /// Primitives that read an image with several wrap modes, by position in `primitives`, with the image: they agree only inside it.
    pub(crate) conflicts: Vec<(u32, usize)>,
}

/// Sheet of a set without images.
const VIRTUAL_SHEET: [u32; 2] = [1024, 1024];

impl Planned {
    fn without_images(primitives: Vec<(usize, UvLayout)>) -> Planned {
        Planned { primitives, slots: Vec::new(), reference: VIRTUAL_SHEET, conflicts: Vec::new() }
    }
}

/// Forms the texture sets of the TEXCOORD set `uv_set`, in the order of their first primitive. Behind them is one without images, of
/// what no texture is read through; where the new layout is a set of its own, all is in that one.
///
/// # Errors
/// None but those of the context; what cannot be refined is a warning.
pub(crate) fn plan(doc: &Document, index: &MaterialIndex, uv_set: UvSet, context: &Context) -> Result<Vec<Planned>> {
    context.check()?;
    let mut chooser = LayoutChooser { doc, index, uv_set: uv_set.number(), texels: BTreeMap::new() };
    let mut candidates: Vec<(usize, UvLayout)> = Vec::new();
    for (p, primitive) in index.primitives.iter().enumerate() {
        if is_refinable(doc, primitive, uv_set, context) {
            if uv_set == UvSet::New {
                candidates.push((p, UvLayout::plain(uv_set.number())));
                continue;
            }
            let layout = chooser.layout(primitive);
            if may_change(doc, index, primitive, layout, context) {
                candidates.push((p, layout));
            }
        }
    }
    let mut sets = Vec::new();
    if uv_set != UvSet::New {
        let (components, rest) = components(index, &candidates);
        let own = |(primitives, images): (Vec<_>, Vec<_>)| planned(doc, index, primitives, &images, context);
        sets.extend(components.into_iter().filter_map(own));
        // A texture that is read through the set, and is not known, stays where it is read.
        let reads = |m: &usize| all_uses(index, *m).iter().any(|u| u.layout.uv_set == uv_set.number());
        let is_unread = |p: usize| !index.primitives[p].materials.iter().any(reads);
        let all = array(&doc.json, "images").is_empty();
        candidates = rest.into_iter().filter(|&(p, _)| all || is_unread(p)).collect();
    }
    if !candidates.is_empty() {
        sets.push(Planned::without_images(candidates));
    }
    Ok(sets)
}

/// The triangles of a document without any texture coordinates, as one set without a layout: those of primitives whose
/// materials read no texture, so that a layout may be made for them, and whose extensions are known.
pub(crate) fn plan_unmapped(doc: &Document, index: &MaterialIndex) -> Option<Planned> {
    let textured = |m: &usize| index.materials.get(*m).is_none_or(|m| !m.uses.is_empty() || m.untextured_anisotropy);
    let unmapped = |primitive: &Primitive| {
        let Some(value) = doc.json.pointer(&primitive.pointer()) else { return false };
        let mut names = object(value, "attributes").into_iter().flat_map(|a| a.keys());
        let mut extensions = object(value, "extensions").into_iter().flatten();
        primitive.is_triangles()
            && primitive.positions.is_some()
            && !names.any(|name| name.starts_with("TEXCOORD_"))
            && !extensions.any(|(name, own)| on_primitive(name, own) == OnPrimitive::Unknown)
            && !primitive.materials.iter().any(textured)
    };
    let layout = UvLayout::plain(0);
    let found = index.primitives.iter().enumerate().filter(|(_, p)| unmapped(p));
    let primitives: Vec<_> = found.map(|(p, _)| (p, layout)).collect();
    (!primitives.is_empty()).then(|| Planned::without_images(primitives))
}

/// Whether triangles with the texture coordinates that are refined are in none of the sets, because something stands in the way.
pub(crate) fn leaves_any(doc: &Document, index: &MaterialIndex, sets: &[TextureSet], uv_set: UvSet) -> bool {
    let taken: BTreeSet<_> = sets.iter().flat_map(|s| s.primitives.iter().map(|p| (p.mesh, p.primitive))).collect();
    let name = format!("TEXCOORD_{}", uv_set.number());
    let is_left = |p: &Primitive| {
        let value = doc.json.pointer(&p.pointer());
        let value = value.filter(|v| v.get("attributes").is_some_and(|a| a.get(&name).is_some()));
        p.is_triangles() && p.positions.is_some() && value.is_some_and(|v| declared_triangles(&doc.json, v) > 0)
    };
    index.primitives.iter().any(|p| !taken.contains(&(p.mesh, p.primitive)) && is_left(p))
}

/// The uses of a material that are refined with a layout.
pub(crate) fn refined_uses(
    index: &MaterialIndex,
    material: usize,
    layout: UvLayout,
) -> impl Iterator<Item = &TextureUse> {
    all_uses(index, material).iter().filter(move |u| u.layout == layout && u.role.is_some())
}

fn all_uses(index: &MaterialIndex, material: usize) -> &[TextureUse] {
    index.materials.get(material).map_or(&[], |m| &m.uses)
}

/// The TEXCOORD set that takes the new layout of a primitive: the refined one, or a new one where something else reads it on or the
/// options say so.
pub(crate) fn written_set(
    index: &MaterialIndex,
    value: &serde_json::Value,
    materials: &[usize],
    layout: UvLayout,
    uv_set: UvSet,
) -> usize {
    let read_on = |u: &TextureUse| u.layout.uv_set == layout.uv_set && (u.layout != layout || u.role.is_none());
    let reads = |(name, own): (&String, &serde_json::Value)| on_primitive(name, own) == OnPrimitive::ReadsLayout;
    let extended = object(value, "extensions").is_some_and(|e| e.iter().any(reads));
    if uv_set == UvSet::New || extended || materials.iter().any(|&m| all_uses(index, m).iter().any(read_on)) {
        let names = object(value, "attributes").into_iter().flat_map(|a| a.keys());
        let last = names.filter_map(|n| n.strip_prefix("TEXCOORD_")?.parse::<usize>().ok()).max();
        return last.map_or(layout.uv_set, |last| last.saturating_add(1));
    }
    layout.uv_set
}

/// Chooses the texture transform that is refined where a TEXCOORD set is read through several: the one with the most texels.
struct LayoutChooser<'a> {
    doc: &'a Document,
    index: &'a MaterialIndex,
    uv_set: usize,
    /// By image; 0 where it cannot be read.
    texels: BTreeMap<usize, u64>,
}

impl LayoutChooser<'_> {
    fn layout(&mut self, primitive: &Primitive) -> UvLayout {
        let (index, uv_set) = (self.index, self.uv_set);
        let uses = primitive.materials.iter().flat_map(|&m| all_uses(index, m));
        let mut found: Vec<(TextureTransform, u64)> = Vec::new();
        for used in uses.filter(|u| u.role.is_some() && u.layout.uv_set == uv_set) {
            let image = self.index.textures.get(used.texture).and_then(|t| t.image);
            let texels = image.map_or(0, |image| self.texels_of(image));
            match found.iter_mut().find(|(t, _)| *t == used.layout.transform) {
                Some((_, sum)) => *sum = sum.saturating_add(texels),
                None => found.push((used.layout.transform, texels)),
            }
        }
        // The first of the largest: the order of uses is that of roles.
        let best = found.into_iter().reduce(|a, b| if b.1 > a.1 { b } else { a });
        UvLayout { uv_set, transform: best.map_or(TextureTransform::IDENTITY, |b| b.0) }
    }

    fn texels_of(&mut self, image: usize) -> u64 {
        let bytes = self.doc.images.get(image).and_then(Option::as_ref);
        let read = || bytes.and_then(|b| header(b).ok()).map_or(0, |h| u64::from(h.width) * u64::from(h.height));
        *self.texels.entry(image).or_insert_with(read)
    }
}

/// Whether a primitive has triangles with UVs and nothing of its own that stands in the way.
fn is_refinable(doc: &Document, primitive: &Primitive, uv_set: UvSet, context: &Context) -> bool {
    let pointer = primitive.pointer();
    let Some(value) = doc.json.pointer(&pointer) else { return false };
    let name = format!("TEXCOORD_{}", uv_set.number());
    let has_uvs = value.get("attributes").is_some_and(|a| a.get(&name).is_some());
    if !primitive.is_triangles() || primitive.positions.is_none() || !has_uvs {
        return false;
    }
    let mut extensions = object(value, "extensions").into_iter().flatten();
    if let Some((key, _)) = extensions.find(|(name, own)| on_primitive(name, own) == OnPrimitive::Unknown) {
        let text = format!(
            "the primitive is left as it is: its extension {key} is not known, and names textures or texture coordinates that a new layout would make wrong (remove the extension to have the primitive refined)"
        );
        context.warn(Warning::new("primitive_extension", text).at(format!("{pointer}/extensions/{key}")));
        return false;
    }
    if uv_set != UvSet::New && array(value, "targets").iter().any(|t| t.get(&name).is_some()) {
        let text = format!(
            "the primitive is left as it is: a morph target moves its {name} (atlas.uv_set \"new\" gives it a layout beside that)"
        );
        context.warn(Warning::new("texcoord_morph", text).at(format!("{pointer}/targets")));
        return false;
    }
    true
}

/// Whether the materials of a primitive let its layout change; says which of their textures keep theirs.
fn may_change(
    doc: &Document,
    index: &MaterialIndex,
    primitive: &Primitive,
    layout: UvLayout,
    context: &Context,
) -> bool {
    let attributes = doc.json.pointer(&format!("{}/attributes", primitive.pointer()));
    let has_tangents = attributes.is_some_and(|a| a.get("TANGENT").is_some());
    let mut free = true;
    for &m in &primitive.materials {
        let Some(material) = index.materials.get(m) else { continue };
        let at = |used: &TextureUse| format!("/materials/{m}{}", used.path);
        let mut left = |code: &str, text: &str| {
            let text = format!("the material is left as it is: {text}");
            context.warn(Warning::new(code, text).at(format!("/materials/{m}")));
            free = false;
        };
        if doc.undefined.contains(&m) {
            left(
                "missing_material_library",
                "the library that may define it was not uploaded, so that its textures are not known",
            );
        }
        if material.animated {
            left(
                "animated_texture_transform",
                "an animation moves one of its texture transforms (atlas.uv_set \"new\" gives its primitives a layout beside the old one)",
            );
        }
        let directions = material.uses.iter().filter(|u| u.role.is_some_and(|r| r.is_direction()));
        let (ours, others): (Vec<_>, Vec<_>) = directions.partition(|u| u.layout == layout);
        if !ours.is_empty() && !others.is_empty() {
            let text = "its normal maps (or anisotropy) are read through two layouts, and have one tangent space (read all through one TEXCOORD set and transform to have it refined)";
            left("directions_on_two_layouts", text);
        }
        if material.untextured_anisotropy && (!ours.is_empty() || !has_tangents) {
            let text = "its anisotropy has no texture that could turn with the charts (give it an anisotropyTexture, or its primitives TANGENT)";
            left("anisotropy_without_texture", text);
        }
        for used in material.uses.iter().filter(|u| u.layout != layout || u.role.is_none()) {
            let (code, why) = if used.layout.uv_set != layout.uv_set {
                let (own, refined) = (used.layout.uv_set, layout.uv_set);
                (
                    "other_uv_set",
                    format!(
                        "it reads TEXCOORD_{own}, not TEXCOORD_{refined} (atlas.uv_set {own} refines that one instead)"
                    ),
                )
            } else if used.role.is_none() {
                ("material_extension_texture", "it belongs to an extension that is not known".to_owned())
            } else {
                ("other_texture_transform", "it is read through another texture transform than what is refined (give all textures of the material one, to have all refined)".to_owned())
            };
            let text = format!("the texture keeps its layout: {why}");
            context.warn(Warning::new(code, text).at(at(used)));
        }
    }
    free
}

/// Primitives with their layouts, and the images that they read through them; both ascending.
type Component = (Vec<(usize, UvLayout)>, Vec<usize>);

/// Connected components with at least one image, by first primitive, and the primitives without any.
fn components(index: &MaterialIndex, candidates: &[(usize, UvLayout)]) -> (Vec<Component>, Vec<(usize, UvLayout)>) {
    let mut parent: Vec<u32> = (0..candidates.len() as u32).collect();
    let mut first_reader: BTreeMap<usize, u32> = BTreeMap::new();
    for (i, &(p, layout)) in candidates.iter().enumerate() {
        for image in images_of(index, &index.primitives[p], layout) {
            let reader = *first_reader.entry(image).or_insert(i as u32);
            let (a, b) = (find_root(&mut parent, i as u32), find_root(&mut parent, reader));
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    let mut images: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
    for (&image, &reader) in &first_reader {
        images.entry(find_root(&mut parent, reader)).or_default().push(image);
    }
    let mut primitives: BTreeMap<u32, Vec<(usize, UvLayout)>> = BTreeMap::new();
    for (i, &candidate) in candidates.iter().enumerate() {
        primitives.entry(find_root(&mut parent, i as u32)).or_default().push(candidate);
    }
    // A root is its component's first primitive, so that the order of the map is the one wanted.
    let found = images.into_iter().filter_map(|(root, images)| Some((primitives.remove(&root)?, images))).collect();
    (found, primitives.into_values().flatten().collect())
}

fn images_of(index: &MaterialIndex, primitive: &Primitive, layout: UvLayout) -> Vec<usize> {
    let uses = primitive.materials.iter().flat_map(|&m| refined_uses(index, m, layout));
    uses.filter_map(|u| index.textures.get(u.texture)?.image).collect()
}

/// The slots of a component, or a warning and nothing where it cannot be refined.
fn planned(
    doc: &Document,
    index: &MaterialIndex,
    primitives: Vec<(usize, UvLayout)>,
    images: &[usize],
    context: &Context,
) -> Option<Planned> {
    let mut blocked = false;
    let mut readers: BTreeMap<(usize, Class), Readers> = BTreeMap::new();
    for (i, &(p, layout)) in primitives.iter().enumerate() {
        for &m in &index.primitives[p].materials {
            for used in refined_uses(index, m, layout) {
                let Some(texture) = index.textures.get(used.texture) else { continue };
                if texture.extended {
                    let text = "the texture set is left as it is: an extension gives the texture another source";
                    let at = format!("/textures/{}/extensions", used.texture);
                    context.warn(Warning::new("texture_extension", text).at(at));
                    blocked = true;
                }
                if let (Some(image), Some(role)) = (texture.image, used.role) {
                    let alpha = index.materials[m].alpha;
                    readers.entry((image, class(role))).or_default().add(i as u32, role, texture, alpha);
                }
            }
        }
    }
    let (mut slots, mut conflicts) = (Vec::new(), Vec::new());
    for ((image, _), readers) in readers.into_iter().filter(|((image, _), _)| images.contains(image)) {
        conflicts.extend(readers.conflicts().map(|p| (p, image)));
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
        slot.name = if *n == 1 { slot.role.to_string() } else { format!("{}_{n}", slot.role) };
    }
    // The first of the largest.
    let size = |h: &Header| u64::from(h.width) * u64::from(h.height);
    let largest = slots.iter().map(|s| &s.header).reduce(|a, b| if size(b) > size(a) { b } else { a });
    let reference = largest.map_or(VIRTUAL_SHEET, |h| [h.width, h.height]);
    Some(Planned { primitives, slots, reference, conflicts })
}

/// What decides how texels are filtered: whether they are sRGB-encoded, and the kind of direction. An image that is read as
/// several is a slot of each.
type Class = (bool, Option<Direction>);

/// The class of a role.
pub(crate) fn class(role: Role) -> Class {
    (role.is_srgb(), role.direction())
}

/// What the readers of one image say of it, in order.
#[derive(Default)]
struct Readers {
    roles: Vec<Role>,
    readings: Vec<Reading>,
    mipmaps: bool,
    alphas: Vec<Alpha>,
}

impl Readers {
    fn add(&mut self, primitive: u32, role: Role, texture: &Texture, alpha: Alpha) {
        self.mipmaps |= texture.mipmaps;
        if !self.roles.contains(&role) {
            self.roles.push(role);
        }
        match self.readings.iter_mut().find(|r| r.wrap == texture.wrap) {
            Some(reading) if reading.primitives.last() == Some(&primitive) => {}
            Some(reading) => reading.primitives.push(primitive),
            None => self.readings.push(Reading { wrap: texture.wrap, primitives: vec![primitive] }),
        }
        let coloured = matches!(role, Role::BaseColor | Role::Diffuse);
        if coloured && self.alphas.len() < 64 && !self.alphas.contains(&alpha) {
            self.alphas.push(alpha);
        }
    }

    /// Primitives that read the image with several wrap modes.
    fn conflicts(&self) -> impl Iterator<Item = u32> {
        let mut all: Vec<u32> = self.readings.iter().flat_map(|r| r.primitives.iter().copied()).collect();
        all.sort_unstable();
        let mut twice: Vec<u32> = all.windows(2).filter(|w| w[0] == w[1]).map(|w| w[0]).collect();
        twice.dedup();
        twice.into_iter()
    }
}

/// One image with what its readers say of it.
fn slot(doc: &Document, image: usize, mut readers: Readers) -> std::result::Result<Slot, Warning> {
    let at = format!("/images/{image}");
    let left = "the texture set is left as it is:";
    let bytes = doc.images.get(image).and_then(Option::as_ref);
    let bytes = bytes.ok_or_else(|| {
        Warning::new("missing_image", format!("{left} the image is missing (send it along with the model)")).at(&*at)
    })?;
    let header = header(bytes).map_err(|e| Warning::new("invalid_image", format!("{left} {}", e.message)).at(&*at))?;
    readers.roles.sort_unstable();
    let mut primitives: Vec<u32> = readers.readings.iter().flat_map(|r| r.primitives.iter().copied()).collect();
    primitives.sort_unstable();
    primitives.dedup();
    // Who reads an image with several wrap modes reads it inside: the first serves.
    let mut seen = BTreeSet::new();
    for reading in &mut readers.readings {
        reading.primitives.retain(|p| seen.insert(*p));
    }
    readers.readings.retain(|r| !r.primitives.is_empty());
    Ok(Slot {
        image,
        role: readers.roles.first().copied().unwrap_or(Role::BaseColor),
        name: String::new(),
        header,
        block: match header.format {
            Format::Ktx2 => BASIS_BLOCK,
            _ => jpeg_coding(bytes).map_or(1, |coding| coding.block().into_iter().max().unwrap_or(1)),
        },
        readings: readers.readings,
        mipmaps: readers.mipmaps,
        alpha: common_alpha(&readers.alphas),
        primitives,
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

/// The least common multiple; none where it is no number of 32 bits, or 0.
pub(crate) fn lcm(a: u32, b: u32) -> Option<u32> {
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
    let text = format!(
        "{} is less than 1/8 as wide or high as the largest texture of its atlas: charts cannot move by whole texels of it, so that it is resampled",
        slot.name
    );
    Some(Warning::new("small_slot_resampled", text).at(format!("/images/{}", slot.image)))
}
