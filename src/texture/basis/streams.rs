//! BasisLZ: palettes and slices as bits (KTX 2.0, appendix "BasisLZ Bitstream Specification").

use super::bits::{BitWriter, Code};
use super::block::Endpoint;
use super::etc1s::{HISTORY, History, Pair, Palettes};

/// Symbol for a run of equal predictions, and the shortest run.
const PREDICTION_RUN: u32 = 256;
const SHORTEST_RUN: u32 = 3;
/// Symbols for the length of a run of the newest pattern; the last is followed by the length itself.
const RUNS: u32 = 64;
/// The prediction of a block that tells its endpoint.
const NEW: u32 = 3;

/// A file's parts, compressed.
#[derive(Debug)]
pub(super) struct Streams {
    pub(super) endpoints: Vec<u8>,
    pub(super) patterns: Vec<u8>,
    pub(super) tables: Vec<u8>,
    pub(super) slices: Vec<Vec<u8>>,
}

/// What is written of a slice: the code, the symbol, and where a number follows, that with its bits a group.
#[derive(Debug, Clone, Copy)]
struct Told {
    code: usize,
    symbol: u32,
    more: Option<(u32, u32)>,
}

/// Codes of slices, in the order in which they are written.
const PREDICTION: usize = 0;
const DELTA: usize = 1;
const PATTERN: usize = 2;
const RUN: usize = 3;

impl Streams {
    /// Compresses slices, each with its blocks in a row.
    pub(super) fn new(palettes: &Palettes, slices: &[(usize, Vec<Pair>)]) -> Self {
        let told: Vec<Vec<Told>> = slices.iter().map(|(wide, pairs)| tell(*wide, pairs, palettes)).collect();
        let counts = [257, palettes.endpoints.len(), palettes.patterns.len() + HISTORY + 1, RUNS as usize];
        let mut counts = counts.map(|n| vec![0u32; n]);
        for told in told.iter().flatten() {
            counts[told.code][told.symbol as usize] += 1;
        }
        let codes = counts.map(|counts| Code::new(&counts));
        let mut tables = BitWriter::default();
        codes.iter().for_each(|code| tables.put_code(code));
        tables.put(HISTORY as u32, 13);
        let slice = |told: &Vec<Told>| {
            let mut out = BitWriter::default();
            for Told { code, symbol, more } in told {
                out.put_symbol(&codes[*code], *symbol);
                if let Some((number, chunk)) = more {
                    out.put_chunks(*number, *chunk);
                }
            }
            out.finish()
        };
        let slices = told.iter().map(slice).collect();
        Streams {
            endpoints: endpoints(&palettes.endpoints),
            patterns: patterns(&palettes.patterns),
            tables: tables.finish(),
            slices,
        }
    }
}

/// By block how its endpoint follows: that of the left one, of the one above, of the one before that, or new.
fn predictions(wide: usize, pairs: &[Pair]) -> Vec<u32> {
    let predicted = |i: usize| {
        let (x, endpoint) = (i % wide, pairs[i][0]);
        let like = |back: usize| pairs[i - back][0] == endpoint;
        if x > 0 && like(1) {
            0
        } else if i >= wide && like(wide) {
            1
        } else if x > 0 && i > wide && like(wide + 1) {
            2
        } else {
            NEW
        }
    };
    (0..pairs.len()).map(predicted).collect()
}

