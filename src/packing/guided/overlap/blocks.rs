//! A placed piece's costs by blocks of cells, for scans of the whole container.

use crate::packing::guided::item::PlacedItem;

/// Costs of the blocks that a piece touches.
#[derive(Debug, Default)]
pub(super) struct BlockCosts {
    /// The first block.
    pub x: i32,
    pub y: i32,
    /// Blocks in a row.
    pub width: usize,
    pub costs: Vec<i32>,
}

impl BlockCosts {
    /// Recomputes the costs for a piece that has moved; gives the work.
    pub fn update(&mut self, placed: &PlacedItem, block: usize) -> u64 {
        let block = block as i32;
        if block <= 1 {
            return 0;
        }
        let PlacedItem { item, x, y } = placed;
        (self.x, self.y) = (x.div_euclid(block), y.div_euclid(block));
        self.width = ((x + item.width() - 1).div_euclid(block) - self.x + 1) as usize;
        let height = ((y + item.height() - 1).div_euclid(block) - self.y + 1) as usize;
        self.costs.clear();
        self.costs.resize(self.width * height, 0);
        for (row, line) in item.cost().chunks_exact(item.mask.width).enumerate() {
            let at = ((y + row as i32).div_euclid(block) - self.y) as usize * self.width;
            let mut rest = line;
            let mut length = (block - x.rem_euclid(block)) as usize;
            for sum in &mut self.costs[at..at + self.width] {
                let (now, later) = rest.split_at(length.min(rest.len()));
                *sum += now.iter().map(|c| i32::from(*c)).sum::<i32>();
                (rest, length) = (later, block as usize);
            }
        }
        item.cells() as u64 / 8
    }
}
