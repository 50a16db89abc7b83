//! Motorcycle graphs: which trails are cut, and the rectangles that are left (section 3.2).

use glam::DVec2;

use super::arrangement::Arrangement;
use crate::atlas::groups::DisjointSets;
use crate::packing::{Random, RectanglePacker, RectanglePacking, RectangleRequest};

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
    pub rectangles: Vec<(DVec2, DVec2)>,
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
        for (edge, _) in chart.edges.iter().zip(active.iter()).filter(|(edge, active)| !edge.is_boundary && !**active) {
            if let [Some(a), Some(b)] = edge.cells {
                sets.unite(a, b);
            }
        }
        let (_, groups) = sets.numbered();
        let area = |cells: &Vec<u32>| -> f64 {
            cells.iter().map(|c| &chart.cells[*c as usize]).map(|c| (c.high - c.low).element_product()).sum()
        };
        out.areas = groups.iter().map(area).collect();
        out.folded = groups.iter().any(|cells| chart.lies_on_itself(cells));
        out.rectangles = groups
            .iter()
            .map(|cells| {
                cells
                    .iter()
                    .map(|c| &chart.cells[*c as usize])
                    .fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), cell| {
                        (low.min(cell.low), high.max(cell.high))
                    })
            })
            .collect();
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
    /// What seams cost before.
    pub seams: f64,
    /// How rectangles are packed.
    pub request: RectangleRequest,
    /// Divisions that are tried.
    pub tries: usize,
    /// Whether random motorcycle graphs are judged by the published score (eq. 11).
    pub is_published: bool,
}

/// Divisions of all charts and the packing of their rectangles.
#[derive(Debug, Clone)]
pub(super) struct Chosen {
    pub divisions: Vec<Division>,
    pub packing: RectanglePacking,
    /// Area of the rectangles over area of the box.
    pub efficiency: f64,
    /// What all cuts cost.
    pub cost: f64,
}

/// What a missing hundredth of packing efficiency counts, in parts of the seams before: more than any cut that might mend it.
const MISSING: f64 = 10.0;
/// Temperature of the search at its begin and end, in parts of the seams before.
const WARM: f64 = 0.02;
const COLD: f64 = 0.0005;

/// Searches for the shortest cuts with which the rectangles of all charts can be packed well enough: simulated annealing over the orders of the motorcycles.
/// The best that is found, whether it is good enough or not; `None` where nothing is to be packed.
pub(super) fn search(charts: &[Arrangement], goal: &Goal, random: &mut Random) -> Option<Chosen> {
    let mut divider = Divider::default();
    let mut packer = RectanglePacker::default();
    let mut orders: Vec<Order> = charts.iter().map(greedy).collect();
    let mut divisions: Vec<Division> = charts.iter().zip(&orders).map(|(c, o)| divider.divide(c, o)).collect();
    let mut judge = |divisions: &[Division]| -> Option<(f64, Chosen)> {
        let rectangles = || divisions.iter().flat_map(|d| &d.rectangles).map(|(low, high)| *high - *low);
        let cost: f64 = divisions.iter().map(|d| d.cost).sum();
        let sizes: Vec<DVec2> = rectangles().map(|s| s + goal.padding).collect();
        let packing = packer.pack(&sizes, &goal.request)?;
        let area: f64 = divisions.iter().flat_map(|d| &d.areas).sum();
        let efficiency = area / packing.area(goal.request.aspect);
        let slender = rectangles().filter(|s| s.max_element() > SLENDER * s.min_element()).count();
        let folded = divisions.iter().filter(|d| d.folded).count();
        let value =
            cost / goal.seams + folded as f64 + MISSING * (goal.efficiency - efficiency).max(0.0) + slender as f64;
        Some((value, Chosen { divisions: divisions.to_vec(), packing, efficiency, cost }))
    };
    let (mut value, first) = judge(&divisions)?;
    let (mut best, mut least) = (first, value);
    let movable: Vec<usize> = (0..charts.len()).filter(|c| charts[*c].motorcycles.len() > 1).collect();
    if movable.is_empty() {
        return Some(best);
    }
    for round in 0..goal.tries {
        let temperature = WARM * (COLD / WARM).powf(round as f64 / goal.tries as f64);
        let c = movable[random.below(movable.len())];
        let n = charts[c].motorcycles.len();
        let before = orders[c].clone();
        for _ in 0..1 + random.below(2) {
            let own = &mut orders[c];
            let from = random.below(n);
            let m = own.motorcycles.remove(from);
            let to = if random.below(2) == 0 { from } else { random.below(n) };
            own.motorcycles.insert(to, m);
            if to == from || !own.on[m as usize] {
                own.on[m as usize] = !own.on[m as usize];
            }
        }
        let division = divider.divide(&charts[c], &orders[c]);
        if division.ran == divisions[c].ran {
            continue;
        }
        let old = std::mem::replace(&mut divisions[c], division);
        // What costs too much needs no packing.
        let cost: f64 = divisions.iter().map(|d| d.cost).sum();
        let limit = value - temperature * random.unit().max(1e-12).ln();
        let judged = if cost / goal.seams > limit { None } else { judge(&divisions) };
        match judged {
            Some((new, chosen)) if new <= limit => {
                value = new;
                if new < least {
                    (best, least) = (chosen, new);
                }
            }
            _ => {
                divisions[c] = old;
                orders[c] = before;
            }
        }
    }
    Some(best)
}
