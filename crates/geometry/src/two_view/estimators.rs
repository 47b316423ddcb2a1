//! The four problems of two views as the sampling loop sees them.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};

use super::columns::Columns;
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

/// Models of samples are screened on no more than this many correspondences, evenly spread.
const MAX_SCREENED: usize = 512;

/// A dominant rotation is fitted to no more than about this many correspondences, evenly spread.
const MAX_FITTED: usize = 150;

/// How thoroughly a model is refined.
#[derive(Clone, Copy)]
struct Effort {
    /// Inliers looked at, evenly spread: enough to average noise, and quick.
    max_inliers: usize,
    max_steps: u32,
}

/// On the way: the loop repeats it while it helps.
const BRIEF: Effort = Effort { max_inliers: 120, max_steps: 3 };
/// At the end.
const FULL: Effort = Effort { max_inliers: 300, max_steps: 6 };

impl Effort {
    fn options(self) -> LmOptions {
        LmOptions { max_iterations: self.max_steps, cost_tolerance: 1e-4, ..Default::default() }
    }

    /// Every `k`-th so that at most as many as wanted stay.
    fn thinned(self, inliers: Vec<u32>) -> Vec<u32> {
        let stride = inliers.len().div_ceil(self.max_inliers).max(1);
        if stride == 1 { inliers } else { inliers.into_iter().step_by(stride).collect() }
    }
}

fn chosen<const N: usize>(points: &[Vector2<f64>], sample: &[usize]) -> [Vector2<f64>; N] {
    std::array::from_fn(|k| points[sample[k]])
}

/// Scores and inliers from a squared error of (model, first, second), for each of the problems below.
macro_rules! compare_by {
    ($squared_error:expr, $screened:ident) => {
        fn data_len(&self) -> usize {
            self.first.len()
        }

        fn score(&self, model: &Self::Model, stop_at: f64) -> Score {
            let max_squared = self.threshold * self.threshold;
            ransac::msac(self.first.len(), max_squared, stop_at, |i| {
                $squared_error(model, &self.first[i], &self.second[i])
            })
        }

        fn screen(&self, model: &Self::Model, stop_at: f64) -> Score {
            self.columns.$screened(model, self.threshold, stop_at)
        }

        fn inliers(&self, model: &Self::Model) -> Vec<u32> {
            let max_squared = self.threshold * self.threshold;
            ransac::indices_within(self.first.len(), max_squared, |i| {
                $squared_error(model, &self.first[i], &self.second[i])
            })
        }

        fn min_gain(&self) -> f64 {
            1e-3
        }

        fn refine(&self, model: &Self::Model) -> Option<Self::Model> {
            self.refined(model, FULL)
        }

        fn refine_briefly(&self, model: &Self::Model) -> Option<Self::Model> {
            self.refined(model, BRIEF)
        }
    };
}

pub(super) struct Essentials<'a> {
    first: &'a [Vector2<f64>],
    second: &'a [Vector2<f64>],
    columns: Columns,
    threshold: f64,
}

impl<'a> Essentials<'a> {
    pub(super) fn new(first: &'a [Vector2<f64>], second: &'a [Vector2<f64>], threshold: f64) -> Option<Self> {
        let columns = Columns::spread(first, second, MAX_SCREENED);
        (first.len() == second.len()).then_some(Self { first, second, columns, threshold })
    }

    fn refined(&self, model: &Matrix3<f64>, effort: Effort) -> Option<Matrix3<f64>> {
        let indices = effort.thinned(self.inliers(model));
        if indices.len() <= 5 {
            return None;
        }
        // All four poses of an essential matrix have the same errors; any will do.
        let start = *candidates(model)?.first()?;
        let (first, second) = (self.first, self.second);
        let problem =
            PoseProblem(Correspondences { first, second, indices: &indices, loss_scale: self.threshold });
        let (pose, _) = small_lm::minimize(&problem, start, &effort.options());
        Some(essential_from_pose(&pose).normalize())
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

    compare_by!(squared_sampson_error, sampson);
}

pub(super) struct Fundamentals<'a> {
    first: &'a [Vector2<f64>],
    second: &'a [Vector2<f64>],
    columns: Columns,
    threshold: f64,
}

