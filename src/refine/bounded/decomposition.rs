//! Motorcycle graphs: which trails are cut, and the rectangles that are left (section 3.2).

use glam::DVec2;

use super::arrangement::Arrangement;
use crate::atlas::bvh::Bounds;
use crate::atlas::groups::DisjointSets;
use crate::packing::{Random, RectanglePacker, RectangleRequest};

/// Longest side of a rectangle in units of the other.
const SLENDER: f64 = 20.0;

/// Which motorcycles run, in which order, in one chart.
///
/// Each runs until it comes to the boundary or to the trail of one before it. One that starts at a reflex corner from which, or to which, another trail
/// runs already is left out; those that start on a side only run where `on` says so.
#[derive(Debug, Clone)]
pub(super) struct Order {
    pub motorcycles: Vec<u32>,
    pub on: Vec<bool>,
}

/// A chart divided into rectangles.
#[derive(Debug, Clone, Default)]
pub(super) struct Division {
    /// Motorcycles that ran, in order.
    pub ran: Vec<u32>,
    /// What all cuts cost.
    pub cost: f64,
    /// Its parts: the box about each, and its area, which is less where a corner stays.
    pub rectangles: Vec<Bounds>,
    pub areas: Vec<f64>,
    /// Whether a part lies on itself.
    pub folded: bool,
}

/// Room to divide in.
#[derive(Debug, Default)]
pub(super) struct Divider {
    active: Vec<bool>,
    busy: Vec<bool>,
    resolved: Vec<bool>,
}

impl Divider {
    /// Lets the motorcycles run.
    pub fn divide(&mut self, chart: &Arrangement, order: &Order) -> Division {
        let Divider { active, busy, resolved } = self;
        active.clear();
        active.resize(chart.edges.len(), false);
        busy.clear();
        busy.extend(chart.nodes.iter().map(|n| n.on_boundary));
        resolved.clear();
        resolved.resize(chart.nodes.len(), false);
        let mut out = Division::default();
        for &m in &order.motorcycles {
            let own = &chart.motorcycles[m as usize];
            if !order.on[m as usize] || own.is_corner && resolved[own.from as usize] {
                continue;
            }
            if own.edges.first().is_none_or(|(e, _)| active[*e as usize]) {
                continue;
            }
            resolved[own.from as usize] = true;
            for &(e, node) in &own.edges {
                active[e as usize] = true;
                out.cost += chart.edges[e as usize].cost;
                resolved[node as usize] = true;
                if std::mem::replace(&mut busy[node as usize], true) {
                    break;
                }
            }
            out.ran.push(m);
        }
        let mut sets = DisjointSets::new(chart.cells.len());
        let pairs = chart.edges.iter().zip(active.iter());
        for (edge, _) in pairs.filter(|(edge, active)| !edge.is_boundary && !**active) {
            if let [Some(a), Some(b)] = edge.cells {
                sets.unite(a, b);
            }
        }
        let (_, groups) = sets.numbered();
        let area =
            |cells: &Vec<u32>| -> f64 { cells.iter().map(|c| chart.cells[*c as usize].size().element_product()).sum() };
        out.areas = groups.iter().map(area).collect();
        out.folded = groups.iter().any(|cells| chart.lies_on_itself(cells));
        out.rectangles = groups.iter().map(|cells| chart.bounds(cells)).collect();
        out
    }
}

/// The order in which the cheapest trail that is left runs first.
pub(super) fn greedy(chart: &Arrangement) -> Order {
    let mut busy: Vec<bool> = chart.nodes.iter().map(|n| n.on_boundary).collect();
    let mut resolved = vec![false; chart.nodes.len()];
    let mut motorcycles: Vec<u32> = Vec::new();
    loop {
        let open = |m: &u32| {
            let own = &chart.motorcycles[*m as usize];
            own.is_corner && !resolved[own.from as usize]
        };
        let cost = |m: u32| {
            let mut sum = 0.0;
            for &(e, node) in &chart.motorcycles[m as usize].edges {
                sum += chart.edges[e as usize].cost;
                if busy[node as usize] {
                    break;
                }
            }
            sum
        };
        let all = 0..chart.motorcycles.len() as u32;
        let Some(next) = all.filter(open).min_by(|&a, &b| cost(a).total_cmp(&cost(b)).then(a.cmp(&b))) else { break };
        motorcycles.push(next);
        let own = &chart.motorcycles[next as usize];
        resolved[own.from as usize] = true;
        for &(_, node) in &own.edges {
            resolved[node as usize] = true;
            if std::mem::replace(&mut busy[node as usize], true) {
                break;
            }
        }
    }
    let mut is_in = vec![false; chart.motorcycles.len()];
    motorcycles.iter().for_each(|m| is_in[*m as usize] = true);
    motorcycles.extend((0..chart.motorcycles.len() as u32).filter(|m| !is_in[*m as usize]));
    let on = chart.motorcycles.iter().map(|m| m.is_corner).collect();
    Order { motorcycles, on }
}

