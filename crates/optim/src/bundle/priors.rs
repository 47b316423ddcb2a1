//! What is known of cameras and landmarks beside reprojections: measured positions, directions, lengths, marks.

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use terrane_geometry::CameraModel;

use super::{BundleError, BundleProblem};

/// All priors of a problem; each kind may be empty.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Priors {
    /// Measured camera centres, as from GPS.
    pub positions: Vec<PositionPrior>,
    /// Measured directions of gravity, as from an accelerometer or a gimbal.
    pub gravities: Vec<GravityPrior>,
    /// Measured rotations, as from an inertial unit.
    pub rotations: Vec<RotationPrior>,
    /// Known parameters of intrinsics, as focal lengths from EXIF.
    pub parameters: Vec<ParameterPrior>,
    /// Surveyed positions of landmarks, as of ground control points.
    pub landmarks: Vec<LandmarkPrior>,
    /// Known distances, as of scale bars and of cameras on a frame.
    pub distances: Vec<DistancePrior>,
}

impl Priors {
    /// Whether measured positions hold all seven directions in which a reconstruction may move as a whole: three or more, of
    /// cameras or of landmarks. (On one line they leave a turn open, which damping then holds.)
    pub(super) fn fixes_the_datum(&self) -> bool {
        self.positions.len() + self.landmarks.len() >= 3
    }
}

/// A measured camera centre.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PositionPrior {
    /// Index of the pose.
    pub pose: u32,
    /// The measured centre, in the world's frame and unit.
    pub center_in_world: Vector3<f64>,
    /// Standard deviation along each axis of the world; positive.
    pub sigma_m: Vector3<f64>,
    /// Index of the bias that the measurement has in common with others, as those of one flight.
    #[serde(default)]
    pub bias: Option<u32>,
}

/// What the positions of one flight have in common: measured = true centre + bias + noise. An unknown of the adjustment.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PositionBias {
    /// The bias; where the solve starts, and afterwards what it found.
    pub bias_m: Vector3<f64>,
    /// Standard deviation about zero along each axis of the world; positive.
    pub sigma_m: Vector3<f64>,
}

/// A measured direction of gravity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GravityPrior {
    /// Index of the pose.
    pub pose: u32,
    /// Down in the camera's frame, as measured; of unit length.
    pub down_in_cam: Vector3<f64>,
    /// Down in the world's frame; of unit length.
    pub down_in_world: Vector3<f64>,
    /// Standard deviation of the angle about each axis across it; positive.
    pub sigma_rad: f64,
}

/// A measured rotation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RotationPrior {
    /// Index of the pose.
    pub pose: u32,
    /// The measured rotation of `cam_from_world`.
    pub cam_from_world: UnitQuaternion<f64>,
    /// Standard deviation about each axis of the camera; positive.
    pub sigma_rad: Vector3<f64>,
}

/// A parameter of intrinsics that is known beforehand; acts when the parameter is refined.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterPrior {
    /// Index of the intrinsics.
    pub intrinsics: u32,
    /// Index of the parameter in the model's order.
    pub param: u32,
    /// The expected value, in the parameter's unit.
    pub value: f64,
    /// Its standard deviation; positive.
    pub sigma: f64,
}

impl ParameterPrior {
    /// The priors that say the same of all focal lengths of a model.
    pub fn focal(
        intrinsics: u32,
        model: CameraModel,
        focal_px: f64,
        sigma_px: f64,
    ) -> impl Iterator<Item = Self> {
        (0..model.num_focal() as u32).map(move |param| Self {
            intrinsics,
            param,
            value: focal_px,
            sigma: sigma_px,
        })
    }
}

/// A point that is kept beside the cameras and not eliminated: a ground control or check point, the end of a scale bar.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Landmark {
    /// Where it is; where the solve starts, and afterwards what it found.
    pub x_in_world: Vector3<f64>,
    /// Whether it is held.
    pub fixed: bool,
}

/// Where a photograph shows a landmark.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Mark {
    /// Index of the pose.
    pub pose: u32,
    /// Index of the landmark.
    pub landmark: u32,
    /// Its image, in pixels.
    pub xy_px: [f64; 2],
    /// Standard deviation along each axis of the image; positive. One is what an observation of a point counts with.
    pub sigma_px: f64,
}

/// A surveyed position of a landmark.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LandmarkPrior {
    /// Index of the landmark.
    pub landmark: u32,
    /// The surveyed position, in the world's frame and unit.
    pub x_in_world: Vector3<f64>,
    /// Standard deviation along each axis of the world; positive.
    pub sigma_m: Vector3<f64>,
}

