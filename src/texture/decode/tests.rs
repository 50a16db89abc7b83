//! Every kind of file, whole, cut short and damaged.

use super::fixture::*;
use super::*;
use crate::texture::encode::tests::picture;
use crate::texture::pixels::{Depth, from_samples};
use crate::texture::{Coding, JpegCoding, encode, widened};

#[test]
fn palettes_low_depths_and_transparency_are_expanded() {
    let mut file = b"\x89PNG\r\n\x1a\n".to_vec();
    chunk(&mut file, b"IHDR", &[0, 0, 0, 3, 0, 0, 0, 1, 2, 3, 0, 0, 0]);
    chunk(&mut file, b"PLTE", &[1, 2, 3, 40, 50, 60, 7, 8, 9]);
    chunk(&mut file, b"tRNS", &[255, 128]);
    chunk(&mut file, b"IDAT", &stored_zlib(&[0, 0b00_01_10_00]));
    chunk(&mut file, b"IEND", &[]);
    let expected = Header { width: 3, height: 1, channels: 4, depth: 8, format: Format::Png };
    assert_eq!(header(&file).unwrap(), expected);
    let image = decode(&file, 3).unwrap();
    assert_eq!(bytes(&image), [1, 2, 3, 255, 40, 50, 60, 128, 7, 8, 9, 255]);
}

#[test]
fn a_bomb_is_refused_by_its_header() {
    let mut file = encode(&picture(64, 64, 3, false), &Coding::Png).unwrap();
    assert_eq!(decode(&file, 64 * 64 - 1).unwrap_err().code, Code::TooLarge);
    // 60000 x 60000 texels declared by the same few bytes.
    file[16..24].copy_from_slice(&[0, 0, 0xea, 0x60, 0, 0, 0xea, 0x60]);
    let crc = crc32(&file[12..29]);
    file[29..33].copy_from_slice(&crc.to_be_bytes());
    assert_eq!(header(&file).unwrap().width, 60_000);
    assert_eq!(decode(&file, 1 << 28).unwrap_err().code, Code::TooLarge);
    file[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
    let crc = crc32(&file[12..29]);
    file[29..33].copy_from_slice(&crc.to_be_bytes());
    assert_eq!(header(&file).unwrap_err().code, Code::InvalidImage);
}

/// A file of every kind.
fn files() -> Vec<(&'static str, Vec<u8>)> {
    let rgb = picture(40, 24, 3, false);
    let (level, _) = uastc_level();
    let ends = [([3, 9, 27], 4); 8];
    let blocks: Vec<(u32, u32)> = (0..12).map(|i| (i % 8, i % 4)).collect();
    let rgba8 = |scheme, level: &[u8]| {
        let inflated = 64;
        ktx2(&Ktx2 { vulkan: 37, size: [4, 4], scheme, model: 1, channels: &[0], inflated, global: &[], level })
    };
    vec![
        ("png", encode(&rgb, &Coding::Png).unwrap()),
        ("jpeg", encode(&rgb, &Coding::Jpeg(JpegCoding::of_quality(90))).unwrap()),
        (
            "progressive",
            jpeg(bytes(&picture(24, 16, 3, false)), jpeg_encoder::ColorType::Rgb, |e| e.set_progressive(true)),
        ),
        ("webp", encode(&picture(40, 24, 4, false), &Coding::Webp(None)).unwrap()),
        ("lossy webp", grey_webp([12, 9], Some(&[100; 108]))),
        ("uastc", uastc(0, 3, &level)),
        ("uastc, zstd", uastc(2, 0, &level)),
        ("etc1s", etc1s([14, 10], &ends, &[[1; 16]; 4], &[&blocks, &blocks])),
        ("rgba8", rgba8(0, &[9; 64])),
        ("rgba8, zstd", rgba8(2, &zstd(&[9; 64]))),
    ]
}

#[test]
fn every_truncation_and_many_mutations_end_in_a_sentence() {
    for (kind, file) in files() {
        assert!(decode(&file, 1 << 20).is_ok(), "{kind}");
        // Only what stands behind the picture may be missing.
        let needed = if kind == "png" { file.len() - 16 } else { file.len() - 1 };
        for length in 0..needed {
            let failure = decode(&file[..length], 1 << 20).unwrap_err();
            assert_eq!(failure.code, Code::InvalidImage, "{kind} cut to {length}");
        }
        for at in 0..file.len() {
            for bit in [1, 0x10, 0x80] {
                let mut broken = file.clone();
                broken[at] ^= bit;
                match decode(&broken, 1 << 14) {
                    Ok(image) => assert!(image.width() * image.height() <= 1 << 14, "{kind}"),
                    Err(failure) => assert!(matches!(failure.code, Code::InvalidImage | Code::TooLarge), "{kind}"),
                }
            }
        }
    }
    assert_eq!(header(b"").unwrap_err().code, Code::InvalidImage);
    assert_eq!(header(b"GIF89a").unwrap_err().code, Code::InvalidImage);
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, b| {
        (0..8).fold(crc ^ u32::from(*b), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xedb8_8320 } else { c >> 1 })
    })
}

