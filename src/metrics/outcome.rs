//! What became of an atlas, and of a job, in one word.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What became of an atlas, or of all that a job was given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[schema(as = Outcome)]
#[serde(rename_all = "snake_case")]
pub enum RefinementOutcome {
    /// The result of the recipe was taken, for all of it.
    Refined,
    /// A part is as it was uploaded: a stage was undone, charts were held back or given back, or, of a job, some atlases or primitives were
    /// left as they are. The warnings say which, and why.
    PartlyRefined,
    /// It is as it was uploaded: no result was better, or none was sound.
    KeptInput,
    /// There was nothing that the recipe could refine: no texture coordinates, no triangles, or nothing that could be read.
    NothingToRefine,
}

impl RefinementOutcome {
    /// The name in JSON.
    pub fn as_str(self) -> &'static str {
        match self {
            RefinementOutcome::Refined => "refined",
            RefinementOutcome::PartlyRefined => "partly_refined",
            RefinementOutcome::KeptInput => "kept_input",
            RefinementOutcome::NothingToRefine => "nothing_to_refine",
        }
    }

    /// What became of a job whose atlases became this. `left` says whether primitives with triangles and texture coordinates are in none of
    /// them, because something stood in the way. Surfaces without a layout take nothing from what was refined.
    pub fn of_job(atlases: impl IntoIterator<Item = RefinementOutcome>, left: bool) -> RefinementOutcome {
        let atlases: Vec<_> = atlases.into_iter().filter(|a| *a != RefinementOutcome::NothingToRefine).collect();
        let all = |outcome| atlases.iter().all(|a| *a == outcome);
        match atlases.is_empty() {
            true => RefinementOutcome::NothingToRefine,
            false if all(RefinementOutcome::KeptInput) => RefinementOutcome::KeptInput,
            false if all(RefinementOutcome::Refined) && !left => RefinementOutcome::Refined,
            false => RefinementOutcome::PartlyRefined,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::RefinementOutcome::{self, KeptInput, NothingToRefine, PartlyRefined, Refined};

    #[test]
    fn a_job_is_refined_where_all_of_it_was() {
        for (atlases, left, wanted) in [
            (vec![], false, NothingToRefine),
            (vec![NothingToRefine], true, NothingToRefine),
            (vec![Refined, NothingToRefine], false, Refined),
            (vec![Refined, Refined], true, PartlyRefined),
            (vec![Refined, KeptInput], false, PartlyRefined),
            (vec![KeptInput, KeptInput, NothingToRefine], true, KeptInput),
            (vec![PartlyRefined], false, PartlyRefined),
        ] {
            assert_eq!(RefinementOutcome::of_job(atlases.clone(), left), wanted, "{atlases:?} {left}");
        }
        for outcome in [Refined, PartlyRefined, KeptInput, NothingToRefine] {
            assert_eq!(serde_json::to_value(outcome).unwrap(), outcome.as_str());
        }
    }
}
