//! Reads damaged databases for as long as it is told to: `fuzz_database SAMPLE [EXECUTIONS] [FIRST SEED]`.
//!
//! `SAMPLE` is a small database, as `terrane export --format colmap-db` writes it. A panic names the seed; the memory that
//! the process has used at most is printed at the end.

use std::path::PathBuf;

use terrane_scene as terrane_scene_under_test;

mod mutate;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let Some(sample) = arguments.first() else {
        eprintln!("usage: fuzz_database SAMPLE [EXECUTIONS] [FIRST SEED]");
        std::process::exit(2);
    };
    let number =
        |at: usize, default: u64| arguments.get(at).and_then(|text| text.parse().ok()).unwrap_or(default);
    let (executions, first) = (number(1, 100_000), number(2, 0));
    let folder = tempfile::tempdir().expect("a folder for damaged files");
    let path: PathBuf = folder.path().join("whole.db");
    std::fs::copy(sample, &path).expect("the sample is readable");
    mutate::shrink(&path);
    let whole = std::fs::read(&path).expect("the sample is readable");
    let target = folder.path().join("damaged.db");
    let (mut read, mut refused) = (0_u64, 0_u64);
    for seed in first..first + executions {
        // Rows are damaged through SQLite, which is slow: one in sixteen.
        if seed.is_multiple_of(16) {
            std::fs::write(&target, &whole).expect("the damaged file is written");
            mutate::values(&target, seed);
        } else {
            std::fs::write(&target, mutate::bytes(&whole, seed)).expect("the damaged file is written");
        }
        match std::panic::catch_unwind(|| mutate::read_all(&target).is_ok()) {
            Ok(true) => read += 1,
            Ok(false) => refused += 1,
            Err(_) => {
                eprintln!("seed {seed} panicked");
                std::process::exit(1);
            }
        }
    }
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find(|line| line.starts_with("VmHWM")).unwrap_or("VmHWM: unknown");
    println!(
        "{executions} executions on {} bytes: {read} read, {refused} refused, no panic; {peak}",
        whole.len()
    );
}
