//! Projected Newton (Teran et al. 2005) with a line search that turns no triangle over (Smith and Schaefer 2015, section 3.3).

use glam::{DMat2, DVec2};

use super::alignment::AlignedEdge;
use super::dirichlet::{RestTriangle, step_bound};
use super::lbfgs::Memory;
use super::multifrontal::{FIXED, Factor, Structure};

/// What costs energy.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Element {
    /// A triangle whose deformation does.
    Triangle {
        /// Its vertices.
        corners: [u32; 3],
        /// What it is at rest.
        rest: RestTriangle,
    },
    /// An edge that is to turn.
    Edge(AlignedEdge),
}

impl Element {
    /// Its vertices; [`FIXED`] where it has fewer than three.
    pub fn corners(&self) -> [u32; 3] {
        match self {
            Element::Triangle { corners, .. } => *corners,
            Element::Edge(edge) => [edge.ends[0], edge.ends[1], FIXED],
        }
    }

    fn weight(&self) -> f64 {
        match self {
            Element::Triangle { rest, .. } => rest.weight,
            Element::Edge(_) => 0.0,
        }
    }

    fn energy(&self, x: &[DVec2]) -> f64 {
        match self {
            Element::Triangle { corners, rest } => rest.energy(corners.map(|v| x[v as usize])),
            Element::Edge(edge) => edge.energy(vector(edge, x)),
        }
    }

    fn gradient(&self, x: &[DVec2]) -> (f64, [DVec2; 3]) {
        match self {
            Element::Triangle { corners, rest } => rest.gradient(corners.map(|v| x[v as usize])),
            Element::Edge(edge) => {
                let e = vector(edge, x);
                let gradient = edge.gradient(e);
                (edge.energy(e), [-gradient, gradient, DVec2::ZERO])
            }
        }
    }

    fn projected_hessian(&self, x: &[DVec2]) -> [DMat2; 6] {
        match self {
            Element::Triangle { corners, rest } => rest.projected_hessian(corners.map(|v| x[v as usize])),
            Element::Edge(edge) => {
                let own = edge.projected_hessian(vector(edge, x));
                [own, -own, own, DMat2::ZERO, DMat2::ZERO, DMat2::ZERO]
            }
        }
    }

    /// How far along the directions `p` of its corners it can go.
    fn step_bound(&self, x: &[DVec2], p: [DVec2; 3]) -> f64 {
        match self {
            Element::Triangle { corners, .. } => step_bound(corners.map(|v| x[v as usize]), p),
            Element::Edge(_) => f64::INFINITY,
        }
    }
}

/// An edge as it lies.
fn vector(edge: &AlignedEdge, x: &[DVec2]) -> DVec2 {
    x[edge.ends[1] as usize] - x[edge.ends[0] as usize]
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
    /// The order of elimination of the last step, and what it is of.
    structure: Option<(Vec<[u32; 3]>, Structure)>,
}

/// The sum of the elements' energies.
pub(crate) fn energy(x: &[DVec2], elements: &[Element]) -> f64 {
    elements.iter().map(|e| e.energy(x)).sum()
}

/// One step that moves the `free` vertices of `x`. All elements must be injective before, and stay so. `None` where the
/// energy is not finite.
pub(crate) fn step(x: &mut [DVec2], elements: &[Element], free: &[u32], workspace: &mut Workspace) -> Option<Step> {
    steps(x, elements, free, workspace, 1)
}