/// The samples of an image of 8 bits.
fn bytes(image: &DynamicImage) -> &[u8] {
    u8::of(image).unwrap()
}

#[test]
fn png_of_every_kind_is_read() {
    // Grey and alpha of 16 bits, interlaced by hand: of Adam7 only the passes 1, 2, 4 and 6 are there at 8 x 1.
    let value = |x: u16, c: u16| x * 1000 + c * 7;
    let columns = [[0].as_slice(), &[4], &[2, 6], &[1, 3, 5, 7]].concat();
    let scan: Vec<u8> = [1, 1, 2, 4]
        .iter()
        .scan(0, |at, n| {
            let pass = &columns[*at..*at + n];
            *at += n;
            Some(
                [
                    &[0][..],
                    &pass
                        .iter()
                        .flat_map(|x| [value(*x, 0), value(*x, 1)])
                        .flat_map(u16::to_be_bytes)
                        .collect::<Vec<_>>(),
                ]
                .concat(),
            )
        })
        .flatten()
        .collect();
    let mut file = b"\x89PNG\r\n\x1a\n".to_vec();
    chunk(&mut file, b"IHDR", &[0, 0, 0, 8, 0, 0, 0, 1, 16, 4, 0, 0, 1]);
    chunk(&mut file, b"IDAT", &stored_zlib(&scan));
    chunk(&mut file, b"IEND", &[]);
    assert_eq!(header(&file).unwrap(), Header { width: 8, height: 1, channels: 2, depth: 16, format: Format::Png });
    let expected: Vec<u16> = (0..8).flat_map(|x| [value(x, 0), value(x, 1)]).collect();
    assert_eq!(u16::of(&decode(&file, 8).unwrap()).unwrap(), expected);

    // Grey of one bit, and grey of 16 bits of which one value is transparent.
    for (depth, data, transparent, expected) in [
        (1, vec![0b1010_0000], None, from_samples([3, 1], 1, vec![255u8, 0, 255])),
        (16, vec![0, 5, 1, 0, 0, 9], Some(vec![1, 0]), from_samples([3, 1], 2, vec![5u16, 65_535, 256, 0, 9, 65_535])),
    ] {
        let mut file = b"\x89PNG\r\n\x1a\n".to_vec();
        chunk(&mut file, b"IHDR", &[0, 0, 0, 3, 0, 0, 0, 1, depth, 0, 0, 0, 0]);
        transparent.iter().for_each(|t| chunk(&mut file, b"tRNS", t));
        chunk(&mut file, b"IDAT", &stored_zlib(&[&[0][..], &data].concat()));
        chunk(&mut file, b"IEND", &[]);
        assert_eq!(decode(&file, 3).unwrap(), expected.unwrap());
    }
}

fn chunk(file: &mut Vec<u8>, name: &[u8; 4], data: &[u8]) {
    file.extend((data.len() as u32).to_be_bytes());
    let body = [&name[..], data].concat();
    file.extend(&body);
    file.extend(crc32(&body).to_be_bytes());
}

