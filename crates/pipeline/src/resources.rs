//! What this process has used of the machine.

/// The largest resident memory of this process so far in bytes, or `None` where the system does not say.
pub fn peak_resident_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// Seconds of processor time of this process so far, user and system, over all threads.
pub fn cpu_seconds() -> f64 {
    let mut usage = std::mem::MaybeUninit::<libc::rusage>::zeroed();
    // SAFETY: `getrusage` writes a whole `rusage` through a valid pointer; zeroed memory is a valid one besides.
    let usage = unsafe {
        libc::getrusage(libc::RUSAGE_SELF, usage.as_mut_ptr());
        usage.assume_init()
    };
    let seconds = |time: libc::timeval| time.tv_sec as f64 + time.tv_usec as f64 * 1e-6;
    seconds(usage.ru_utime) + seconds(usage.ru_stime)
}

#[cfg(test)]
mod tests {
    #[test]
    fn figures_are_there_and_grow() {
        let before = super::cpu_seconds();
        let mut sum = 0u64;
        while super::cpu_seconds() <= before {
            sum = std::hint::black_box(sum + 1);
        }
        assert!(super::cpu_seconds() > before);
        if let Some(bytes) = super::peak_resident_bytes() {
            assert!(bytes > 100_000);
        }
    }
}
