//! Draw calls: primitives of one mesh, and meshes of nodes that never move, drawn at once where nothing but their place differs.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat4, DVec3};
use serde_json::Value;

use super::join::{joined, key};
use super::shown;
use crate::asset::Document;
use crate::asset::json::{array, each_mut, keep, new_numbers, number, renumber};
use crate::asset::nodes::{DEEPEST, local};
use crate::asset::precision::{bounding_box, is_far, remoteness};
use crate::asset::primitive::{declared_triangles, primitive_pointer};
use crate::asset::read_vec3;
use crate::error::Result;

/// A mesh that several nodes show is copied into another only where it has no more triangles than this.
const MOST_COPIED: u64 = 256;

/// Puts primitives of each mesh together.
///
/// # Errors
/// `invalid_model` for broken accessors.
pub(super) fn within_meshes(doc: &mut Document) -> Result<()> {
    for m in 0..array(&doc.json, "meshes").len() {
        let primitives =
            array(doc.json.pointer(&format!("/meshes/{m}")).unwrap_or(&Value::Null), "primitives").to_vec();
        let mut groups: Vec<(Option<String>, Vec<Value>)> = Vec::new();
        for primitive in primitives {
            let key = key(doc, &primitive, false)?;
            match groups.iter_mut().find(|(k, _)| k.is_some() && *k == key) {
                Some((_, own)) => own.push(primitive),
                None => groups.push((key, vec![primitive])),
            }
        }
        if groups.iter().all(|(_, own)| own.len() == 1) {
            continue;
        }
        let mut fresh = Vec::new();
        for (_, own) in groups {
            fresh.push(match <[Value; 1]>::try_from(own) {
                Ok([one]) => one,
                Err(own) => joined(doc, &own.into_iter().map(|p| (p, None)).collect::<Vec<_>>())?,
            });
        }
        doc.json["meshes"][m]["primitives"] = Value::Array(fresh);
    }
    Ok(())
}

/// A node that shows a mesh and never moves.
struct StaticNode {
    node: usize,
    mesh: usize,
    /// From the node's space to the scene's.
    world: DMat4,
}

/// Puts primitives of nodes that never move together, into the mesh of the first. Nodes stay, whatever hangs from them too.
///
/// # Errors
/// `invalid_model` for broken accessors.
pub(super) fn across_nodes(doc: &mut Document) -> Result<()> {
    let static_nodes = static_nodes(&doc.json);
    let mut uses: BTreeMap<usize, usize> = BTreeMap::new();
    shown(&doc.json).for_each(|m| *uses.entry(m).or_default() += 1);
    // By key: the primitives, as (index into `static_nodes`, primitive).
    let mut groups: BTreeMap<String, Vec<(usize, usize)>> = BTreeMap::new();
    for (s, still) in static_nodes.iter().enumerate() {
        let mesh = doc.json.pointer(&format!("/meshes/{}", still.mesh)).unwrap_or(&Value::Null);
        for (p, primitive) in array(mesh, "primitives").iter().enumerate() {
            let shared = uses.get(&still.mesh).is_some_and(|n| *n > 1);
            if shared && declared_triangles(&doc.json, primitive) > MOST_COPIED {
                continue;
            }
            if let Some(key) = key(doc, primitive, true)? {
                groups.entry(key).or_default().push((s, p));
            }
        }
    }
    let mut order = Vec::new();
    for group in groups.into_values() {
        let near = neighbourhoods(doc, &static_nodes, group)?;
        order.extend(near.into_iter().filter(|g| g.iter().any(|m| m.0 != g[0].0)));
    }
    order.sort();
    // By still: what its primitives become; none for those that went elsewhere.
    let mut fresh: BTreeMap<usize, Vec<Option<Value>>> = BTreeMap::new();
    for group in order {
        let host = &static_nodes[group[0].0];
        let inverse = host.world.inverse();
        if !inverse.is_finite() {
            continue;
        }
        let mut parts = Vec::new();
        for &(s, p) in &group {
            let still = &static_nodes[s];
            let value = doc.json.pointer(&primitive_pointer(still.mesh, p)).cloned().unwrap_or(Value::Null);
            // The host's own stay bit by bit.
            let transform = (still.node != host.node).then(|| inverse * still.world);
            parts.push((value, transform));
        }
        let one = joined(doc, &parts)?;
        for &(s, p) in &group {
            let mesh = doc.json.pointer(&format!("/meshes/{}", static_nodes[s].mesh)).unwrap_or(&Value::Null);
            let uploaded = || array(mesh, "primitives").iter().cloned().map(Some).collect();
            fresh.entry(s).or_insert_with(uploaded)[p] = None;
        }
        if let Some(own) = fresh.get_mut(&group[0].0) {
            own[group[0].1] = Some(one);
        }
    }
    for (s, primitives) in fresh {
        let left: Vec<Value> = primitives.into_iter().flatten().collect();
        let node = static_nodes[s].node;
        if left.is_empty() {
            if let Some(object) = doc.json["nodes"][node].as_object_mut() {
                object.shift_remove("mesh");
            }
            continue;
        }
        let mut mesh = static_nodes[s].mesh;
        if uses.get(&mesh).is_some_and(|n| *n > 1) {
            let clone = doc.json["meshes"][mesh].clone();
            mesh = doc.push("meshes", clone);
            doc.json["nodes"][node]["mesh"] = Value::from(mesh);
        }
        doc.json["meshes"][mesh]["primitives"] = Value::Array(left);
    }
    drop_unused_meshes(doc, &uses);
    Ok(())
}

