//! Against streams that meshoptimizer 1.3 wrote and read back, and against what a stream must not do.

use super::{Codec, Decoded, Filter, Mode, StreamLayout, decode, encode, exponential, octahedral, one_of_octahedral};

type Known = (Mode, Filter, usize, usize, &'static str, &'static str);

/// Mode, filter, count, stride, stream, what its own decoder makes of it.
#[rustfmt::skip]
const KNOWN: [Known; 15] = [
    (Mode::Attributes, Filter::None, 2, 4, "a0012000000001300000007801300000008401300000009500000000000000000000000000000000000000000000000000000000176e4aa0", "176e4aa018aa8c55"),
    (Mode::Attributes, Filter::None, 15, 4, "a17f0015fd4d540313c0ebec1122d72c17009282ded33112835ca379af84c2040098009a64643430302e2e201614140006007a01000000000000000000000000000000000000000000000001", "00000000f5b64c3d7675cc3d4f06193ef96f4b3e77577d3e6d4e973e4d90af3ed761c73ecdb3de3e4477f53ed5ce053f698c103f7fed1a3f73eb243f"),
    (Mode::Attributes, Filter::None, 15, 8, "a17f9f0015fd4d540313c0ebec1122d72c17009282ded33112835ca379af84c2040098009a64643430302e2e201614140006007a01006191876ee93084da02ca0174fc6600b52ef71fac893cfa4772d3199ca9020ecaa88664200030000000000000000000000000000000000000a46ad73f0100", "00000000a46ad73ff5b64c3d730fde3f7675cc3d2a26e43f4f06193ee6aae93ff96f4b3e1d9aee3f77577d3ea8f0f23f6d4e973ec0abf63f4d90af3e02c9f93fd761c73e6f46fc3fcdb3de3e7022fe3f4477f53ed55bff3fd5ce053fd4f1ff3f698c103f0ee4ff3f7fed1a3f8c32ff3f73eb243fbfddfd3f"),
    (Mode::Attributes, Filter::Octahedral, 2, 4, "a00130000000030130000000030000000000000000000000000000000000000000000000000000000000000101017f", "0000817f0000817f"),
    (Mode::Attributes, Filter::Octahedral, 3, 8, "a1bbba00120000130a0003040000000000000000000000000000fcff0500070001800101", "eac1215deac10180163eeac1dfa2ff7fd7760000892f0180"),
    (Mode::Attributes, Filter::Quaternion, 2, 8, "a1bbab0008000900130000000000000000000000000000fcff0400040007000101", "48ccb833b8336d5b000012f36cb2fc64"),
    (Mode::Attributes, Filter::Exponential, 2, 12, "a1eabbeb00010081000100b7000100000000000000000000000012000000125c000012000100", "00000000000000000000b84b00000000000002cb00000000"),
    (Mode::Attributes, Filter::Color, 2, 4, "a1ff003d0005005c0037000000000000000000000000000000000000006ffccaa300", "a139a94751485f0f"),
    (Mode::Attributes, Filter::Color, 2, 8, "a001300000003d000130000000050001300000005c00013000000037000000000000000000000000000000000000000000000000006f00fcffcaffa300", "a1a13939a9a94747515148485f5f0f0f"),
    (Mode::Indices, Filter::None, 6, 4, "d120060416483e00000000", "080000000600000007000000010000001300000003000000"),
    (Mode::Triangles, Filter::None, 15, 2, "e1fe1e100e100f2a007687566778a9866589689801690000", "000001001500150001001600160001000200160002001700170002000300"),
    (Mode::Triangles, Filter::None, 15, 4, "e1f000fcfffe620a1f02007687566778a9866589689801690000", "000000000100000002000000000000000200000003000000040000000500000003000000050000000000000004000000060000000500000006000000"),
    (Mode::Indices, Filter::None, 15, 4, "d144041e2220280e02144a040030062a00000000", "11000000120000000a0000000100000009000000130000000f0000000e000000130000000000000001000000010000000d0000000b00000000000000"),
    (Mode::Attributes, Filter::None, 17, 4, "a0070015fd4dabfc133feb13eeddd72c17dcc00000007507009381ddd22f11845da477ae83c203d7c00000004a070098ff9a64643430302e2e2016141414c00000001201320002007a0000000000000000000000000000000000000000000000000000000000000000", "00000000f5b64c3d7675cc3d4f06193ef96f4b3e77577d3e6d4e973e4d90af3ed761c73ecdb3de3e4477f53ed5ce053f698c103f7fed1a3f73eb243fe17f2e3fa6a4373f"),
    (Mode::Attributes, Filter::None, 17, 4, "a13f0015fd4dabfc133feb13eeddd72c17dc75009381ddd22f11845da477ae83c203d74a0098ff9a64643430302e2e201614141412010a087a0202000000000000000000000000000000000000000000000000", "00000000f5b64c3d7675cc3d4f06193ef96f4b3e77577d3e6d4e973e4d90af3ed761c73ecdb3de3e4477f53ed5ce053f698c103f7fed1a3f73eb243fe17f2e3fa6a4373f"),
];

