//! A set of UV triangles that grows, and tells whether another triangle overlaps one of it.
//!
//! Triangles are kept in trees of falling size; two of like size become one, so that adding n triangles one by one costs
//! n log^2 n, whatever their sizes and places.

use std::sync::Arc;

use glam::DVec2;

use super::bvh::{Bounds, TriangleTree};
use super::overlap::triangles_overlap;

/// Triangles that are tested one by one before they are worth a tree.
const LOOSE: usize = 24;

/// The set. Cloning is cheap: trees are shared.
#[derive(Debug, Clone, Default)]
pub(crate) struct DynamicTriangleSet {
    trees: Vec<Arc<TriangleTree>>,
    loose: Vec<[DVec2; 3]>,
}

impl DynamicTriangleSet {
    /// Adds triangles. Those without area, or with coordinates that are not finite, never overlap anything.
    pub(crate) fn add(&mut self, triangles: impl IntoIterator<Item = [DVec2; 3]>) {
        self.loose.extend(triangles.into_iter().filter(|t| t.iter().all(|p| p.is_finite())));
        if self.loose.len() <= LOOSE {
            return;
        }
        let mut all = std::mem::take(&mut self.loose);
        while let Some(last) = self.trees.pop_if(|last| last.triangles.len() < 2 * all.len()) {
            all.extend(&last.triangles);
        }
        self.trees.push(Arc::new(TriangleTree::new(&all)));
    }

    /// Whether a triangle of the set for which `counts` holds overlaps `triangle`, and how many were looked at.
    pub(crate) fn hits(&self, triangle: &[DVec2; 3], counts: impl Fn(&[DVec2; 3]) -> bool) -> (bool, u64) {
        let mut looked = self.loose.len() as u64;
        if !triangle.iter().all(|p| p.is_finite()) {
            return (false, 1);
        }
        if self.loose.iter().any(|t| counts(t) && triangles_overlap(t, triangle)) {
            return (true, looked);
        }
        let query = Bounds::of(triangle);
        let mut hit = false;
        for part in &self.trees {
            looked += 1;
            let visit = |p: usize| {
                looked += 1;
                hit = counts(&part.triangles[p]) && triangles_overlap(&part.triangles[p], triangle);
                !hit
            };
            part.tree.query(&query, 0, visit);
            if hit {
                break;
            }
        }
        (hit, looked)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;

    #[test]
    fn it_says_what_testing_all_says() {
        let mut rng = Rng(9);
        let (mut set, mut all) = (DynamicTriangleSet::default(), Vec::new());
        let (mut hits, mut misses) = (0, 0);
        for n in 0..600 {
            let p = rng.point(100.0);
            let t = [p, p + rng.point(5.0), p + rng.point(5.0)];
            let expected = all.iter().any(|o| triangles_overlap(o, &t));
            assert_eq!(set.hits(&t, |_| true).0, expected, "{n}");
            if expected {
                hits += 1
            } else {
                misses += 1
            }
            set.add([t]);
            all.push(t);
        }
        assert!(hits > 50 && misses > 50);
        assert!(set.trees.len() < 10);
    }
}
