//! From uploaded files to models and the groups of texture sets that are refined together.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::group::{Group, can_join};
use super::importance::{Importance, Subject, importances};
use super::options::{Container, ImportanceSource, Options};
use super::refinement::Refinement;
use super::run::Input;
use super::textures::exempt_uniform;
use crate::asset::{self, Document, File, MaterialIndex, Merge, TextureSet, UvSet};
use crate::context::Context;
use crate::error::{Code, Failure, Result, Warning};

/// The models as they came in.
pub(super) struct Loaded {
    /// In the order of the input; at least one.
    pub models: Vec<Model>,
    /// The texture sets, each by itself or joined with others.
    pub groups: Vec<Group>,
    /// Bytes of all files.
    pub bytes: u64,
    /// Whether triangles with texture coordinates are in no texture set, because something stands in the way.
    pub left: bool,
}

/// One model.
pub(super) struct Model {
    /// The document as read, and prepared where its texture sets are to be merged.
    pub doc: Document,
    /// Its materials, textures and primitives.
    pub index: MaterialIndex,
    /// What is to be merged once it is written.
    pub merge: Option<Merge>,
    /// Bytes of its files; files that several models come with count for each.
    pub bytes: u64,
    /// What it is called in warnings, where there are several.
    pub label: Option<String>,
}

impl Loaded {
    /// Every group before any stage.
    pub fn untouched(&self) -> Vec<Refinement<'_>> {
        self.groups.iter().map(Refinement::untouched).collect()
    }

    /// Sets the model that warnings are about.
    pub fn speak_of(&self, model: usize, context: &Context) {
        context.speak_of(self.models.get(model).and_then(|m| m.label.as_deref()));
    }
}

/// Reads the models. With `join`, the texture sets of several models become one group where they can.
///
/// # Errors
/// Those of the input, with the model's name where there are several; those of `importance`.
pub(super) fn load(input: &Input, options: &Options, join: bool, context: &Context) -> Result<Loaded> {
    if input.models.is_empty() {
        return Err(Failure::new(Code::InvalidRequest, "there is no model"));
    }
    let count = input.models.len();
    let mut loaded = Loaded { models: Vec::new(), groups: Vec::new(), bytes: total_bytes(&input.models), left: false };
    let mut sets: Vec<(usize, TextureSet)> = Vec::new();
    let mut unused: Option<BTreeSet<String>> = None;
    for (index, files) in input.models.iter().enumerate() {
        let label = (count > 1).then(|| label(&input.models, index));
        context.speak_of(label.as_deref());
        let own = read(files, count, input, options, join && options.atlas.merge, context).map_err(|mut failure| {
            if let Some(label) = label.as_ref().filter(|_| failure.code != Code::Canceled) {
                failure.message = format!("{label}: {}", failure.message);
            }
            failure
        });
        let ReadModel { doc, index: indexed, merge, sets: own, unused: left } = own?;
        loaded.left |= asset::leaves_any(&doc, &indexed, &own, options.atlas.uv_set);
        let left: BTreeSet<String> = left.into_iter().collect();
        unused = Some(unused.map_or(left.clone(), |before| &before & &left));
        sets.extend(own.into_iter().map(|set| (index, set)));
        let bytes = files.iter().map(|f| f.bytes.len() as u64).sum();
        loaded.models.push(Model { doc, index: indexed, merge, bytes, label });
        context.step(0.9 * (index + 1) as f64 / count as f64, "reading models")?;
    }
    context.speak_of(None);
    let weights = match &options.importance {
        Some(ImportanceSource::Texture(name)) => Some(name),
        _ => None,
    };
    for path in unused.iter().flatten().filter(|path| Some(*path) != weights) {
        let text = format!(
            "the file `{path}` was uploaded, and no model names it: it is not used (if it should be, check its name against that in the model)"
        );
        context.warn(Warning::new("unused_file", text));
    }
    // Layouts without images are numbered after those with, and surfaces without a layout after all.
    sets.sort_by_key(|(_, set)| (!set.atlas.has_layout(), set.slots.is_empty()));
    let mapped = sets.iter().filter(|(_, set)| set.atlas.has_layout()).count();
    let unwraps = join && options.steps().iter().any(|step| !step.stage.needs_layout());
    let refinable = if unwraps { sets.len() } else { mapped };
    if refinable == 0 {
        let warned = !context.warnings().is_empty();
        context.warn(nothing_to_refine(&loaded.models, options.atlas.uv_set, warned));
    }
    let weights = match &options.importance {
        Some(source) => {
            let subjects: Vec<Subject<'_>> = sets[..refinable]
                .iter()
                .map(|(model, set)| Subject { doc: &loaded.models[*model].doc, files: &input.models[*model], set })
                .collect();
            let own = importances(source, &subjects, &input.limits, context)?;
            own.into_iter().map(Some).chain((refinable..sets.len()).map(|_| None)).collect()
        }
        None => vec![None; sets.len()],
    };
    let join = match (join, count) {
        (false, _) => Join::Nothing,
        (true, 1) if options.atlas.merge => Join::Alike,
        (true, 1) => Join::Nothing,
        _ => Join::All,
    };
    for (model, set) in sets[..mapped].iter().filter(|(_, set)| join != Join::Nothing && !can_join(set)) {
        loaded.speak_of(*model, context);
        let text = format!(
            "the charts of {} spread too far for a shared sheet: it keeps its own atlas (bring its texture coordinates into the image to have it share one)",
            set.name
        );
        context.warn(Warning::new("not_joined", text));
    }
    loaded.groups = groups(sets, weights, join);
    for group in &loaded.groups {
        for (model, warning) in group.warnings() {
            loaded.speak_of(model, context);
            context.warn(warning);
        }
    }
    context.speak_of(None);
    Ok(loaded)
}

