//! MTL files: the materials of OBJ models, with the common extensions for physically based shading.

use super::lines::{Lines, keyword, words};
use super::number::float;
use crate::asset::name::from_bytes;

/// A texture map.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Map {
    /// File name as written.
    pub(crate) file: String,
    /// `-clamp on`: the texture does not repeat.
    pub(crate) clamp: bool,
    /// `-s`: what texture coordinates are multiplied by, before
    pub(crate) scale: [f32; 2],
    /// `-o`: this is added.
    pub(crate) offset: [f32; 2],
    /// `-bm`: how strong bumps are.
    pub(crate) strength: Option<f32>,
    /// Whether options that change the texture were left out.
    pub(crate) adjusted: bool,
}

/// A material as written; numbers that are none are left out.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Mtl {
    /// `newmtl`
    pub(crate) name: String,
    /// `Kd`
    pub(crate) diffuse: Option<[f32; 3]>,
    /// `Ke`
    pub(crate) emissive: Option<[f32; 3]>,
    /// `d`. `Tr` is not read: programs disagree on whether 1 means opaque or invisible.
    pub(crate) dissolve: Option<f32>,
    /// `Pr`
    pub(crate) roughness: Option<f32>,
    /// `Pm`
    pub(crate) metallic: Option<f32>,
    /// `map_Kd`
    pub(crate) map_diffuse: Option<Map>,
    /// `map_Ke`
    pub(crate) map_emissive: Option<Map>,
    /// `map_d`
    pub(crate) map_dissolve: Option<Map>,
    /// `norm`
    pub(crate) normal: Option<Map>,
    /// Every other map: its keyword and file.
    pub(crate) others: Vec<(String, Map)>,
}

/// Reads an MTL file; what is not understood is skipped.
pub(crate) fn parse(text: &[u8]) -> Vec<Mtl> {
    let mut materials: Vec<Mtl> = Vec::new();
    let mut lines = Lines::new(text);
    while let Some((_, line)) = lines.next_line() {
        let (key, rest) = keyword(line);
        if key.eq_ignore_ascii_case(b"newmtl") {
            materials.push(Mtl { name: from_bytes(rest), ..Mtl::default() });
            continue;
        }
        let Some(material) = materials.last_mut() else { continue };
        match key {
            b"Kd" => material.diffuse = color(rest).or(material.diffuse),
            b"Ke" => material.emissive = color(rest).or(material.emissive),
            b"d" => material.dissolve = fraction(rest).or(material.dissolve),
            b"Pr" => material.roughness = fraction(rest).or(material.roughness),
            b"Pm" => material.metallic = fraction(rest).or(material.metallic),
            _ => read_map(material, key, rest),
        }
    }
    materials
}

fn read_map(material: &mut Mtl, key: &[u8], rest: &[u8]) {
    let key = String::from_utf8_lossy(key).to_ascii_lowercase();
    if !(key.starts_with("map_") || matches!(key.as_str(), "norm" | "bump" | "disp" | "decal" | "refl")) {
        return;
    }
    let Some(map) = map(rest) else { return };
    match key.as_str() {
        "map_kd" => material.map_diffuse = Some(map),
        "map_ke" => material.map_emissive = Some(map),
        "map_d" => material.map_dissolve = Some(map),
        "norm" => material.normal = Some(map),
        _ => material.others.push((key, map)),
    }
}

fn color(rest: &[u8]) -> Option<[f32; 3]> {
    let mut values = words(rest).map(|w| float(w).filter(|v| v.is_finite()).map(|v| v.max(0.0)));
    let first = values.next()??;
    // One value alone stands for all three.
    Some([first, values.next().flatten().unwrap_or(first), values.next().flatten().unwrap_or(first)])
}

fn fraction(rest: &[u8]) -> Option<f32> {
    // `d -halo 0.5` also ends with its number.
    words(rest).last().and_then(float).filter(|v| v.is_finite()).map(|v| v.clamp(0.0, 1.0))
}

/// A map: options, then a file name that may hold blanks.
fn map(rest: &[u8]) -> Option<Map> {
    let mut map =
        Map { file: String::new(), clamp: false, scale: [1.0; 2], offset: [0.0; 2], strength: None, adjusted: false };
    let mut rest = rest;
    loop {
        let (option, after) = keyword(rest);
        let most = match option {
            b"-blendu" | b"-blendv" | b"-cc" | b"-clamp" | b"-imfchan" | b"-type" | b"-boost" | b"-texres" | b"-bm" => {
                1
            }
            b"-mm" => 2,
            b"-o" | b"-s" | b"-t" => 3,
            _ => break,
        };
        let mut arguments = after;
        for taken in 0..most {
            let (argument, after) = keyword(arguments);
            // -o, -s and -t take one to three numbers: the first word that is none belongs to the file name.
            if most == 3 && (float(argument).is_none() || after.is_empty() && taken > 0) {
                break;
            }
            let number = float(argument).filter(|v| v.is_finite());
            match option {
                b"-clamp" => map.clamp |= argument.eq_ignore_ascii_case(b"on"),
                b"-s" if taken < 2 => map.scale[taken] = number.unwrap_or(1.0),
                b"-o" if taken < 2 => map.offset[taken] = number.unwrap_or(0.0),
                b"-bm" => map.strength = number,
                b"-t" => map.adjusted |= number != Some(0.0),
                b"-mm" | b"-imfchan" => map.adjusted = true,
                _ => {}
            }
            arguments = after;
        }
        rest = arguments;
    }
    map.file = from_bytes(rest).trim_matches('"').to_owned();
    (!map.file.is_empty()).then_some(map)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_with_options_and_blanks() {
        let read = |text: &str| map(text.as_bytes()).map(|m| (m.file, m.clamp, m.scale, m.offset, m.adjusted));
        let (one, zero) = ([1.0; 2], [0.0; 2]);
        assert_eq!(read("fuze uv.jpg"), Some(("fuze uv.jpg".into(), false, one, zero, false)));
        assert_eq!(read("-clamp on -s 1 1 1 a b.png"), Some(("a b.png".into(), true, one, zero, false)));
        assert_eq!(read("-o 0.5 x.png"), Some(("x.png".into(), false, one, [0.5, 0.0], false)));
        assert_eq!(read("-s 2 3 1.png"), Some(("1.png".into(), false, [2.0, 3.0], zero, false)));
        assert_eq!(read("-t 0.1 0 0 x.png"), Some(("x.png".into(), false, one, zero, true)));
        assert_eq!(read("-texres 512 -bm 1 \"q r.png\""), Some(("q r.png".into(), false, one, zero, false)));
        assert_eq!(map(b"-bm 0.5 n.png").unwrap().strength, Some(0.5));
        assert_eq!(read("-clamp on"), None);
    }

    #[test]
    fn materials() {
        let all =
            parse(b"Kd 1 1 1\nnewmtl a b\r\nKd .5\nKe 1 x 2\nd 0.25\nPr nan\nMap_Kd t.png\nnewmtl c\nmap_Bump n.png\n");
        assert_eq!(all.len(), 2);
        assert_eq!((all[0].name.as_str(), all[0].diffuse, all[0].dissolve), ("a b", Some([0.5; 3]), Some(0.25)));
        assert_eq!((all[0].emissive, all[0].roughness), (Some([1.0, 1.0, 2.0]), None));
        assert_eq!(all[0].map_diffuse.as_ref().unwrap().file, "t.png");
        assert_eq!(all[1].others[0].0, "map_bump");
    }
}
