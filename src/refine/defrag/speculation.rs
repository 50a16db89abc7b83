//! What is tried before it is known to be needed, on threads that would idle: operations ahead of their turn, and the next way to try
//! an operation beside the one before.
//!
//! An attempt changes nothing, and stands as long as nothing changes that it depends on. So the result is that of one thread that tries
//! one way of one operation after the other; only the time differs.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use super::attempt::{Attempt, Reason, Workspace, attempt};
use super::mesh::MergeMesh;
use super::operation::Operation;
use super::params::Defrag;
use super::queue::OperationQueue;

/// Vertices beyond which others are begun beside a piece of work, and one that nobody waits for any more is given up. Some
/// milliseconds: waking another thread may take as long.
const LONG: usize = if cfg!(test) { 20 } else { 500 };

/// Operations that are tried ahead of their turn at most.
const AHEAD: usize = 64;

/// Work on an operation beyond which it is not tried ahead of its turn again: what it depends on changes too soon.
const DEAR: u64 = 2_000;

/// Nobody waits for a piece of work any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Superseded;

/// Memory for as many pieces of work as run at once.
#[derive(Debug, Default)]
struct Workspaces(Mutex<Vec<Workspace>>);

impl Workspaces {
    fn with<T>(&self, work: impl FnOnce(&mut Workspace) -> T) -> T {
        let free = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut workspace = free().pop().unwrap_or_default();
        let result = work(&mut workspace);
        free().push(workspace);
        result
    }
}

/// A piece of work, as the scheduler sees it.
pub(super) struct Task<'a> {
    workspaces: &'a Workspaces,
    /// What it is a part of.
    parent: Option<&'a Task<'a>>,
    /// Set when nobody waits for it any more.
    superseded: Option<&'a AtomicBool>,
    /// Begins what may run beside it.
    begin_others: Option<&'a (dyn Fn() + Sync)>,
}

impl<'a> Task<'a> {
    fn root(workspaces: &'a Workspaces) -> Self {
        Task { workspaces, parent: None, superseded: None, begin_others: None }
    }

    /// Lends it memory.
    pub(super) fn with_workspace<T>(&self, work: impl FnOnce(&mut Workspace) -> T) -> T {
        self.workspaces.with(work)
    }

    /// To be called by work on so many vertices where it may take long from here on.
    pub(super) fn checkpoint(&self, vertices: usize) -> Result<(), Superseded> {
        if vertices <= LONG {
            return Ok(());
        }
        self.begin_others();
        if self.is_superseded() { Err(Superseded) } else { Ok(()) }
    }

    fn begin_others(&self) {
        if let Some(begin) = self.begin_others {
            begin();
        }
        if let Some(parent) = self.parent {
            parent.begin_others();
        }
    }

    fn is_superseded(&self) -> bool {
        self.superseded.is_some_and(|flag| flag.load(Ordering::Relaxed)) || self.parent.is_some_and(Task::is_superseded)
    }

