//! What each seam shows: how far its two submaps disagree about what they share.

use serde::{Deserialize, Serialize};
use terrane_geometry::{Sim3, so3};
use terrane_scene::{ImageId, Reconstruction};

use crate::SubmapSummary;
use crate::align::tracks;
use crate::average::Placement;
use crate::statistics::{median, rms};

/// Part of the shared points that the RMS is taken over: the farthest are mismatches.
const KEPT: f64 = 0.9;

/// Figures of one seam. Lengths are in units of the placed frame: metres when geo-referenced.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeamFigures {
    /// Images of both.
    pub num_shared_cameras: u32,
    /// RMS distance between the two centres of a shared camera.
    pub camera_distance_rms: f64,
    /// RMS rotation between the two poses of a shared camera, in degrees.
    pub camera_rotation_rms_deg: f64,
    /// Pairs of points that own a common observation.
    pub num_shared_points: u32,
    /// Median distance between the two places of a shared point.
    pub point_distance_median: f64,
    /// RMS distance between the two places of a shared point, the farthest tenth left out.
    pub point_distance_rms: f64,
}

/// How far two submaps disagree once they are placed in one world.
pub fn measure(
    a: &Reconstruction,
    b: &Reconstruction,
    world_from_a: &Sim3,
    world_from_b: &Sim3,
) -> SeamFigures {
    let cameras = tracks::shared_cameras(a, b);
    let (mut distances, mut rotations) = (Vec::new(), Vec::new());
    for camera in &cameras {
        let (in_a, in_b) = (
            world_from_a.transform_camera(&camera.cam_from_a),
            world_from_b.transform_camera(&camera.cam_from_b),
        );
        distances.push((in_a.center() - in_b.center()).norm());
        rotations.push(so3::angle_between(&in_a.rotation, &in_b.rotation).to_degrees());
    }
    let mut of_points: Vec<f64> = tracks::shared_points(a, b)
        .iter()
        .map(|(in_a, in_b)| {
            let x_a = world_from_a.transform_point(&a.points[*in_a as usize].x_in_world);
            let x_b = world_from_b.transform_point(&b.points[*in_b as usize].x_in_world);
            (x_a - x_b).norm()
        })
        .collect();
    of_points.sort_by(f64::total_cmp);
    let kept = (of_points.len() as f64 * KEPT).ceil() as usize;
    SeamFigures {
        num_shared_cameras: cameras.len() as u32,
        camera_distance_rms: rms(&distances),
        camera_rotation_rms_deg: rms(&rotations),
        num_shared_points: of_points.len() as u32,
        point_distance_median: median(&mut of_points.clone()).unwrap_or(0.0),
        point_distance_rms: rms(&of_points[..kept.min(of_points.len())]),
    }
}

/// How far the cameras of a merged or adjusted reconstruction lie from where one submap would have them, after the
/// best similarity between both: the bending that merging and adjustment took out of (or put into) the submap.
/// RMS of centres in units of the reconstruction; `None` when fewer than three cameras are in both.
pub fn bending(submap: &SubmapSummary, whole: &Reconstruction) -> Option<f64> {
    let both: Vec<(ImageId, _)> =
        submap.centers().filter(|(image, _)| whole.image(*image).is_some()).collect();
    let from: Vec<_> = both.iter().map(|(_, center)| *center).collect();
    let to: Vec<_> = both
        .iter()
        .filter_map(|(image, _)| whole.image(*image))
        .map(|image| image.cam_from_world.center())
        .collect();
    let whole_from_submap = terrane_geometry::alignment::umeyama(&from, &to, None)?;
    let left: Vec<f64> =
        from.iter().zip(&to).map(|(x, y)| (whole_from_submap.transform_point(x) - y).norm()).collect();
    Some(rms(&left))
}

/// Images that both submaps of each used seam of a component have: what adjustment goes by.
pub fn seam_images(submaps: &[SubmapSummary], placement: &Placement, component: usize) -> Vec<Vec<ImageId>> {
    placement
        .seams
        .iter()
        .filter(|seam| seam.refused.is_none())
        .filter(|seam| placement.component_of[seam.a as usize] as usize == component)
        .map(|seam| {
            let (a, b) = (&submaps[seam.a as usize], &submaps[seam.b as usize]);
            a.images.iter().map(|entry| entry.0).filter(|image| b.cam_from_submap(*image).is_some()).collect()
        })
        .collect()
}
