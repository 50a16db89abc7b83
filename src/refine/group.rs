//! Texture sets that share one Atlas: joined before the stages run, parted again to be written.
//!
//! The uploaded sheets of the sets lie side by side on one sheet, so that no chart of one meets a chart of another; a texel
//! stays a texel. Faces, primitives, surface and UV vertices of the sets follow one another, in the order of the members.

use std::borrow::Cow;
use std::collections::BTreeMap;

use glam::DVec2;

use super::importance::Importance;
use crate::asset::{TextureSet, grid};
use crate::atlas::{Atlas, FaceId, Surface, UvId, VertexId};
use crate::error::{Failure, Result, Warning};
use crate::texture::Slot;
use crate::texture::{Alpha, Format, Header};

/// Sheets are placed at multiples of this many texels, and of what keeps the texels of every slot whole.
const STEP: u32 = 16;
/// The largest such multiple; beyond it slots are resampled rather than placed far apart.
const LARGEST_STEP: u32 = 1024;
/// A set whose charts spread over more texels than this on an axis is not joined to others.
const FARTHEST: f64 = 1_048_576.0;
/// Longest name of a group, in characters.
const LONGEST_NAME: usize = 60;
/// Ratios of slot to sheet that differ by less are the same.
const SAME_RATIO: f64 = 1e-6;

/// Texture sets that share one Atlas; usually one.
#[derive(Debug)]
pub(super) struct Group {
    /// The sets; never empty.
    pub members: Vec<Member>,
    /// The sets as one, where there are several.
    joint: Option<TextureSet>,
    /// Weights of the surface, where the options ask for them.
    pub importance: Option<Importance>,
}

/// A texture set in a group.
#[derive(Debug)]
pub(super) struct Member {
    /// The model that it belongs to.
    pub model: usize,
    /// As read.
    pub set: TextureSet,
    /// Its first face in the group's Atlas.
    first_face: usize,
    /// Its first primitive in the group's list.
    first_primitive: usize,
    /// Where the corner of its sheet lies on the group's, in texels.
    pub place: DVec2,
    /// By slot of the set: the slot of the group. None for those that stay as they are.
    pub slots: Vec<Option<usize>>,
}

impl Group {
    /// A set for itself, or several joined; `id` becomes their number. `sets` are models and sets, and not empty.
    pub fn new(id: usize, sets: Vec<(usize, TextureSet)>) -> Self {
        let mut members: Vec<Member> = Vec::new();
        let (mut first_face, mut first_primitive) = (0, 0);
        for (model, mut set) in sets {
            set.id = id;
            let slots = set.slots.iter().enumerate().map(|(i, s)| (!s.exempt).then_some(i)).collect();
            let (faces, primitives) = (set.atlas.face_count(), set.primitives.len());
            members.push(Member { model, set, first_face, first_primitive, place: DVec2::ZERO, slots });
            first_face += faces;
            first_primitive += primitives;
        }
        let joint = if members.len() > 1 { Some(join(id, &mut members)) } else { None };
        Group { members, joint, importance: None }
    }

    /// What the stages, the figures and the pictures see: the only set, or the joint one.
    pub fn set(&self) -> &TextureSet {
        self.joint.as_ref().unwrap_or(&self.members[0].set)
    }

    /// Whether several sets were joined.
    pub fn is_joined(&self) -> bool {
        self.joint.is_some()
    }

    /// The members, and the index of their own slot, that a slot of the group is read from.
    pub fn sources(&self, slot: usize) -> impl Iterator<Item = (&Member, usize)> {
        self.members.iter().filter_map(move |m| Some((m, m.slots.iter().position(|s| *s == Some(slot))?)))
    }

    /// Primitives of a member, as the group numbers them.
    pub fn primitives(member: &Member, own: &[u32]) -> Vec<u32> {
        own.iter().map(|p| p + member.first_primitive as u32).collect()
    }

    /// Warnings due to slots whose texels are coarser than those of other members.
    pub fn warnings(&self) -> Vec<(usize, Warning)> {
        let mut out = Vec::new();
        let Some(joint) = &self.joint else { return out };
        for (index, slot) in joint.slots.iter().enumerate() {
            let finest = ratio(slot, joint.reference);
            for (member, own) in self.sources(index) {
                let own = &member.set.slots[own];
                if (finest - ratio(own, member.set.reference)).max_element() > SAME_RATIO {
                    let text = format!(
                        "{} of {} has coarser texels than that of the other sets of its atlas: it is resampled",
                        own.name, member.set.name
                    );
                    out.push((member.model, Warning::new("slot_refined", text).at(format!("/images/{}", own.image))));
                }
            }
        }
        out
    }

