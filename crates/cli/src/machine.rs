//! What this machine has: cores, memory, a name.

use std::num::NonZeroU32;

/// Cores that this process may use; at least one.
pub fn cores() -> u32 {
    std::thread::available_parallelism().map_or(1, |cores| u32::try_from(cores.get()).unwrap_or(u32::MAX))
}

/// Memory in bytes that this process may use: the machine's, or less where a control group says so. 4 GiB when the system
/// does not say.
pub fn memory_bytes() -> u64 {
    let info = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let line = info.lines().find_map(|line| line.strip_prefix("MemTotal:"));
    let kib = line.and_then(|line| line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    let machine = kib.map_or(4 << 30, |kib| kib * 1024);
    let group = std::fs::read_to_string("/sys/fs/cgroup/memory.max")
        .ok()
        .and_then(|text| text.trim().parse::<u64>().ok());
    machine.min(group.unwrap_or(u64::MAX))
}

/// A name for a worker of this process.
pub fn worker_name() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let host = host.trim();
    format!("{}-{}", if host.is_empty() { "host" } else { host }, std::process::id())
}

/// How processes share the machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Share {
    /// Worker processes.
    pub workers: u32,
    /// Threads of each.
    pub threads: u32,
    /// Memory of each in bytes.
    pub memory_bytes: u64,
}

/// Smallest memory of a worker that is of any use.
pub const LEAST_MEMORY: u64 = 256 << 20;

impl Share {
    /// What was asked for, completed from what the machine has.
    pub fn resolve(workers: Option<NonZeroU32>, threads: Option<NonZeroU32>, memory: Option<u64>) -> Self {
        Self::of(cores(), self::memory_bytes(), (workers, threads, memory))
    }

    /// The same for a process that has the machine, or what was asked of it, to itself.
    pub fn alone(threads: Option<NonZeroU32>, memory: Option<u64>) -> Self {
        let threads = threads.or_else(|| NonZeroU32::new(cores()));
        Self::resolve(NonZeroU32::new(1), threads, memory)
    }

    fn of(
        cores: u32,
        machine_bytes: u64,
        asked: (Option<NonZeroU32>, Option<NonZeroU32>, Option<u64>),
    ) -> Self {
        let workers = asked.0.map_or(cores.clamp(1, 4), NonZeroU32::get);
        // Each may use every core: a stage of fewer tasks than workers, or its last task, would leave some idle. Where all
        // workers are busy, the system shares the cores among them.
        let threads = asked.1.map_or(cores.max(1), NonZeroU32::get);
        let share = machine_bytes / 4 * 3 / u64::from(workers);
        Self { workers, threads, memory_bytes: asked.2.unwrap_or(share).max(LEAST_MEMORY) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_share_the_machine() {
        let share = |cores| Share::of(cores, 16 << 30, (None, None, None));
        assert_eq!(share(1), Share { workers: 1, threads: 1, memory_bytes: 12 << 30 });
        assert_eq!(share(2), Share { workers: 2, threads: 2, memory_bytes: 6 << 30 });
        assert_eq!(share(16), Share { workers: 4, threads: 16, memory_bytes: 3 << 30 });
        let three = NonZeroU32::new(3);
        assert_eq!(
            Share::of(2, 16 << 30, (three, None, Some(1 << 30))),
            Share { workers: 3, threads: 2, memory_bytes: 1 << 30 }
        );
        assert!(cores() >= 1 && memory_bytes() > 1 << 20 && !worker_name().is_empty());
    }
}
