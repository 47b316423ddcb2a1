//! Camera centres against surveyed ones, by the rule that the field's tables use.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Matrix3, Vector3};

/// Distances of camera centres from the truth after a robust similarity, in the truth's unit.
#[derive(Clone, Debug)]
pub struct Judgement {
    /// Photographs that have both a pose and a truth.
    pub registered: usize,
    /// Photographs that have a truth.
    pub of: usize,
    /// Median distance.
    pub median_m: f64,
    /// Root of the mean square over all registered photographs.
    pub rmse_m: f64,
}

/// Camera centres by file name from a folder of `.camera` files as Strecha et al. (2008) publish them.
pub fn strecha_centers(folder: &Path) -> BTreeMap<String, Vector3<f64>> {
    let mut centers = BTreeMap::new();
    for entry in std::fs::read_dir(folder).expect("the truth is readable").flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let Some(image) = name.strip_suffix(".camera") else { continue };
        let text = std::fs::read_to_string(entry.path()).expect("the truth is text");
        let rows: Vec<Vec<f64>> = text
            .lines()
            .map(|line| line.split_whitespace().filter_map(|word| word.parse().ok()).collect())
            .collect();
        let [x, y, z] = rows[7][..] else { panic!("{name}: the eighth line is the centre") };
        centers.insert(image.to_owned(), Vector3::new(x, y, z));
    }
    centers
}

/// Judges camera centres by name. The fit leaves out what lies beyond three medians and starts again, as long as that
/// changes anything; the distances count every registered photograph.
pub fn judge(
    centers: &BTreeMap<String, Vector3<f64>>,
    truth: &BTreeMap<String, Vector3<f64>>,
) -> Option<Judgement> {
    let (from, to): (Vec<_>, Vec<_>) =
        truth.iter().filter_map(|(name, x)| centers.get(name).map(|center| (*center, *x))).unzip();
    if from.len() < 4 {
        return None;
    }
    let mut kept = vec![true; from.len()];
    let mut errors = Vec::new();
    for _ in 0..20 {
        errors = fit_errors(&from, &to, &kept);
        let limit = (3.0 * median(&errors)).max(1e-9);
        let next: Vec<bool> = errors.iter().map(|error| *error <= limit).collect();
        if next == kept || next.iter().filter(|keep| **keep).count() < 4 {
            break;
        }
        kept = next;
    }
    let mean_square = errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64;
    Some(Judgement {
        registered: from.len(),
        of: truth.len(),
        median_m: median(&errors),
        rmse_m: mean_square.sqrt(),
    })
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 { sorted[middle] } else { 0.5 * (sorted[middle - 1] + sorted[middle]) }
}

/// Distances after the least-squares similarity over the kept ones (Umeyama 1991).
fn fit_errors(from: &[Vector3<f64>], to: &[Vector3<f64>], kept: &[bool]) -> Vec<f64> {
    let pairs: Vec<_> =
        from.iter().zip(to).zip(kept).filter(|(_, keep)| **keep).map(|(pair, _)| pair).collect();
    let count = pairs.len() as f64;
    let mean_from = pairs.iter().map(|(a, _)| **a).sum::<Vector3<f64>>() / count;
    let mean_to = pairs.iter().map(|(_, b)| **b).sum::<Vector3<f64>>() / count;
    let mut covariance = Matrix3::zeros();
    let mut variance = 0.0;
    for (a, b) in &pairs {
        covariance += (*b - mean_to) * (*a - mean_from).transpose() / count;
        variance += (*a - mean_from).norm_squared() / count;
    }
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u.expect("asked for"), svd.v_t.expect("asked for"));
    let mut signs = Vector3::repeat(1.0);
    signs.z = (u * v_t).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&signs) * v_t;
    let scale = svd.singular_values.dot(&signs) / variance;
    from.iter().zip(to).map(|(a, b)| (scale * (rotation * (a - mean_from)) + mean_to - b).norm()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> BTreeMap<String, Vector3<f64>> {
        (0..9)
            .map(|i| {
                (
                    format!("{i}.jpg"),
                    Vector3::new(f64::from(i % 3), f64::from(i / 3), f64::from(i * i) / 20.0),
                )
            })
            .collect()
    }

    #[test]
    fn a_similarity_is_no_error_and_a_moved_camera_is_one() {
        let truth = scene();
        let moved = |x: &Vector3<f64>| 2.0 * Vector3::new(-x.y, x.x, x.z) + Vector3::new(1.0, 2.0, 3.0);
        let mut centers: BTreeMap<_, _> = truth.iter().map(|(name, x)| (name.clone(), moved(x))).collect();
        let same = judge(&centers, &truth).expect("enough cameras");
        assert!(same.rmse_m < 1e-12 && same.registered == 9, "{same:?}");
        centers.get_mut("4.jpg").expect("there").x += 3.0;
        let one_off = judge(&centers, &truth).expect("enough cameras");
        // The fit leaves the moved camera out: its error is the whole 1.5, in the truth's unit.
        assert!((one_off.rmse_m - 1.5 / 3.0).abs() < 1e-9 && one_off.median_m < 1e-9, "{one_off:?}");
    }
}