    /// The Atlas of each member, with the faces of `atlas` that became its faces.
    pub fn part<'a>(&self, atlas: &'a Atlas) -> Result<Vec<(Cow<'a, Atlas>, Vec<FaceId>)>> {
        if !self.is_joined() {
            return Ok(vec![(Cow::Borrowed(atlas), atlas.faces().collect())]);
        }
        let part = |member: &Member| {
            let end = member.first_primitive + member.set.primitives.len();
            let own =
                |f: &FaceId| (member.first_primitive..end).contains(&(atlas.provenance[f.index()].primitive as usize));
            let faces: Vec<FaceId> = atlas.faces().filter(own).collect();
            let mut part = atlas.subset(&faces);
            for provenance in &mut part.provenance {
                let source = provenance.source.index().checked_sub(member.first_face);
                let source = source.ok_or_else(|| Failure::internal("a face has no valid provenance"))?;
                provenance.source = FaceId::new(source);
                provenance.primitive -= member.first_primitive as u32;
            }
            Ok((Cow::Owned(part), faces))
        };
        self.members.iter().map(part).collect()
    }

    /// The group's Atlas again, from those of its members: each with the faces of `after` that its faces are.
    pub fn rejoin(&self, after: &Atlas, mut parts: Vec<(Atlas, Vec<FaceId>)>) -> Atlas {
        if !self.is_joined() && parts.len() == 1 {
            return parts.remove(0).0;
        }
        let n = after.face_count();
        let mut all = Atlas {
            surface: Surface { positions: Vec::new(), triangles: vec![Default::default(); n] },
            corners: vec![Default::default(); n],
            provenance: after.provenance.clone(),
            page: after.page.clone(),
            sheets: after.sheets.clone(),
            uv: Vec::new(),
        };
        for (own, faces) in parts {
            let (vertex, uv) = (all.surface.positions.len() as u32, all.uv.len() as u32);
            all.surface.positions.extend(own.surface.positions);
            all.uv.extend(own.uv);
            for (i, face) in faces.into_iter().enumerate() {
                all.surface.triangles[face.index()] = own.surface.triangles[i].map(|v| VertexId(v.0 + vertex));
                all.corners[face.index()] = own.corners[i].map(|c| UvId(c.0 + uv));
            }
        }
        all
    }
}

/// Whether a set can share its sheet with others: its charts must lie where sheets lie.
pub(super) fn can_join(set: &TextureSet) -> bool {
    let (low, high) = region(set);
    set.atlas.has_layout() && low.is_finite() && high.is_finite() && (high - low).max_element() <= FARTHEST
}

/// What a set takes up: its sheet, and the charts that leave it.
fn region(set: &TextureSet) -> (DVec2, DVec2) {
    let sheet = DVec2::new(f64::from(set.reference[0]), f64::from(set.reference[1]));
    set.atlas.uv.iter().fold((DVec2::ZERO, sheet), |(low, high), uv| (low.min(*uv), high.max(*uv)))
}

/// Texels of a slot by texel of its sheet.
fn ratio(slot: &Slot, reference: [u32; 2]) -> DVec2 {
    let size = DVec2::new(f64::from(slot.header.width), f64::from(slot.header.height));
    size / DVec2::new(f64::from(reference[0].max(1)), f64::from(reference[1].max(1)))
}

/// Makes the members' sets one; fills in the places and slots of the members.
fn join(id: usize, members: &mut [Member]) -> TextureSet {
    let reference = place_sheets(members);
    let slots = join_slots(members, reference);
    let mut atlas = Atlas { sheets: vec![reference], ..Atlas::default() };
    let mut primitives = Vec::new();
    let mut names: Vec<&str> = Vec::new();
    for member in members.iter() {
        atlas.append(&member.set.atlas, member.place, member.first_face, member.first_primitive);
        primitives.extend(member.set.primitives.iter().cloned().map(|mut p| {
            p.first_face += member.first_face;
            p
        }));
        names.push(&member.set.name);
    }
    names.dedup();
    let joined = names.join(" + ");
    let name = match joined.chars().count() {
        n if n > LONGEST_NAME => joined.chars().take(LONGEST_NAME - 1).chain(['…']).collect(),
        _ => joined,
    };
    let grid = grid(reference, &slots);
    TextureSet { id, name, atlas, reference, primitives, slots, grid }
}

