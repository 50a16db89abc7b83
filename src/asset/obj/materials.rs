//! OBJ materials as glTF materials, textures, samplers and images.

use std::collections::{BTreeMap, BTreeSet};

use encoding_rs::Encoding;
use percent_encoding::utf8_percent_encode;
use serde_json::{Value, json};

use super::mtl::{Map, Mtl};
use crate::asset::Document;
use crate::asset::extensions::TEXTURE_TRANSFORM;
use crate::asset::name::readable_in;
use crate::asset::upload::Upload;
use crate::asset::uri::{self, quote};
use crate::error::{Code, Failure, Result, Warning};

/// Most words in the name of a library, and in a line of them.
const MOST_WORDS: usize = 12;
const MOST_LINE: usize = 256;

/// Reads the libraries that an OBJ names; the first definition of a name counts. Says too whether one is missing.
pub(crate) fn read_libraries(
    names: &[String],
    model_path: &str,
    upload: &Upload<'_>,
    warnings: &mut Vec<Warning>,
) -> (BTreeMap<String, (String, Mtl)>, bool) {
    let mut found = BTreeMap::new();
    // Lines may name one file a million times.
    let (mut read, mut missing) = (BTreeSet::new(), BTreeSet::new());
    for line in names {
        let parts = library_names(line, &|name| find(name, model_path, upload).is_some());
        let parts = parts.into_iter().map(|name| (name, find(name, model_path, upload)));
        for (name, file) in parts {
            let Some(file) = file else {
                if !missing.insert(name) {
                    continue;
                }
                let message = format!(
                    "the material library {} was not uploaded: faces have plain materials without it (send it along with the model, under that name)",
                    quote(name)
                );
                warnings.push(Warning::new("missing_material_library", message));
                continue;
            };
            if !read.insert(file.path.as_str()) {
                continue;
            }
            for material in super::mtl::parse(&file.bytes) {
                found.entry(material.name.clone()).or_insert_with(|| (file.path.clone(), material));
            }
        }
    }
    (found, !missing.is_empty())
}

/// The names in a line of libraries: one with blanks, or several, which may have blanks too, or stand in quotes. A name is whatever `is_there`; what
/// is left between such names is one that is not.
fn library_names<'a>(line: &'a str, is_there: &dyn Fn(&str) -> bool) -> Vec<&'a str> {
    let plain = line.trim_matches('"');
    if is_there(plain) {
        return vec![plain];
    }
    if line.contains('"') {
        return line.split('"').map(str::trim).filter(|name| !name.is_empty()).collect();
    }
    let words = words(line);
    let run = |from: usize, to: usize| &line[words[from].start..words[to].end];
    let mut names = Vec::new();
    let (mut at, mut unknown) = (0, None);
    while at < words.len() {
        let most = words.len().min(at + MOST_WORDS);
        match (at..most).rev().find(|to| is_there(run(at, *to))) {
            Some(to) => {
                names.extend(unknown.take().map(|from| run(from, at - 1)));
                names.push(run(at, to));
                at = to + 1;
            }
            None => {
                unknown.get_or_insert(at);
                at += 1;
            }
        }
    }
    names.extend(unknown.map(|from| run(from, words.len() - 1)));
    names
}

/// Every name that a line of libraries may mean.
pub(super) fn possible_names(line: &str) -> Vec<&str> {
    let mut names = vec![line.trim_matches('"')];
    names.extend(line.split('"').map(str::trim).filter(|name| !name.is_empty()));
    let words = words(line);
    for (from, first) in words.iter().enumerate() {
        names.extend(words[from..].iter().take(MOST_WORDS).map(|last| &line[first.start..last.end]));
    }
    names
}

/// Where the words of a line are, as many as are looked at.
fn words(line: &str) -> Vec<std::ops::Range<usize>> {
    let start = |word: &str| word.as_ptr() as usize - line.as_ptr() as usize;
    line.split_whitespace().take(MOST_LINE).map(|word| start(word)..start(word) + word.len()).collect()
}

/// A file named from another one; absolute paths of somebody's disk are cut to the file name.
fn find<'u, 'a>(name: &str, from: &str, upload: &'u Upload<'a>) -> Option<&'u crate::asset::upload::UploadEntry<'a>> {
    upload.find(&clean(name, from)?)
}

