//! Matches as points: in pixels and on the plane z = 1 of each camera, likeliest first.

use nalgebra::{Matrix3, Vector2};
use terrane_geometry::Camera;
use terrane_geometry::two_view::squared_sampson_error;
use terrane_scene::{CameraRecord, FocalSource, ImagePair, Keypoint, MatchedPair, PairSummary};

use super::agreement::agreeing;
use super::models::Geometry;
use super::{Candidate, VerificationOptions};
use crate::matching::Match;

/// The usable matches of a pair, by falling quality: those that turn and grow as most do, then the others, both by the
/// ratio of their distances.
pub(super) struct Correspondences {
    /// Whether more of them turn and grow alike than by chance.
    pub(super) many_agree: bool,
    /// Feature of the first image, feature of the second.
    matches: Vec<[u32; 2]>,
    pub(super) first_px: Vec<Vector2<f64>>,
    pub(super) second_px: Vec<Vector2<f64>>,
    /// On the plane z = 1.
    pub(super) first: Vec<Vector2<f64>>,
    /// On the plane z = 1.
    pub(super) second: Vec<Vector2<f64>>,
    /// Whether each point lies in the border of its image and the match does not move.
    is_static: Vec<bool>,
    /// Whether both focal lengths are given or from EXIF.
    pub(super) is_calibrated: bool,
    /// Which focal lengths are guessed.
    pub(super) is_guessed: [bool; 2],
    /// The greatest error in pixels.
    pub(super) threshold_px: f64,
    /// The same on the plane z = 1, as the mean of both cameras.
    pub(super) threshold: f64,
    /// Focal lengths and principal points, for fundamental matrices.
    pub(super) cameras: [Camera; 2],
}

impl Correspondences {
    /// Leaves out matches of keypoints that do not exist, are not finite or lie beyond the camera's domain, and a static
    /// border where most matches move.
    pub(super) fn new(candidate: &Candidate<'_>, options: &VerificationOptions) -> Self {
        let cameras = [candidate.first.camera, candidate.second.camera];
        let is_guessed = cameras.map(|record: &CameraRecord| record.focal_source == FocalSource::Guess);
        let threshold_px = options.max_error_px;
        let (likeliest_first, many_agree) = likeliest_first(candidate);
        let mut points = Self {
            many_agree,
            matches: Vec::new(),
            first_px: Vec::new(),
            second_px: Vec::new(),
            first: Vec::new(),
            second: Vec::new(),
            is_static: Vec::new(),
            is_calibrated: is_guessed == [false; 2],
            is_guessed,
            threshold_px,
            threshold: cameras
                .iter()
                .map(|record| record.camera.normalized_from_px(threshold_px))
                .sum::<f64>()
                / 2.0,
            cameras: cameras.map(|record| record.camera),
        };
        for (indices, [a, b]) in likeliest_first {
            points.push(indices, a, b, options.watermark_border);
        }
        points.drop_static_border();
        points
    }

    fn push(&mut self, indices: [u32; 2], a: &Keypoint, b: &Keypoint, border: f64) {
        let pixel = |keypoint: &Keypoint| Vector2::new(f64::from(keypoint.x_px), f64::from(keypoint.y_px));
        let (a_px, b_px) = (pixel(a), pixel(b));
        let finite = |point: &Vector2<f64>| point.x.is_finite() && point.y.is_finite();
        let rays = (self.cameras[0].unproject(&a_px), self.cameras[1].unproject(&b_px));
        let (Some(a), Some(b)) = rays else { return };
        if !(finite(&a) && finite(&b)) {
            return;
        }
        let in_border = |camera: &Camera, point: &Vector2<f64>| {
            let (width, height) = (f64::from(camera.width_px), f64::from(camera.height_px));
            let margin = border * (width * width + height * height).sqrt();
            point.x < margin || point.y < margin || point.x > width - margin || point.y > height - margin
        };
        let stays = (a_px - b_px).norm() <= self.threshold_px;
        let bordered = in_border(&self.cameras[0], &a_px) && in_border(&self.cameras[1], &b_px);
        self.matches.push(indices);
        self.first_px.push(a_px);
        self.second_px.push(b_px);
        self.first.push(a);
        self.second.push(b);
        self.is_static.push(stays && bordered);
    }

    /// Matches that stay in the border are no part of the scene when most others move: a time stamp would outvote a small
    /// overlap. Where hardly anything moves they may be the scene itself, and are kept.
    fn drop_static_border(&mut self) {
        let stays = |i: usize| (self.first_px[i] - self.second_px[i]).norm() <= self.threshold_px;
        let num_staying = (0..self.len()).filter(|&i| stays(i)).count();
        if 2 * num_staying >= self.len() || !self.is_static.contains(&true) {
            return;
        }
        let keep: Vec<usize> = (0..self.len()).filter(|&i| !self.is_static[i]).collect();
        self.matches = keep.iter().map(|&i| self.matches[i]).collect();
        for points in [&mut self.first_px, &mut self.second_px, &mut self.first, &mut self.second] {
            *points = keep.iter().map(|&i| points[i]).collect();
        }
        self.is_static = vec![false; keep.len()];
    }