/// Places the members' sheets on shelves, tall ones first, and gives the size of the sheet that holds them all.
fn place_sheets(members: &mut [Member]) -> [u32; 2] {
    let step = f64::from(common_step(members));
    let regions: Vec<(DVec2, DVec2)> = members
        .iter()
        .map(|m| {
            let (low, high) = region(&m.set);
            let low = (low / step).floor() * step;
            (low, ((high - low) / step).ceil() * step)
        })
        .collect();
    let area: f64 = regions.iter().map(|r| r.1.element_product()).sum();
    let widest = regions.iter().map(|r| r.1.x).fold(0.0, f64::max);
    let limit = widest.max((area.sqrt() / step).ceil() * step);
    let mut order: Vec<usize> = (0..members.len()).collect();
    order.sort_by(|a, b| regions[*b].1.y.total_cmp(&regions[*a].1.y).then(a.cmp(b)));
    let (mut corner, mut shelf, mut extent) = (DVec2::ZERO, 0.0, DVec2::ZERO);
    for index in order {
        let (low, size) = regions[index];
        if corner.x + size.x > limit && corner.x > 0.0 {
            corner = DVec2::new(0.0, corner.y + shelf);
            shelf = 0.0;
        }
        members[index].place = corner - low;
        extent = extent.max(corner + size);
        corner.x += size.x;
        shelf = f64::max(shelf, size.y);
    }
    [extent.x, extent.y].map(|side| side.clamp(1.0, f64::from(u32::MAX)) as u32)
}

/// A multiple of [`STEP`] at which the texels of all slots are whole, where it is not too large.
fn common_step(members: &[Member]) -> u32 {
    let mut step = STEP;
    for set in members.iter().map(|m| &m.set) {
        for slot in set.slots.iter().filter(|s| !s.exempt) {
            for (side, size) in [slot.header.width, slot.header.height].into_iter().enumerate() {
                let whole = set.reference[side].checked_rem(size) == Some(0);
                let ratio = if whole { set.reference[side] / size } else { 1 };
                let (mut a, mut b) = (step, ratio);
                while b != 0 {
                    (a, b) = (b, a % b);
                }
                step = Some((step / a).saturating_mul(ratio)).filter(|s| *s <= LARGEST_STEP).unwrap_or(step);
            }
        }
    }
    step
}

/// The slots of the group: those of one name become one, with the finest texels and the widest format of them.
fn join_slots(members: &mut [Member], reference: [u32; 2]) -> Vec<Slot> {
    let mut by_name: BTreeMap<_, Vec<(usize, usize)>> = BTreeMap::new();
    for (m, member) in members.iter().enumerate() {
        for (s, slot) in member.set.slots.iter().enumerate().filter(|(_, s)| !s.exempt) {
            by_name.entry((slot.role, slot.name.len(), slot.name.clone())).or_default().push((m, s));
        }
    }
    let mut slots = Vec::new();
    for ((role, _, name), own) in by_name {
        let all = || own.iter().map(|&(m, s)| (&members[m], &members[m].set.slots[s]));
        let finest = all().map(|(m, s)| ratio(s, m.set.reference)).fold(DVec2::ZERO, DVec2::max);
        let side = |k: usize| (f64::from(reference[k]) * finest[k]).round().clamp(1.0, f64::from(u32::MAX)) as u32;
        let colour = if all().any(|(_, s)| s.header.channels >= 3) { 3 } else { 1 };
        let alpha = u8::from(all().any(|(_, s)| s.header.channels % 2 == 0));
        let mut formats = all().map(|(_, s)| s.header.format);
        let first = formats.next().unwrap_or(Format::Png);
        let header = Header {
            width: side(0),
            height: side(1),
            channels: colour + alpha,
            depth: all().map(|(_, s)| s.header.depth).max().unwrap_or(8),
            // Files of several formats meet in the one that holds all.
            format: if formats.all(|f| f == first) { first } else { Format::Png },
        };
        let slot = Slot {
            image: all().next().map_or(0, |(_, s)| s.image),
            role,
            name,
            header,
            block: all().map(|(_, s)| s.block).max().unwrap_or(1),
            readings: Vec::new(),
            mipmaps: all().any(|(_, s)| s.mipmaps),
            alpha: common_alpha(&all().map(|(_, s)| s.alpha).collect::<Vec<_>>()),
            primitives: all().flat_map(|(m, s)| Group::primitives(m, &s.primitives)).collect(),
            exempt: false,
        };
        for &(m, s) in &own {
            members[m].slots[s] = Some(slots.len());
        }
        slots.push(slot);
    }
    slots
}

/// The treatment of alpha that serves all: only where all are masks their coverage is kept.
fn common_alpha(all: &[Alpha]) -> Alpha {
    match all {
        [first, rest @ ..] if rest.iter().all(|a| a == first) => *first,
        [first @ Alpha::Mask(_), rest @ ..] if rest.iter().all(|a| matches!(a, Alpha::Mask(_))) => *first,
        _ => Alpha::Opaque,
    }
}

#[cfg(test)]
mod tests;
