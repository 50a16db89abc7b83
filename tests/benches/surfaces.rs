//! What benchmarks read of models by themselves: vertices of OBJ files, and the Atlas of what was written.

use intarsia::asset::{File, Limits, MaterialIndex, UvSet, load, read};
use intarsia::atlas::Atlas;
use intarsia::context::Context;
use intarsia::refine::options::Options;

/// The position in a line of an OBJ file; none where it is no vertex.
pub fn vertex(line: &str) -> Option<[f64; 3]> {
    let mut numbers = line.strip_prefix("v ")?.split_whitespace().map(|word| word.parse().ok());
    Some([numbers.next()??, numbers.next()??, numbers.next()??])
}

/// The first Atlas of a written model, by one of its TEXCOORD sets.
pub fn written(glb: Vec<u8>, uv_set: UvSet) -> Result<Atlas, String> {
    let files = [File { path: "model.glb".to_owned(), bytes: glb }];
    let (doc, _) = load(&files, None, &Limits::default()).map_err(|e| e.to_string())?;
    let index = MaterialIndex::new(&doc).map_err(|e| e.to_string())?;
    let mut options = Options::default();
    options.atlas.uv_set = uv_set;
    let sets = read(&doc, &index, options.atlas.reading(), &Context::silent()).map_err(|e| e.to_string())?;
    Ok(sets.into_iter().next().ok_or("there is no atlas")?.atlas)
}
