//! What a bundle adjustment adjusts: poses, intrinsics, and what is known of them beforehand.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use terrane_geometry::{Camera, Rigid3};

use super::BundleError;
use super::priors::{self, Landmark, Mark, PositionBias, Priors};

/// The camera side of a bundle adjustment. Points and observations come in shards ([`super::Shards`]).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BundleProblem {
    /// `cam_from_world` of each pose; refined on the left by `(ω, v)`.
    pub poses: Vec<Rigid3>,
    /// Poses to hold, as many as `poses`.
    pub fixed_poses: Vec<bool>,
    /// Intrinsics, shared by any number of poses.
    pub intrinsics: Vec<Camera>,
    /// For each pose, its index in `intrinsics`.
    pub intrinsics_of_pose: Vec<u32>,
    /// For each of the intrinsics, which of its parameters to refine.
    pub refine: Vec<RefineIntrinsics>,
    /// Points that are kept beside the cameras, as ground control points; most problems have none.
    #[serde(default)]
    pub landmarks: Vec<Landmark>,
    /// Where photographs show landmarks.
    #[serde(default)]
    pub marks: Vec<Mark>,
    /// What measured positions have in common, as those of one flight.
    #[serde(default)]
    pub position_biases: Vec<PositionBias>,
    /// What is known beside observations.
    #[serde(default)]
    pub priors: Priors,
}

/// Which parameters of a camera to refine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefineIntrinsics {
    /// The focal length or lengths.
    pub focal: bool,
    /// The principal point.
    pub principal_point: bool,
    /// The distortion coefficients.
    pub distortion: bool,
}

impl RefineIntrinsics {
    /// Hold everything.
    pub const NONE: Self = Self { focal: false, principal_point: false, distortion: false };
    /// Focal length and distortion, with the principal point held.
    pub const FOCAL_AND_DISTORTION: Self = Self { focal: true, principal_point: false, distortion: true };
    /// Every parameter.
    pub const ALL: Self = Self { focal: true, principal_point: true, distortion: true };

    /// The indices of the refined parameters in `camera.params()`, ascending. Of a panorama there are none: its size is known.
    pub fn params(self, camera: &Camera) -> Vec<usize> {
        if camera.model.is_spherical() {
            return Vec::new();
        }
        let num_focal = camera.model.num_focal();
        let mut params = Vec::new();
        if self.focal {
            params.extend(0..num_focal);
        }
        if self.principal_point {
            params.extend(num_focal..num_focal + 2);
        }
        if self.distortion {
            params.extend(num_focal + 2..camera.model.num_params());
        }
        params
    }
}

impl BundleProblem {
    /// A problem with every pose free and the same refinement for all intrinsics.
    pub fn new(
        poses: Vec<Rigid3>,
        intrinsics: Vec<Camera>,
        intrinsics_of_pose: Vec<u32>,
        refine: RefineIntrinsics,
    ) -> Self {
        Self {
            fixed_poses: vec![false; poses.len()],
            refine: vec![refine; intrinsics.len()],
            poses,
            intrinsics,
            intrinsics_of_pose,
            landmarks: Vec::new(),
            marks: Vec::new(),
            position_biases: Vec::new(),
            priors: Priors::default(),
        }
    }

    /// Checks lengths, indices, finiteness and standard deviations.
    pub fn validate(&self) -> Result<(), BundleError> {
        let num_poses = self.poses.len();
        for (name, length) in
            [("fixed_poses", self.fixed_poses.len()), ("intrinsics_of_pose", self.intrinsics_of_pose.len())]
        {
            if length != num_poses {
                return Err(BundleError::invalid(format!(
                    "{name} has {length} entries but there are {num_poses} poses: give one for each"
                )));
            }
        }
        if self.refine.len() != self.intrinsics.len() {
            return Err(BundleError::invalid(format!(
                "refine has {} entries but there are {} intrinsics: give one for each",
                self.refine.len(),
                self.intrinsics.len()
            )));
        }
        if u32::try_from(num_poses).is_err() || u32::try_from(self.intrinsics.len()).is_err() {
            return Err(BundleError::invalid("more than 2^32 poses or intrinsics".to_owned()));
        }
        self.validate_values()?;
        priors::validate(self)
    }

    /// Whether anything beside observations says where cameras are.
    pub(super) fn has_measurements(&self) -> bool {
        !self.priors.positions.is_empty() || !self.marks.is_empty()
    }

    fn validate_values(&self) -> Result<(), BundleError> {
        for (i, pose) in self.poses.iter().enumerate() {
            let finite = pose.rotation.coords.iter().chain(pose.translation.iter()).all(|v| v.is_finite());
            if !finite {
                return Err(BundleError::invalid(format!("pose {i} is not finite: leave it out")));
            }
            let intrinsics = self.intrinsics_of_pose[i];
            if intrinsics as usize >= self.intrinsics.len() {
                return Err(BundleError::invalid(format!(
                    "pose {i} names intrinsics {intrinsics} but there are {}",
                    self.intrinsics.len()
                )));
            }
        }
        for (i, camera) in self.intrinsics.iter().enumerate() {
            let finite = camera.params().iter().all(|v| v.is_finite());
            if !finite || !camera_is_sane(camera) {
                return Err(BundleError::invalid(format!(
                    "intrinsics {i} must be finite with a positive focal length"
                )));
            }
        }
        Ok(())
    }
}

/// Whether the focal lengths are positive and every parameter is finite.
pub(super) fn camera_is_sane(camera: &Camera) -> bool {
    camera.params().iter().all(|v| v.is_finite()) && camera.focal_px().iter().all(|f| *f > 0.0)
}

/// What an adjustment of a problem found on the camera side.
#[derive(Clone, Debug, PartialEq)]
pub struct AdjustedCameras {
    /// `cam_from_world` of each pose.
    pub poses: Vec<Rigid3>,
    /// The intrinsics.
    pub intrinsics: Vec<Camera>,
    /// Each position bias.
    pub biases_m: Vec<Vector3<f64>>,
    /// Each landmark in the world.
    pub landmarks: Vec<Vector3<f64>>,
}

impl AdjustedCameras {
    /// Where a problem starts.
    pub(super) fn of(problem: &BundleProblem) -> Self {
        Self {
            poses: problem.poses.clone(),
            intrinsics: problem.intrinsics.clone(),
            biases_m: problem.position_biases.iter().map(|bias| bias.bias_m).collect(),
            landmarks: problem.landmarks.iter().map(|landmark| landmark.x_in_world).collect(),
        }
    }

    /// Takes them over into the problem.
    pub fn put_into(self, problem: &mut BundleProblem) {
        problem.poses = self.poses;
        problem.intrinsics = self.intrinsics;
        for (bias, found) in problem.position_biases.iter_mut().zip(self.biases_m) {
            bias.bias_m = found;
        }
        for (landmark, found) in problem.landmarks.iter_mut().zip(self.landmarks) {
            landmark.x_in_world = found;
        }
    }
}