fn clean(name: &str, from: &str) -> Option<String> {
    uri::join(from, name).or_else(|| uri::normalise(uri::file_name(name)))
}

/// Makes glTF materials in a document.
pub(crate) struct Materials<'m> {
    upload: &'m Upload<'m>,
    model_path: &'m str,
    /// Bytes that images may still take.
    left: u64,
    images: BTreeMap<String, usize>,
    textures: BTreeMap<(usize, bool), usize>,
    /// In which the OBJ's names are, where they are not UTF-8.
    encoding: Option<&'static Encoding>,
}

impl<'m> Materials<'m> {
    /// For a model at `model_path` in `upload`, whose names are in `encoding` where they are not UTF-8.
    pub(crate) fn new(
        upload: &'m Upload<'m>,
        model_path: &'m str,
        max_bytes: u64,
        encoding: Option<&'static Encoding>,
    ) -> Self {
        Materials { upload, model_path, left: max_bytes, images: BTreeMap::new(), textures: BTreeMap::new(), encoding }
    }

    /// Appends a material; `library` is the path of its MTL file. Gives its index.
    ///
    /// # Errors
    /// `too_large` when its images exceed the limit.
    pub(crate) fn add(
        &mut self,
        doc: &mut Document,
        library: &str,
        mtl: &Mtl,
        warnings: &mut Vec<Warning>,
    ) -> Result<usize> {
        let mut pbr =
            json!({ "metallicFactor": mtl.metallic.unwrap_or(0.0), "roughnessFactor": mtl.roughness.unwrap_or(1.0) });
        let mut material = json!({ "name": readable_in(&mtl.name, self.encoding) });
        let opacity = mtl.dissolve.unwrap_or(1.0);
        // Scans write a grey Kd beside their map; the map alone is meant.
        let [r, g, b] = match mtl.map_diffuse {
            Some(_) => [1.0; 3],
            None => mtl.diffuse.unwrap_or([1.0; 3]).map(|v| v.min(1.0)),
        };
        if [r, g, b, opacity] != [1.0; 4] {
            pbr["baseColorFactor"] = json!([r, g, b, opacity]);
        }
        if let Some(map) = &mtl.map_diffuse {
            pbr["baseColorTexture"] = self.texture_info(doc, library, map, warnings)?;
        }
        let cutout = match (&mtl.map_dissolve, &mtl.map_diffuse) {
            (Some(alpha), Some(color)) => alpha.file == color.file,
            _ => false,
        };
        if cutout || opacity < 1.0 {
            material["alphaMode"] = json!("BLEND");
        }
        material["pbrMetallicRoughness"] = pbr;
        let glow = mtl.emissive.unwrap_or([0.0; 3]).map(|v| v.min(1.0));
        if let Some(map) = &mtl.map_emissive {
            material["emissiveTexture"] = self.texture_info(doc, library, map, warnings)?;
            material["emissiveFactor"] = json!(if glow == [0.0; 3] { [1.0; 3] } else { glow });
        } else if glow != [0.0; 3] {
            material["emissiveFactor"] = json!(glow);
        }
        if let Some(map) = &mtl.normal {
            material["normalTexture"] = self.texture_info(doc, library, map, warnings)?;
            if let Some(strength) = map.strength {
                material["normalTexture"]["scale"] = json!(strength);
            }
        }
        let index = doc.push("materials", material);
        self.warn_of_dropped(mtl, cutout, index, warnings);
        Ok(index)
    }

    fn warn_of_dropped(&self, mtl: &Mtl, cutout: bool, index: usize, warnings: &mut Vec<Warning>) {
        let color = mtl.map_diffuse.as_ref().map(|m| m.file.as_str());
        let alpha = mtl.map_dissolve.iter().filter(|_| !cutout).map(|m| ("map_d", m));
        let others = mtl.others.iter().map(|(key, map)| (key.as_str(), map));
        // The ambient map is a copy of the diffuse one by custom.
        for (key, map) in alpha.chain(others).filter(|(key, map)| *key != "map_ka" || Some(map.file.as_str()) != color)
        {
            let message = format!("{key} {} has no counterpart in glTF and is dropped", quote(&map.file));
            warnings.push(Warning::new("material_map_dropped", message).at(format!("/materials/{index}")));
        }
        let maps = [&mtl.map_diffuse, &mtl.map_emissive, &mtl.normal];
        for map in maps.into_iter().flatten().filter(|m| m.adjusted) {
            let message = format!(
                "options of the map {} have no counterpart in glTF and are dropped (-t, -mm or -imfchan)",
                quote(&map.file)
            );
            warnings.push(Warning::new("map_option_dropped", message).at(format!("/materials/{index}")));
        }
    }

