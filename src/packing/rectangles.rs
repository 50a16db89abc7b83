//! Rectangles on a sheet, with quarter turns: maximal free rectangles (Jylänki 2010), the best of several rules, orders and widths.
//!
//! One packing of a few dozen rectangles takes microseconds, so that whoever divides shapes into rectangles can judge thousands of divisions.

use glam::DVec2;

/// Where a rectangle lies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PlacedRectangle {
    /// Its low corner.
    pub at: DVec2,
    /// Whether it is turned by a quarter: its width and height are exchanged.
    pub turned: bool,
}

/// A packing of rectangles.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct RectanglePacking {
    /// By rectangle.
    pub places: Vec<PlacedRectangle>,
    /// Width and height of the box about all of them.
    pub size: DVec2,
}

impl RectanglePacking {
    /// Area of the box; with an aspect, of the smallest box of that aspect about it.
    pub fn area(&self, aspect: Option<f64>) -> f64 {
        match aspect {
            Some(aspect) => (self.size.x / aspect).max(self.size.y).powi(2) * aspect,
            None => self.size.element_product(),
        }
    }
}

/// What is asked for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RectangleRequest {
    /// Whether rectangles may be turned by a quarter.
    pub turns: bool,
    /// Width / height of the box; free between 1 : [`WIDEST`] and [`WIDEST`] : 1 where there is none.
    pub aspect: Option<f64>,
    /// Widths of the box that are tried.
    pub widths: usize,
}

/// Longest side of a box of free aspect, in units of the other, where no rectangle needs more.
const WIDEST: f64 = 2.0;
/// Fill that the narrowest and the widest box of a given aspect are made for.
const FILLS: [f64; 2] = [0.99, 0.70];

/// From this many rectangles on, fewer rules are tried where fewer widths are asked for than this.
const FEW: usize = 32;
const MANY_WIDTHS: usize = 8;

/// By what rectangles are put in order, large to small.
const ORDERS: [fn(DVec2) -> f64; 3] = [|s| s.max_element(), |s| s.element_product(), |s| s.min_element()];

/// By what the place of a rectangle is chosen; the least pair of numbers wins.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Rule {
    /// As low as it gets, then to the left.
    Bottom,
    /// The free rectangle that leaves the least on its shorter side, in a box that is bounded.
    ShortSide,
    /// The most of its sides on the box and on other rectangles.
    Contact,
}

const RULES: [Rule; 3] = [Rule::Bottom, Rule::ShortSide, Rule::Contact];

/// An axis-aligned box.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Span {
    low: DVec2,
    high: DVec2,
}

impl Span {
    fn holds(&self, other: &Span) -> bool {
        self.low.cmple(other.low).all() && self.high.cmpge(other.high).all()
    }

    fn meets(&self, other: &Span) -> bool {
        self.low.cmplt(other.high).all() && other.low.cmplt(self.high).all()
    }
}

/// The room in which packings are made, used again and again.
#[derive(Debug, Default)]
pub(crate) struct RectanglePacker {
    free: Vec<Span>,
    fresh: Vec<Span>,
    kept: Vec<Span>,
    least: Vec<f64>,
    placed: Vec<Span>,
    places: Vec<PlacedRectangle>,
}