/// The same, and then up to `most` - 1 steps more by L-BFGS on the factor of the first one: each costs a solution and no factorisation. Tells the
/// energies before the first and after the last.
pub(crate) fn steps(
    x: &mut [DVec2],
    elements: &[Element],
    free: &[u32],
    workspace: &mut Workspace,
    most: usize,
) -> Option<Step> {
    let Workspace { place, factor, structure } = workspace;
    place.resize(x.len().max(place.len()), FIXED);
    free.iter().enumerate().for_each(|(k, &v)| place[v as usize] = k as u32);
    let place_of = |v: u32| if v == FIXED { FIXED } else { place[v as usize] };
    let triangles: Vec<[u32; 3]> = elements.iter().map(|e| e.corners().map(place_of)).collect();
    free.iter().for_each(|&v| place[v as usize] = FIXED);
    let problem = Problem { elements, free, triangles: &triangles };

    let (before, mut downhill) = problem.downhill(x);
    if !before.is_finite() {
        return None;
    }
    let at: Vec<DVec2> = free.iter().map(|&v| x[v as usize]).collect();
    // What moves and what hangs together is the same in most steps.
    let (_, structure) = match structure.take().filter(|(of, _)| *of == triangles) {
        Some(known) => structure.insert(known),
        None => structure.insert((triangles.clone(), Structure::new(&at, &triangles))),
    };
    let mean = elements.iter().map(Element::weight).sum::<f64>() / elements.len().max(1) as f64;
    let mut ridge = RIDGE * mean;
    let hessian = |e: u32| elements[e as usize].projected_hessian(x);
    while !structure.factor(ridge, hessian, factor) {
        ridge *= 100.0;
        if ridge.is_nan() || ridge > 1e9 {
            return None;
        }
    }
    let gradient = downhill.iter().map(|g| g.length_squared()).sum::<f64>().sqrt();
    let mut whole = Step { before, after: before, alpha: 0.0, gradient };
    let mut memory = Memory::default();
    for k in 0..most {
        let mut p = downhill.clone();
        memory.solve(&mut p, |b| structure.solve(factor, b));
        let (after, alpha) = problem.search(x, whole.after, &downhill, &p);
        (whole.after, whole.alpha) = (after, alpha);
        if alpha == 0.0 || k + 1 == most {
            break;
        }
        let (_, next) = problem.downhill(x);
        let change = downhill.iter().zip(&next).map(|(old, new)| *old - *new).collect();
        p.iter_mut().for_each(|p| *p *= alpha);
        memory.note(p, change);
        downhill = next;
    }
    Some(whole)
}

/// Elements, the vertices that may move, and the places among those of the elements' corners.
struct Problem<'a> {
    elements: &'a [Element],
    free: &'a [u32],
    triangles: &'a [[u32; 3]],
}

impl Problem<'_> {
    /// The energy, and the direction against its gradient.
    fn downhill(&self, x: &[DVec2]) -> (f64, Vec<DVec2>) {
        let mut energy = 0.0;
        let mut p = vec![DVec2::ZERO; self.free.len()];
        for (element, places) in self.elements.iter().zip(self.triangles) {
            let (own, gradient) = element.gradient(x);
            energy += own;
            for (place, g) in places.iter().zip(gradient) {
                if *place != FIXED {
                    p[*place as usize] -= g;
                }
            }
        }
        (energy, p)
    }

    /// Goes along `p` as far as it lowers the energy, which is `before`; gives the energy then and the part of `p` that was gone, 0 where none does.
    fn search(&self, x: &mut [DVec2], before: f64, downhill: &[DVec2], p: &[DVec2]) -> (f64, f64) {
        let slope: f64 = -downhill.iter().zip(p).map(|(g, p)| g.dot(*p)).sum::<f64>();
        let direction = |place: u32| if place == FIXED { DVec2::ZERO } else { p[place as usize] };
        let bound = self
            .elements
            .iter()
            .zip(self.triangles)
            .map(|(e, places)| e.step_bound(x, places.map(direction)))
            .fold(f64::INFINITY, f64::min);
        let mut alpha = (NEAREST * bound).min(1.0);
        if slope.is_nan() || slope >= 0.0 {
            return (before, 0.0);
        }
        let at: Vec<DVec2> = self.free.iter().map(|&v| x[v as usize]).collect();
        for _ in 0..40 {
            self.free.iter().zip(at.iter().zip(p)).for_each(|(&v, (at, p))| x[v as usize] = *at + alpha * *p);
            let after = energy(x, self.elements);
            if after <= before + SUFFICIENT * alpha * slope {
                return (after, alpha);
            }
            alpha *= 0.5;
        }
        self.free.iter().zip(&at).for_each(|(&v, at)| x[v as usize] = *at);
        (before, 0.0)
    }
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
                    elements.push(Element::Triangle { corners, rest });
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
