//! Medians and robust spreads.

/// Factor from the median absolute deviation to the standard deviation of a Gaussian.
pub(crate) const SIGMA_FROM_MAD: f64 = 1.4826;

/// The median (upper of the two for an even count), or `None` when empty. Reorders `values`.
pub(crate) fn median(values: &mut [f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// The value at a fraction of the sorted order, or `None` when empty. Reorders `values`.
pub(crate) fn quantile(values: &mut [f64], fraction: f64) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let at = ((values.len() as f64 * fraction) as usize).min(values.len() - 1);
    let (_, value, _) = values.select_nth_unstable_by(at, f64::total_cmp);
    Some(*value)
}

/// Root of the mean of squares; zero when empty.
pub(crate) fn rms(values: &[f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    (values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_and_rms_of_known_values() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [4.0, 1.0, 2.0, 3.0]), Some(3.0));
        assert_eq!(median(&mut []), None);
        assert_eq!(quantile(&mut [1.0, 2.0, 3.0, 4.0], 1.0), Some(4.0));
        assert!((rms(&[3.0, 4.0]) - 12.5f64.sqrt()).abs() < 1e-12);
        assert_eq!(rms(&[]), 0.0);
    }
}
