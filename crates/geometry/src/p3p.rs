//! The pose of a camera from three points and the rays that see them.
//!
//! As Persson & Nordberg (2018, "Lambda Twist"): the depths lie on three quadrics that share two conics; one degenerate conic
//! of their pencil, from a real root of a cubic, is a pair of lines; each line meets another conic of the pencil in at most
//! two points. Depths are polished by Gauss–Newton; the pose comes from matching the frames of the two triangles.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use smallvec::SmallVec;

use crate::Rigid3;
use crate::linear::{largest_entry, tangent_basis};
use crate::polynomial::cubic_roots;

/// Every `cam_from_world` (at most four) under which the unit `rays` in the camera's frame see the points.
///
/// None when the points or the rays are coincident, the points lie on a line, or a value is not finite.
pub fn p3p(rays: &[Vector3<f64>; 3], x_in_world: &[Vector3<f64>; 3]) -> SmallVec<[Rigid3; 4]> {
    let mut poses = SmallVec::new();
    let Some((y, x)) = ordered(rays, x_in_world) else { return poses };
    let triangle = Triangle::new(&y, &x);
    let Some(world) = frame(&x) else { return poses };
    for depths in triangle.depths() {
        let seen = [y[0] * depths.x, y[1] * depths.y, y[2] * depths.z];
        let Some(camera) = frame(&seen) else { continue };
        let rotation = Rotation3::from_matrix_unchecked(camera * world.transpose());
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
        let x_mean = (x[0] + x[1] + x[2]) / 3.0;
        let seen_mean = (seen[0] + seen[1] + seen[2]) / 3.0;
        poses.push(Rigid3::new(rotation, seen_mean - rotation * x_mean));
    }
    poses
}

/// Rays and points with the longest side last, which conditions the conics; `None` for degenerate input.
fn ordered(
    rays: &[Vector3<f64>; 3],
    x: &[Vector3<f64>; 3],
) -> Option<([Vector3<f64>; 3], [Vector3<f64>; 3])> {
    let opposite = [0, 1, 2].map(|i| (x[(i + 1) % 3] - x[(i + 2) % 3]).norm_squared());
    let longest = opposite.iter().fold(0.0, |m: f64, side| m.max(*side));
    let first = opposite.iter().position(|side| *side == longest)?;
    let order = [first, (first + 1) % 3, (first + 2) % 3];
    let area = (x[1] - x[0]).cross(&(x[2] - x[0])).norm_squared();
    let apart = (0..3).all(|i| rays[i].cross(&rays[(i + 1) % 3]).norm_squared() > 1e-16);
    (apart && area > 1e-16 * longest * longest && longest.is_finite())
        .then(|| (order.map(|i| rays[i]), order.map(|i| x[i])))
}

/// An orthonormal frame fixed to a triangle.
fn frame(x: &[Vector3<f64>; 3]) -> Option<Matrix3<f64>> {
    let first = (x[2] - x[1]).try_normalize(0.0)?;
    let normal = first.cross(&(x[0] - x[1])).try_normalize(0.0)?;
    Some(Matrix3::from_columns(&[first, normal.cross(&first), normal]))
}

/// Squared sides over the longest one, and `-cos` of the angles between rays.
struct Triangle {
    side_01: f64,
    side_02: f64,
    b_01: f64,
    b_02: f64,
    b_12: f64,
    /// The longest side itself, opposite of the first point.
    longest_side: f64,
}

impl Triangle {
    fn new(y: &[Vector3<f64>; 3], x: &[Vector3<f64>; 3]) -> Self {
        let longest = (x[1] - x[2]).norm_squared();
        Self {
            side_01: (x[0] - x[1]).norm_squared() / longest,
            side_02: (x[0] - x[2]).norm_squared() / longest,
            b_01: -y[0].dot(&y[1]),
            b_02: -y[0].dot(&y[2]),
            b_12: -y[1].dot(&y[2]),
            longest_side: longest.sqrt(),
        }
    }

    /// The depths of the three points along their rays, every solution.
    fn depths(&self) -> SmallVec<[Vector3<f64>; 4]> {
        let mut all = SmallVec::new();
        let (a, c, b12) = (self.side_01, self.side_02, self.b_12);
        // |λ0 y0 - λ1 y1|² = a |λ1 y1 - λ2 y2|², and the same for points 0 and 2.
        let conic_1 = Matrix3::new(1.0, self.b_01, 0.0, self.b_01, 1.0 - a, -a * b12, 0.0, -a * b12, -a);
        let conic_2 = Matrix3::new(1.0, 0.0, self.b_02, 0.0, -c, -c * b12, self.b_02, -c * b12, 1.0 - c);
        let Some(gamma) = degenerate_member(&conic_1, &conic_2) else { return all };
        let other = if gamma.abs() > 1.0 { &conic_1 } else { &conic_2 };
        for line in lines(&(conic_1 + gamma * conic_2)).into_iter().flatten() {
            for direction in meet(&line, other).into_iter().flatten() {
                all.extend(self.scaled(&direction).and_then(|depths| self.polished(depths)));
            }
        }
        all
    }

