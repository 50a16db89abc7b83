//! What all merges together may cost, and what they came to.

use std::collections::BTreeMap;

use serde_json::{Map, Value, json};

use super::attempt::{Merge, Reason};
use super::mesh::MergeMesh;
use super::operation::Operation;
use super::params::{Defrag, Search};

/// Resampled part of the surface that no merge has to make up for.
const FREE: f64 = 0.001;

/// The account of a run.
pub(super) struct Account<'a> {
    params: &'a Defrag,
    budget: u64,
    /// UV area of the input, 3D area, and length of all seams.
    uv_area: f64,
    surface: f64,
    seam_length: f64,
    charts: usize,
    energy: f64,
    /// 3D area that keeps its texels.
    preserved: f64,
    merges: u64,
    attempts: u64,
    work: u64,
    failures: BTreeMap<Reason, u64>,
}

impl<'a> Account<'a> {
    /// `budget` is the most work.
    pub(super) fn new(mesh: &MergeMesh, params: &'a Defrag, budget: u64) -> Self {
        Account {
            params,
            budget,
            uv_area: mesh.weight.iter().sum::<f64>().max(1e-300),
            surface: mesh.area.iter().sum(),
            seam_length: mesh.seam_length().max(1e-300),
            charts: mesh.charts().len(),
            energy: 0.0,
            preserved: mesh.charts().iter().map(|c| c.preserved_area).sum(),
            merges: 0,
            attempts: 0,
            work: 0,
            failures: BTreeMap::new(),
        }
    }

    /// Whether the budget is spent.
    pub(super) fn is_spent(&self) -> bool {
        self.work > self.budget
    }

    /// Takes note of an attempt.
    pub(super) fn tried(&mut self, work: u64) {
        self.attempts += 1;
        self.work += work;
    }

    /// Takes note of a failure.
    pub(super) fn failed(&mut self, reason: Reason) {
        *self.failures.entry(reason).or_default() += 1;
    }

    /// Takes note of a merge and gives it back, if the atlas as a whole allows it: its energy is limited (section 4.2.2), and so is what is resampled, as a
    /// whole and for what the merge removes of all seams.
    pub(super) fn admit(&mut self, mesh: &MergeMesh, op: &Operation, merge: Merge) -> Result<Merge, Reason> {
        if self.energy + merge.energy > self.params.global_energy() * self.uv_area && merge.energy > 0.0 {
            return Err(Reason::Global);
        }
        let preserved_by = |chart: u32| mesh.chart(chart).preserved_area;
        let before = preserved_by(op.kept) + if op.is_within() { 0.0 } else { preserved_by(op.moved) };
        let preserved = self.preserved - before + mesh.preserved_after(op, &merge);
        let least = (1.0 - self.params.max_resampled - 1e-9) * self.surface;
        if self.params.max_resampled < 1.0 && preserved < least && preserved < self.preserved {
            return Err(Reason::Resampled);
        }
        let lost = (self.preserved - preserved) / self.surface;
        let removed = 0.5 * op.lengths.iter().sum::<f64>() / self.seam_length;
        if self.params.search == Search::Partial && lost > self.params.resampling_rate * removed + FREE {
            return Err(Reason::Resampled);
        }
        self.energy += merge.energy;
        self.preserved = preserved;
        self.merges += 1;
        Ok(merge)
    }

    /// The figures for the report; `stopped_by` is what ended the search.
    pub(super) fn figures(self, mesh: &MergeMesh, stopped_by: &str) -> Map<String, Value> {
        let energy: f64 = mesh.energy.iter().sum();
        let failures: Map<String, Value> =
            self.failures.into_iter().map(|(reason, n)| (reason.name().to_owned(), Value::from(n))).collect();
        let left = mesh.charts().iter().filter(|c| !c.faces.is_empty()).count();
        Map::from_iter([
            ("charts_before".to_owned(), json!(self.charts)),
            ("charts".to_owned(), json!(left)),
            ("merges".to_owned(), json!(self.merges)),
            ("attempts".to_owned(), json!(self.attempts)),
            ("failures".to_owned(), Value::Object(failures)),
            ("energy".to_owned(), json!(energy / self.uv_area)),
            ("work".to_owned(), json!(self.work)),
            ("merging_stopped_by".to_owned(), json!(stopped_by)),
        ])
    }
}
