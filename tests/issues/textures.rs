//! What textures weigh, and in which codec they come back.

use image::{DynamicImage, ImageFormat, RgbImage};
use intarsia::texture::{Coding, JpegCoding, encode};
use serde_json::json;

use super::fidelity::report;

/// Hills of a few colours.
fn hills(side: u32) -> DynamicImage {
    let wave = |v: f64| (127.5 + 90.0 * v.sin()) as u8;
    let image = RgbImage::from_fn(side, side, |x, y| {
        let (x, y) = (f64::from(x), f64::from(y));
        image::Rgb([wave(x / 9.0 + y / 31.0), wave(y / 12.0), wave((x - y) / 17.0)])
    });
    image.into()
}

/// The quantisation tables and the frame header of a JPEG, without its size.
fn coded(file: &[u8]) -> (Vec<u8>, Vec<u8>) {
    let (mut at, mut tables, mut frame) = (2, Vec::new(), Vec::new());
    while file[at + 1] != 0xda {
        let length = usize::from(u16::from_be_bytes([file[at + 2], file[at + 3]]));
        let payload = &file[at + 4..at + 2 + length];
        match file[at + 1] {
            0xdb => tables.extend(payload),
            0xc0 | 0xc2 => frame = [&[file[at + 1]], &payload[5..]].concat(),
            _ => {}
        }
        at += 2 + length;
    }
    (tables, frame)
}

/// A JPEG of quality 60 came back at 92 without subsampling, four times as heavy, and had lost once more.
#[test]
fn a_jpeg_keeps_its_tables_and_loses_next_to_nothing() {
    for quality in [60, 85, 95] {
        let jpeg = encode(&hills(128), &Coding::Jpeg(JpegCoding::of_quality(quality))).unwrap();
        let (textures, files) = report("map_Kd a.jpg\n", &[("a.jpg", jpeg.clone())], json!({"pack": {"grid": 16}}));
        assert!(coded(&files[0].1) == coded(&jpeg), "{quality}: tables, sampling or scans changed");
        let psnr = textures[0]["psnr_db"].as_f64().unwrap();
        assert!(psnr >= 45.0, "{quality}: {psnr} dB");
        // A square of a quarter of the sheet.
        assert!(files[0].1.len() * 10 < jpeg.len() * 7, "{quality}: {} of {} bytes", files[0].1.len(), jpeg.len());
    }
}

/// Flat pictures, and pictures of few colours, grew to many times their size.
#[test]
fn a_png_is_as_light_as_it_can_be() {
    let flags =
        RgbImage::from_fn(128, 128, |x, y| image::Rgb([if (x / 16 + y / 16) % 2 == 0 { 200 } else { 40 }, 90, 10]));
    let mut png = std::io::Cursor::new(Vec::new());
    DynamicImage::ImageRgb8(flags).write_to(&mut png, ImageFormat::Png).unwrap();
    let (textures, files) = report("map_Kd a.png\n", &[("a.png", png.into_inner())], json!({}));
    assert_eq!((&textures[0]["exact"], files[0].1[25]), (&json!(true), 3), "a palette");
    assert!(files[0].1.len() < 400, "{} bytes", files[0].1.len());
}

/// Lossy WebP became PNG.
#[test]
fn a_lossy_webp_stays_one() {
    let webp = encode(&hills(128), &Coding::Webp(Some(70))).unwrap();
    for (options, chunk) in [(json!({}), b"VP8 "), (json!({"texture": {"webp_quality": "lossless"}}), b"VP8L")] {
        let (textures, files) = report("map_Kd a.webp\n", &[("a.webp", webp.clone())], options);
        assert_eq!(&textures[0]["after"]["format"], "webp");
        assert!(files[0].1.windows(4).any(|w| w == chunk), "{}", files[0].0);
        assert!(textures[0]["psnr_db"].as_f64().unwrap() > 36.0, "{:#}", textures[0]);
    }
}
