//! Which operations there are, and which is tried next (section 4.4).

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

use super::attempt::{Attempt, Merge, Reason};
use super::mesh::Mesh;
use super::operation::{Kind, Operation, runs};
use super::params::{Defrag, Search};
use crate::atlas::bvh::Bounds;
use crate::packing::Random;

/// Mean misalignment, in lengths of the seam, beyond which merges all but never succeed: of a stretch, and of a seam within a chart.
const CROOKED: [f64; 2] = [0.6, 1.6];

/// Texels of misalignment that are not too many whatever the length.
const NEAR: f64 = 4.0;

/// The least benefit of a part of a seam, relative to that of a whole one.
const PART: f64 = 0.5;

/// Work on an operation that failed, times how often it did, beyond which it is not tried again.
const RETRY: u64 = 10_000;

/// Work on an operation beyond which it is tried ahead of its turn only once: what it depends on changes too soon.
const DEAR: u64 = 2_000;

/// Where an operation stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Standing {
    /// Waits for its turn.
    Queued,
    /// Failed, until its charts change.
    Failed,
    /// Removes too little of a border, until its charts change.
    Small,
    /// Never again: what it was about has changed.
    Gone,
}

/// An operation in the queue.
#[derive(Debug)]
pub(super) struct Entry {
    pub op: Operation,
    pub standing: Standing,
    /// What it shares with others on the same seams.
    link: u32,
    /// Entries of the heap with another number are stale.
    stamp: u32,
    /// Whether its parts are in the queue.
    apart: bool,
    /// Work on the last attempt that failed.
    spent: u64,
    /// What was found out ahead of its turn, or why it failed.
    pub known: Known,
    /// Took longer, ahead of its turn, than there was time.
    pub dear: bool,
}

/// An attempt, with the number of changes of both charts by then.
type Known = Option<(Attempt, [usize; 2])>;

/// What an operation takes over from the one on the same edges before it.
#[derive(Debug, Default)]
struct Former {
    fails: u32,
    spent: u64,
    known: Known,
}

/// All seams between two charts, or within one.
#[derive(Debug, Default)]
struct Link {
    /// One half edge of each pair.
    edges: Vec<u32>,
    /// Its operations.
    entries: Vec<u32>,
    /// The most that one of its operations failed.
    fails: u32,
}

/// The queue.
pub(super) struct Queue<'a> {
    params: &'a Defrag,
    unit: f64,
    pub entries: Vec<Entry>,
    links: Vec<Link>,
    /// By chart: its links by the other chart.
    of_chart: Vec<BTreeMap<u32, u32>>,
    heap: BinaryHeap<Turn>,
    random: Random,
}

impl<'a> Queue<'a> {
    /// Identifies all operations and ranks them.
    pub(super) fn new(mesh: &Mesh, params: &'a Defrag, unit: f64, seed: u64) -> Self {
        let mut queue = Queue {
            params,
            unit,
            entries: Vec::new(),
            links: Vec::new(),
            of_chart: vec![BTreeMap::new(); mesh.charts.len()],
            heap: BinaryHeap::new(),
            random: Random::new(seed),
        };
        for ((a, b), edges) in mesh.links() {
            let link = queue.links.len() as u32;
            queue.of_chart[a as usize].insert(b, link);
            queue.of_chart[b as usize].insert(a, link);
            queue.links.push(Link { edges, ..Link::default() });
            queue.enumerate(mesh, link, a == b);
        }
        queue
    }

    /// Operations that wait.
    pub(super) fn len(&self) -> usize {
        self.heap.len()
    }

    /// The next operation.
    pub(super) fn pop(&mut self) -> Option<u32> {
        while let Some(turn) = self.heap.pop() {
            let entry = &self.entries[turn.entry as usize];
            if entry.stamp == turn.stamp && entry.standing == Standing::Queued {
                return Some(turn.entry);
            }
        }
        None
    }

    /// Puts an operation (back) into the queue.
    pub(super) fn push(&mut self, entry: u32) {
        let own = &mut self.entries[entry as usize];
        own.stamp += 1;
        own.standing = Standing::Queued;
        self.heap.push(Turn { rank: own.op.rank, entry, stamp: own.stamp });
    }

    /// What is known of an operation, if it still stands: nothing that it depends on has changed since.
    pub(super) fn known(&self, mesh: &Mesh, entry: u32) -> Option<&Attempt> {
        let own = &self.entries[entry as usize];
        let (attempt, seen) = own.known.as_ref()?;
        let [kept, moved] = [own.op.kept, own.op.moved].map(|c| &mesh.charts[c as usize].changes);
        let untouched = kept.get(seen[0]..)?.iter().all(|b| !b.meets(&attempt.region));
        let same = own.op.kept == own.op.moved || moved.len() == seen[1];
        let alike = attempt.island == own.op.is_island(mesh, self.params);
        (untouched && same && alike).then_some(attempt)
    }