/// Neighbourhoods of one group that primitives are tried in, the latest first.
const MOST_TRIED: usize = 16;

/// A group by where its primitives are: what lies so far from the first of a neighbourhood that 32 bits would not hold its shape in that one's space begins
/// one of its own.
fn neighbourhoods(
    doc: &Document,
    nodes: &[StaticNode],
    group: Vec<(usize, usize)>,
) -> Result<Vec<Vec<(usize, usize)>>> {
    let mut all: Vec<(DMat4, Vec<(usize, usize)>)> = Vec::new();
    for (s, p) in group {
        let (low, high) = own_box(doc, nodes[s].mesh, p)?;
        let stays_near = |inverse: &DMat4| {
            let own = *inverse * nodes[s].world;
            let corner =
                |i: usize| DVec3::from_array(std::array::from_fn(|k| if i >> k & 1 == 0 { low[k] } else { high[k] }));
            let moved = bounding_box((0..8).map(|i| own.transform_point3(corner(i)).to_array()));
            // What was far away in its own space loses nothing more.
            !is_far(moved.0, moved.1) || remoteness(moved.0, moved.1) <= 2.0 * remoteness(low, high)
        };
        let near = all.iter_mut().rev().take(MOST_TRIED).find(|(inverse, _)| stays_near(inverse));
        match near {
            Some((_, own)) => own.push((s, p)),
            None => all.push((nodes[s].world.inverse(), vec![(s, p)])),
        }
    }
    Ok(all.into_iter().map(|(_, own)| own).collect())
}

/// The box of a primitive in the space of its node.
fn own_box(doc: &Document, mesh: usize, primitive: usize) -> Result<([f64; 3], [f64; 3])> {
    let attributes = doc.json.pointer(&format!("{}/attributes", primitive_pointer(mesh, primitive)));
    let Some(accessor) = attributes.and_then(|a| a.get("POSITION")).and_then(number) else {
        return Ok(bounding_box(std::iter::empty()));
    };
    Ok(bounding_box(read_vec3(doc, accessor)?.into_iter().map(|p| p.map(f64::from))))
}

/// Takes out the meshes that no node shows any more.
fn drop_unused_meshes(doc: &mut Document, before: &BTreeMap<usize, usize>) {
    let after: BTreeSet<usize> = shown(&doc.json).collect();
    let count = array(&doc.json, "meshes").len();
    let kept: Vec<bool> = (0..count).map(|m| after.contains(&m) || !before.contains_key(&m)).collect();
    if let Some(meshes) = doc.json.get_mut("meshes").and_then(Value::as_array_mut) {
        keep(meshes, |m| kept[m]);
    }
    let new = new_numbers(&kept);
    each_mut(&mut doc.json, "nodes").filter_map(|n| n.get_mut("mesh")).for_each(|mesh| renumber(mesh, &new));
}

/// Nodes with a mesh, without skin, weights or extensions, that no animation moves, nor what they hang from, in the order of
/// the one scene; empty where there are several.
fn static_nodes(json: &Value) -> Vec<StaticNode> {
    let (nodes, scenes) = (array(json, "nodes"), array(json, "scenes"));
    let [scene] = scenes else { return Vec::new() };
    let node_number = |v: &Value| number(v).filter(|n| *n < nodes.len());
    let mut moving: BTreeSet<usize> = BTreeSet::new();
    for animation in array(json, "animations") {
        moving.extend(
            array(animation, "channels").iter().filter_map(|c| c.pointer("/target/node").and_then(node_number)),
        );
        // A pointer may move anything.
        let pointers = array(animation, "channels").iter();
        if pointers.into_iter().any(|c| c.pointer("/target/extensions").is_some()) {
            return Vec::new();
        }
    }
    for skin in array(json, "skins") {
        moving.extend(array(skin, "joints").iter().filter_map(node_number));
    }
    let mut seen = BTreeSet::new();
    let mut out = Vec::new();
    let mut stack: Vec<(usize, DMat4, usize)> = Vec::new();
    stack.extend(array(scene, "nodes").iter().rev().filter_map(node_number).map(|n| (n, DMat4::IDENTITY, 0)));
    while let Some((n, parent, depth)) = stack.pop() {
        if !seen.insert(n) || depth > DEEPEST || moving.contains(&n) {
            continue;
        }
        let node = &nodes[n];
        let world = parent * local(node);
        stack.extend(array(node, "children").iter().rev().filter_map(node_number).map(|c| (c, world, depth + 1)));
        let plain = ["skin", "weights", "extensions"].iter().all(|k| node.get(*k).is_none());
        let mesh = node.get("mesh").and_then(number);
        let mesh = mesh.filter(|m| array(json, "meshes").get(*m).is_some_and(|mesh| mesh.get("weights").is_none()));
        if let Some(mesh) = mesh.filter(|_| plain && world.is_finite()) {
            out.push(StaticNode { node: n, mesh, world });
        }
    }
    out
}
