//! A piece's mask prepared for the search over all positions.

use super::pitch::Pitch;
use crate::packing::mask::Mask;

/// A piece's mask prepared for searching: its runs, each as two look-ups on a level.
#[derive(Debug, Clone)]
pub(crate) struct Probe {
    pub width: usize,
    pub height: usize,
    pub(super) tests: Vec<Test>,
    /// Runs of whole bands.
    pub(super) bands: Vec<Test>,
    /// Rows of the longest runs and their lengths: a row of the sheet without so much room is out.
    pub(super) widest: Vec<(u32, u32)>,
}

/// A run: where the two words that answer for it lie, relative to the word of the position, and how far they are shifted.
#[derive(Debug, Clone, Copy)]
pub(super) struct Test {
    first: u32,
    second: u32,
    shifts: [u8; 2],
}

/// Runs so many rows apart collide independently of each other.
const REACH: u32 = 16;
/// How many runs are chosen with regard to those before them.
const SPREAD: usize = 8;
/// How many of the longest runs are held against the room that rows have.
const WIDEST: usize = 12;

impl Probe {
    /// Prepares a mask; long runs come first, since they collide most often, and where `apart` says so also those that are far
    /// from each other.
    pub fn new(mask: &Mask, pitch: Pitch, apart: bool) -> Self {
        let mut runs = mask.runs();
        runs.sort_unstable_by_key(|&(row, first, last)| (std::cmp::Reverse(last - first), row, first));
        let widest = runs.iter().take(WIDEST).map(|&(row, first, last)| (row, last - first + 1)).collect();
        let mut bands = if pitch.stride > 1 { mask.bands(pitch.stride).runs() } else { Vec::new() };
        if apart {
            spread(&mut bands, (REACH / pitch.stride as u32).max(1));
            spread(&mut runs, REACH);
        }
        let tests = |runs: Vec<(u32, u32, u32)>| {
            runs.into_iter().map(|(row, first, last)| Test::new(row as usize, first, last, pitch)).collect()
        };
        Probe { width: mask.width, height: mask.height, tests: tests(runs), bands: tests(bands), widest }
    }
}

/// Puts first those runs that collide where the ones before them do not: long ones far from each other.
fn spread(runs: &mut [(u32, u32, u32)], reach: u32) {
    let mut distance = vec![reach; runs.len()];
    for done in 0..runs.len().min(SPREAD) {
        let worth = |k: &usize| (runs[*k].2 - runs[*k].1 + 1) * distance[*k];
        // The first of equals.
        let Some(next) = (done..runs.len()).rev().max_by_key(worth) else { return };
        runs[done..=next].rotate_right(1);
        distance[done..=next].rotate_right(1);
        let row = runs[done].0;
        for (run, least) in runs.iter().zip(&mut distance).skip(done + 1) {
            *least = (*least).min(run.0.abs_diff(row));
        }
    }
}

/// Those of the free positions at which no run meets a taken cell. `hint` is the run that left none the last time.
#[inline(always)]
pub(super) fn narrowed(mut free: u64, tests: &[Test], here: &[u64], hint: &mut usize, work: &mut u64) -> u64 {
    if let Some(test) = tests.get(*hint) {
        free &= !test.taken(here);
    }
    if free == 0 {
        return 0;
    }
    for (n, test) in tests.iter().enumerate() {
        free &= !test.taken(here);
        if free == 0 {
            *work += n as u64;
            *hint = n;
            return 0;
        }
    }
    *work += tests.len() as u64;
    free
}

impl Test {
    fn new(row: usize, first: u32, last: u32, pitch: Pitch) -> Self {
        let level = (last - first + 1).ilog2();
        let base = row * pitch.row() + level as usize * pitch.level();
        let [first, second] = [first, last + 1 - (1 << level)].map(|x| pitch.plane(x as usize));
        Test {
            first: (base + first.0 + first.1 / 64) as u32,
            second: (base + second.0 + second.1 / 64) as u32,
            shifts: [(first.1 % 64) as u8, (second.1 % 64) as u8],
        }
    }

    /// Of 64 positions, those at which the run meets a taken cell.
    #[inline(always)]
    fn taken(&self, here: &[u64]) -> u64 {
        word_at(here, self.first, self.shifts[0]) | word_at(here, self.second, self.shifts[1])
    }
}

/// The 64 cells that start `shift` cells after word `offset`.
#[inline(always)]
fn word_at(here: &[u64], offset: u32, shift: u8) -> u64 {
    match here.get(offset as usize..offset as usize + 2) {
        Some(&[low, high]) => (low >> shift) | ((high << 1) << (63 - shift)),
        _ => 0,
    }
}