impl<'a> Fundamentals<'a> {
    /// The threshold is in the unit before normalisation.
    pub(super) fn new(points: &'a Normalized, threshold: f64) -> Self {
        let (first, second) = (&points.first, &points.second);
        let columns = Columns::spread(first, second, MAX_SCREENED);
        Self { first, second, columns, threshold: threshold * points.scale }
    }

    fn refined(&self, model: &Matrix3<f64>, effort: Effort) -> Option<Matrix3<f64>> {
        let indices = effort.thinned(self.inliers(model));
        if indices.len() <= 7 {
            return None;
        }
        let (first, second) = (self.first, self.second);
        let data = Correspondences { first, second, indices: &indices, loss_scale: self.threshold };
        let (state, _) =
            small_lm::minimize(&RankTwoProblem(data), RankTwo::nearest(model)?, &effort.options());
        Some(state.matrix().normalize())
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

    compare_by!(squared_sampson_error, sampson);
}

pub(super) struct Homographies<'a> {
    first: &'a [Vector2<f64>],
    second: &'a [Vector2<f64>],
    columns: Columns,
    threshold: f64,
    min_support: usize,
}

impl<'a> Homographies<'a> {
    /// The threshold is in the unit before normalisation; models that a smaller share agree with are not looked at further.
    pub(super) fn new(points: &'a Normalized, threshold: f64, min_share: f64) -> Self {
        let (first, second) = (&points.first, &points.second);
        let columns = Columns::spread(first, second, MAX_SCREENED);
        let min_support = ((min_share * columns.len() as f64) as usize).max(4);
        Self { first, second, columns, threshold: threshold * points.scale, min_support }
    }

    fn refined(&self, model: &Matrix3<f64>, effort: Effort) -> Option<Matrix3<f64>> {
        let indices = effort.thinned(self.inliers(model));
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
        Some(small_lm::minimize(&problem, *model, &effort.options()).0.normalize())
    }
}

impl Estimator for Homographies<'_> {
    type Model = Matrix3<f64>;

    fn sample_len(&self) -> usize {
        4
    }

    fn min_support(&self) -> usize {
        self.min_support
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<Matrix3<f64>>) {
        models.extend(homography_from_four(&chosen(self.first, sample), &chosen(self.second, sample)));
    }

    compare_by!(squared_transfer_error, transfer);
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

    /// See [`super::dominant_rotation`].
    pub(super) fn dominant(&self, share: f64) -> Option<(UnitQuaternion<f64>, Vec<u32>)> {
        const ROUNDS: usize = 6;
        let len = self.first.len();
        let needed = (share * len as f64).ceil().max(2.0) as usize;
        let thin = len.div_ceil(MAX_FITTED).max(1);
        let mut fitted: Vec<usize> = (0..len).step_by(thin).collect();
        let kept = (share * fitted.len() as f64).ceil().max(2.0) as usize;
        let mut rotation = self.fit(fitted.iter().copied())?;
        for _ in 0..ROUNDS {
            let matrix = rotation.to_rotation_matrix().into_inner();
            let error = |&i: &usize| {
                let error = squared_transfer_error(&matrix, &self.first[i], &self.second[i]);
                if error.is_nan() { f64::INFINITY } else { error }
            };
            fitted = (0..len).step_by(thin).collect();
            fitted.sort_by(|a, b| error(a).total_cmp(&error(b)).then(a.cmp(b)));
            // Far off after a fit to the better half: no rotation at all.
            if error(fitted.get(fitted.len() / 2)?) > 100.0 * self.threshold * self.threshold {
                return None;
            }
            fitted.truncate(kept);
            rotation = self.fit(fitted.iter().copied())?;
        }
        let inliers = self.inliers(&rotation);
        let rotation = self.fit(inliers.iter().map(|&i| i as usize)).unwrap_or(rotation);
        let inliers = self.inliers(&rotation);
        (inliers.len() >= needed).then_some((rotation, inliers))
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
