//! Hierarchical adjustment: seams first, then the whole, over shards that the caller keeps.

mod filter;
mod problem;
mod run;
mod seam;
#[cfg(test)]
mod tests;

pub use run::adjust;

use std::borrow::Cow;

use serde::{Deserialize, Serialize};
use terrane_scene::{CameraId, ImageId};

use crate::FusionError;
use crate::georegister::LocalPosition;
use crate::merge::MergedShard;

/// Where the caller keeps the shards: memory, a local disk, or a store.
pub trait MergedShards: Sync {
    /// How many there are.
    fn len(&self) -> usize;

    /// True when there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// One shard.
    ///
    /// # Errors
    /// When the storage fails; see [`FusionError::shard`].
    fn load(&self, shard: usize) -> Result<Cow<'_, MergedShard>, FusionError>;

    /// Replaces one shard.
    ///
    /// # Errors
    /// When the storage fails; see [`FusionError::shard`].
    fn store(&mut self, shard: usize, value: MergedShard) -> Result<(), FusionError>;
}

impl MergedShards for Vec<MergedShard> {
    fn len(&self) -> usize {
        self.as_slice().len()
    }

    fn load(&self, shard: usize) -> Result<Cow<'_, MergedShard>, FusionError> {
        self.get(shard)
            .map(Cow::Borrowed)
            .ok_or_else(|| FusionError::shard(shard, "read", "there is no such shard"))
    }

    fn store(&mut self, shard: usize, value: MergedShard) -> Result<(), FusionError> {
        match self.get_mut(shard) {
            Some(place) => {
                *place = value;
                Ok(())
            }
            None => Err(FusionError::shard(shard, "written", "there is no such shard")),
        }
    }
}

/// How a component is adjusted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AdjustOptions {
    /// Whether seams are adjusted by themselves before the whole. Default true.
    pub seams_first: bool,
    /// Most iterations of a seam. Default 10.
    pub seam_iterations: u32,
    /// Rounds of the whole: adjust, then filter. Range: at least 1. Default 3.
    pub rounds: u32,
    /// Most iterations of a round of the whole. Default 30.
    pub round_iterations: u32,
    /// Observations with a larger reprojection error are dropped after a round, in pixels. Default 4, as COLMAP.
    pub max_error_px: f64,
    /// Points seen under a smaller angle are dropped after a round, in degrees. Default 1.5, as COLMAP.
    pub min_angle_deg: f64,
    /// Scale of the robust loss, in pixels. Default 1.
    pub loss_scale_px: f64,
    /// Whether satellite positions take part. Default true.
    pub use_positions: bool,
}

impl Default for AdjustOptions {
    fn default() -> Self {
        Self {
            seams_first: true,
            seam_iterations: 10,
            rounds: 3,
            round_iterations: 30,
            max_error_px: 4.0,
            min_angle_deg: 1.5,
            loss_scale_px: 1.0,
            use_positions: true,
        }
    }
}

/// What adjustment reads beside cameras and points.
#[derive(Clone, Copy, Debug, Default)]
pub struct AdjustInput<'a> {
    /// Satellite positions in the world frame of the component, ascending by image; empty when it is not
    /// geo-referenced.
    pub positions: &'a [LocalPosition],
    /// Cameras whose intrinsics stay as they are, ascending.
    pub fixed_intrinsics: &'a [CameraId],
    /// Images that both submaps of each used seam have, ascending within a seam.
    pub seams: &'a [Vec<ImageId>],
}

/// One adjustment.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AdjustRound {
    /// "seam 3" or "whole 1".
    pub name: String,
    /// Cost before.
    pub initial_cost: f64,
    /// Cost after.
    pub final_cost: f64,
    /// Iterations done.
    pub iterations: u32,
    /// Why it stopped.
    pub termination: String,
    /// Observations dropped afterwards.
    pub num_dropped_observations: u64,
    /// Points dropped afterwards.
    pub num_dropped_points: u64,
}

/// What adjusting a component did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AdjustReport {
    /// Every adjustment, in order.
    pub rounds: Vec<AdjustRound>,
    /// Mean reprojection error before, in pixels.
    pub initial_mean_error_px: f64,
    /// Mean reprojection error after, in pixels.
    pub mean_error_px: f64,
    /// Points left.
    pub num_points: u64,
    /// Observations left.
    pub num_observations: u64,
    /// Satellite positions that took part.
    pub num_positions: u32,
    /// Images left out at the end, as too few observations hold them.
    pub dropped_images: Vec<ImageId>,
}
