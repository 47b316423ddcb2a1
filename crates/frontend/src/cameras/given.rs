//! Intrinsics that the user gives: `MODEL:params`, as in `PINHOLE:2759.48,2764.16,1520.69,1006.81`.

use std::str::FromStr;

use serde::{Deserialize, Serialize};
use terrane_geometry::{Camera, CameraModel};

use crate::FrontendError;

/// A camera model with parameters, of no particular image size.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct GivenCamera {
    model: CameraModel,
    params: Vec<f64>,
}

impl GivenCamera {
    /// A camera from a model and its parameters in COLMAP's order.
    ///
    /// # Errors
    /// When the number of parameters does not fit the model, one is not finite, or a focal length is not positive.
    pub fn new(model: CameraModel, params: Vec<f64>) -> Result<Self, FrontendError> {
        if model.is_spherical() {
            return Err(FrontendError::invalid_option(format!(
                "{} photographs can be adjusted (terrane adjust) but not yet reconstructed: cut them into perspective views",
                model.name()
            )));
        }
        if params.len() != model.num_params() {
            return Err(FrontendError::invalid_option(format!(
                "camera model {} takes {} parameters, {} were given",
                model.name(),
                model.num_params(),
                params.len()
            )));
        }
        if !params.iter().all(|p| p.is_finite()) || params[..model.num_focal()].iter().any(|f| *f <= 0.0) {
            return Err(FrontendError::invalid_option(format!(
                "parameters of camera model {} must be finite numbers, focal lengths above 0",
                model.name()
            )));
        }
        Ok(Self { model, params })
    }

    /// The camera for photographs of a size.
    pub fn camera(&self, width_px: u32, height_px: u32) -> Camera {
        let mut camera = Camera::centered(self.model, width_px, height_px, 1.0);
        camera.params_mut().copy_from_slice(&self.params);
        camera
    }
}

impl FromStr for GivenCamera {
    type Err = FrontendError;

    fn from_str(text: &str) -> Result<Self, FrontendError> {
        let (name, params) = text.split_once(':').ok_or_else(|| {
            FrontendError::invalid_option(format!(
                "camera '{text}' is not of the form MODEL:params, for example PINHOLE:2759.5,2764.2,1520.7,1006.8"
            ))
        })?;
        let model = CameraModel::from_name(&name.trim().to_ascii_uppercase()).ok_or_else(|| {
            FrontendError::invalid_option(format!(
                "camera model '{name}' is unknown: use one of {}",
                CameraModel::names()
            ))
        })?;
        let params = params
            .split(',')
            .map(|param| {
                param.trim().parse::<f64>().map_err(|_| {
                    FrontendError::invalid_option(format!("camera parameter '{param}' is not a number"))
                })
            })
            .collect::<Result<Vec<f64>, FrontendError>>()?;
        Self::new(model, params)
    }
}

impl TryFrom<String> for GivenCamera {
    type Error = FrontendError;

    fn try_from(text: String) -> Result<Self, FrontendError> {
        text.parse()
    }
}

impl From<GivenCamera> for String {
    fn from(given: GivenCamera) -> Self {
        let params: Vec<String> = given.params.iter().map(f64::to_string).collect();
        format!("{}:{}", given.model.name(), params.join(","))
    }
}