    /// A texture as a material names it: `-s` and `-o` are a texture transform, whose v axis points down.
    fn texture_info(
        &mut self,
        doc: &mut Document,
        library: &str,
        map: &Map,
        warnings: &mut Vec<Warning>,
    ) -> Result<Value> {
        let mut info = json!({ "index": self.texture(doc, library, map, warnings)? });
        let ([su, sv], [ou, ov]) = (map.scale, map.offset);
        if (map.scale, map.offset) != ([1.0; 2], [0.0; 2]) {
            info["extensions"] = json!({ TEXTURE_TRANSFORM: { "offset": [ou, 1.0 - sv - ov], "scale": [su, sv] } });
            if doc.json.get("extensionsUsed").is_none() {
                doc.json["extensionsUsed"] = json!([TEXTURE_TRANSFORM]);
            }
        }
        Ok(info)
    }

    fn texture(&mut self, doc: &mut Document, library: &str, map: &Map, warnings: &mut Vec<Warning>) -> Result<usize> {
        let image = self.image(doc, library, map, warnings)?;
        if let Some(index) = self.textures.get(&(image, map.clamp)) {
            return Ok(*index);
        }
        let wrap = if map.clamp { 33071 } else { 10497 };
        let wanted = json!({ "magFilter": 9729, "minFilter": 9987, "wrapS": wrap, "wrapT": wrap });
        let samplers = doc.json.get("samplers").and_then(Value::as_array);
        let sampler = samplers.and_then(|all| all.iter().position(|s| *s == wanted));
        let sampler = sampler.unwrap_or_else(|| doc.push("samplers", wanted));
        let texture = doc.push("textures", json!({ "sampler": sampler, "source": image }));
        self.textures.insert((image, map.clamp), texture);
        Ok(texture)
    }

    fn image(&mut self, doc: &mut Document, library: &str, map: &Map, warnings: &mut Vec<Warning>) -> Result<usize> {
        // Maps are named from the library's folder; some writers name them from the model's.
        let from_model = || clean(&map.file, self.model_path).filter(|path| self.upload.find(path).is_some());
        let path = clean(&map.file, library).filter(|path| self.upload.find(path).is_some()).or_else(from_model);
        let file = path.as_deref().and_then(|path| self.upload.find(path));
        let path = match file {
            Some(file) => file.path.clone(),
            None => clean(&map.file, library).unwrap_or_else(|| "image".to_owned()),
        };
        if let Some(index) = self.images.get(&path) {
            return Ok(*index);
        }
        let folder = self.model_path.rfind('/').and_then(|end| self.model_path.get(..=end)).unwrap_or_default();
        // Written as UTF-8, whatever it came in.
        let relative = readable_in(path.strip_prefix(folder).unwrap_or(&path), self.encoding);
        let uri = utf8_percent_encode(&relative, &uri::RESERVED).to_string();
        let image = json!({ "name": uri::stem(&relative), "uri": uri });
        let index = doc.push("images", image);
        if let Some(file) = file {
            self.left = self.left.checked_sub(file.bytes.len() as u64).ok_or_else(|| {
                Failure::new(Code::TooLarge, "the images together exceed the limit on the input")
                    .at(format!("/images/{index}"))
            })?;
        } else {
            let message = format!(
                "the image file {} was not uploaded: send it along with the model, under that name",
                quote(&map.file)
            );
            warnings.push(Warning::new("missing_image", message).at(format!("/images/{index}")));
        }
        doc.images.push(file.map(|f| f.bytes.to_vec()));
        self.images.insert(path, index);
        Ok(index)
    }
}
