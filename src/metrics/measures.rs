//! The measures of one atlas, and of a model: what the report shows before and after.

use std::collections::BTreeMap;

use glam::DVec3;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::density::{self, TexelDensity};
use super::distortion::{self, Strain};
use super::{boundary, charts, coverage, gutter};
use crate::atlas::{Atlas, Charts, Clusters, Coverage, Topology};

/// What `measure` must know beside the atlas itself.
#[derive(Debug, Clone, Copy)]
pub struct MeasureInputs<'a> {
    /// The atlas before refinement: for the box of `boundary_length` and for `distortion_from_input`. `None`: the atlas is the input.
    pub input: Option<&'a Atlas>,
    /// Charts that share texels on purpose.
    pub clusters: &'a Clusters,
    /// Every image of the set, on every page; empty for a virtual page.
    pub slots: &'a [SlotSize],
    /// Size on the sheet of the smallest slot, for `gutter_texels`, where the images in `slots` do not each fill the sheet.
    pub smallest_slot: Option<[u32; 2]>,
    /// Fraction of the 3D area whose texels were not copied verbatim, where textures were baked.
    pub resampled_area: Option<f64>,
    /// Mean squared difference of the surface signal, where it was computed.
    pub signal_error: Option<f64>,
}

/// Size of one image of a texture set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotSize {
    /// Page of the atlas that the image belongs to.
    pub page: u16,
    /// Width in texels.
    pub width: u32,
    /// Height in texels.
    pub height: u32,
    /// Bytes of the encoded file.
    pub bytes: u64,
    /// Whether the layout does not matter to it (one colour): left out of `gutter_texels`.
    pub exempt: bool,
}

/// The measures of one atlas, or of a model. Figures that are not defined are null, with the reason in `undefined`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Measures {
    /// Number of triangles.
    pub triangles: u64,
    /// Number of charts.
    pub charts: u64,
    /// Triangles whose UV orientation is not that of their chart (the sign of the chart's area).
    pub flipped_triangles: u64,
    /// Triangles without area in 3D or in UV; left out of the energies.
    pub degenerate_triangles: u64,
    /// Area covered, each point once / area of the bounding box of the charts, over all pages.
    pub packing_efficiency: Option<f64>,
    /// The same, but where charts share texels each of them counts: over 1 is possible.
    pub packing_efficiency_by_charts: Option<f64>,
    /// Fraction of the sheets' texels whose centre a chart covers.
    pub utilisation: Option<f64>,
    /// Area covered more than once by accident (by one chart, or by charts of different clusters) / area covered.
    pub overlap_fraction: Option<f64>,
    /// Area covered by several charts of one cluster / area covered.
    pub stacked_fraction: Option<f64>,
    /// UV border length / longest side of the bounding box of the charts before refinement [box cutter].
    pub boundary_length: Option<f64>,
    /// 3D length of the seams, each once, mesh boundary apart / sqrt(surface area / pi) [OptCuts, E_s].
    pub seam_length: Option<f64>,
    /// 3D length of the seams, each once / diagonal of the surface's bounding box [bounded packing efficiency].
    pub seam_length_diagonal: Option<f64>,
    /// Area-weighted mean of s1^2 + s2^2 + s1^-2 + s2^-2 at the best global scale; 4 is isometric [OptCuts, E_d].
    pub symmetric_dirichlet: Option<f64>,
    /// The same from the input UVs to these; 4 is rigid.
    pub distortion_from_input: Option<f64>,
    /// 2 sqrt(pi * UV area) / UV border length; 1 is a disk [defragmentation].
    pub solidity: Option<f64>,
    /// UV vertices / 3D vertices [defragmentation].
    pub vertex_replication: Option<f64>,
    /// 3D area of the smallest chart / surface area.
    pub smallest_chart: Option<f64>,
    /// Charts with less than 3 % of the surface area.
    pub charts_under_3_percent: u64,
    /// Texels of the largest slot per unit of mesh length, over triangles with an area.
    pub texel_density: TexelDensity,
    /// Free texels between the closest texels of two clusters, in the smallest slot; at most 64 is looked for.
    pub gutter_texels: Option<f64>,
    /// Fraction of the 3D area whose texels were not copied verbatim.
    pub resampled_area: Option<f64>,
    /// Pixels of all slots.
    pub texture_pixels: Option<u64>,
    /// Bytes of all slots' files.
    pub texture_bytes: Option<u64>,
    /// Bytes of all slots as uncompressed RGBA, 8 bits, with mip levels.
    pub gpu_bytes: Option<u64>,
    /// Mean squared difference between the surface signal and its reconstruction.
    pub signal_error: Option<f64>,
    /// Why a figure is null, by its name.
    pub undefined: BTreeMap<String, String>,
    /// The sums that the figures are made of, for [`roll_up`].
    #[serde(skip)]
    pub(crate) totals: Totals,
}