    /// How many usable matches there are.
    pub(super) fn len(&self) -> usize {
        self.matches.len()
    }

    /// At most `count` correspondences, evenly spread over the order of quality, ascending.
    pub(super) fn spread(&self, count: usize) -> Vec<u32> {
        spread(self.len(), count).map(|i| i as u32).collect()
    }

    /// Correspondences that agree with a matrix on the plane z = 1, ascending.
    pub(super) fn within(&self, matrix: &Matrix3<f64>) -> Vec<u32> {
        let limit = self.threshold * self.threshold;
        let agrees = |&i: &usize| squared_sampson_error(matrix, &self.first[i], &self.second[i]) < limit;
        (0..self.len()).filter(agrees).map(|i| i as u32).collect()
    }

    /// Mean squared error of these under a matrix on the plane z = 1, as a share of the squared threshold; infinite for none.
    pub(super) fn mean_squared_error(&self, matrix: &Matrix3<f64>, indices: &[u32]) -> f64 {
        let error =
            |&i: &u32| squared_sampson_error(matrix, &self.first[i as usize], &self.second[i as usize]);
        let sum: f64 = indices.iter().map(error).sum();
        let share = sum / (indices.len() as f64 * self.threshold * self.threshold);
        if share.is_finite() { share } else { f64::INFINITY }
    }

    /// Correspondences that agree with a matrix in pixels, ascending.
    pub(super) fn within_px(&self, matrix: &Matrix3<f64>) -> Vec<u32> {
        let limit = self.threshold_px * self.threshold_px;
        let agrees =
            |&i: &usize| squared_sampson_error(matrix, &self.first_px[i], &self.second_px[i]) < limit;
        (0..self.len()).filter(agrees).map(|i| i as u32).collect()
    }

    /// An epipolar matrix on the planes z = 1 as one in pixels without distortion; `None` for a focal length of zero.
    pub(super) fn in_pixels(&self, matrix: &Matrix3<f64>) -> Option<Matrix3<f64>> {
        let [first, second] = self.cameras.map(|camera| intrinsic_matrix(&camera).try_inverse());
        Some(second?.transpose() * matrix * first?)
    }

    /// An epipolar matrix in pixels without distortion as one on the planes z = 1.
    pub(super) fn on_planes(&self, matrix: &Matrix3<f64>) -> Matrix3<f64> {
        let [first, second] = self.cameras.map(|camera| intrinsic_matrix(&camera));
        second.transpose() * matrix * first
    }

    /// How many of these stay at their place in the border.
    pub(super) fn num_static(&self, indices: &[u32]) -> usize {
        indices.iter().filter(|&&i| self.is_static[i as usize]).count()
    }

    /// The result, with matches ascending.
    pub(super) fn matched_pair(&self, pair: ImagePair, geometry: &Geometry) -> MatchedPair {
        let mut matches: Vec<[u32; 2]> = geometry.inliers.iter().map(|&i| self.matches[i as usize]).collect();
        matches.sort_unstable();
        matches.dedup();
        let summary = PairSummary {
            pair,
            kind: geometry.kind,
            num_inliers: matches.len() as u32,
            second_from_first: geometry.second_from_first,
            median_angle_rad: geometry.median_angle_rad,
        };
        MatchedPair { summary, matches }
    }
}

/// Matches of keypoints that exist, likeliest first, and whether more of them turn and grow alike than by chance.
fn likeliest_first<'a>(candidate: &Candidate<'a>) -> (Vec<([u32; 2], [&'a Keypoint; 2])>, bool) {
    let mut order: Vec<_> = candidate.matches.iter().collect();
    order.sort_by(|a, b| a.ratio.total_cmp(&b.ratio).then((a.first, a.second).cmp(&(b.first, b.second))));
    let ends = |found: &Match| {
        let first = candidate.first.keypoints.get(found.first as usize)?;
        let second = candidate.second.keypoints.get(found.second as usize)?;
        Some(([found.first, found.second], [first, second]))
    };
    let found: Vec<_> = order.into_iter().filter_map(ends).collect();
    let keypoints: Vec<_> = found.iter().map(|(_, [a, b])| (*a, *b)).collect();
    let Some(agrees) = agreeing(&keypoints) else { return (found, false) };
    let of = |wanted: bool| found.iter().zip(&agrees).filter(move |(_, agrees)| **agrees == wanted);
    (of(true).chain(of(false)).map(|(found, _)| *found).collect(), true)
}

/// The matrix that takes points of the plane z = 1 to pixels, without distortion.
fn intrinsic_matrix(camera: &Camera) -> Matrix3<f64> {
    let (focal, center) = (camera.focal_px(), camera.principal_point_px());
    Matrix3::new(focal.x, 0.0, center.x, 0.0, focal.y, center.y, 0.0, 0.0, 1.0)
}

/// At most `count` of `len` places, evenly spread.
pub(super) fn spread(len: usize, count: usize) -> impl Iterator<Item = usize> {
    let taken = len.min(count);
    (0..taken).map(move |at| at * len / taken)
}
