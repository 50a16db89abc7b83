//! A piece as the edges that rasterising it needs.

use glam::{DMat2, DVec2};

use super::Piece;
use super::mask::{Mask, on_border};
use super::shape::frame;
use crate::atlas::bvh::Bounds;

/// A piece's directed border, and the triangles that do not turn the way most do.
#[derive(Debug)]
pub(crate) struct Outline {
    /// Edges without their opposite: with all triangles the right way round, what is inside is to the left of each.
    border: Vec<[DVec2; 2]>,
    /// Triangles that are turned over or have no area.
    folded: Vec<[DVec2; 3]>,
}

impl Outline {
    /// Finds the border: directed edges without their opposite. Where all triangles turn the same way round, a point that k of
    /// them cover has winding number ±k about it, so that filling by winding number loses nothing even where the chart
    /// overlaps itself; only what those cover that turn the other way round may be lost, so they are kept apart.
    pub fn new(piece: &Piece) -> Self {
        let sign = |t: &[DVec2; 3]| (t[1] - t[0]).perp_dot(t[2] - t[0]);
        let turned =
            |right: bool| piece.triangles.iter().filter(|t| (sign(t) < 0.0) == right && sign(t) != 0.0).count();
        let side = if turned(true) > turned(false) { -1.0 } else { 1.0 };
        let right_way = |t: &[DVec2; 3]| side * sign(t) > 0.0;
        let folded = piece.triangles.iter().filter(|t| !right_way(t)).copied().collect();
        let bits = |p: DVec2| [(p.x + 0.0).to_bits(), (p.y + 0.0).to_bits()];
        // An edge and its opposite get the same key, and signs that cancel.
        let mut edges: Vec<([[u64; 2]; 2], i32, [DVec2; 2])> = Vec::with_capacity(3 * piece.triangles.len());
        for t in piece.triangles.iter().filter(|t| t.iter().all(|p| p.is_finite())) {
            for k in 0..3 {
                let (a, b) = (t[k], t[(k + 1) % 3]);
                let (p, q) = (bits(a), bits(b));
                if p != q {
                    edges.push(if p < q { ([p, q], 1, [a, b]) } else { ([q, p], -1, [b, a]) });
                }
            }
        }
        edges.sort_unstable_by_key(|e| (e.0, e.1));
        let mut border = Vec::new();
        for same in edges.chunk_by(|a, b| a.0 == b.0) {
            let sum: i32 = same.iter().map(|e| e.1).sum();
            let [a, b] = same[0].2;
            let edge = if sum > 0 { [a, b] } else { [b, a] };
            border.extend(std::iter::repeat_n(edge, sum.unsigned_abs() as usize));
        }
        Outline { border, folded }
    }

    /// About how many words rasterising looks at.
    pub fn work(&self) -> u64 {
        8 * (self.border.len() + self.folded.len()) as u64
    }

    /// Sides of the bounding box after the linear map.
    pub fn sides(&self, linear: DMat2) -> DVec2 {
        self.bounds(linear).size()
    }

    fn bounds(&self, linear: DMat2) -> Bounds {
        let points = self.border.iter().flatten().chain(self.folded.iter().flatten());
        Bounds::around(points.map(|p| linear * *p)).or_zero()
    }

    /// The cells that the piece touches, and what is subtracted from turned coordinates so that the mask's corner is the origin.
    pub fn raster(&self, linear: DMat2, cell: f64, lattice: Option<usize>) -> (Mask, DVec2) {
        let (anchor, [width, height]) = frame(self.bounds(linear), cell, lattice);
        let place = |p: DVec2| (linear * p - anchor) / cell;
        let border: Vec<[DVec2; 2]> = self.border.iter().map(|e| e.map(place)).collect();
        let mut mask = Mask::new(width, height);
        for t in &self.folded {
            mask.add_triangle(&t.map(place));
        }
        for [a, b] in border.iter().copied() {
            // An edge between two cells touches neither; what is inside has its own cells.
            if !(on_border(a.x, b.x) || on_border(a.y, b.y)) {
                mask.add_triangle(&[a, b, b]);
            }
        }
        fill(&border, &mut mask);
        (mask, anchor)
    }
}

