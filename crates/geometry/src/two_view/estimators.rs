//! The four problems of two views as the sampling loop sees them.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};

use super::pose::candidates;
use crate::alignment::rotation_from_directions;
use crate::epipolar::{
    Correspondences, Normalized, PoseProblem, RankTwo, RankTwoProblem, essential_from_pose,
    squared_sampson_error,
};
use crate::essential::essential_from_five;
use crate::fundamental::fundamental_from_seven;
use crate::homography::{TransferProblem, homography_from_four, squared_transfer_error};
use crate::linear::largest_entry;
use crate::ransac::{self, Estimator, Score};
use crate::small_lm::{self, LmOptions};

/// Local steps look at no more than this many inliers, evenly spread: enough to average noise, and quick.
const MAX_LOCAL_INLIERS: usize = 300;

/// Steps of a local refinement: the loop repeats it while it helps.
fn local_options() -> LmOptions {
    LmOptions { max_iterations: 6, cost_tolerance: 1e-5, ..Default::default() }
}

/// Every `k`-th so that at most [`MAX_LOCAL_INLIERS`] stay.
fn thinned(inliers: Vec<u32>) -> Vec<u32> {
    let stride = inliers.len().div_ceil(MAX_LOCAL_INLIERS).max(1);
    if stride == 1 { inliers } else { inliers.into_iter().step_by(stride).collect() }
}

fn chosen<const N: usize>(points: &[Vector2<f64>], sample: &[usize]) -> [Vector2<f64>; N] {
    std::array::from_fn(|k| points[sample[k]])
}

/// Scores and inliers from a squared error of (model, first, second), for each of the problems below.
macro_rules! compare_by {
    ($squared_error:expr) => {
        fn data_len(&self) -> usize {
            self.first.len()
        }

        fn score(&self, model: &Self::Model, stop_at: f64) -> Score {
            let max_squared = self.threshold * self.threshold;
            ransac::msac(self.first.len(), max_squared, stop_at, |i| {
                $squared_error(model, &self.first[i], &self.second[i])
            })
        }

        fn inliers(&self, model: &Self::Model) -> Vec<u32> {
            let max_squared = self.threshold * self.threshold;
            ransac::indices_within(self.first.len(), max_squared, |i| {
                $squared_error(model, &self.first[i], &self.second[i])
            })
        }
    };
}

pub(super) struct Essentials<'a> {
    first: &'a [Vector2<f64>],
    second: &'a [Vector2<f64>],
    threshold: f64,
}

impl<'a> Essentials<'a> {
    pub(super) fn new(first: &'a [Vector2<f64>], second: &'a [Vector2<f64>], threshold: f64) -> Option<Self> {
        (first.len() == second.len()).then_some(Self { first, second, threshold })
    }
}

impl Estimator for Essentials<'_> {
    type Model = Matrix3<f64>;

    fn sample_len(&self) -> usize {
        5
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<Matrix3<f64>>) {
        models.extend(essential_from_five(&chosen(self.first, sample), &chosen(self.second, sample)));
    }

    fn refine(&self, model: &Matrix3<f64>) -> Option<Matrix3<f64>> {
        let indices = thinned(self.inliers(model));
        if indices.len() <= 5 {
            return None;
        }
        // All four poses of an essential matrix have the same errors; any will do.
        let start = *candidates(model)?.first()?;
        let (first, second) = (self.first, self.second);
        let problem =
            PoseProblem(Correspondences { first, second, indices: &indices, loss_scale: self.threshold });
        let (pose, _) = small_lm::minimize(&problem, start, &local_options());
        Some(essential_from_pose(&pose).normalize())
    }

    compare_by!(squared_sampson_error);
}

pub(super) struct Fundamentals<'a> {
    first: &'a [Vector2<f64>],
    second: &'a [Vector2<f64>],
    threshold: f64,
}

impl<'a> Fundamentals<'a> {
    /// The threshold is in the unit before normalisation.
    pub(super) fn new(points: &'a Normalized, threshold: f64) -> Self {
        Self { first: &points.first, second: &points.second, threshold: threshold * points.scale }
    }
}

