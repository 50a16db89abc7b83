//! The images that textures name, and taking out those that none names any more.

use serde_json::Value;

use super::document::Document;

/// Calls `f` with every image index of the textures, those in extensions too.
pub(crate) fn each_source(json: &mut Value, mut f: impl FnMut(&mut Value)) {
    for texture in json.get_mut("textures").and_then(Value::as_array_mut).into_iter().flatten() {
        if let Some(source) = texture.get_mut("source") {
            f(source);
        }
        let extensions = texture.get_mut("extensions").and_then(Value::as_object_mut);
        for source in extensions.into_iter().flat_map(|e| e.values_mut()).filter_map(|e| e.get_mut("source")) {
            f(source);
        }
    }
}

/// Takes images out and numbers the others anew. `gone` rises; no texture names any of it.
pub(crate) fn drop_images(doc: &mut Document, gone: &[usize]) {
    let stays = |image: usize| gone.binary_search(&image).is_err();
    if let Some(images) = doc.json.get_mut("images").and_then(Value::as_array_mut) {
        let mut index = 0;
        images.retain(|_| {
            index += 1;
            stays(index - 1)
        });
    }
    let mut index = 0;
    doc.images.retain(|_| {
        index += 1;
        stays(index - 1)
    });
    let before = |image: usize| gone.partition_point(|g| *g < image);
    for images in [&mut doc.merging.constants, &mut doc.merging.spare] {
        *images = images.iter().filter(|i| stays(**i)).map(|i| i - before(*i)).collect();
    }
    each_source(&mut doc.json, |source| {
        if let Some(image) = source.as_u64().and_then(|i| usize::try_from(i).ok()).filter(|i| before(*i) > 0) {
            *source = Value::from(image - before(image));
        }
    });
}