/// Sums over one or several atlases, from which all figures follow.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Totals {
    pub atlases: usize,
    pub triangles: u64,
    pub charts: u64,
    pub flipped: u64,
    pub degenerate: u64,
    pub coverage: Coverage,
    /// Area of the bounding boxes of the pages' charts.
    pub box_area: f64,
    /// Texels of the sheets; centres covered, where they could be counted.
    pub texels: u64,
    pub texels_covered: Option<u64>,
    pub uv_border: f64,
    /// Longest side of the input's bounding box.
    pub input_side: f64,
    pub seam: f64,
    pub surface_area: f64,
    pub bounds: Option<(DVec3, DVec3)>,
    pub uv_area: f64,
    pub uv_vertices: u64,
    pub vertices: u64,
    pub isometry: Strain,
    pub from_input: Strain,
    /// 3D area by chart.
    pub chart_areas: Vec<f64>,
    pub density: TexelDensity,
    pub gutter: Option<u32>,
    /// 3D area resampled, where textures were baked.
    pub resampled: Option<f64>,
    pub slots: usize,
    pub pixels: u64,
    pub bytes: u64,
    pub gpu: u64,
    /// Signal error times surface area.
    pub signal: Option<f64>,
}

/// The measures of an atlas with its topology and charts. Indices must be in range and `inputs.clusters` must belong to the charts.
pub fn measure(atlas: &Atlas, topology: &Topology, own_charts: &Charts, inputs: &MeasureInputs<'_>) -> Measures {
    let mut totals = Totals { atlases: 1, triangles: atlas.face_count() as u64, ..Totals::default() };
    charts::add(&mut totals, atlas, own_charts);
    coverage::add(&mut totals, atlas, own_charts, inputs.clusters);
    boundary::add(&mut totals, atlas, topology, inputs.input.unwrap_or(atlas));
    totals.isometry = distortion::from_surface(atlas);
    totals.from_input = distortion::from_input(atlas, inputs.input.unwrap_or(atlas));
    totals.density = density::of(atlas);
    totals.gutter = gutter::of(atlas, own_charts, inputs.clusters, inputs.slots, inputs.smallest_slot);
    totals.resampled = inputs.resampled_area.map(|f| f * totals.surface_area);
    totals.signal = inputs.signal_error.map(|e| e * totals.surface_area);
    totals.slots = inputs.slots.len();
    for slot in inputs.slots {
        totals.pixels += u64::from(slot.width) * u64::from(slot.height);
        totals.bytes += slot.bytes;
        totals.gpu += gpu_bytes(slot.width, slot.height);
    }
    Measures::from_totals(totals)
}

/// The measures of a surface that has no layout yet: what can be said of it in 3D.
pub fn without_layout(atlas: &Atlas) -> Measures {
    let triangles = atlas.face_count() as u64;
    let degenerate = atlas.faces().filter(|f| charts::has_no_surface(atlas, *f)).count() as u64;
    let totals = Totals { triangles, degenerate, ..Totals::default() };
    let mut m = Measures { triangles, degenerate_triangles: degenerate, totals, ..Measures::default() };
    // The figures' names are those of the report.
    for (name, value) in serde_json::to_value(&m).ok().and_then(|v| v.as_object().cloned()).into_iter().flatten() {
        let parts = value.as_object().into_iter().flatten().filter(|(_, part)| part.is_null());
        let null = parts.map(|(part, _)| format!("{name}.{part}")).chain(value.is_null().then(|| name.clone()));
        m.undefined.extend(null.map(|name| (name, "the surface has no layout".to_owned())));
    }
    m
}

