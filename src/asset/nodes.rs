//! The scene graph: what nodes, scenes and skins name exists, and no node is below itself.

use serde_json::Value;

use super::json::{array, index};
use crate::error::{Failure, Result};

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
