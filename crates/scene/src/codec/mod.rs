//! Artefacts as bytes: columns in checksummed sections that can be read one by one.

mod container;
mod features;
mod matches;
mod pairs;
mod reconstruction;
mod submap;

pub use container::{Archive, ArchiveWriter, Kind, Packing, Source, Tag};
pub use features::{FeatureBatchReader, FeatureBatchWriter, FeatureOutcome};
pub use matches::{MatchBlock, encode_match_block, read_matches, read_pair_summaries};
pub use pairs::{decode_pair_blocks, encode_pair_blocks};
pub use reconstruction::{
    decode_reconstruction, encode_reconstruction, read_reconstruction, write_reconstruction,
};
pub use submap::{decode_submap, encode_submap, read_submap_report};

#[cfg(test)]
mod tests;
