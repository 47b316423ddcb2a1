//! Real problems and cities, beside Ceres.

use std::path::{Path, PathBuf};

use terrane_benches::table::{Bar, Row};
use terrane_benches::{Request, process};

use crate::city::City;
use crate::peers::{self, Solved};

const COMMAND: &str = "cargo bench -p terrane-benches --bench adjustment";

/// Threads of both.
const THREADS: usize = 2;

/// The better of Ceres's solvers, and how often each ran.
fn best_of_ceres(problem: &Path, solvers: &[&str], runs: usize) -> anyhow::Result<Option<(String, Solved)>> {
    let mut best: Option<(String, Solved)> = None;
    for solver in solvers {
        for _ in 0..runs {
            let Some(solved) = peers::ceres(problem, solver, THREADS)? else { return Ok(None) };
            if best.as_ref().is_none_or(|(_, old)| solved.seconds < old.seconds) {
                best = Some(((*solver).to_owned(), solved));
            }
        }
    }
    Ok(best)
}

/// Rows of one problem; `memory` says whether the bar on memory holds for it.
fn compare(
    name: &str,
    problem: &Path,
    folder: &Path,
    (runs, solvers, memory): (usize, &[&str], bool),
) -> anyhow::Result<Vec<Row>> {
    let binary = process::terrane()?;
    let out = folder.join("solved.txt");
    let threads = format!("--threads={THREADS}");
    let mut ours: Option<Solved> = None;
    let mut ceres: Option<(String, Solved)> = None;
    for _ in 0..runs {
        // One after the other, again and again: the machine's mood falls on both.
        let solved = peers::terrane(&binary, problem, &out, &[&threads])?;
        if ours.as_ref().is_none_or(|old| solved.seconds < old.seconds) {
            ours = Some(solved);
        }
        if let Some(found) = best_of_ceres(problem, solvers, 1)?
            && ceres.as_ref().is_none_or(|(_, old)| found.1.seconds < old.seconds)
        {
            ceres = Some(found);
        }
    }
    let Some(ours) = ours else { return Ok(Vec::new()) };
    let told = &ours.told["report"];
    let ours_text = format!(
        "{:.2} s, {:.0} MiB, {} steps, {} products",
        ours.seconds, ours.peak_mib, told["iterations"], told["linear_iterations"]
    );
    let Some((solver, peer)) = ceres else {
        return Ok(vec![
            Row::new(format!("{name}: cost"), Some(ours.cost), "px²", Bar::None)
                .note(ours_text)
                .command(COMMAND),
        ]);
    };
    let peer_text =
        format!("Ceres {solver} {:.2} s, {:.0} MiB, cost {:.4}", peer.seconds, peer.peak_mib, peer.cost);
    let mut rows = vec![
        Row::new(format!("{name}: cost, ours / Ceres"), Some(ours.cost / peer.cost), "", Bar::AtMost(1.0001))
            .note(format!("ours {:.4}", ours.cost)),
        Row::new(
            format!("{name}: time, ours / Ceres"),
            Some(ours.seconds / peer.seconds),
            "",
            Bar::AtMost(1.0 / 3.0),
        )
        .note(format!("{ours_text}; {peer_text}")),
    ];
    let bar = if memory { Bar::AtMost(0.5) } else { Bar::None };
    rows.push(Row::new(
        format!("{name}: peak memory, ours / Ceres"),
        Some(ours.peak_mib / peer.peak_mib),
        "",
        bar,
    ));
    Ok(rows.into_iter().map(|row| row.command(COMMAND)).collect())
}

const BOTH: &[&str] = &["sparse_schur", "iterative_schur"];

/// The real problems.
pub fn real(_: &Request) -> anyhow::Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let mut rows = Vec::new();
    for name in ["problem-21-11315-pre", "problem-49-7776-pre"] {
        if let Some(problem) = peers::real(name, folder.path())? {
            rows.extend(compare(name, &problem, folder.path(), (3, BOTH, false))?);
        }
    }
    Ok(rows)
}

/// Cities that fit into minutes.
pub fn cities(_: &Request) -> anyhow::Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let mut rows = Vec::new();
    for (cameras, blocks, runs) in [(400, 3, 3), (2000, 6, 1)] {
        if let Some(problem) = peers::city(cameras, blocks, folder.path())? {
            rows.extend(compare(&format!("city-{cameras}"), &problem, folder.path(), (runs, BOTH, true))?);
        }
    }
    Ok(rows)
}

/// A city of ten thousand cameras; Ceres takes a quarter of an hour.
pub fn large_city(request: &Request) -> anyhow::Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let Some(problem) = peers::city(10_000, 12, folder.path())? else { return Ok(Vec::new()) };
    let solvers: &[&str] = if request.quick { &[] } else { &["iterative_schur"] };
    let mut rows = compare("city-10000", &problem, folder.path(), (1, solvers, false))?;
    let solved =
        peers::terrane(&process::terrane()?, &problem, &folder.path().join("again.txt"), &["--threads=2"])?;
    let city = counted(&problem)?;
    rows.push(
        Row::new(
            "city-10000: cost / what the noise predicts",
            Some(solved.cost / city.predicted_cost()),
            "",
            Bar::AtMost(1.01),
        )
        .command(COMMAND),
    );
    Ok(rows)
}

/// The counts in the header of a BAL file.
fn counted(problem: &PathBuf) -> anyhow::Result<City> {
    use std::io::BufRead;
    let mut line = String::new();
    std::io::BufReader::new(std::fs::File::open(problem)?).read_line(&mut line)?;
    let counts: Vec<usize> = line.split_whitespace().filter_map(|word| word.parse().ok()).collect();
    match counts[..] {
        [cameras, points, observations] => Ok(City { cameras, points, observations }),
        _ => anyhow::bail!("{} has no header", problem.display()),
    }
}