/// The measures of a model: counts and lengths are summed before they are divided, so that every ratio is the one of all
/// atlases together; density is the extremes', the gutter the narrowest.
pub fn roll_up(parts: &[Measures]) -> Measures {
    let mut all = Totals { texels_covered: Some(0), resampled: Some(0.0), signal: Some(0.0), ..Totals::default() };
    for part in parts.iter().map(|p| &p.totals) {
        all.add(part);
    }
    Measures::from_totals(all)
}

impl Totals {
    fn add(&mut self, other: &Totals) {
        self.atlases += other.atlases;
        self.triangles += other.triangles;
        self.charts += other.charts;
        self.flipped += other.flipped;
        self.degenerate += other.degenerate;
        self.coverage.add(other.coverage, 1.0);
        self.box_area += other.box_area;
        self.texels += other.texels;
        self.texels_covered = self.texels_covered.zip(other.texels_covered).map(|(a, b)| a + b);
        self.uv_border += other.uv_border;
        self.input_side += other.input_side;
        self.seam += other.seam;
        self.surface_area += other.surface_area;
        let bounds = self.bounds.into_iter().chain(other.bounds);
        self.bounds = bounds.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
        self.uv_area += other.uv_area;
        self.uv_vertices += other.uv_vertices;
        self.vertices += other.vertices;
        self.isometry.add(&other.isometry);
        self.from_input.add(&other.from_input);
        self.chart_areas.extend(&other.chart_areas);
        self.density = if self.atlases == 1 { other.density } else { self.density.with(other.density) };
        self.gutter = self.gutter.into_iter().chain(other.gutter).min();
        self.resampled = self.resampled.zip(other.resampled).map(|(a, b)| a + b);
        self.slots += other.slots;
        self.pixels += other.pixels;
        self.bytes += other.bytes;
        self.gpu += other.gpu;
        self.signal = self.signal.zip(other.signal).map(|(a, b)| a + b);
    }
}