/// One end of a known distance.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Anchor {
    /// The camera centre of a pose.
    Pose(u32),
    /// A landmark.
    Landmark(u32),
}

/// A known distance between two camera centres or landmarks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DistancePrior {
    /// The one end.
    pub from: Anchor,
    /// The other end.
    pub to: Anchor,
    /// The distance; positive.
    pub length_m: f64,
    /// Its standard deviation; positive.
    pub sigma_m: f64,
}

/// A check's verdict on one prior: what is wrong with it, or nothing.
type Verdict = Result<(), String>;

/// Checks indices, finiteness and standard deviations of all that is known.
pub(super) fn validate(problem: &BundleProblem) -> Result<(), BundleError> {
    let BundleProblem { priors, landmarks, marks, position_biases, .. } = problem;
    each("position prior", &priors.positions, |p| {
        index("pose", p.pose, problem.poses.len())?;
        p.bias.map_or(Ok(()), |bias| index("position bias", bias, position_biases.len()))?;
        finite(p.center_in_world.iter())?;
        positive(p.sigma_m.iter())
    })?;
    each("position bias", position_biases, |p| {
        finite(p.bias_m.iter())?;
        positive(p.sigma_m.iter())
    })?;
    each("gravity prior", &priors.gravities, |p| {
        index("pose", p.pose, problem.poses.len())?;
        unit(&p.down_in_cam)?;
        unit(&p.down_in_world)?;
        positive([p.sigma_rad].iter())
    })?;
    each("rotation prior", &priors.rotations, |p| {
        index("pose", p.pose, problem.poses.len())?;
        finite(p.cam_from_world.coords.iter())?;
        positive(p.sigma_rad.iter())
    })?;
    each("parameter prior", &priors.parameters, |p| {
        index("intrinsics", p.intrinsics, problem.intrinsics.len())?;
        index("parameter", p.param, problem.intrinsics[p.intrinsics as usize].model.num_params())?;
        finite([p.value].iter())?;
        positive([p.sigma].iter())
    })?;
    each("landmark", landmarks, |p| finite(p.x_in_world.iter()))?;
    each("mark", marks, |p| {
        index("pose", p.pose, problem.poses.len())?;
        index("landmark", p.landmark, landmarks.len())?;
        finite(p.xy_px.iter())?;
        positive([p.sigma_px].iter())
    })?;
    each("landmark prior", &priors.landmarks, |p| {
        index("landmark", p.landmark, landmarks.len())?;
        finite(p.x_in_world.iter())?;
        positive(p.sigma_m.iter())
    })?;
    each("distance prior", &priors.distances, |p| {
        for anchor in [p.from, p.to] {
            match anchor {
                Anchor::Pose(pose) => index("pose", pose, problem.poses.len())?,
                Anchor::Landmark(landmark) => index("landmark", landmark, landmarks.len())?,
            }
        }
        if p.from == p.to {
            return Err("joins a thing to itself".to_owned());
        }
        positive([p.length_m, p.sigma_m].iter())
    })
}

fn each<T>(name: &str, items: &[T], check: impl Fn(&T) -> Verdict) -> Result<(), BundleError> {
    for (i, item) in items.iter().enumerate() {
        check(item).map_err(|wrong| BundleError::invalid(format!("{name} {i} {wrong}")))?;
    }
    Ok(())
}

fn index(name: &str, index: u32, count: usize) -> Verdict {
    if (index as usize) < count { Ok(()) } else { Err(format!("names {name} {index} but there are {count}")) }
}

fn finite<'a>(values: impl Iterator<Item = &'a f64>) -> Verdict {
    all(values, |v| v.is_finite(), "must be finite")
}

fn positive<'a>(values: impl Iterator<Item = &'a f64>) -> Verdict {
    all(values, |v| v.is_finite() && v > 0.0, "must have positive, finite lengths and standard deviations")
}

fn unit(direction: &Vector3<f64>) -> Verdict {
    all([direction.norm()].iter(), |v| (v - 1.0).abs() < 1e-6, "must have directions of unit length")
}

fn all<'a>(mut values: impl Iterator<Item = &'a f64>, good: impl Fn(f64) -> bool, wrong: &str) -> Verdict {
    if values.all(|v| good(*v)) { Ok(()) } else { Err(wrong.to_owned()) }
}
