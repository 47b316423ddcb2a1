//! The bytes of blobs as values and back. Numbers are little-endian, matrices row after row.

use nalgebra::Matrix3;

use crate::{Keypoint, SceneError};

/// How many rows and columns a row of a table states, checked against the bytes that are there.
pub(super) fn table_size(what: &str, rows: i64, cols: i64) -> Result<(usize, usize), SceneError> {
    match (usize::try_from(rows), usize::try_from(cols)) {
        (Ok(rows), Ok(cols)) if rows <= u32::MAX as usize => Ok((rows, cols)),
        _ => Err(SceneError::corrupt(format!("{what} states a size of {rows} x {cols}"))),
    }
}

/// Checks that a blob has `rows * cols` entries of so many bytes.
fn check_len(what: &str, (rows, cols): (usize, usize), entry: usize, data: &[u8]) -> Result<(), SceneError> {
    let expected = rows.checked_mul(cols).and_then(|count| count.checked_mul(entry));
    if expected == Some(data.len()) {
        return Ok(());
    }
    Err(SceneError::corrupt(format!(
        "{what} states {rows} x {cols} entries of {entry} bytes and holds {} bytes",
        data.len()
    )))
}

/// Keypoints of two (place), four (place, scale, orientation) or six (place, affine shape) columns of 32-bit numbers.
pub(super) fn keypoints(what: &str, size: (usize, usize), data: &[u8]) -> Result<Vec<Keypoint>, SceneError> {
    let (rows, cols) = size;
    if !matches!(cols, 2 | 4 | 6) && rows > 0 {
        return Err(SceneError::corrupt(format!("{what} have {cols} columns: 2, 4 or 6 are known")));
    }
    check_len(what, size, 4, data)?;
    if rows == 0 {
        return Ok(Vec::new());
    }
    let mut found = Vec::with_capacity(rows);
    for (at, row) in data.chunks_exact(4 * cols).enumerate() {
        let mut values = [0.0_f32; 6];
        for (value, bytes) in values.iter_mut().zip(row.as_chunks::<4>().0) {
            *value = f32::from_le_bytes(*bytes);
        }
        let keypoint = keypoint(&values[..cols]);
        let is_usable = [keypoint.x_px, keypoint.y_px, keypoint.scale_px, keypoint.orientation_rad]
            .iter()
            .all(|value| value.is_finite());
        if !is_usable {
            return Err(SceneError::corrupt(format!("{what}: number {at} is not finite")));
        }
        found.push(keypoint);
    }
    Ok(found)
}

fn keypoint(values: &[f32]) -> Keypoint {
    let (x_px, y_px) = (values[0], values[1]);
    match *values {
        [_, _, scale_px, orientation_rad] => Keypoint { x_px, y_px, scale_px, orientation_rad },
        [_, _, a11, a12, a21, a22] => {
            // The mean length of the axes, and the direction of the first: what COLMAP takes of an affine shape.
            let length = |a: f32, b: f32| (f64::from(a) * f64::from(a) + f64::from(b) * f64::from(b)).sqrt();
            let scale_px = (0.5 * (length(a11, a21) + length(a12, a22))) as f32;
            Keypoint { x_px, y_px, scale_px, orientation_rad: angle(f64::from(a21), f64::from(a11)) as f32 }
        }
        _ => Keypoint { x_px, y_px, scale_px: 1.0, orientation_rad: 0.0 },
    }
}

/// The angle of (x, y) against the first axis in radians, to 1e-10: by arithmetic that is the same on every processor,
/// which the C library's is not.
pub(super) fn angle(y: f64, x: f64) -> f64 {
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_6, PI};
    if !x.is_finite() || !y.is_finite() {
        return f64::NAN;
    }
    let (largest, smallest) = (x.abs().max(y.abs()), x.abs().min(y.abs()));
    if largest == 0.0 {
        return 0.0;
    }
    let tangent = smallest / largest;
    // Turned by a twelfth where the series would be slow: |t| is at most tan(π/12) then.
    let root3 = 3.0_f64.sqrt();
    let is_large = tangent > 2.0 - root3;
    let t = if is_large { (root3 * tangent - 1.0) / (root3 + tangent) } else { tangent };
    let square = t * t;
    let series = (0..9).rev().fold(0.0, |sum, k| 1.0 / f64::from(2 * k + 1) - square * sum);
    let octant = t * series + if is_large { FRAC_PI_6 } else { 0.0 };
    let quadrant = if y.abs() > x.abs() { FRAC_PI_2 - octant } else { octant };
    let half = if x < 0.0 { PI - quadrant } else { quadrant };
    if y < 0.0 { -half } else { half }
}

/// Matches: two columns of 32-bit numbers.
pub(super) fn matches(what: &str, size: (usize, usize), data: &[u8]) -> Result<Vec<[u32; 2]>, SceneError> {
    if size.0 > 0 && size.1 != 2 {
        return Err(SceneError::corrupt(format!("{what} have {} columns instead of 2", size.1)));
    }
    check_len(what, size, 4, data)?;
    let row = |bytes: &[[u8; 4]; 2]| bytes.map(u32::from_le_bytes);
    Ok(data.as_chunks::<4>().0.as_chunks::<2>().0.iter().map(row).collect())
}

/// Bytes of one descriptor. COLMAP counts columns in bytes; others count numbers of two, four or eight bytes.
pub(super) fn descriptor_bytes(
    what: &str,
    (rows, cols): (usize, usize),
    num_bytes: usize,
) -> Result<usize, SceneError> {
    let fits = |entry: &usize| rows.checked_mul(cols).and_then(|n| n.checked_mul(*entry)) == Some(num_bytes);
    match [1, 2, 4, 8].iter().find(|entry| fits(entry)) {
        Some(entry) => Ok(cols * entry),
        None => Err(SceneError::corrupt(format!(
            "{what} state {rows} x {cols} entries and hold {num_bytes} bytes"
        ))),
    }
}

/// Parameters of a camera.
pub(super) fn doubles(what: &str, data: &[u8]) -> Result<Vec<f64>, SceneError> {
    let (numbers, rest) = data.as_chunks::<8>();
    if !rest.is_empty() {
        return Err(SceneError::corrupt(format!("{what} holds {} bytes, no multiple of 8", data.len())));
    }
    Ok(numbers.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect())
}

/// Numbers as bytes.
pub(super) fn bytes_of_doubles(values: impl IntoIterator<Item = f64>) -> Vec<u8> {
    values.into_iter().flat_map(f64::to_le_bytes).collect()
}

/// A matrix row after row.
pub(super) fn bytes_of_matrix(matrix: &Matrix3<f64>) -> Vec<u8> {
    bytes_of_doubles(matrix.transpose().iter().copied())
}

/// Keypoints of four columns.
pub(super) fn bytes_of_keypoints(keypoints: &[Keypoint]) -> Vec<u8> {
    let row = |k: &Keypoint| [k.x_px, k.y_px, k.scale_px, k.orientation_rad];
    keypoints.iter().flat_map(row).flat_map(f32::to_le_bytes).collect()
}

/// Matches of two columns.
pub(super) fn bytes_of_matches(matches: &[[u32; 2]]) -> Vec<u8> {
    matches.iter().flatten().flat_map(|index| index.to_le_bytes()).collect()
}
