//! What this process has used.

use anyhow::Context;

/// CPU time of this process in seconds, all threads.
pub fn cpu_s() -> f64 {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the call fills the structure that it is given and nothing else.
    unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &mut time) };
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// Runs something and returns the CPU seconds that this process used meanwhile, with its result.
pub fn cpu_of<T>(run: impl FnOnce() -> T) -> (f64, T) {
    let before_s = cpu_s();
    let made = run();
    (cpu_s() - before_s, made)
}

/// The largest resident size of this process so far, in bytes.
///
/// # Errors
/// Where the system does not tell.
pub fn peak_bytes() -> anyhow::Result<u64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).context("the system tells no peak")?;
    let kib: u64 = line.split_whitespace().nth(1).context("the peak is no number")?.parse()?;
    Ok(kib * 1024)
}
