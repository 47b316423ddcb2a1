//! The folder that a user gets: models, points, camera positions, report. The layout is in `docs/report.md`.

#[cfg(feature = "sqlite")]
mod database;
mod model;
mod report;

use std::path::{Path, PathBuf};

#[cfg(feature = "sqlite")]
pub use database::{DatabaseFigures, write_database};
pub use report::{RunCosts, StageCost};

use crate::execute::read;
use crate::{KnownArtefacts, PipelineError, RunConfig, RunFigures, Store};

/// Writes the result of a finished run: `sparse/`, `points.ply`, `cameras.geojson`, `report.json`, `run.json`.
///
/// Each of them is made beside its place and then renamed into it, `report.json` last, so that none is ever half written;
/// other files in `out` stay. What an earlier run left is replaced. Nothing but `report.json` depends on `costs`.
///
/// # Errors
/// Storage errors that name the folder; a corrupt artefact, which is to be discarded and planned again; invalid input
/// when the run is not finished.
pub fn write(
    config: &RunConfig,
    store: &Store,
    known: &mut KnownArtefacts,
    out: &Path,
    costs: &RunCosts,
) -> Result<RunFigures, PipelineError> {
    let (export, run) = crate::plan::finished(config, store, known)?.ok_or_else(|| {
        PipelineError::invalid_input("the run is not finished: there is nothing to write yet")
    })?;
    let report = read::record(store, &export, terrane_scene::codec::Kind::Record, read::REPORT)?;
    check_writable(out)?;
    let staging = Staging::new(out)?;
    model::write(store, &run, &report, &staging.path)?;
    report::write_run(config, export, &staging.path)?;
    report::write_report(&report, costs, &staging.path)?;
    for name in ["sparse", "points.ply", "cameras.geojson", "run.json", "report.json"] {
        staging.publish(name, out)?;
    }
    read::figures(store, &export)
}

/// Makes `out` and finds out whether it can be written: worth calling before hours of work.
///
/// # Errors
/// When the folder can't be made or written; names it and the remedy.
pub fn check_writable(out: &Path) -> Result<(), PipelineError> {
    let failed = |error: &std::io::Error| {
        PipelineError::io(&format!("output folder {} can't be written", out.display()), error)
    };
    std::fs::create_dir_all(out).map_err(|error| failed(&error))?;
    tempfile::Builder::new().prefix(".terrane-").tempfile_in(out).map_err(|error| failed(&error))?;
    Ok(())
}

/// A folder within the output folder, so that renaming stays within one file system.
struct Staging {
    path: PathBuf,
    _folder: tempfile::TempDir,
}

impl Staging {
    fn new(out: &Path) -> Result<Self, PipelineError> {
        let folder = tempfile::Builder::new().prefix(".terrane-").tempdir_in(out).map_err(|error| {
            PipelineError::io(&format!("output folder {} can't be written", out.display()), &error)
        })?;
        Ok(Self { path: folder.path().to_path_buf(), _folder: folder })
    }

    /// Puts a file or folder in its place; the old one goes with the staging folder.
    fn publish(&self, name: &str, out: &Path) -> Result<(), PipelineError> {
        let target = out.join(name);
        let failed = |error: &std::io::Error| {
            PipelineError::io(&format!("can't put {} in place", target.display()), error)
        };
        match std::fs::rename(&target, self.path.join(format!("old-{name}"))) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(failed(&error)),
            _ => {}
        }
        std::fs::rename(self.path.join(name), &target).map_err(|error| failed(&error))
    }
}