impl Estimator for Fundamentals<'_> {
    type Model = Matrix3<f64>;

    fn sample_len(&self) -> usize {
        7
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<Matrix3<f64>>) {
        models.extend(fundamental_from_seven(&chosen(self.first, sample), &chosen(self.second, sample)));
    }

    fn refine(&self, model: &Matrix3<f64>) -> Option<Matrix3<f64>> {
        let indices = thinned(self.inliers(model));
        if indices.len() <= 7 {
            return None;
        }
        let (first, second) = (self.first, self.second);
        let data = Correspondences { first, second, indices: &indices, loss_scale: self.threshold };
        let (state, _) =
            small_lm::minimize(&RankTwoProblem(data), RankTwo::nearest(model)?, &local_options());
        Some(state.matrix().normalize())
    }

    compare_by!(squared_sampson_error);
}

pub(super) struct Homographies<'a> {
    first: &'a [Vector2<f64>],
    second: &'a [Vector2<f64>],
    threshold: f64,
}

impl<'a> Homographies<'a> {
    /// The threshold is in the unit before normalisation.
    pub(super) fn new(points: &'a Normalized, threshold: f64) -> Self {
        Self { first: &points.first, second: &points.second, threshold: threshold * points.scale }
    }
}

impl Estimator for Homographies<'_> {
    type Model = Matrix3<f64>;

    fn sample_len(&self) -> usize {
        4
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<Matrix3<f64>>) {
        models.extend(homography_from_four(&chosen(self.first, sample), &chosen(self.second, sample)));
    }

    fn refine(&self, model: &Matrix3<f64>) -> Option<Matrix3<f64>> {
        let indices = thinned(self.inliers(model));
        if indices.len() <= 4 {
            return None;
        }
        let held = largest_entry(model);
        let problem = TransferProblem {
            first: self.first,
            second: self.second,
            indices: &indices,
            loss_scale: self.threshold,
            held,
        };
        Some(small_lm::minimize(&problem, *model, &local_options()).0.normalize())
    }

    compare_by!(squared_transfer_error);
}

pub(super) struct Rotations<'a> {
    first: &'a [Vector2<f64>],
    second: &'a [Vector2<f64>],
    threshold: f64,
}

impl<'a> Rotations<'a> {
    pub(super) fn new(first: &'a [Vector2<f64>], second: &'a [Vector2<f64>], threshold: f64) -> Option<Self> {
        (first.len() == second.len()).then_some(Self { first, second, threshold })
    }

    fn fit(&self, indices: impl Iterator<Item = usize> + Clone) -> Option<UnitQuaternion<f64>> {
        let direction = |point: &Vector2<f64>| point.push(1.0).normalize();
        let first: Vec<Vector3<f64>> = indices.clone().map(|i| direction(&self.first[i])).collect();
        let second: Vec<Vector3<f64>> = indices.map(|i| direction(&self.second[i])).collect();
        rotation_from_directions(&first, &second)
    }
}

impl Estimator for Rotations<'_> {
    type Model = UnitQuaternion<f64>;

    fn sample_len(&self) -> usize {
        2
    }

    fn data_len(&self) -> usize {
        self.first.len()
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<UnitQuaternion<f64>>) {
        models.extend(self.fit(sample.iter().copied()));
    }

    fn score(&self, model: &UnitQuaternion<f64>, stop_at: f64) -> Score {
        let matrix = model.to_rotation_matrix().into_inner();
        ransac::msac(self.first.len(), self.threshold * self.threshold, stop_at, |i| {
            squared_transfer_error(&matrix, &self.first[i], &self.second[i])
        })
    }

    fn refine(&self, model: &UnitQuaternion<f64>) -> Option<UnitQuaternion<f64>> {
        self.fit(self.inliers(model).into_iter().map(|i| i as usize))
    }

    fn inliers(&self, model: &UnitQuaternion<f64>) -> Vec<u32> {
        let matrix = model.to_rotation_matrix().into_inner();
        ransac::indices_within(self.first.len(), self.threshold * self.threshold, |i| {
            squared_transfer_error(&matrix, &self.first[i], &self.second[i])
        })
    }
}