fn bytes(hex: &str) -> Vec<u8> {
    hex::decode(hex).unwrap()
}

fn layout(mode: Mode, count: usize, stride: usize) -> StreamLayout {
    StreamLayout { mode, filter: Filter::None, count, stride }
}

#[test]
fn known_streams_are_read() {
    for (mode, filter, count, stride, stream, expected) in KNOWN {
        let layout = StreamLayout { mode, filter, count, stride };
        assert!(layout.check().is_ok());
        let (found, expected) = (decode(&bytes(stream), &layout).unwrap(), bytes(expected));
        // What filters round may differ by one unit; floats and unfiltered elements may not.
        let near = |a: &[u8], b: &[u8]| match (filter, stride) {
            (Filter::None | Filter::Exponential, _) => a == b,
            (_, 4) => a.iter().zip(b).all(|(a, b)| (*a as i8).wrapping_sub(*b as i8).abs() <= 1),
            _ => a
                .as_chunks()
                .0
                .iter()
                .zip(b.as_chunks().0)
                .all(|(a, b)| i16::from_le_bytes(*a).wrapping_sub(i16::from_le_bytes(*b)).unsigned_abs() <= 1),
        };
        assert_eq!(found.len(), expected.len());
        assert!(near(&found, &expected), "{layout:?}: {} is not {}", hex::encode(&found), hex::encode(&expected));
    }
}

#[test]
fn the_example_of_the_specification_is_read() {
    // One block of 16 elements of 4 bytes: the first bytes in 4 bits each, the others all zero.
    let mut stream = bytes("a002175ff0bc77a9210034b5000000");
    stream.resize(stream.len() + 32, 0);
    let data = decode(&stream, &layout(Mode::Attributes, 16, 4)).unwrap();
    let values: Vec<u8> = data.chunks(4).map(|element| element[0]).collect();
    let deltas = [-1i8, -4, -3, 26, -91, 0, -6, 6, -4, -4, 5, -5, 1, -1, 0, 0];
    let mut sum = 0u8;
    let expected: Vec<u8> = deltas
        .iter()
        .map(|d| {
            sum = sum.wrapping_add(*d as u8);
            sum
        })
        .collect();
    assert_eq!(values, expected);
    assert!(data.chunks(4).all(|element| element[1..] == [0; 3]));
}

/// Elements as version 1 writes them when nothing can be saved: all bytes literal.
fn literal(data: &[u8], stride: usize) -> Vec<u8> {
    let mut stream = vec![0xA1];
    let mut last = vec![0u8; stride];
    for block in data.chunks((8192 / stride / 16 * 16).min(256) * stride) {
        stream.extend(std::iter::repeat_n(0xFF, stride / 4));
        for k in 0..stride {
            for element in block.chunks(stride) {
                let delta = element[k].wrapping_sub(last[k]) as i8;
                stream.push(((delta << 1) ^ (delta >> 7)) as u8);
                last[k] = element[k];
            }
        }
    }
    let tail = stride + stride / 4;
    stream.resize(stream.len() + tail.max(24), 0);
    stream
}

#[test]
fn blocks_follow_each_other() {
    for stride in [4, 12, 64, 256] {
        for count in [0, 1, 31, 32, 33, 255, 256, 257, 600] {
            let data: Vec<u8> = (0..count * stride).map(|i| (i * i / 7 + i) as u8).collect();
            let found = decode(&literal(&data, stride), &layout(Mode::Attributes, count, stride));
            assert!(found.as_ref() == Ok(&data), "{count} elements of {stride} bytes");
        }
    }
}

fn refused(stream: &[u8], layout: &StreamLayout) -> &'static str {
    let found: Decoded<Vec<u8>> = decode(stream, layout);
    found.expect_err("a broken stream is refused")
}

