//! Buffer views and accessors that nothing refers to any more: found and taken out.
//!
//! References are looked for where `each_accessor` and `each_view` look, which is everywhere if
//! [`super::extensions::all_understood`].

use serde_json::Value;

use super::extensions::GPU_INSTANCING;

/// Takes out accessors and buffer views that nothing refers to, and numbers the others anew. Gives which of the
/// views stay; none, with the document untouched, when a reference is broken.
pub(crate) fn prune(json: &mut Value) -> Option<Vec<bool>> {
    let used_accessors = used(json, "accessors", each_accessor)?;
    let mut pruned = json.clone();
    retain(&mut pruned, "accessors", &used_accessors);
    renumber(&mut pruned, &used_accessors, each_accessor);
    let used_views = used(&mut pruned, "bufferViews", each_view)?;
    retain(&mut pruned, "bufferViews", &used_views);
    renumber(&mut pruned, &used_views, each_view);
    *json = pruned;
    Some(used_views)
}

type Each = fn(&mut Value, &mut dyn FnMut(&mut Value));

fn used(json: &mut Value, key: &str, each: Each) -> Option<Vec<bool>> {
    let count = json.get(key).and_then(Value::as_array).map_or(0, Vec::len);
    let mut used = vec![false; count];
    let mut broken = false;
    each(json, &mut |index| {
        let slot = index.as_u64().and_then(|i| used.get_mut(usize::try_from(i).ok()?));
        match slot {
            Some(slot) => *slot = true,
            None => broken = true,
        }
    });
    (!broken).then_some(used)
}

fn retain(json: &mut Value, key: &str, used: &[bool]) {
    let Some(array) = json.get_mut(key).and_then(Value::as_array_mut) else { return };
    let mut keep = used.iter();
    array.retain(|_| keep.next().copied().unwrap_or(true));
    if array.is_empty()
        && let Some(root) = json.as_object_mut()
    {
        root.shift_remove(key);
    }
}

fn renumber(json: &mut Value, used: &[bool], each: Each) {
    let mut next = 0;
    let numbers: Vec<u64> = used
        .iter()
        .map(|used| {
            let number = next;
            next += u64::from(*used);
            number
        })
        .collect();
    each(json, &mut |index| {
        let number = index.as_u64().and_then(|i| numbers.get(usize::try_from(i).ok()?));
        // Equal values stay as they are written.
        if let Some(number) = number.filter(|n| index.as_u64() != Some(**n)) {
            *index = Value::from(*number);
        }
    });
}

/// Calls `f` with every reference to an accessor.
fn each_accessor(json: &mut Value, f: &mut dyn FnMut(&mut Value)) {
    for mesh in objects(json, "meshes") {
        for primitive in objects(mesh, "primitives") {
            fields(primitive.get_mut("attributes"), f);
            field(primitive, "indices", f);
            for target in objects(primitive, "targets") {
                fields(Some(target), f);
            }
        }
    }
    for animation in objects(json, "animations") {
        for sampler in objects(animation, "samplers") {
            field(sampler, "input", f);
            field(sampler, "output", f);
        }
    }
    for skin in objects(json, "skins") {
        field(skin, "inverseBindMatrices", f);
    }
    let instances = format!("/extensions/{GPU_INSTANCING}/attributes");
    for node in objects(json, "nodes") {
        fields(node.pointer_mut(&instances), f);
    }
}

/// Calls `f` with every reference to a buffer view.
fn each_view(json: &mut Value, f: &mut dyn FnMut(&mut Value)) {
    for accessor in objects(json, "accessors") {
        field(accessor, "bufferView", f);
        for part in ["indices", "values"] {
            if let Some(part) = accessor.get_mut("sparse").and_then(|s| s.get_mut(part)) {
                field(part, "bufferView", f);
            }
        }
    }
    for image in objects(json, "images") {
        field(image, "bufferView", f);
    }
}

fn objects<'a>(value: &'a mut Value, key: &str) -> impl Iterator<Item = &'a mut Value> + use<'a> {
    value.get_mut(key).and_then(Value::as_array_mut).into_iter().flatten()
}

fn field(value: &mut Value, key: &str, f: &mut dyn FnMut(&mut Value)) {
    if let Some(found) = value.get_mut(key) {
        f(found);
    }
}

fn fields(value: Option<&mut Value>, f: &mut dyn FnMut(&mut Value)) {
    for found in value.and_then(Value::as_object_mut).into_iter().flat_map(|o| o.values_mut()) {
        f(found);
    }
}