/// Why there is nothing to refine.
fn nothing_to_refine(models: &[Model], uv_set: UvSet, warned: bool) -> Warning {
    let list = |value: &Value, key: &str| value.get(key).and_then(Value::as_array).cloned().unwrap_or_default();
    let meshes = models.iter().flat_map(|m| list(&m.doc.json, "meshes"));
    let primitives = meshes.flat_map(|mesh| list(&mesh, "primitives"));
    let triangles = primitives.filter(|p| p.get("mode").is_none_or(|m| m.as_u64().is_some_and(|m| m >= 4)));
    let name = format!("TEXCOORD_{}", uv_set.number());
    let (mut all, mut with) = (0, 0);
    for primitive in triangles {
        all += 1;
        with += u64::from(primitive.get("attributes").is_some_and(|a| a.get(&name).is_some()));
    }
    let message = match (all, with) {
        (0, _) => "the model has no triangles".to_owned(),
        (_, 0) => format!(
            "the model has no texture coordinates: none of its {all} triangle primitives has {name} (the recipe unwrap makes some; atlas.uv_set names another set)"
        ),
        _ if warned => format!("the other warnings say why of the {with} primitives with {name}"),
        _ => format!("the {with} primitives with {name} have no triangles with an area"),
    };
    Warning::new("nothing_to_refine", format!("nothing is refined: {message}"))
}

/// What a model of several is called: its file, where that tells it from the others.
fn label(models: &[Vec<File>], index: usize) -> String {
    let name = |files: &Vec<File>| files.first().map(|f| f.path.clone());
    let own = models.get(index).and_then(name);
    let alike = models.iter().filter(|files| name(files) == own).count();
    own.filter(|_| alike == 1).unwrap_or_else(|| format!("model {index}"))
}

/// A model as it was read.
struct ReadModel {
    doc: Document,
    index: MaterialIndex,
    merge: Option<Merge>,
    sets: Vec<TextureSet>,
    /// Paths of files that it does not name.
    unused: Vec<String>,
}

