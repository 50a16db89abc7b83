//! Prints what the stage `bounded` reaches on the OBJ models at hand, those of `uv/` as they come and those of `meshes/` after `unwrap` of
//! quality `fast`: packing efficiency, charts, 3D length of the seams, distortion (1 is isometric), and the seconds of the stage; at the end
//! the means. With `--ablations` the tables of *Atlas Refinement with Bounded Packing Efficiency*: means by sigma, by bound, with and
//! without gaps, by how cuts run, and the distortion of a half that matters a hundred times as much as the other.
//!
//! `cargo bench --bench bounded [-- PART-OF-A-NAME] [--most-faces=N] [--bound=.8] [--gutter=0] [--search=paper] [--sigma=.004]
//! [--cuts=edges] [--keep-mapping] [--energy=uploaded] [--ablations]`; models lie in `INTARSIA_DATA`, or in `../shared/data`. `uv/` and `meshes/` are parts of
//! names too. Every other parameter of an ablation is what the flags say.

mod common;
mod surfaces;

use std::path::Path;

use glam::{DVec2, DVec3};
use intarsia::asset::{File, UvSet, read_paths};
use intarsia::atlas::{Atlas, FaceId, OverlapMode};
use intarsia::context::Context;
use intarsia::packing::Gutter;
use intarsia::refine::bounded::params::{Bounded, Cuts, Energy, Search};
use intarsia::refine::optcuts::params::{OptCuts, Quality};
use intarsia::refine::options::{IfLarger, ImportanceSource, Options};
use intarsia::refine::stage::Stage;

/// Texels between charts where an ablation has gaps and no flag says how wide they are.
const GAP: u32 = 2;

/// What is varied.
#[derive(Debug, Clone, PartialEq)]
struct Variant {
    params: Bounded,
    gutter: u32,
}

/// A model with a layout, and the TEXCOORD set in which it lies.
struct Model {
    name: String,
    files: Vec<File>,
    uv_set: UvSet,
}

/// What became of a model. Of two values the first is from before.
#[derive(Debug, Clone, Copy)]
struct Row {
    triangles: f64,
    efficiency: [f64; 2],
    charts: [f64; 2],
    /// In parts of the diagonal of the surface's bounding box.
    seams: [f64; 2],
    distortion: [f64; 2],
    seconds: f64,
    /// Whether the bound is met.
    is_met: bool,
    /// Whether no face is turned over, and none lies on another.
    is_sound: bool,
}

fn main() {
    let flags: Vec<String> = std::env::args().skip(1).collect();
    let own = variant(&flags);
    let models = models(&flags);
    if models.is_empty() {
        return;
    }
    if !flags.iter().any(|f| f == "--ablations") {
        rows(&models, &own);
        return;
    }
    let with = |params: Bounded| Variant { params, ..own.clone() };
    let sigma = |sigma: f64| (format!("sigma {sigma}"), with(Bounded { sigma, ..own.params.clone() }));
    let bound = |b: f64| (format!("bound {b:.2}"), with(Bounded { packing_efficiency: b, ..own.params.clone() }));
    let gap = |gutter: u32| (format!("gutter {gutter}"), Variant { gutter, ..own.clone() });
    let cuts = |name: &str, cuts: Cuts| (name.to_owned(), with(Bounded { cuts, ..own.params.clone() }));
    let tables = [
        ("boundary smoothing", [0.001, 0.004, 0.006].map(sigma).to_vec()),
        ("bounds", [0.8, 0.85, 0.9].map(bound).to_vec()),
        ("gaps", [0, if own.gutter > 0 { own.gutter } else { GAP }].map(gap).to_vec()),
        ("cuts", vec![cuts("straight", Cuts::Straight), cuts("along edges", Cuts::Edges)]),
    ];
    // What the tables have in common is refined once.
    let mut known: Vec<(Variant, Vec<Row>)> = Vec::new();
    for (_, variants) in &tables {
        for (_, variant) in variants {
            if known.iter().all(|(k, _)| k != variant) {
                known.push((variant.clone(), rows(&models, variant)));
            }
        }
    }
    for (title, variants) in &tables {
        println!("\n{}", heading(title));
        for (name, variant) in variants {
            if let Some((_, rows)) = known.iter().find(|(k, _)| k == variant) {
                println!("{name:30} {}", means(rows));
            }
        }
    }
    local_control(&own);
}

