//! Height above ground and attitude of each photograph, as far as there is evidence for them.

use terrane_scene::{AttitudeOf, AttitudePrior, ImageRecord, ImageTable};

use super::footprint::{View, tilt_rad};

/// Heights outside are no flight over ground: a camera in a hand, or a barometer that was never set.
const HEIGHT_RANGE_M: std::ops::RangeInclusive<f64> = 5.0..=6_000.0;
/// Ground heights (altitude less height above ground) of half of the photographs must lie within this, or the run has no
/// one ground.
const MAX_GROUND_SPREAD_M: f64 = 60.0;
/// A camera counts as one that looks down when at least this many photographs of it say how it was held,
const MIN_EVIDENCE: usize = 3;
/// this share of them looks down,
const NADIR_SHARE: f64 = 0.9;
/// up to this tilt.
const NADIR_TILT_RAD: f64 = 0.26;

/// Attitude of a camera that looks down in an unknown direction.
const NADIR: AttitudePrior =
    AttitudePrior { of: AttitudeOf::Gimbal, yaw_deg: None, pitch_deg: -90.0, roll_deg: 0.0 };

/// The view of each photograph of the table; `None` where height or attitude is unknown.
///
/// A height above ground stands as the file gives it. A photograph that only has an altitude takes the run's ground, the
/// median of altitude less height above ground over those that have both: the datum, and a constant error in it, cancel.
/// An attitude that is missing is straight down when the other photographs of its camera say so.
pub(super) fn views(table: &ImageTable) -> Vec<Option<View>> {
    let ground_m = ground_m(table);
    let looks_down = looking_down(table);
    let view = |image: &ImageRecord| {
        let height_m = height_m(image).or_else(|| {
            let above = altitude_m(image)? - ground_m?;
            Some(above).filter(|height| HEIGHT_RANGE_M.contains(height))
        })?;
        let assumed = looks_down.get(image.camera.index()).is_some_and(|&down| down).then_some(NADIR);
        let attitude = attitude(image).or(assumed)?;
        Some(View { height_m, attitude, on_its_side: (5..=8).contains(&image.orientation.0) })
    };
    table.images.iter().map(view).collect()
}

fn attitude(image: &ImageRecord) -> Option<AttitudePrior> {
    image.flight.as_ref()?.attitude.filter(|attitude| {
        let yaw = attitude.yaw_deg.unwrap_or(0.0);
        yaw.is_finite() && attitude.pitch_deg.is_finite() && attitude.roll_deg.is_finite()
    })
}

fn altitude_m(image: &ImageRecord) -> Option<f64> {
    image.gps.as_ref()?.altitude_m.filter(|altitude| altitude.is_finite())
}

fn height_m(image: &ImageRecord) -> Option<f64> {
    let height = image.flight.as_ref()?.height_above_ground_m?;
    HEIGHT_RANGE_M.contains(&height).then_some(height)
}

/// Height of the ground in the datum of the altitudes, when the photographs agree on one.
fn ground_m(table: &ImageTable) -> Option<f64> {
    let of = |image: &ImageRecord| Some(altitude_m(image)? - height_m(image)?);
    let mut grounds: Vec<f64> = table.images.iter().filter_map(of).collect();
    grounds.sort_by(f64::total_cmp);
    let quartile = |k: usize| grounds.get(k * grounds.len() / 4).copied();
    let spread = quartile(3)? - quartile(1)?;
    (grounds.len() >= MIN_EVIDENCE && spread <= MAX_GROUND_SPREAD_M).then(|| quartile(2)).flatten()
}

/// For each camera, whether its photographs look down as a rule.
fn looking_down(table: &ImageTable) -> Vec<bool> {
    let mut counts = vec![(0_usize, 0_usize); table.cameras.len()];
    for image in &table.images {
        let (Some(attitude), Some(count)) = (attitude(image), counts.get_mut(image.camera.index())) else {
            continue;
        };
        count.0 += 1;
        count.1 += usize::from(tilt_rad(&attitude) <= NADIR_TILT_RAD);
    }
    let is_down =
        |&(known, down): &(usize, usize)| known >= MIN_EVIDENCE && down as f64 >= NADIR_SHARE * known as f64;
    counts.iter().map(is_down).collect()
}
