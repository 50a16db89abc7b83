//! Runs one piece of work and says what it cost: time, memory, panics.

use std::alloc::{GlobalAlloc, Layout, System};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use intarsia::asset::Limits;

/// Longest that a small input may take, in seconds.
pub const MOST_SECONDS: f64 = 2.0;

/// The system's allocator, which also counts.
struct Counting;

static HELD: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

fn count(more: usize, less: usize) {
    let held = HELD.fetch_add(more, Relaxed).wrapping_add(more);
    PEAK.fetch_max(held, Relaxed);
    HELD.fetch_sub(less, Relaxed);
}

#[expect(unsafe_code, reason = "every call goes on to the system's allocator as it came")]
// SAFETY: the contract of each method is that of the method of `System` which it calls.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        unsafe { System.alloc(layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        count(0, layout.size());
        unsafe { System.dealloc(at, layout) }
    }
    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // Both are held while the contents move.
        count(size, layout.size());
        unsafe { System.realloc(at, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// What a piece of work cost.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cost {
    /// Time on the clock or, where other programs had the processor, on that.
    pub seconds: f64,
    /// Most bytes held at once, beyond those held before.
    pub bytes: usize,
}

/// Runs `work` alone in this process, so that the memory is its own; a panic comes back as its words.
pub fn measured<T>(work: impl FnOnce() -> T) -> (Result<T, String>, Cost) {
    static ALONE: Mutex<()> = Mutex::new(());
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let before = HELD.load(Relaxed);
    PEAK.store(before, Relaxed);
    let start = (Instant::now(), processor_seconds());
    let done = catch_unwind(AssertUnwindSafe(work));
    let elapsed = start.0.elapsed().as_secs_f64();
    let used = processor_seconds().zip(start.1).map_or(elapsed, |(now, then)| now - then);
    let cost = Cost { seconds: elapsed.min(used), bytes: PEAK.load(Relaxed).saturating_sub(before) };
    let words = |panic: Box<dyn std::any::Any + Send>| {
        let text = panic.downcast_ref::<String>().cloned();
        text.or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned())).unwrap_or_default()
    };
    (done.map_err(words), cost)
}

/// Seconds of processor time that this process has taken, in hundredths; none where the system does not tell.
fn processor_seconds() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name of the program, in brackets, may hold blanks.
    let mut fields = text.rsplit_once(')')?.1.split_ascii_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / 100.0)
}

/// What an input within `limits` may hold at once, in bytes: copies of the files while they are unpacked, edited and
/// written, the Atlas of the triangles before and after, one slot decoded and baked, and what any job needs.
pub fn most_bytes(limits: &Limits) -> usize {
    let bytes = 16 * limits.max_input_bytes + 64 * limits.max_image_pixels + 2048 * limits.max_triangles + (64 << 20);
    bytes as usize
}
