//! What the cameras see of the points, and which keypoints are matched.

use nalgebra::Vector3;
use rand::Rng;
use rayon::prelude::*;
use terrane_geometry::Rigid3;
use terrane_scene::{
    CameraId, ImageId, ImagePair, MatchedPair, Observation, PairKind, PairSummary, Reconstruction,
    RegisteredImage,
};

use super::layout::{normal, uniform};
use super::{SceneOptions, SyntheticImage};

/// The farthest that a point is detected, in metres.
const FARTHEST_M: f64 = 400.0;

/// The photographs, with noisy keypoints in an order of their own.
pub(super) fn images(
    options: &SceneOptions,
    poses: &[Rigid3],
    points: &[Vector3<f64>],
) -> Vec<SyntheticImage> {
    poses.par_iter().enumerate().map(|(index, pose)| image(options, index, pose, points)).collect()
}

fn image(options: &SceneOptions, index: usize, pose: &Rigid3, points: &[Vector3<f64>]) -> SyntheticImage {
    let rng = &mut options.seed.derive("keypoints").item(&[index as u64]).rng();
    let camera = &options.camera;
    let mut seen = Vec::new();
    for (point, x_in_world) in points.iter().enumerate() {
        let x_in_cam = pose.transform_point(x_in_world);
        if x_in_cam.z < 0.1 || x_in_cam.norm() > FARTHEST_M {
            continue;
        }
        let Some(xy_px) = camera.project(&x_in_cam) else { continue };
        let inside = xy_px.x > 0.0
            && xy_px.y > 0.0
            && xy_px.x < f64::from(camera.width_px)
            && xy_px.y < f64::from(camera.height_px);
        if inside && uniform(rng, 0.0, 1.0) >= options.miss_fraction {
            let x_px = xy_px.x + options.noise_px * normal(rng);
            let y_px = xy_px.y + options.noise_px * normal(rng);
            seen.push(([x_px as f32, y_px as f32], point as u32));
        }
    }
    shuffle(&mut seen, rng);
    SyntheticImage {
        image: ImageId::from_index(index),
        camera: CameraId(0),
        keypoints_px: seen.iter().map(|entry| entry.0).collect(),
        colors: seen.iter().map(|entry| color_of(entry.1)).collect(),
        point_of_keypoint: seen.iter().map(|entry| entry.1).collect(),
    }
}

fn color_of(point: u32) -> [u8; 3] {
    let [a, b, c, _] = point.wrapping_mul(2_654_435_761).to_le_bytes();
    [a, b, c]
}

fn shuffle<T>(items: &mut [T], rng: &mut impl Rng) {
    for last in (1..items.len()).rev() {
        let other = (rng.next_u64() % (last as u64 + 1)) as usize;
        items.swap(last, other);
    }
}

/// Every pair with enough matches.
pub(super) fn pairs(
    options: &SceneOptions,
    poses: &[Rigid3],
    points: &[Vector3<f64>],
    images: &[SyntheticImage],
) -> Vec<MatchedPair> {
    let keypoint_of_point: Vec<Vec<(u32, u32)>> = images.iter().map(by_point).collect();
    (0..images.len())
        .into_par_iter()
        .flat_map_iter(|first| {
            let keypoint_of_point = &keypoint_of_point;
            (first + 1..images.len()).filter_map(move |second| {
                let shared = join(&keypoint_of_point[first], &keypoint_of_point[second]);
                pair(options, poses, points, (first, second), shared, images)
            })
        })
        .collect()
}

fn by_point(image: &SyntheticImage) -> Vec<(u32, u32)> {
    let mut list: Vec<_> =
        image.point_of_keypoint.iter().enumerate().map(|(at, point)| (*point, at as u32)).collect();
    list.sort_unstable();
    list
}

