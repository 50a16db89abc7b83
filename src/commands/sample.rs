//! `intarsia sample`: a model made by code.

use intarsia::asset::sample::{SampleTextures, names, sample_with};
use intarsia::config::Sample;
use intarsia::error::{Code, Failure, Result};
use intarsia::refine::parse::near_or_all;

/// Writes the model, or lists the names.
pub fn run(arguments: &Sample) -> Result<()> {
    let Some(name) = &arguments.name else {
        return super::print(&format!("{}\n", names().join("\n")));
    };
    if !names().contains(&name.as_str()) {
        let message = format!("no sample is called `{name}`; {}", near_or_all(name, names()));
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
