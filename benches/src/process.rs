//! Other programs, measured from outside.

use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::Instant;

use anyhow::{Context, bail};

/// What a finished process used, its children included.
#[derive(Clone, Copy, Debug)]
pub struct Usage {
    /// Wall time in seconds.
    pub wall_s: f64,
    /// User and system time in seconds, of the process and those it waited for.
    pub cpu_s: f64,
}

/// User and system time of the children waited for, in seconds.
fn children_cpu_s() -> f64 {
    // SAFETY: getrusage only fills the structure it is given, and zero is a valid value of every field.
    let usage = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        libc::getrusage(libc::RUSAGE_CHILDREN, &mut usage);
        usage
    };
    let seconds = |time: libc::timeval| time.tv_sec as f64 + time.tv_usec as f64 * 1e-6;
    seconds(usage.ru_utime) + seconds(usage.ru_stime)
}

/// Runs a command to its end and returns what it used and printed.
///
/// # Errors
/// When it can't be started or does not succeed; the error holds the end of what it printed.
pub fn run(command: &mut Command) -> anyhow::Result<(Usage, String)> {
    let cpu_before_s = children_cpu_s();
    let start = Instant::now();
    let output = command
        .stdin(Stdio::null())
        .output()
        .with_context(|| format!("{} can't be started", command.get_program().to_string_lossy()))?;
    let wall_s = start.elapsed().as_secs_f64();
    let cpu_s = children_cpu_s() - cpu_before_s;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    if !output.status.success() {
        let errors = String::from_utf8_lossy(&output.stderr);
        bail!("{command:?} ended with {}:\n{text}\n{errors}", output.status);
    }
    Ok((Usage { wall_s, cpu_s }, text))
}

/// The release binary of terrane as a newcomer builds it, built if need be.
///
/// # Errors
/// When the build fails.
pub fn terrane() -> anyhow::Result<PathBuf> {
    built_with(&[])
}

/// The release binary of terrane with everything, built if need be. It takes the place of the other one.
///
/// # Errors
/// When the build fails.
pub fn full_terrane() -> anyhow::Result<PathBuf> {
    built_with(&["--features", "full"])
}

fn built_with(flags: &[&str]) -> anyhow::Result<PathBuf> {
    let mut build = Command::new(env!("CARGO"));
    build.args([
        "build",
        "--release",
        "--package",
        "terrane-cli",
        "--bin",
        "terrane",
        "--message-format=json",
    ]);
    let (_, text) = run(build.args(flags).current_dir(crate::root()))?;
    text.lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
        .filter_map(|message| message["executable"].as_str().map(PathBuf::from))
        .next_back()
        .context("cargo did not name the executable")
}

/// A Python that has pycolmap: `TERRANE_PYTHON`, else `python3`; `None` when it can't import it.
pub fn python() -> Option<PathBuf> {
    let python = std::env::var_os("TERRANE_PYTHON").map_or_else(|| "python3".into(), PathBuf::from);
    let found = Command::new(&python).args(["-c", "import pycolmap, numpy"]).output().ok()?;
    found.status.success().then_some(python)
}