/// Distortion of the halves of each model of `uv/`, above and below the middle of its height, where both matter alike and where the upper one
/// matters a hundred times as much: 1 is isometric.
fn local_control(own: &Variant) {
    let filter = common::filter();
    let (folder, paths) = common::models(&["uv"]);
    println!("\n{:30} {:>8} {:>8} | {:>8} {:>8}", "local control: E_d of halves", "upper", "lower", "upper", "lower");
    println!("{:30} {:>17} | {:>17}", "", "alike", "the upper 100x");
    let mut rows: Vec<[f64; 4]> = Vec::new();
    for path in paths.iter().filter(|p| p.extension().is_some_and(|e| e == "obj")) {
        let name = path.strip_prefix(&folder).unwrap_or(path).with_extension("").display().to_string();
        let Some(painted) = painted(path).filter(|_| name.contains(&filter)) else { continue };
        let halves = |importance: Option<ImportanceSource>| {
            let options = Options { importance, ..options(own, UvSet::Number(0)) };
            halves(&painted, &options)
        };
        let weighted = Some(ImportanceSource::Attribute("COLOR_0.r".to_owned()));
        match halves(None).and_then(|alike| Ok([alike, halves(weighted)?])) {
            Ok([alike, weighted]) => {
                let row = [alike[0], alike[1], weighted[0], weighted[1]];
                println!("{:30.30} {}", common::short(&name), in_columns(&row));
                rows.push(row);
            }
            Err(error) => println!("{:30.30} {error}", common::short(&name)),
        }
    }
    let mean = |k: usize| rows.iter().map(|r| r[k]).sum::<f64>() / rows.len() as f64;
    println!("{:30} {}", format!("means of {}", rows.len()), in_columns(&[0, 1, 2, 3].map(mean)));
}

fn in_columns([a, b, c, d]: &[f64; 4]) -> String {
    format!("{a:8.4} {b:8.4} | {c:8.4} {d:8.4}")
}

/// An OBJ model as one file whose vertices are white above the middle of its height and black below.
fn painted(path: &Path) -> Option<Vec<File>> {
    let text = std::fs::read_to_string(path).ok()?;
    let middle = middle(text.lines().filter_map(surfaces::vertex).map(|[_, y, _]| y));
    let line = |line: &str| match surfaces::vertex(line) {
        Some([x, y, z]) => {
            let colour = if y > middle { 1 } else { 0 };
            format!("v {x} {y} {z} {colour} {colour} {colour}\n")
        }
        None => format!("{line}\n"),
    };
    let bytes = text.lines().map(line).collect::<String>().into_bytes();
    Some(vec![File { path: "painted.obj".to_owned(), bytes }])
}

/// Halfway between the least and the greatest.
fn middle(values: impl Iterator<Item = f64>) -> f64 {
    let (least, most) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), y| (a.min(y), b.max(y)));
    0.5 * (least + most)
}

/// The distortion of the upper and the lower half of what becomes of a model.
fn halves(files: &[File], options: &Options) -> Result<[f64; 2], String> {
    let (outcome, _) = common::run(files.to_vec(), options, &Context::silent())?;
    let model = outcome.artifacts.into_iter().find(|a| a.role == "model").ok_or("there is no model")?;
    let atlas = surfaces::written(model.bytes, options.atlas.uv_set)?;
    let middle = middle(atlas.surface.positions.iter().map(|p| p.y));
    // At the scale at which the areas are the same.
    let area = |of: &dyn Fn(FaceId) -> f64| atlas.faces().map(of).sum::<f64>();
    let scale = area(&|f| atlas.area(f)) / area(&|f| atlas.uv_area(f).abs());
    let mut sums = [DVec3::ZERO; 2];
    for face in atlas.faces() {
        let Some(own) = energy(&atlas, face, scale) else { continue };
        let height = atlas.triangle(face).iter().map(|p| p.y).sum::<f64>() / 3.0;
        sums[usize::from(height <= middle)] += own.extend(1.0) * atlas.area(face);
    }
    // A file does not say which aspect its sheet has: that for which the energy of the whole is least.
    let whole = sums[0] + sums[1];
    let aspect = (whole.y / whole.x).sqrt();
    Ok(sums.map(|own| (own.x * aspect + own.y / aspect) / own.z))
}

/// Symmetric Dirichlet energy of a face over that of one that keeps its shape, where areas in the layout are `scale` times what they are there: its parts
/// of u and of v, of which the first grows and the second shrinks with the aspect of the sheet.
fn energy(atlas: &Atlas, face: FaceId, scale: f64) -> Option<DVec2> {
    let [p, q, r] = atlas.triangle(face);
    let [a, b, c] = atlas.uv_triangle(face);
    let ((e, f), (u, v)) = ((q - p, r - p), (b - a, c - a));
    let gram = e.length_squared() * f.length_squared() - e.dot(f).powi(2);
    let determinant = u.perp_dot(v).powi(2) * scale * scale;
    let norms = (f.length_squared() * u * u - 2.0 * e.dot(f) * u * v + e.length_squared() * v * v) * scale / gram;
    let energy = 0.25 * norms * (1.0 + gram / determinant);
    energy.is_finite().then_some(energy)
}