/// Sets the cells whose centres the border winds about; the border's own cells are set already.
pub(crate) fn fill(border: &[[DVec2; 2]], mask: &mut Mask) {
    // Crossings of the centre line of each row: (row, x, direction).
    let mut crossings: Vec<(u32, f64, i32)> = Vec::new();
    for &[a, b] in border {
        let (direction, a, b) = if a.y < b.y { (1, a, b) } else { (-1, b, a) };
        let first = (a.y - 0.5).ceil().max(0.0) as usize;
        let slope = (b.x - a.x) / (b.y - a.y);
        for row in first..mask.height {
            let y = row as f64 + 0.5;
            if y >= b.y {
                break;
            }
            crossings.push((row as u32, a.x + (y - a.y) * slope, direction));
        }
    }
    crossings.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
    for line in crossings.chunk_by(|a, b| a.0 == b.0) {
        let mut winding = 0;
        for pair in line.windows(2) {
            winding += pair[0].2;
            // Cells with their centre between the crossings.
            let (first, last) = ((pair[0].1 - 0.5).ceil().max(0.0), (pair[1].1 - 0.5).floor());
            if winding != 0 && first <= last {
                let last = (last as usize).min(mask.width - 1);
                mask.set_run(pair[0].0 as usize, (first as usize).min(last), last);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packing::random::Random;

    /// A fan of triangles about a point: all turn the same way round, and the last ones may lie over the first.
    fn fan(random: &mut Random, turns: f64) -> Piece {
        let steps = 5 + random.below(30);
        let rim: Vec<DVec2> = (0..=steps)
            .map(|k| DVec2::from_angle(turns * k as f64 / steps as f64) * (3.0 + 20.0 * random.unit()))
            .collect();
        Piece { triangles: rim.windows(2).map(|w| [DVec2::ZERO, w[0], w[1]]).collect(), ..Piece::default() }
    }

    #[test]
    fn the_outline_covers_what_the_triangles_cover() {
        let mut random = Random::new(2);
        for round in 0..200 {
            let mut piece = fan(&mut random, [3.0, 6.0, 9.0][round % 3]);
            if round % 5 == 0 {
                // Folded over: filling by winding number would lose cells.
                piece.triangles.extend(fan(&mut random, -4.0).triangles);
            }
            let outline = Outline::new(&piece);
            assert_eq!(outline.folded.is_empty(), round % 5 != 0);
            let linear = DMat2::from_angle(7.0 * random.unit());
            let (mask, anchor) = outline.raster(linear, 0.7, None);
            let turned: Vec<_> = piece.triangles.iter().map(|t| t.map(|p| (linear * p - anchor) / 0.7)).collect();
            let plain = Mask::of_triangles(&turned, mask.width, mask.height);
            for y in 0..mask.height {
                for x in 0..mask.width {
                    assert!(mask.get(x, y) || !plain.get(x, y), "{round}: {x} {y}");
                }
            }
            assert!(mask.count() <= plain.count(), "{round}");
        }
    }

    #[test]
    fn whole_texels_own_their_cells_alone() {
        let mut random = Random::new(5);
        for round in 0..100 {
            let corner = |x: usize, y: usize| DVec2::new(x as f64, y as f64);
            let mut piece = Piece::default();
            for (x, y) in (0..8).flat_map(|y| (0..8).map(move |x| (x, y))) {
                if random.below(3) > 0 {
                    let [a, b, c, d] = [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(i, j)| corner(x + i, y + j));
                    piece.triangles.extend([[a, b, c], if round % 4 == 0 && x == y { [d, c, a] } else { [a, c, d] }]);
                }
            }
            let outline = Outline::new(&piece);
            for turn in
                [DMat2::IDENTITY, DMat2::from_cols(DVec2::Y, DVec2::NEG_X), DMat2::from_diagonal(DVec2::NEG_ONE)]
            {
                let (mask, anchor) = outline.raster(turn, 1.0, Some(1));
                let turned: Vec<_> = piece.triangles.iter().map(|t| t.map(|p| turn * p - anchor)).collect();
                assert_eq!(mask, Mask::of_triangles(&turned, mask.width, mask.height), "{round}");
                assert_eq!(2 * mask.count(), piece.triangles.len());
            }
        }
    }
}
