//! Photographs of a planar target in, the camera's intrinsics out.

use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Serialize;
use terrane_frontend::image::{DecodeOptions, decode, probe};
use terrane_frontend::targets::{TargetView, detect};
use terrane_geometry::calibration::{Calibration, CalibrationError, PlanarView, calibrate};
use terrane_geometry::{Camera, CameraModel};

pub use terrane_frontend::targets::Target;

use crate::PipelineError;

/// A view whose error is above so many medians of all views' is an outlier, if it is above [`MIN_OUTLIER_PX`] too.
const OUTLIER_MEDIANS: f64 = 4.0;
/// Errors in pixels below which no view is an outlier.
const MIN_OUTLIER_PX: f64 = 0.5;
/// Fewer corners than this leave a view's pose loose.
const MIN_CORNERS: usize = 8;
/// Views from which on no more are asked for.
const ENOUGH_VIEWS: usize = 8;
/// Angle between target planes, in degrees, that tells focal length from distance well.
const GOOD_TILT_DEG: f64 = 20.0;

/// What one photograph gave.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PhotographReport {
    /// The photograph, as it was named.
    pub path: PathBuf,
    /// Corners found.
    pub corners: usize,
    /// Root mean square of the reprojection error over them, if used.
    pub rms_px: Option<f64>,
    /// Why it was not used.
    pub unused: Option<String>,
}

/// A calibrated camera, and how far to trust it.
#[derive(Clone, Debug, Serialize)]
pub struct CalibrationReport {
    /// Every photograph, in the order given.
    pub photographs: Vec<PhotographReport>,
    /// The intrinsics; `None` when the photographs don't give them.
    pub camera: Option<Camera>,
    /// Standard deviations of the parameters, in their order.
    pub params_sigma: Vec<f64>,
    /// Root mean square of the reprojection error over all corners used.
    pub rms_px: Option<f64>,
    /// Why there are no intrinsics.
    pub failure: Option<String>,
    /// What would make the result better.
    pub warnings: Vec<String>,
}

/// Finds the target in every photograph and calibrates the camera that took them all.
///
/// A photograph that can't be used is listed with the reason. The result is the same for any number of threads.
///
/// # Errors
/// When a file can't be read, or photographs differ in size.
pub fn calibrate_photographs(
    paths: &[PathBuf],
    target: &Target,
    model: CameraModel,
) -> Result<CalibrationReport, PipelineError> {
    let looks: Vec<Look> = paths.par_iter().map(|path| Look::at(path, target)).collect::<Result<_, _>>()?;
    let size = common_size(paths, &looks)?;
    let mut report = CalibrationReport {
        photographs: Vec::with_capacity(paths.len()),
        camera: None,
        params_sigma: Vec::new(),
        rms_px: None,
        failure: None,
        warnings: Vec::new(),
    };
    let mut used = Vec::new();
    for (index, (path, look)) in paths.iter().zip(&looks).enumerate() {
        let (corners, unused) = match &look.view {
            Ok(view) if view.xy_px.len() >= MIN_CORNERS => {
                used.push(index);
                (view.xy_px.len(), None)
            }
            Ok(view) => (view.xy_px.len(), Some(format!("fewer than {MIN_CORNERS} corners are seen"))),
            Err(reason) => (0, Some(reason.clone())),
        };
        report.photographs.push(PhotographReport { path: path.clone(), corners, rms_px: None, unused });
    }
    let views: Vec<TargetView> = looks.into_iter().map(|look| look.view.unwrap_or_default()).collect();
    match fitted(&views, &mut used, model, size, &mut report.photographs) {
        Ok(found) => {
            for (&index, rms_px) in used.iter().zip(errors_px(&found, &views, &used)) {
                report.photographs[index].rms_px = Some(rms_px);
            }
            let count = found.camera.params().len();
            report.params_sigma = (0..count).map(|i| found.params_covariance[(i, i)].sqrt()).collect();
            report.rms_px = Some(found.rms_px);
            report.warnings = warnings(&found, &views, &used);
            report.camera = Some(found.camera);
        }
        Err(error) => report.failure = Some(error.to_string()),
    }
    Ok(report)
}

/// The size of all photographs that are photographs at all.
fn common_size(paths: &[PathBuf], looks: &[Look]) -> Result<(u32, u32), PipelineError> {
    let mut first: Option<(&Path, (u32, u32))> = None;
    let mut others = Vec::new();
    for (path, look) in paths.iter().zip(looks) {
        let Some(size) = look.size else { continue };
        match first {
            None => first = Some((path, size)),
            Some((_, common)) if common != size => {
                others.push(format!("{} is {} x {}", path.display(), size.0, size.1));
            }
            Some(_) => {}
        }
    }
    let Some((path, size)) = first else {
        return Err(PipelineError::invalid_input("none of the files is a photograph that can be read"));
    };
    if others.is_empty() {
        return Ok(size);
    }
    Err(PipelineError::invalid_input(format!(
        "photographs of one camera must have one size: {} is {} x {}, but {}",
        path.display(),
        size.0,
        size.1,
        others.join(", ")
    )))
}

