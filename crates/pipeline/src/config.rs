//! Everything that decides a run, in one value.

use std::path::PathBuf;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use terrane_frontend::cameras::GivenCamera;
use terrane_frontend::corners::CornerOptions;
use terrane_frontend::features::{FeatureMethod, FeatureOptions};
use terrane_frontend::image::DecodeOptions;
use terrane_frontend::matching::MatchOptions;
use terrane_frontend::pairs::{BlockOptions, PairOptions};
use terrane_frontend::retrieval::{RetrievalOptions, VocabularyOptions};
use terrane_frontend::sift::SiftOptions;
use terrane_frontend::surf::SurfOptions;
use terrane_frontend::verification::VerificationOptions;
use terrane_fusion::adjust::AdjustOptions;
use terrane_fusion::align::AlignOptions;
use terrane_fusion::average::{CameraAverageOptions, PlaceOptions};
use terrane_fusion::georegister::GeoOptions;
use terrane_fusion::merge::MergeOptions;
use terrane_geometry::{Camera, CameraModel, Seed};
use terrane_mapping::MappingOptions;
use terrane_viewgraph::{PartitionOptions, ViewGraphOptions};

use crate::PipelineError;

/// A run: its photographs, its seed, and the options of every stage.
///
/// Only what a stage reads goes into the keys of its artefacts, so that a change of one option recomputes what depends on
/// it and nothing else. [`WorkerHints`] never goes into a key.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RunConfig {
    /// Folder of the photographs, as every worker sees it.
    pub photos: PathBuf,
    /// Which photographs of the folder, by path relative to it with `/` between parts; `None`: all, recursively.
    pub list: Option<Vec<String>>,
    /// Seed of every random stream. Default 0.
    pub seed: u64,
    /// Intrinsics of all photographs; they are then trusted and stay as they are. Default none.
    pub camera: Option<CameraOverride>,
    /// Folder of masks, as every worker sees it: black keeps features out. The mask of `a/b.jpg` is `a/b.jpg.png`, or
    /// `a/b.png` or `b.png` where that is of no other photograph; a photograph without one is used whole. Default none.
    pub masks: Option<PathBuf>,
    /// COLMAP database that cameras, features and matches come from, as every worker sees it; `None`: terrane
    /// computes them. Default none.
    pub import: Option<PathBuf>,
    /// What the planner assumes about workers, to predict memory and seconds.
    pub workers: WorkerHints,
    /// Features.
    pub features: FeatureStageOptions,
    /// Pair selection.
    pub pairs: PairStageOptions,
    /// Matching and verification.
    pub matching: MatchStageOptions,
    /// View graph.
    pub view_graph: ViewGraphOptions,
    /// Partition; `max_cluster_size` is the command line's `--cluster-size`.
    pub partition: PartitionOptions,
    /// Submaps.
    pub mapping: MappingOptions,
    /// Seams.
    pub align: AlignOptions,
    /// Placement of submaps.
    pub place: PlaceOptions,
    /// Averaging of cameras.
    pub camera_average: CameraAverageOptions,
    /// Merging.
    pub merge: MergeOptions,
    /// Adjustment.
    pub adjust: AdjustOptions,
    /// Geo-registration of the adjusted result.
    pub georegister: GeoOptions,
}

/// What the planner assumes about workers. Does not bear on any result.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct WorkerHints {
    /// Threads of a worker. Range: at least 1. Default 1.
    pub threads: u32,
    /// Memory of a worker in bytes. Range: at least 256 MiB. Default 2 GiB.
    pub memory_bytes: u64,
}

impl Default for WorkerHints {
    fn default() -> Self {
        Self { threads: 1, memory_bytes: 2 << 30 }
    }
}

