//! Streams of compressed geometry that lie, or that were read wrong.

use std::time::{Duration, Instant};

use intarsia::asset::{Document, File, Limits, load, read_indices};
use intarsia::error::{Code, Result};
use serde_json::{Value, json};

fn open(json: &Value, buffer: &[u8]) -> Result<Document> {
    let file = |path: &str, bytes: Vec<u8>| File { path: path.to_owned(), bytes };
    let files = [file("m.gltf", serde_json::to_vec(json).unwrap()), file("m.bin", buffer.to_vec())];
    load(&files, None, &Limits::default()).map(|(document, _)| document)
}

/// A model with one primitive, of as many vertices and indices as are said, and a Draco stream for it.
fn draco(stream: &[u8], vertices: u64, indices: u64) -> Result<Document> {
    let extension = json!({ "bufferView": 0, "attributes": { "POSITION": 0 } });
    let json = json!({
        "asset": { "version": "2.0" },
        "extensionsUsed": ["KHR_draco_mesh_compression"],
        "extensionsRequired": ["KHR_draco_mesh_compression"],
        "buffers": [{ "byteLength": stream.len(), "uri": "m.bin" }],
        "bufferViews": [{ "buffer": 0, "byteLength": stream.len() }],
        "accessors": [
            { "componentType": 5126, "count": vertices, "type": "VEC3" },
            { "componentType": 5125, "count": indices, "type": "SCALAR" },
        ],
        "meshes": [{ "primitives": [{
            "attributes": { "POSITION": 0 }, "indices": 1, "extensions": { "KHR_draco_mesh_compression": extension },
        }] }],
    });
    open(&json, stream)
}

/// A Draco header, version 2.2: method 0 is sequential, 1 edgebreaker.
fn header(method: u8, flags: u16) -> Vec<u8> {
    [&b"DRACO\x02\x02\x01"[..], &[method], &flags.to_le_bytes()].concat()
}

fn varint(mut value: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
    bytes
}

/// Most memory that this process ever held, in bytes; none where the system does not tell.
fn peak() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? << 10)
}

/// Metadata of Draco streams nest, and readers that follow them by recursion overflow their stack, which nothing
/// catches.
#[test]
fn nested_metadata_do_not_overflow_the_stack() {
    for depth in [900, 1_000_000] {
        let mut stream = header(1, 0x8000);
        stream.push(0);
        for _ in 0..depth {
            stream.extend([0, 1, 1, b'a']);
        }
        stream.extend([0, 0]);
        assert_eq!(draco(&stream, 3, 3).unwrap_err().code, Code::InvalidModel, "depth {depth}");
    }
}

/// A hundred bytes that declare billions of vertices, alone or with accessors that agree.
#[test]
fn declared_counts_take_no_memory() {
    let before = peak();
    let start = Instant::now();
    for count in [20_000_000, 1 << 31, u64::from(u32::MAX), 1 << 62] {
        for method in [0, 1] {
            // Sequential: faces, points, kind of connectivity. Edgebreaker: kind of traversal, vertices, faces, and so on.
            for start in [vec![], vec![0], vec![2]] {
                let mut stream = [header(method, 0), start, varint(count), varint(count)].concat();
                for filler in [0, 1, 0x7F, 0xFF] {
                    stream.truncate(40);
                    stream.resize(100, filler);
                    for declared in [3, 60_000_000, 3 << 31] {
                        let failure = draco(&stream, declared / 6, declared).unwrap_err();
                        assert!(matches!(failure.code, Code::InvalidModel | Code::TooLarge), "{failure}");
                    }
                }
            }
        }
    }
    assert!(start.elapsed() < Duration::from_secs(20), "{:?} for 288 streams", start.elapsed());
    if let (Some(before), Some(after)) = (before, peak()) {
        assert!(after - before < 256 << 20, "{} MiB for streams of 100 bytes", (after - before) >> 20);
    }
}

/// Version 1 of the attribute codec turns the bits of XOR differences. The text reads as if the reader turned them left
/// too; it has to turn them back. Two elements of four bytes, as meshoptimizer wrote them, with a turn of 6.
#[test]
fn turned_differences_are_turned_back() {
    let stream = hex("a1ef009600fd006300000000000000000000000000000000000000d9a6a20462");
    let extension = json!({ "buffer": 0, "byteLength": 32, "byteStride": 4, "mode": "ATTRIBUTES", "count": 2 });
    let json = json!({
        "asset": { "version": "2.0" },
        "extensionsRequired": ["EXT_meshopt_compression"],
        "buffers": [{ "byteLength": 32, "uri": "m.bin" }, { "byteLength": 8 }],
        "bufferViews": [{ "buffer": 1, "byteLength": 8, "extensions": { "EXT_meshopt_compression": extension } }],
        "accessors": [{ "bufferView": 0, "componentType": 5125, "count": 2, "type": "SCALAR" }],
    });
    let doc = open(&json, &stream).unwrap();
    assert_eq!(read_indices(&doc, 0).unwrap(), [0x04A2_A6D9, 0x5D2E_A52F]);
}

fn hex(text: &str) -> Vec<u8> {
    text.as_bytes().chunks(2).map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap()).collect()
}
