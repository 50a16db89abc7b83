//! Blocks of cells, by which whole containers are scanned.

use super::grid::Run;

/// The runs of blocks of which at least a third is covered; of slivers, which fill no block, every block touched.
pub(super) fn block_runs(runs: &[Run], block: i32) -> Vec<Run> {
    let Some(top) = runs.iter().map(|r| r.row.div_euclid(block)).min() else { return Vec::new() };
    let bottom = runs.iter().map(|r| r.row.div_euclid(block)).max().unwrap_or(top);
    let left = runs.iter().map(|r| r.first.div_euclid(block)).min().unwrap_or(0);
    let right = runs.iter().map(|r| (r.end - 1).div_euclid(block)).max().unwrap_or(left);
    let (w, h) = ((right - left + 1) as usize, (bottom - top + 1) as usize);
    let mut covered = vec![0i32; w * h];
    for r in runs {
        let line = (r.row.div_euclid(block) - top) as usize * w;
        let mut x = r.first;
        while x < r.end {
            let at = x.div_euclid(block);
            let end = ((at + 1) * block).min(r.end);
            covered[line + (at - left) as usize] += end - x;
            x = end;
        }
    }
    let total: i32 = covered.iter().sum();
    let mut least = block * block / 3;
    let kept: i32 = covered.iter().filter(|c| **c >= least).sum();
    if kept * 10 < total * 7 {
        least = 1;
    }
    let mut out = Vec::new();
    for y in 0..h {
        let mut x = 0;
        while x < w {
            let first = x;
            while x < w && covered[y * w + x] >= least {
                x += 1;
            }
            if x > first {
                out.push(Run { row: top + y as i32, first: left + first as i32, end: left + x as i32 });
            }
            x += 1;
        }
    }
    out
}
