//! ETC1S: the blocks of all levels tell endpoints and patterns of two palettes by number. Blocks that an upload has are taken over as they are;
//! for the others the palettes get entries, and each block the pair that costs least in error and bits.

use rayon::prelude::*;

use super::block::{Endpoint, Errors, Pattern, Texels, best_pattern, error_below, fit, selector};
use super::clusters::{Weighted, clusters};
use super::in_parts;
use super::nearest::Nearest;
use super::uploaded::{KnownBlocks, Uploaded};
use crate::context::Context;
use crate::error::Result;

/// Entries that a palette may have: numbers are symbols of codes with 14 bits of them, some of which mean something else.
pub(super) const MOST: usize = 16_128;
/// Blocks for each entry of a new palette, and the fewest entries.
const BLOCKS_AN_ENDPOINT: usize = 20;
const BLOCKS_A_PATTERN: usize = 12;
const LEAST: usize = 64;
/// Different vectors that a palette is learned from.
const LEARNED: usize = 1 << 16;
/// Entries that are tried for each block.
const ENDPOINTS: usize = 6;
const PATTERNS: usize = 6;
/// Patterns that were used last and can be told in fewer bits.
pub(super) const HISTORY: usize = 64;
/// What a bit may cost: of the mean error of a block, and at least, in squared steps of a block's samples.
const BIT: f64 = 0.02;
const LEAST_BIT: f64 = 2.0;

/// One channel group of a level.
#[derive(Debug)]
pub(super) struct Slice {
    /// Blocks in a row, and rows.
    pub(super) size: [usize; 2],
    /// Whether it is alpha, as greys: readers look at green alone.
    pub(super) alpha: bool,
    pub(super) blocks: Vec<Texels>,
}

/// Endpoints and patterns.
#[derive(Debug, Default)]
pub(super) struct Palettes {
    pub(super) endpoints: Vec<Endpoint>,
    pub(super) patterns: Vec<Pattern>,
}

/// A block's numbers in the palettes.
pub(super) type Pair = [u32; 2];

