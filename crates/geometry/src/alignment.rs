//! Similarities and rigid transforms between two sets of corresponding points.
//!
//! Closed form: least squares as Umeyama (1991), with the rotation as the largest eigenvector of Horn's (1987) 4×4 matrix,
//! which needs no case for reflections or planar points. Collinear and coincident points leave the rotation open and give
//! `None`; points that are collinear but for noise do not: look at what the result is supported by.

use nalgebra::{Matrix3, Matrix4, Quaternion, UnitQuaternion, Vector3};

use crate::linear::symmetric_eigen;
use crate::ransac::{self, Estimator, RansacOptions, Robust, Score};
use crate::{Rigid3, Seed, Sim3};

#[cfg(test)]
mod tests;

/// Below this share of the spread the second direction of the points is rounding.
const MIN_RELATIVE_GAP: f64 = 1e-10;

/// The similarity `to_from_from` that minimises `Σ w |to - S from|²` (Umeyama 1991).
///
/// `None` for fewer than three points, lengths that differ, points on a line, non-finite or negative weights or values.
pub fn umeyama(from: &[Vector3<f64>], to: &[Vector3<f64>], weights: Option<&[f64]>) -> Option<Sim3> {
    let sums = Moments::new(from, to, weights)?;
    let rotation = sums.rotation()?;
    let scale = (rotation.to_rotation_matrix().into_inner() * sums.from_to).trace() / sums.from_variance;
    sums.similarity(scale, rotation)
}

/// The rigid transform `to_from_from` that minimises `Σ w |to - T from|²` (Horn 1987). `None` as for [`umeyama`].
pub fn rigid_from_points(
    from: &[Vector3<f64>],
    to: &[Vector3<f64>],
    weights: Option<&[f64]>,
) -> Option<Rigid3> {
    let sums = Moments::new(from, to, weights)?;
    let similarity = sums.similarity(1.0, sums.rotation()?)?;
    Some(Rigid3::new(similarity.rotation, similarity.translation))
}

