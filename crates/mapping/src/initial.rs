//! The pair that a submap starts from.
//!
//! Pairs are ranked by the tracks that they share with further images, weighted by the angle under which they see the
//! scene, with planes and guessed focal lengths behind (Schönberger & Frahm 2016, section 4.1, rank by the number of
//! matches alone). Each is then judged by the points that it really gives.

use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use terrane_geometry::ransac::RansacOptions;
use terrane_geometry::triangulation::{View, ray_angle_rad, triangulate};
use terrane_geometry::{Camera, Rigid3, Seed, two_view};
use terrane_scene::PairKind;

use crate::cluster::Cluster;
use crate::{InitialPairOptions, TriangulationOptions};

/// Two cameras and their points.
pub(crate) struct Start {
    /// `cam_from_world` of the pair's second image; the first image's frame is the world.
    pub second_from_first: Rigid3,
    /// Positions with the two features of each.
    pub points: Vec<(Vector3<f64>, [u32; 2])>,
}

/// How strict a start must be; see [`InitialPairOptions`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Strictness {
    pub min_points: usize,
    pub min_median_angle_rad: f64,
    pub max_forward_motion: f64,
}

impl Strictness {
    /// Strict first, then looser: half the angle, a quarter of the angle and half the points, and motion along the axis.
    pub fn ladder(options: &InitialPairOptions) -> [Self; 3] {
        let angle_rad = options.min_median_angle_deg.to_radians();
        let level = |points: usize, angle: f64, forward: f64| Self {
            min_points: (options.min_points / points).max(10),
            min_median_angle_rad: angle_rad * angle,
            max_forward_motion: forward,
        };
        let forward = options.max_forward_motion;
        [level(1, 1.0, forward), level(1, 0.5, forward), level(3, 0.25, 1.0)]
    }
}

/// Places in `cluster.pairs` of the pairs that may start a submap, most promising first. `taken` images are in another.
pub(crate) fn candidates(cluster: &Cluster<'_>, taken: &[bool]) -> Vec<usize> {
    let mut ranked: Vec<(f64, usize)> = (0..cluster.pairs.len())
        .into_par_iter()
        .filter(|&at| {
            let pair = &cluster.pairs[at];
            let free = !taken[pair.first] && !taken[pair.second];
            free && pair.source.summary.kind.has_baseline() && pair.source.matches.len() >= 10
        })
        .map(|at| (promise(cluster, at, taken), at))
        .collect();
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    ranked.into_iter().map(|entry| entry.1).collect()
}

fn promise(cluster: &Cluster<'_>, at: usize, taken: &[bool]) -> f64 {
    let pair = &cluster.pairs[at];
    let leads_on = |feature: u32, other: u32| {
        cluster.neighbours(feature).iter().any(|&next| next != other && !taken[cluster.image_of(next)])
    };
    let shared = cluster.matches(pair).filter(|&(a, b)| leads_on(a, b) || leads_on(b, a)).count();
    let angle_deg = pair.source.summary.median_angle_rad.to_degrees();
    // Full marks from 12 to 45 degrees: less gives no depth, more gives few true matches.
    let angle = if angle_deg.is_finite() {
        (angle_deg / 12.0).min(45.0 / angle_deg.max(45.0)).clamp(0.02, 1.0)
    } else {
        0.1
    };
    let kind = if pair.source.summary.kind == PairKind::Planar { 0.3 } else { 1.0 };
    // Tracks that go on count fully, the others a little: a cluster of two images has none that do.
    (shared as f64 + 0.1 * pair.source.matches.len() as f64) * angle * kind
}

