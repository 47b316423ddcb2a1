//! What stands in for the import of databases in a build that has no SQLite: refusals.

use terrane_frontend::matching::Match;
use terrane_frontend::pairs::PairSelection;
use terrane_scene::{Features, ImageId, ImagePair, ImageTable, RejectedImage};

use super::ExecutionContext;
use super::ingest::Usable;
use super::inputs::Imported;
use crate::PipelineError;

fn refused<T>() -> Result<T, PipelineError> {
    Err(PipelineError::invalid_input(
        "this terrane can't read databases: build it with `--features full`, on every machine",
    ))
}

pub(super) fn table(
    _: &ExecutionContext,
    _: Vec<Usable>,
    _: Vec<RejectedImage>,
) -> Result<(ImageTable, Imported), PipelineError> {
    refused()
}

pub(super) fn features(
    _: &ExecutionContext,
    _: &ImageTable,
    _: &Imported,
    _: &[ImageId],
) -> Result<Vec<Result<Features, String>>, PipelineError> {
    refused()
}

pub(super) fn pairs(
    _: &ExecutionContext,
    _: &ImageTable,
    _: &Imported,
) -> Result<PairSelection, PipelineError> {
    refused()
}

pub(super) fn matches(
    _: &ExecutionContext,
    _: &Imported,
    _: &[ImagePair],
) -> Result<Vec<Vec<Match>>, PipelineError> {
    refused()
}
