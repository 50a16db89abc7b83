//! The nearest of many vectors, about: those of the groups whose means are nearest are looked at.

use super::clusters::{Weighted, clusters};
use crate::context::Context;
use crate::error::Result;

/// Groups that are looked at.
const GROUPS: usize = 8;

/// Vectors in groups.
pub(super) struct Nearest<const D: usize> {
    groups: Vec<([f32; D], Vec<Weighted<D>>)>,
}

impl<const D: usize> Nearest<D> {
    /// About as many groups as each has members.
    ///
    /// # Errors
    /// `canceled`.
    pub(super) fn new(vectors: impl Iterator<Item = [f32; D]>, context: &Context) -> Result<Self> {
        let all: Vec<Weighted<D>> =
            vectors.enumerate().map(|(i, at)| Weighted { at, weight: 1.0, index: i as u32 }).collect();
        let count = (all.len() as f64).sqrt().ceil() as usize;
        Ok(Nearest { groups: clusters(all, count, context)? })
    }

    /// The nearest `K` vectors, from the nearest on; fewer where there are fewer.
    pub(super) fn of<const K: usize>(&self, at: &[f32; D]) -> impl Iterator<Item = u32> + use<D, K> {
        let mut near = Best::<GROUPS>::new();
        for (i, (mean, _)) in self.groups.iter().enumerate() {
            near.offer(distance(mean, at), i as u32);
        }
        let mut best = Best::<K>::new();
        for group in near.indices() {
            for member in &self.groups[group as usize].1 {
                best.offer(distance(&member.at, at), member.index);
            }
        }
        best.indices()
    }
}

fn distance<const D: usize>(a: &[f32; D], b: &[f32; D]) -> f32 {
    let mut sum = 0.0;
    for k in 0..D {
        sum += (a[k] - b[k]) * (a[k] - b[k]);
    }
    sum
}

/// The least of what is offered.
struct Best<const K: usize> {
    all: [(f32, u32); K],
    count: usize,
}

impl<const K: usize> Best<K> {
    fn new() -> Self {
        Best { all: [(f32::INFINITY, 0); K], count: 0 }
    }

    fn offer(&mut self, distance: f32, index: u32) {
        if self.count == K && distance >= self.all[K - 1].0 {
            return;
        }
        let mut at = self.count.min(K - 1);
        while at > 0 && self.all[at - 1].0 > distance {
            self.all[at] = self.all[at - 1];
            at -= 1;
        }
        self.all[at] = (distance, index);
        self.count = (self.count + 1).min(K);
    }

    fn indices(self) -> impl Iterator<Item = u32> {
        self.all.into_iter().take(self.count).map(|(_, index)| index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn most_of_the_nearest_are_found() {
        let value = |i: u32| (i.wrapping_mul(2_654_435_761) >> 8) as f32 / 65_536.0;
        let vectors: Vec<[f32; 3]> = (0..900).map(|i| [value(3 * i), value(3 * i + 1), value(3 * i + 2)]).collect();
        let nearest = Nearest::new(vectors.iter().copied(), &Context::silent()).unwrap();
        let mut found = 0;
        for i in 0..200 {
            let at = [value(i + 5000), value(2 * i + 9000), value(7 * i)];
            let mut order: Vec<u32> = (0..900).collect();
            order.sort_by(|a, b| distance(&vectors[*a as usize], &at).total_cmp(&distance(&vectors[*b as usize], &at)));
            let told: Vec<u32> = nearest.of::<4>(&at).collect();
            assert!(
                told.windows(2)
                    .all(|w| distance(&vectors[w[0] as usize], &at) <= distance(&vectors[w[1] as usize], &at))
            );
            found += usize::from(told[0] == order[0]);
        }
        assert!(found > 190, "{found}");
        assert_eq!(
            Nearest::new(vectors[..2].iter().copied(), &Context::silent()).unwrap().of::<5>(&[0.0; 3]).count(),
            2
        );
    }
}
