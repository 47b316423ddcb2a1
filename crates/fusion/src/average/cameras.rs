//! One pose per photograph: rotation averaging, then position averaging with one scale per submap.

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use terrane_geometry::{Rigid3, so3};
use terrane_optim::position_averaging::{self, PositionAveragingOptions, RelativePosition};
use terrane_optim::rotation_averaging::{self, RelativeRotation, RotationAveragingOptions};
use terrane_scene::RegisteredImage;

use super::{Placement, fuse};
use crate::SubmapSummary;
use crate::statistics::median;

/// How cameras are averaged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraAverageOptions {
    /// Largest turn of a camera away from its submaps' mean, in degrees; beyond it the mean is kept. Default 5.
    pub max_rotation_deg: f64,
    /// Largest move of a camera away from its submaps' mean, as a fraction of the median depth; beyond it the mean
    /// is kept. Default 0.1.
    pub max_relative_move: f64,
}

impl Default for CameraAverageOptions {
    fn default() -> Self {
        Self { max_rotation_deg: 5.0, max_relative_move: 0.1 }
    }
}

/// What averaging a component's cameras did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CameraAverageReport {
    /// Cameras.
    pub num_cameras: u32,
    /// Cameras in more than one submap.
    pub num_shared: u32,
    /// Relative poses that went in.
    pub num_edges: u32,
    /// Median disagreement of the relative rotations with the averaged ones, in degrees.
    pub median_rotation_error_deg: f64,
    /// Median move of the cameras away from their submaps' mean, in units of the world.
    pub median_move: f64,
    /// Cameras whose averaged pose strayed too far, so that the submaps' mean was kept.
    pub num_kept: u32,
}

/// Cameras of one component, in its world.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraAverages {
    /// Poses, ascending by image.
    pub images: Vec<RegisteredImage>,
    /// How it went.
    pub report: CameraAverageReport,
}

/// Standard deviation of a relative position within a submap, as a fraction of the median depth.
const RELATIVE_POSITION_SIGMA: f64 = 0.005;

/// Averages the cameras of one component: rotations over all links of all submaps, then positions with one unknown
/// scale per submap, both robust. The frame is that of the placement, and a camera that averaging carries far from
/// where its submaps have it stays there.
pub fn average_cameras(
    submaps: &[SubmapSummary],
    placement: &Placement,
    component: usize,
    options: &CameraAverageOptions,
) -> CameraAverages {
    let Some(found) = placement.components.get(component) else { return CameraAverages::default() };
    let mut images = fuse::fused_images(submaps, &found.submaps, &placement.world_from_submap);
    let links = component_links(submaps, &found.submaps, &images);
    let mut report = CameraAverageReport {
        num_cameras: images.len() as u32,
        num_shared: num_shared(submaps, &found.submaps),
        num_edges: links.len() as u32,
        ..Default::default()
    };
    let depth = world_depth(submaps, &found.submaps, placement);
    let start = images.clone();
    average_rotations(&mut images, &links, options, &mut report);
    average_positions(&mut images, &start, &links, options.max_relative_move * depth, &mut report);
    let mut moves: Vec<f64> = images
        .iter()
        .zip(&start)
        .map(|(after, before)| (after.cam_from_world.center() - before.cam_from_world.center()).norm())
        .collect();
    report.median_move = median(&mut moves).unwrap_or(0.0);
    CameraAverages { images, report }
}

/// Two cameras of one submap, by their places in the component's images.
struct Link {
    from: u32,
    to: u32,
    submap: u32,
    cam_from_submap: [Rigid3; 2],
    weight: f64,
    sigma: f64,
}

fn component_links(submaps: &[SubmapSummary], members: &[u32], images: &[RegisteredImage]) -> Vec<Link> {
    let place = |image| images.binary_search_by_key(&image, |entry: &RegisteredImage| entry.image).ok();
    let mut links = Vec::new();
    for number in members {
        let submap = &submaps[*number as usize];
        for link in &submap.links {
            let (Some(first), Some(second)) =
                (submap.images.get(link.first as usize), submap.images.get(link.second as usize))
            else {
                continue;
            };
            let (Some(from), Some(to)) = (place(first.0), place(second.0)) else { continue };
            links.push(Link {
                from: from as u32,
                to: to as u32,
                submap: *number,
                cam_from_submap: [first.2, second.2],
                weight: f64::from(link.shared_points).sqrt(),
                sigma: RELATIVE_POSITION_SIGMA * submap.median_depth,
            });
        }
    }
    links
}

fn num_shared(submaps: &[SubmapSummary], members: &[u32]) -> u32 {
    let mut all: Vec<_> = members
        .iter()
        .flat_map(|submap| submaps[*submap as usize].images.iter().map(|entry| entry.0))
        .collect();
    all.sort_unstable();
    all.chunk_by(|a, b| a == b).filter(|copies| copies.len() > 1).count() as u32
}

/// Median of the submaps' median depths, in the world.
fn world_depth(submaps: &[SubmapSummary], members: &[u32], placement: &Placement) -> f64 {
    let depth = |submap: &u32| {
        placement.world_from_submap[*submap as usize].scale * submaps[*submap as usize].median_depth
    };
    median(&mut members.iter().map(depth).collect::<Vec<_>>()).unwrap_or(0.0)
}

