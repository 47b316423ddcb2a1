//! Options of SURF.

use serde::{Deserialize, Serialize};

use crate::FrontendError;

/// Options of [`super::extract`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SurfOptions {
    /// The most features of a photograph. Range: above 0. Default 8,192, as for SIFT.
    pub max_features: u32,
    /// The most octaves. Range: 1 to 6. Default 4 (Bay et al. 2008).
    pub num_octaves: u32,
    /// The least determinant of the Hessian, in squared greys. Range: at least 0. Default 10: low enough that low
    /// contrast has features; the strongest are kept anyway.
    pub hessian_threshold: f64,
    /// Whether features take the photograph's own axes instead of turning with what they show. Default: no.
    pub upright: bool,
    /// The part of `max_features` that is spread evenly over the photograph; the rest goes to the strongest. Range: 0 to
    /// 1. Default 0.5.
    pub spread: f64,
}

impl Default for SurfOptions {
    fn default() -> Self {
        Self { max_features: 8192, num_octaves: 4, hessian_threshold: 10.0, upright: false, spread: 0.5 }
    }
}

impl SurfOptions {
    /// Checks the ranges of all fields.
    ///
    /// # Errors
    /// Names every field that is out of its range.
    pub fn validate(&self) -> Result<(), FrontendError> {
        let checks = [
            (self.max_features > 0, "max_features must be above 0"),
            ((1..=6).contains(&self.num_octaves), "num_octaves must be 1 to 6"),
            (self.hessian_threshold >= 0.0, "hessian_threshold must be at least 0"),
            ((0.0..=1.0).contains(&self.spread), "spread must be 0 to 1"),
        ];
        let problems: Vec<&str> =
            checks.into_iter().filter(|(holds, _)| !holds).map(|(_, what)| what).collect();
        match problems.is_empty() {
            true => Ok(()),
            false => Err(FrontendError::invalid_option(format!("surf: {}", problems.join("; ")))),
        }
    }
}