/// What a search is to reach.
#[derive(Debug, Clone, Copy)]
pub(super) struct Goal {
    /// Least packing efficiency.
    pub efficiency: f64,
    /// What is left free beside each rectangle, in texels.
    pub padding: f64,
    /// What the borders of all charts cost before.
    pub seams: f64,
    /// How rectangles are packed.
    pub request: RectangleRequest,
    /// Divisions that are tried.
    pub tries: usize,
    /// Whether random motorcycle graphs are judged by the published score (eq. 11).
    pub is_published: bool,
}

/// Divisions of all charts that are to be cut.
#[derive(Debug, Clone)]
pub(super) struct Chosen {
    pub divisions: Vec<Division>,
    judgement: Judgement,
}

/// What divisions are worth.
#[derive(Debug, Clone, Copy)]
struct Judgement {
    /// Area of the parts over area of the box.
    efficiency: f64,
    /// What all cuts cost.
    cost: f64,
    /// Parts that are slivers, and charts in which a part lies on itself.
    faults: usize,
    /// The less, the better.
    value: f64,
}

/// What missing packing efficiency counts, in parts of the seams before: more than any cut that might mend it.
const MISSING: f64 = 20.0;
/// Temperature of the search at its begin and end, in parts of the seams before.
const WARM: f64 = 0.02;
const COLD: f64 = 0.0005;
/// Numbers of divided charts that are tried where the goal is out of reach.
const SAMPLED: usize = 16;
/// Rectangles that are packed in a whole search, squared: fewer tries for more.
const WORK: f64 = 2e6;
/// Most rectangles that are packed to judge a division; of more it is known how tightly they pack.
const MOST_PACKED: usize = 600;
const FILLED: f64 = 0.97;
/// Weight of the boundary's growth in the published score (omega of eq. 11).
const OMEGA: f64 = 0.1;

/// A search for the cuts with which the boxes about the parts of all charts can be packed well enough.
struct Searcher<'a> {
    charts: &'a [&'a Arrangement],
    goal: &'a Goal,
    packer: RectanglePacker,
    divider: Divider,
    sizes: Vec<DVec2>,
}

/// Searches for the shortest cuts with which the boxes about the parts of all charts can be packed well enough: the charts that waste most are cut at all their
/// corners, then by simulated annealing over the orders of the motorcycles. The best that is found, whether it is good enough or not; `None` where nothing is to
/// be packed.
pub(super) fn search(charts: &[&Arrangement], goal: &Goal, random: &mut Random) -> Option<Chosen> {
    let mut searcher =
        Searcher { charts, goal, packer: RectanglePacker::default(), divider: Divider::default(), sizes: Vec::new() };
    if goal.is_published { searcher.by_score(random) } else { searcher.shortest(random) }
}

