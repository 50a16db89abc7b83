//! Damaged models, images and options by the thousand.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use intarsia::asset::sample::sample;
use intarsia::asset::{File, Limits, MaterialIndex, load, read};
use intarsia::context::Context;
use intarsia::error::{Code, Failure};
use intarsia::refine::options::{IfLarger, Options};
use intarsia::refine::{Input, parse, refine};
use intarsia::texture::{Format, decode, header};
use serde_json::{Value, json};

use super::fixture::{MTL, OBJ, file, glb, obj, parts, picture, tiny, zip};
use super::guard::{Cost, MOST_SECONDS, measured, most_bytes};
use super::mutate::{self, Random};

/// What the cases may cost.
const LIMITS: Limits =
    Limits { max_input_bytes: 4 << 20, max_image_pixels: 1 << 18, max_triangles: 50_000, max_json_bytes: 1 << 20 };
/// Of so many models one goes the whole way; samples do not, as packing them takes its time.
const REFINED: u64 = 16;

/// One damaged input.
enum Case {
    Model(Vec<File>),
    Image(Vec<u8>),
    Options(Value),
}

/// What the damage is dealt to.
struct Bases {
    tiny: (Value, Vec<u8>),
    whole: Vec<u8>,
    samples: Vec<(Value, Vec<u8>)>,
    images: Vec<Vec<u8>>,
    files: Vec<File>,
    obj: Vec<File>,
    zip: Vec<u8>,
    options: Value,
}

impl Bases {
    fn new() -> Self {
        let whole = tiny().to_glb().expect("a GLB");
        let (json, bin) = parts(&whole);
        let samples = ["quantized", "strips", "skinned"].map(|name| parts(&sample(name).expect("a sample")));
        let files = tiny().to_gltf().expect("files");
        Bases {
            samples: samples.into(),
            images: vec![picture(24, Format::Png), picture(24, Format::Jpeg)],
            zip: zip(&files),
            tiny: (json, bin),
            whole,
            files,
            obj: obj(),
            options: serde_json::to_value(Options::default()).expect("options"),
        }
    }

    /// The case of a number, and the name of its kind.
    fn case(&self, number: u64) -> (&'static str, Case) {
        let mut random = Random::new(number);
        let (json, bin) = &self.tiny;
        match number % 10 {
            0 => {
                let mut bytes = self.whole.clone();
                mutate::bytes(&mut random, &mut bytes);
                ("container", Case::Model(vec![file("m.glb", bytes)]))
            }
            1..4 => {
                // Samples are larger, so that most of the time goes to the tiny model.
                let sampled = random.below(6) == 0;
                let samples = &self.samples;
                let (json, bin) = if sampled { random.pick(samples) } else { &self.tiny };
                let mut json = json.clone();
                mutate::document(&mut random, &mut json);
                let kind = if sampled { "sample" } else { "json" };
                (kind, Case::Model(vec![file("m.glb", glb(json.to_string().as_bytes(), bin))]))
            }
            4 => {
                let mut bin = bin.clone();
                let length = bin.len();
                mutate::bytes(&mut random, &mut bin);
                bin.resize(length, 0);
                ("data", Case::Model(vec![file("m.glb", glb(json.to_string().as_bytes(), &bin))]))
            }
            5 => {
                let mut files = self.files.clone();
                let which = random.below(files.len());
                mutate::bytes(&mut random, &mut files[which].bytes);
                ("files", Case::Model(files))
            }
            6 => {
                let mut files = self.obj.clone();
                files[0].bytes = mutate::text(&mut random, OBJ).into_bytes();
                if random.below(2) == 0 {
                    files[1].bytes = mutate::text(&mut random, MTL).into_bytes();
                }
                if random.below(4) == 0 {
                    let which = random.below(files.len());
                    mutate::bytes(&mut random, &mut files[which].bytes);
                }
                ("obj", Case::Model(files))
            }
            7 => {
                let mut bytes = self.zip.clone();
                mutate::bytes(&mut random, &mut bytes);
                ("zip", Case::Model(vec![file("m.zip", bytes)]))
            }
            8 => {
                let mut bytes = random.pick(&self.images).clone();
                mutate::bytes(&mut random, &mut bytes);
                ("image", Case::Image(bytes))
            }
            _ => {
                let mut options = self.options.clone();
                mutate::document(&mut random, &mut options);
                ("options", Case::Options(options))
            }
        }
    }
}

/// Puts the files of a case into a folder, to be looked at.
fn save(case: &Case, folder: &Path) {
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name.replace('/', "_")), bytes).expect("a file");
    std::fs::create_dir_all(folder).expect("a folder");
    match case {
        Case::Model(files) => files.iter().for_each(|f| write(&f.path, &f.bytes)),
        Case::Image(bytes) => write("image", bytes),
        Case::Options(value) => write("options.json", value.to_string().as_bytes()),
    }
}

/// What is wrong with the answer to a failure, if anything: Intarsia is never at fault, and the sentence says something.
fn judge(failure: &Failure) -> Result<(), String> {
    if failure.code == Code::Internal || failure.message.is_empty() || failure.message.contains('\0') {
        return Err(format!("the answer is {failure:?}"));
    }
    Ok(())
}