/// What the flags ask for.
fn variant(flags: &[String]) -> Variant {
    let value = |name: &str| flags.iter().find_map(|f| f.strip_prefix(name)?.strip_prefix('='));
    let number = |name: &str| value(name).map(|v| v.parse::<f64>().unwrap_or_else(|e| panic!("{name}={v}: {e}")));
    let usual = Bounded::default();
    let params = Bounded {
        packing_efficiency: number("--bound").unwrap_or(usual.packing_efficiency),
        sigma: number("--sigma").unwrap_or(usual.sigma),
        cuts: if value("--cuts") == Some("edges") { Cuts::Edges } else { Cuts::Straight },
        keep_mapping: flags.iter().any(|f| f == "--keep-mapping"),
        energy: if value("--energy") == Some("uploaded") { Energy::Uploaded } else { Energy::Surface },
        search: if value("--search") == Some("paper") { Search::Paper } else { Search::Default },
        ..usual
    };
    Variant { params, gutter: number("--gutter").unwrap_or(0.0) as u32 }
}

/// The models that the flags ask for, with layouts.
fn models(flags: &[String]) -> Vec<Model> {
    let most = flags.iter().find_map(|f| f.strip_prefix("--most-faces=")?.parse().ok()).unwrap_or(usize::MAX);
    let (folder, paths) = common::models(&["uv", "meshes"]);
    let filter = common::filter();
    let mut models = Vec::new();
    for path in paths.iter().filter(|p| p.extension().is_some_and(|e| e == "obj")) {
        let name = path.strip_prefix(&folder).unwrap_or(path).with_extension("").display().to_string();
        if !name.contains(&filter) || faces(path) > most {
            continue;
        }
        let Ok(files) = read_paths(std::slice::from_ref(path)) else { continue };
        let is_uv = name.starts_with("uv/");
        // Some are in both folders.
        let name = format!("{:6} {}", if is_uv { "uv" } else { "meshes" }, common::short(&name));
        if is_uv {
            models.push(Model { name, files, uv_set: UvSet::Number(0) });
            continue;
        }
        match unwrapped(files) {
            Ok((files, uv_set)) => models.push(Model { name, files, uv_set }),
            Err(error) => println!("{name:30} is not unwrapped: {error}"),
        }
    }
    models
}

/// Lines of faces in an OBJ file.
fn faces(path: &Path) -> usize {
    let bytes = std::fs::read(path).unwrap_or_default();
    bytes.split(|b| *b == b'\n').filter(|line| line.starts_with(b"f ")).count()
}

/// A model with the layout of `unwrap`, and the set in which that is.
fn unwrapped(files: Vec<File>) -> Result<(Vec<File>, UvSet), String> {
    let mut options = Options::preset("unwrap");
    options.stages.set(OptCuts { quality: Quality::Fast, ..options.stages.get() });
    let (outcome, _) = common::run(files, &options, &Context::silent())?;
    let set = outcome.report["atlases"][0]["uv_sets"][0].as_u64().ok_or("it has no layout")?;
    let set = UvSet::Number(u32::try_from(set).map_err(|e| e.to_string())?);
    let model = outcome.artifacts.into_iter().find(|a| a.role == "model").ok_or("there is no model")?;
    Ok((vec![File { path: "unwrapped.glb".to_owned(), bytes: model.bytes }], set))
}

/// Refines the models, with a line for each and one of the means.
fn rows(models: &[Model], variant: &Variant) -> Vec<Row> {
    println!("\n{:?}, gutter {}\n{}", variant.params, variant.gutter, heading("model"));
    let mut rows = Vec::new();
    for model in models {
        match refined(model, variant) {
            Ok(row) => {
                println!("{:30.30} {}", model.name, row.in_words());
                rows.push(row);
            }
            Err(error) => println!("{:30.30} {error}", model.name),
        }
    }
    println!("{:30} {}", format!("means of {} of {}", rows.len(), models.len()), means(&rows));
    rows
}

/// What is asked for.
fn options(variant: &Variant, uv_set: UvSet) -> Options {
    let mut options = Options::preset(Bounded::NAME);
    options.pack.gutter = Gutter::Texels(variant.gutter);
    options.atlas.overlaps = OverlapMode::Separate;
    options.atlas.if_larger = IfLarger::Accept;
    options.atlas.uv_set = uv_set;
    options.stages.set(variant.params.clone());
    options
}

