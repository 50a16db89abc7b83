//! Vector quantisation: a few vectors that stand for many (tree-structured: the cluster that loses most is divided across its longest axis).

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use crate::context::Context;
use crate::error::Result;

/// Rounds in which a division is improved, and in which its axis is.
const ROUNDS: usize = 3;
const POWER: usize = 6;

/// A vector and how much it counts.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighted<const D: usize> {
    pub(super) at: [f32; D],
    pub(super) weight: f32,
    /// What the caller knows it by.
    pub(super) index: u32,
}

struct Cluster<const D: usize> {
    members: Vec<Weighted<D>>,
    mean: [f32; D],
    /// Weighted sum of squared distances to the mean.
    loss: f64,
    /// Ties go by it.
    number: u32,
}

impl<const D: usize> PartialEq for Cluster<D> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl<const D: usize> Eq for Cluster<D> {}

impl<const D: usize> PartialOrd for Cluster<D> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<const D: usize> Ord for Cluster<D> {
    fn cmp(&self, other: &Self) -> Ordering {
        self.loss.total_cmp(&other.loss).then(other.number.cmp(&self.number))
    }
}

fn distance<const D: usize>(a: &[f32; D], b: &[f32; D]) -> f32 {
    (0..D).map(|k| (a[k] - b[k]).powi(2)).sum()
}

fn mean<const D: usize>(members: &[Weighted<D>]) -> [f32; D] {
    let (mut sum, mut weight) = ([0f64; D], 0f64);
    for member in members {
        weight += f64::from(member.weight);
        (0..D).for_each(|k| sum[k] += f64::from(member.weight * member.at[k]));
    }
    sum.map(|s| (s / weight.max(1e-30)) as f32)
}

impl<const D: usize> Cluster<D> {
    fn new(members: Vec<Weighted<D>>, number: u32) -> Self {
        let mean = mean(&members);
        let loss = members.iter().map(|m| f64::from(m.weight * distance(&m.at, &mean))).sum();
        Cluster { members, mean, loss, number }
    }

    /// Two parts, none of them empty; none where all members are one.
    fn divided(&self) -> Option<[Vec<Weighted<D>>; 2]> {
        let axis = self.axis()?;
        let along = |m: &Weighted<D>| (0..D).map(|k| (m.at[k] - self.mean[k]) * axis[k]).sum::<f32>();
        let mut is_high: Vec<bool> = self.members.iter().map(|m| along(m) > 0.0).collect();
        for _ in 0..ROUNDS {
            let side = |high: bool| -> Vec<Weighted<D>> {
                self.members.iter().zip(&is_high).filter(|(_, h)| **h == high).map(|(m, _)| *m).collect()
            };
            let parts = [side(false), side(true)];
            if parts.iter().any(Vec::is_empty) {
                break;
            }
            let [low, high] = [mean(&parts[0]), mean(&parts[1])];
            let next: Vec<bool> = self.members.iter().map(|m| distance(&m.at, &high) < distance(&m.at, &low)).collect();
            if next == is_high || next.iter().all(|h| *h) || !next.iter().any(|h| *h) {
                break;
            }
            is_high = next;
        }
        let mut parts = [Vec::new(), Vec::new()];
        for (member, high) in self.members.iter().zip(&is_high) {
            parts[usize::from(*high)].push(*member);
        }
        parts.iter().all(|p| !p.is_empty()).then_some(parts)
    }

    /// The longest axis: the largest eigenvector of the covariance.
    fn axis(&self) -> Option<[f32; D]> {
        let mut covariance = [[0f32; D]; D];
        for member in &self.members {
            let d: [f32; D] = std::array::from_fn(|k| member.at[k] - self.mean[k]);
            for i in 0..D {
                let wd = member.weight * d[i];
                for j in 0..D {
                    covariance[i][j] += wd * d[j];
                }
            }
        }
        let longest = (0..D).max_by(|a, b| covariance[*a][*a].total_cmp(&covariance[*b][*b]))?;
        let mut axis = covariance[longest];
        for _ in 0..POWER {
            let length = axis.iter().map(|v| v * v).sum::<f32>().sqrt();
            if length <= 0.0 || !length.is_finite() {
                return None;
            }
            let unit = axis.map(|v| v / length);
            axis = std::array::from_fn(|i| (0..D).map(|j| covariance[i][j] * unit[j]).sum());
        }
        Some(axis)
    }
}

/// Clusters: by cluster its mean and its members.
type Clusters<const D: usize> = Vec<([f32; D], Vec<Weighted<D>>)>;

/// At most `count` clusters of the vectors.
///
/// # Errors
/// `canceled`.
pub(super) fn clusters<const D: usize>(
    vectors: Vec<Weighted<D>>,
    count: usize,
    context: &Context,
) -> Result<Clusters<D>> {
    if vectors.is_empty() || count == 0 {
        return Ok(Vec::new());
    }
    let mut done = Vec::new();
    let mut heap = BinaryHeap::from([Cluster::new(vectors, 0)]);
    let mut number = 0;
    while heap.len() + done.len() < count {
        if number % 64 == 0 {
            context.check()?;
        }
        let Some(worst) = heap.pop() else { break };
        if worst.loss <= 0.0 {
            heap.push(worst);
            break;
        }
        match worst.divided() {
            Some(parts) => {
                let [low, high] = parts;
                heap.push(Cluster::new(low, number + 1));
                heap.push(Cluster::new(high, number + 2));
                number += 2;
            }
            None => done.push(worst),
        }
    }
    let mut all: Vec<Cluster<D>> = heap.into_iter().chain(done).collect();
    all.sort_unstable_by_key(|c| c.number);
    Ok(all.into_iter().map(|c| (c.mean, c.members)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heaps_are_found_and_no_member_is_lost() {
        let context = Context::silent();
        let vectors: Vec<Weighted<2>> = (0..400u32)
            .map(|i| {
                let heap = f32::from((i % 4) as u8);
                let jitter = (i.wrapping_mul(2_654_435_761) >> 24) as f32 / 512.0;
                Weighted { at: [100.0 * heap + jitter, -50.0 * heap * heap], weight: 1.0 + heap, index: i }
            })
            .collect();
        let found = clusters(vectors.clone(), 4, &context).unwrap();
        assert_eq!(found.len(), 4);
        assert!(found.iter().all(|(_, members)| members.len() == 100 && members.iter().all(|m| m.index % 4 == members[0].index % 4)));
        let finer = clusters(vectors.clone(), 90, &context).unwrap();
        let mut indices: Vec<u32> = finer.iter().flat_map(|(_, m)| m.iter().map(|m| m.index)).collect();
        indices.sort_unstable();
        assert_eq!(indices, (0..400).collect::<Vec<_>>());
        // There are no more clusters than different vectors.
        let same = vec![Weighted { at: [1.0, 2.0], weight: 1.0, index: 0 }; 9];
        assert_eq!(clusters(same, 5, &context).unwrap().len(), 1);
        assert!(
            clusters::<2>(Vec::new(), 5, &context).unwrap().is_empty()
                && clusters(vectors, 0, &context).unwrap().is_empty()
        );
    }
}
