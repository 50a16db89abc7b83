//! From the texels of the new sheets back to the uploaded image, face by face, through provenance alone.

use glam::{DAffine2, DMat2, DVec2};

use super::direction::{Turn, nearest_orthogonal};
use super::{Bake, Source, page_size};
use crate::atlas::{Atlas, Charts, FaceId};
use crate::error::{Failure, Result};

/// How far a corner may lie from where whole texels and quarter turns put it, in texels of the slot.
const EXACT: f64 = 1e-3;
/// Faces lower than this, in texels, do not define a map of their own: rounding of their corners would.
const SLIVER: f64 = 0.01;
/// Texel coordinates beyond this are no place on a sheet.
const FARTHEST: f64 = 1e9;
/// Exact maps of a chart that are tried on a face before its own is computed.
const TRIED: usize = 16;

/// Where texels come from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum TexelMap {
    /// Whole texels: the uploaded point is `turn * point + shift`.
    Exact {
        /// Quarter turn and mirror.
        turn: Turn,
        /// In texels.
        shift: [i64; 2],
    },
    /// Resampled.
    Affine {
        /// From texels of the sheet to texels of the uploaded image.
        to_source: DAffine2,
        /// How directions turn, in texels of the reference sheet, whose axes have equal units.
        rotation: DMat2,
    },
}

impl TexelMap {
    /// The point of the uploaded image, in its texels.
    pub(crate) fn apply(&self, point: DVec2) -> DVec2 {
        match *self {
            TexelMap::Exact { turn, shift } => turn.matrix() * point + DVec2::new(shift[0] as f64, shift[1] as f64),
            TexelMap::Affine { to_source, .. } => to_source.transform_point2(point),
        }
    }

    /// Orthogonal part from new to uploaded texels: what directions turn by.
    pub(crate) fn rotation(&self) -> DMat2 {
        match *self {
            TexelMap::Exact { turn, .. } => turn.matrix(),
            TexelMap::Affine { rotation, .. } => rotation,
        }
    }
}

/// The maps of all faces of a slot.
pub(crate) struct TexelMaps {
    /// Distinct maps.
    pub(crate) all: Vec<TexelMap>,
    /// By map: the source that it leads to.
    pub(crate) source: Vec<u32>,
    /// By source: whether it only fills.
    neutral: Vec<bool>,
    /// Index into `all` by face, or [`TexelMaps::NONE`] for a face that does not read the slot (or has no place on a sheet).
    pub(crate) of_face: Vec<u32>,
    /// Corners of each face on its page, in texels of the slot.
    pub(crate) corners: Vec<[DVec2; 3]>,
}

impl TexelMaps {
    /// No map.
    pub(crate) const NONE: u32 = u32::MAX;

    /// TexelMaps every face of `job.after` that reads the slot. Fails with `internal` when the Atlases do not belong together.
    pub(crate) fn new(job: &Bake<'_>, charts: &Charts) -> Result<Self> {
        let after = job.after;
        let count = after.face_count();
        let mut builder = Builder {
            maps: TexelMaps {
                all: Vec::new(),
                source: Vec::new(),
                neutral: job.sources.iter().map(|s| s.neutral).collect(),
                of_face: vec![TexelMaps::NONE; count],
                corners: vec![[DVec2::ZERO; 3]; count],
            },
            source: vec![[DVec2::ZERO; 3]; count],
            source_of: vec![0; count],
            to_reference: job.sources.iter().map(|s| source_scale(s).recip()).collect(),
            sheet_scale: (0..after.sheets.len()).map(|p| sheet_scale(job, p)).collect(),
            after,
        };
        builder.place(job)?;
        for faces in &charts.faces {
            builder.map_chart(faces);
        }
        Ok(builder.maps)
    }

    /// The map of a face that reads the slot.
    pub(crate) fn get(&self, face: usize) -> Option<&TexelMap> {
        self.all.get(*self.of_face.get(face)? as usize)
    }

    /// The map of a face that reads the slot, and the source that it leads to.
    pub(crate) fn with_source(&self, face: usize) -> Option<(&TexelMap, usize)> {
        let map = *self.of_face.get(face)? as usize;
        Some((self.all.get(map)?, *self.source.get(map)? as usize))
    }

