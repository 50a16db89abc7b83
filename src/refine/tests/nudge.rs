//! A stage that only tests have: one file, and one line in the table.

use glam::DVec2;
use serde_json::{Map, json};

use crate::error::Result;
use crate::params::params;
use crate::refine::stage::{Stage, StageInput, Staged};

params! {
    /// Parameters of the stage `nudge`.
    pub struct Nudge {
        /// How far the charts move to the right, in texels.
        pub by: u32 = 1, in 1..=64;
        /// Whether it breaks the Atlas: a face without a page.
        pub breaks: bool = false;
        /// Whether it spoils a chart: a UV that is no number.
        pub spoils: bool = false;
    }
}

impl Stage for Nudge {
    const NAME: &'static str = "nudge";
    const DESCRIPTION: &'static str = "Moves all charts a little.";
    const WEIGHT: f64 = 1.0;

    fn run(&self, input: &StageInput<'_>) -> Result<Staged> {
        let mut atlas = input.atlas.clone();
        for uv in &mut atlas.uv {
            uv.x += f64::from(self.by);
        }
        for sheet in &mut atlas.sheets {
            sheet[0] += self.by;
        }
        if self.breaks {
            atlas.page.pop();
        }
        if self.spoils {
            atlas.uv[0] = DVec2::NAN;
        }
        let figures = Map::from_iter([("by".to_owned(), json!(self.by))]);
        Ok(Staged { atlas, stopped_by: "done", figures, kept: false })
    }
}