/// A zlib stream of one stored block.
fn stored_zlib(data: &[u8]) -> Vec<u8> {
    let (a, b) =
        data.iter().fold((1u32, 0u32), |(a, b), v| ((a + u32::from(*v)) % 65_521, (a + b + u32::from(*v)) % 65_521));
    let length = data.len() as u16;
    [&[0x78, 0x01, 1], &length.to_le_bytes()[..], &(!length).to_le_bytes(), data, &(b << 16 | a).to_be_bytes()].concat()
}

/// A JPEG of 24 x 16 texels.
fn jpeg(
    data: &[u8],
    colour: jpeg_encoder::ColorType,
    set: impl Fn(&mut jpeg_encoder::Encoder<&mut Vec<u8>>),
) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut file, 100);
    encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::F_1_1);
    set(&mut encoder);
    encoder.encode(data, 24, 16, colour).unwrap();
    file
}

fn close(a: &[u8], b: &[u8], most: u8) {
    assert_eq!(a.len(), b.len());
    let worst = a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(worst <= Some(most), "{worst:?}");
}

#[test]
fn jpeg_of_every_kind_is_read() {
    use jpeg_encoder::ColorType;
    let rgb = picture(24, 16, 3, false);
    let decoded = |file: &[u8]| {
        let image = decode(file, 384).unwrap();
        let head = header(file).unwrap();
        assert_eq!((head.width, head.height, head.channels), (24, 16, image.color().channel_count()));
        image
    };
    let baseline = jpeg(bytes(&rgb), ColorType::Rgb, |_| {});
    close(bytes(&decoded(&baseline)), bytes(&rgb), 4);
    let progressive = jpeg(bytes(&rgb), ColorType::Rgb, |e| e.set_progressive(true));
    assert!(progressive.windows(2).any(|w| w == [0xff, 0xc2]));
    close(bytes(&decoded(&progressive)), bytes(&rgb), 4);
    let restarts = jpeg(bytes(&rgb), ColorType::Rgb, |e| e.set_restart_interval(2));
    assert_eq!(decoded(&restarts), decoded(&baseline));
    // Orientation 6, a quarter turn, is not heeded.
    let exif = b"MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";
    let turned = jpeg(bytes(&rgb), ColorType::Rgb, |e| e.add_exif_metadata(exif).unwrap());
    assert_eq!(decoded(&turned), decoded(&baseline));
    // Adobe's marker with transform 0: the three components are R, G and B as they stand.
    let adobe =
        jpeg(bytes(&rgb), ColorType::Ycbcr, |e| e.add_app_segment(14, b"Adobe\0\x64\0\0\0\0\0".to_vec()).unwrap());
    close(bytes(&decoded(&adobe)), bytes(&rgb), 3);
    let grey = picture(24, 16, 1, false);
    for progressive in [false, true] {
        let file = jpeg(bytes(&grey), ColorType::Luma, |e| e.set_progressive(progressive));
        close(bytes(&decoded(&file)), bytes(&grey), 3);
    }
    // Inks on white paper: what is left of the light.
    let inks = picture(24, 16, 4, false);
    let left = |ink: u8, black: u8| ((255 - u32::from(ink)) * (255 - u32::from(black)) / 255) as u8;
    let light: Vec<u8> = bytes(&inks).chunks_exact(4).flat_map(|p| [0, 1, 2].map(|c| left(p[c], p[3]))).collect();
    for colour in [ColorType::Cmyk, ColorType::CmykAsYcck] {
        for progressive in [false, true] {
            let file = jpeg(bytes(&inks), colour, |e| e.set_progressive(progressive));
            assert!(file.windows(5).any(|w| w == b"Adobe"));
            close(bytes(&decoded(&file)), &light, 6);
        }
    }
}

#[test]
fn a_jpeg_of_too_many_scans_is_refused() {
    let file = jpeg(bytes(&picture(24, 16, 3, false)), jpeg_encoder::ColorType::Rgb, |e| e.set_progressive(true));
    let last = file.windows(2).rposition(|w| w == [0xff, 0xda]).unwrap();
    let scan = &file[last..file.len() - 2];
    let many = [&file[..last], &scan.repeat(501), &file[file.len() - 2..]].concat();
    assert!(decode(&many, 384).unwrap_err().message.contains("scans"));
}

