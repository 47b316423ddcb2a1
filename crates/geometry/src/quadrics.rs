//! Where three quadrics meet.
//!
//! As Kukelova, Heller & Fitzgibbon (2016): with one unknown hidden, the three quadratic monomials of the other two are
//! eliminated, and what ties those to each other makes a 3×3 matrix of polynomials whose determinant, of degree eight, vanishes.

use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};
use smallvec::SmallVec;

use crate::polynomial::degree_ten_roots;

/// Degree of a polynomial at most nine, coefficients from the constant up.
type Polynomial = [f64; 11];

/// Homogeneous points `x` (at most eight, norm one) with `xᵀ q x = 0` for three symmetric matrices.
///
/// The coordinates are first turned by a fixed rotation, so that no special place of the axes matters. Solutions at which two
/// coincide may be missing. None for dependent or non-finite input.
pub(crate) fn intersect_three_quadrics(quadrics: &[Matrix4<f64>; 3]) -> SmallVec<[Vector4<f64>; 8]> {
    let turn = generic_turn();
    let turned = quadrics.map(|q| turn.transpose() * q * turn);
    let mut points = SmallVec::new();
    let Some(reduced) = Reduced::new(&turned) else { return points };
    let constraints = reduced.constraints();
    for z in degree_ten_roots(&determinant(&constraints)) {
        let matrix = Matrix3::from_fn(|i, j| evaluate(&constraints[i][j], z));
        let Some(direction) = kernel(&matrix) else { continue };
        let point = Vector4::new(direction.x, direction.y, direction.z * z, direction.z);
        let point = polished(&turned, point);
        if points.len() < 8
            && let Some(point) = point.try_normalize(0.0)
        {
            points.push(turn * point);
        }
    }
    points
}

/// A rotation of four dimensions of which no axis stays near another: a reflection on (1, 2, 3, 4) after one on (3, -1, 2, 1).
fn generic_turn() -> Matrix4<f64> {
    let reflection = |v: Vector4<f64>| Matrix4::identity() - v * v.transpose() * (2.0 / v.norm_squared());
    reflection(Vector4::new(1.0, 2.0, 3.0, 4.0)) * reflection(Vector4::new(3.0, -1.0, 2.0, 1.0))
}

/// `x²`, `xy` and `y²` as `[·x, ·y, ·1]` with polynomials in `z`.
struct Reduced([[Polynomial; 3]; 3]);

impl Reduced {
    fn new(quadrics: &[Matrix4<f64>; 3]) -> Option<Self> {
        let eliminated = Matrix3::from_fn(|i, j| {
            let q = &quadrics[i];
            [q[(0, 0)], 2.0 * q[(0, 1)], q[(1, 1)]][j]
        });
        let inverse = eliminated.try_inverse()?;
        let mut rows = [[[0.0; 11]; 3]; 3];
        for (i, row) in rows.iter_mut().enumerate() {
            for (k, q) in quadrics.iter().enumerate() {
                let gain = -inverse[(i, k)];
                for axis in 0..2 {
                    row[axis][1] += gain * 2.0 * q[(axis, 2)];
                    row[axis][0] += gain * 2.0 * q[(axis, 3)];
                }
                row[2][2] += gain * q[(2, 2)];
                row[2][1] += gain * 2.0 * q[(2, 3)];
                row[2][0] += gain * q[(3, 3)];
            }
        }
        Some(Self(rows))
    }

    /// `x·xy = y·x²`, `x·y² = y·xy`, `xy·xy = x²·y²`, each reduced to `[·x, ·y, ·1]`.
    fn constraints(&self) -> [[Polynomial; 3]; 3] {
        let [a, b, c] = &self.0;
        let third = [
            sum(&times(&b[0], &b[0]), &times(&a[0], &c[0]), -1.0),
            sum(&twice(&times(&b[0], &b[1])), &sum(&times(&a[0], &c[1]), &times(&a[1], &c[0]), 1.0), -1.0),
            sum(&times(&b[1], &b[1]), &times(&a[1], &c[1]), -1.0),
        ];
        let linear = |i: usize| {
            let crossed = sum(&times(&a[i], &c[2]), &times(&a[2], &c[i]), 1.0);
            sum(&twice(&times(&b[i], &b[2])), &crossed, -1.0)
        };
        let rest = [linear(0), linear(1), sum(&times(&b[2], &b[2]), &times(&a[2], &c[2]), -1.0)];
        [self.difference(b, a), self.difference(c, b), self.substituted(&third, &rest)]
    }

    /// `x (f · (x, y, 1)) - y (g · (x, y, 1))`, reduced.
    fn difference(&self, f: &[Polynomial; 3], g: &[Polynomial; 3]) -> [Polynomial; 3] {
        let quadratic = [f[0], sum(&f[1], &g[0], -1.0), g[1].map(|value| -value)];
        self.substituted(&quadratic, &[f[2], g[2].map(|value| -value), [0.0; 11]])
    }

