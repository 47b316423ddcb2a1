//! Points in the world from the pixels that see them.
//!
//! Linear start: the point nearest to all rays, weighted by depth (a midpoint, as discussed by Lee & Civera 2019); then the
//! reprojection error is minimised by Levenberg–Marquardt. With outliers, pairs of views propose, all views vote (as Schönberger
//! & Frahm 2016), and the supporters are fitted again.

use nalgebra::{Matrix3, Vector2, Vector3};
use rand::Rng;
use serde::{Deserialize, Serialize};
use smallvec::SmallVec;

use crate::linear::solve_positive_definite;
use crate::ransac::{self, Score};
use crate::small_lm::{self, LeastSquares, LmOptions, NormalEquations};
use crate::{Camera, Rigid3, Seed};

mod two_rays;

pub use two_rays::{corrected_pair, triangulate_pair};

#[cfg(test)]
mod tests;

/// Where a camera stood and which of its pixels saw the point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Pose of the camera.
    pub cam_from_world: Rigid3,
    /// Its intrinsics.
    pub camera: Camera,
    /// The observation in pixels.
    pub xy_px: Vector2<f64>,
}

/// What counts as a point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TriangulationOptions {
    /// Largest reprojection error of a supporting view, in pixels. Range: above 0. Default 4, as COLMAP's mapper.
    pub max_error_px: f64,
    /// Smallest angle, in radians, at which some two supporting rays must meet. Default 1.5°, as COLMAP's mapper.
    pub min_angle_rad: f64,
    /// Most pairs of views that may propose a point; shorter tracks try all of theirs. Range: at least 1. Default 60: one pair
    /// of good views is met with 99.6 % even when only 3 of 10 views are good.
    pub max_hypotheses: u32,
}

impl Default for TriangulationOptions {
    fn default() -> Self {
        Self { max_error_px: 4.0, min_angle_rad: 1.5_f64.to_radians(), max_hypotheses: 60 }
    }
}

/// A point with the views that support it.
#[derive(Clone, Debug, PartialEq)]
pub struct Triangulated {
    /// The point.
    pub x_in_world: Vector3<f64>,
    /// Indices of the supporting views, ascending; at least two.
    pub inliers: Vec<u32>,
    /// The largest angle between two supporting rays, in radians.
    pub angle_rad: f64,
}

impl Triangulated {
    /// Indices of the views, of this many, that don't support the point; ascending.
    pub fn outliers(&self, num_views: usize) -> Vec<u32> {
        (0..num_views as u32).filter(|i| self.inliers.binary_search(i).is_err()).collect()
    }
}

/// The covariance of a point fitted to these views by least squares, in the world's squared unit, when each coordinate of a
/// pixel has this standard deviation: `σ² (JᵀJ)⁻¹`, first order (Hartley & Zisserman 2004, section 5.2).
///
/// `None` when the views don't determine the point (fewer than two, or rays that are parallel to working precision), the point
/// is not ahead of all cameras, or a value is not finite.
pub fn point_covariance(views: &[View], x_in_world: &Vector3<f64>, sigma_px: f64) -> Option<Matrix3<f64>> {
    let problem = PointProblem { views };
    if views.len() < 2 || !problem.cost(x_in_world).is_finite() {
        return None;
    }
    let mut equations = NormalEquations::default();
    problem.linearize(x_in_world, &mut equations);
    let hessian = equations.hessian();
    let mut covariance = Matrix3::zeros();
    for axis in 0..3 {
        let mut unit = Vector3::zeros();
        unit[axis] = sigma_px * sigma_px;
        covariance.set_column(axis, &solve_positive_definite(&hessian, &unit)?);
    }
    Some(0.5 * (covariance + covariance.transpose()))
}

/// The angle at `x` between the directions to two camera centres, in radians within [0, π].
pub fn ray_angle_rad(center_a: &Vector3<f64>, center_b: &Vector3<f64>, x: &Vector3<f64>) -> f64 {
    let (a, b) = (center_a - x, center_b - x);
    a.cross(&b).norm().atan2(a.dot(&b))
}

/// The point in the world that minimises the squared reprojection error over all views.
///
/// `None` for fewer than two views, parallel rays, pixels that can't be unprojected, or a point that is not ahead of all
/// cameras.
pub fn triangulate(views: &[View]) -> Option<Vector3<f64>> {
    let rays = views.iter().map(WorldRay::new).collect::<Option<SmallVec<[WorldRay; 8]>>>()?;
    refined(views, nearest_to_rays(&rays)?)
}