#[test]
fn webp_round_trips_without_loss() {
    for (channels, expected) in [(1, 3), (2, 4), (3, 3), (4, 4)] {
        let mut image = picture(37, 21, channels, false);
        if channels == 4 {
            // Colour under full transparency stays.
            let DynamicImage::ImageRgba8(texels) = &mut image else { panic!("RGBA expected") };
            texels.pixels_mut().step_by(3).for_each(|texel| texel[3] = 0);
        }
        let file = encode(&image, &Coding::Webp(None)).unwrap();
        let head = Header { width: 37, height: 21, channels: expected, depth: 8, format: Format::Webp };
        assert_eq!(header(&file).unwrap(), head);
        assert!(!is_lossy(&file));
        assert_eq!(decode(&file, 37 * 21).unwrap(), widened(image, expected, 8));
    }
    assert!(encode(&picture(8, 8, 3, true), &Coding::Webp(None)).is_err());
    assert!(encode(&DynamicImage::new_luma8(16_384, 1), &Coding::Webp(None)).is_err());
}

#[test]
fn lossy_webp_is_read_with_its_alpha() {
    let plain = grey_webp([12, 9], None);
    assert!(is_lossy(&plain));
    let image = decode(&plain, 108).unwrap();
    assert_eq!((image.width(), image.height(), image.color()), (12, 9, image::ColorType::Rgb8));
    assert!(bytes(&image).windows(2).all(|w| w[0].abs_diff(w[1]) < 8), "{:?}", bytes(&image));
    let alpha: Vec<u8> = (0..108).collect();
    let file = grey_webp([12, 9], Some(&alpha));
    assert!(is_lossy(&file));
    let head = Header { width: 12, height: 9, channels: 4, depth: 8, format: Format::Webp };
    assert_eq!(header(&file).unwrap(), head);
    let with = decode(&file, 108).unwrap();
    assert!(bytes(&with).iter().skip(3).step_by(4).eq(&alpha));
    let colours =
        |image: &DynamicImage, n: usize| bytes(image).chunks_exact(n).flat_map(|t| t[..3].to_vec()).collect::<Vec<_>>();
    assert_eq!(colours(&with, 4), colours(&image, 3));
}

#[test]
fn a_webp_file_that_contradicts_itself_is_refused() {
    let frame = |size| grey_webp(size, None)[20..].to_vec();
    let canvas = |flags: u8| vec![flags, 0, 0, 0, 11, 0, 0, 8, 0, 0];
    let failure = |chunks: &[(&[u8; 4], Vec<u8>)]| decode(&riff(chunks), 1 << 20).unwrap_err().message;
    // A frame larger than its canvas would take memory that the limit does not see.
    assert!(failure(&[(b"VP8X", canvas(0)), (b"VP8 ", frame([16, 16]))]).contains("canvas"));
    assert!(failure(&[(b"VP8X", canvas(2)), (b"VP8 ", frame([12, 9]))]).contains("animation"));
    assert!(failure(&[(b"VP8X", canvas(0))]).contains("no picture"));
    let mut long = riff(&[(b"VP8 ", frame([12, 9]))]);
    long[4] += 2;
    assert!(decode(&long, 1 << 20).unwrap_err().message.contains("ends before"));
}

/// The level of a UASTC file of 8 x 8 texels, and what it holds.
fn uastc_level() -> (Vec<u8>, Vec<u8>) {
    let colours: [[u8; 4]; 4] = [[10, 200, 30, 255], [255, 0, 128, 7], [1, 2, 3, 4], [90, 91, 92, 200]];
    let level = colours.iter().flat_map(|c| solid_block(*c)).collect();
    let texels = (0..64).flat_map(|i| colours[i / 32 * 2 + i % 8 / 4]).collect();
    (level, texels)
}

