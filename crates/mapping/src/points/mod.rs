//! Points from matches: continued, created, completed, merged, triangulated again, and filtered.
//!
//! After Schönberger & Frahm 2016, sections 4.3 and 4.4. Proposals are made in parallel against a model that stands still
//! and applied one after another in ascending order, so that the result does not depend on threads.

mod complete;
mod create;
mod filter;

use nalgebra::Vector3;
use terrane_geometry::triangulation::{View, ray_angle_rad};

use crate::TriangulationOptions;
use crate::model::Model;

pub(crate) use complete::{complete, merge};
pub(crate) use create::{retriangulate, triangulate_image};
pub(crate) use filter::{filter, remove_weak_images};

/// Limits of a point in the units of the geometry.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// Largest reprojection error in pixels.
    pub max_error_px: f64,
    /// Smallest largest angle between two rays in radians.
    pub min_angle_rad: f64,
}

impl Limits {
    /// The limits that options ask for.
    pub fn new(options: &TriangulationOptions) -> Self {
        Self { max_error_px: options.max_error_px, min_angle_rad: options.min_angle_deg.to_radians() }
    }
}

/// A feature of a registered image as a view.
fn view(model: &Model<'_>, feature: u32) -> Option<View> {
    let image = model.cluster.image_of(feature);
    let cam_from_world = model.poses[image]?;
    Some(View { cam_from_world, camera: *model.camera_of(image), xy_px: model.cluster.xy_px(feature) })
}

/// Whether two of the features' rays meet at the point under at least this angle.
fn has_angle(model: &Model<'_>, x_in_world: &Vector3<f64>, features: &[u32], min_angle_rad: f64) -> bool {
    let center = |feature: &u32| model.poses[model.cluster.image_of(*feature)].map(|pose| pose.center());
    let centers: Vec<Vector3<f64>> = features.iter().filter_map(center).collect();
    (0..centers.len()).any(|a| {
        // Nearly every good point passes on its first and last view.
        (a + 1..centers.len())
            .rev()
            .any(|b| ray_angle_rad(&centers[a], &centers[b], x_in_world) >= min_angle_rad)
    })
}
