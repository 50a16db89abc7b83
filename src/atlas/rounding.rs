//! Texture coordinates that 32 bits hold exactly, without turning faces over.
//!
//! Between 0 and 1 all multiples of 2^-24 are exact in 32 bits. So an Atlas on that grid is delivered as it is in memory, and rounding,
//! which turns slivers over, can be mended where it is known what they were.

use glam::DVec2;

use super::groups::{Grouped, sorted_unique};
use super::{Atlas, FaceId, UvId, orientation};

/// Steps along the side of a sheet.
pub(crate) const STEPS: f64 = (1 << 24) as f64;
/// How far vertices may be moved to mend a face, in steps.
const REACH: i32 = 4;
/// Rounds over all faces that are wrong.
const ROUNDS: usize = 12;

/// Which way round a face is to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Facing {
    /// Like this sign, or without area.
    NotAgainst(i8),
    /// Like this sign.
    Like(i8),
}

impl Facing {
    fn is_met(self, triangle: [DVec2; 3]) -> bool {
        let [a, b, c] = triangle;
        match self {
            Facing::NotAgainst(sign) => orientation(a, b, c) * sign >= 0,
            Facing::Like(sign) => orientation(a, b, c) * sign > 0,
        }
    }
}

/// Whether all UV vertices lie on the grid, so that writing changes none.
pub(crate) fn is_rounded(atlas: &Atlas) -> bool {
    let mut any = false;
    let is_on = |(corners, page): (&[UvId; 3], &u16)| {
        let Some(sheet) = atlas.sheets.get(usize::from(*page)) else { return false };
        let step = DVec2::from(sheet.map(f64::from)) / STEPS;
        any = true;
        corners.iter().all(|u| atlas.uv.get(u.index()).is_some_and(|uv| (*uv / step).round() * step == *uv))
    };
    atlas.corners.iter().zip(&atlas.page).all(is_on) && any
}

/// Puts all UV vertices on a grid of so many steps along the sides of their sheets, a power of two up to [`STEPS`]; vertices of faces that do not face as they are to are moved by a few steps more. Gives the faces
/// for which that did not help. `facing` by face.
pub(crate) fn round_uvs(atlas: &mut Atlas, facing: &[Facing], steps: f64) -> Vec<FaceId> {
    let mut step = vec![DVec2::ONE; atlas.uv.len()];
    for f in atlas.faces() {
        let sheet = atlas.sheets[usize::from(atlas.page[f.index()])].map(f64::from);
        atlas.corners[f.index()].iter().for_each(|u| step[u.index()] = DVec2::from(sheet) / steps);
    }
    for (uv, step) in atlas.uv.iter_mut().zip(&step) {
        *uv = (*uv / *step).round().clamp(DVec2::ZERO, DVec2::splat(steps)) * *step;
    }
    let is_wrong = |atlas: &Atlas, f: FaceId| !facing[f.index()].is_met(atlas.uv_triangle(f));
    let mut wrong: Vec<FaceId> = atlas.faces().filter(|f| is_wrong(atlas, *f)).collect();
    if wrong.is_empty() {
        return wrong;
    }
    let corners = atlas.corners.iter().zip(0..).flat_map(|(own, f)| own.map(|u| (u.0, f)));
    let stars: Grouped<u32> = Grouped::new(atlas.uv.len(), corners);
    let near = near();
    for _ in 0..ROUNDS {
        let before = wrong.len();
        let mut touched = Vec::new();
        for f in std::mem::take(&mut wrong) {
            if is_wrong(atlas, f) {
                mend(atlas, f, &stars, &step, steps, &near, &is_wrong);
                touched.extend(atlas.corners[f.index()].iter().flat_map(|u| stars.of(u.0)).map(|f| FaceId(*f)));
            }
        }
        wrong = sorted_unique(touched).into_iter().filter(|f| is_wrong(atlas, *f)).collect();
        if wrong.is_empty() || wrong.len() > 2 * before {
            break;
        }
    }
    wrong
}