fn tell(wide: usize, pairs: &[Pair], palettes: &Palettes) -> Vec<Told> {
    let high = pairs.len() / wide.max(1);
    let predictions = predictions(wide, pairs);
    // Four blocks tell together how their endpoints follow.
    let together = |x: usize, y: usize| -> u32 {
        let own = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)];
        let one = |(k, (x, y)): (usize, (usize, usize))| {
            if x < wide && y < high { predictions[y * wide + x] << (2 * k) } else { 0 }
        };
        own.into_iter().enumerate().map(one).sum()
    };
    let groups: Vec<u32> = (0..high)
        .step_by(2)
        .flat_map(|y| (0..wide).step_by(2).map(move |x| (x, y)))
        .map(|(x, y)| together(x, y))
        .collect();
    // At each group what is written of it, if anything.
    let mut of_groups: Vec<Option<Told>> = vec![None; groups.len()];
    let mut at = 0;
    let mut before = None;
    while at < groups.len() {
        let run = groups[at..].iter().take_while(|g| Some(**g) == before).count() as u32;
        if run >= SHORTEST_RUN {
            of_groups[at] =
                Some(Told { code: PREDICTION, symbol: PREDICTION_RUN, more: Some((run - SHORTEST_RUN, 4)) });
            at += run as usize;
            continue;
        }
        of_groups[at] = Some(Told { code: PREDICTION, symbol: groups[at], more: None });
        before = Some(groups[at]);
        at += 1;
    }
    let mut history = History::new();
    let own = palettes.patterns.len() as u32;
    let patterns: Vec<u32> = pairs.iter().map(|[_, p]| history.told(*p).map_or(*p, |at| own + at as u32)).collect();
    let mut out = Vec::new();
    let mut group = of_groups.into_iter();
    let mut last_endpoint = 0;
    let mut in_run = 0;
    for (i, [endpoint, _]) in pairs.iter().enumerate() {
        if (i % wide).is_multiple_of(2) && (i / wide).is_multiple_of(2) {
            out.extend(group.next().flatten());
        }
        if predictions[i] == NEW {
            let count = palettes.endpoints.len() as u32;
            out.push(Told { code: DELTA, symbol: (endpoint + count - last_endpoint) % count, more: None });
        }
        last_endpoint = *endpoint;
        if in_run > 0 {
            in_run -= 1;
            continue;
        }
        let run = patterns[i..].iter().take_while(|p| **p == own).count() as u32;
        if run < SHORTEST_RUN {
            out.push(Told { code: PATTERN, symbol: patterns[i], more: None });
            continue;
        }
        out.push(Told { code: PATTERN, symbol: own + HISTORY as u32, more: None });
        let beyond = run - SHORTEST_RUN;
        let more = (beyond >= RUNS - 1).then_some((beyond, 7));
        out.push(Told { code: RUN, symbol: beyond.min(RUNS - 1), more });
        in_run = run - 1;
    }
    out
}

/// Endpoints as differences from the one before, with codes by the size of what came before.
fn endpoints(all: &[Endpoint]) -> Vec<u8> {
    let grey = all.iter().all(|e| e.colour[0] == e.colour[1] && e.colour[1] == e.colour[2]);
    let channels = if grey { 1 } else { 3 };
    let mut told: Vec<(usize, u32)> = Vec::new();
    let (mut colour, mut table) = ([16u8; 3], 0u8);
    for endpoint in all {
        told.push((3, u32::from(endpoint.table.wrapping_sub(table) & 7)));
        table = endpoint.table;
        for (before, now) in colour.iter_mut().zip(endpoint.colour).take(channels) {
            let code = if *before <= 9 {
                0
            } else if *before <= 21 {
                1
            } else {
                2
            };
            told.push((code, u32::from(now.wrapping_sub(*before) & 31)));
            *before = now;
        }
    }
    let mut counts = [32, 32, 32, 8].map(|n| vec![0u32; n]);
    told.iter().for_each(|(code, symbol)| counts[*code][*symbol as usize] += 1);
    let codes = counts.map(|counts| Code::new(&counts));
    let mut out = BitWriter::default();
    codes.iter().for_each(|code| out.put_code(code));
    out.put(u32::from(grey), 1);
    told.iter().for_each(|(code, symbol)| out.put_symbol(&codes[*code], *symbol));
    out.finish()
}

/// Patterns as differences from the one before, byte by byte.
fn patterns(all: &[u32]) -> Vec<u8> {
    let mut counts = vec![0u32; 256];
    let differences = || all.windows(2).flat_map(|w| (w[0] ^ w[1]).to_le_bytes());
    differences().for_each(|byte| counts[usize::from(byte)] += 1);
    let code = Code::new(&counts);
    let mut out = BitWriter::default();
    // Neither palettes from elsewhere nor bytes as they are.
    out.put(0, 3);
    out.put_code(&code);
    all.first().into_iter().flat_map(|p| p.to_le_bytes()).for_each(|byte| out.put(u32::from(byte), 8));
    differences().for_each(|byte| out.put_symbol(&code, u32::from(byte)));
    out.finish()
}