    /// Whether a face reads the slot, and not only has its place filled.
    pub(crate) fn counts(&self, face: usize) -> bool {
        self.with_source(face).is_some_and(|(_, source)| !self.neutral[source])
    }
}

/// Texels of an uploaded image by texels of the reference sheet.
pub(crate) fn source_scale(source: &Source<'_>) -> DVec2 {
    let size = DVec2::new(f64::from(source.image.width()), f64::from(source.image.height()));
    size / DVec2::new(f64::from(source.sheet[0].max(1)), f64::from(source.sheet[1].max(1)))
}

/// Texels of the slot's page by texels of its sheet, as a renderer will see it.
fn sheet_scale(job: &Bake<'_>, page: usize) -> DVec2 {
    let [w, h] = page_size(job, page);
    let sheet = job.after.sheets[page];
    DVec2::new(f64::from(w), f64::from(h)) / DVec2::new(f64::from(sheet[0].max(1)), f64::from(sheet[1].max(1)))
}

struct Builder<'a> {
    maps: TexelMaps,
    /// Corners on the uploaded image.
    source: Vec<[DVec2; 3]>,
    /// Index of that image, by face.
    source_of: Vec<u32>,
    /// By source.
    to_reference: Vec<DVec2>,
    sheet_scale: Vec<DVec2>,
    after: &'a Atlas,
}

