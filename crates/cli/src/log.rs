//! Log lines of the libraries: which ones, and where they go.
//!
//! `TERRANE_LOG` says which, as in `debug` or `info,terrane_cluster=debug`; without it those of level `info` and above.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

use crate::exit::Failure;

/// The environment variable that chooses log lines.
const VARIABLE: &str = "TERRANE_LOG";

/// Log lines go to standard error.
pub fn to_stderr() {
    init(std::io::stderr);
}

/// Log lines go to a file beside the workers' ones, so that they don't disturb the progress.
///
/// # Errors
/// When the file can't be written.
pub fn to_file(hidden: &Path) -> Result<(), Failure> {
    let folder = hidden.join("logs");
    let path = folder.join("coordinator.log");
    let failed = |error: std::io::Error| {
        Failure::system(format!("the log {} can't be written: {error}", path.display()))
    };
    std::fs::create_dir_all(&folder).map_err(failed)?;
    init(Arc::new(File::options().create(true).append(true).open(&path).map_err(failed)?));
    Ok(())
}

fn init<W: for<'a> MakeWriter<'a> + Send + Sync + 'static>(writer: W) {
    let given = std::env::var(VARIABLE).ok();
    let (targets, refused) = targets(given.as_deref());
    let lines = tracing_subscriber::fmt::layer().with_writer(writer).with_ansi(false);
    // Fails only when a log is set up already, and then that one is as good.
    let _ = tracing_subscriber::registry().with(lines).with(targets).try_init();
    if let Some(reason) = refused {
        tracing::warn!("{VARIABLE} is not understood and not used: {reason}");
    }
}

/// What a value of the variable chooses, and why it can't be used if it can't.
fn targets(given: Option<&str>) -> (Targets, Option<String>) {
    let usual = Targets::new().with_default(LevelFilter::INFO);
    match given.map(str::parse::<Targets>) {
        None => (usual, None),
        Some(Ok(targets)) => (targets, None),
        Some(Err(error)) => (usual, Some(error.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tracing::Level;

    #[test]
    fn the_variable_chooses_by_level_and_by_crate() {
        let chosen = |given| targets(given).0;
        assert!(chosen(None).would_enable("terrane_cluster", &Level::INFO));
        assert!(!chosen(None).would_enable("terrane_cluster", &Level::DEBUG));
        let some = chosen(Some("info,terrane_cluster=debug"));
        assert!(some.would_enable("terrane_cluster", &Level::DEBUG));
        assert!(!some.would_enable("terrane_pipeline", &Level::DEBUG));
        assert!(some.would_enable("terrane_pipeline", &Level::INFO));
    }

    #[test]
    fn a_value_that_makes_no_sense_is_told_and_not_used() {
        let (usual, reason) = targets(Some("terrane=loudest"));
        assert!(reason.is_some());
        assert!(usual.would_enable("terrane", &Level::INFO));
    }
}
