use super::*;
use crate::texture::encode::tests::picture;
use crate::texture::{Coding, decode, encode, from_samples, header, is_lossy};

const PLAIN: MipFilter = MipFilter { srgb: true, normal: false, premultiplied: false };

fn psnr(a: &DynamicImage, b: &DynamicImage) -> f64 {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    assert_eq!(a.len(), b.len());
    let squares: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum();
    10.0 * (255.0f64.powi(2) * a.len() as f64 / squares.max(1e-9)).log10()
}

fn smooth([w, h]: [u32; 2], channels: u8) -> DynamicImage {
    let value = |i: u32| {
        let (c, p) = (i % u32::from(channels), i / u32::from(channels));
        let (x, y) = (f64::from(p % w), f64::from(p / w));
        (127.0 + 100.0 * ((x / 31.0 + f64::from(c) * 0.4).sin() * (y / 23.0).cos())) as u8
    };
    from_samples([w, h], channels, (0..w * h * u32::from(channels)).map(value).collect()).unwrap()
}

fn coding(kind: BasisKind, mips: bool) -> BasisCoding {
    BasisCoding::of(&[], Some(kind), PLAIN, mips)
}

const KINDS: [BasisKind; 2] = [BasisKind::Etc1s, BasisKind::Uastc];

#[test]
fn files_are_read_as_what_was_written() {
    for (kind, (channels, size)) in KINDS.into_iter().flat_map(|kind| {
        [(3, [64, 48]), (4, [128, 128]), (1, [4, 4]), (2, [12, 20]), (3, [8, 256])].map(|case| (kind, case))
    }) {
        for mips in [false, true] {
            let image = smooth(size, channels);
            let file = encode(&image, &Coding::Basis(coding(kind, mips))).unwrap();
            let head = header(&file).unwrap();
            assert_eq!([head.width, head.height], size);
            assert_eq!(head.channels, if channels % 2 == 0 { 4 } else { 3 });
            assert!(is_lossy(&file));
            let read = decode(&file, 1 << 20).unwrap();
            let wide = if head.channels == 4 { DynamicImage::from(image.to_rgba8()) } else { image.to_rgb8().into() };
            let db = psnr(&read, &wide);
            let least = if kind == BasisKind::Etc1s { 33.0 } else { 44.0 };
            assert!(db > least, "{kind:?} {channels} {size:?} {mips}: {db}");
            let levels = u32::from_le_bytes(file[40..44].try_into().unwrap());
            assert_eq!(levels, if mips { size[0].max(size[1]).ilog2() + 1 } else { 1 });
            let transcoder = basisu::Transcoder::new(&file).unwrap();
            for level in 0..levels {
                transcoder.transcode(level, basisu::TargetFormat::Bc7Rgba, basisu::DecodeFlags::NONE).unwrap();
            }
        }
    }
    for kind in KINDS {
        assert!(coding(kind, true).encode(&smooth([6, 8], 3), &Context::silent()).is_err());
        assert!(coding(kind, true).encode(&picture(8, 8, 3, true), &Context::silent()).is_err());
    }
}

/// Blocks that were moved by whole blocks are what they were, and cost about as much.
#[test]
fn what_only_moved_by_blocks_loses_nothing() {
    for (kind, channels) in KINDS.into_iter().flat_map(|kind| [(kind, 3), (kind, 4)]) {
        let first = encode(&picture(256, 128, channels, false), &Coding::Basis(coding(kind, true))).unwrap();
        let shown = decode(&first, 1 << 20).unwrap();
        let mut moved = shown.clone();
        image::imageops::replace(&mut moved, &shown.crop_imm(0, 0, 128, 128), 128, 0);
        let other = shown.crop_imm(128, 0, 128, 128);
        // Blocks of ETC1S can be turned.
        let other = if kind == BasisKind::Etc1s { other.rotate90() } else { other };
        image::imageops::replace(&mut moved, &other, 0, 0);
        let upload = crate::texture::basis_upload(&first).unwrap();
        let coding = BasisCoding::of(&[&upload], None, PLAIN, false);
        let second = encode(&moved, &Coding::Basis(coding)).unwrap();
        assert!(decode(&second, 1 << 20).unwrap() == moved, "{kind:?} {channels}");
        assert!(second.len() * 10 < first.len() * 12, "{} {}", first.len(), second.len());
    }
}

#[test]
fn threads_do_not_matter() {
    let image = picture(96, 96, 4, false);
    for coding in KINDS.map(|kind| Coding::Basis(coding(kind, true))) {
        let with = |threads: usize| {
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap()
                .install(|| encode(&image, &coding).unwrap())
        };
        assert!(with(1) == with(3));
    }
}

#[test]
fn it_can_be_given_up() {
    let cancel = Arc::new(std::sync::atomic::AtomicBool::new(true));
    let context = Context::new(Arc::new(crate::context::Silent), cancel, 0);
    for kind in KINDS {
        let failure = coding(kind, true).encode(&smooth([64, 64], 3), &context).unwrap_err();
        assert_eq!(failure.code, crate::error::Code::Canceled);
    }
}