fn refined(model: &Model, variant: &Variant) -> Result<Row, String> {
    let options = options(variant, model.uv_set);
    let context = Context::silent();
    let (outcome, _) = common::run(model.files.clone(), &options, &context)?;
    let timings = context.timings();
    let seconds = timings.iter().filter(|t| t.stage == Bounded::NAME).map(|t| t.seconds).sum();
    let figures = &outcome.report["model"];
    let figure = |when: &str, key: &str| figures[when][key].as_f64().unwrap_or(f64::NAN);
    let both = |key: &str| ["before", "after"].map(|when| figure(when, key));
    // The report's energy of a face that keeps its shape is 4.
    let distortion = match variant.params.energy {
        Energy::Surface => both("symmetric_dirichlet").map(|e| e / 4.0),
        Energy::Uploaded => [1.0, figure("after", "distortion_from_input") / 4.0],
    };
    let efficiency = both("packing_efficiency");
    Ok(Row {
        triangles: figure("before", "triangles"),
        efficiency,
        charts: both("charts"),
        seams: both("seam_length_diagonal"),
        distortion,
        seconds,
        is_met: efficiency[1] >= variant.params.packing_efficiency - 1e-6,
        is_sound: figure("after", "flipped_triangles") == 0.0 && figure("after", "overlap_fraction") < 1e-6,
    })
}

fn heading(title: &str) -> String {
    format!(
        "{title:30} {:>9} | {:>7} {:>7} | {:>8} {:>8} | {:>7} {:>7} {:>8} | {:>8} {:>8} {:>8} | {:>7}",
        "triangles", "PE", "to", "charts", "to", "seams", "to", "longer", "E_d", "to", "more", "s"
    )
}

impl Row {
    /// By how much the seams grew; infinite where there were none.
    fn growth(&self) -> f64 {
        self.seams[1] / self.seams[0] - 1.0
    }

    /// By how much the distortion grew.
    fn rise(&self) -> f64 {
        self.distortion[1] / self.distortion[0] - 1.0
    }

    fn in_words(&self) -> String {
        let mut line = line(&[
            self.triangles,
            self.efficiency[0],
            self.efficiency[1],
            self.charts[0],
            self.charts[1],
            self.seams[0],
            self.seams[1],
            self.growth(),
            self.distortion[0],
            self.distortion[1],
            self.rise(),
            self.seconds,
        ]);
        if !self.is_met {
            line.push_str(" MISSED");
        }
        if !self.is_sound {
            line.push_str(" WRONG");
        }
        line
    }
}

fn line(figures: &[f64; 12]) -> String {
    let [triangles, pe, to_pe, charts, to_charts, seams, to_seams, longer, energy, to_energy, more, seconds] = figures;
    format!(
        "{triangles:9.0} | {pe:7.4} {to_pe:7.4} | {charts:8.1} {to_charts:8.1} | {seams:7.3} {to_seams:7.3} {:+7.1}% | {energy:8.4} {to_energy:8.4} {:+7.3}% | {seconds:7.2}",
        100.0 * longer,
        100.0 * more
    )
}

/// The mean of each figure over the models for which it is defined, the least packing efficiency, and how many reach the bound.
fn means(rows: &[Row]) -> String {
    let mean = |pick: &dyn Fn(&Row) -> f64| {
        let known: Vec<f64> = rows.iter().map(pick).filter(|x| x.is_finite()).collect();
        known.iter().sum::<f64>() / known.len() as f64
    };
    let line = line(&[
        mean(&|r| r.triangles),
        mean(&|r| r.efficiency[0]),
        mean(&|r| r.efficiency[1]),
        mean(&|r| r.charts[0]),
        mean(&|r| r.charts[1]),
        mean(&|r| r.seams[0]),
        mean(&|r| r.seams[1]),
        mean(&Row::growth),
        mean(&|r| r.distortion[0]),
        mean(&|r| r.distortion[1]),
        mean(&Row::rise),
        mean(&|r| r.seconds),
    ]);
    let least = rows.iter().map(|r| r.efficiency[1]).fold(f64::NAN, f64::min);
    let count = |is: fn(&Row) -> bool| rows.iter().filter(|r| is(r)).count();
    format!(
        "{line}; least PE {least:.4}, {} of {} met, {} wrong",
        count(|r| r.is_met),
        rows.len(),
        count(|r| !r.is_sound)
    )
}
