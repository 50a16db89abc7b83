//! Files that people take for models that are read: what they are, and what to do with them.

/// What a file is called and begins with, what it is, and what makes a model of it that is read.
struct Foreign {
    /// Endings of names, in small letters.
    endings: &'static [&'static str],
    /// First bytes; empty where these tell nothing.
    magic: &'static [u8],
    what: &'static str,
    advice: &'static str,
}

const EXPORT: &str = "export it as .glb from the program that made it";

const FOREIGN: [Foreign; 11] = [
    Foreign { endings: &["fbx"], magic: b"Kaydara FBX", what: "FBX", advice: EXPORT },
    Foreign { endings: &["blend"], magic: b"BLENDER", what: "a Blender file", advice: EXPORT },
    Foreign { endings: &["ply"], magic: b"ply", what: "PLY", advice: EXPORT },
    Foreign { endings: &["stl"], magic: b"", what: "STL, which has no texture coordinates", advice: EXPORT },
    Foreign { endings: &["dae"], magic: b"", what: "COLLADA", advice: EXPORT },
    Foreign { endings: &["usd", "usda", "usdc", "usdz"], magic: b"PXR-USDC", what: "USD", advice: EXPORT },
    Foreign {
        endings: &["3ds", "max", "ma", "mb", "c4d", "skp"],
        magic: b"",
        what: "a file of a modelling program",
        advice: EXPORT,
    },
    Foreign { endings: &["vrm"], magic: b"", what: "VRM, which is a GLB", advice: "rename it to .glb" },
    Foreign {
        endings: &["7z", "rar", "gz", "tgz", "tar", "xz"],
        magic: b"",
        what: "an archive that is not read",
        advice: "pack it as .zip",
    },
    Foreign {
        endings: &["mtl"],
        magic: b"",
        what: "a material library",
        advice: "give the .obj that names it as well",
    },
    Foreign {
        endings: &["png", "jpg", "jpeg", "webp", "ktx2", "tga", "tif", "tiff", "bmp", "exr", "hdr"],
        magic: b"",
        what: "an image",
        advice: "give the model that it belongs to as well",
    },
];

/// What a file is that is no model that is read, and what to do about it; none where that is not known.
pub fn foreign(name: &str, head: &[u8]) -> Option<String> {
    let ending = name.rsplit_once('.').map(|(_, ending)| ending.to_ascii_lowercase()).unwrap_or_default();
    let by_magic = FOREIGN.iter().find(|f| !f.magic.is_empty() && head.starts_with(f.magic));
    let found = by_magic.or_else(|| FOREIGN.iter().find(|f| f.endings.contains(&ending.as_str())))?;
    Some(format!("{}: {}", found.what, found.advice))
}

#[cfg(test)]
mod tests {
    use super::foreign;

    #[test]
    fn first_bytes_tell_more_than_a_name() {
        assert!(foreign("a.bin", b"BLENDER-v3").unwrap().starts_with("a Blender file"));
        assert!(foreign("A.FBX", b"; FBX 7").unwrap().starts_with("FBX: export"));
        assert_eq!(foreign("a.txt", b"hello"), None);
    }
}
