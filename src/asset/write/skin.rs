//! Joints and weights of vertices between others.

use std::collections::BTreeMap;

use serde_json::{Map, Value};

use super::vertices::Point;
use crate::asset::accessor::{RawAccessor, raw_elements, read_vec};
use crate::asset::{ComponentType, Document, Kind};
use crate::error::{Failure, Result};

/// One pair JOINTS_n, WEIGHTS_n, with the component type of the joints.
type Pair = (Vec<[u32; 4]>, ComponentType, Vec<[f32; 4]>);

/// JOINTS_n and WEIGHTS_n for all vertices of a pool, by name; nothing where the primitive is not skinned. Influences of the
/// same joint are merged at `points`, the strongest kept (as many as the primitive has room for: four a set), and weights
/// made to sum to one.
///
/// # Errors
/// `invalid_model` for joints that are no unsigned integers, and those of the accessors.
pub(super) fn influences(
    attributes: &Map<String, Value>,
    points: &[Point],
    checked: impl Fn(&str, &Value) -> Result<usize>,
    doc: &Document,
) -> Result<BTreeMap<String, RawAccessor>> {
    let mut sets: Vec<Pair> = Vec::new();
    let mut names = Vec::new();
    loop {
        let pair = [format!("JOINTS_{}", sets.len()), format!("WEIGHTS_{}", sets.len())];
        let (Some(j), Some(w)) = (attributes.get(&pair[0]), attributes.get(&pair[1])) else { break };
        let (j, w) = (checked(&pair[0], j)?, checked(&pair[1], w)?);
        let raw = raw_elements(doc, j)?;
        let joints = joints(&raw).ok_or_else(|| {
            Failure::model("joints are a VEC4 of 8 or 16 bit unsigned integers").at(format!("/accessors/{j}"))
        })?;
        sets.push((joints, raw.component_type, read_vec::<4>(doc, w)?));
        names.push(pair);
    }
    for point in points {
        let merged = merge(&sets, point);
        for (s, (joints, _, weights)) in sets.iter_mut().enumerate() {
            let at = |k: usize| merged.get(4 * s + k).copied().unwrap_or_default();
            joints.push(std::array::from_fn(|k| at(k).0));
            weights.push(std::array::from_fn(|k| at(k).1));
        }
    }
    let mut ready = BTreeMap::new();
    for ([j, w], (joints, component, weights)) in names.into_iter().zip(sets) {
        ready.insert(j, RawAccessor::from_unsigned(component, Kind::Vec4, joints.as_flattened()));
        ready.insert(w, RawAccessor::from_floats(&weights));
    }
    Ok(ready)
}

/// The influences at a point, strongest first, cut to the room there is.
fn merge(sets: &[Pair], point: &Point) -> Vec<(u32, f32)> {
    let (sources, n) = point.weights();
    let element = |v: u32| {
        sets.iter().flat_map(move |(joints, _, weights)| {
            let joints = joints.get(v as usize).copied().unwrap_or_default();
            let weights = weights.get(v as usize).copied().unwrap_or_default();
            joints.into_iter().zip(weights)
        })
    };
    if let Point::Vertex(v) = *point {
        return element(v).collect();
    }
    let mut sum: BTreeMap<u32, f64> = BTreeMap::new();
    for (v, share) in &sources[..n] {
        for (joint, weight) in element(*v).filter(|(_, w)| *w > 0.0) {
            *sum.entry(joint).or_default() += f64::from(weight) * share;
        }
    }
    let mut merged: Vec<(u32, f64)> = sum.into_iter().collect();
    merged.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    merged.truncate(4 * sets.len());
    let total: f64 = merged.iter().map(|m| m.1).sum();
    merged.iter().map(|(joint, weight)| (*joint, (weight / total) as f32)).collect()
}

fn joints(raw: &RawAccessor) -> Option<Vec<[u32; 4]>> {
    let narrow = matches!(raw.component_type, ComponentType::U8 | ComponentType::U16);
    let all = raw.unsigned().filter(|_| narrow && raw.kind.multiplicity() == 4)?;
    Some(all.as_chunks().0.to_vec())
}