    /// The squared sides of the triangle that these depths span, minus those given; zero for a solution.
    fn residual(&self, d: &Vector3<f64>) -> Vector3<f64> {
        let side = |p: f64, q: f64, b: f64| p * p + q * q + 2.0 * b * p * q;
        Vector3::new(
            side(d.x, d.y, self.b_01) - self.side_01,
            side(d.x, d.z, self.b_02) - self.side_02,
            side(d.y, d.z, self.b_12) - 1.0,
        )
    }

    /// The multiple of a direction that has the right size and lies ahead of the camera.
    fn scaled(&self, direction: &Vector3<f64>) -> Option<Vector3<f64>> {
        let ahead = if direction.sum() < 0.0 { -direction } else { *direction };
        if !(ahead.min() > 0.0) {
            return None;
        }
        let sides = Vector3::new(self.side_01, self.side_02, 1.0);
        let spanned = self.residual(&ahead) + sides;
        Some(ahead * (sides.sum() / spanned.sum()).sqrt())
    }

    /// Gauss–Newton on the squared sides, then a check that they hold; in the points' own unit.
    fn polished(&self, mut depths: Vector3<f64>) -> Option<Vector3<f64>> {
        let mut residual = self.residual(&depths);
        for _ in 0..4 {
            let (d, b01, b02, b12) = (depths, self.b_01, self.b_02, self.b_12);
            let jacobian = 2.0
                * Matrix3::new(
                    d.x + b01 * d.y,
                    d.y + b01 * d.x,
                    0.0,
                    d.x + b02 * d.z,
                    0.0,
                    d.z + b02 * d.x,
                    0.0,
                    d.y + b12 * d.z,
                    d.z + b12 * d.y,
                );
            let Some(inverse) = jacobian.try_inverse() else { break };
            let next = depths - inverse * residual;
            let next_residual = self.residual(&next);
            if !(next_residual.norm_squared() < residual.norm_squared()) {
                break;
            }
            (depths, residual) = (next, next_residual);
        }
        // Relative to the depths: far triangles are small on the scale of their rays.
        let holds = residual.norm() < 1e-8 * (1.0 + depths.norm_squared()) && depths.min() > 0.0;
        holds.then(|| depths * self.longest_side)
    }
}

/// A real `γ` that makes `p + γ q` singular; of several, the one best determined.
fn degenerate_member(p: &Matrix3<f64>, q: &Matrix3<f64>) -> Option<f64> {
    let c = [p.determinant(), (adjugate(p) * q).trace(), (adjugate(q) * p).trace(), q.determinant()];
    let slope = |g: f64| (c[1] + g * (2.0 * c[2] + 3.0 * g * c[3])).abs() / (1.0 + g * g);
    cubic_roots(c).into_iter().max_by(|a, b| slope(*a).total_cmp(&slope(*b)))
}

/// The adjugate of a symmetric matrix.
fn adjugate(m: &Matrix3<f64>) -> Matrix3<f64> {
    let (a, b, c) = (m.column(0).into_owned(), m.column(1).into_owned(), m.column(2).into_owned());
    Matrix3::from_columns(&[b.cross(&c), c.cross(&a), a.cross(&b)])
}

/// The two lines of a degenerate conic, if real (Hartley & Zisserman 2004, section 2.2; `l mᵀ + m lᵀ`).
fn lines(conic: &Matrix3<f64>) -> Option<[Vector3<f64>; 2]> {
    let adjugate = adjugate(conic);
    let i = smallest_entry(&adjugate.diagonal());
    let pivot = -adjugate[(i, i)];
    // The lines meet at `l × m`, whose outer product is minus the adjugate; zero when the lines are one.
    let meeting = if pivot > 0.0 { adjugate.column(i) / pivot.sqrt() } else { Vector3::zeros() };
    if !(pivot > -1e-12 * conic.norm_squared()) {
        return None;
    }
    let product = conic + crate::so3::skew(&meeting);
    let largest = largest_entry(&product);
    let (row, column) = (largest % 3, largest / 3);
    let (l, m) = (product.row(row).transpose(), product.column(column).into_owned());
    Some([l.try_normalize(0.0)?, m.try_normalize(0.0)?])
}