impl RectanglePacker {
    /// The best packing of rectangles of these sizes that is found, all of them finite and above zero. `None` where there are none.
    pub fn pack(&mut self, sizes: &[DVec2], request: &RectangleRequest) -> Option<RectanglePacking> {
        let total: f64 = sizes.iter().map(|s| s.element_product()).sum();
        let least = |s: &DVec2| if request.turns { s.min_element() } else { s.x };
        // A box must hold each of them.
        let narrowest = sizes.iter().map(least).fold(0.0, f64::max);
        if sizes.is_empty() || !(total > 0.0 && total.is_finite()) {
            return None;
        }
        let [low, high] = match request.aspect {
            Some(aspect) => FILLS.map(|fill| (total * aspect / fill).sqrt()),
            None if request.turns => [(total / WIDEST).sqrt(), (total / FILLS[1]).sqrt()],
            None => [(total / WIDEST).sqrt(), (total * WIDEST).sqrt()],
        };
        let (low, high) = (low.max(narrowest), high.max(narrowest));
        // The more there are, the less it matters how they are placed, and the longer it takes.
        let (orders, rules, widths) = match sizes.len() {
            // Contact is dear: where many packings are asked for, few rectangles have it.
            FEW..=100 if request.widths < MANY_WIDTHS => (ORDERS.as_slice(), &RULES[..2], request.widths),
            0..=100 => (ORDERS.as_slice(), RULES.as_slice(), request.widths),
            101..=1000 => (&ORDERS[..2], &RULES[..1], request.widths.min(12)),
            1001..=3000 => (&ORDERS[..1], &RULES[..1], request.widths.min(4)),
            _ => (&ORDERS[..1], &RULES[..1], request.widths.min(2)),
        };
        let steps = widths.max(1);
        let mut best: Option<RectanglePacking> = None;
        let mut order: Vec<usize> = (0..sizes.len()).collect();
        for key in orders {
            order.sort_by(|&a, &b| key(sizes[b]).total_cmp(&key(sizes[a])).then(a.cmp(&b)));
            for step in 0..steps {
                let width = low + (high - low) * step as f64 / (steps - 1).max(1) as f64;
                for &rule in rules {
                    let bound = best.as_ref().map_or(f64::INFINITY, |b| b.area(request.aspect));
                    // Beyond this height the box would be larger than the best one.
                    let ceiling = match request.aspect {
                        Some(aspect) => (bound / aspect).sqrt(),
                        None => bound / width,
                    };
                    let ceiling = match rule {
                        Rule::ShortSide => ceiling.min(total / FILLS[1] / width),
                        _ => ceiling,
                    };
                    let Some(size) = self.fill(sizes, &order, width, ceiling, rule, request.turns) else { continue };
                    let found = RectanglePacking { places: Vec::new(), size };
                    if best.as_ref().is_none_or(|b| found.area(request.aspect) < b.area(request.aspect)) {
                        best = Some(RectanglePacking { places: self.places.clone(), size });
                    }
                }
            }
        }
        best
    }

    /// Places all in that order into a strip of a width, and not above a ceiling; gives the size of the box about them.
    fn fill(
        &mut self,
        sizes: &[DVec2],
        order: &[usize],
        width: f64,
        ceiling: f64,
        rule: Rule,
        turns: bool,
    ) -> Option<DVec2> {
        let slack = 1e-9 * width;
        let height = if ceiling.is_finite() { ceiling } else { f64::MAX };
        self.free.clear();
        self.free.push(Span { low: DVec2::ZERO, high: DVec2::new(width + slack, height) });
        self.placed.clear();
        self.places.clear();
        self.places.resize(sizes.len(), PlacedRectangle { at: DVec2::ZERO, turned: false });
        let mut size = DVec2::ZERO;
        // What is narrower than all that are still to come is of no use.
        self.least.clear();
        self.least.resize(order.len() + 1, f64::INFINITY);
        for (k, &i) in order.iter().enumerate().rev() {
            self.least[k] = self.least[k + 1].min(sizes[i].min_element());
        }
        for (k, &i) in order.iter().enumerate() {
            let mut best: Option<((f64, f64), Span, bool)> = None;
            for free in &self.free {
                let room = free.high - free.low;
                for turned in [false, true] {
                    let own = if turned { DVec2::new(sizes[i].y, sizes[i].x) } else { sizes[i] };
                    if turned && (!turns || own.x == own.y) || own.x > room.x || own.y > room.y {
                        continue;
                    }
                    let span = Span { low: free.low, high: free.low + own };
                    let score = match rule {
                        Rule::Bottom => (span.high.y, span.low.x),
                        Rule::ShortSide => {
                            let left = room - own;
                            (left.min_element(), left.max_element())
                        }
                        Rule::Contact => (-self.contact(&span, width), span.high.y),
                    };
                    if best.as_ref().is_none_or(|b| score < b.0) {
                        best = Some((score, span, turned));
                    }
                }
            }
            let (_, span, turned) = best?;
            self.places[i] = PlacedRectangle { at: span.low, turned };
            size = size.max(span.high);
            self.placed.push(span);
            let least = self.least[k + 1];
            self.take(&span, least);
        }
        Some(size)
    }

    /// Length of a box' sides that lie on the left, lower and right side of the strip, or on others.
    fn contact(&self, span: &Span, width: f64) -> f64 {
        let near = 1e-9 * width;
        let common = |a: f64, b: f64, c: f64, d: f64| (b.min(d) - a.max(c)).max(0.0);
        let mut sum = 0.0;
        let (own, size) = (span, span.high - span.low);
        sum += if own.low.y <= near { size.x } else { 0.0 };
        sum += if own.low.x <= near { size.y } else { 0.0 };
        sum += if own.high.x >= width - near { size.y } else { 0.0 };
        for other in &self.placed {
            if (other.high.x - own.low.x).abs() <= near || (other.low.x - own.high.x).abs() <= near {
                sum += common(own.low.y, own.high.y, other.low.y, other.high.y);
            }
            if (other.high.y - own.low.y).abs() <= near || (other.low.y - own.high.y).abs() <= near {
                sum += common(own.low.x, own.high.x, other.low.x, other.high.x);
            }
        }
        sum
    }

