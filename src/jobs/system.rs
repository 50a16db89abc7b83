//! What a service asks of its operating system, and no crate here does.
#![expect(unsafe_code, reason = "functions of the C library that take numbers only")]

/// Nice level of threads that compute: those that serve requests go first where cores are few.
#[cfg(target_os = "linux")]
const NICE: std::ffi::c_int = 10;

/// Lowers the priority of the calling thread below that of the threads that serve requests.
pub(super) fn lower_thread_priority() {
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
pub(super) fn return_free_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        unsafe extern "C" {
            fn malloc_trim(pad: usize) -> std::ffi::c_int;
        }
        // SAFETY: the GNU C library's own; it may be called at any time from any thread and touches only memory that is free.
        unsafe { malloc_trim(0) };
    }
}