/// The point that most views agree on, fitted to those; views need not be all right.
///
/// `None` when no two views agree on a point ahead of both that their rays meet at a wide enough angle.
pub fn triangulate_robust(
    views: &[View],
    options: &TriangulationOptions,
    seed: Seed,
) -> Option<Triangulated> {
    let rays: SmallVec<[Option<WorldRay>; 16]> = views.iter().map(WorldRay::new).collect();
    let max_cos = (0.5 * options.min_angle_rad).cos();
    let mut best: Option<(Vector3<f64>, Score)> = None;
    for (a, b) in hypotheses(views.len(), options.max_hypotheses as usize, seed) {
        let (Some(ray_a), Some(ray_b)) = (&rays[a], &rays[b]) else { continue };
        if ray_a.direction.dot(&ray_b.direction) > max_cos {
            continue;
        }
        let Some(x) = nearest_to_rays(&[*ray_a, *ray_b]) else { continue };
        let limit = best.map_or(f64::INFINITY, |(_, score)| score.cost);
        let score = score(views, &x, options.max_error_px, limit);
        if score.num_inliers >= 2 && score.cost < limit {
            best = Some((x, score));
            if score.num_inliers as usize == views.len() {
                break;
            }
        }
    }
    let (x_in_world, inliers) = fitted(views, best?, options.max_error_px);
    let angle_rad = widest_angle_rad(views, &inliers, &x_in_world);
    (inliers.len() >= 2 && angle_rad >= options.min_angle_rad).then_some(Triangulated {
        x_in_world,
        inliers,
        angle_rad,
    })
}

/// The reprojection error of a point in a view, in pixels; infinite when it is not ahead.
pub fn reprojection_error_px(view: &View, x_in_world: &Vector3<f64>) -> f64 {
    squared_error(view, x_in_world).sqrt()
}

fn squared_error(view: &View, x_in_world: &Vector3<f64>) -> f64 {
    let x_in_cam = view.cam_from_world.transform_point(x_in_world);
    view.camera.project(&x_in_cam).map_or(f64::INFINITY, |pixel| (pixel - view.xy_px).norm_squared())
}

fn score(views: &[View], x: &Vector3<f64>, max_error_px: f64, stop_at: f64) -> Score {
    ransac::msac(views.len(), max_error_px * max_error_px, stop_at, |i| squared_error(&views[i], x))
}

fn supporters(views: &[View], x: &Vector3<f64>, max_error_px: f64) -> Vec<u32> {
    ransac::indices_within(views.len(), max_error_px * max_error_px, |i| squared_error(&views[i], x))
}

/// Fits to the supporters and selects them again, while that lowers the cost.
fn fitted(
    views: &[View],
    (mut x, mut best): (Vector3<f64>, Score),
    max_error_px: f64,
) -> (Vector3<f64>, Vec<u32>) {
    const MAX_ROUNDS: usize = 4;
    let mut inliers = supporters(views, &x, max_error_px);
    for _ in 0..MAX_ROUNDS {
        let chosen: SmallVec<[View; 8]> = inliers.iter().map(|&i| views[i as usize]).collect();
        let Some(next) = refined(&chosen, x) else { break };
        let next_score = score(views, &next, max_error_px, best.cost);
        if !(next_score.cost < best.cost) {
            break;
        }
        let next_inliers = supporters(views, &next, max_error_px);
        let settled = next_inliers == inliers;
        (x, best, inliers) = (next, next_score, next_inliers);
        if settled {
            break;
        }
    }
    (x, inliers)
}

/// Which pairs of views propose: all of them, or a random choice, each `(a, b)` with `a < b`.
fn hypotheses(num_views: usize, max_count: usize, seed: Seed) -> SmallVec<[(usize, usize); 16]> {
    let all = num_views * num_views.saturating_sub(1) / 2;
    if all <= max_count {
        return (0..num_views).flat_map(|b| (0..b).map(move |a| (a, b))).collect();
    }
    let mut rng = seed.derive(b"triangulation").rng();
    let mut below = |count: usize| ((u128::from(rng.next_u64()) * count as u128) >> 64) as usize;
    let mut pairs = SmallVec::with_capacity(max_count);
    for _ in 0..max_count {
        let a = below(num_views);
        let b = below(num_views - 1);
        let b = if b >= a { b + 1 } else { b };
        pairs.push((a.min(b), a.max(b)));
    }
    pairs
}

