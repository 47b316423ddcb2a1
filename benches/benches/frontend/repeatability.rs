//! Repeatability and matching score under known homographies, beside COLMAP's SIFT on the same pictures.
//!
//! The example `repeatability` of `terrane-frontend` renders the pictures, extracts as many blobs of each as COLMAP kept, and
//! scores both sides by the same matcher.

use std::path::{Path, PathBuf};
use std::process::Command;

use terrane_benches::table::{Bar, Row};
use terrane_benches::{Request, process, root};

use crate::sets::{SETS, Set};

/// Photographs of each set, evenly taken from it. Each gives sixteen pictures, which take COLMAP a minute.
const PER_SET: usize = 1;

pub fn rows(request: &Request) -> anyhow::Result<Vec<Row>> {
    let Some(python) = process::python() else {
        let row = Row::new("repeatability", None, "", Bar::None);
        return Ok(vec![row.note("no Python with pycolmap")]);
    };
    let sets = SETS.iter().filter(|set| request.wants_set(set.name, set.quick));
    let photographs: Vec<PathBuf> =
        sets.map(chosen).collect::<anyhow::Result<Vec<_>>>()?.into_iter().flatten().collect();
    let folder = tempfile::tempdir()?;
    let pictures = folder.path().join("pictures");
    example(&["--pictures".as_ref(), &pictures], &photographs)?;
    let mut rows = Vec::new();
    for octave in ["0", "-1"] {
        let theirs = folder.path().join(format!("peer{octave}"));
        let mut peer = Command::new(&python);
        peer.arg(root().join("benches/peers/sift_colmap.py")).arg(&pictures).arg(&theirs);
        process::run(peer.args(["--first-octave", octave, "--threads", "2"]))?;
        let flags: [&Path; 8] = [
            "--pictures".as_ref(),
            &pictures,
            "--peer".as_ref(),
            &theirs,
            "--first-octave".as_ref(),
            octave.as_ref(),
            "--spread".as_ref(),
            "0".as_ref(),
        ];
        let table = example(&flags, &photographs)?;
        rows.extend(table.lines().filter_map(|line| compared(octave, line)).flatten());
    }
    Ok(rows)
}

/// Some photographs of a set.
fn chosen(set: &Set) -> anyhow::Result<Vec<PathBuf>> {
    let all = set.photographs(usize::MAX)?;
    let places = (0..PER_SET).map(|k| (2 * k + 1) * all.len() / (2 * PER_SET));
    Ok(places.map(|at| set.path().join(&all[at].name)).collect())
}

fn example(flags: &[&Path], photographs: &[PathBuf]) -> anyhow::Result<String> {
    let mut command = Command::new(env!("CARGO"));
    command.args(["run", "--release", "--package", "terrane-frontend", "--example", "repeatability", "--"]);
    command.args(flags).args(photographs).current_dir(root());
    Ok(process::run(&mut command)?.1)
}

/// The rows of a line of the example's table: condition, features, repeatability, matching score and more.
fn compared(octave: &str, line: &str) -> Option<[Row; 2]> {
    let cells: Vec<&str> = line.split('|').map(str::trim).collect();
    let condition = cells.get(1)?.trim_end_matches(" (worse)");
    let row = |what: &str, cell: &str| {
        let (ours, theirs) = cell.split_once(" / ")?;
        let (ours, theirs): (f64, f64) = (ours.parse().ok()?, theirs.parse().ok()?);
        let figure = format!("{what}, octave {octave}, {condition}: over COLMAP's");
        Some(
            Row::new(figure, Some(ours - theirs), "points", Bar::AtLeast(0.0))
                .note(format!("{ours} % and {theirs} %")),
        )
    };
    Some([row("repeatability", cells.get(3)?)?, row("matching score", cells.get(4)?)?])
}
