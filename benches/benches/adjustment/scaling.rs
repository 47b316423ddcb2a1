//! Workers, memory, and how conjugate gradients grow with the city.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use terrane_benches::table::{Bar, Row};
use terrane_benches::{Request, process};

use crate::city;
use crate::peers;

const COMMAND: &str = "cargo bench -p terrane-benches --bench adjustment";

/// One and two workers of one thread each on ten thousand cameras; the bytes of one, two, three workers, and of two of
/// which one is killed.
pub fn workers(_: &Request) -> anyhow::Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let problem = folder.path().join("city.txt");
    city::write(&problem, 10_000, 300, 12, 1)?;
    let binary = process::terrane()?;
    let mut seconds = [f64::INFINITY; 2];
    let mut results = Vec::new();
    for (count, run) in [(1, 0), (2, 0), (1, 1), (2, 1), (3, 0)] {
        let out = folder.path().join(format!("workers-{count}-{run}.txt"));
        let flags = [format!("--workers={count}"), "--threads=1".to_owned()];
        let flags: Vec<&str> = flags.iter().map(String::as_str).collect();
        let solved = peers::terrane(&binary, &problem, &out, &flags)?;
        if count < 3 {
            seconds[count - 1] = seconds[count - 1].min(solved.seconds);
        }
        results.push(std::fs::read(out)?);
    }
    let mut rows = vec![
        Row::new(
            "two workers against one, 10,000 cameras",
            Some(seconds[0] / seconds[1]),
            "times as fast",
            Bar::AtLeast(1.8),
        )
        .note(format!("{:.1} s and {:.1} s to solve, one thread each", seconds[0], seconds[1])),
    ];
    let killed = folder.path().join("killed.txt");
    let lost = solve_and_kill(&binary, &problem, &killed, Duration::from_secs_f64(0.4 * seconds[1]))?;
    results.push(std::fs::read(killed)?);
    let equal = results.iter().filter(|result| **result == results[0]).count();
    rows.push(
        Row::new(
            "results of equal bytes: 1, 2, 1, 2, 3 workers, and 2 of which one is killed",
            Some(equal as f64),
            "of 6",
            Bar::AtLeast(6.0),
        )
        .note(format!("{lost} worker killed in the midst of the solve")),
    );
    Ok(rows.into_iter().map(|row| row.command(COMMAND)).collect())
}

/// Solves with two workers and kills one of them after a while; how many were killed.
fn solve_and_kill(binary: &Path, problem: &Path, out: &Path, after: Duration) -> anyhow::Result<u32> {
    let mut solving = Command::new(binary);
    solving.arg("adjust").arg(problem).arg("--out").arg(out).args(["--workers=2", "--threads=1"]);
    let mut solving = solving.stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
    std::thread::sleep(after);
    let mut killed = 0;
    if let Some(worker) = children(solving.id()).first() {
        // SAFETY: only sends a signal to a process that this one has started.
        killed += u32::from(unsafe { libc::kill(*worker, libc::SIGKILL) } == 0);
    }
    let status = solving.wait()?;
    anyhow::ensure!(status.success(), "the solve ended with {status} after a worker was killed");
    Ok(killed)
}

/// The processes that a process has started.
fn children(parent: u32) -> Vec<i32> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir("/proc").into_iter().flatten().flatten() {
        let Some(id) = entry.file_name().to_str().and_then(|name| name.parse::<i32>().ok()) else { continue };
        let stat = std::fs::read_to_string(entry.path().join("stat")).unwrap_or_default();
        let after_name = stat.rsplit(')').next().unwrap_or_default();
        if after_name.split_whitespace().nth(1) == Some(parent.to_string().as_str()) {
            found.push(id);
        }
    }
    found.sort_unstable();
    found
}

/// Iterations of conjugate gradients to a residual of a hundredth in the first step, for more and more clusters of the same
/// size: with the usual damping, and with hardly any.
pub fn iterations(request: &Request) -> anyhow::Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let binary = process::terrane()?;
    const DAMPINGS: [&str; 2] = ["1e-4", "1e-8"];
    let mut found = [Vec::new(), Vec::new()];
    let sizes: &[usize] = if request.quick { &[9, 90] } else { &[9, 90, 900] };
    for clusters in sizes {
        let problem = folder.path().join("city.txt");
        let cameras = 64 * clusters;
        city::write(&problem, cameras, 100, ((*clusters as f64).sqrt() as usize).max(1), 1)?;
        let out = folder.path().join("out.txt");
        for (damping, found) in DAMPINGS.iter().zip(&mut found) {
            let damping = format!("--initial-damping={damping}");
            let flags = [
                "--linear-tolerance=0.01",
                "--max-iterations=1",
                "--threads=2",
                "--solver=implicit",
                &damping,
            ];
            let solved = peers::terrane(&binary, &problem, &out, &flags)?;
            found.push(solved.told["report"]["linear_iterations"].as_f64().unwrap_or(f64::NAN));
        }
    }
    let rows = DAMPINGS.iter().zip(&found).map(|(damping, found)| {
        let growth = found.last().zip(found.first()).map(|(last, first)| last / first);
        Row::new(
            format!("growth of iterations to 1e-2 with the number of clusters, damping {damping}"),
            growth,
            "times",
            Bar::AtMost(2.0),
        )
        .note(format!("{sizes:?} clusters: {found:?} iterations"))
        .command(COMMAND)
    });
    Ok(rows.collect())
}

/// Address space that the system grants to each process, in KiB.
const LIMIT_KIB: u64 = 2 << 20;

/// A hundred thousand cameras on two workers, no process of which may have more than 2 GiB.
pub fn hundred_thousand(request: &Request) -> anyhow::Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let binary = process::terrane()?;
    let mut rows = Vec::new();
    let sizes: &[(usize, usize)] =
        if request.quick { &[(1000, 4)] } else { &[(1000, 4), (10_000, 12), (100_000, 38)] };
    for &(cameras, blocks) in sizes {
        let problem = folder.path().join("city.txt");
        let city = city::write(&problem, cameras, 240, blocks, 1)?;
        let out = folder.path().join("out.txt");
        // The limit is inherited by the workers that are started. It counts addresses that are only reserved, of which
        // the C library would take 64 MiB for each thread that allocates.
        let wrapper = folder.path().join("limited");
        let script = format!(
            "#!/bin/sh\nulimit -v {LIMIT_KIB}\nexport MALLOC_ARENA_MAX=1\nexec {} \"$@\"\n",
            binary.display()
        );
        std::fs::write(&wrapper, script)?;
        std::process::Command::new("chmod").arg("+x").arg(&wrapper).status()?;
        let flags = ["--workers=2", "--threads=1", "--memory=1700MiB", "--solver=implicit"];
        let solved = peers::terrane(&wrapper, &problem, &out, &flags)?;
        let report = &solved.told["report"];
        let note = format!(
            "{} observations; {:.0} s to solve, {} steps, {} iterations of conjugate gradients, {} clusters; solver's peak {:.0} MiB",
            city.observations,
            solved.seconds,
            report["iterations"],
            report["linear_iterations"],
            report["clusters"],
            solved.peak_mib
        );
        rows.push(
            Row::new(
                format!("city of {cameras}, 2 workers, 2 GiB each: cost / what the noise predicts"),
                Some(solved.cost / city.predicted_cost()),
                "",
                Bar::AtMost(1.01),
            )
            .note(note)
            .command(COMMAND),
        );
    }
    Ok(rows)
}
