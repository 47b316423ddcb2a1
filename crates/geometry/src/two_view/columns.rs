//! Correspondences as columns in single precision, by which models of samples are screened many lanes at a time.
//!
//! Sums run over a fixed number of lanes in a fixed order, so that every processor gives the same bits. The exact scores are
//! those in double precision; here a threshold of pixels is known to about a thousandth of itself.

use nalgebra::{Matrix3, Vector2};

use crate::ransac::Score;

/// Correspondences that are looked at together.
pub(super) const LANES: usize = 8;
/// Blocks between two looks at whether the cost is already too high.
const STRIDE: usize = 4;

/// x and y in the first view, x and y in the second.
type Block = [[f32; LANES]; 4];

/// At most so many correspondences, evenly spread over their order.
pub(super) struct Columns {
    blocks: Vec<Block>,
    num_padded: usize,
}

impl Columns {
    pub(super) fn spread(first: &[Vector2<f64>], second: &[Vector2<f64>], at_most: usize) -> Self {
        let len = first.len().min(second.len());
        let taken = len.min(at_most);
        let num_blocks = taken.div_ceil(LANES);
        // An error that is not a number is that of an outlier.
        let mut blocks = vec![[[f32::NAN; LANES]; 4]; num_blocks];
        for at in 0..taken {
            let from = at * len / taken;
            let (a, b) = (first[from], second[from]);
            for (column, value) in [a.x, a.y, b.x, b.y].into_iter().enumerate() {
                blocks[at / LANES][column][at % LANES] = value as f32;
            }
        }
        Self { blocks, num_padded: num_blocks * LANES - taken }
    }

    /// How many correspondences these are.
    pub(super) fn len(&self) -> usize {
        self.blocks.len() * LANES - self.num_padded
    }

    /// Sum of the squared Sampson errors under a matrix, each cut off at the squared threshold.
    pub(super) fn sampson(&self, matrix: &Matrix3<f64>, threshold: f64, stop_at: f64) -> Score {
        let (m, inverse) = (entries(matrix), (1.0 / (threshold * threshold)) as f32);
        self.score(threshold, stop_at, |[x, y, u, v]| {
            let mut errors = [0.0; LANES];
            for l in 0..LANES {
                let a0 = m[0] * x[l] + m[1] * y[l] + m[2];
                let a1 = m[3] * x[l] + m[4] * y[l] + m[5];
                let a2 = m[6] * x[l] + m[7] * y[l] + m[8];
                let b0 = m[0] * u[l] + m[3] * v[l] + m[6];
                let b1 = m[1] * u[l] + m[4] * v[l] + m[7];
                let c = u[l] * a0 + v[l] * a1 + a2;
                errors[l] = c * c * inverse / (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1);
            }
            errors
        })
    }

    /// Sum of the squared transfer errors under a homography, each cut off at the squared threshold.
    pub(super) fn transfer(&self, homography: &Matrix3<f64>, threshold: f64, stop_at: f64) -> Score {
        let (h, inverse) = (entries(homography), (1.0 / (threshold * threshold)) as f32);
        self.score(threshold, stop_at, |[x, y, u, v]| {
            let mut errors = [0.0; LANES];
            for l in 0..LANES {
                let w = h[6] * x[l] + h[7] * y[l] + h[8];
                let dx = (h[0] * x[l] + h[1] * y[l] + h[2]) / w - u[l];
                let dy = (h[3] * x[l] + h[4] * y[l] + h[5]) / w - v[l];
                let error = (dx * dx + dy * dy) * inverse;
                errors[l] = if w > 0.0 { error } else { f32::INFINITY };
            }
            errors
        })
    }

    /// Sums errors in units of the squared threshold.
    #[inline(always)]
    fn score(&self, threshold: f64, stop_at: f64, errors: impl Fn(&Block) -> [f32; LANES]) -> Score {
        let limit = threshold * threshold;
        let stop_at = (stop_at / limit) as f32 + self.num_padded as f32;
        let (mut costs, mut inside) = ([0.0_f32; LANES], [0.0_f32; LANES]);
        for chunk in self.blocks.chunks(STRIDE) {
            for block in chunk {
                let errors = errors(block);
                for l in 0..LANES {
                    let is_inside = errors[l] < 1.0;
                    costs[l] += if is_inside { errors[l] } else { 1.0 };
                    inside[l] += if is_inside { 1.0 } else { 0.0 };
                }
            }
            if costs.iter().sum::<f32>() > stop_at {
                break;
            }
        }
        let cost = (f64::from(costs.iter().sum::<f32>()) - self.num_padded as f64) * limit;
        Score { cost, num_inliers: inside.iter().sum::<f32>() as u32 }
    }
}

/// Row by row, scaled to norm one so that single precision suffices.
fn entries(matrix: &Matrix3<f64>) -> [f32; 9] {
    let scale = 1.0 / matrix.norm();
    let m = matrix;
    [m.m11, m.m12, m.m13, m.m21, m.m22, m.m23, m.m31, m.m32, m.m33].map(|value| (value * scale) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::epipolar::{essential_from_pose, squared_sampson_error};
    use crate::homography::{homography_from_points, squared_transfer_error};
    use crate::ransac;
    use crate::test_support::{Random, two_views};

    #[test]
    fn screening_agrees_with_the_exact_score() {
        let mut random = Random::new("columns");
        for count in [5, 8, 31, 64, 333] {
            let mut views = two_views(&mut random, count, 1e-3, true);
            for i in (0..count).step_by(3) {
                views.second[i] = Vector2::new(random.uniform(-0.7, 0.7), random.uniform(-0.7, 0.7));
            }
            let (first, second, limit) = (&views.first, &views.second, 3e-3_f64);
            let columns = Columns::spread(first, second, usize::MAX);
            let e = essential_from_pose(&views.second_from_first) * 7.0;
            let exact =
                |error: &dyn Fn(usize) -> f64| ransac::msac(count, limit * limit, f64::INFINITY, error);
            let cases = [
                (
                    columns.sampson(&e, limit, f64::INFINITY),
                    exact(&|i| squared_sampson_error(&e, &first[i], &second[i])),
                ),
                homography_from_points(first, second).map_or_else(
                    || panic!("points determine a homography"),
                    |h| {
                        let h = h * h.m33.signum();
                        (
                            columns.transfer(&h, limit, f64::INFINITY),
                            exact(&|i| squared_transfer_error(&h, &first[i], &second[i])),
                        )
                    },
                ),
            ];
            for (screened, exact) in cases {
                assert!((screened.cost - exact.cost).abs() < 2e-3 * exact.cost, "{screened:?} {exact:?}");
                assert!(screened.num_inliers.abs_diff(exact.num_inliers) <= 1);
            }
        }
    }

    #[test]
    fn a_bad_model_is_given_up_early_and_nan_is_an_outlier() {
        let nan = vec![Vector2::repeat(f64::NAN); 1000];
        let columns = Columns::spread(&nan, &nan, 512);
        let full = columns.sampson(&Matrix3::identity(), 1.0, f64::INFINITY);
        assert_eq!(full, Score { cost: 512.0, num_inliers: 0 });
        let early = columns.sampson(&Matrix3::identity(), 1.0, 40.0);
        assert!(early.cost > 40.0 && early.cost < 100.0, "{early:?}");
        assert!(Columns::spread(&[], &[], 512).blocks.is_empty());
    }
}
