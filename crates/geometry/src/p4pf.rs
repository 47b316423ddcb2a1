//! The pose and the focal length of a camera from four points and their pixels.
//!
//! The first two rows of the projection leave a space of four by `u (row 2) = v (row 1)`, and the third follows from them
//! (Bujnak, Kukelova & Pajdla 2008; Kukelova, Heller & Fitzgibbon 2016). That the rows of a rotation are orthogonal, and the
//! first two of one length, makes four quadrics in three unknowns: three are intersected, and four pixels, which have an
//! equation to spare, judge. Of points on one plane the homography gives the focal length in closed form.

use nalgebra::{Matrix3, Matrix4, Rotation3, SVector, UnitQuaternion, Vector2, Vector3, Vector4};
use smallvec::SmallVec;

use crate::Rigid3;
use crate::homography::homography_from_four;
use crate::quadrics::intersect_three_quadrics;
use crate::small_lm::{self, LeastSquares, LmOptions, NormalEquations};

/// Candidates that miss the pixels by more than this share of the pixels' size are no solutions: eight coordinates bind
/// seven unknowns.
const MAX_MISFIT: f64 = 0.01;
/// Four points whose volume is this small against their spread count as lying on one plane.
const MIN_RELATIVE_VOLUME: f64 = 1e-7;

/// A pose with its focal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseAndFocal {
    /// Pose of the camera.
    pub cam_from_world: Rigid3,
    /// Focal length of both axes, in pixels; positive.
    pub focal_px: f64,
}