impl Measures {
    fn from_totals(t: Totals) -> Self {
        let mut undefined = BTreeMap::new();
        let mut reason = |name: &str, why: &str| {
            undefined.insert(name.to_owned(), why.to_owned());
        };
        let mut ratio = |name: &str, a: f64, b: f64, why: &str| {
            let value = a / b;
            if b > 0.0 && value.is_finite() {
                return Some(value);
            }
            reason(name, why);
            None
        };
        let (no_box, no_surface) = ("the charts' bounding box has no area", "the surface has no area");
        let (no_uv_area, no_border) = ("the charts have no area", "the charts have no border");
        let smallest = t.chart_areas.iter().copied().fold(f64::INFINITY, f64::min);
        let diagonal = t.bounds.map_or(0.0, |b| (b.1 - b.0).length());
        let mut m = Measures {
            triangles: t.triangles,
            charts: t.charts,
            flipped_triangles: t.flipped,
            degenerate_triangles: t.degenerate,
            packing_efficiency: ratio("packing_efficiency", t.coverage.covered, t.box_area, no_box),
            packing_efficiency_by_charts: ratio(
                "packing_efficiency_by_charts",
                t.coverage.by_charts,
                t.box_area,
                no_box,
            ),
            utilisation: t
                .texels_covered
                .and_then(|n| ratio("utilisation", n as f64, t.texels as f64, "there is no sheet")),
            overlap_fraction: ratio("overlap_fraction", t.coverage.accidental, t.coverage.covered, no_uv_area),
            stacked_fraction: ratio("stacked_fraction", t.coverage.stacked, t.coverage.covered, no_uv_area),
            boundary_length: ratio("boundary_length", t.uv_border, t.input_side, no_box),
            seam_length: ratio("seam_length", t.seam, (t.surface_area / std::f64::consts::PI).sqrt(), no_surface),
            seam_length_diagonal: ratio("seam_length_diagonal", t.seam, diagonal, "the surface is a point"),
            symmetric_dirichlet: t.isometry.energy(),
            distortion_from_input: t.from_input.energy(),
            solidity: ratio("solidity", 2.0 * (std::f64::consts::PI * t.uv_area).sqrt(), t.uv_border, no_border),
            vertex_replication: ratio("vertex_replication", t.uv_vertices as f64, t.vertices as f64, "no vertices"),
            smallest_chart: ratio("smallest_chart", smallest, t.surface_area, no_surface),
            charts_under_3_percent: t.chart_areas.iter().filter(|a| **a < 0.03 * t.surface_area).count() as u64,
            texel_density: t.density,
            gutter_texels: t.gutter.map(f64::from),
            resampled_area: t.resampled.and_then(|r| ratio("resampled_area", r, t.surface_area, no_surface)),
            texture_pixels: (t.slots > 0).then_some(t.pixels),
            texture_bytes: (t.slots > 0).then_some(t.bytes),
            gpu_bytes: (t.slots > 0).then_some(t.gpu),
            signal_error: t.signal.and_then(|s| ratio("signal_error", s, t.surface_area, no_surface)),
            ..Measures::default()
        };
        let only_degenerate = "every triangle is degenerate";
        let absent = [
            ("utilisation", t.texels_covered.is_none(), "the triangles cover the sheet too often to count its texels"),
            ("symmetric_dirichlet", m.symmetric_dirichlet.is_none(), only_degenerate),
            ("distortion_from_input", m.distortion_from_input.is_none(), only_degenerate),
            ("texel_density.min", m.texel_density.min.is_none(), only_degenerate),
            ("texel_density.max", m.texel_density.max.is_none(), only_degenerate),
            (
                "texel_density.median",
                m.texel_density.median.is_none(),
                if t.atlases > 1 { "the median is defined for one atlas" } else { only_degenerate },
            ),
            ("gutter_texels", m.gutter_texels.is_none(), "there are not two clusters on one page"),
            ("resampled_area", t.resampled.is_none(), "no texture was baked"),
            ("texture_pixels", t.slots == 0, "there are no images"),
            ("texture_bytes", t.slots == 0, "there are no images"),
            ("gpu_bytes", t.slots == 0, "there are no images"),
            ("signal_error", t.signal.is_none(), "it was not asked for"),
        ];
        for (name, missing, why) in absent {
            if missing {
                reason(name, why);
            }
        }
        m.undefined = undefined;
        m.totals = t;
        m
    }
}