/// Palettes, and by slice the numbers of its blocks.
///
/// # Errors
/// `canceled`.
pub(super) fn encode(slices: &[Slice], uploads: &[&Uploaded], context: &Context) -> Result<(Palettes, Vec<Vec<Pair>>)> {
    let (blocks, is_alpha): (Vec<&Texels>, Vec<bool>) =
        slices.iter().flat_map(|s| s.blocks.iter().map(|b| (b, s.alpha))).unzip();
    let of_blocks = KnownBlocks::new(uploads);
    let mut known = in_parts(blocks.len(), context, |i| of_blocks.pair(blocks[i], is_alpha[i]))?;
    let mut endpoints = kept(known.iter().flatten().map(|(endpoint, _)| *endpoint));
    let mut patterns = kept(known.iter().flatten().map(|(_, pattern)| *pattern));
    for block in &mut known {
        *block = block.filter(|(e, p)| endpoints.binary_search(e).is_ok() && patterns.binary_search(p).is_ok());
    }
    let fits = in_parts(blocks.len(), context, |i| known[i].is_none().then(|| fit(blocks[i])))?;
    let free = fits.iter().flatten().count();
    let [for_endpoints, for_patterns] = budgets(uploads, free);

    let learned = counted(fits.iter().flatten().map(|(endpoint, ..)| *endpoint)).map(|(endpoint, count)| Weighted {
        at: endpoint.span(),
        weight: count as f32,
        index: 0,
    });
    let found = clusters(sampled(learned.collect()), for_endpoints.min(MOST - endpoints.len()), context)?;
    endpoints.extend(found.iter().map(|(mean, _)| Endpoint::of_span(mean)));
    endpoints.sort_unstable();
    endpoints.dedup();
    let endpoints = chain(endpoints, |e| e.span(), |a, b| (0..6).map(|k| (a[k] - b[k]).powi(2)).sum());
    context.check()?;

    let near = Nearest::new(endpoints.iter().map(|e| e.span()), context)?;
    let two = |i: usize| fits[i].map_or([0; 2], |(ideal, ..)| two_best(&near, &endpoints, ideal, blocks[i]));
    let chosen = in_parts(blocks.len(), context, two)?;
    let wanted = |i: usize| positions(endpoints[chosen[i][0] as usize], blocks[i]);
    let of_free = fits.iter().enumerate().filter(|(_, fit)| fit.is_some()).map(|(i, _)| i).collect();
    let learned = sampled(of_free).into_par_iter().map(|i| {
        let span = endpoints[chosen[i][0] as usize].span();
        Weighted { at: wanted(i), weight: (span[3] - span[0]).powi(2), index: 0 }
    });
    let found = clusters(learned.collect(), for_patterns.min(MOST - patterns.len()), context)?;
    patterns.extend(found.iter().map(|(mean, _)| rounded(mean)));
    patterns.sort_unstable();
    patterns.dedup();
    let patterns = chain(patterns, |p| *p, |a, b| (a ^ b).count_ones() as f32);
    context.check()?;

    let near = Nearest::new(patterns.iter().map(|p| std::array::from_fn(|i| selector(*p, i) as f32)), context)?;
    let palettes = Palettes { endpoints: endpoints.clone(), patterns };
    let number = Numbers::new(&palettes);
    let candidates = in_parts(blocks.len(), context, |i| match known[i] {
        Some((endpoint, pattern)) => Candidates::Known(number.of(endpoint, pattern)),
        None => Candidates::Free { endpoints: chosen[i], patterns: padded(near.of::<PATTERNS>(&wanted(i))) },
    })?;
    // What is lost where bits cost nothing.
    let least = |i: usize| match &candidates[i] {
        Candidates::Known(_) => 0.0,
        Candidates::Free { endpoints, patterns } => {
            let errors = palettes.endpoints[endpoints[0] as usize].errors(blocks[i]);
            let error = |p: &u32| error_below(&errors, palettes.patterns[*p as usize], f64::INFINITY);
            f64::from(patterns.iter().filter_map(error).min().unwrap_or(0))
        }
    };
    let lost: f64 = in_parts(blocks.len(), context, least)?.iter().sum();
    let bit = (BIT * lost / free.max(1) as f64).max(LEAST_BIT);
    let mut rest = &candidates[..];
    let parts: Vec<(&Slice, &[Candidates])> = slices
        .iter()
        .map(|slice| {
            let (own, after) = rest.split_at(slice.blocks.len());
            rest = after;
            (slice, own)
        })
        .collect();
    let chosen = |(slice, candidates)| choose(slice, candidates, &palettes, bit, context);
    let pairs = parts.into_par_iter().map(chosen).collect::<Result<_>>()?;
    Ok((palettes, pairs))
}

/// What a block may become.
#[derive(Debug)]
enum Candidates {
    /// This.
    Known(Pair),
    /// One of these, or what stands about it.
    Free { endpoints: [u32; 2], patterns: [u32; PATTERNS] },
}

/// Entries for blocks that are free: as many for each block as the uploads have.
fn budgets(uploads: &[&Uploaded], free: usize) -> [usize; 2] {
    if uploads.is_empty() {
        return [BLOCKS_AN_ENDPOINT, BLOCKS_A_PATTERN].map(|blocks| (free / blocks).max(LEAST).min(free));
    }
    let counts = uploads.iter().map(|u| u.counts()).fold([0; 3], |a, b| [a[0] + b[0], a[1] + b[1], a[2] + b[2]]);
    [counts[0], counts[1]].map(|n| (n * free).div_ceil(counts[2].max(1)).max(LEAST).min(free))
}

/// Different values, the most frequent where there are too many, in their order.
fn kept<T: Ord + Copy>(values: impl Iterator<Item = T>) -> Vec<T> {
    let mut all: Vec<(T, usize)> = counted(values).collect();
    if all.len() > MOST {
        all.sort_by_key(|(value, count)| (std::cmp::Reverse(*count), *value));
        all.truncate(MOST);
        all.sort_unstable();
    }
    all.into_iter().map(|(value, _)| value).collect()
}

