//! A balanced tree of bounding boxes, for items that lie anywhere and are of any size.
//!
//! A grid would need memory for long triangles and for sheets that are mostly empty; a tree needs
//! linear memory whatever the input. Items are split at the median of their box centres, ties by index,
//! so the tree is the same for any number of threads.

use glam::DVec2;

/// An axis-aligned box. Boxes that only touch do not meet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bounds {
    pub min: DVec2,
    pub max: DVec2,
}

impl Default for Bounds {
    fn default() -> Self {
        Self::EMPTY
    }
}

impl Bounds {
    pub(crate) const EMPTY: Bounds = Bounds { min: DVec2::INFINITY, max: DVec2::NEG_INFINITY };

    /// The least box that holds the points; [`Self::EMPTY`] of none.
    pub(crate) fn of<'a>(points: impl IntoIterator<Item = &'a DVec2>) -> Self {
        Self::around(points.into_iter().copied())
    }

    /// [`Self::of`] points that come one by one.
    pub(crate) fn around(points: impl Iterator<Item = DVec2>) -> Self {
        points.fold(Self::EMPTY, |b, p| b.union(Bounds { min: p, max: p }))
    }

    /// Itself, or the origin where it is empty or endless.
    pub(crate) fn or_zero(self) -> Self {
        if self.min.is_finite() { self } else { Bounds { min: DVec2::ZERO, max: DVec2::ZERO } }
    }

    pub(crate) fn union(self, other: Self) -> Self {
        Bounds { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// Whether the interiors have a point in common, or one box is flat and lies inside the other.
    pub(crate) fn meets(&self, other: &Self) -> bool {
        self.min.x < other.max.x && other.min.x < self.max.x && self.min.y < other.max.y && other.min.y < self.max.y
    }

    pub(crate) fn size(&self) -> DVec2 {
        (self.max - self.min).max(DVec2::ZERO)
    }
}

const LEAF: usize = 4;

#[derive(Debug, Clone, Copy)]
struct Node {
    bounds: Bounds,
    /// First position in `order`.
    first: u32,
    count: u32,
    /// The right child; the left one follows its parent. 0: a leaf.
    right: u32,
}

/// The tree. Items are numbered as the boxes were given.
#[derive(Debug)]
pub(crate) struct Bvh {
    nodes: Vec<Node>,
    /// Items by position; each node owns a contiguous range of positions.
    pub order: Vec<u32>,
    boxes: Vec<Bounds>,
}

impl Bvh {
    /// The tree over `boxes`, by item.
    pub(crate) fn new(boxes: &[Bounds]) -> Self {
        let mut order: Vec<u32> = (0..boxes.len() as u32).collect();
        let leaf = Node { bounds: Bounds::EMPTY, first: 0, count: 0, right: 0 };
        let mut nodes = vec![leaf; node_count(boxes.len())];
        build(&mut nodes, &mut order, 0, 0, boxes);
        let by_position = order.iter().map(|&i| boxes[i as usize]).collect();
        Bvh { nodes, order, boxes: by_position }
    }

    /// Calls `visit` with the position of every item from position `from` on whose box meets `query`,
    /// in order of position, until it returns false.
    pub(crate) fn query(&self, query: &Bounds, from: usize, visit: impl FnMut(usize) -> bool) {
        self.query_nodes(query, from, |_| true, visit);
    }

    /// [`Self::query`], where `enter` may refuse a node by its number.
    pub(crate) fn query_nodes(
        &self,
        query: &Bounds,
        from: usize,
        enter: impl Fn(usize) -> bool,
        mut visit: impl FnMut(usize) -> bool,
    ) {
        let mut stack = [0u32; 64];
        let mut depth = 1;
        if self.nodes.is_empty() {
            return;
        }
        while depth > 0 {
            depth -= 1;
            let index = stack[depth] as usize;
            let node = &self.nodes[index];
            let end = (node.first + node.count) as usize;
            if end <= from || !node.bounds.meets(query) || !enter(index) {
                continue;
            }
            if node.right == 0 {
                for p in (node.first as usize).max(from)..end {
                    if self.boxes[p].meets(query) && !visit(p) {
                        return;
                    }
                }
            } else {
                stack[depth] = node.right;
                stack[depth + 1] = index as u32 + 1;
                depth += 2;
            }
        }
    }

    /// For every node: the label that all its items share, or `None`. `label` is by position.
    pub(crate) fn common_labels(&self, label: &[u32]) -> Vec<Option<u32>> {
        let mut common = vec![None; self.nodes.len()];
        for (index, node) in self.nodes.iter().enumerate().rev() {
            common[index] = if node.right == 0 {
                let own = &label[node.first as usize..(node.first + node.count) as usize];
                own.first().copied().filter(|l| own.iter().all(|m| m == l))
            } else {
                let left: Option<u32> = common[index + 1];
                left.filter(|_| left == common[node.right as usize])
            };
        }
        common
    }

    /// The box of everything.
    pub(crate) fn bounds(&self) -> Bounds {
        self.nodes.first().map_or(Bounds::EMPTY, |n| n.bounds)
    }

    /// The box of the item at a position.
    pub(crate) fn bounds_at(&self, position: usize) -> Bounds {
        self.boxes[position]
    }
}

/// Triangles in a tree.
#[derive(Debug)]
pub(crate) struct TriangleTree {
    pub tree: Bvh,
    /// By position in the tree.
    pub triangles: Vec<[DVec2; 3]>,
}

impl TriangleTree {
    pub(crate) fn new(triangles: &[[DVec2; 3]]) -> Self {
        let tree = Bvh::new(&triangles.iter().map(Bounds::of).collect::<Vec<_>>());
        let triangles = tree.order.iter().map(|&i| triangles[i as usize]).collect();
        TriangleTree { tree, triangles }
    }
}

fn node_count(items: usize) -> usize {
    match items {
        0 => 0,
        n if n <= LEAF => 1,
        n => 1 + node_count(n / 2) + node_count(n - n / 2),
    }
}

fn build(nodes: &mut [Node], order: &mut [u32], number: usize, first: usize, boxes: &[Bounds]) {
    let Some((node, rest)) = nodes.split_first_mut() else { return };
    node.first = first as u32;
    node.count = order.len() as u32;
    node.bounds = order.iter().fold(Bounds::EMPTY, |b, &i| b.union(boxes[i as usize]));
    if order.len() <= LEAF {
        return;
    }
    let centre = |i: u32| boxes[i as usize].min + boxes[i as usize].max;
    let spread = order.iter().fold(Bounds::EMPTY, |b, &i| b.union(Bounds { min: centre(i), max: centre(i) })).size();
    let axis = usize::from(spread.y > spread.x);
    let half = order.len() / 2;
    order.select_nth_unstable_by(half, |&a, &b| centre(a)[axis].total_cmp(&centre(b)[axis]).then(a.cmp(&b)));
    let (left, right) = order.split_at_mut(half);
    let left_nodes = node_count(half);
    node.right = (number + 1 + left_nodes) as u32;
    let (a, b) = rest.split_at_mut(left_nodes);
    let parallel = left.len() > 4096;
    let mut one = || build(a, left, number + 1, first, boxes);
    let mut two = || build(b, right, number + 1 + left_nodes, first + half, boxes);
    if parallel {
        rayon::join(one, two);
    } else {
        one();
        two();
    }
}
