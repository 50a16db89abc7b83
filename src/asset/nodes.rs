//! The scene graph: what nodes, scenes and skins name exists, and no node is below itself.

use glam::{DMat4, DQuat, DVec3};
use serde_json::Value;

use super::json::{array, index, number};
use crate::error::{Failure, Result};

/// Nodes below each other, at most.
pub(crate) const DEEPEST: usize = 10_000;

/// By mesh, the transforms of the nodes that show it, from its space to the scene's: in the default scene, or in the first, or where there is
/// none from all nodes that are no children; at most `limit` of each mesh. Bones and `EXT_mesh_gpu_instancing` are not followed.
pub fn mesh_instances(json: &Value, limit: usize) -> Vec<Vec<DMat4>> {
    let nodes = array(json, "nodes");
    let mut instances = vec![Vec::new(); array(json, "meshes").len()];
    let scenes = array(json, "scenes");
    let scene = scenes.get(json.get("scene").and_then(number).unwrap_or(0));
    let roots: Vec<usize> = match scene {
        Some(scene) => array(scene, "nodes").iter().filter_map(number).collect(),
        None => {
            let children = nodes.iter().flat_map(|node| array(node, "children")).filter_map(number);
            let children: std::collections::BTreeSet<usize> = children.collect();
            (0..nodes.len()).filter(|n| !children.contains(n)).collect()
        }
    };
    let mut seen = vec![false; nodes.len()];
    let mut stack: Vec<(usize, DMat4, usize)> = roots.into_iter().rev().map(|n| (n, DMat4::IDENTITY, 0)).collect();
    while let Some((n, parent, depth)) = stack.pop() {
        let Some(node) = nodes.get(n).filter(|_| depth <= DEEPEST && !std::mem::replace(&mut seen[n], true)) else {
            continue;
        };
        let world = parent * local(node);
        let children = array(node, "children").iter().rev().filter_map(number);
        stack.extend(children.map(|child| (child, world, depth + 1)));
        if let Some(own) = node.get("mesh").and_then(number).and_then(|m| instances.get_mut(m))
            && own.len() < limit
            && world.is_finite()
        {
            own.push(world);
        }
    }
    instances
}

/// A node's transform.
pub(crate) fn local(node: &Value) -> DMat4 {
    let numbers = |key: &str| -> Option<Vec<f64>> { node.get(key)?.as_array()?.iter().map(Value::as_f64).collect() };
    if let Some(Ok(matrix)) = numbers("matrix").map(<[f64; 16]>::try_from) {
        return DMat4::from_cols_array(&matrix);
    }
    let three = |key: &str, default: DVec3| {
        numbers(key).and_then(|v| <[f64; 3]>::try_from(v).ok()).map_or(default, DVec3::from_array)
    };
    let rotation =
        numbers("rotation").and_then(|v| <[f64; 4]>::try_from(v).ok()).map_or(DQuat::IDENTITY, DQuat::from_array);
    let rotation = if rotation.length_squared() > 0.0 { rotation.normalize() } else { DQuat::IDENTITY };
    DMat4::from_scale_rotation_translation(three("scale", DVec3::ONE), rotation, three("translation", DVec3::ZERO))
}

/// Checks the references among nodes, scenes, skins, meshes and cameras (glTF 2.0, section 3.5). Intarsia walks no scene
/// itself; others that do would fail on what it hands back.
///
/// # Errors
/// `invalid_model` with the pointer of a reference that names nothing, or that closes a circle.
pub(crate) fn check(json: &Value) -> Result<()> {
    let nodes = array(json, "nodes");
    let count = |key: &str| array(json, key).len();
    let children = nodes.iter().enumerate().map(|(n, node)| {
        for (key, plural) in [("mesh", "meshes"), ("skin", "skins"), ("camera", "cameras")] {
            index(node, key, count(plural), &format!("/nodes/{n}"))?;
        }
        indices(node, "children", nodes.len(), &format!("/nodes/{n}"))
    });
    let children: Vec<Vec<usize>> = children.collect::<Result<_>>()?;
    for (s, scene) in array(json, "scenes").iter().enumerate() {
        indices(scene, "nodes", nodes.len(), &format!("/scenes/{s}"))?;
    }
    for (s, skin) in array(json, "skins").iter().enumerate() {
        indices(skin, "joints", nodes.len(), &format!("/skins/{s}"))?;
    }
    no_circle(&children)
}

/// The indices listed under `key`.
fn indices(value: &Value, key: &str, count: usize, pointer: &str) -> Result<Vec<usize>> {
    let listed = array(value, key).iter().enumerate();
    listed.map(|(i, found)| super::json::checked(found, count, || format!("{pointer}/{key}/{i}"))).collect()
}

/// Depth first, with a stack of its own: graphs may be as deep as they have nodes.
fn no_circle(children: &[Vec<usize>]) -> Result<()> {
    #[derive(Clone, Copy, PartialEq)]
    enum VisitState {
        New,
        Open,
        Done,
    }
    let mut state = vec![VisitState::New; children.len()];
    for root in 0..children.len() {
        let mut path: Vec<(usize, usize)> = Vec::new();
        if state[root] == VisitState::New {
            state[root] = VisitState::Open;
            path.push((root, 0));
        }
        while let Some((node, next)) = path.last_mut() {
            let Some(&child) = children[*node].get(*next) else {
                state[*node] = VisitState::Done;
                path.pop();
                continue;
            };
            if state[child] == VisitState::Open {
                let text = format!("node {child} is its own descendant: the nodes form a circle");
                return Err(Failure::model(text).at(format!("/nodes/{node}/children/{next}")));
            }
            *next += 1;
            if state[child] == VisitState::New {
                state[child] = VisitState::Open;
                path.push((child, 0));
            }
        }
    }
    Ok(())
}
