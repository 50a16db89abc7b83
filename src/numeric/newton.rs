//! Projected Newton (Teran et al. 2005) with a line search that turns no triangle over (Smith and Schaefer 2015, section 3.3).

use glam::DVec2;

use super::dirichlet::{RestTriangle, step_bound};
use super::multifrontal::{FIXED, Factor, Structure};

/// A triangle whose deformation costs energy.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Element {
    /// Its vertices.
    pub corners: [u32; 3],
    /// What it is at rest.
    pub rest: RestTriangle,
}

impl Element {
    fn at(&self, x: &[DVec2]) -> [DVec2; 3] {
        self.corners.map(|v| x[v as usize])
    }
}

/// What a step did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Step {
    /// Energy before.
    pub before: f64,
    /// Energy after: never more.
    pub after: f64,
    /// Part of the Newton step that was taken; 0 where none lowers the energy.
    pub alpha: f64,
    /// Length of the gradient before.
    pub gradient: f64,
}

/// How close to the collapse of a triangle a step may go.
const NEAREST: f64 = 0.9;
/// Armijo's condition asks for this part of the decrease that the slope promises.
const SUFFICIENT: f64 = 1e-4;
/// Added to the diagonal of the Hessian, in parts of the mean weight of an element.
const RIDGE: f64 = 1e-8;

/// Room that steps use again.
#[derive(Debug, Default)]
pub(crate) struct Workspace {
    /// Place among the free vertices, by vertex.
    place: Vec<u32>,
    factor: Factor,
}

/// The sum of the elements' energies.
pub(crate) fn energy(x: &[DVec2], elements: &[Element]) -> f64 {
    elements.iter().map(|e| e.rest.energy(e.at(x))).sum()
}

/// One step that moves the `free` vertices of `x`. All elements must be injective before, and stay so. `None` where the
/// energy is not finite.
pub(crate) fn step(x: &mut [DVec2], elements: &[Element], free: &[u32], workspace: &mut Workspace) -> Option<Step> {
    let Workspace { place, factor } = workspace;
    place.resize(x.len().max(place.len()), FIXED);
    free.iter().enumerate().for_each(|(k, &v)| place[v as usize] = k as u32);
    let triangles: Vec<[u32; 3]> = elements.iter().map(|e| e.corners.map(|v| place[v as usize])).collect();
    free.iter().for_each(|&v| place[v as usize] = FIXED);

    let mut before = 0.0;
    let mut p = vec![DVec2::ZERO; free.len()];
    for (element, places) in elements.iter().zip(&triangles) {
        let (own, gradient) = element.rest.gradient(element.at(x));
        before += own;
        for (place, g) in places.iter().zip(gradient) {
            if *place != FIXED {
                p[*place as usize] -= g;
            }
        }
    }
    if !before.is_finite() {
        return None;
    }
    let gradient = p.iter().map(|g| g.length_squared()).sum::<f64>().sqrt();
    let downhill = p.clone();
    let at: Vec<DVec2> = free.iter().map(|&v| x[v as usize]).collect();
    let structure = Structure::new(&at, &triangles);
    let mean = elements.iter().map(|e| e.rest.weight).sum::<f64>() / elements.len().max(1) as f64;
    let mut ridge = RIDGE * mean;
    let hessian = |e: u32| elements[e as usize].rest.projected_hessian(elements[e as usize].at(x));
    while !structure.factor(ridge, hessian, factor) {
        ridge *= 100.0;
        if ridge.is_nan() || ridge > 1e9 {
            return None;
        }
    }
    structure.solve(factor, &mut p);

    let slope: f64 = -downhill.iter().zip(&p).map(|(g, p)| g.dot(*p)).sum::<f64>();
    let direction = |place: u32| if place == FIXED { DVec2::ZERO } else { p[place as usize] };
    let bound = elements
        .iter()
        .zip(&triangles)
        .map(|(e, places)| step_bound(e.at(x), places.map(direction)))
        .fold(f64::INFINITY, f64::min);
    let mut alpha = (NEAREST * bound).min(1.0);
    let none = Step { before, after: before, alpha: 0.0, gradient };
    if slope.is_nan() || slope >= 0.0 {
        return Some(none);
    }
    for _ in 0..40 {
        free.iter().zip(at.iter().zip(&p)).for_each(|(&v, (at, p))| x[v as usize] = *at + alpha * *p);
        let after = energy(x, elements);
        if after <= before + SUFFICIENT * alpha * slope {
            return Some(Step { before, after, alpha, gradient });
        }
        alpha *= 0.5;
    }
    free.iter().zip(&at).for_each(|(&v, at)| x[v as usize] = *at);
    Some(none)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;

    #[test]
    fn a_deformed_grid_goes_back_to_an_isometry() {
        let mut rng = Rng(17);
        let side = 12;
        let at = |i: usize, j: usize| (i * side + j) as u32;
        let rest: Vec<DVec2> = (0..side * side).map(|k| DVec2::new((k % side) as f64, (k / side) as f64)).collect();
        let mut elements = Vec::new();
        for i in 0..side - 1 {
            for j in 0..side - 1 {
                for corners in [[at(i, j), at(i, j + 1), at(i + 1, j)], [at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)]]
                {
                    let rest = RestTriangle::new(corners.map(|v| rest[v as usize]), 1.0).expect("it has an area");
                    elements.push(Element { corners, rest });
                }
            }
        }
        let mut x: Vec<DVec2> =
            rest.iter().map(|p| DVec2::new(2.0 * p.x + 0.3 * p.y, 0.5 * p.y) + rng.point(0.1)).collect();
        let free: Vec<u32> = (1..(side * side) as u32).collect();
        let mut workspace = Workspace::default();
        let mut last = f64::INFINITY;
        for _ in 0..40 {
            let step = step(&mut x, &elements, &free, &mut workspace).expect("finite");
            assert!(step.after <= step.before && step.before <= last);
            last = step.after;
        }
        let isometry = 4.0 * elements.len() as f64;
        assert!((last - isometry).abs() < 1e-9 * isometry, "{last}");
    }
}
