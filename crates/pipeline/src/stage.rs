//! The thirteen stages of a run.

use serde::{Deserialize, Serialize};

/// A step of a run. The order of the variants is the order in which photographs travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// Files become the image table.
    Ingest,
    /// Pixels become keypoints and descriptors, a batch of images at a time.
    Features,
    /// Which pairs of images are worth matching.
    Pairs,
    /// Descriptors become verified pairs, a block of pairs at a time.
    Match,
    /// Verified pairs become a graph with rotations.
    ViewGraph,
    /// The graph becomes clusters of bounded size.
    Partition,
    /// A cluster becomes submaps.
    Submap,
    /// Two submaps that share images become a similarity.
    Align,
    /// Similarities and positions become one placement.
    Average,
    /// Placed submaps become components with joined tracks.
    Merge,
    /// Components are adjusted, seams first, then whole.
    Adjust,
    /// Components get their final frame.
    Georegister,
    /// Figures and files for people.
    Export,
}

impl Stage {
    /// Every stage, in order.
    pub const ALL: [Stage; 13] = [
        Stage::Ingest,
        Stage::Features,
        Stage::Pairs,
        Stage::Match,
        Stage::ViewGraph,
        Stage::Partition,
        Stage::Submap,
        Stage::Align,
        Stage::Average,
        Stage::Merge,
        Stage::Adjust,
        Stage::Georegister,
        Stage::Export,
    ];

    /// The name in paths, logs and reports.
    pub fn name(self) -> &'static str {
        match self {
            Stage::Ingest => "ingest",
            Stage::Features => "features",
            Stage::Pairs => "pairs",
            Stage::Match => "match",
            Stage::ViewGraph => "view_graph",
            Stage::Partition => "partition",
            Stage::Submap => "submap",
            Stage::Align => "align",
            Stage::Average => "average",
            Stage::Merge => "merge",
            Stage::Adjust => "adjust",
            Stage::Georegister => "georegister",
            Stage::Export => "export",
        }
    }

    /// The stage of a name.
    pub fn from_name(name: &str) -> Option<Stage> {
        Stage::ALL.into_iter().find(|stage| stage.name() == name)
    }

    /// The version of what the stage computes. Raised whenever its bytes would differ for the same inputs and options,
    /// so that no artefact of an older program is taken for today's.
    pub fn version(self) -> u32 {
        match self {
            // Ingest: XMP, masks, imports, TIFF and narrow 16-bit images. Pairs: footprints, ranks. Submap: roots of cubics
            // and undistortion in their last bits. Export: what was read beside photographs, and where every artefact of
            // the run is.
            Stage::Ingest | Stage::Pairs | Stage::Submap | Stage::Export => 2,
            // Features: limits count blobs. Match: more cells are looked into.
            Stage::Features | Stage::Match => 3,
            _ => 1,
        }
    }
}

impl std::fmt::Display for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}