/// Replaces the rotations by averaged ones, turned as a whole to where the cameras are.
fn average_rotations(
    images: &mut [RegisteredImage],
    links: &[Link],
    options: &CameraAverageOptions,
    report: &mut CameraAverageReport,
) {
    let edges: Vec<RelativeRotation> = links
        .iter()
        .map(|link| RelativeRotation {
            from: link.from,
            to: link.to,
            to_from_from: link.cam_from_submap[1].rotation * link.cam_from_submap[0].rotation.inverse(),
            weight: link.weight,
        })
        .collect();
    let averages = rotation_averaging::average(images.len(), &edges, &RotationAveragingOptions::default());
    let mut errors: Vec<f64> =
        averages.edge_error_rad.iter().copied().filter(|error| error.is_finite()).collect();
    report.median_rotation_error_deg = median(&mut errors).unwrap_or(0.0).to_degrees();
    let averaged: Vec<Option<UnitQuaternion<f64>>> = averages
        .rotations
        .iter()
        .zip(&averages.component)
        .map(|(rotation, component)| rotation.filter(|_| *component == 0))
        .collect();
    let turns: Vec<UnitQuaternion<f64>> = images
        .iter()
        .zip(&averaged)
        .filter_map(|(image, averaged)| Some(averaged.as_ref()?.inverse() * image.cam_from_world.rotation))
        .collect();
    let Some(old_from_new) = fuse::mean_rotation(&turns) else { return };
    for (image, averaged) in images.iter_mut().zip(averaged) {
        let Some(averaged) = averaged else { continue };
        let rotation = averaged * old_from_new;
        if rotation.angle_to(&image.cam_from_world.rotation).to_degrees() <= options.max_rotation_deg {
            let center = image.cam_from_world.center();
            image.cam_from_world = Rigid3::from_rotation_and_center(rotation, &center);
        } else {
            report.num_kept += 1;
        }
    }
}

/// Replaces the centres by averaged ones, moved and scaled as a whole to where the cameras are.
fn average_positions(
    images: &mut [RegisteredImage],
    start: &[RegisteredImage],
    links: &[Link],
    max_move: f64,
    report: &mut CameraAverageReport,
) {
    let edges: Vec<RelativePosition> = links
        .iter()
        .map(|link| RelativePosition {
            from: link.from,
            to: link.to,
            offset_in_world: offset_in_world(images, link),
            group: Some(link.submap),
            sigma: link.sigma,
        })
        .collect();
    let averages =
        position_averaging::average(images.len(), &edges, &[], &PositionAveragingOptions::default());
    let pairs: Vec<(Vector3<f64>, Vector3<f64>)> = averages
        .positions
        .iter()
        .zip(&averages.component)
        .zip(start)
        .filter(|((_, component), _)| **component == 0)
        .filter_map(|((position, _), before)| Some(((*position)?, before.cam_from_world.center())))
        .collect();
    let Some((scale, shift)) = scale_and_shift(&pairs) else { return };
    for (at, image) in images.iter_mut().enumerate() {
        let Some(position) = averages.positions[at].filter(|_| averages.component[at] == 0) else { continue };
        let center = scale * position + shift;
        if (center - start[at].cam_from_world.center()).norm() <= max_move {
            image.cam_from_world = Rigid3::from_rotation_and_center(image.cam_from_world.rotation, &center);
        } else {
            report.num_kept += 1;
        }
    }
}

/// From the first camera of a link to the second, turned into the world by half of each one's averaged rotation.
fn offset_in_world(images: &[RegisteredImage], link: &Link) -> Vector3<f64> {
    let offset = link.cam_from_submap[1].center() - link.cam_from_submap[0].center();
    let turn = |place: u32, cam_from_submap: &Rigid3| {
        images[place as usize].cam_from_world.rotation.inverse() * cam_from_submap.rotation
    };
    let (first, second) =
        (turn(link.from, &link.cam_from_submap[0]), turn(link.to, &link.cam_from_submap[1]));
    let half = so3::exp(&(0.5 * so3::log(&(second * first.inverse()))));
    (half * first) * offset
}

/// The scale and shift that bring the first of each pair nearest to the second, by reweighted least squares.
fn scale_and_shift(pairs: &[(Vector3<f64>, Vector3<f64>)]) -> Option<(f64, Vector3<f64>)> {
    let mut weights = vec![1.0; pairs.len()];
    let mut result = None;
    for _ in 0..10 {
        let total: f64 = weights.iter().sum();
        let mean = |pick: fn(&(Vector3<f64>, Vector3<f64>)) -> Vector3<f64>| {
            pairs.iter().zip(&weights).map(|(pair, weight)| *weight * pick(pair)).sum::<Vector3<f64>>()
                / total
        };
        let (mean_from, mean_to) = (mean(|pair| pair.0), mean(|pair| pair.1));
        let (mut along, mut spread) = (0.0, 0.0);
        for ((from, to), weight) in pairs.iter().zip(&weights) {
            along += weight * (from - mean_from).dot(&(to - mean_to));
            spread += weight * (from - mean_from).norm_squared();
        }
        let scale = along / spread;
        if !(scale > 0.0 && scale.is_finite()) {
            return result;
        }
        let shift = mean_to - scale * mean_from;
        result = Some((scale, shift));
        let distances: Vec<f64> = pairs.iter().map(|(from, to)| (scale * from + shift - to).norm()).collect();
        let typical = median(&mut distances.clone()).unwrap_or(0.0);
        if typical <= 0.0 {
            break;
        }
        weights =
            distances.iter().map(|distance| 1.0 / (1.0 + (distance / (2.0 * typical)).powi(2))).collect();
    }
    result
}