    /// Works on one item after the other, until a result `decides`. Gives the results.
    pub(super) fn until_decided<I: Sync, T: Send>(
        &self,
        items: &[I],
        work: &(impl Fn(&I, &Task<'_>) -> Result<T, Superseded> + Sync),
        decides: impl Fn(&T) -> bool + Sync,
    ) -> Result<Vec<T>, Superseded> {
        let Some((first, others)) = items.split_first() else { return Ok(Vec::new()) };
        if others.is_empty() {
            return Ok(vec![work(first, self)?]);
        }
        let (result, mut ahead) = self.beside(
            |task| work(first, task),
            |result| result.as_ref().is_ok_and(|result| !decides(result)),
            || (0..others.len() as u32).collect(),
            |other, task| work(&others[other as usize], task).ok(),
        );
        let mut results = vec![result?];
        for (other, item) in (0..).zip(others) {
            if results.last().is_some_and(&decides) {
                break;
            }
            results.push(match ahead.remove(&other) {
                Some(result) => result,
                None => work(item, self)?,
            });
        }
        Ok(results)
    }

    /// Does `first`. From where that may take long, threads that would idle do those of `others` beside it, which are superseded when
    /// `first` is done, unless they are `needed` then. Gives their results, too, as far as there are any.
    fn beside<T: Send, U: Send>(
        &self,
        first: impl FnOnce(&Task<'_>) -> T + Send,
        needed: impl Fn(&T) -> bool + Sync,
        others: impl Fn() -> Vec<u32> + Sync,
        other: impl Fn(u32, &Task<'_>) -> Option<U> + Sync,
    ) -> (T, BTreeMap<u32, U>) {
        if rayon::current_num_threads() == 1 {
            return (first(self), BTreeMap::new());
        }
        let (begun, superseded) = (AtomicBool::new(false), AtomicBool::new(false));
        let results: Mutex<BTreeMap<u32, U>> = Mutex::default();
        let result = rayon::scope(|scope| {
            let begin_others = || {
                if begun.swap(true, Ordering::Relaxed) {
                    return;
                }
                for id in others() {
                    let (superseded, results, other) = (&superseded, &results, &other);
                    let task = Task { parent: Some(self), superseded: Some(superseded), begin_others: None, ..*self };
                    scope.spawn(move |_| {
                        if !task.is_superseded()
                            && let Some(result) = other(id, &task)
                        {
                            results.lock().unwrap_or_else(PoisonError::into_inner).insert(id, result);
                        }
                    });
                }
            };
            let task = Task { parent: Some(self), superseded: None, begin_others: Some(&begin_others), ..*self };
            let result = first(&task);
            superseded.store(!needed(&result), Ordering::Relaxed);
            result
        });
        (result, results.into_inner().unwrap_or_else(PoisonError::into_inner))
    }
}

/// Attempts that were made ahead of their turn.
#[derive(Debug)]
pub(super) struct Speculation<'a> {
    params: &'a Defrag,
    workspaces: Workspaces,
    /// By operation.
    ahead: BTreeMap<u32, Attempt>,
    /// Operations that are not tried ahead of their turn again.
    dear: BTreeSet<u32>,
}

impl<'a> Speculation<'a> {
    pub(super) fn new(params: &'a Defrag) -> Self {
        Speculation { params, workspaces: Workspaces::default(), ahead: BTreeMap::new(), dear: BTreeSet::new() }
    }

    /// Whether the operation leaves a planar chart: a matter of all of its border, and asked when its turn comes.
    pub(super) fn stays_planar(&self, mesh: &MergeMesh, op: &Operation) -> bool {
        self.workspaces.with(|w| w.loops.stays_planar(mesh, &op.pairs(mesh), op.is_within()))
    }

    /// The attempt at an operation, as the mesh is now.
    pub(super) fn attempt(&mut self, mesh: &MergeMesh, queue: &OperationQueue<'_>, id: u32) -> Attempt {
        let op = queue.operation(id);
        if let Some(attempt) = self.ahead.remove(&id).filter(|a| a.footprint.stands(mesh, op, self.params)) {
            return attempt;
        }
        let this = &*self;
        let (attempt, ahead) = Task::root(&this.workspaces).beside(
            |task| attempt(mesh, op, this.params, task),
            |_| false,
            || this.worth_trying(mesh, queue),
            |other, task| {
                let op = queue.operation(other);
                this.stays_planar(mesh, op).then(|| attempt(mesh, op, this.params, task))
            },
        );
        for (other, attempt) in ahead {
            self.note_work(other, &attempt);
            self.ahead.extend(attempt.ok().map(|attempt| (other, attempt)));
        }
        self.ahead.retain(|&id, _| queue.is_waiting(id));
        self.note_work(id, &attempt);
        // Nothing supersedes the operation whose turn it is.
        attempt.unwrap_or_else(|Superseded| Attempt::failed(mesh, op, self.params, Reason::Singular))
    }

    /// The next operations that are worth trying ahead of their turn.
    fn worth_trying(&self, mesh: &MergeMesh, queue: &OperationQueue<'_>) -> Vec<u32> {
        let known = |id: &u32| {
            let attempt = self.ahead.get(id);
            attempt.is_some_and(|attempt| attempt.footprint.stands(mesh, queue.operation(*id), self.params))
        };
        queue.upcoming(AHEAD).into_iter().filter(|id| !self.dear.contains(id) && !known(id)).collect()
    }

    /// Remembers whether an operation is dear.
    fn note_work(&mut self, id: u32, attempt: &Result<Attempt, Superseded>) {
        if attempt.as_ref().is_ok_and(|attempt| attempt.work <= DEAR) {
            self.dear.remove(&id);
        } else {
            self.dear.insert(id);
        }
    }
}
