//! Room for jobs: how many run at once, and how much memory they may need together.
//!
//! Each running job has a pool of its own: on a shared one, a job that waits for its own parts could be given all of another job to do.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::Notify;

use super::queue::Room;
use super::system;
use crate::error::{Failure, Result};

/// Jobs that are expected to need more than this many bytes are large: one slot stays free of them.
const SMALL: u64 = 160 << 20;
/// A job for which there is no room is overtaken by smaller ones for so long.
const PATIENCE: Duration = Duration::from_secs(60);

/// The room of this process.
pub struct Slots {
    state: Mutex<Taken>,
    threads: usize,
    count: usize,
    memory: u64,
    /// Told when a slot becomes free.
    pub freed: Notify,
}

struct Taken {
    idle: Vec<Arc<ThreadPool>>,
    memory: u64,
    large: usize,
}

/// Room that a job holds.
pub struct Slot {
    slots: Arc<Slots>,
    pool: Arc<ThreadPool>,
    memory: u64,
}

impl Slots {
    /// Room for `count` jobs at once, each with `threads` threads (0 means one for each core), that need `memory` bytes together.
    ///
    /// # Errors
    /// `internal` when the system has no threads to give.
    pub fn new(count: usize, threads: usize, memory: u64) -> Result<Arc<Self>> {
        let idle = (0..count.max(1))
            .map(|_| built(builder(threads).start_handler(|_| system::step_back())).map(Arc::new))
            .collect::<Result<Vec<_>>>()?;
        let threads = idle.first().map_or(1, |pool| pool.current_num_threads());
        let (count, freed) = (idle.len(), Notify::new());
        Ok(Arc::new(Slots { state: Mutex::new(Taken { idle, memory: 0, large: 0 }), threads, count, memory, freed }))
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
    pub fn taken(&self) -> (usize, u64) {
        let taken = self.lock();
        (self.count - taken.idle.len(), taken.memory)
    }

    /// What there is room for; `None` when every slot is taken.
    pub fn room(&self) -> Option<Room> {
        let taken = self.lock();
        let full = self.count > 1 && taken.large + 1 >= self.count;
        let room = Room {
            total: self.memory,
            free: self.memory - taken.memory,
            most: if full { SMALL } else { u64::MAX },
            patience: PATIENCE,
        };
        (!taken.idle.is_empty()).then_some(room)
    }

    /// Takes the room that a job of that size needs; call it after [`Slots::room`] has told that there is some.
    pub fn take(self: &Arc<Self>, memory: u64) -> Option<Slot> {
        let mut taken = self.lock();
        let pool = taken.idle.pop()?;
        let memory = memory.min(self.memory - taken.memory);
        taken.memory += memory;
        taken.large += usize::from(memory > SMALL);
        Some(Slot { slots: self.clone(), pool, memory })
    }

    fn lock(&self) -> MutexGuard<'_, Taken> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Slot {
    /// Runs the work on the slot's pool. The room is taken until it ends.
    pub fn spawn(self, work: impl FnOnce() + Send + 'static) {
        let pool = self.pool.clone();
        pool.spawn(move || {
            work();
            system::give_memory_back();
            drop(self);
        });
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        let mut taken = self.slots.lock();
        taken.memory -= self.memory;
        taken.large -= usize::from(self.memory > SMALL);
        taken.idle.push(self.pool.clone());
        drop(taken);
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
    fn room_is_taken_and_given_back_and_one_slot_is_for_small_jobs() {
        let slots = Slots::new(3, 1, 1 << 30).unwrap();
        assert_eq!(slots.room().unwrap().free, 1 << 30);
        let large = [slots.take(1 << 28), slots.take(1 << 28)];
        let room = slots.room().unwrap();
        assert_eq!((room.free, room.most), (1 << 29, SMALL));
        let small = slots.take(10).unwrap();
        assert!(slots.room().is_none() && slots.take(1).is_none());
        drop(large);
        assert_eq!(slots.taken(), (1, 10));
        drop(small);
        assert_eq!((slots.taken(), slots.room().unwrap().most), ((0, 0), u64::MAX));
        // What needs more than there is takes all there is.
        let huge = slots.take(u64::MAX).unwrap();
        assert_eq!(slots.room().unwrap().free, 0);
        drop(huge);
    }

    #[test]
    fn a_slot_is_free_again_when_its_work_has_ended() {
        let slots = Slots::new(1, 2, 100).unwrap();
        let (told, hear) = std::sync::mpsc::channel();
        slots.take(100).unwrap().spawn(move || hear.recv().unwrap());
        assert!(slots.room().is_none());
        told.send(()).unwrap();
        let started = std::time::Instant::now();
        while slots.room().is_none() {
            assert!(started.elapsed() < Duration::from_secs(10));
            std::thread::yield_now();
        }
    }
}
