//! The corners about each vertex, as linked lists: to take one out and to add one costs the same however many there are.

use crate::atlas::HalfEdge;

const NONE: u32 = u32::MAX;

/// Circular lists of corners, one for each vertex.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct CornerLists {
    /// First corner by vertex.
    first: Vec<u32>,
    /// (previous, next) by corner.
    links: Vec<(u32, u32)>,
}

/// Where a corner was in its list.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Taken {
    links: (u32, u32),
    was_first: bool,
}

impl CornerLists {
    /// Lists in ascending order, of faces given by their vertices.
    pub(super) fn new<T: Copy>(vertices: usize, faces: &[[T; 3]], index: impl Fn(T) -> usize) -> Self {
        let mut lists = CornerLists { first: vec![NONE; vertices], links: vec![(NONE, NONE); 3 * faces.len()] };
        for (corner, vertex) in faces.iter().flatten().enumerate() {
            lists.append(index(*vertex), HalfEdge::new(corner));
        }
        lists
    }

    /// The corners of a vertex, in order.
    pub(super) fn of(&self, vertex: usize) -> impl Iterator<Item = HalfEdge> + '_ {
        let first = self.first[vertex];
        let next = move |c: &u32| Some(self.links[*c as usize].1).filter(|next| *next != first);
        std::iter::successors((first != NONE).then_some(first), next).map(HalfEdge)
    }

    /// A further vertex, without corners.
    pub(super) fn push_vertex(&mut self) {
        self.first.push(NONE);
    }

    /// Takes back the last vertex, which has no corners.
    pub(super) fn pop_vertex(&mut self) {
        self.first.pop();
    }

    /// Room for so many corners; new ones are in no list.
    pub(super) fn resize(&mut self, corners: usize) {
        self.links.resize(corners, (NONE, NONE));
    }

    /// Adds a corner, which is in no list, at the end.
    pub(super) fn append(&mut self, vertex: usize, corner: HalfEdge) {
        let c = corner.0;
        let first = self.first[vertex];
        if first == NONE {
            self.first[vertex] = c;
            self.links[corner.index()] = (c, c);
            return;
        }
        let last = self.links[first as usize].0;
        self.links[corner.index()] = (last, first);
        self.links[last as usize].1 = c;
        self.links[first as usize].0 = c;
    }

    /// Takes a corner out.
    pub(super) fn remove(&mut self, vertex: usize, corner: HalfEdge) -> Taken {
        let c = corner.0;
        let links = self.links[corner.index()];
        let was_first = self.first[vertex] == c;
        if links.1 == c {
            self.first[vertex] = NONE;
        } else {
            self.links[links.0 as usize].1 = links.1;
            self.links[links.1 as usize].0 = links.0;
            if was_first {
                self.first[vertex] = links.1;
            }
        }
        Taken { links, was_first }
    }

    /// Undoes [`Self::remove`], the last that happened to the list.
    pub(super) fn put_back(&mut self, vertex: usize, corner: HalfEdge, taken: Taken) {
        self.links[corner.index()] = taken.links;
        self.links[taken.links.0 as usize].1 = corner.0;
        self.links[taken.links.1 as usize].0 = corner.0;
        if taken.was_first {
            self.first[vertex] = corner.0;
        }
    }
}