/// The largest angle between two of the rays. Quadratic; long tracks are thinned to a hundred views.
fn widest_angle_rad(views: &[View], inliers: &[u32], x: &Vector3<f64>) -> f64 {
    let stride = inliers.len().div_ceil(100).max(1);
    let directions: SmallVec<[Vector3<f64>; 8]> = inliers
        .iter()
        .step_by(stride)
        .map(|&i| (views[i as usize].cam_from_world.center() - x).normalize())
        .collect();
    let mut widest: f64 = 0.0;
    for b in 1..directions.len() {
        for a in 0..b {
            let sine = directions[a].cross(&directions[b]).norm();
            widest = widest.max(sine.atan2(directions[a].dot(&directions[b])));
        }
    }
    widest
}

/// A pixel's ray in the world.
#[derive(Clone, Copy)]
struct WorldRay {
    center: Vector3<f64>,
    direction: Vector3<f64>,
}

impl WorldRay {
    fn new(view: &View) -> Option<Self> {
        let ray_in_cam = view.camera.ray(&view.xy_px)?;
        let direction = view.cam_from_world.rotation.inverse() * ray_in_cam;
        let center = view.cam_from_world.center();
        let finite = direction.iter().chain(center.iter()).all(|value| value.is_finite());
        finite.then_some(Self { center, direction })
    }
}

/// The point of least squared distance to the rays, each over its squared depth; coordinates relative to the first centre.
fn nearest_to_rays(rays: &[WorldRay]) -> Option<Vector3<f64>> {
    let origin = rays.first()?.center;
    let mut x = weighted_nearest(rays, &origin, |_| 1.0)?;
    if rays.len() > 2 {
        // For two rays the depths are the same from both lines; weights matter once three compete.
        let depths: SmallVec<[f64; 8]> = rays.iter().map(|ray| (x - ray.center).norm_squared()).collect();
        x = weighted_nearest(rays, &origin, |i| 1.0 / depths[i].max(f64::MIN_POSITIVE))?;
    }
    rays.iter().all(|ray| (x - ray.center).dot(&ray.direction) > 0.0).then_some(x)
}

fn weighted_nearest(
    rays: &[WorldRay],
    origin: &Vector3<f64>,
    weight: impl Fn(usize) -> f64,
) -> Option<Vector3<f64>> {
    let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
    for (i, ray) in rays.iter().enumerate() {
        let across = weight(i) * (Matrix3::identity() - ray.direction * ray.direction.transpose());
        a += across;
        b += across * (ray.center - origin);
    }
    Some(solve_positive_definite(&a, &b)? + origin)
}

/// The minimum of the reprojection error near a point that is ahead of all cameras.
fn refined(views: &[View], start: Vector3<f64>) -> Option<Vector3<f64>> {
    if views.len() < 2 {
        return None;
    }
    let options = LmOptions { max_iterations: 12, cost_tolerance: 1e-9, ..Default::default() };
    let (x, report) = small_lm::minimize(&PointProblem { views }, start, &options);
    report.final_cost.is_finite().then_some(x)
}

/// Squared reprojection errors over a point.
struct PointProblem<'a> {
    views: &'a [View],
}

impl LeastSquares<3> for PointProblem<'_> {
    type State = Vector3<f64>;

    fn cost(&self, x: &Vector3<f64>) -> f64 {
        0.5 * self.views.iter().map(|view| squared_error(view, x)).sum::<f64>()
    }

    fn linearize(&self, x: &Vector3<f64>, into: &mut NormalEquations<3>) {
        for view in self.views {
            let rotation = view.cam_from_world.rotation_matrix();
            let x_in_cam = rotation * x + view.cam_from_world.translation;
            let Some((pixel, d_point)) = view.camera.project_with_point_jacobian(&x_in_cam) else { continue };
            let (residual, jacobian) = (pixel - view.xy_px, d_point * rotation);
            for axis in 0..2 {
                let row = [jacobian[(axis, 0)], jacobian[(axis, 1)], jacobian[(axis, 2)]];
                into.add(1.0, residual[axis], &row);
            }
        }
    }

    fn retract(&self, x: &Vector3<f64>, step: &Vector3<f64>) -> Vector3<f64> {
        x + step
    }
}
