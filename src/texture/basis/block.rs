//! Blocks of 4 x 4 texels, and ETC1S: one colour of 5 bits a channel, one of eight tables of steps along the greys, two bits a texel.

/// Texels of a block, row by row.
pub(super) type Texels = [[u8; 3]; 16];

/// Steps of each table, from the darkest (ETC1).
const STEPS: [[i32; 4]; 8] = [
    [-8, -2, 2, 8],
    [-17, -5, 5, 17],
    [-29, -9, 9, 29],
    [-42, -13, 13, 42],
    [-60, -18, 18, 60],
    [-80, -24, 24, 80],
    [-106, -33, 33, 106],
    [-183, -47, 47, 183],
];

/// Colour and table of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub(super) struct Endpoint {
    /// Five bits a channel.
    pub(super) colour: [u8; 3],
    /// Number of the table.
    pub(super) table: u8,
}

/// Which of its four colours each texel has: two bits a texel, row by row from the lowest.
pub(super) type Pattern = u32;

/// Squared differences by texel and colour.
pub(super) type Errors = [[u32; 4]; 16];

/// The colour of a texel in a pattern.
pub(super) fn selector(pattern: Pattern, texel: usize) -> usize {
    (pattern >> (2 * texel) & 3) as usize
}

fn widened(five: u8) -> i32 {
    i32::from(five << 3 | five >> 2)
}

impl Endpoint {
    /// Its four colours.
    pub(super) fn colours(self) -> [[u8; 3]; 4] {
        STEPS[usize::from(self.table & 7)].map(|step| self.colour.map(|c| (widened(c) + step).clamp(0, 255) as u8))
    }

    /// The darkest and the brightest colour, as if there were no bounds: what endpoints are compared by.
    pub(super) fn span(self) -> [f32; 6] {
        let [low, .., high] = STEPS[usize::from(self.table & 7)];
        let [r, g, b] = self.colour.map(widened);
        [r + low, g + low, b + low, r + high, g + high, b + high].map(|v| v as f32)
    }

    /// The endpoint whose span is nearest to one, about.
    pub(super) fn of_span(span: &[f32; 6]) -> Self {
        let half = (0..3).map(|c| span[c + 3] - span[c]).sum::<f32>() / 6.0;
        let off = |t: &usize| (STEPS[*t][3] as f32 - half).abs();
        let table = (0..8).min_by(|a, b| off(a).total_cmp(&off(b))).unwrap_or(0);
        let five = |c: usize| ((span[c] + span[c + 3]) * 0.5 * 31.0 / 255.0).round().clamp(0.0, 31.0) as u8;
        Endpoint { colour: [five(0), five(1), five(2)], table: table as u8 }
    }

    /// What each texel of a block loses with each of the colours.
    pub(super) fn errors(self, texels: &Texels) -> Errors {
        let colours = self.colours();
        texels.map(|texel| colours.map(|colour| (0..3).map(|c| u32::from(texel[c].abs_diff(colour[c])).pow(2)).sum()))
    }

    /// A block of it.
    pub(super) fn texels(self, pattern: Pattern) -> Texels {
        let colours = self.colours();
        std::array::from_fn(|i| colours[selector(pattern, i)])
    }
}

/// The pattern that loses least, and what it loses.
pub(super) fn best_pattern(errors: &Errors) -> (Pattern, u32) {
    let (mut pattern, mut sum) = (0, 0);
    for (i, errors) in errors.iter().enumerate() {
        let (best, error) = errors.iter().enumerate().min_by_key(|(_, e)| **e).unwrap_or((0, &0));
        pattern |= (best as u32) << (2 * i);
        sum += error;
    }
    (pattern, sum)
}

/// What a pattern loses, if that is less than `limit`.
pub(super) fn error_below(errors: &Errors, pattern: Pattern, limit: f64) -> Option<u32> {
    let mut sum = 0;
    for (k, rows) in errors.chunks_exact(4).enumerate() {
        sum += rows.iter().enumerate().map(|(i, errors)| errors[selector(pattern, 4 * k + i)]).sum::<u32>();
        if f64::from(sum) >= limit {
            return None;
        }
    }
    Some(sum)
}