/// The start that a pair gives, or why it gives none.
pub(crate) fn start(
    cluster: &Cluster<'_>,
    at: usize,
    cameras: &[Camera],
    (options, points): (&InitialPairOptions, &TriangulationOptions),
    seed: Seed,
) -> Result<Start, String> {
    let pair = &cluster.pairs[at];
    let (camera_a, camera_b) =
        (&cameras[cluster.camera_of[pair.first]], &cameras[cluster.camera_of[pair.second]]);
    let mut features: Vec<[u32; 2]> = Vec::new();
    let (mut first, mut second): (Vec<Vector2<f64>>, Vec<Vector2<f64>>) = (Vec::new(), Vec::new());
    for (a, b) in cluster.matches(pair) {
        let rays = (camera_a.unproject(&cluster.xy_px(a)), camera_b.unproject(&cluster.xy_px(b)));
        if let (Some(x), Some(y)) = rays {
            features.push([a, b]);
            first.push(x);
            second.push(y);
        }
    }
    let threshold = 0.5
        * (camera_a.normalized_from_px(options.max_error_px)
            + camera_b.normalized_from_px(options.max_error_px));
    let ransac = RansacOptions { confidence: 0.999_99, ..RansacOptions::default() };
    let essential = two_view::estimate_essential(&first, &second, threshold, &ransac, seed)
        .ok_or("its matches fit no essential matrix")?;
    let pose = two_view::pose_from_essential(&essential.model, &first, &second, &essential.inliers)
        .ok_or("its matches give no relative pose with points in front of both cameras")?;
    let second_from_first = pose.second_from_first;
    let limits = (options.max_error_px, points.min_angle_deg.to_radians());
    let triangulated: Vec<Option<Vector3<f64>>> = features
        .par_iter()
        .with_min_len(64)
        .map(|&[a, b]| {
            let xy_px = [cluster.xy_px(a), cluster.xy_px(b)];
            point([(Rigid3::identity(), camera_a), (second_from_first, camera_b)], xy_px, limits)
        })
        .collect();
    let points =
        triangulated.into_iter().zip(features).filter_map(|(x, features)| Some((x?, features))).collect();
    Ok(Start { second_from_first, points })
}

/// The point of one match, when both cameras see it where they should and under enough angle.
fn point(
    cameras: [(Rigid3, &Camera); 2],
    xy_px: [Vector2<f64>; 2],
    (max_error_px, min_angle_rad): (f64, f64),
) -> Option<Vector3<f64>> {
    let views = [0, 1].map(|k| View { cam_from_world: cameras[k].0, camera: *cameras[k].1, xy_px: xy_px[k] });
    let x_in_world = triangulate(&views)?;
    for view in &views {
        let seen = view.camera.project(&view.cam_from_world.transform_point(&x_in_world))?;
        let error_px = (seen - view.xy_px).norm();
        if error_px.is_nan() || error_px > max_error_px {
            return None;
        }
    }
    let angle_rad = ray_angle_rad(&cameras[0].0.center(), &cameras[1].0.center(), &x_in_world);
    (angle_rad >= min_angle_rad).then_some(x_in_world)
}

/// Why a start is not good enough, or `None` when it is.
pub(crate) fn weakness(start: &Start, strictness: &Strictness) -> Option<String> {
    let found = start.points.len();
    if found < strictness.min_points {
        return Some(format!("it gives {found} points, {} are needed", strictness.min_points));
    }
    let center = start.second_from_first.center();
    let forward = (center.normalize().z).abs();
    if forward > strictness.max_forward_motion {
        return Some("the camera moved along its optical axis".to_owned());
    }
    let mut angles: Vec<f64> =
        start.points.iter().map(|(x, _)| ray_angle_rad(&Vector3::zeros(), &center, x)).collect();
    angles.sort_unstable_by(f64::total_cmp);
    let median_rad = angles[angles.len() / 2];
    if median_rad < strictness.min_median_angle_rad {
        let needed_deg = strictness.min_median_angle_rad.to_degrees();
        return Some(format!(
            "its rays meet under {:.1} degrees, {needed_deg:.1} are needed",
            median_rad.to_degrees()
        ));
    }
    None
}