    /// Those of the next `most` operations that are to be tried ahead of their turn, in order.
    pub(super) fn upcoming(&self, mesh: &Mesh, most: usize) -> Vec<u32> {
        let waits = |turn: &&Turn| {
            let entry = &self.entries[turn.entry as usize];
            entry.stamp == turn.stamp && entry.standing == Standing::Queued
        };
        let mut turns: Vec<&Turn> = self.heap.iter().filter(waits).collect();
        if turns.len() > most {
            turns.select_nth_unstable_by(most, |a, b| b.cmp(a));
            turns.truncate(most);
        }
        turns.sort_unstable_by(|a, b| b.cmp(a));
        turns.into_iter().map(|turn| turn.entry).filter(|&e| self.is_open(mesh, e)).collect()
    }

    /// Whether it is to be tried ahead of its turn: not yet, or cheaply, and not as things are now.
    fn is_open(&self, mesh: &Mesh, entry: u32) -> bool {
        let own = &self.entries[entry as usize];
        !own.dear && own.known.as_ref().is_none_or(|(stale, _)| stale.work <= DEAR) && self.known(mesh, entry).is_none()
    }

    /// Remembers what was found out.
    pub(super) fn remember(&mut self, mesh: &Mesh, entry: u32, attempt: Attempt) {
        let own = &mut self.entries[entry as usize];
        let seen = [own.op.kept, own.op.moved].map(|c| mesh.charts[c as usize].changes.len());
        own.known = Some((attempt, seen));
    }

    /// The operation failed: it waits until its charts change; parts of it may do better.
    pub(super) fn failed(&mut self, mesh: &Mesh, entry: u32, reason: Reason) {
        let own = &mut self.entries[entry as usize];
        own.op.fails += 1;
        own.spent = own.known.as_ref().map_or(0, |(attempt, _)| attempt.work);
        let for_good = matches!(reason, Reason::Global | Reason::Resampled | Reason::Size);
        own.standing = if for_good { Standing::Gone } else { Standing::Failed };
        // Charts that are too large together are so along every part of their seams.
        let first = !std::mem::replace(&mut own.apart, true) && reason != Reason::Size;
        let (kind, link, fails, edges) = (own.op.kind, own.link, own.op.fails, own.op.edges.clone());
        let shared = &mut self.links[link as usize];
        shared.fails = shared.fails.max(fails);
        if self.params.search == Search::Partial && first {
            self.take_apart(mesh, link, kind, &edges);
        }
    }

    /// Operations of parts of a seam that cannot be dissolved as a whole.
    fn take_apart(&mut self, mesh: &Mesh, link: u32, kind: Kind, edges: &[u32]) {
        let parts = match kind {
            Kind::Whole => {
                let runs = runs(mesh, edges);
                if runs.len() > 1 { runs.into_iter().map(|r| (Kind::Run, r)).collect() } else { halves(mesh, edges) }
            }
            Kind::Run | Kind::Within | Kind::Stretch => halves(mesh, edges),
        };
        for (kind, edges) in parts {
            self.add(mesh, link, kind, edges, Former::default());
        }
    }

    /// Makes an operation, unless it is none or is taken apart at once.
    fn add(&mut self, mesh: &Mesh, link: u32, kind: Kind, edges: Vec<u32>, former: Former) {
        let chance = self.random.unit();
        let Some(op) = Operation::new(mesh, kind, edges, former.fails, self.params, self.unit, chance) else { return };
        let crooked = match kind {
            Kind::Stretch => CROOKED[0],
            Kind::Within => CROOKED[1],
            Kind::Whole | Kind::Run => f64::INFINITY,
        };
        if self.params.search == Search::Partial
            && op.cost > crooked * 0.5 * (op.lengths[0] + op.lengths[1])
            && op.cost > NEAR
        {
            // Hopeless as it is: its parts may do.
            self.take_apart(mesh, link, kind, &op.edges);
            return;
        }
        let entry = self.entries.len() as u32;
        let small = self.is_small(mesh, &op);
        let Former { spent, known, .. } = former;
        self.entries.push(Entry {
            op,
            standing: Standing::Small,
            link,
            stamp: 0,
            apart: false,
            spent,
            known,
            dear: false,
        });
        self.links[link as usize].entries.push(entry);
        if !self.may_retry(entry) {
            // Not it again, but its parts.
            let own = &mut self.entries[entry as usize];
            (own.standing, own.apart) = (Standing::Failed, true);
            let edges = own.op.edges.clone();
            self.take_apart(mesh, link, kind, &edges);
        } else if !small {
            self.push(entry);
        }
    }