/// Moves one corner of a face to the nearest place with the fewest wrong faces about it, where those are fewer than before.
fn mend(
    atlas: &mut Atlas,
    face: FaceId,
    stars: &Grouped<u32>,
    step: &[DVec2],
    steps: f64,
    near: &[DVec2],
    is_wrong: &dyn Fn(&Atlas, FaceId) -> bool,
) {
    let mut best: Option<(i64, usize, UvId, DVec2)> = None;
    for u in atlas.corners[face.index()] {
        let count = |atlas: &Atlas| stars.of(u.0).iter().filter(|f| is_wrong(atlas, FaceId(**f))).count() as i64;
        let (at, before) = (atlas.uv[u.index()], count(atlas));
        for (k, by) in near.iter().enumerate() {
            let own = at + *by * step[u.index()];
            if own.min_element() < 0.0 || (own / step[u.index()]).max_element() > steps {
                continue;
            }
            atlas.uv[u.index()] = own;
            let gained = count(atlas) - before;
            if gained < 0 && best.as_ref().is_none_or(|b| (gained, k) < (b.0, b.1)) {
                best = Some((gained, k, u, own));
            }
        }
        atlas.uv[u.index()] = at;
    }
    if let Some((_, _, u, at)) = best {
        atlas.uv[u.index()] = at;
    }
}

/// Steps to places in reach, the nearest first.
fn near() -> Vec<DVec2> {
    let reach = -REACH..=REACH;
    let all = reach.clone().flat_map(|x| reach.clone().map(move |y| DVec2::new(f64::from(x), f64::from(y))));
    let mut out: Vec<DVec2> = all.filter(|p| *p != DVec2::ZERO).collect();
    out.sort_by(|a, b| {
        a.length_squared().total_cmp(&b.length_squared()).then(a.x.total_cmp(&b.x)).then(a.y.total_cmp(&b.y))
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::{Rng, sheet};

    /// A grid of faces so flat that rounding turns many of them over.
    fn flat(rng: &mut Rng) -> Atlas {
        let mut atlas = sheet(12, 12, DVec2::ZERO);
        atlas.sheets = vec![[4096, 2048]];
        let low = atlas.uv.iter().copied().fold(DVec2::INFINITY, DVec2::min);
        let high = atlas.uv.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
        let size = DVec2::new(3000.0, 3000.0 / STEPS * 8.0);
        let turn = DVec2::from_angle(0.3);
        for uv in &mut atlas.uv {
            let jitter = (rng.point(0.3) - 0.15) * DVec2::new(0.1, 0.1);
            *uv = turn.rotate(((*uv - low) / (high - low) + jitter * 0.05) * size) + 600.0;
        }
        atlas
    }

    #[test]
    fn what_is_rounded_is_exact_in_32_bits_and_faces_as_before() {
        let mut rng = Rng(4);
        let mut turned = 0;
        for _ in 0..8 {
            let before = flat(&mut rng);
            let sign = |f: FaceId| {
                let [a, b, c] = before.uv_triangle(f);
                orientation(a, b, c)
            };
            let facing: Vec<Facing> = before.faces().map(|f| Facing::Like(sign(f))).collect();
            let mut after = before.clone();
            assert!(!is_rounded(&before));
            assert_eq!(round_uvs(&mut after, &facing, STEPS), []);
            assert!(is_rounded(&after));
            let size = DVec2::new(4096.0, 2048.0);
            let written = |uv: DVec2| {
                let own = uv / size;
                DVec2::new(f64::from(own.x as f32), f64::from(own.y as f32)) * size
            };
            let step = size / STEPS;
            for (a, b) in before.uv.iter().zip(&after.uv) {
                assert_eq!(written(*b), *b);
                assert!(((*a - *b) / step).abs().max_element() < f64::from(REACH * 8), "{a} {b}");
            }
            let mut plain = before.clone();
            plain.uv.iter_mut().for_each(|uv| *uv = written(*uv));
            turned += before.faces().filter(|f| !facing[f.index()].is_met(plain.uv_triangle(*f))).count();
        }
        assert!(turned > 0, "rounding alone turns none");
    }

    #[test]
    fn what_cannot_be_is_told() {
        let mut atlas = sheet(2, 2, DVec2::ZERO);
        let facing: Vec<Facing> = atlas
            .faces()
            .map(|f| {
                let [a, b, c] = atlas.uv_triangle(f);
                if f.0 == 3 { Facing::Like(-orientation(a, b, c)) } else { Facing::Like(orientation(a, b, c)) }
            })
            .collect();
        assert_eq!(round_uvs(&mut atlas, &facing, STEPS), [FaceId(3)]);
    }
}