fn read(
    files: &[File],
    count: usize,
    input: &Input,
    options: &Options,
    merging: bool,
    context: &Context,
) -> Result<ReadModel> {
    // Files that come with several models may be models themselves: the first is this one.
    let main = match &options.model {
        Some(path) if count == 1 => Some(path.as_str()),
        Some(_) => {
            let message = "`model` names one model of an archive, and several models were given";
            return Err(Failure::new(Code::InvalidOptions, message).at("/model"));
        }
        None => files.first().filter(|_| count > 1).map(|f| f.path.as_str()),
    };
    let (mut doc, warnings, unused) = asset::load_while(files, main, &input.limits, &|| context.check())?;
    for warning in warnings {
        context.warn(warning);
    }
    let tile = doc.tile.as_ref().map(|tile| tile.kind);
    if let (Container::Glb | Container::Gltf, Some(kind)) = (options.output.container.of(tile)?, tile) {
        let name = kind.extension();
        let text = format!(
            "the model comes out of its .{name} without the feature table and the batch table, which may hold its place on the globe, its batches and its instances: ask for a .{name} to keep them"
        );
        context.warn(Warning::new("tile_unwrapped", text));
    }
    let mut index = MaterialIndex::new(&doc)?;
    let mut merge = None;
    if merging {
        merge = asset::prepare_merge(&mut doc, &mut index, options.atlas.uv_set.number())?;
        if merge.is_none() {
            let text = "the model is not merged: it uses an extension, or animates materials, that merging does not understand; it is refined material by material";
            context.warn(Warning::new("not_merged", text));
        }
    }
    let mut sets = asset::read(&doc, &index, options.atlas.reading(), context)?;
    for set in &mut sets {
        exempt_uniform(&doc, set, input.limits.max_image_pixels, context)?;
    }
    Ok(ReadModel { doc, index, merge, sets, unused })
}

/// Files that several models come with count once.
fn total_bytes(models: &[Vec<File>]) -> u64 {
    let mut seen = BTreeSet::new();
    let all = models.iter().flatten();
    all.filter(|f| seen.insert((f.path.as_str(), f.bytes.len()))).map(|f| f.bytes.len() as u64).sum()
}

/// Which texture sets share an atlas.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Join {
    /// Each is one by itself.
    Nothing,
    /// Those with the same slots.
    Alike,
    /// All with images, and all without.
    All,
}

/// The groups of sets, in the order of their first.
fn groups(sets: Vec<(usize, TextureSet)>, weights: Vec<Option<Importance>>, join: Join) -> Vec<Group> {
    type Part = (usize, TextureSet, Option<Importance>);
    let mut parts: Vec<Vec<Part>> = Vec::new();
    // Where sets go, by whether they have images and by the names of their slots.
    let mut places: BTreeMap<(bool, Vec<String>), usize> = BTreeMap::new();
    for ((model, set), weight) in sets.into_iter().zip(weights) {
        let alike = |s: &TextureSet| s.slots.iter().filter(|s| !s.exempt).map(|s| s.name.clone()).collect();
        let key = match join {
            Join::Nothing => None,
            Join::Alike => Some((true, alike(&set))).filter(|(_, names): &(bool, Vec<String>)| !names.is_empty()),
            Join::All => Some((!set.slots.is_empty(), Vec::new())),
        };
        let key = key.filter(|_| can_join(&set));
        let index = key.map_or(parts.len(), |key| *places.entry(key).or_insert(parts.len()));
        if index == parts.len() {
            parts.push(Vec::new());
        }
        parts[index].push((model, set, weight));
    }
    let group = |(id, part): (usize, Vec<Part>)| {
        let weights: Option<Vec<Importance>> = part.iter().map(|(_, _, w)| w.clone()).collect();
        let mut group = Group::new(id, part.into_iter().map(|(model, set, _)| (model, set)).collect());
        group.importance = weights.map(|w| Importance::join(&w));
        group
    };
    parts.into_iter().enumerate().map(group).collect()
}