    /// Quadratic terms, replaced, plus linear ones.
    fn substituted(&self, quadratic: &[Polynomial; 3], linear: &[Polynomial; 3]) -> [Polynomial; 3] {
        let mut total = *linear;
        for (factor, row) in quadratic.iter().zip(&self.0) {
            for j in 0..3 {
                total[j] = sum(&total[j], &times(factor, &row[j]), 1.0);
            }
        }
        total
    }
}

fn times(a: &Polynomial, b: &Polynomial) -> Polynomial {
    let mut product = [0.0; 11];
    for i in (0..11).filter(|&i| a[i] != 0.0) {
        for j in 0..11 - i {
            product[i + j] += a[i] * b[j];
        }
    }
    product
}

fn sum(a: &Polynomial, b: &Polynomial, gain: f64) -> Polynomial {
    std::array::from_fn(|i| a[i] + gain * b[i])
}

fn twice(a: &Polynomial) -> Polynomial {
    a.map(|value| 2.0 * value)
}

fn evaluate(c: &Polynomial, z: f64) -> f64 {
    c.iter().rev().fold(0.0, |total, value| total * z + value)
}

fn determinant(m: &[[Polynomial; 3]; 3]) -> Polynomial {
    let minor = |j: usize, k: usize| sum(&times(&m[1][j], &m[2][k]), &times(&m[1][k], &m[2][j]), -1.0);
    let first = sum(&times(&m[0][0], &minor(1, 2)), &times(&m[0][1], &minor(0, 2)), -1.0);
    sum(&first, &times(&m[0][2], &minor(0, 1)), 1.0)
}

/// The direction that a singular matrix takes to zero: the longest cross product of two rows.
fn kernel(m: &Matrix3<f64>) -> Option<Vector3<f64>> {
    // Rows differ in degree; a root far out must not drown the shorter ones.
    let rows = [0, 1, 2].map(|i| m.row(i).transpose().try_normalize(0.0).unwrap_or_default());
    let crosses = [rows[0].cross(&rows[1]), rows[1].cross(&rows[2]), rows[2].cross(&rows[0])];
    let longest = crosses.iter().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
    longest.try_normalize(0.0).filter(|v| v.iter().all(|value| value.is_finite()))
}

/// Newton's method on the sphere, as long as it helps.
fn polished(quadrics: &[Matrix4<f64>; 3], start: Vector4<f64>) -> Vector4<f64> {
    let residual = |p: &Vector4<f64>| Vector3::from_fn(|i, _| p.dot(&(quadrics[i] * p)));
    let Some(mut point) = start.try_normalize(0.0) else { return start };
    let mut value = residual(&point);
    for _ in 0..3 {
        let rows = [0, 1, 2].map(|i| (quadrics[i] * point * 2.0).transpose());
        let jacobian = Matrix4::from_rows(&[rows[0], rows[1], rows[2], point.transpose()]);
        let Some(step) = jacobian.lu().solve(&value.push(0.0)) else { break };
        let next = (point - step).normalize();
        let next_value = residual(&next);
        if !(next_value.norm_squared() < value.norm_squared()) {
            break;
        }
        (point, value) = (next, next_value);
    }
    point
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::Random;

    fn random_quadric_through(random: &mut Random, point: &Vector4<f64>) -> Matrix4<f64> {
        let m = Matrix4::from_fn(|_, _| random.gaussian());
        let m = m + m.transpose();
        m - Matrix4::identity() * (point.dot(&(m * point)) / point.norm_squared())
    }

    #[test]
    fn the_planted_point_is_found_and_all_points_lie_on_all_quadrics() {
        let mut random = Random::new("quadrics");
        let (mut good, mut count) = (0, 0);
        for _ in 0..3000 {
            let truth = Vector4::from_fn(|_, _| random.gaussian()).normalize();
            let quadrics = [0; 3].map(|_| random_quadric_through(&mut random, &truth));
            let found = intersect_three_quadrics(&quadrics);
            count += found.len();
            good += usize::from(found.iter().any(|p| (p - truth).norm().min((p + truth).norm()) < 1e-6));
            let off = |p: &Vector4<f64>| quadrics.iter().any(|q| p.dot(&(q * p)).abs() > 1e-6);
            assert!(found.iter().filter(|p| off(p)).count() <= 1);
        }
        assert!(good >= 2985, "{good}");
        // Random quadrics meet in some four real points of eight.
        assert!(count > 6000 && count < 18_000, "{count}");
    }

    #[test]
    fn degenerate_input_gives_only_finite_points() {
        let mut random = Random::new("quadrics degenerate");
        let q = random_quadric_through(&mut random, &Vector4::x());
        for bad in
            [[q; 3], [Matrix4::zeros(); 3], [Matrix4::repeat(f64::NAN); 3], [q, q * 2.0, Matrix4::identity()]]
        {
            for point in intersect_three_quadrics(&bad) {
                assert!(point.iter().all(|value| value.is_finite()));
            }
        }
    }
}
