//! Focal lengths, principal point and poses in closed form, from homographies.

use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, UnitQuaternion, Vector2, Vector3};

use super::refine::{State, cost};
use super::{CalibrationError, MIN_TILT, PlanarView, largest_sine};
use crate::linear::{proper_svd3, symmetric_eigen};
use crate::{Camera, Rigid3};

/// When no camera fits and the planes seem less tilted than this, distortion feigned the tilt.
const DOUBTFUL_TILT: f64 = 0.2;

/// Of the closed form and of the one with the principal point in the image's centre, that with the lower error.
pub(super) fn best(
    views: &[PlanarView<'_>],
    homographies: &[Matrix3<f64>],
    blank: &Camera,
) -> Result<State, CalibrationError> {
    let size = 0.5 * f64::from(blank.width_px.max(blank.height_px)).max(1.0);
    let center = blank.principal_point_px();
    // Pixels about the centre, of size one.
    let moved = Matrix3::new(1.0, 0.0, -center.x, 0.0, 1.0, -center.y, 0.0, 0.0, size) / size;
    let scaled: Vec<Matrix3<f64>> = homographies.iter().map(|h| (moved * h).normalize()).collect();
    let normals: Vec<Vector3<f64>> = scaled.iter().filter_map(seeming_normal).collect();
    let tilt = largest_sine(&normals);
    if !(tilt > MIN_TILT) {
        return Err(CalibrationError::ParallelViews);
    }
    let rows: Vec<[SVector<f64, 5>; 2]> = scaled.iter().map(constraints).collect();
    let guesses = [closed_form(&rows), centered(&rows)];
    let mut found: Option<(f64, State)> = None;
    for (focal, offset) in guesses.into_iter().flatten() {
        let mut camera = *blank;
        let count = camera.model.num_focal();
        let mean = 0.5 * (focal.x + focal.y);
        let focal = if count == 2 { focal } else { Vector2::repeat(mean) };
        camera.params_mut()[0] = focal.x * size;
        camera.params_mut()[count - 1] = focal.y * size;
        camera.params_mut()[count] = center.x + offset.x * size;
        camera.params_mut()[count + 1] = center.y + offset.y * size;
        let poses = scaled.iter().map(|h| pose(h, &focal, &offset)).collect::<Option<Vec<_>>>();
        let Some(cam_from_target) = poses else { continue };
        let state = State { camera, cam_from_target };
        let cost = cost(views, &state);
        if cost.is_finite() && found.as_ref().is_none_or(|(least, _)| cost < *least) {
            found = Some((cost, state));
        }
    }
    let reason =
        if tilt < DOUBTFUL_TILT { CalibrationError::ParallelViews } else { CalibrationError::NoCamera };
    found.map(|(_, state)| state).ok_or(reason)
}

/// The target's normal as a camera with a usual field of view would see it: the image of its line at infinity, back-projected.
fn seeming_normal(h: &Matrix3<f64>) -> Option<Vector3<f64>> {
    const USUAL_FOCAL: f64 = 2.0;
    let line = h.column(0).cross(&h.column(1));
    Vector3::new(line.x * USUAL_FOCAL, line.y * USUAL_FOCAL, line.z).try_normalize(0.0)
}

/// Zhang's two constraints on (B11, B22, B13, B23, B33), for axes without skew.
fn constraints(h: &Matrix3<f64>) -> [SVector<f64, 5>; 2] {
    let row = |i: usize, j: usize| {
        let (a, b) = (h.column(i), h.column(j));
        SVector::<f64, 5>::from([
            a.x * b.x,
            a.y * b.y,
            a.x * b.z + a.z * b.x,
            a.y * b.z + a.z * b.y,
            a.z * b.z,
        ])
    };
    [row(0, 1), row(0, 0) - row(1, 1)]
}

/// Focal lengths and principal point, in the scaled pixels.
fn closed_form(rows: &[[SVector<f64, 5>; 2]]) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let mut sums = SMatrix::<f64, 5, 5>::zeros();
    for row in rows.iter().flatten() {
        sums += row * row.transpose();
    }
    let (_, vectors) = symmetric_eigen(sums);
    let b = vectors.column(0);
    let offset = Vector2::new(-b[2] / b[0], -b[3] / b[1]);
    let scale = b[4] + b[2] * offset.x + b[3] * offset.y;
    let squared = Vector2::new(scale / b[0], scale / b[1]);
    let plausible = squared.min() > 1e-4 && squared.max() < 1e6 && offset.amax() < 1.0;
    plausible.then(|| (squared.map(f64::sqrt), offset))
}

/// The focal length when the principal point is in the centre.
fn centered(rows: &[[SVector<f64, 5>; 2]]) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let (mut square, mut product) = (0.0, 0.0);
    for row in rows.iter().flatten() {
        square += (row[0] + row[1]) * (row[0] + row[1]);
        product -= (row[0] + row[1]) * row[4];
    }
    let inverse_squared = product / square;
    let focal = 1.0 / inverse_squared.sqrt();
    (focal.is_finite() && focal > 0.0).then(|| (Vector2::repeat(focal), Vector2::zeros()))
}

/// The target's pose ahead of the camera.
fn pose(h: &Matrix3<f64>, focal: &Vector2<f64>, offset: &Vector2<f64>) -> Option<Rigid3> {
    let inverse = |v: Vector3<f64>| {
        Vector3::new((v.x - offset.x * v.z) / focal.x, (v.y - offset.y * v.z) / focal.y, v.z)
    };
    let columns = [0, 1, 2].map(|k| inverse(h.column(k).into_owned()));
    let size = 0.5 * (columns[0].norm() + columns[1].norm()) * columns[2].z.signum();
    let [x, y, t] = columns.map(|column| column / size);
    let (u, _, v) = proper_svd3(&Matrix3::from_columns(&[x, y, x.cross(&y)]))?;
    let rotation = Rotation3::from_matrix_unchecked(u * v.transpose());
    let pose = Rigid3::new(UnitQuaternion::from_rotation_matrix(&rotation), t);
    t.iter().all(|value| value.is_finite()).then_some(pose)
}