    /// Whether an operation that failed is worth another try: the dearer it is, the fewer.
    fn may_retry(&self, entry: u32) -> bool {
        let own = &self.entries[entry as usize];
        self.params.search == Search::Paper || u64::from(own.op.fails) * own.spent <= RETRY
    }

    fn is_small(&self, mesh: &Mesh, op: &Operation) -> bool {
        op.kept != op.moved
            && op.benefit(mesh) < self.params.min_benefit * if op.kind == Kind::Whole { 1.0 } else { PART }
    }

    /// Makes the operations of a link anew.
    fn enumerate(&mut self, mesh: &Mesh, link: u32, within: bool) {
        let own = &mut self.links[link as usize];
        let (edges, fails) = (own.edges.clone(), own.fails);
        let old = std::mem::take(&mut own.entries);
        let groups = if within && !edges.is_empty() { runs(mesh, &edges) } else { Vec::new() };
        // Groups within a chart that are as they were keep what is known of them; those that failed stay where nothing changed.
        // What was only tried ahead of its turn makes no difference to what is queued.
        let same: BTreeSet<&Vec<u32>> = groups.iter().collect();
        let mut kept: BTreeSet<Vec<u32>> = BTreeSet::new();
        let mut former: BTreeMap<Vec<u32>, Former> = BTreeMap::new();
        for entry in old {
            let own = &self.entries[entry as usize];
            let goes_on = within
                && own.op.kind == Kind::Within
                && own.standing != Standing::Gone
                && same.contains(&own.op.edges)
                && own.op.kept == own.op.moved;
            let known = goes_on && self.known(mesh, entry).is_some();
            let own = &mut self.entries[entry as usize];
            if known && own.standing == Standing::Failed {
                kept.insert(own.op.edges.clone());
                self.links[link as usize].entries.push(entry);
                continue;
            }
            own.standing = Standing::Gone;
            let known = own.known.take().filter(|_| known);
            if goes_on {
                former.insert(own.op.edges.clone(), Former { fails: own.op.fails, spent: own.spent, known });
            }
        }
        if edges.is_empty() {
            return;
        }
        if !within {
            self.add(mesh, link, Kind::Whole, edges, Former { fails, ..Former::default() });
            return;
        }
        for group in groups.into_iter().filter(|g| !kept.contains(g)) {
            let new = || Former { fails: fails.min(8), ..Former::default() };
            let former = former.remove(&group).unwrap_or_else(new);
            self.add(mesh, link, Kind::Within, group, former);
        }
    }

    /// Takes note of a merge that was made.
    pub(super) fn merged(&mut self, mesh: &Mesh, entry: u32, merge: &Merge, region: Bounds) {
        let op = &self.entries[entry as usize].op;
        let (kept, moved, link) = (op.kept, op.moved, self.entries[entry as usize].link);
        // The seams that are gone.
        let zipped: BTreeSet<u32> = merge.zip.iter().flat_map(|&(h, t)| [h, t]).collect();
        self.links[link as usize].edges.retain(|h| !zipped.contains(h));
        let mut dirty: Vec<u32> = vec![link];
        if kept != moved {
            // What is left between the two is within one now; the other's seams are the kept chart's.
            self.of_chart[kept as usize].remove(&moved);
            for (other, from) in std::mem::take(&mut self.of_chart[moved as usize]) {
                let other = if other == kept || other == moved { kept } else { other };
                if other != kept {
                    self.of_chart[other as usize].remove(&moved);
                }
                let to = match self.of_chart[kept as usize].get(&other) {
                    Some(&to) => to,
                    None => {
                        self.of_chart[kept as usize].insert(other, from);
                        self.of_chart[other as usize].insert(kept, from);
                        from
                    }
                };
                dirty.push(to);
                if to != from {
                    let gone = std::mem::take(&mut self.links[from as usize]);
                    for entry in gone.entries {
                        self.entries[entry as usize].standing = Standing::Gone;
                        self.entries[entry as usize].known = None;
                    }
                    let own = &mut self.links[to as usize];
                    own.edges.extend(gone.edges);
                    own.fails = own.fails.max(gone.fails);
                }
            }
        }
        // Seams whose sides changed shape.
        for h in merge.band.iter().flat_map(|&(f, _)| 3 * f..3 * f + 3) {
            let t = mesh.link[h as usize];
            if t != super::mesh::NONE
                && let Some(&link) = self.of_chart[kept as usize].get(&mesh.chart(t))
            {
                dirty.push(link);
            }
        }
        dirty.sort_unstable();
        dirty.dedup();
        let within = self.of_chart[kept as usize].get(&kept).copied();
        for &link in &dirty {
            self.enumerate(mesh, link, Some(link) == within);
        }
        self.update(mesh, kept, &dirty, region);
    }

