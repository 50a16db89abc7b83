//! What a service asks of its operating system, and no crate here does.
#![expect(unsafe_code, reason = "functions of the C library that take numbers only")]

/// Nice level of threads that compute: those that answer go first where cores are few.
#[cfg(target_os = "linux")]
const NICE: std::ffi::c_int = 10;

/// Lets the threads that answer go before the calling one.
pub(super) fn step_back() {
    #[cfg(target_os = "linux")]
    {
        unsafe extern "C" {
            fn nice(more: std::ffi::c_int) -> std::ffi::c_int;
        }
        // SAFETY: takes a number and changes the calling thread alone (on Linux; elsewhere it would be the process).
        unsafe { nice(NICE) };
    }
}

/// Gives memory that the allocator keeps for later back to the system: jobs need a lot of it, and seldom.
pub(super) fn give_memory_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        unsafe extern "C" {
            fn malloc_trim(pad: usize) -> std::ffi::c_int;
        }
        // SAFETY: the GNU C library's own; it may be called at any time from any thread and touches only memory that is free.
        unsafe { malloc_trim(0) };
    }
}