/// Where a line meets a conic, as directions.
fn meet(line: &Vector3<f64>, conic: &Matrix3<f64>) -> [Option<Vector3<f64>>; 2] {
    let (u, v) = tangent_basis(line);
    let (uu, uv, vv) = (u.dot(&(conic * u)), u.dot(&(conic * v)), v.dot(&(conic * v)));
    let discriminant = uv * uv - uu * vv;
    let scale = uv * uv + uu.abs() * vv.abs();
    if !(discriminant > -1e-12 * scale) {
        return [None, None];
    }
    // Homogeneous roots of uu α² + 2 uv αβ + vv β², without division or cancellation.
    let q = -(uv + discriminant.max(0.0).sqrt().copysign(uv));
    [Some(vv * u + q * v), Some(q * u + uu * v)]
}

/// The index of the smallest entry, sign included.
fn smallest_entry(v: &Vector3<f64>) -> usize {
    (1..3).fold(0, |best, i| if v[i] < v[best] { i } else { best })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::Random;

    fn closest(poses: &[Rigid3], truth: &Rigid3) -> f64 {
        poses.iter().map(|pose| pose.local_left(truth).norm()).fold(f64::INFINITY, f64::min)
    }

    fn case(random: &mut Random, spread: f64) -> (Rigid3, [Vector3<f64>; 3], [Vector3<f64>; 3]) {
        let truth = random.rigid();
        let ahead = Vector3::new(0.0, 0.0, 6.0);
        let in_cam = [0; 3].map(|_| ahead + random.gaussian3(spread));
        let x_in_world = in_cam.map(|x| truth.inverse().transform_point(&x));
        (truth, in_cam.map(|x| x.normalize()), x_in_world)
    }

    #[test]
    fn truth_is_among_the_poses() {
        let mut random = Random::new("p3p");
        let (mut good, mut count) = (0, 0);
        for _ in 0..20_000 {
            let (truth, rays, x_in_world) = case(&mut random, 1.0);
            let poses = p3p(&rays, &x_in_world);
            good += usize::from(closest(&poses, &truth) < 1e-6);
            count += poses.len();
            for pose in &poses {
                for (ray, x) in rays.iter().zip(&x_in_world) {
                    assert!(pose.transform_point(x).normalize().dot(ray) > 1.0 - 1e-9);
                }
            }
        }
        assert!(good >= 19_980, "{good}");
        assert!(count > 20_000 && count < 60_000, "{count}");
    }

    #[test]
    fn small_and_large_triangles_work() {
        let mut random = Random::new("p3p scale");
        for (spread, tolerance) in [(0.05, 1e-3), (3.0, 1e-6)] {
            let mut good = 0;
            for _ in 0..2000 {
                let (truth, rays, x_in_world) = case(&mut random, spread);
                good += usize::from(closest(&p3p(&rays, &x_in_world), &truth) < tolerance);
            }
            assert!(good >= 1980, "{spread} {good}");
        }
    }

    #[test]
    fn a_symmetric_triangle_seen_along_its_axis_is_solved() {
        let x = [0.0, 1.0, 2.0].map(|k: f64| {
            let angle = k * std::f64::consts::TAU / 3.0;
            Vector3::new(angle.cos(), angle.sin(), 0.0)
        });
        let truth = Rigid3::new(UnitQuaternion::identity(), Vector3::new(0.0, 0.0, 4.0));
        let rays = x.map(|x| truth.transform_point(&x).normalize());
        assert!(closest(&p3p(&rays, &x), &truth) < 1e-5);
    }

    #[test]
    fn degenerate_input_gives_none() {
        let mut random = Random::new("p3p degenerate");
        let (_, rays, x) = case(&mut random, 1.0);
        assert!(p3p(&rays, &[x[0], x[1], (x[0] + x[1]) / 2.0]).is_empty());
        assert!(p3p(&rays, &[x[0], x[0], x[1]]).is_empty());
        assert!(p3p(&rays, &[x[0]; 3]).is_empty());
        assert!(p3p(&[rays[0], rays[0], rays[1]], &x).is_empty());
        assert!(p3p(&[Vector3::zeros(); 3], &x).is_empty());
        assert!(p3p(&[Vector3::repeat(f64::NAN); 3], &x).is_empty());
        assert!(p3p(&rays, &[x[0], x[1], Vector3::repeat(f64::NAN)]).is_empty());
        assert!(p3p(&rays, &[x[0], x[1], Vector3::repeat(f64::INFINITY)]).is_empty());
    }
}
