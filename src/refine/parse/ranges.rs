//! Options that their types allow and that make no sense.

use super::MAX_METADATA_BYTES;
use crate::asset::UvSet;
use crate::params::{Problem, out_of_range};
use crate::refine::options::{Options, Recipe};

/// What the types cannot say.
pub(super) fn ranges(o: &Options) -> Vec<Problem> {
    let mut out = out_of_range(&o.pack, "/pack");
    for stage in o.stages.iter() {
        out.extend(stage.out_of_range(&format!("/{}", stage.name())));
    }
    if let Recipe::Stages(stages) = &o.recipe {
        for (i, stage) in stages.iter().enumerate() {
            out.extend(stage.out_of_range(&format!("/recipe/{i}")));
        }
    }
    out.extend(out_of_range(&o.texture, "/texture"));
    out.extend(out_of_range(&o.atlas, "/atlas"));
    if o.atlas.merge && o.atlas.uv_set == UvSet::New {
        let text = "`merge` makes one atlas of images, and with `uv_set` \"new\" no image changes";
        out.push(Problem::new("/atlas/merge", text));
    }
    if let Some(fabrication) = &o.fabrication {
        out.extend(out_of_range(fabrication, "/fabrication"));
    }
    if let Some(limit) = o.time_limit_s.filter(|l| !(*l > 0.0 && *l <= 1e9)) {
        out.push(Problem::new(
            "/time_limit_s",
            format!("`time_limit_s` is {limit}, not more than 0 (and at most 1e9)"),
        ));
    }
    if o.work_budget == Some(0) {
        out.push(Problem::new("/work_budget", "`work_budget` is 0; it is at least 1, or null"));
    }
    out.extend(o.texture.conflicts().into_iter().map(|conflict| Problem::new("/texture/size", conflict)));
    out.extend(o.importance.iter().flat_map(|source| source.problems("/importance")));
    if serde_json::to_vec(&o.metadata).map_or(true, |m| m.len() > MAX_METADATA_BYTES) {
        out.push(Problem::new("/metadata", format!("`metadata` is larger than {MAX_METADATA_BYTES} bytes of JSON")));
    }
    out
}
