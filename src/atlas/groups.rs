//! Things that belong together: sets that grow into each other, lists of lists, lists without repetition.

/// The member that the set of `i` goes by, where each member names another of its set and that one itself (union-find with path halving).
pub(crate) fn find_root(parent: &mut [u32], mut i: u32) -> u32 {
    while parent[i as usize] != i {
        parent[i as usize] = parent[parent[i as usize] as usize];
        i = parent[i as usize];
    }
    i
}

/// Disjoint sets of 0..n, each of which goes by its least member.
#[derive(Debug, Clone)]
pub(crate) struct DisjointSets {
    parent: Vec<u32>,
}

impl DisjointSets {
    /// Each of 0..n for itself.
    pub(crate) fn new(n: usize) -> Self {
        DisjointSets { parent: (0..n as u32).collect() }
    }

    /// The member that the set of `i` goes by.
    pub(crate) fn find(&mut self, i: u32) -> u32 {
        find_root(&mut self.parent, i)
    }

    /// Makes the sets of two members one.
    pub(crate) fn unite(&mut self, a: u32, b: u32) {
        let (a, b) = (self.find(a), self.find(b));
        self.parent[a.max(b) as usize] = a.min(b);
    }

    /// The sets, each ascending, in the order of their least members.
    pub(crate) fn sets(&mut self) -> Vec<Vec<u32>> {
        self.numbered().1
    }

    /// The number of each member's set, and [`Self::sets`].
    pub(crate) fn numbered(&mut self) -> (Vec<u32>, Vec<Vec<u32>>) {
        let mut sets: Vec<Vec<u32>> = Vec::new();
        let mut number = vec![0; self.parent.len()];
        for i in 0..self.parent.len() as u32 {
            // What a set goes by is its least member, which comes first.
            let root = self.find(i);
            if root == i {
                number[i as usize] = sets.len() as u32;
                sets.push(Vec::new());
            }
            number[i as usize] = number[root as usize];
            sets[number[i as usize] as usize].push(i);
        }
        (number, sets)
    }
}

/// Items in groups, one group after the other in memory; those of a group in the order in which they were given.
#[derive(Debug, Clone)]
pub(crate) struct Grouped<T> {
    /// By group, one more than groups: its first item.
    start: Vec<u32>,
    items: Vec<T>,
}

impl<T: Copy + Default> Grouped<T> {
    /// From each item with its group in 0..n.
    pub(crate) fn new(n: usize, items: impl Iterator<Item = (u32, T)> + Clone) -> Self {
        let mut start = vec![0; n + 1];
        items.clone().for_each(|(group, _)| start[group as usize + 1] += 1);
        (0..n).for_each(|group| start[group + 1] += start[group]);
        let mut next = start.clone();
        let mut sorted = vec![T::default(); start[n] as usize];
        for (group, item) in items {
            let place = &mut next[group as usize];
            sorted[*place as usize] = item;
            *place += 1;
        }
        Grouped { start, items: sorted }
    }

    /// The items of a group.
    pub(crate) fn of(&self, group: u32) -> &[T] {
        &self.items[self.start[group as usize] as usize..self.start[group as usize + 1] as usize]
    }

    /// The items of all groups.
    pub(crate) fn into_items(self) -> Vec<T> {
        self.items
    }
}

/// The items in order, each once.
pub(crate) fn sorted_unique<T: Ord>(items: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut items: Vec<T> = items.into_iter().collect();
    items.sort_unstable();
    items.dedup();
    items
}

/// A cost that can be ordered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cost(pub f64);
impl Eq for Cost {}
impl PartialOrd for Cost {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Cost {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}
