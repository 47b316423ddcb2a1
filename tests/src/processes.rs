//! Processes of a run as the system sees them: who started whom, who lives, who is killed.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

/// Longer than any run of these tests takes on a slow and busy machine.
const PATIENCE: Duration = Duration::from_secs(900);

/// A run under way, with its events in JSON.
pub struct Running {
    child: Child,
    events: std::io::Lines<BufReader<ChildStdout>>,
    /// Every event read so far.
    pub seen: Vec<serde_json::Value>,
}

impl Drop for Running {
    fn drop(&mut self) {
        // A test that failed leaves nothing behind; one that ended well has waited already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Running {
    /// Starts `terrane --json run PHOTOS -o OUT FLAGS`.
    pub fn start(photos: &Path, out: &Path, flags: &[&str]) -> Self {
        let mut command = crate::terrane();
        command.args(["--json", "run"]).arg(photos).arg("-o").arg(out).args(flags);
        Self::spawn(command)
    }

    /// Starts a command whose standard output is lines of JSON.
    pub fn spawn(mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().expect("terrane starts");
        let stdout = child.stdout.take().expect("its output is a pipe");
        Self { child, events: BufReader::new(stdout).lines(), seen: Vec::new() }
    }

    /// The process id of the coordinator.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Reads events until one fits; false when the run ends before.
    pub fn wait_for(&mut self, fits: impl Fn(&serde_json::Value) -> bool) -> bool {
        for line in self.events.by_ref() {
            let event = serde_json::from_str(&line.expect("its output is text")).expect("its output is JSON");
            self.seen.push(event);
            if self.seen.last().is_some_and(&fits) {
                return true;
            }
        }
        false
    }

    /// Waits for the moment when tasks of a stage run.
    pub fn wait_for_running(&mut self, stage: &str) -> bool {
        self.wait_for(|event| event["stage"] == stage && event["running"].as_u64() > Some(0))
    }

    /// Reads the events that are left and waits for the end.
    pub fn finish(&mut self) -> ExitStatus {
        self.wait_for(|_| false);
        self.child.wait().expect("its end can be waited for")
    }

    /// Log lines that hold a word.
    pub fn log_lines(&self, word: &str) -> Vec<String> {
        let text = |event: &serde_json::Value| Some(event["text"].as_str()?.to_owned());
        self.seen.iter().filter_map(text).filter(|line| line.contains(word)).collect()
    }
}

/// The processes that `parent` has started.
pub fn children(parent: u32) -> Vec<u32> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir("/proc").expect("processes can be listed").flatten() {
        let Some(process) = entry.file_name().to_str().and_then(|name| name.parse::<u32>().ok()) else {
            continue;
        };
        if status_field(process, "PPid:").and_then(|value| value.parse().ok()) == Some(parent) {
            found.push(process);
        }
    }
    found.sort_unstable();
    found
}

fn status_field(process: u32, field: &str) -> Option<String> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(field))?;
    Some(line.split_whitespace().next()?.to_owned())
}

/// Sends a signal.
pub fn signal(process: u32, signal: i32) {
    let process = i32::try_from(process).expect("process ids are small");
    // SAFETY: kill(2) takes two numbers and touches no memory of ours.
    let sent = unsafe { libc::kill(process, signal) };
    assert_eq!(sent, 0, "process {process} can be signalled");
}

/// Whether a process computes or waits: not ended, not a zombie.
pub fn lives(process: u32) -> bool {
    status_field(process, "State:").is_some_and(|state| state != "Z" && state != "X")
}

/// Waits until something holds.
pub fn eventually(what: &str, holds: impl Fn() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < end, "waited in vain: {what}");
        std::thread::yield_now();
    }
}