/// The rotation that best turns directions of `from` onto those of `to` (Horn 1987); `None` when they leave it open.
pub fn rotation_from_directions(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<UnitQuaternion<f64>> {
    if from.len() != to.len() {
        return None;
    }
    horn_rotation(&from.iter().zip(to).map(|(a, b)| a * b.transpose()).sum())
}

/// The similarity that most correspondences agree with, to within `threshold` in the unit of `to`; refined on them.
///
/// `None` when the lengths differ, or no three points give a similarity that three agree with.
pub fn estimate_sim3(
    from: &[Vector3<f64>],
    to: &[Vector3<f64>],
    threshold: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<Sim3>> {
    let estimator = Similarities::new(from, to, threshold, false)?;
    ransac::run(&estimator, options, seed)
}

/// [`estimate_sim3`] at scale one.
pub fn estimate_rigid3(
    from: &[Vector3<f64>],
    to: &[Vector3<f64>],
    threshold: f64,
    options: &RansacOptions,
    seed: Seed,
) -> Option<Robust<Rigid3>> {
    let estimator = Similarities::new(from, to, threshold, true)?;
    let Robust { model, inliers, cost, iterations } = ransac::run(&estimator, options, seed)?;
    Some(Robust { model: Rigid3::new(model.rotation, model.translation), inliers, cost, iterations })
}

/// Weighted means and second moments of two point sets.
struct Moments {
    from_mean: Vector3<f64>,
    to_mean: Vector3<f64>,
    from_variance: f64,
    /// `Σ w from toᵀ` about the means.
    from_to: Matrix3<f64>,
}

impl Moments {
    fn new(from: &[Vector3<f64>], to: &[Vector3<f64>], weights: Option<&[f64]>) -> Option<Self> {
        let same_len = from.len() == to.len() && weights.is_none_or(|w| w.len() == from.len());
        if from.len() < 3 || !same_len {
            return None;
        }
        let weight = |i: usize| weights.map_or(1.0, |w| w[i]);
        let (mut total, mut from_mean, mut to_mean) = (0.0, Vector3::zeros(), Vector3::zeros());
        for i in 0..from.len() {
            if !(weight(i) >= 0.0) {
                return None;
            }
            total += weight(i);
            from_mean += weight(i) * from[i];
            to_mean += weight(i) * to[i];
        }
        from_mean /= total;
        to_mean /= total;
        let (mut from_variance, mut from_to) = (0.0, Matrix3::zeros());
        for i in 0..from.len() {
            let (a, b) = (from[i] - from_mean, to[i] - to_mean);
            from_variance += weight(i) * a.norm_squared();
            from_to += weight(i) * a * b.transpose();
        }
        let usable =
            from_variance > 0.0 && from_variance.is_finite() && from_to.iter().all(|x| x.is_finite());
        usable.then_some(Self { from_mean, to_mean, from_variance, from_to })
    }

    fn rotation(&self) -> Option<UnitQuaternion<f64>> {
        horn_rotation(&self.from_to)
    }

    fn similarity(&self, scale: f64, rotation: UnitQuaternion<f64>) -> Option<Sim3> {
        let translation = self.to_mean - scale * (rotation * self.from_mean);
        let usable = scale > 0.0 && scale.is_finite() && translation.iter().all(|x| x.is_finite());
        usable.then_some(Sim3::new(scale, rotation, translation))
    }
}

/// The rotation that maximises `tr(R from_to)`, or `None` when it is not unique.
fn horn_rotation(s: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    let trace = s.trace();
    let twist = Vector3::new(s.m23 - s.m32, s.m31 - s.m13, s.m12 - s.m21);
    let mut horn = Matrix4::zeros();
    horn[(0, 0)] = trace;
    for i in 0..3 {
        horn[(0, i + 1)] = twist[i];
        horn[(i + 1, 0)] = twist[i];
        for j in 0..3 {
            horn[(i + 1, j + 1)] = s[(i, j)] + s[(j, i)] - if i == j { trace } else { 0.0 };
        }
    }
    let (values, vectors) = symmetric_eigen(horn);
    if !(values[3] - values[2] > MIN_RELATIVE_GAP * values[3].abs()) {
        return None;
    }
    let q = vectors.column(3);
    let sign = if q[0] < 0.0 { -1.0 } else { 1.0 };
    let rotation = UnitQuaternion::try_new(Quaternion::new(q[0], q[1], q[2], q[3]) * sign, 0.5)?;
    rotation.coords.iter().all(|x| x.is_finite()).then_some(rotation)
}

/// Similarities (or rigid transforms) from three correspondences.
struct Similarities<'a> {
    from: &'a [Vector3<f64>],
    to: &'a [Vector3<f64>],
    max_squared_error: f64,
    fixed_scale: bool,
}

impl<'a> Similarities<'a> {
    fn new(
        from: &'a [Vector3<f64>],
        to: &'a [Vector3<f64>],
        threshold: f64,
        fixed_scale: bool,
    ) -> Option<Self> {
        (from.len() == to.len()).then_some(Self {
            from,
            to,
            max_squared_error: threshold * threshold,
            fixed_scale,
        })
    }

    fn fit(&self, indices: impl Iterator<Item = usize> + Clone) -> Option<Sim3> {
        let from: Vec<_> = indices.clone().map(|i| self.from[i]).collect();
        let to: Vec<_> = indices.map(|i| self.to[i]).collect();
        match self.fixed_scale {
            true => rigid_from_points(&from, &to, None).map(|rigid| Sim3::from_rigid(&rigid)),
            false => umeyama(&from, &to, None),
        }
    }

    /// The squared error of a datum, with the rotation as a matrix.
    fn squared_errors(&self, model: &Sim3) -> impl Fn(usize) -> f64 {
        let matrix = model.scale * model.rotation.to_rotation_matrix().into_inner();
        let translation = model.translation;
        move |i| (self.to[i] - matrix * self.from[i] - translation).norm_squared()
    }
}

impl Estimator for Similarities<'_> {
    type Model = Sim3;

    fn sample_len(&self) -> usize {
        3
    }

    fn data_len(&self) -> usize {
        self.from.len()
    }

    fn propose(&self, sample: &[usize], models: &mut Vec<Sim3>) {
        let sample: [usize; 3] = [sample[0], sample[1], sample[2]];
        let (from, to) = (sample.map(|i| self.from[i]), sample.map(|i| self.to[i]));
        models.extend(match self.fixed_scale {
            true => rigid_from_points(&from, &to, None).map(|rigid| Sim3::from_rigid(&rigid)),
            false => umeyama(&from, &to, None),
        });
    }

    fn score(&self, model: &Sim3, stop_at: f64) -> Score {
        ransac::msac(self.from.len(), self.max_squared_error, stop_at, self.squared_errors(model))
    }

    fn refine(&self, model: &Sim3) -> Option<Sim3> {
        self.fit(self.inliers(model).into_iter().map(|i| i as usize))
    }

    fn inliers(&self, model: &Sim3) -> Vec<u32> {
        ransac::indices_within(self.from.len(), self.max_squared_error, self.squared_errors(model))
    }
}