/// Different values in their order, and how often they occur.
fn counted<T: Ord + Copy>(values: impl Iterator<Item = T>) -> impl Iterator<Item = (T, usize)> {
    let mut all: Vec<T> = values.collect();
    all.sort_unstable();
    let groups: Vec<(T, usize)> = all.chunk_by(|a, b| a == b).map(|group| (group[0], group.len())).collect();
    groups.into_iter()
}

/// At most [`LEARNED`] of all, at equal distances.
fn sampled<T>(all: Vec<T>) -> Vec<T> {
    let step = all.len().div_ceil(LEARNED).max(1);
    all.into_iter().step_by(step).collect()
}

/// An order in which neighbours are alike: from each the nearest that is left.
fn chain<T: Copy, K: Copy + Sync>(all: Vec<T>, key: impl Fn(&T) -> K, distance: impl Fn(&K, &K) -> f32) -> Vec<T> {
    let mut rest: Vec<(T, K)> = all.iter().map(|t| (*t, key(t))).collect();
    let mut out = Vec::with_capacity(all.len());
    let mut at = 0;
    while !rest.is_empty() {
        let (value, from) = rest.swap_remove(at);
        out.push(value);
        let mut best = (f32::INFINITY, 0);
        for (i, (_, to)) in rest.iter().enumerate() {
            let d = distance(&from, to);
            if d < best.0 {
                best = (d, i);
            }
        }
        at = best.1;
    }
    out
}

/// The two endpoints that lose least when each texel takes the best of their colours.
fn two_best(near: &Nearest<6>, endpoints: &[Endpoint], ideal: Endpoint, texels: &Texels) -> [u32; 2] {
    let mut best = [(u32::MAX, 0); 2];
    for i in near.of::<ENDPOINTS>(&ideal.span()) {
        let (_, error) = best_pattern(&endpoints[i as usize].errors(texels));
        if error < best[0].0 {
            best = [(error, i), best[0]];
        } else if error < best[1].0 {
            best[1] = (error, i);
        }
    }
    if best[1].0 == u32::MAX {
        best[1] = best[0];
    }
    best.map(|(_, i)| i)
}

/// Where the texels lie between the colours of an endpoint, from 0 at the darkest to 3.
fn positions(endpoint: Endpoint, texels: &Texels) -> [f32; 16] {
    let colours = endpoint.colours().map(|c| c.iter().map(|v| f32::from(*v)).sum::<f32>());
    texels.map(|texel| {
        let sum: f32 = texel.iter().map(|v| f32::from(*v)).sum();
        let k = colours[1..3].iter().take_while(|c| sum > **c).count();
        let width = (colours[k + 1] - colours[k]).max(1e-3);
        k as f32 + ((sum - colours[k]) / width).clamp(0.0, 1.0)
    })
}

fn rounded(positions: &[f32; 16]) -> Pattern {
    positions.iter().enumerate().map(|(i, v)| (v.round().clamp(0.0, 3.0) as u32) << (2 * i)).sum()
}

fn padded<const N: usize>(found: impl Iterator<Item = u32>) -> [u32; N] {
    let mut out = [0; N];
    let mut last = 0;
    let mut found = found;
    for slot in &mut out {
        last = found.next().unwrap_or(last);
        *slot = last;
    }
    out
}

/// Entries to their numbers.
struct Numbers {
    endpoints: Vec<(Endpoint, u32)>,
    patterns: Vec<(Pattern, u32)>,
}

impl Numbers {
    fn new(palettes: &Palettes) -> Self {
        fn sorted<T: Ord + Copy>(all: &[T]) -> Vec<(T, u32)> {
            let mut out: Vec<(T, u32)> = all.iter().enumerate().map(|(i, t)| (*t, i as u32)).collect();
            out.sort_unstable();
            out
        }
        Numbers { endpoints: sorted(&palettes.endpoints), patterns: sorted(&palettes.patterns) }
    }