/// What a pattern loses.
#[cfg(test)]
pub(super) fn error(errors: &Errors, pattern: Pattern) -> u32 {
    errors.iter().enumerate().map(|(i, errors)| errors[selector(pattern, i)]).sum()
}

/// How far a table's largest step may be from how far the texels lie from their mean, as a factor.
const REACH: [f32; 2] = [0.4, 2.2];

/// The endpoint and pattern that lose least, about: every table that reaches as far as the texels do, with the colour that fits the pattern best,
/// in turns.
pub(super) fn fit(texels: &Texels) -> (Endpoint, Pattern, u32) {
    let mean: [f32; 3] = std::array::from_fn(|c| texels.iter().map(|t| f32::from(t[c])).sum::<f32>() / 16.0);
    let five = |v: f32| (v * 31.0 / 255.0).round().clamp(0.0, 31.0) as u8;
    let grey = mean.iter().sum::<f32>();
    let reach =
        texels.iter().map(|t| (t.iter().map(|v| f32::from(*v)).sum::<f32>() - grey).abs() / 3.0).fold(0.0, f32::max);
    let reaches = |table: &u8| {
        let step = STEPS[usize::from(*table)][3] as f32;
        (step >= REACH[0] * reach || *table == 7) && (step <= REACH[1] * reach || *table == 0)
    };
    let mut best = (Endpoint::default(), 0, u32::MAX);
    for table in (0..8u8).filter(reaches) {
        let mut endpoint = Endpoint { colour: mean.map(five), table };
        for _ in 0..3 {
            let (pattern, error) = best_pattern(&endpoint.errors(texels));
            if error < best.2 {
                best = (endpoint, pattern, error);
            }
            let steps = &STEPS[usize::from(table)];
            let step = (0..16).map(|i| steps[selector(pattern, i)]).sum::<i32>() as f32 / 16.0;
            let colour = mean.map(|v| five(v - step));
            if colour == endpoint.colour {
                break;
            }
            endpoint.colour = colour;
        }
        if best.2 == 0 {
            break;
        }
    }
    best
}

/// What an ETC1 block of an ETC1S file holds: bytes as they are on a GPU.
pub(super) fn of_etc1(block: [u8; 8]) -> (Endpoint, Pattern) {
    let endpoint = Endpoint { colour: [block[0] >> 3, block[1] >> 3, block[2] >> 3], table: block[3] >> 5 };
    let high = u16::from_be_bytes([block[4], block[5]]);
    let low = u16::from_be_bytes([block[6], block[7]]);
    // ETC1 goes down the columns, and numbers small and large steps up, then down.
    let mut pattern = 0;
    for x in 0..4 {
        for y in 0..4 {
            let at = 4 * x + y;
            let selector = match (high >> at & 1, low >> at & 1) {
                (1, 1) => 0,
                (1, 0) => 1,
                (0, 0) => 2,
                _ => 3,
            };
            pattern |= selector << (2 * (4 * y + x));
        }
    }
    (endpoint, pattern)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_that_can_be_told_is_told() {
        let mut seed = 7u32;
        let mut next = || {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            seed >> 8
        };
        let (mut exact, mut lost) = (0, 0);
        for _ in 0..500 {
            let endpoint =
                Endpoint { colour: std::array::from_fn(|_| 6 + (next() % 20) as u8), table: (next() % 4) as u8 };
            let pattern = next() ^ next() << 12;
            let texels = endpoint.texels(pattern);
            let (found, with, error) = fit(&texels);
            assert_eq!(super::error(&found.errors(&texels), with), error);
            assert_eq!(found.texels(with) == texels, error == 0);
            exact += usize::from(error == 0);
            lost += error;
        }
        assert!(exact > 450, "{exact}");
        assert!(lost / 500 < 120, "{lost}");
    }

    #[test]
    fn spans_lead_back() {
        for table in 0..8 {
            for five in 0..32 {
                let endpoint = Endpoint { colour: [five, 31 - five, five / 2], table };
                assert_eq!(Endpoint::of_span(&endpoint.span()), endpoint);
            }
        }
    }
}