/// How features are computed and batched.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FeatureStageOptions {
    /// Images of a task. Range: 1 to 1,024. Default 8: some seconds of work, and little is lost with a worker.
    pub images_per_task: u32,
    /// Decoding.
    pub decode: DecodeOptions,
    /// Which features; the command line's `--features`.
    pub method: FeatureMethod,
    /// Of SIFT.
    pub sift: SiftOptions,
    /// Of Harris, FAST and ORB.
    pub corners: CornerOptions,
    /// Of SURF.
    pub surf: SurfOptions,
}

impl Default for FeatureStageOptions {
    fn default() -> Self {
        let FeatureOptions { method, sift, corners, surf } = FeatureOptions::default();
        Self { images_per_task: 8, decode: DecodeOptions::default(), method, sift, corners, surf }
    }
}

impl FeatureStageOptions {
    /// Detection and description: what the method reads, and defaults elsewhere, so that options of other methods do not
    /// bear on keys.
    pub fn extraction(&self) -> FeatureOptions {
        let Self { method, sift, corners, surf, .. } = self.clone();
        FeatureOptions { method, sift, corners, surf }.that_matter()
    }
}

/// How pairs are chosen and blocked.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PairStageOptions {
    /// Which pairs.
    pub select: PairOptions,
    /// Retrieval's vocabulary.
    pub vocabulary: VocabularyOptions,
    /// How retrieval finds similar images.
    pub retrieval: RetrievalOptions,
    /// How large a match task is.
    pub blocks: BlockOptions,
}

/// How pairs are matched and verified.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MatchStageOptions {
    /// Matching of descriptors.
    pub matching: MatchOptions,
    /// Two-view geometry.
    pub verification: VerificationOptions,
}

/// Intrinsics given by the user: `MODEL:parameters`, as `PINHOLE:2759.48,2764.16,1520.69,1006.81`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraOverride {
    /// The model.
    pub model: CameraModel,
    /// Its parameters in COLMAP's order, in pixels where they have a unit.
    pub params: Vec<f64>,
}

impl CameraOverride {
    /// The camera of an image of this size.
    ///
    /// # Errors
    /// When the number of parameters does not fit the model, a focal length is not positive, or the model can't be
    /// reconstructed.
    pub fn camera(&self, width_px: u32, height_px: u32) -> Result<Camera, PipelineError> {
        Ok(self.given()?.camera(width_px, height_px))
    }

    /// The same as the front end takes it.
    pub(crate) fn given(&self) -> Result<GivenCamera, PipelineError> {
        GivenCamera::new(self.model, self.params.clone())
            .map_err(|error| PipelineError::invalid_input(error.to_string()))
    }
}

impl FromStr for CameraOverride {
    type Err = PipelineError;

    fn from_str(text: &str) -> Result<Self, PipelineError> {
        let (name, params) = text.split_once(':').ok_or_else(|| {
            PipelineError::invalid_input(format!("camera `{text}` is not of the form MODEL:p1,p2,…"))
        })?;
        let model = CameraModel::from_name(name).ok_or_else(|| {
            PipelineError::invalid_input(format!(
                "camera model `{name}` is unknown: use one of {}",
                CameraModel::names()
            ))
        })?;
        let params = params
            .split(',')
            .map(|number| number.trim().parse::<f64>())
            .collect::<Result<Vec<_>, _>>()
            .map_err(|error| PipelineError::invalid_input(format!("camera `{text}`: {error}")))?;
        let camera = Self { model, params };
        camera.camera(1, 1)?;
        Ok(camera)
    }
}

impl RunConfig {
    /// The seed of a stage's random streams.
    pub fn stage_seed(&self, stage: crate::Stage) -> Seed {
        Seed(self.seed).derive(stage.name())
    }