/// Bytes of an image as 8-bit RGBA with all mip levels.
pub(crate) fn gpu_bytes(mut width: u32, mut height: u32) -> u64 {
    let mut bytes = 0;
    loop {
        bytes += 4 * u64::from(width) * u64::from(height);
        if width <= 1 && height <= 1 {
            return bytes;
        }
        (width, height) = ((width / 2).max(1), (height / 2).max(1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::OverlapMode;
    use crate::atlas::testing::{join, sheet};
    use crate::atlas::{UvId, VertexId, clusters};
    use glam::DVec2;

    fn measured(atlas: &Atlas, input: Option<&Atlas>, slots: &[SlotSize]) -> Measures {
        let topology = Topology::new(atlas);
        let charts = Charts::new(&topology);
        let clusters = clusters(atlas, &charts, OverlapMode::Stack);
        measure(
            atlas,
            &topology,
            &charts,
            &MeasureInputs {
                input,
                clusters: &clusters,
                slots,
                smallest_slot: None,
                resampled_area: None,
                signal_error: None,
            },
        )
    }

    fn close(a: Option<f64>, b: f64) {
        assert!(a.is_some_and(|a| (a - b).abs() < 1e-9 * b.abs().max(1.0)), "{a:?} is not {b}");
    }

    /// A plate of 4 x 2, cut across the middle; its halves lie 2 apart. The plate is flat, so all is isometric.
    fn plate() -> Atlas {
        let mut atlas = join(&sheet(2, 2, DVec2::ZERO), &sheet(2, 2, DVec2::new(2.0, 0.0)));
        // The right column of the left half is the left column of the right half.
        for triangle in &mut atlas.surface.triangles {
            for v in triangle.iter_mut().filter(|v| v.0 >= 9 && v.0 % 3 == 0) {
                *v = VertexId(v.0 - 9 + 2);
            }
        }
        for uv in &mut atlas.uv[9..] {
            uv.x += 2.0;
        }
        atlas.sheets = vec![[8, 4]];
        atlas
    }

    #[test]
    fn a_plate_by_hand() {
        let slot = SlotSize { page: 0, width: 8, height: 4, bytes: 77, exempt: false };
        let m = measured(&plate(), None, &[slot]);
        assert_eq!((m.triangles, m.charts, m.flipped_triangles, m.degenerate_triangles), (16, 2, 0, 0));
        close(m.packing_efficiency, 8.0 / 12.0);
        close(m.utilisation, 8.0 / 32.0);
        close(m.boundary_length, 16.0 / 6.0);
        close(m.seam_length, 2.0 / (8.0 / std::f64::consts::PI).sqrt());
        close(m.seam_length_diagonal, 2.0 / 20f64.sqrt());
        close(m.symmetric_dirichlet, 4.0);
        close(m.distortion_from_input, 4.0);
        close(m.solidity, 2.0 * (std::f64::consts::PI * 8.0).sqrt() / 16.0);
        close(m.vertex_replication, 18.0 / 15.0);
        close(m.smallest_chart, 0.5);
        close(m.gutter_texels, 2.0);
        close(m.texel_density.median, 1.0);
        assert_eq!((m.texture_pixels, m.texture_bytes), (Some(32), Some(77)));
        assert_eq!(m.gpu_bytes, Some(4 * (32 + 8 + 2 + 1)));
        let null: Vec<_> = m.undefined.keys().map(String::as_str).collect();
        assert_eq!(null, ["resampled_area", "signal_error"]);
    }

    #[test]
    fn distortion_is_free_of_scale_and_knows_the_input() {
        let input = plate();
        let mut after = input.clone();
        for uv in &mut after.uv {
            *uv = DVec2::new(uv.x * 6.0, uv.y * 3.0);
        }
        let m = measured(&after, Some(&input), &[]);
        close(m.distortion_from_input, 5.0); // s = (2, 1) / sqrt 2: 2 + 1/2 + 1/2 + 2
        close(m.symmetric_dirichlet, 5.0);
        close(m.boundary_length, (2.0 * 12.0 + 2.0 * 24.0 / 2.0 + 24.0) / 6.0);
    }

    #[test]
    fn a_surface_without_a_layout_is_counted() {
        let bare = without_layout(&plate());
        let all = roll_up(&[bare.clone(), bare.clone()]);
        assert_eq!((bare.triangles, all.triangles), (16, 32));
        assert_eq!((all.charts, all.packing_efficiency, all.texel_density.median), (0, None, None));
    }

    #[test]
    fn nothing_gives_null_with_a_reason_and_no_panic() {
        let mut broken = plate();
        broken.uv.fill(DVec2::ONE);
        broken.corners[0] = [UvId(0); 3];
        for m in [measured(&Atlas::default(), None, &[]), measured(&broken, None, &[]), roll_up(&[])] {
            let value = serde_json::to_value(&m).unwrap_or_default();
            for path in crate::metrics::paths().iter().filter_map(|p| p.strip_prefix("atlas.")) {
                let found = path.split('.').try_fold(&value, |v, k| v.get(k));
                let null = found.is_some_and(serde_json::Value::is_null);
                assert_eq!(null, m.undefined.contains_key(path), "{path}: {found:?}");
            }
        }
    }

    #[test]
    fn a_model_is_its_atlases_together() {
        let (a, b) = (plate(), join(&plate(), &sheet(3, 3, DVec2::new(0.0, 4.0))));
        let parts = [measured(&a, None, &[]), measured(&b, None, &[])];
        let m = roll_up(&parts);
        assert_eq!((m.triangles, m.charts), (50, 5));
        close(m.packing_efficiency, (8.0 + 17.0) / (12.0 + 42.0));
        close(m.gutter_texels, 2.0);
        assert!(m.texel_density.median.is_none() && m.undefined.contains_key("texel_density.median"));
        assert_eq!(roll_up(&parts[..1]).packing_efficiency, parts[0].packing_efficiency);
    }
}