    fn of(&self, endpoint: Endpoint, pattern: Pattern) -> Pair {
        fn find<T: Ord + Copy>(all: &[(T, u32)], value: T) -> u32 {
            all.binary_search_by_key(&value, |(t, _)| *t).map_or(0, |i| all[i].1)
        }
        [find(&self.endpoints, endpoint), find(&self.patterns, pattern)]
    }
}

/// The patterns that were told last, as a reader keeps them.
#[derive(Debug, Clone)]
pub(super) struct History {
    pub(super) patterns: [u32; HISTORY],
    next: usize,
}

impl History {
    pub(super) fn new() -> Self {
        History { patterns: [0; HISTORY], next: HISTORY / 2 }
    }

    /// Where it stands, after it has been told; otherwise it is added.
    pub(super) fn told(&mut self, pattern: u32) -> Option<usize> {
        let found = self.patterns.iter().position(|p| *p == pattern);
        match found {
            Some(at) if at > 0 => self.patterns.swap(at, at / 2),
            Some(_) => {}
            None => {
                self.patterns[self.next] = pattern;
                self.next = if self.next + 1 == HISTORY { HISTORY / 2 } else { self.next + 1 };
            }
        }
        found
    }
}

/// The numbers of a slice's blocks: what costs least in error and bits, block after block.
fn choose(
    slice: &Slice,
    candidates: &[Candidates],
    palettes: &Palettes,
    bit: f64,
    context: &Context,
) -> Result<Vec<Pair>> {
    let bits = |n: usize| (n.max(2) as f64).log2();
    // About what codes make of them.
    let (like_neighbour, new_endpoint) = (1.5, 2.0 + 0.85 * bits(palettes.endpoints.len()));
    let new_pattern = 1.0 + bits(palettes.patterns.len());
    let of_history: [f64; HISTORY] = std::array::from_fn(|i| 2.5 + 0.6 * ((i + 1) as f64).log2());
    let mut out: Vec<Pair> = Vec::with_capacity(slice.blocks.len());
    let mut history = History::new();
    let wide = slice.size[0];
    for (i, (texels, candidates)) in slice.blocks.iter().zip(candidates).enumerate() {
        if i % wide == 0 {
            context.check()?;
        }
        let pair = match candidates {
            Candidates::Known(pair) => *pair,
            Candidates::Free { endpoints, patterns } => {
                let (x, y) = (i % wide, i / wide);
                let neighbours =
                    [(x > 0).then(|| i - 1), (y > 0).then(|| i - wide), (x > 0 && y > 0).then(|| i - wide - 1)];
                let mut tried: [u32; 5] = [u32::MAX; 5];
                let mut best = (f64::INFINITY, [0; 2]);
                let near = neighbours.into_iter().map(|n| n.map(|n| (out[n][0], like_neighbour)));
                let own = endpoints.iter().map(|e| Some((*e, new_endpoint)));
                // The best first: others are left as soon as they cost more.
                for (k, (endpoint, cost)) in own.chain(near).enumerate().filter_map(|(k, e)| Some((k, e?))) {
                    // As that of a neighbour it is cheaper than before.
                    let known = if k < 2 { &tried[..k] } else { &tried[2..k] };
                    if known.contains(&endpoint) {
                        continue;
                    }
                    tried[k] = endpoint;
                    let errors: Errors = palettes.endpoints[endpoint as usize].errors(texels);
                    if f64::from(best_pattern(&errors).1) + bit * cost >= best.0 {
                        continue;
                    }
                    let told = history.patterns.iter().zip(of_history).map(|(p, cost)| (*p, cost));
                    for (pattern, pattern_cost) in patterns.iter().map(|p| (*p, new_pattern)).chain(told) {
                        let price = bit * (cost + pattern_cost);
                        let pattern_of = palettes.patterns[pattern as usize];
                        if let Some(error) = error_below(&errors, pattern_of, best.0 - price) {
                            best = (f64::from(error) + price, [endpoint, pattern]);
                        }
                    }
                }
                best.1
            }
        };
        history.told(pair[1]);
        out.push(pair);
    }
    Ok(out)
}