fn uastc(scheme: u32, channel: u32, level: &[u8]) -> Vec<u8> {
    let (stored, inflated) = if scheme == 2 { (zstd(level), level.len() as u64) } else { (level.to_vec(), 0) };
    ktx2(&Ktx2 {
        vulkan: 0,
        size: [8, 8],
        scheme,
        model: 166,
        channels: &[channel],
        inflated,
        global: &[],
        level: &stored,
    })
}

#[test]
fn uastc_is_read_plain_and_compressed() {
    let (level, texels) = uastc_level();
    for scheme in [0, 2] {
        let file = uastc(scheme, 3, &level);
        assert_eq!(header(&file).unwrap(), Header { width: 8, height: 8, channels: 4, depth: 8, format: Format::Ktx2 });
        assert!(is_lossy(&file));
        assert_eq!(bytes(&decode(&file, 64).unwrap()), texels);
        let opaque = decode(&uastc(scheme, 0, &level), 64).unwrap();
        assert_eq!(opaque.color(), image::ColorType::Rgb8);
        assert_eq!(bytes(&opaque), texels.chunks_exact(4).flat_map(|t| t[..3].to_vec()).collect::<Vec<_>>());
    }
    // A level that is too short, or says so of itself.
    assert_eq!(header(&uastc(0, 3, &level[..48])).unwrap_err().code, Code::InvalidImage);
    let file = ktx2(&Ktx2 {
        vulkan: 0,
        size: [8, 8],
        scheme: 2,
        model: 166,
        channels: &[3],
        inflated: 1 << 40,
        global: &[],
        level: &zstd(&level),
    });
    assert_eq!(decode(&file, 64).unwrap_err().code, Code::InvalidImage);
}

#[test]
fn etc1s_is_read_with_its_alpha() {
    // Two modifiers by table (ETC1, "Intensity modifier sets"), in the order of selectors: -b, -a, a, b.
    const MODIFIERS: [[i32; 2]; 8] = [[2, 8], [5, 17], [9, 29], [13, 42], [18, 60], [24, 80], [33, 106], [47, 183]];
    let ends: [EndPoint; 8] = std::array::from_fn(|i| {
        let i = i as u32;
        ([(i * 5 + 3) & 31, (31 - i * 3) & 31, (i * 11 + 16) & 31], 7 - i)
    });
    let selectors: [[u8; 16]; 4] =
        std::array::from_fn(|i| std::array::from_fn(|k| ((k * (i + 1) + i + k / 4) % 4) as u8));
    let (w, h) = (14, 10);
    let colour: Vec<(u32, u32)> = (0..12).map(|i| (i * 3 % 8, i % 4)).collect();
    let alpha: Vec<(u32, u32)> = (0..12).map(|i| (i * 5 % 8, (i + 1) % 4)).collect();
    let texel = |blocks: &[(u32, u32)], x: usize, y: usize| {
        let (end, selector) = blocks[y / 4 * 4 + x / 4];
        let (base, table) = ends[end as usize];
        let s = selectors[selector as usize][y % 4 * 4 + x % 4];
        let [a, b] = MODIFIERS[table as usize];
        let step = [-b, -a, a, b][usize::from(s)];
        base.map(|c| ((c << 3 | c >> 2) as i32 + step).clamp(0, 255) as u8)
    };
    for slices in [&[&colour[..]][..], &[&colour[..], &alpha[..]]] {
        let file = etc1s([w, h], &ends, &selectors, slices);
        let channels = 2 + slices.len() as u8;
        let head = Header { width: w, height: h, channels, depth: 8, format: Format::Ktx2 };
        assert_eq!(header(&file).unwrap(), head);
        let mut expected = Vec::new();
        for (x, y) in (0..h as usize).flat_map(|y| (0..w as usize).map(move |x| (x, y))) {
            expected.extend(texel(&colour, x, y));
            // Alpha is the green of its slice.
            expected.extend(slices.get(1).map(|blocks| texel(blocks, x, y)[1]));
        }
        assert_eq!(bytes(&decode(&file, 140).unwrap()), expected);
    }
}

