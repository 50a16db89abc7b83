//! The images that textures name, and taking out those that none names any more.

use serde_json::Value;

use super::document::Document;
use super::json::{array, each_mut, keep, new_numbers, renumber};

/// Calls `f` with every image index of the textures, those in extensions too.
pub(crate) fn each_source(json: &mut Value, mut f: impl FnMut(&mut Value)) {
    for texture in each_mut(json, "textures") {
        if let Some(source) = texture.get_mut("source") {
            f(source);
        }
        let extensions = texture.get_mut("extensions").and_then(Value::as_object_mut);
        for source in extensions.into_iter().flat_map(|e| e.values_mut()).filter_map(|e| e.get_mut("source")) {
            f(source);
        }
    }
}

/// Takes images out and numbers the others anew; no texture names any that is gone.
pub(crate) fn drop_images(doc: &mut Document, gone: &[usize]) {
    let mut kept = vec![true; doc.images.len().max(array(&doc.json, "images").len())];
    for image in gone {
        if let Some(kept) = kept.get_mut(*image) {
            *kept = false;
        }
    }
    if let Some(images) = doc.json.get_mut("images").and_then(Value::as_array_mut) {
        keep(images, |image| kept[image]);
    }
    keep(&mut doc.images, |image| kept[image]);
    let new = new_numbers(&kept);
    for images in [&mut doc.merging.constants, &mut doc.merging.spare] {
        *images = images.iter().filter(|i| kept[**i]).map(|i| new[*i]).collect();
    }
    each_source(&mut doc.json, |source| renumber(source, &new));
}