impl Builder<'_> {
    /// Corners on both sides, for faces that read the slot.
    fn place(&mut self, job: &Bake<'_>) -> Result<()> {
        let reads = source_by_primitive(&job.sources);
        let scale: Vec<DVec2> = job.sources.iter().map(source_scale).collect();
        let foreign = || Failure::internal("the refined atlas does not come from the uploaded one");
        for face in self.after.faces() {
            let f = face.index();
            let (Some(origin), Some(&page)) = (self.after.provenance.get(f), self.after.page.get(f)) else {
                return Err(foreign());
            };
            let Some(source) = reads.get(origin.primitive as usize).copied().flatten() else { continue };
            if origin.source.index() >= job.before.face_count() {
                return Err(foreign());
            }
            let sheet = self.sheet_scale.get(usize::from(page)).copied().ok_or_else(foreign)?;
            let (place, scale) = (job.sources[source as usize].place, scale[source as usize]);
            let [a, b, c] = job.before.uv_triangle(origin.source).map(|uv| (uv - place) * scale);
            self.source_of[f] = source;
            self.source[f] = origin.barycentric.map(|w| a * w.x + b * w.y + c * w.z);
            self.maps.corners[f] = self.after.uv_triangle(face).map(|uv| uv * sheet);
            let near = |p: &DVec2| p.abs().max_element() < FARTHEST;
            if self.source[f].iter().chain(&self.maps.corners[f]).all(near) {
                // Marks the face; its map follows with its chart.
                self.maps.of_face[f] = 0;
            }
        }
        Ok(())
    }

    /// Large faces first, so that a sliver is tried on a map that a better face defines.
    fn map_chart(&mut self, faces: &[FaceId]) {
        let area = |f: usize| {
            let [a, b, c] = self.maps.corners[f];
            (b - a).perp_dot(c - a).abs()
        };
        let mut order: Vec<(f64, usize)> = faces
            .iter()
            .map(|f| f.index())
            .filter(|f| self.maps.of_face[*f] != TexelMaps::NONE)
            .map(|f| (area(f), f))
            .collect();
        order.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let first = self.maps.all.len();
        let mut exact: Vec<u32> = Vec::new();
        for (_, f) in order {
            let source = self.source_of[f];
            let known = exact.iter().rev().take(TRIED).copied().find(|m| match self.maps.all[*m as usize] {
                TexelMap::Exact { turn, shift } => self.maps.source[*m as usize] == source && self.fits(f, turn, shift),
                TexelMap::Affine { .. } => false,
            });
            let map = known.unwrap_or_else(|| {
                let index = self.maps.all.len() as u32;
                self.maps.source.push(source);
                if let Some(map) = self.exact(f) {
                    exact.push(index);
                    self.maps.all.push(map);
                } else {
                    let sibling = self.maps.all.get(first).map(TexelMap::rotation);
                    let map = self.affine(f, sibling);
                    self.maps.all.push(map);
                }
                index
            });
            self.maps.of_face[f] = map;
        }
    }

    fn fits(&self, f: usize, turn: Turn, shift: [i64; 2]) -> bool {
        let map = TexelMap::Exact { turn, shift };
        let pairs = self.maps.corners[f].iter().zip(&self.source[f]);
        pairs.into_iter().all(|(q, p)| (map.apply(*q) - *p).abs().max_element() <= EXACT)
    }

    fn exact(&self, f: usize) -> Option<TexelMap> {
        let (q, p) = (self.maps.corners[f][0], self.source[f][0]);
        Turn::ALL.into_iter().find_map(|turn| {
            let shift = (p - turn.matrix() * q).round();
            let shift = [shift.x as i64, shift.y as i64];
            self.fits(f, turn, shift).then_some(TexelMap::Exact { turn, shift })
        })
    }

    fn affine(&self, f: usize, sibling: Option<DMat2>) -> TexelMap {
        let (q, p) = (self.maps.corners[f], self.source[f]);
        let edges = DMat2::from_cols(q[1] - q[0], q[2] - q[0]);
        let longest = (0..3)
            .map(|k| (k, (q[(k + 1) % 3] - q[k]).length()))
            .fold((0, 0.0), |best, edge| if edge.1 > best.1 { edge } else { best });
        let linear = if edges.determinant().abs() > SLIVER * longest.1 {
            DMat2::from_cols(p[1] - p[0], p[2] - p[0]) * edges.inverse()
        } else {
            // The similarity that keeps the longest edge, mirrored as its chart is.
            let mirrored = sibling.is_some_and(|r| r.determinant() < 0.0);
            let new = q[(longest.0 + 1) % 3] - q[longest.0];
            let old = p[(longest.0 + 1) % 3] - p[longest.0];
            if longest.1 > SLIVER { similarity(new, old, mirrored) } else { sibling.unwrap_or(DMat2::IDENTITY) }
        };
        // Reference texels to reference texels: axes of equal units, in which angles mean what they say.
        let page = usize::from(self.after.page[f]);
        let in_reference = DMat2::from_diagonal(self.to_reference[self.source_of[f] as usize])
            * linear
            * DMat2::from_diagonal(self.sheet_scale[page]);
        let rotation = nearest_orthogonal(in_reference);
        let to_source = DAffine2::from_mat2_translation(linear, p[longest.0] - linear * q[longest.0]);
        TexelMap::Affine { to_source, rotation }
    }
}

/// The source that each primitive reads the slot from.
fn source_by_primitive(sources: &[Source<'_>]) -> Vec<Option<u32>> {
    let primitives = sources.iter().flat_map(|s| s.primitives);
    let mut table = vec![None; primitives.max().map_or(0, |m| *m as usize + 1)];
    for (i, source) in sources.iter().enumerate() {
        for p in source.primitives {
            table[*p as usize] = Some(i as u32);
        }
    }
    table
}

/// The similarity, mirrored or not, that takes `from` to `to`.
fn similarity(from: DVec2, to: DVec2, mirrored: bool) -> DMat2 {
    let from = if mirrored { DVec2::new(from.x, -from.y) } else { from };
    let z = from.length_squared();
    let (c, s) = (from.dot(to) / z, from.perp_dot(to) / z);
    let turn = DMat2::from_cols(DVec2::new(c, s), DVec2::new(-s, c));
    if mirrored { turn * DMat2::from_diagonal(DVec2::new(1.0, -1.0)) } else { turn }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_similarity_takes_its_edge_to_the_other() {
        let (from, to) = (DVec2::new(3.0, 1.0), DVec2::new(-2.0, 5.0));
        for mirrored in [false, true] {
            let m = similarity(from, to, mirrored);
            assert!((m * from - to).length() < 1e-12);
            assert_eq!(m.determinant() < 0.0, mirrored);
        }
    }
}
