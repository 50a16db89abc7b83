//! Capacity for jobs: how many run at once, and how much memory they may need together.
//!
//! Each running job has a pool of its own: on a shared one, a job that waits for its own parts could be given all of another job to do.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::Notify;

use super::queue::Capacity;
use super::system;
use crate::error::{Failure, Result};

/// Jobs that are expected to need more than this many bytes are large: one slot stays free of them.
pub(super) const SMALL: u64 = 160 << 20;
/// A job for which there is no capacity is overtaken by smaller ones for so long.
const PATIENCE: Duration = Duration::from_secs(60);

/// The capacity of this process.
pub struct Slots {
    usage: Mutex<SlotUsage>,
    threads: usize,
    count: usize,
    memory: u64,
    /// Notified when a slot becomes free.
    pub freed: Notify,
}

struct SlotUsage {
    idle: Vec<Arc<ThreadPool>>,
    memory: u64,
    large: usize,
}

/// Capacity that a job holds.
pub struct Slot {
    slots: Arc<Slots>,
    pool: Arc<ThreadPool>,
    memory: u64,
}

impl Slots {
    /// Capacity for `count` jobs at once, each with `threads` threads (0 means one for each core), that need `memory` bytes together.
    ///
    /// # Errors
    /// `internal` when the system has no threads to give.
    pub fn new(count: usize, threads: usize, memory: u64) -> Result<Arc<Self>> {
        let idle = (0..count.max(1))
            .map(|_| built(builder(threads).start_handler(|_| system::lower_thread_priority())).map(Arc::new))
            .collect::<Result<Vec<_>>>()?;
        let threads = idle.first().map_or(1, |pool| pool.current_num_threads());
        let (count, freed) = (idle.len(), Notify::new());
        Ok(Arc::new(Slots {
            usage: Mutex::new(SlotUsage { idle, memory: 0, large: 0 }),
            threads,
            count,
            memory,
            freed,
        }))
    }

    /// Threads of one job.
    pub fn threads(&self) -> usize {
        self.threads
    }

    /// Jobs at once.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Bytes that all running jobs may need.
    pub fn memory(&self) -> u64 {
        self.memory
    }

    /// Jobs that run, and the bytes that they are expected to need.
    pub fn usage(&self) -> (usize, u64) {
        let usage = self.lock();
        (self.count - usage.idle.len(), usage.memory)
    }

    /// What there is capacity for; `None` when every slot is taken.
    pub fn capacity(&self) -> Option<Capacity> {
        let usage = self.lock();
        let full = self.count > 1 && usage.large + 1 >= self.count;
        let capacity = Capacity {
            total: self.memory,
            free: self.memory - usage.memory,
            most: if full { SMALL } else { u64::MAX },
            patience: PATIENCE,
        };
        (!usage.idle.is_empty()).then_some(capacity)
    }

    /// Takes the capacity that a job of that size needs; call it after [`Slots::capacity`] has said that there is some.
    pub fn take(self: &Arc<Self>, memory: u64) -> Option<Slot> {
        let mut usage = self.lock();
        let pool = usage.idle.pop()?;
        let memory = memory.min(self.memory - usage.memory);
        usage.memory += memory;
        usage.large += usize::from(memory > SMALL);
        Some(Slot { slots: self.clone(), pool, memory })
    }

    fn lock(&self) -> MutexGuard<'_, SlotUsage> {
        self.usage.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Slot {
    /// Runs the work on the slot's pool. The slot is taken until it ends.
    pub fn spawn(self, work: impl FnOnce() + Send + 'static) {
        let pool = self.pool.clone();
        pool.spawn(move || {
            work();
            system::return_free_memory();
            drop(self);
        });
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        let mut usage = self.slots.lock();
        usage.memory -= self.memory;
        usage.large -= usize::from(self.memory > SMALL);
        usage.idle.push(self.pool.clone());
        drop(usage);
        self.slots.freed.notify_one();
    }
}

/// A pool that computes; 0 threads means one for each core.
///
/// # Errors
/// `internal` when the system has no threads to give.
pub fn pool(threads: usize) -> Result<ThreadPool> {
    built(builder(threads))
}

fn builder(threads: usize) -> ThreadPoolBuilder {
    ThreadPoolBuilder::new().num_threads(threads).thread_name(|i| format!("compute-{i}")).stack_size(8 << 20)
}

fn built(builder: ThreadPoolBuilder) -> Result<ThreadPool> {
    builder.build().map_err(|e| Failure::internal(format!("no threads: {e}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn capacity_is_taken_and_given_back_and_one_slot_is_for_small_jobs() {
        let slots = Slots::new(3, 1, 1 << 30).unwrap();
        assert_eq!(slots.capacity().unwrap().free, 1 << 30);
        let large = [slots.take(1 << 28), slots.take(1 << 28)];
        let capacity = slots.capacity().unwrap();
        assert_eq!((capacity.free, capacity.most), (1 << 29, SMALL));
        let small = slots.take(10).unwrap();
        assert!(slots.capacity().is_none() && slots.take(1).is_none());
        drop(large);
        assert_eq!(slots.usage(), (1, 10));
        drop(small);
        assert_eq!((slots.usage(), slots.capacity().unwrap().most), ((0, 0), u64::MAX));
        // What needs more than there is takes all there is.
        let huge = slots.take(u64::MAX).unwrap();
        assert_eq!(slots.capacity().unwrap().free, 0);
        drop(huge);
    }

    #[test]
    fn a_slot_is_free_again_when_its_work_has_ended() {
        let slots = Slots::new(1, 2, 100).unwrap();
        let (finish, finished) = std::sync::mpsc::channel();
        slots.take(100).unwrap().spawn(move || finished.recv().unwrap());
        assert!(slots.capacity().is_none());
        finish.send(()).unwrap();
        let started = std::time::Instant::now();
        while slots.capacity().is_none() {
            assert!(started.elapsed() < Duration::from_secs(10));
            std::thread::yield_now();
        }
    }
}
