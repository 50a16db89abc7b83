//! A picture of a layout: charts in colours of their own, seams dark, what overlaps hatched in red.

use glam::DVec2;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use rayon::prelude::*;

use super::boundary::page_boxes;
use super::canvas::Canvas;
use crate::atlas::{Atlas, Charts, FaceId, HalfEdge, Topology};
use crate::texture::linear_to_srgb;

/// Samples per pixel and axis.
const SAMPLES: usize = 2;
/// Of the sheet's size: how far the view follows charts that leave the sheet.
const REACH: f64 = 8.0;
const BORDER_INK: u8 = 190;
const FRAME: [f32; 3] = [96.0, 100.0, 108.0];
const OUTSIDE: [f32; 3] = [222.0, 224.0, 228.0];
const RED: [f32; 3] = [214.0, 32.0, 39.0];

/// A PNG (8-bit RGB) of one page, its longer side `max_side` pixels (16..=8192). The view is the sheet, and as much around
/// it as charts need that leave it; a frame shows the sheet then.
pub fn picture(atlas: &Atlas, page: usize, max_side: u32) -> Vec<u8> {
    let sheet = atlas.sheets.get(page).copied().unwrap_or([1, 1]);
    let sheet = DVec2::new(f64::from(sheet[0].max(1)), f64::from(sheet[1].max(1)));
    let (mut low, mut high) = (DVec2::ZERO, sheet);
    if let Some(own) = page_boxes(atlas).get(page).filter(|b| b.min.is_finite() && b.max.is_finite()) {
        low = low.min(own.min.max(-sheet * REACH));
        high = high.max(own.max.min(sheet * (REACH + 1.0)));
    }
    if low != DVec2::ZERO || high != sheet {
        let margin = 0.02 * (high - low).max_element();
        low -= margin;
        high += margin;
    }
    let side = f64::from(max_side.clamp(16, 8192));
    let scale = side / (high - low).max_element();
    let size = ((high - low) * scale).round().max(DVec2::ONE);
    let (width, height) = (size.x as usize, size.y as usize);

    let topology = Topology::new(atlas);
    let charts = Charts::new(&topology);
    let mut canvas = Canvas::new(width * SAMPLES, height * SAMPLES);
    let samples = scale * SAMPLES as f64;
    let at = |p: DVec2| (p - low) * samples;
    let faces: Vec<FaceId> = atlas
        .faces()
        .filter(|f| usize::from(atlas.page[f.index()]) == page)
        .filter(|&f| atlas.uv_triangle(f).iter().all(|c| c.is_finite()))
        .collect();
    for &f in &faces {
        canvas.triangle(atlas.uv_triangle(f).map(at), charts.of_face[f.index()].0);
    }
    // Inner edges fade away where they would cover everything.
    let area: f64 = faces.iter().map(|&f| atlas.uv_area(f).abs()).sum::<f64>() * samples * samples;
    let spacing = (area / faces.len().max(1) as f64).sqrt();
    let faint = ((spacing - 4.0) * 4.0).clamp(0.0, 60.0) as u8;
    for border in [false, true] {
        for &f in &faces {
            let t = atlas.uv_triangle(f).map(at);
            for k in 0..3 {
                let h = HalfEdge::of(f, k);
                match topology.uv_twin(h) {
                    None if border => canvas.line(t[k], t[(k + 1) % 3], SAMPLES, BORDER_INK),
                    Some(twin) if !border && faint > 0 && twin > h => canvas.line(t[k], t[(k + 1) % 3], 1, faint),
                    _ => {}
                }
            }
        }
    }
    let colours: Vec<[f32; 3]> = (0..charts.len()).map(colour).collect();
    let (first, last) = (at(DVec2::ZERO), at(sheet));
    let mut pixels = vec![0u8; width * height * 3];
    pixels.par_chunks_exact_mut(width * 3).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            // Most pixels lie within one triangle.
            if let Some(own) = canvas.plain(x, y, SAMPLES).and_then(|label| colours.get(label as usize)) {
                pixel.copy_from_slice(&own.map(|c| c as u8));
                continue;
            }
            let mut sum = [0.0f32; 3];
            for sy in y * SAMPLES..(y + 1) * SAMPLES {
                for sx in x * SAMPLES..(x + 1) * SAMPLES {
                    let sample = shade(&canvas, sx, sy, &colours, first, last);
                    sum = [0, 1, 2].map(|c| sum[c] + sample[c]);
                }
            }
            for (channel, value) in pixel.iter_mut().zip(sum) {
                *channel = (value / (SAMPLES * SAMPLES) as f32).round().clamp(0.0, 255.0) as u8;
            }
        }
    });
    encode(width as u32, height as u32, &pixels)
}