impl Searcher<'_> {
    fn judge(&mut self, divisions: &[Division]) -> Option<Judgement> {
        let Goal { padding, seams, .. } = *self.goal;
        self.sizes.clear();
        self.sizes.extend(divisions.iter().flat_map(|d| &d.rectangles).map(|r| r.size() + padding));
        let box_area = match self.sizes.len() {
            0..=MOST_PACKED => self.packer.pack(&self.sizes, &self.goal.request)?.area(self.goal.request.aspect),
            _ => self.sizes.iter().map(|s| s.element_product()).sum::<f64>() / FILLED,
        };
        let area: f64 = divisions.iter().flat_map(|d| &d.areas).sum();
        let efficiency = area / box_area;
        let is_sliver = |r: &&Bounds| r.size().max_element() > SLENDER * r.size().min_element();
        // What was not cut has the shape that it has.
        let slivers = divisions.iter().filter(|d| !d.ran.is_empty()).flat_map(|d| &d.rectangles);
        let slivers = slivers.filter(is_sliver).count();
        let faults = slivers + divisions.iter().filter(|d| d.folded).count();
        let cost: f64 = divisions.iter().map(|d| d.cost).sum();
        let value = cost / seams + MISSING * (self.goal.efficiency - efficiency).max(0.0) + faults as f64;
        Some(Judgement { efficiency, cost, faults, value })
    }

    fn divide(&mut self, chart: usize, order: &Order) -> Division {
        self.divider.divide(self.charts[chart], order)
    }

    fn shortest(&mut self, random: &mut Random) -> Option<Chosen> {
        let Goal { seams, efficiency: goal, .. } = *self.goal;
        let mut orders: Vec<Order> = self.charts.iter().map(|c| greedy(c)).collect();
        let cut: Vec<Division> = (0..orders.len()).map(|c| self.divide(c, &orders[c])).collect();
        let whole: Vec<Division> = orders
            .iter()
            .enumerate()
            .map(|(c, o)| self.divide(c, &Order { on: vec![false; o.on.len()], ..o.clone() }))
            .collect();
        // Those that lie on themselves are cut in any case; then those whose boxes waste most for what their cuts cost.
        let waste = |d: &Division| {
            d.rectangles.iter().map(|r| r.size().element_product()).sum::<f64>() - d.areas.iter().sum::<f64>()
        };
        let gain = |c: usize| {
            if whole[c].folded { f64::INFINITY } else { (waste(&whole[c]) - waste(&cut[c])) / cut[c].cost.max(1e-300) }
        };
        let mut ranked: Vec<usize> = (0..orders.len()).filter(|c| !cut[*c].ran.is_empty()).collect();
        ranked.sort_by(|&a, &b| gain(b).total_cmp(&gain(a)).then(a.cmp(&b)));
        let least = ranked.iter().take_while(|c| whole[**c].folded).count();
        let with = |count: usize| {
            let mut own = whole.clone();
            ranked[..count].iter().for_each(|c| own[*c] = cut[*c].clone());
            own
        };
        let (mut low, mut high) = (least, ranked.len());
        while low < high {
            let middle = (low + high) / 2;
            if self.judge(&with(middle))?.efficiency >= goal { high = middle } else { low = middle + 1 }
        }
        // Where not even all cuts suffice, some may do more than all: each part has free room about it.
        if self.judge(&with(high))?.efficiency < goal {
            let counts = (0..=SAMPLED).map(|k| least + (ranked.len() - least) * k / SAMPLED);
            let judged = counts.map(|count| Some((self.judge(&with(count))?.value, count)));
            let judged = judged.collect::<Option<Vec<_>>>()?;
            high = judged.into_iter().min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))?.1;
        }
        for c in &ranked[high..] {
            orders[*c].on.fill(false);
        }
        let mut divisions = with(high);
        let first = self.judge(&divisions)?;
        let (mut value, mut least) = (first.value, first.value);
        let mut best = Chosen { divisions: divisions.clone(), judgement: first };
        let movable: Vec<usize> = (0..self.charts.len()).filter(|c| !self.charts[*c].motorcycles.is_empty()).collect();
        if movable.is_empty() {
            return Some(best);
        }
        let size = self.sizes.len() as f64;
        let tries = (self.goal.tries as f64).min(WORK / (size * size)) as usize;
        let mut cost: f64 = divisions.iter().map(|d| d.cost).sum();
        for round in 0..tries {
            let temperature = WARM * (COLD / WARM).powf(round as f64 / tries as f64);
            let c = movable[random.below(movable.len())];
            let before = orders[c].clone();
            for _ in 0..1 + random.below(2) {
                shake(&mut orders[c], random);
            }
            let division = self.divide(c, &orders[c]);
            if division.ran == divisions[c].ran {
                continue;
            }
            let limit = value - temperature * random.unit().max(1e-12).ln();
            let changed = cost - divisions[c].cost + division.cost;
            let old = std::mem::replace(&mut divisions[c], division);
            // What costs too much needs no packing.
            let judged = if changed / seams > limit { None } else { self.judge(&divisions) };
            match judged.filter(|j| j.value <= limit) {
                Some(judged) => {
                    (value, cost) = (judged.value, changed);
                    if value < least {
                        least = value;
                        best = Chosen { divisions: divisions.clone(), judgement: judged };
                    }
                }
                None => {
                    divisions[c] = old;
                    orders[c] = before;
                }
            }
        }
        Some(best)
    }

    /// The random motorcycle graph with the best score PE - omega BL1 / BL0 among those that pack well enough (section 3.2): all corners are cut.
    fn by_score(&mut self, random: &mut Random) -> Option<Chosen> {
        let Goal { seams, efficiency: goal, tries, .. } = *self.goal;
        let mut orders: Vec<Order> = self.charts.iter().map(|c| greedy(c)).collect();
        let mut best: Option<Chosen> = None;
        let score = |j: &Judgement| {
            let is_in = j.efficiency >= goal && j.faults == 0;
            (is_in, j.efficiency - OMEGA * (1.0 + j.cost / seams))
        };
        for _ in 0..tries {
            for order in &mut orders {
                for k in (1..order.motorcycles.len()).rev() {
                    order.motorcycles.swap(k, random.below(k + 1));
                }
            }
            let divisions: Vec<Division> = (0..orders.len()).map(|c| self.divide(c, &orders[c])).collect();
            let judgement = self.judge(&divisions)?;
            if best.as_ref().is_none_or(|b| score(&judgement) > score(&b.judgement)) {
                best = Some(Chosen { divisions, judgement });
            }
        }
        best
    }
}

/// Lets a motorcycle run earlier or later, or not, or again.
fn shake(order: &mut Order, random: &mut Random) {
    let n = order.motorcycles.len();
    let from = random.below(n);
    let m = order.motorcycles.remove(from);
    let to = if random.below(2) == 0 { from } else { random.below(n) };
    order.motorcycles.insert(to, m);
    if to == from || !order.on[m as usize] {
        order.on[m as usize] = !order.on[m as usize];
    }
}
