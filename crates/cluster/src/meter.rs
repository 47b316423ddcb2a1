//! What a task costs its process. One task runs at a time in a worker, so the process's figures are the task's.

use std::time::Instant;

use terrane_pipeline::resources;
use terrane_proto::types::TaskCost;

/// Measures from its creation on.
pub(crate) struct Meter {
    started: Instant,
    cpu_seconds: f64,
}

impl Meter {
    /// Begins; sets the process's memory peak back to what is resident now, where the system can.
    pub(crate) fn start() -> Self {
        // Linux: "5" resets the peak resident size. Elsewhere the peak is that of the process so far, which is safe to report.
        let _ = std::fs::write("/proc/self/clear_refs", "5");
        Self { started: Instant::now(), cpu_seconds: resources::cpu_seconds() }
    }

    /// What it has cost so far.
    pub(crate) fn cost(&self) -> TaskCost {
        TaskCost {
            wall_ms: u64::try_from(self.started.elapsed().as_millis()).unwrap_or(u64::MAX),
            cpu_ms: ((resources::cpu_seconds() - self.cpu_seconds).max(0.0) * 1e3) as u64,
            peak_bytes: resources::peak_resident_bytes().unwrap_or(0),
        }
    }
}

/// Memory in bytes that the process holds now; zero where the system doesn't say.
pub(crate) fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    kib.unwrap_or(0) * 1024
}