/// Runs a case; gives whether the input was taken.
fn run(case: &Case, whole: bool) -> Result<bool, String> {
    let answered = match case {
        Case::Model(files) => model(files, whole),
        Case::Image(bytes) => {
            let told = header(bytes);
            decode(bytes, LIMITS.max_image_pixels).map(|image| {
                let told = told.expect("what is decoded has a header");
                assert_eq!((told.width, told.height), (image.width(), image.height()));
            })
        }
        Case::Options(value) => parse::options(value).map(|_| ()).map_err(|problems| parse::failure(&problems)),
    };
    match answered {
        Ok(()) => Ok(true),
        Err(failure) => judge(&failure).map(|()| false),
    }
}

fn model(files: &[File], whole: bool) -> Result<(), Failure> {
    let (doc, _) = load(files, None, &LIMITS)?;
    let mut options = Options::default();
    options.atlas.if_larger = IfLarger::Accept;
    if whole {
        let input = Input { models: vec![files.to_vec()], limits: LIMITS, extras: false };
        let outcome = refine(&input, &options, &Context::silent())?;
        let result = outcome.artifacts.iter().find(|a| a.role == "model").expect("a model");
        // What goes out can come in. It may be larger than what came.
        let limits = Limits::default();
        let (doc, _) = load(&[file("out.glb", &result.bytes)], None, &limits).expect("the result loads");
        read(
            &doc,
            &MaterialIndex::new(&doc).expect("the result is indexed"),
            options.atlas.reading(),
            &Context::silent(),
        )
        .expect("the result reads");
        return Ok(());
    }
    doc.to_glb()?;
    doc.to_gltf()?;
    read(&doc, &MaterialIndex::new(&doc)?, options.atlas.reading(), &Context::silent())?;
    Ok(())
}

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().and_then(|n| n.parse().ok()).unwrap_or(default)
}

#[derive(Default)]
struct Tally {
    cases: u64,
    taken: u64,
    slowest: (f64, u64),
    largest: (usize, u64),
}

#[test]
fn damaged_input_is_answered_soon_and_in_bounded_memory() {
    let bases = Bases::new();
    let (from, count) = (number("INTARSIA_FUZZ_FROM", 0), number("INTARSIA_FUZZ", 3000));
    let kept = std::env::var_os("INTARSIA_FUZZ_SAVE").map(PathBuf::from);
    let bound = most_bytes(&LIMITS);
    let mut tallies: BTreeMap<&str, Tally> = BTreeMap::new();
    let mut faults: Vec<String> = Vec::new();
    for number in from..from.saturating_add(count) {
        let (kind, case) = bases.case(number);
        let whole = kind != "sample" && (number / 10) % REFINED == 0;
        if let Some(folder) = &kept {
            save(&case, &folder.join(number.to_string()));
        }
        let (mut answer, mut cost) = measured(|| run(&case, whole));
        // Packing takes its time, and longer with all assertions.
        let longest = if whole { 4.0 * MOST_SECONDS } else { MOST_SECONDS };
        if cost.seconds > longest {
            // Another process may have had the processor.
            let (again, second): (_, Cost) = measured(|| run(&case, whole));
            (answer, cost) = (again, Cost { seconds: cost.seconds.min(second.seconds), ..cost });
        }
        let tally = tallies.entry(kind).or_default();
        tally.cases += 1;
        match answer {
            Ok(Ok(taken)) => tally.taken += u64::from(taken),
            Ok(Err(why)) | Err(why) => faults.push(format!("case {number} ({kind}): {why}")),
        }
        if cost.seconds > longest || cost.bytes > bound {
            faults.push(format!("case {number} ({kind}) takes {:.1} s and {} bytes", cost.seconds, cost.bytes));
        }
        if cost.seconds > tally.slowest.0 {
            tally.slowest = (cost.seconds, number);
        }
        tally.largest = tally.largest.max((cost.bytes, number));
        if faults.len() > 20 {
            break;
        }
    }
    for (kind, t) in &tallies {
        println!(
            "{kind:10} {:8} cases, {:5.1} % taken, slowest {:.3} s (case {}), most memory {:.1} MiB (case {}) of {} MiB",
            t.cases,
            100.0 * t.taken as f64 / t.cases as f64,
            t.slowest.0,
            t.slowest.1,
            t.largest.0 as f64 / (1 << 20) as f64,
            t.largest.1,
            bound >> 20
        );
    }
    assert!(faults.is_empty(), "{} faults:\n{}", faults.len(), faults.join("\n"));
    for (kind, t) in tallies.iter().filter(|(_, t)| t.cases >= 250) {
        // Damage of which nothing passes, or everything, tries nothing; but numbers that make no sense are only held back.
        let share = t.taken as f64 / t.cases as f64;
        let most = if *kind == "data" { 1.0 } else { 0.98 };
        assert!((0.002..=most).contains(&share), "{kind}: {share} of the cases are taken");
    }
}

#[test]
fn options_survive_a_round_trip_whatever_they_are() {
    let base = serde_json::to_value(Options::default()).expect("options");
    let mut taken = 0;
    for number in 0..2000 {
        let mut value = base.clone();
        mutate::document(&mut Random::new(number), &mut value);
        if let Ok(options) = parse::options(&value) {
            taken += 1;
            let written = serde_json::to_value(&options).expect("options");
            assert_eq!(parse::options(&written).expect("what was written is read"), options, "case {number}: {value}");
        }
    }
    assert!((1..2000).contains(&taken), "{taken} of 2000 are taken");
    assert!(parse::options(&json!({})).is_ok());
}