/// (point, keypoint, keypoint) of the points in both ascending lists.
fn join(first: &[(u32, u32)], second: &[(u32, u32)]) -> Vec<(u32, u32, u32)> {
    let mut shared = Vec::new();
    let mut at = 0;
    for &(point, keypoint) in first {
        while at < second.len() && second[at].0 < point {
            at += 1;
        }
        if at < second.len() && second[at].0 == point {
            shared.push((point, keypoint, second[at].1));
        }
    }
    shared
}

fn pair(
    options: &SceneOptions,
    poses: &[Rigid3],
    points: &[Vector3<f64>],
    (first, second): (usize, usize),
    shared: Vec<(u32, u32, u32)>,
    images: &[SyntheticImage],
) -> Option<MatchedPair> {
    if shared.len() < options.min_matches {
        return None;
    }
    let rng = &mut options.seed.derive("pair").item(&[first as u64, second as u64]).rng();
    let mut matches: Vec<[u32; 2]> = shared.iter().map(|&(_, a, b)| [a, b]).collect();
    let keypoints_in_second = images[second].keypoints_px.len() as u64;
    for entry in &mut matches {
        if uniform(rng, 0.0, 1.0) < options.outlier_fraction {
            entry[1] = (rng.next_u64() % keypoints_in_second) as u32;
        }
    }
    matches.sort_unstable();
    matches.dedup_by_key(|entry| entry[0]);
    let summary = summary(options, poses, points, (first, second), &shared, rng)?;
    Some(MatchedPair { summary: PairSummary { num_inliers: matches.len() as u32, ..summary }, matches })
}

fn summary(
    options: &SceneOptions,
    poses: &[Rigid3],
    points: &[Vector3<f64>],
    (first, second): (usize, usize),
    shared: &[(u32, u32, u32)],
    rng: &mut impl Rng,
) -> Option<PairSummary> {
    let (a, b) = (poses[first].center(), poses[second].center());
    let mut angles: Vec<f64> = shared
        .iter()
        .map(|&(point, _, _)| (points[point as usize] - a).angle(&(points[point as usize] - b)))
        .collect();
    angles.sort_unstable_by(f64::total_cmp);
    let turned = poses[second] * poses[first].inverse();
    let sigma = options.pair_rotation_sigma_rad;
    let error = Vector3::new(normal(rng), normal(rng), normal(rng)) * sigma;
    let rotation = terrane_geometry::so3::exp(&error) * turned.rotation;
    let has_baseline = turned.translation.norm() > 1e-9;
    let translation = if has_baseline { turned.translation.normalize() } else { Vector3::zeros() };
    Some(PairSummary {
        pair: ImagePair::new(ImageId::from_index(first), ImageId::from_index(second))?,
        kind: if has_baseline { PairKind::Calibrated } else { PairKind::Panoramic },
        num_inliers: shared.len() as u32,
        second_from_first: Some(Rigid3::new(rotation, translation)),
        median_angle_rad: angles[angles.len() / 2],
    })
}

/// The true reconstruction; points that fewer than two photographs detect are left out.
pub(super) fn truth(
    options: &SceneOptions,
    poses: &[Rigid3],
    points: &[Vector3<f64>],
    images: &[SyntheticImage],
) -> Reconstruction {
    let mut tracks: Vec<Vec<Observation>> = vec![Vec::new(); points.len()];
    for image in images {
        for (feature, (point, xy_px)) in image.point_of_keypoint.iter().zip(&image.keypoints_px).enumerate() {
            tracks[*point as usize].push(Observation {
                image: image.image,
                feature: feature as u32,
                x_px: xy_px[0],
                y_px: xy_px[1],
            });
        }
    }
    let mut truth = Reconstruction { cameras: vec![(CameraId(0), options.camera)], ..Default::default() };
    truth.images = poses
        .iter()
        .enumerate()
        .map(|(index, pose)| RegisteredImage {
            image: ImageId::from_index(index),
            camera: CameraId(0),
            cam_from_world: *pose,
        })
        .collect();
    for (point, track) in tracks.iter().enumerate() {
        if track.len() >= 2 {
            truth.push_point(points[point], color_of(point as u32), track);
        }
    }
    truth
}
