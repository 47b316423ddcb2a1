//! The positions of the image table in one local frame.

use nalgebra::Vector3;
use terrane_geometry::geodesy::{EnuFrame, Geodetic};
use terrane_scene::{GpsPrior, ImageId, ImageTable};

use super::{EnuOrigin, LocalPosition, LocalPositions};
use crate::statistics::median;

/// Standard deviation of a height that is not given, in metres: no height on earth is far outside it.
const UNKNOWN_HEIGHT_SIGMA_M: f64 = 10_000.0;
/// Standard deviations below this are taken for it, in metres: no receiver is better.
const MIN_SIGMA_M: f64 = 0.005;
/// Farther from the median position than this, a position can't be of the same scene, in metres.
const MAX_DISTANCE_M: f64 = 200_000.0;

impl EnuOrigin {
    /// The local frame at this origin.
    pub fn frame(&self) -> EnuFrame {
        EnuFrame::new(Geodetic::from_degrees(self.latitude_deg, self.longitude_deg, self.height_m))
    }
}

impl LocalPositions {
    /// The position of an image, if it has one.
    pub fn of(&self, image: ImageId) -> Option<&LocalPosition> {
        self.positions
            .binary_search_by_key(&image, |position| position.image)
            .ok()
            .map(|at| &self.positions[at])
    }
}

/// Satellite positions as east, north, up from their median; `None` when no photograph has one that can be true.
///
/// The origin's height is the median altitude, in the datum that the files have. A position without altitude takes
/// that height with a standard deviation so large that it has no say.
pub fn local_positions(table: &ImageTable) -> Option<LocalPositions> {
    let (mut valid, mut rejected) = (Vec::new(), Vec::new());
    for image in table.ids() {
        if let Some(gps) = &table.image(image).gps {
            if is_plausible(gps) { valid.push((image, *gps)) } else { rejected.push(image) }
        }
    }
    let middle = |value: &dyn Fn(&GpsPrior) -> Option<f64>| {
        median(&mut valid.iter().filter_map(|(_, gps)| value(gps)).collect::<Vec<_>>())
    };
    let origin = EnuOrigin {
        latitude_deg: middle(&|gps| Some(gps.latitude_deg))?,
        longitude_deg: middle(&|gps| Some(gps.longitude_deg))?,
        height_m: middle(&|gps| gps.altitude_m).unwrap_or(0.0),
    };
    let frame = origin.frame();
    let mut positions = Vec::new();
    for (image, gps) in &valid {
        let height_m = gps.altitude_m.unwrap_or(origin.height_m);
        let mut x_in_enu =
            frame.enu_from_geodetic(&Geodetic::from_degrees(gps.latitude_deg, gps.longitude_deg, height_m));
        let (horizontal, vertical) = (gps.sigma_horizontal_m, gps.sigma_vertical_m);
        let mut sigma_m = Vector3::new(horizontal, horizontal, vertical).map(|sigma| sigma.max(MIN_SIGMA_M));
        if gps.altitude_m.is_none() {
            x_in_enu.z = 0.0;
            sigma_m.z = UNKNOWN_HEIGHT_SIGMA_M;
        }
        if x_in_enu.norm() > MAX_DISTANCE_M {
            rejected.push(*image);
        } else {
            positions.push(LocalPosition { image: *image, x_in_enu, sigma_m });
        }
    }
    rejected.sort_unstable();
    let num_without_altitude = valid.iter().filter(|(_, gps)| gps.altitude_m.is_none()).count() as u32;
    Some(LocalPositions { origin, positions, num_without_altitude, rejected })
}

/// Whether a receiver can have said this: within range, and not the 0°, 0° of one that had no fix.
fn is_plausible(gps: &GpsPrior) -> bool {
    let finite = gps.latitude_deg.is_finite() && gps.longitude_deg.is_finite();
    let height = gps.altitude_m.is_none_or(|height| height.is_finite() && height.abs() < 100_000.0);
    let sigma = gps.sigma_horizontal_m.is_finite() && gps.sigma_vertical_m.is_finite();
    let in_range = gps.latitude_deg.abs() <= 90.0 && gps.longitude_deg.abs() <= 180.0;
    finite && height && sigma && in_range && (gps.latitude_deg, gps.longitude_deg) != (0.0, 0.0)
}