#[test]
fn every_truncation_and_every_excess_is_refused() {
    for (mode, filter, count, stride, stream, _) in KNOWN {
        let stream = bytes(stream);
        let layout = StreamLayout { mode, filter, count, stride };
        for end in 0..stream.len() {
            refused(&stream[..end], &layout);
        }
        let mut longer = stream.clone();
        longer.insert(1, 0);
        refused(&longer, &layout);
    }
}

#[test]
fn what_is_wrong_is_told() {
    let triangle = layout(Mode::Triangles, 3, 4);
    let mut stream = bytes("e1f0");
    stream.resize(18, 0);
    assert_eq!(decode(&stream, &triangle).unwrap(), [0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    stream[1] = 0x00;
    assert!(refused(&stream, &triangle).contains("did not come before"));
    stream[1] = 0xF1;
    stream[3] = 0x10;
    assert!(refused(&stream, &triangle).contains("did not come before"));
    stream[17] = 1;
    assert!(refused(&stream, &triangle).contains("table"));
    stream[0] = 0xE0;
    assert!(refused(&stream, &triangle).contains("0xe1"));
    assert!(refused(&bytes("d1ffffffffff0100000000"), &layout(Mode::Indices, 1, 4)).contains("five bytes"));
    let mut stream = literal(&[7; 16], 4);
    let last = stream.len() - 1;
    for mode in [0x03, 0x10, 0x11] {
        stream[last] = mode;
        assert!(refused(&stream, &layout(Mode::Attributes, 4, 4)).contains("channel mode"));
    }
}

#[test]
fn counts_are_not_believed() {
    for (mode, stride) in [(Mode::Attributes, 256), (Mode::Triangles, 4), (Mode::Indices, 2)] {
        let layout = layout(mode, 3 << 40, stride);
        assert!(layout.check().is_ok() && layout.bytes().is_some());
        assert!(refused(&[0xA1; 100], &layout).contains("too short"));
    }
    assert_eq!(layout(Mode::Attributes, usize::MAX, 8).bytes(), None);
}

#[test]
fn layouts_go_together() {
    let with = |mode, filter, count, stride| StreamLayout { mode, filter, count, stride }.check().is_ok();
    assert!(with(Mode::Attributes, Filter::None, 1, 256) && !with(Mode::Attributes, Filter::None, 1, 260));
    assert!(!with(Mode::Attributes, Filter::None, 1, 6) && !with(Mode::Attributes, Filter::None, 1, 0));
    assert!(with(Mode::Attributes, Filter::Octahedral, 1, 8) && !with(Mode::Attributes, Filter::Octahedral, 1, 12));
    assert!(!with(Mode::Attributes, Filter::Quaternion, 1, 4) && !with(Mode::Attributes, Filter::Color, 1, 16));
    assert!(with(Mode::Triangles, Filter::None, 3, 2) && !with(Mode::Triangles, Filter::None, 4, 2));
    assert!(!with(Mode::Indices, Filter::Exponential, 1, 4) && !with(Mode::Indices, Filter::None, 1, 1));
}

/// A number that looks random and is the same on every machine (xorshift).
fn next(state: &mut u64) -> u64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    *state
}

#[test]
fn attributes_are_written_as_they_are_read() {
    let mut state = 0x9E37_79B9_7F4A_7C15;
    for stride in [4, 8, 12, 20, 64, 256] {
        for count in [0, 1, 15, 16, 17, 255, 256, 257, 700] {
            // Smooth, noisy in low bits, and noise.
            for noise in [0u64, 3, 200, 256] {
                let data: Vec<u8> = (0..count * stride)
                    .map(|i| ((i / stride) as u64 / 3 + next(&mut state) % (noise + 1)) as u8)
                    .collect();
                let layout = layout(Mode::Attributes, count, stride);
                for codec in [Codec::Version0, Codec::Version1] {
                    let stream = encode(&data, &layout, codec).unwrap();
                    assert_eq!(stream[0], if codec == Codec::Version0 { 0xA0 } else { 0xA1 });
                    assert!(
                        decode(&stream, &layout).as_ref() == Ok(&data),
                        "{count} of {stride} bytes, noise {noise}, {codec:?}"
                    );
                    assert!(
                        count < 200 || noise > 3 || 5 * stream.len() < 4 * data.len(),
                        "{} bytes of {}",
                        stream.len(),
                        data.len()
                    );
                }
            }
        }
    }
}

#[test]
fn triangles_are_written_as_they_are_read() {
    let mut state = 88_172_645_463_325_252;
    let side = 30u32;
    let corner = |x: u32, y: u32| y * (side + 1) + x;
    let squares = (0..side).flat_map(|y| (0..side).map(move |x| (x, y)));
    let grid: Vec<u32> = squares
        .flat_map(|(x, y)| {
            let [a, b, c, d] = [corner(x, y), corner(x + 1, y), corner(x + 1, y + 1), corner(x, y + 1)];
            [a, b, c, a, c, d]
        })
        .collect();
    let few: Vec<u32> = (0..3000).map(|_| (next(&mut state) % 20) as u32).collect();
    let many: Vec<u32> = (0..3000).map(|_| (next(&mut state) % 0x3FFF_FFFF) as u32).collect();
    for (name, indices) in
        [("grid", grid), ("few", few), ("many", many), ("in order", (0..3000).collect()), ("none", Vec::new())]
    {
        let data: Vec<u8> = indices.iter().flat_map(|i| i.to_le_bytes()).collect();
        let triangles = layout(Mode::Triangles, indices.len(), 4);
        let stream = encode(&data, &triangles, Codec::Version0).unwrap();
        let read = decode(&stream, &triangles).unwrap();
        let read: Vec<u32> = read.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
        for (found, [a, b, c]) in read.as_chunks::<3>().0.iter().zip(indices.as_chunks::<3>().0) {
            assert!([[a, b, c], [b, c, a], [c, a, b]].iter().any(|t| t.map(|v| *v) == *found), "{name}");
        }
        assert!(name != "grid" || stream.len() < indices.len(), "{} bytes", stream.len());
        let sequence = layout(Mode::Indices, indices.len(), 4);
        assert_eq!(decode(&encode(&data, &sequence, Codec::Version0).unwrap(), &sequence).unwrap(), data, "{name}");
    }
}

#[test]
fn floats_on_a_grid_are_exact_through_a_filter_and_others_are_not_put_through() {
    let bytes = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let on_grid: Vec<f32> = (0..600).map(|i| (i * 37 % 8193) as f32 / 8192.0).collect();
    let data = bytes(&on_grid);
    let elements = exponential(&data, 8).unwrap();
    let filtered = StreamLayout { filter: Filter::Exponential, ..layout(Mode::Attributes, 300, 8) };
    let stream = encode(&elements, &layout(Mode::Attributes, 300, 8), Codec::Version0).unwrap();
    assert_eq!(decode(&stream, &filtered).unwrap(), data);
    for wrong in [[1.0, f32::NAN], [1.0, 1e-30], [-0.0, 1.0], [f32::INFINITY, 0.0]] {
        assert!(exponential(&bytes(&wrong), 4).is_none(), "{wrong:?}");
    }
}

#[test]
fn unit_vectors_come_back_within_the_steps_of_their_coordinates() {
    for (stride, one, max) in [(4, 127i16, 127.0f64), (8, 511, 32767.0), (8, 32767, 32767.0)] {
        let vectors = (0..500).map(|i| {
            let (a, b) = (f64::from(i) * 0.7, f64::from(i) * 0.31);
            [a.cos() * b.sin(), a.sin() * b.sin(), b.cos()].map(|v| (v * max).round() as i16)
        });
        let data: Vec<u8> = match stride {
            4 => vectors.flat_map(|[x, y, z]| [x as u8, y as u8, z as u8, 9]).collect(),
            _ => vectors
                .flat_map(|[x, y, z]| [x, y, z, -3].map(i16::to_le_bytes).into_iter().flatten().collect::<Vec<_>>())
                .collect(),
        };
        let mut elements = data.clone();
        octahedral(&mut elements, stride, one);
        let plain = layout(Mode::Attributes, 500, stride);
        let filtered = StreamLayout { filter: Filter::Octahedral, ..plain };
        let stream = encode(&elements, &plain, Codec::Version0).unwrap();
        assert_eq!(one_of_octahedral(&stream, &filtered), Some(one));
        let read = decode(&stream, &filtered).unwrap();
        let components = |bytes: &[u8]| -> Vec<f64> {
            match stride {
                4 => bytes.iter().map(|b| f64::from(*b as i8)).collect(),
                _ => bytes.as_chunks().0.iter().map(|b| f64::from(i16::from_le_bytes(*b))).collect(),
            }
        };
        let worst = components(&read).iter().zip(components(&data)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(worst <= 2.0 * max / f64::from(one) + 1.0, "{worst} of {max}");
    }
}
