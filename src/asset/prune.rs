//! Buffer views and accessors that nothing refers to any more: found and taken out.
//!
//! References are looked for where `each_accessor` and `each_view` look, which is everywhere if
//! [`super::extensions::all_understood`].

use serde_json::Value;

use super::extensions::{DRACO, GPU_INSTANCING};
use super::json::{array, each_mut, keep, new_numbers, number, renumber};

/// Takes out accessors and buffer views that nothing refers to, but for the first `least` of each, and numbers the others anew. Gives which
/// of the views stay; none, with the document untouched, when a reference is broken.
pub(crate) fn prune(json: &mut Value, least: [usize; 2]) -> Option<Vec<bool>> {
    let mut used_accessors = used(json, "accessors", each_accessor)?;
    used_accessors.iter_mut().take(least[0]).for_each(|used| *used = true);
    let mut pruned = json.clone();
    retain(&mut pruned, "accessors", &used_accessors, each_accessor);
    let mut used_views = used(&mut pruned, "bufferViews", each_view)?;
    used_views.iter_mut().take(least[1]).for_each(|used| *used = true);
    retain(&mut pruned, "bufferViews", &used_views, each_view);
    *json = pruned;
    Some(used_views)
}

type Each = fn(&mut Value, &mut dyn FnMut(&mut Value));

fn used(json: &mut Value, key: &str, each: Each) -> Option<Vec<bool>> {
    let mut used = vec![false; array(json, key).len()];
    let mut broken = false;
    each(json, &mut |index| match number(index).and_then(|i| used.get_mut(i)) {
        Some(used) => *used = true,
        None => broken = true,
    });
    (!broken).then_some(used)
}

/// Takes out what is not used, and numbers the others anew.
fn retain(json: &mut Value, key: &str, used: &[bool], each: Each) {
    if let Some(array) = json.get_mut(key).and_then(Value::as_array_mut) {
        keep(array, |index| used[index]);
        if array.is_empty()
            && let Some(root) = json.as_object_mut()
        {
            root.shift_remove(key);
        }
    }
    let new = new_numbers(used);
    each(json, &mut |index| renumber(index, &new));
}

/// Calls `f` with every reference to an accessor.
fn each_accessor(json: &mut Value, f: &mut dyn FnMut(&mut Value)) {
    for mesh in each_mut(json, "meshes") {
        for primitive in each_mut(mesh, "primitives") {
            fields(primitive.get_mut("attributes"), f);
            field(primitive, "indices", f);
            for target in each_mut(primitive, "targets") {
                fields(Some(target), f);
            }
        }
    }
    for animation in each_mut(json, "animations") {
        for sampler in each_mut(animation, "samplers") {
            field(sampler, "input", f);
            field(sampler, "output", f);
        }
    }
    for skin in each_mut(json, "skins") {
        field(skin, "inverseBindMatrices", f);
    }
    let instances = format!("/extensions/{GPU_INSTANCING}/attributes");
    for node in each_mut(json, "nodes") {
        fields(node.pointer_mut(&instances), f);
    }
}

/// Calls `f` with every reference to a buffer view.
fn each_view(json: &mut Value, f: &mut dyn FnMut(&mut Value)) {
    for accessor in each_mut(json, "accessors") {
        field(accessor, "bufferView", f);
        for part in ["indices", "values"] {
            if let Some(part) = accessor.get_mut("sparse").and_then(|s| s.get_mut(part)) {
                field(part, "bufferView", f);
            }
        }
    }
    for image in each_mut(json, "images") {
        field(image, "bufferView", f);
    }
    let stream = format!("/extensions/{DRACO}/bufferView");
    for mesh in each_mut(json, "meshes") {
        for primitive in each_mut(mesh, "primitives") {
            primitive.pointer_mut(&stream).into_iter().for_each(&mut *f);
        }
    }
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
