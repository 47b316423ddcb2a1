//! Options of corners.

use serde::{Deserialize, Serialize};

use crate::FrontendError;

/// Options of [`super::extract`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CornerOptions {
    /// The most features of a photograph. Range: above 0. Default 8,192, as for SIFT.
    pub max_features: u32,
    /// The most levels of the pyramid. Range: 1 to 16. Default 8 (Rublee et al. 2011).
    pub num_levels: u32,
    /// How many times smaller each level is than the one before. Range: 1.1 to 2. Default 1.2 (Rublee et al. 2011).
    pub level_scale: f64,
    /// By how many greys a FAST corner differs from its circle, at least. Range: 1 to 254. Default 8: weaker ones are
    /// mostly noise, and the strongest are kept anyway.
    pub fast_threshold: u8,
    /// The least measure of a Harris corner, in fourth powers of greys a pixel. Range: at least 0. Default 2: noise of
    /// one grey measures about 0.01.
    pub harris_threshold: f64,
    /// A corner within this many pixels (of the coarser of the two levels) of a stronger one is left out, so that a
    /// place that is found on several levels is described once. Range: 0 to 32. Default 4: on photographs of a
    /// beach from the air, verified matches of Harris corners rise by a third from 0 to 2, those of ORB by two thirds from 2
    /// to 4, and neither beyond.
    pub separation_px: f64,
    /// The most orientations of a corner that is described by gradients. Range: 1 to 4. Default 2, as for SIFT.
    pub max_orientations: u32,
    /// Whether features take the photograph's own axes instead of turning with what they show. Default: no.
    pub upright: bool,
    /// The part of `max_features` that is spread evenly over the photograph; the rest goes to the strongest. Range: 0 to
    /// 1. Default 0.5.
    pub spread: f64,
}

impl Default for CornerOptions {
    fn default() -> Self {
        Self {
            max_features: 8192,
            num_levels: 8,
            level_scale: 1.2,
            fast_threshold: 8,
            harris_threshold: 2.0,
            separation_px: 4.0,
            max_orientations: 2,
            upright: false,
            spread: 0.5,
        }
    }
}

impl CornerOptions {
    /// Checks the ranges of all fields.
    ///
    /// # Errors
    /// Names every field that is out of its range.
    pub fn validate(&self) -> Result<(), FrontendError> {
        let checks = [
            (self.max_features > 0, "max_features must be above 0"),
            ((1..=16).contains(&self.num_levels), "num_levels must be 1 to 16"),
            ((1.1..=2.0).contains(&self.level_scale), "level_scale must be 1.1 to 2"),
            ((1..=254).contains(&self.fast_threshold), "fast_threshold must be 1 to 254"),
            (self.harris_threshold >= 0.0, "harris_threshold must be at least 0"),
            ((0.0..=32.0).contains(&self.separation_px), "separation_px must be 0 to 32"),
            ((1..=4).contains(&self.max_orientations), "max_orientations must be 1 to 4"),
            ((0.0..=1.0).contains(&self.spread), "spread must be 0 to 1"),
        ];
        let problems: Vec<&str> =
            checks.into_iter().filter(|(holds, _)| !holds).map(|(_, what)| what).collect();
        match problems.is_empty() {
            true => Ok(()),
            false => Err(FrontendError::invalid_option(format!("corners: {}", problems.join("; ")))),
        }
    }
}