/// What one look at a file says.
struct Look {
    /// Its width and height in pixels, when it is a photograph.
    size: Option<(u32, u32)>,
    /// The target in it, or why that isn't there.
    view: Result<TargetView, String>,
}

impl Look {
    fn at(path: &Path, target: &Target) -> Result<Self, PipelineError> {
        let bytes = std::fs::read(path).map_err(|error| {
            PipelineError::invalid_input(format!("can't read {}: {error}", path.display()))
        })?;
        let size = probe(&bytes).ok().map(|probe| (probe.width, probe.height));
        let options = DecodeOptions { color: false, ..DecodeOptions::default() };
        let view = decode(&bytes, &options)
            .map_err(|error| error.to_string())
            .and_then(|image| detect(target, &image.luma).map_err(|reason| reason.to_string()));
        Ok(Self { size, view })
    }
}

fn fit(
    views: &[TargetView],
    used: &[usize],
    model: CameraModel,
    size: (u32, u32),
) -> Result<Calibration, CalibrationError> {
    let planar: Vec<PlanarView<'_>> = used
        .iter()
        .map(|&i| PlanarView { xy_on_target: &views[i].xy_on_target_m, xy_px: &views[i].xy_px })
        .collect();
    calibrate(&planar, model, size)
}

/// Calibrates, and takes out the worst view as long as it is an outlier.
fn fitted(
    views: &[TargetView],
    used: &mut Vec<usize>,
    model: CameraModel,
    size: (u32, u32),
    photographs: &mut [PhotographReport],
) -> Result<Calibration, CalibrationError> {
    loop {
        let found = fit(views, used, model, size)?;
        let errors = errors_px(&found, views, used);
        let mut sorted = errors.clone();
        sorted.sort_by(f64::total_cmp);
        let limit_px = (OUTLIER_MEDIANS * sorted[sorted.len() / 2]).max(MIN_OUTLIER_PX);
        let worst = (0..errors.len()).max_by(|&a, &b| errors[a].total_cmp(&errors[b])).unwrap_or(0);
        if errors[worst] <= limit_px || used.len() <= 3 {
            return Ok(found);
        }
        photographs[used[worst]].unused = Some(format!(
            "its corners are {:.2} px off (others {:.2} px): blurred by motion, bent, or another target?",
            errors[worst],
            sorted[sorted.len() / 2]
        ));
        used.remove(worst);
    }
}

/// Root mean square of the reprojection error of each view used.
fn errors_px(found: &Calibration, views: &[TargetView], used: &[usize]) -> Vec<f64> {
    let of_view = |(&index, pose): (&usize, &terrane_geometry::Rigid3)| {
        let view = &views[index];
        let squared = view.xy_on_target_m.iter().zip(&view.xy_px).map(|(xy, px)| {
            let seen = found.camera.project(&pose.transform_point(&xy.push(0.0)));
            seen.map_or(f64::INFINITY, |seen| (seen - px).norm_squared())
        });
        (squared.sum::<f64>() / view.xy_px.len() as f64).sqrt()
    };
    used.iter().zip(&found.cam_from_target).map(of_view).collect()
}

fn warnings(found: &Calibration, views: &[TargetView], used: &[usize]) -> Vec<String> {
    let mut warnings = Vec::new();
    if used.len() < ENOUGH_VIEWS {
        warnings.push(format!(
            "{} photographs were used: {ENOUGH_VIEWS} or more are better, 20 are good",
            used.len()
        ));
    }
    let tilt_deg = found.largest_tilt_sine().min(1.0).asin().to_degrees();
    if tilt_deg < GOOD_TILT_DEG {
        warnings.push(format!(
            "the target's planes differ by {tilt_deg:.0}° at most: tilt it by 20° to 45° both ways"
        ));
    }
    let (width, height) = (f64::from(found.camera.width_px), f64::from(found.camera.height_px));
    let mut seen = [false; 9];
    for xy in used.iter().flat_map(|&index| &views[index].xy_px) {
        let cell = |v: f64, size: f64| ((3.0 * v / size) as usize).min(2);
        seen[3 * cell(xy.y, height) + cell(xy.x, width)] = true;
    }
    let names = [
        "upper left",
        "upper middle",
        "upper right",
        "middle left",
        "centre",
        "middle right",
        "lower left",
        "lower middle",
        "lower right",
    ];
    let unseen: Vec<&str> = names.iter().zip(seen).filter(|(_, seen)| !seen).map(|(name, _)| *name).collect();
    if !unseen.is_empty() {
        warnings.push(format!(
            "no corner lies in these parts of the picture, where distortion is a guess: {}",
            unseen.join(", ")
        ));
    }
    warnings
}