    /// Every problem of the options at once, each with its path; empty when they can be used.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let mut check = |holds: bool, path: &str, rule: &str| {
            if !holds {
                problems.push(format!("{path}: must be {rule}"));
            }
        };
        check(!self.photos.as_os_str().is_empty(), "photos", "the folder of the photographs");
        check(self.masks.is_none() || self.import.is_none(), "masks", "left out when features are imported");
        check(
            self.import.is_none() || cfg!(feature = "sqlite"),
            "import",
            "left out: this build can't read databases; build terrane with `--features full`",
        );
        check(self.workers.threads >= 1, "workers.threads", "at least 1");
        check(self.workers.memory_bytes >= 256 << 20, "workers.memory_bytes", "at least 256 MiB");
        check((1..=1024).contains(&self.features.images_per_task), "features.images_per_task", "1 to 1,024");
        let retrieval = &self.pairs.retrieval;
        check((1..=512).contains(&retrieval.dimensions), "pairs.retrieval.dimensions", "1 to 512");
        check(retrieval.training_images >= 2, "pairs.retrieval.training_images", "at least 2");
        check(retrieval.local_features >= 8, "pairs.retrieval.local_features", "at least 8");
        check((0.0..=1.0).contains(&self.pairs.select.min_overlap), "pairs.select.min_overlap", "0 to 1");
        check(self.partition.max_cluster_size >= 8, "partition.max_cluster_size", "at least 8");
        if let Some(Err(error)) = self.camera.as_ref().map(|camera| camera.camera(1, 1)) {
            problems.push(format!("camera: {error}"));
        }
        if let Err(rule) = self.pairs.vocabulary.given() {
            problems.push(format!("pairs.vocabulary.words: {rule}"));
        }
        problems.extend(self.features.extraction().validate().err().map(|error| format!("features.{error}")));
        problems.extend(self.mapping.validate("mapping"));
        problems
    }

    /// Names the run: equal for equal photographs' folder, list, seed and options, whatever the workers.
    ///
    /// # Errors
    /// Never for a config that can be written as JSON.
    pub fn canonical_hash(&self) -> Result<String, PipelineError> {
        let mut config = self.clone();
        config.workers = WorkerHints::default();
        let json = serde_json::to_vec(&config).map_err(|error| PipelineError::bug(error.to_string()))?;
        Ok(crate::key::hex(blake3::hash(&json).as_bytes()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_is_read_as_colmap_writes_it() {
        let camera: CameraOverride = "PINHOLE:2759.48,2764.16,1520.69,1006.81".parse().unwrap();
        assert_eq!(camera.camera(3072, 2048).unwrap().focal_px().y, 2764.16);
        for bad in ["PINHOLE", "PINHOLE:1,2,3", "FISH:1,2,3,4", "PINHOLE:a,b,c,d", "PINHOLE:-1,1,0,0"] {
            assert!(bad.parse::<CameraOverride>().unwrap_err().is_invalid_input(), "{bad}");
        }
    }

    #[test]
    fn only_options_of_the_chosen_features_matter() {
        let mut config = RunConfig { photos: "p".into(), ..Default::default() };
        let sift = config.features.extraction();
        config.features.surf.hessian_threshold = -1.0;
        config.features.corners.max_features = 5;
        assert_eq!(config.features.extraction(), sift);
        assert!(config.validate().is_empty());
        config.features.method = FeatureMethod::Surf;
        let problems = config.validate();
        assert!(
            problems.len() == 1 && problems[0].contains("features.surf: hessian_threshold"),
            "{problems:?}"
        );
        let named: RunConfig = serde_json::from_str(r#"{"features": {"method": "surf-upright"}}"#).unwrap();
        assert_eq!(named.features.method, FeatureMethod::SurfUpright);
    }

    #[test]
    fn workers_do_not_change_the_name_of_a_run() {
        let config = RunConfig { photos: "p".into(), ..Default::default() };
        let mut other = config.clone();
        other.workers.threads = 7;
        assert_eq!(config.canonical_hash().unwrap(), other.canonical_hash().unwrap());
        other.seed = 1;
        assert_ne!(config.canonical_hash().unwrap(), other.canonical_hash().unwrap());
        assert!(config.validate().is_empty());
        assert!(serde_json::from_str::<RunConfig>(r#"{"seeed": 1}"#).is_err());
    }
}