#[test]
fn uncompressed_ktx2_is_read_in_the_order_of_its_channels() {
    let file = |vulkan, level: &[u8], scheme| {
        let stored = if scheme == 2 { zstd(level) } else { level.to_vec() };
        let inflated = level.len() as u64;
        ktx2(&Ktx2 { vulkan, size: [2, 1], scheme, model: 1, channels: &[0], inflated, global: &[], level: &stored })
    };
    for scheme in [0, 2] {
        let read = |vulkan, level: &[u8]| decode(&file(vulkan, level, scheme), 2).unwrap();
        assert_eq!(bytes(&read(9, &[7, 8])), [7, 0, 0, 8, 0, 0]);
        assert_eq!(bytes(&read(22, &[1, 2, 3, 4])), [1, 2, 0, 3, 4, 0]);
        assert_eq!(bytes(&read(29, &[1, 2, 3, 4, 5, 6])), [1, 2, 3, 4, 5, 6]);
        assert_eq!(bytes(&read(44, &[1, 2, 3, 4, 5, 6, 7, 8])), [3, 2, 1, 4, 7, 6, 5, 8]);
        assert_eq!(u16::of(&read(70, &[1, 2, 3, 4])).unwrap(), [513, 0, 0, 1027, 0, 0]);
    }
    assert!(!is_lossy(&file(43, &[0; 8], 0)));
    assert!(header(&file(131, &[0; 8], 0)).unwrap_err().message.contains("format 131"));
}

#[test]
fn a_ktx2_file_that_is_no_plain_texture_is_refused() {
    let (level, _) = uastc_level();
    let file = uastc(0, 3, &level);
    // Depth, layers, faces, levels; offsets and lengths of descriptor, global data and level, all beyond the file.
    let words = [
        (28, 1),
        (32, 2),
        (36, 6),
        (40, 17),
        (48, u32::MAX),
        (52, u32::MAX),
        (68, 1),
        (76, 9),
        (84, 1),
        (92, u32::MAX),
    ];
    for (at, value) in words {
        let mut broken = file.clone();
        broken[at..at + 4].copy_from_slice(&u32::to_le_bytes(value));
        assert_eq!(decode(&broken, 64).unwrap_err().code, Code::InvalidImage, "{value} at {at}");
    }
    let mut large = file;
    large[20..28].copy_from_slice(&[0xff, 0xff, 0, 0, 0xff, 0xff, 0, 0]);
    assert_eq!(header(&large).unwrap_err().code, Code::InvalidImage);
}

#[test]
fn a_probe_tells_from_the_head_what_the_header_does() {
    let mut files = vec![jpeg(bytes(&picture(24, 16, 3, false)), jpeg_encoder::ColorType::Rgb, |e| {
        e.add_app_segment(5, vec![0xff; 60_000]).unwrap();
        e.set_progressive(true);
    })];
    files.push(jpeg(bytes(&picture(24, 16, 1, false)), jpeg_encoder::ColorType::Luma, |_| {}));
    for channels in 1..=4 {
        files.push(encode(&picture(37, 21, channels, false), &Coding::Png).unwrap());
        files.push(encode(&picture(37, 21, channels, true), &Coding::Png).unwrap());
        files.push(encode(&picture(37, 21, channels, false), &Coding::Webp(None)).unwrap());
    }
    files.push(grey_webp([12, 9], None));
    files.push(grey_webp([12, 9], Some(&[7; 108])));
    for file in files {
        let (whole, head) = (header(&file).unwrap(), probe(&file[..]).unwrap());
        assert_eq!(
            (head.width, head.height, head.depth, head.format),
            (whole.width, whole.height, whole.depth, whole.format)
        );
        assert!(head.channels >= whole.channels);
        assert!(whole.format == Format::Webp || head.channels == whole.channels);
        // The picture itself is not needed.
        let end = if whole.format == Format::Jpeg { file.len() - 40 } else { 33 };
        assert_eq!(probe(&file[..end]).map(|h| [h.width, h.height]), Some([whole.width, whole.height]));
        for end in 0..33.min(file.len()) {
            let _ = probe(&file[..end]);
        }
    }
    assert_eq!(probe(&b"GIF89a"[..]), None);
}