/// Every pose and focal length under which a pinhole camera sees four points at these pixels, best first.
///
/// The pixels count from the principal point, without distortion. The eight coordinates bind seven unknowns: what is returned
/// minimises their squared error near a solution of seven, and misses by less than 1 % of the pixels' distance from the
/// principal point. None when three points or pixels are on a line, the points are on a plane parallel to the image (there
/// focal length and distance can't be told apart), or a value is not finite.
pub fn p4pf(offset_px: &[Vector2<f64>; 4], x_in_world: &[Vector3<f64>; 4]) -> SmallVec<[PoseAndFocal; 8]> {
    let Some(scaled) = Scaled::new(offset_px, x_in_world) else { return SmallVec::new() };
    let mut found = SmallVec::<[(f64, State); 8]>::new();
    for start in scaled.starts() {
        let Some((misfit, state)) = scaled.polished(&start) else { continue };
        if !found.iter().any(|(_, other)| state.is_near(other)) {
            found.push((misfit, state));
        }
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.iter().map(|(_, state)| scaled.unscaled(state)).collect()
}

/// Pose and focal length in the scaled frames.
#[derive(Clone, Copy, Debug)]
struct State {
    pose: Rigid3,
    focal: f64,
}

impl State {
    fn is_near(&self, other: &Self) -> bool {
        let turn = (self.pose.rotation.coords - other.pose.rotation.coords)
            .norm_squared()
            .min((self.pose.rotation.coords + other.pose.rotation.coords).norm_squared());
        turn < 1e-12 && (self.focal - other.focal).abs() < 1e-6 * self.focal
    }
}

/// Pixels of size about one, points about their mean of size about one.
struct Scaled {
    xy: [Vector2<f64>; 4],
    x: [Vector3<f64>; 4],
    px: f64,
    mean: Vector3<f64>,
    spread: f64,
}

impl Scaled {
    fn new(offset_px: &[Vector2<f64>; 4], x_in_world: &[Vector3<f64>; 4]) -> Option<Self> {
        let px = (offset_px.iter().map(|p| p.norm_squared()).sum::<f64>() / 4.0).sqrt();
        let mean = x_in_world.iter().sum::<Vector3<f64>>() / 4.0;
        let spread = (x_in_world.iter().map(|x| (x - mean).norm_squared()).sum::<f64>() / 4.0).sqrt();
        let usable = |value: f64| value > 0.0 && value.is_finite();
        (usable(px) && usable(spread)).then(|| Self {
            xy: offset_px.map(|p| p / px),
            x: x_in_world.map(|x| (x - mean) / spread),
            px,
            mean,
            spread,
        })
    }

    fn unscaled(&self, state: &State) -> PoseAndFocal {
        let rotation = state.pose.rotation;
        let translation = state.pose.translation * self.spread - rotation * self.mean;
        PoseAndFocal { cam_from_world: Rigid3::new(rotation, translation), focal_px: state.focal * self.px }
    }

    fn starts(&self) -> SmallVec<[State; 8]> {
        let homogeneous = Matrix4::from_fn(|i, j| if j < 3 { self.x[i][j] } else { 1.0 });
        if homogeneous.determinant().abs() < MIN_RELATIVE_VOLUME {
            return self.starts_of_plane();
        }
        match homogeneous.try_inverse() {
            Some(inverse) => self.starts_of_volume(&inverse),
            None => SmallVec::new(),
        }
    }

    /// `inverse` times the values of a row of the projection at the four points gives the row.
    fn starts_of_volume(&self, inverse: &Matrix4<f64>) -> SmallVec<[State; 8]> {
        // Row 1 and row 2 at point i are `d u` and `d v` for an unknown `d`: the depth over the focal length. So rows are
        // linear in the four `d`, as the third is: its values are `d` itself.
        let part = |values: [f64; 4]| inverse * Matrix4::from_diagonal(&Vector4::from(values));
        let rows = [part(self.xy.map(|p| p.x)), part(self.xy.map(|p| p.y)), part([1.0; 4])];
        let linear = rows.map(|row| row.fixed_rows::<3>(0).into_owned());
        let product = |a: usize, b: usize| {
            let q: Matrix4<f64> = linear[a].transpose() * linear[b];
            0.5 * (q + q.transpose())
        };
        let quadrics = [product(0, 1), product(0, 0) - product(1, 1), product(0, 2), product(1, 2)];
        let mut starts = SmallVec::new();
        for depths in candidates(&quadrics) {
            let d = if depths.sum() < 0.0 { -depths } else { depths };
            let [r1, r2, r3] = [0, 1, 2].map(|k| linear[k] * d);
            // With a scale s: row 1 and 2 are s f r, row 3 is s r.
            let across = 0.5 * (r1.norm() + r2.norm());
            let offsets = [0, 1, 2].map(|k| (rows[k] * d)[3]);
            let focal = across / r3.norm();
            if d.min() > 0.0 && focal.is_finite() {
                let matrix = Matrix3::from_rows(&[
                    r1.transpose() / across,
                    r2.transpose() / across,
                    r3.transpose() / r3.norm(),
                ]);
                let translation =
                    Vector3::new(offsets[0] / across, offsets[1] / across, offsets[2] / r3.norm());
                starts.extend(state_near(&matrix, translation, focal));
            }
        }
        starts
    }

    fn starts_of_plane(&self) -> SmallVec<[State; 8]> {
        let mut starts = SmallVec::new();
        let (first, second) = (self.x[1] - self.x[0], self.x[2] - self.x[0]);
        let Some(e1) = first.try_normalize(1e-9) else { return starts };
        let Some(e2) = (second - e1 * e1.dot(&second)).try_normalize(1e-9) else { return starts };
        let on_plane = self.x.map(|x| Vector2::new(e1.dot(&x), e2.dot(&x)));
        let Some(h) = homography_from_four(&on_plane, &self.xy) else { return starts };
        let (a, b, c) = (h.column(0), h.column(1), h.column(2));
        // Columns 1 and 2 are orthogonal and of one length under diag(w, w, 1), w = 1 / f².
        let across = |p: f64, q: f64| Vector2::new(p, q);
        let equations = [
            across(a.x * b.x + a.y * b.y, a.z * b.z),
            across(a.x * a.x + a.y * a.y - b.x * b.x - b.y * b.y, a.z * a.z - b.z * b.z),
        ];
        let squared = equations.iter().map(|e| e.x * e.x).sum::<f64>();
        let w = -equations.iter().map(|e| e.x * e.y).sum::<f64>() / squared;
        // Parallel to the image both equations vanish, and what is left of them is rounding.
        let size = (a.norm_squared() + b.norm_squared()).powi(2);
        if !(w > 1e-12 && w.is_finite() && squared > 1e-20 * size) {
            return starts;
        }
        let focal = 1.0 / w.sqrt();
        let metric = |v: Vector3<f64>| Vector3::new(v.x / focal, v.y / focal, v.z);
        let (r1, r2, t) = (metric(a.into()), metric(b.into()), metric(c.into()));
        let size = 0.5 * (r1.norm() + r2.norm());
        let size = if t.z < 0.0 { -size } else { size };
        let (r1, r2) = (r1 / size, r2 / size);
        let plane_from_world = Matrix3::from_columns(&[e1, e2, e1.cross(&e2)]).transpose();
        let matrix = Matrix3::from_columns(&[r1, r2, r1.cross(&r2)]) * plane_from_world;
        // The plane passes through the points' mean, which is the origin.
        starts.extend(state_near(&matrix, t / size, focal));
        starts
    }

    /// Least squares over all eight coordinates; with the root of the mean squared error.
    fn polished(&self, start: &State) -> Option<(f64, State)> {
        let options = LmOptions {
            max_iterations: 10,
            cost_tolerance: 1e-6,
            initial_damping: 1e-9,
            gradient_tolerance: 1e-15,
            ..Default::default()
        };
        let (state, report) = small_lm::minimize(self, *start, &options);
        let misfit = (report.final_cost / 4.0).sqrt();
        let finite = state.pose.translation.iter().all(|value| value.is_finite());
        (misfit < MAX_MISFIT && finite && state.focal > 0.0).then_some((misfit, state))
    }
}

/// Where three of the four quadrics meet; of two choices of three, that at which some point misses the fourth by less.
fn candidates(quadrics: &[Matrix4<f64>; 4]) -> SmallVec<[Vector4<f64>; 8]> {
    // What one choice loses near a double root the other may keep. A looser bound is met by wrong points when the four points
    // of the world nearly lie on a plane.
    const NEAR: f64 = 1e-10;
    let misfit = |points: &[Vector4<f64>]| {
        let worst =
            |p: &Vector4<f64>| quadrics.iter().map(|q| p.dot(&(q * p)).abs() / q.norm()).fold(0.0, f64::max);
        points.iter().map(worst).fold(f64::INFINITY, f64::min)
    };
    let first = intersect_three_quadrics(&[quadrics[0], quadrics[1], quadrics[2] + quadrics[3]]);
    let first_misfit = misfit(&first);
    if first_misfit < NEAR {
        return first;
    }
    let second = intersect_three_quadrics(&[quadrics[0] + quadrics[1], quadrics[2], quadrics[3]]);
    if misfit(&second) < first_misfit { second } else { first }
}

/// The state of which the rotation is nearest to a matrix by Gram–Schmidt; `None` for a mirrored or flat one.
fn state_near(matrix: &Matrix3<f64>, translation: Vector3<f64>, focal: f64) -> Option<State> {
    let z = matrix.row(2).transpose().try_normalize(0.0)?;
    let x = matrix.row(0).transpose();
    let x = (x - z * z.dot(&x)).try_normalize(0.0)?;
    let y = z.cross(&x);
    if !(y.dot(&matrix.row(1).transpose()) > 0.0) {
        return None;
    }
    let rotation =
        Rotation3::from_matrix_unchecked(Matrix3::from_rows(&[x.transpose(), y.transpose(), z.transpose()]));
    Some(State { pose: Rigid3::new(UnitQuaternion::from_rotation_matrix(&rotation), translation), focal })
}

impl LeastSquares<7> for Scaled {
    type State = State;

    fn cost(&self, state: &State) -> f64 {
        let mut cost = 0.0;
        for (x, xy) in self.x.iter().zip(&self.xy) {
            let seen = state.pose.transform_point(x);
            if !(seen.z > 0.0) {
                return f64::INFINITY;
            }
            cost += 0.5 * (seen.xy() * (state.focal / seen.z) - xy).norm_squared();
        }
        cost
    }

    fn linearize(&self, state: &State, into: &mut NormalEquations<7>) {
        for (x, xy) in self.x.iter().zip(&self.xy) {
            let seen = state.pose.transform_point(x);
            let (u, v) = (seen.x / seen.z, seen.y / seen.z);
            let (f, g) = (state.focal, state.focal / seen.z);
            let residual = Vector2::new(u, v) * f - xy;
            into.add(1.0, residual.x, &[-f * u * v, f * (1.0 + u * u), -f * v, g, 0.0, -g * u, f * u]);
            into.add(1.0, residual.y, &[-f * (1.0 + v * v), f * u * v, f * u, 0.0, g, -g * v, f * v]);
        }
    }

    fn retract(&self, state: &State, step: &SVector<f64, 7>) -> State {
        State {
            pose: state.pose.retract_left(&step.fixed_rows::<6>(0).into_owned()),
            focal: state.focal * step[6].exp(),
        }
    }
}

#[cfg(test)]
mod tests;
