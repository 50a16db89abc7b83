//! The search as it was published: Algorithm 1.

use std::collections::BTreeSet;

use super::operations::Operation;
use super::search::{BORDER_PART, SLACK, Search};
use crate::atlas::groups::Cost;
use crate::error::Result;

impl Search<'_> {
    /// Algorithm 1: the dual is moved by eq. 7, the seams by whatever pays most, and both again until a state comes back.
    ///
    /// # Errors
    /// `canceled`.
    pub fn run_as_published(&mut self) -> Result<&'static str> {
        self.published = true;
        self.relax(1e-6, 1000, 0)?;
        self.visit();
        let aim = self.bound - 0.5 * SLACK;
        let mut visited: BTreeSet<[i64; 3]> = BTreeSet::new();
        let mut part = 0.6;
        loop {
            self.round += 1;
            if self.stop()? {
                return Ok(self.stopped_by().unwrap_or("no_improvement"));
            }
            let last = self.lambda;
            self.lambda = (self.lambda + self.distortion - aim).max(0.0);
            let mut all = self.operations(false, BORDER_PART);
            let mut seed = self.seed(&all);
            if seed.is_none() {
                let interior = self.operations(true, part);
                seed = self.seed(&interior);
                all.extend(interior);
            }
            if seed.is_none() {
                self.relax(1e-7, 100, 0)?;
                self.visit();
                let within = self.distortion <= self.bound && self.distortion >= self.bound - SLACK;
                if within || (self.lambda - last).abs() < 1e-3 && self.distortion <= self.bound {
                    return Ok("done");
                }
                // Eq. 7 again and again until an operation pays, in closed form.
                let (over, shorter) = (self.distortion > self.bound, |o: &(Operation, f64, f64)| o.1 < 0.0);
                let worth =
                    all.iter().filter(|o| shorter(o) != over && (o.2 < 0.0) == over && o.2 != 0.0).map(|o| o.1 / -o.2);
                let next = if over { worth.min_by_key(|r| Cost(*r)) } else { worth.max_by_key(|r| Cost(*r)) };
                match next {
                    Some(next) if over => self.lambda = self.lambda.max(next * 1.001),
                    Some(next) => self.lambda = self.lambda.min(next * 0.999),
                    None if part < 1.0 => part += 0.1,
                    None => return Ok("no_improvement"),
                }
                seed = self.seed(&all);
            }
            if let Some(seed) = seed {
                self.propagate(seed, None)?;
            }
            self.relax(1e-6, 10, 0)?;
            self.visit();
            let state = [self.map.seam_length(), self.distortion, self.lambda].map(|v| (v * 1e4).round() as i64);
            if !visited.insert(state) {
                return Ok("cycle");
            }
        }
    }
}
