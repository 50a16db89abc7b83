//! The numbers of the search that depend on how many pieces there are: one table.
//!
//! All were set by hand, mostly so that a default job's search takes about a second on two cores; what each was weighed against
//! was not kept. The lines "measured" say what a change of the column alone does to fast searches: geometric means of the sheets' areas
//! and of the words looked at, over 14 real models (`cargo bench --bench models` runs the like) of 1 to 1171 charts, each with quarter
//! turns on a lattice of 4 texels and with any rotation. Differences below 0.2 % mean little.

/// Where a piece is looked for only from where the last one of its size class was found: a construction then takes half the time or
/// less, and the layout is about one hundredth looser.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Frontiers {
    /// Every piece is looked for on the whole strip.
    Nowhere,
    /// Where plans are compared at the coarse resolution.
    Coarse,
    /// There, and in the final layouts of the fast search.
    CoarseAndFast,
    /// In every construction.
    Everywhere,
}

/// How problems of one size are searched.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tuning {
    /// The row holds for so many pieces and fewer.
    pub up_to: usize,
    /// Cells along the side of a square that would hold everything, where plans are compared. Measured: 0.7 times as many cost 0.4 % of
    /// area (of 13 to 60 pieces 1.5 %), 1.4 times as many gain nothing for 8 % more work.
    pub coarse_side: f64,
    /// The same where the best plans are built again, unless whole texels stop it earlier. Measured: half as many cost 0.3 % of area (of
    /// more than 300 pieces 0.8 %) and save 17 % of the work.
    pub fine_side: f64,
    /// Whether the fine resolution keeps to the orientations that the best coarse plans chose. Measured: keeping all costs 20 % of work and
    /// more, and gains nothing.
    pub keeps_orientations: bool,
    /// Coarse plans of the fast search that are built at the fine resolution. Measured: half as many cost 0.4 % of area (of 13 to 60
    /// pieces 1.6 %) and save 12 % of the work.
    pub finalists: usize,
    /// Plans of the thorough search's own constructions that are built there too.
    pub more_finalists: usize,
    /// Plans that are evaluated at once: fixed, so that the result does not depend on the number of threads. Large enough for the threads
    /// of most machines; of thousands of pieces a batch must not take as long as the whole search may. Measured: a quarter of it gains
    /// 0.1 % of area, since mutations begin with better plans.
    pub batch: usize,
    /// Words of occupancy that the fast search looks at: half a second on two cores. Measured: half of it costs 0.3 % of area (of 61 to
    /// 300 pieces 1.2 %), twice as much gains 0.3 %.
    pub coarse_work: f64,
    /// The part of its budget that the thorough search spends on constructions, before its local searches.
    pub construction_part: f64,
    /// Where the search for a position begins at a frontier. Measured on three models of 321 to 1171 charts: nowhere gains 0.6 % of area for
    /// 61 % more work, everywhere costs 0.7 % and saves 14 %.
    pub frontiers: Frontiers,
    /// Whether all finalists are compacted, twice, or the best of them alone, once. Measured on the same three: compacting all gains nothing
    /// for 18 % more work.
    pub compacts_all: bool,
    /// Whether a probe tests runs that are far from each other first, also without a lattice. Layouts are the same; measured on the same
    /// three: 14 % less work.
    pub spreads_probes: bool,
    /// Cells along the side of that square where local searches begin.
    pub search_side: f64,
    /// Cells along the side of a block of the scans of local searches.
    pub block: usize,
    /// Layouts that local searches begin with.
    pub starts: usize,
}

/// The last row up to 300 pieces.
const FEW: Tuning = Tuning {
    up_to: 300,
    coarse_side: 352.0,
    fine_side: 2048.0,
    keeps_orientations: false,
    finalists: 4,
    more_finalists: 0,
    batch: 16,
    coarse_work: 8e7,
    construction_part: 0.08,
    frontiers: Frontiers::Nowhere,
    compacts_all: true,
    spreads_probes: false,
    search_side: 896.0,
    block: 8,
    starts: 2,
};

/// What the rows of more than 300 have in common.
const MANY: Tuning = Tuning {
    coarse_side: 512.0,
    fine_side: 1792.0,
    more_finalists: 4,
    coarse_work: 2.4e7,
    construction_part: 0.6,
    frontiers: Frontiers::Coarse,
    compacts_all: false,
    spreads_probes: true,
    search_side: 1280.0,
    ..FEW
};

/// What the rows up to 60 have in common.
const HANDFUL: Tuning = Tuning { coarse_side: 224.0, keeps_orientations: true, block: 6, ..FEW };

/// By number of pieces, ascending.
const TABLE: [Tuning; 10] = [
    Tuning { up_to: 6, coarse_side: 256.0, fine_side: 3072.0, search_side: 320.0, starts: 8, ..HANDFUL },
    Tuning { up_to: 12, coarse_side: 160.0, search_side: 400.0, starts: 8, ..HANDFUL },
    Tuning { up_to: 20, search_side: 400.0, starts: 8, ..HANDFUL },
    Tuning { up_to: 60, search_side: 480.0, starts: 4, ..HANDFUL },
    Tuning { up_to: 150, search_side: 600.0, block: 6, starts: 3, ..FEW },
    FEW,
    Tuning { up_to: 400, search_side: 896.0, ..MANY },
    Tuning { up_to: 1000, ..MANY },
    Tuning { up_to: 5000, finalists: 2, frontiers: Frontiers::CoarseAndFast, ..MANY },
    Tuning { up_to: usize::MAX, finalists: 1, batch: 4, frontiers: Frontiers::Everywhere, ..MANY },
];

impl Tuning {
    /// The row for so many pieces.
    pub fn of(pieces: usize) -> &'static Tuning {
        // The last row's limit is that of its type.
        &TABLE[TABLE.partition_point(|row| row.up_to < pieces)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_of_pieces_has_the_first_row_that_holds_it() {
        for pieces in [0, 1, 6, 7, 12, 300, 301, 5000, 5001, usize::MAX] {
            let first = TABLE.iter().find(|row| pieces <= row.up_to).map(|row| row.up_to);
            assert_eq!(first, Some(Tuning::of(pieces).up_to), "{pieces}");
        }
    }
}