/// The colour of one sample.
fn shade(canvas: &Canvas, x: usize, y: usize, colours: &[[f32; 3]], first: DVec2, last: DVec2) -> [f32; 3] {
    let (label, layers, ink) = canvas.sample(x, y);
    let p = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
    let from_edge = (p - first).min(last - p).min_element();
    let base = if let Some(own) = colours.get(label as usize) {
        let stripe = ((x + y) / (2 * SAMPLES)).is_multiple_of(4);
        match (layers > 1, stripe) {
            (false, _) => *own,
            (true, true) => RED,
            (true, false) => mix(*own, [255.0; 3], 0.45),
        }
    } else if from_edge.abs() < SAMPLES as f64 * 0.5 {
        FRAME
    } else if from_edge < 0.0 {
        OUTSIDE
    } else if (x / (16 * SAMPLES) + y / (16 * SAMPLES)).is_multiple_of(2) {
        [250.0, 250.0, 251.0]
    } else {
        [241.0, 242.0, 244.0]
    };
    mix(base, [24.0, 28.0, 38.0], f32::from(ink) / 255.0)
}

fn mix(a: [f32; 3], b: [f32; 3], t: f32) -> [f32; 3] {
    [0, 1, 2].map(|c| a[c] + (b[c] - a[c]) * t)
}

/// A chart's colour, sRGB in 0..=255: hues a golden ratio apart, so that neighbours in number are far apart in hue; three
/// lightnesses in turn, in OKLCh (Ottosson 2020) so that all look equally strong.
fn colour(chart: usize) -> [f32; 3] {
    let hue = (chart as f64 * 0.618_033_988_749_894_9 + 0.07).fract() * std::f64::consts::TAU;
    let (lightness, chroma) = [(0.79, 0.115), (0.70, 0.125), (0.86, 0.085)][chart % 3];
    let (a, b) = (chroma * hue.cos(), chroma * hue.sin());
    let l = (lightness + 0.396_337_777_4 * a + 0.215_803_757_3 * b).powi(3);
    let m = (lightness - 0.105_561_345_8 * a - 0.063_854_172_8 * b).powi(3);
    let s = (lightness - 0.089_484_177_5 * a - 1.291_485_548 * b).powi(3);
    let linear = [
        4.076_741_662_1 * l - 3.307_711_591_3 * m + 0.230_969_929_2 * s,
        -1.268_438_004_6 * l + 2.609_757_401_1 * m - 0.341_319_396_5 * s,
        -0.004_196_086_3 * l - 0.703_418_614_7 * m + 1.707_614_701 * s,
    ];
    linear.map(|v: f64| (linear_to_srgb(v.clamp(0.0, 1.0)) * 255.0).round() as f32)
}

fn encode(width: u32, height: u32, pixels: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Default, FilterType::NoFilter);
    // Writing to memory cannot fail: the size is in range and the pixels are as many as it says.
    let written = encoder.write_image(pixels, width, height, ExtendedColorType::Rgb8);
    debug_assert!(written.is_ok());
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::{join, sheet};

    fn decode(bytes: &[u8]) -> Option<(usize, usize, Vec<u8>)> {
        let image = crate::texture::decode(bytes, 1 << 26).ok()?;
        Some((image.width() as usize, image.height() as usize, image.into_rgb8().into_raw()))
    }

    fn red(pixels: &[u8]) -> usize {
        pixels.chunks_exact(3).filter(|p| p[0] > 190 && p[1] < 80 && p[2] < 80).count()
    }

    #[test]
    fn only_what_overlaps_is_red() -> Result<(), &'static str> {
        let mut apart = join(&sheet(7, 5, DVec2::splat(3.0)), &sheet(7, 5, DVec2::new(10.0, 3.0)));
        apart.sheets = vec![[20, 10]];
        let (w, h, pixels) = decode(&picture(&apart, 0, 400)).ok_or("not a PNG")?;
        assert_eq!((w, h, red(&pixels)), (400, 200, 0), "touching charts and shared edges are not overlaps");
        let at = |x: usize, y: usize| &pixels[3 * (y * w + x)..][..3];
        assert_ne!(at(70, 77), at(250, 77), "two charts, two colours");
        for uv in &mut apart.uv[48..] {
            uv.x -= 2.0;
        }
        let (_, _, pixels) = decode(&picture(&apart, 0, 400)).ok_or("not a PNG")?;
        let share = red(&pixels) as f64 / (2.0 * 5.0 * 20.0 * 20.0);
        assert!((0.05..0.3).contains(&share), "a quarter of the overlap is red, less its lines and edges: {share}");
        Ok(())
    }

    #[test]
    fn charts_outside_the_sheet_and_broken_ones_are_no_trouble() -> Result<(), &'static str> {
        let mut far = sheet(2, 2, DVec2::new(-30.0, 5.0));
        far.sheets = vec![[10, 10]];
        assert_eq!(decode(&picture(&far, 0, 100)).ok_or("not a PNG")?.0, 100);
        far.uv[0] = DVec2::splat(1e300);
        far.uv[1] = DVec2::NAN;
        assert!(decode(&picture(&far, 0, 100)).is_some());
        assert!(decode(&picture(&Atlas::default(), 3, 0)).is_some());
        Ok(())
    }
}