    /// Takes a box out of the free rectangles, which stay maximal; those that are narrower than `least` go.
    fn take(&mut self, span: &Span, least: f64) {
        self.fresh.clear();
        let mut k = 0;
        while k < self.free.len() {
            let free = self.free[k];
            if !free.meets(span) {
                k += 1;
                continue;
            }
            self.free.swap_remove(k);
            let parts = [
                Span { high: DVec2::new(span.low.x, free.high.y), ..free },
                Span { low: DVec2::new(span.high.x, free.low.y), ..free },
                Span { high: DVec2::new(free.high.x, span.low.y), ..free },
                Span { low: DVec2::new(free.low.x, span.high.y), ..free },
            ];
            self.fresh.extend(parts.into_iter().filter(|p| (p.high - p.low).min_element() >= least));
        }
        // Only what is new can lie in another: the old ones were maximal.
        for n in 0..self.fresh.len() {
            let own = self.fresh[n];
            let inside = |(m, other): (usize, &Span)| m != n && other.holds(&own) && (m < n || *other != own);
            if !self.free.iter().any(|f| f.holds(&own)) && !self.fresh.iter().enumerate().any(inside) {
                self.kept.push(own);
            }
        }
        self.free.append(&mut self.kept);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packing::Random;

    const FREE: RectangleRequest = RectangleRequest { turns: true, aspect: None, widths: 8 };

    fn is_sound(sizes: &[DVec2], packing: &RectanglePacking, turns: bool) {
        let spans: Vec<Span> = sizes
            .iter()
            .zip(&packing.places)
            .map(|(s, p)| {
                assert!(turns || !p.turned);
                let s = if p.turned { DVec2::new(s.y, s.x) } else { *s };
                Span { low: p.at, high: p.at + s }
            })
            .collect();
        for (i, a) in spans.iter().enumerate() {
            assert!(a.low.cmpge(DVec2::ZERO).all() && a.high.cmple(packing.size * (1.0 + 1e-12)).all());
            for b in &spans[i + 1..] {
                let common = a.high.min(b.high) - a.low.max(b.low);
                assert!(common.min_element() < 1e-9 * packing.size.max_element(), "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn nothing_overlaps_and_the_box_holds_all() {
        let mut random = Random::new(3);
        for round in 0..120 {
            let n = if round == 0 { 1200 } else { 1 + random.below(40) };
            let sizes: Vec<DVec2> =
                (0..n).map(|_| DVec2::new(0.1 + 3.0 * random.unit(), 0.1 + random.unit().powi(3))).collect();
            let turns = round % 3 != 1;
            let aspect = (round % 4 == 2).then_some(1.5);
            let packing = RectanglePacker::default().pack(&sizes, &RectangleRequest { turns, aspect, ..FREE }).unwrap();
            is_sound(&sizes, &packing, turns);
            let total: f64 = sizes.iter().map(|s| s.element_product()).sum();
            assert!(packing.area(aspect) >= total * (1.0 - 1e-12));
            if n > 20 {
                assert!(total / packing.area(None) > 0.8, "{n}: {}", total / packing.area(None));
            }
        }
        assert_eq!(RectanglePacker::default().pack(&[], &FREE), None);
    }

    #[test]
    fn what_tiles_a_box_is_put_together() {
        let pack =
            |sizes: &[DVec2], request: &RectangleRequest| RectanglePacker::default().pack(sizes, request).unwrap();
        assert_eq!(pack(&[DVec2::ONE; 9], &FREE).area(None), 9.0);
        // Five pieces about a square, as a pinwheel.
        let pinwheel = [[2.0, 1.0], [2.0, 1.0], [1.0, 2.0], [1.0, 2.0], [1.0, 1.0]].map(DVec2::from);
        assert!(pack(&pinwheel, &RectangleRequest { widths: 40, ..FREE }).area(None) <= 10.0);
        // A single one has the aspect that it has; of a given aspect, the box about it counts.
        let one = pack(&[DVec2::new(10.0, 1.0)], &FREE);
        assert_eq!((one.area(None), one.area(Some(1.0))), (10.0, 100.0));
    }
}
