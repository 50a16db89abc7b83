//! `intarsia sample`: a model made by code.

use intarsia::asset::sample::{SampleTextures, names, sample_with};
use intarsia::config::Sample;
use intarsia::error::{Code, Failure, Result};
use intarsia::refine::parse::nearest;

/// Writes the model, or lists the names.
pub fn run(arguments: &Sample) -> Result<()> {
    let Some(name) = &arguments.name else {
        return super::print(&format!("{}\n", names().join("\n")));
    };
    if !names().contains(&name.as_str()) {
        let hint = nearest(name, names()).map(|n| format!("; did you mean `{n}`?")).unwrap_or_default();
        let message = format!("no sample is called `{name}`{hint} There are: {}", names().join(", "));
        return Err(Failure::new(Code::InvalidRequest, message));
    }
    let Some(output) = &arguments.output else {
        return Err(Failure::new(Code::InvalidRequest, "say where to write it: -o FILE.glb"));
    };
    let bytes = sample_with(name, SampleTextures { side: arguments.texture_size, jpeg: arguments.jpeg })?;
    super::write(output, &bytes)?;
    eprintln!("wrote {} ({} bytes)", output.display(), bytes.len());
    Ok(())
}
