//! One problem through terrane and through Ceres.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::Context;
use serde_json::Value;
use terrane_benches::{peer, process};

/// What a solver made of a problem.
#[derive(Clone, Debug)]
pub struct Solved {
    /// Half the sum of squared residuals over all observations, square pixels.
    pub cost: f64,
    /// Seconds to solve, without reading and writing.
    pub seconds: f64,
    /// Peak memory of the process in MiB.
    pub peak_mib: f64,
    /// What terrane printed; null for others.
    pub told: Value,
}

/// Solves by `terrane adjust`; the result goes to `out`.
pub fn terrane(binary: &Path, problem: &Path, out: &Path, flags: &[&str]) -> anyhow::Result<Solved> {
    let mut command = Command::new(binary);
    command.arg("adjust").arg(problem).arg("--out").arg(out).args(flags).arg("--json");
    let output = command.output().with_context(|| format!("{} can't be started", binary.display()))?;
    let text = String::from_utf8_lossy(&output.stdout);
    let told = text
        .lines()
        .filter_map(|line| serde_json::from_str::<Value>(line).ok())
        .find(|line| line["event"] == "adjust")
        .with_context(|| format!("{command:?} told nothing:\n{}", String::from_utf8_lossy(&output.stderr)))?;
    let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
    anyhow::ensure!(
        told["after"]["not_projected"] == 0,
        "{} observations of {} can't be projected after the solve: the cost would leave them out",
        told["after"]["not_projected"],
        problem.display()
    );
    Ok(Solved {
        cost: number(&told["after"]["squared_cost"]),
        seconds: number(&told["solve_seconds"]),
        peak_mib: number(&told["peak_bytes"]) / 1_048_576.0,
        told,
    })
}

/// Solves by Ceres through the peers' script; `None` without a Python that has pycolmap.
pub fn ceres(problem: &Path, solver: &str, threads: usize) -> anyhow::Result<Option<Solved>> {
    let Some(python) = process::python() else { return Ok(None) };
    let mut command = Command::new(python);
    command.arg(peer().join("ba_ceres.py")).arg(problem);
    command.args(["--solver", solver, "--threads", &threads.to_string()]);
    let (_, text) = process::run(&mut command)?;
    let line = text.lines().rfind(|line| line.starts_with('{')).context("ba_ceres.py printed nothing")?;
    let told: Value = serde_json::from_str(line)?;
    let number = |key: &str| told[key].as_f64().unwrap_or(f64::NAN);
    Ok(Some(Solved {
        cost: number("cost_after"),
        seconds: number("wall_s"),
        peak_mib: number("rss_mib"),
        told: Value::Null,
    }))
}

/// A problem of the shared data, unpacked into a folder.
pub fn real(name: &str, folder: &Path) -> anyhow::Result<Option<PathBuf>> {
    let packed = terrane_benches::data().join("bal").join(format!("{name}.txt.bz2"));
    let Some(python) = process::python() else { return Ok(None) };
    let path = folder.join(format!("{name}.txt"));
    let script = "import bz2,sys; open(sys.argv[2],'wb').write(bz2.open(sys.argv[1]).read())";
    process::run(Command::new(python).args(["-c", script]).arg(packed).arg(&path))?;
    Ok(Some(path))
}

/// A city by the peers' script.
pub fn city(cameras: usize, blocks: usize, folder: &Path) -> anyhow::Result<Option<PathBuf>> {
    let Some(python) = process::python() else { return Ok(None) };
    let path = folder.join(format!("city-{cameras}.txt"));
    let mut command = Command::new(python);
    command.arg(peer().join("make_bal.py")).arg(&path);
    command.args(["--cameras", &cameras.to_string(), "--blocks", &blocks.to_string()]);
    process::run(&mut command)?;
    Ok(Some(path))
}
