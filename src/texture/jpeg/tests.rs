//! Files as an independent decoder sees them.

use image::DynamicImage;

use super::*;
use crate::texture::decode;
use crate::texture::decode::jpeg_coding;
use crate::texture::encode::tests::picture;

fn psnr(a: &DynamicImage, b: &DynamicImage) -> f64 {
    assert_eq!((a.width(), a.height(), a.color()), (b.width(), b.height(), b.color()));
    let squares = a.as_bytes().iter().zip(b.as_bytes()).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum::<f64>();
    10.0 * (255.0 * 255.0 * a.as_bytes().len() as f64 / squares.max(1e-9)).log10()
}

fn encoded(image: &DynamicImage, coding: &JpegCoding) -> Vec<u8> {
    coding.encode(image.as_bytes(), [image.width(), image.height()], image.color().channel_count()).unwrap()
}

#[test]
fn files_of_every_shape_are_read_by_others() {
    for (width, height) in [(1, 1), (7, 9), (64, 48), (257, 130), (16, 300)] {
        for channels in [1, 3] {
            let image = picture(width, height, channels, false);
            for sampling in [[1, 1], [2, 1], [1, 2], [2, 2], [4, 1]] {
                let coding = JpegCoding { sampling, ..JpegCoding::of_quality(95) };
                let file = encoded(&image, &coding);
                let shown = decode(&file, 1 << 20).unwrap();
                // Chroma of the pictures changes slowly, but for their grain.
                let least = if channels == 1 || sampling == [1, 1] { 38.0 } else { 22.0 };
                assert!(
                    psnr(&image, &shown) > least,
                    "{width} x {height} x {channels}, {sampling:?}: {}",
                    psnr(&image, &shown)
                );
                let read = jpeg_coding(&file).unwrap();
                assert_eq!(read.tables[0], coding.tables[0]);
                assert!(channels == 1 || (read.sampling, read.tables[1]) == (sampling, coding.tables[1]));
            }
        }
    }
}

/// The second generation is the first: all coefficients come again.
#[test]
fn what_was_decoded_comes_back() {
    for quality in [50, 75, 95] {
        for sampling in [[1, 1], [2, 1], [2, 2]] {
            let image = picture(300, 203, 3, false);
            let first = encoded(&image, &JpegCoding { sampling, ..JpegCoding::of_quality(quality) });
            let shown = decode(&first, 1 << 20).unwrap();
            let again = decode(&encoded(&shown, &jpeg_coding(&first).unwrap()), 1 << 20).unwrap();
            assert!(psnr(&shown, &again) > 45.0, "{quality} {sampling:?}: {}", psnr(&shown, &again));
        }
    }
}

#[test]
fn strips_give_what_the_whole_does_and_flat_pictures_are_small() {
    let image = picture(1030, 700, 3, false);
    for (sampling, decoded) in [([1, 1], false), ([2, 2], true), ([2, 2], false)] {
        let coding = JpegCoding { sampling, decoded, ..JpegCoding::of_quality(80) };
        let frame = Frame::new(&coding, [1030, 700], 3).unwrap();
        let strips: Vec<Scanned> = (0..700usize)
            .step_by(48)
            .map(|top| {
                let rows = top..(top + 48).min(700);
                let first = rows.start.saturating_sub(frame.reach());
                let last = (rows.end + frame.reach()).min(700);
                frame.strip(&image.as_bytes()[first * 3090..last * 3090], first, rows).unwrap()
            })
            .collect();
        assert!(frame.file(&strips) == encoded(&image, &coding));
        assert!(frame.strip(image.as_bytes(), 0, 8..16).is_err() == (sampling[1] == 2), "strips begin with a block");
        assert!(frame.strip(&image.as_bytes()[..3090], 0, 0..16).is_err());
    }
    let grey = DynamicImage::new_rgb8(4096, 4096);
    let file = encoded(&grey, &JpegCoding::of_quality(75));
    assert!(file.len() < 4096 * 4096 / 256 * 12 / 8 + 400, "{}", file.len());
}

/// Another crate writes these: what it writes must be read as it was meant.
#[test]
fn progressive_files_stay_so_and_show_the_picture() {
    for sampling in [[1, 1], [2, 1], [2, 2]] {
        let image = picture(300, 203, 3, false);
        let first = encoded(&image, &JpegCoding { sampling, ..JpegCoding::of_quality(85) });
        let shown = decode(&first, 1 << 20).unwrap();
        let file = encoded(&shown, &JpegCoding { sampling, progressive: true, ..JpegCoding::of_quality(85) });
        assert!(jpeg_coding(&file).unwrap().progressive);
        let again = decode(&file, 1 << 20).unwrap();
        assert!(psnr(&shown, &again) > 30.0, "{sampling:?}: {}", psnr(&shown, &again));
    }
}

#[test]
fn several_files_meet_in_the_finer() {
    let (a, b) = (JpegCoding::of_quality(60), JpegCoding { progressive: true, ..JpegCoding::of_quality(92) });
    let both = a.clone().finer(b.clone());
    assert_eq!((both.tables, both.sampling, both.progressive), (b.tables, [1, 1], false));
    assert_eq!(a.block(), [16, 16]);
}