    /// Ranks the other operations of a chart that changed, and lets those that failed try again where it changed.
    fn update(&mut self, mesh: &Mesh, chart: u32, fresh: &[u32], region: Bounds) {
        let links: Vec<(u32, u32)> = self.of_chart[chart as usize].iter().map(|(o, l)| (*o, *l)).collect();
        for (other, link) in links {
            if fresh.binary_search(&link).is_ok() {
                continue;
            }
            if other != chart {
                let roles = Operation::roles(mesh, chart, other);
                let flipped = self.links[link as usize].entries.iter().any(|&e| {
                    let entry = &self.entries[e as usize];
                    entry.standing != Standing::Gone && (entry.op.kept, entry.op.moved) != roles
                });
                if flipped {
                    self.enumerate(mesh, link, false);
                    continue;
                }
            }
            for i in 0..self.links[link as usize].entries.len() {
                let e = self.links[link as usize].entries[i];
                let entry = &self.entries[e as usize];
                let rank = entry.op.ranked(mesh, self.params);
                let small = self.is_small(mesh, &entry.op);
                let standing = entry.standing;
                let again = self.params.retry
                    && entry.known.as_ref().is_none_or(|(attempt, _)| {
                        attempt.region.meets(&region) || entry.op.moved == chart && entry.op.kept != chart
                    });
                let moves = self.entries[e as usize].op.rank.to_bits() != rank.to_bits();
                self.entries[e as usize].op.rank = rank;
                match standing {
                    Standing::Queued if small => self.entries[e as usize].standing = Standing::Small,
                    Standing::Queued if moves => self.push(e),
                    Standing::Small if !small => self.push(e),
                    Standing::Failed if again && !small && self.may_retry(e) => self.push(e),
                    _ => {}
                }
            }
        }
    }
}

/// The two halves of a run, by the order along the border of its first side.
fn halves(mesh: &Mesh, edges: &[u32]) -> Vec<(Kind, Vec<u32>)> {
    if edges.len() < 2 {
        return Vec::new();
    }
    let ordered = along(mesh, edges);
    let middle = ordered.len() / 2;
    let part = |edges: &[u32]| {
        let mut own = edges.to_vec();
        own.sort_unstable();
        (Kind::Stretch, own)
    };
    vec![part(&ordered[..middle]), part(&ordered[middle..])]
}

/// The edges of a run in order.
fn along(mesh: &Mesh, edges: &[u32]) -> Vec<u32> {
    // One side of each pair, all of the same border where that can be told: by the vertex at which they start.
    let mut by_start: BTreeMap<u32, u32> = BTreeMap::new();
    let mut is_end: BTreeSet<u32> = BTreeSet::new();
    let first = mesh.chart(edges[0]);
    for &h in edges {
        let own = super::operation::sides(mesh, h, first).0;
        by_start.insert(mesh.start(own), h);
        is_end.insert(mesh.end(own));
    }
    let mut ordered = Vec::with_capacity(edges.len());
    let mut left = by_start.clone();
    let starts: Vec<u32> =
        by_start.keys().copied().filter(|s| !is_end.contains(s)).chain(by_start.keys().copied()).collect();
    for start in starts {
        let mut at = start;
        while let Some(h) = left.remove(&at) {
            ordered.push(h);
            let own = super::operation::sides(mesh, h, first).0;
            at = mesh.end(own);
        }
    }
    // Edges that start where another does.
    let mut missing: Vec<u32> = edges.iter().copied().filter(|h| !ordered.contains(h)).collect();
    ordered.append(&mut missing);
    ordered
}

/// An operation's place in the heap.
#[derive(Debug)]
struct Turn {
    rank: f64,
    entry: u32,
    stamp: u32,
}

impl PartialEq for Turn {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Turn {}

impl PartialOrd for Turn {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Turn {
    /// The least rank is the greatest turn; among equals the older operation.
    fn cmp(&self, other: &Self) -> Ordering {
        other.rank.total_cmp(&self.rank).then(other.entry.cmp(&self.entry)).then(other.stamp.cmp(&self.stamp))
    }
}
