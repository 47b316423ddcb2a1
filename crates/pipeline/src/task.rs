//! Tasks: what a worker is given and what it gives back.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use terrane_scene::{ClusterId, ImageId};

use crate::{ArtefactKey, Stage};

/// One piece of work: reads the artefacts `inputs`, leaves the artefact `key`.
///
/// Plain data; on the wire it travels as JSON bytes that nobody but [`crate::execute`] looks into.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Task {
    /// The artefact that it leaves; also the task's identity.
    pub key: ArtefactKey,
    /// The stage that it belongs to.
    pub stage: Stage,
    /// What it works on, in words, for logs and progress.
    pub item: String,
    /// Artefacts that it reads: a worker that has them at hand is the better one.
    pub inputs: Vec<ArtefactKey>,
    /// Memory that it should need at most, beyond that of an idle worker.
    pub predicted_peak_bytes: u64,
    /// Time that it should take on one core.
    pub predicted_seconds: f64,
    /// What exactly is to be done.
    pub spec: TaskSpec,
}

/// What exactly a task does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
// Tagged from outside: a tag within would make serde buffer the fields, and maps with numbers for keys don't survive that.
#[serde(rename_all = "snake_case")]
pub enum TaskSpec {
    /// Read every file of the run's folder or list.
    Ingest {
        /// Digest of names, sizes and times of the files: they must not have changed.
        listing: String,
    },
    /// Compute the features of consecutive images.
    Features {
        /// The ingest artefact.
        table: ArtefactKey,
        /// The first image.
        first: ImageId,
        /// How many.
        count: u32,
    },
    /// Choose pairs.
    Pairs {
        /// The ingest artefact.
        table: ArtefactKey,
        /// Features of every image.
        features: FeatureSet,
        /// Batches whose features could not be computed: first image, number of images, reason.
        lost: Vec<(ImageId, u32, String)>,
    },
    /// Match and verify a block of pairs.
    Match {
        /// The ingest artefact.
        table: ArtefactKey,
        /// The pairs artefact.
        pairs: ArtefactKey,
        /// Which block of it.
        block: u32,
        /// Features of the block's images.
        features: FeatureSet,
    },
    /// Build the view graph.
    ViewGraph {
        /// How many images the run has.
        num_images: u32,
        /// Every match artefact.
        matches: Vec<ArtefactKey>,
    },
    /// Cut the view graph.
    Partition {
        /// The view graph artefact.
        view_graph: ArtefactKey,
    },
    /// Map a cluster.
    Submap {
        /// The ingest artefact.
        table: ArtefactKey,
        /// The view graph artefact.
        view_graph: ArtefactKey,
        /// The partition artefact.
        partition: ArtefactKey,
        /// Which cluster.
        cluster: ClusterId,
        /// Features of its images.
        features: FeatureSet,
        /// Match artefacts that hold its pairs.
        matches: Vec<ArtefactKey>,
    },
    /// Align the submaps of two clusters.
    Align {
        /// One submap artefact.
        a: ArtefactKey,
        /// The other.
        b: ArtefactKey,
    },
    /// Place submaps and average cameras.
    Average {
        /// The ingest artefact.
        table: ArtefactKey,
        /// Submap artefacts, by cluster.
        submaps: Vec<ArtefactKey>,
        /// Align artefacts, with the places of their clusters in `submaps`.
        seams: Vec<(u32, u32, ArtefactKey)>,
    },
    /// Merge the submaps of a component.
    Merge {
        /// The average artefact.
        average: ArtefactKey,
        /// Submap artefacts, as for the average.
        submaps: Vec<ArtefactKey>,
        /// Which component.
        component: u32,
    },
    /// Adjust a component.
    Adjust {
        /// The ingest artefact.
        table: ArtefactKey,
        /// The average artefact.
        average: ArtefactKey,
        /// The merge artefact.
        merge: ArtefactKey,
        /// Which component.
        component: u32,
    },
    /// Bring a component into its final frame.
    Georegister {
        /// The ingest artefact.
        table: ArtefactKey,
        /// The adjust artefact.
        adjust: ArtefactKey,
        /// Which component.
        component: u32,
    },
    /// Gather the figures of the run.
    Export {
        /// Every artefact that the figures come from.
        run: Box<FinishedRun>,
    },
}

/// Where the features of images are.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FeatureSet {
    /// Images of a batch: image `i` is in batch `i / images_per_batch`.
    pub images_per_batch: u32,
    /// Feature artefacts by batch; a batch whose features could not be computed is absent.
    pub batches: BTreeMap<u32, ArtefactKey>,
}

impl FeatureSet {
    /// The batch artefact of an image and the image's place in it.
    pub fn locate(&self, image: ImageId) -> Option<(ArtefactKey, usize)> {
        let per_batch = self.images_per_batch.max(1);
        let key = self.batches.get(&(image.0 / per_batch))?;
        Some((*key, (image.0 % per_batch) as usize))
    }

    /// The part of the set that these images need.
    pub fn only(&self, images: impl IntoIterator<Item = ImageId>) -> FeatureSet {
        let per_batch = self.images_per_batch.max(1);
        let mut part = FeatureSet { images_per_batch: per_batch, batches: BTreeMap::new() };
        for image in images {
            let batch = image.0 / per_batch;
            if let Some(key) = self.batches.get(&batch) {
                part.batches.insert(batch, *key);
            }
        }
        part
    }
}

/// Every artefact of a run that its report and its files come from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FinishedRun {
    /// The image table.
    pub table: ArtefactKey,
    /// Features of every image.
    pub features: FeatureSet,
    /// The pairs.
    pub pairs: ArtefactKey,
    /// Verified pairs.
    pub matches: Vec<ArtefactKey>,
    /// The view graph.
    pub view_graph: ArtefactKey,
    /// The partition.
    pub partition: ArtefactKey,
    /// Submaps with their clusters.
    pub submaps: Vec<(ClusterId, ArtefactKey)>,
    /// Clusters whose task was set aside, with the reason.
    pub lost_clusters: Vec<(ClusterId, String)>,
    /// The placement; `None` when nothing could be placed.
    pub average: Option<ArtefactKey>,
    /// Merged, adjusted and final components, largest first.
    pub components: Vec<FinishedComponent>,
}

/// The artefacts of one component.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FinishedComponent {
    /// Merged.
    pub merge: ArtefactKey,
    /// Adjusted.
    pub adjust: ArtefactKey,
    /// Final.
    pub georegister: ArtefactKey,
}

/// What a task did, without clocks: the caller adds seconds and peak memory.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskReport {
    /// Size of the artefact in bytes.
    pub bytes_written: u64,
    /// The artefact was there already: another worker was quicker.
    pub existed: bool,
    /// Figures in the stage's words, as `images`, `features`, `pairs`.
    pub counts: BTreeMap<String, u64>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::KeyBuilder;

    #[test]
    fn tasks_survive_the_wire() {
        let key = |number| KeyBuilder::new(Stage::Features).number(number).finish();
        let features = FeatureSet { images_per_batch: 8, batches: [(0, key(1)), (1, key(2))].into() };
        let spec = TaskSpec::Pairs { table: key(0), features, lost: vec![(ImageId(3), 8, "cut off".into())] };
        let task = Task {
            key: key(3),
            stage: Stage::Pairs,
            item: "11 images".into(),
            inputs: vec![key(0)],
            predicted_peak_bytes: 1,
            predicted_seconds: 0.5,
            spec,
        };
        let json = serde_json::to_vec(&task).unwrap();
        assert_eq!(serde_json::from_slice::<Task>(&json).unwrap(), task);
    }
}
