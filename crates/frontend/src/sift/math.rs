//! exp, sine, cosine and direction from arithmetic alone.
//!
//! The C library picks its implementations by the processor and by its version, and their last bits differ; features
//! must not. Everything here is made of IEEE operations that every machine rounds alike.

use std::f64::consts::{FRAC_PI_2, LN_2, LOG2_E};

/// exp(x) in double precision, by splitting off a power of two and a Taylor series of degree 13; relative error below 1e-15.
pub(super) fn exp(x: f64) -> f64 {
    if x < -700.0 {
        return 0.0;
    }
    let power = (x.min(700.0) * LOG2_E).round();
    let rest = x.min(700.0) - power * LN_2;
    let mut sum = 1.0;
    for k in (1..=13).rev() {
        sum = 1.0 + sum * rest / f64::from(k);
    }
    sum * f64::from_bits(((power as i64 + 1023) as u64) << 52)
}

/// exp(x) for x in [-80, 0] in single precision: relative error below 3e-7. Inlined into kernels, where it becomes vectors.
#[inline(always)]
pub(super) fn exp_f32(x: f32) -> f32 {
    /// Adding it rounds to an integer, which then stands in the low bits.
    const MAGIC: f32 = 12_582_912.0;
    let shifted = x.mul_add(std::f32::consts::LOG2_E, MAGIC);
    let power = shifted - MAGIC;
    let rest = power.mul_add(-std::f32::consts::LN_2, x);
    let mut sum = 1.0 / 720.0_f32;
    for term in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        sum = sum.mul_add(rest, term);
    }
    let exponent = shifted.to_bits().wrapping_sub(MAGIC.to_bits()).wrapping_add(127) << 23;
    sum * f32::from_bits(exponent)
}

/// Cosine and sine of an angle between -10 and 10 radians.
pub(super) fn cos_sin(angle: f64) -> (f64, f64) {
    let quarter = (angle / FRAC_PI_2).round();
    let rest = angle - quarter * FRAC_PI_2;
    let square = rest * rest;
    let (mut cosine, mut sine) = (1.0, 1.0);
    for k in (1..=8).rev() {
        let k = f64::from(k);
        cosine = 1.0 - cosine * square / ((2.0 * k - 1.0) * (2.0 * k));
        sine = 1.0 - sine * square / ((2.0 * k) * (2.0 * k + 1.0));
    }
    sine *= rest;
    match (quarter as i64).rem_euclid(4) {
        0 => (cosine, sine),
        1 => (-sine, cosine),
        2 => (-cosine, -sine),
        _ => (sine, -cosine),
    }
}

/// The direction of (x, y) in eighths of a turn, in [0, 8]: error below 2e-5 eighths.
#[inline(always)]
pub(super) fn direction_in_eighths(x: f32, y: f32) -> f32 {
    let (across, along) = (x.abs(), y.abs());
    let steep = along > across;
    let (small, large) = if steep { (across, along) } else { (along, across) };
    let ratio = small / (large + f32::MIN_POSITIVE);
    let square = ratio * ratio;
    // Minimax polynomial of the arc tangent on [0, 1].
    let mut sum = -0.011_721_2_f32;
    for coefficient in [0.052_653_32, -0.116_432_87, 0.193_543_46, -0.332_623_47, 0.999_977_26] {
        sum = sum.mul_add(square, coefficient);
    }
    let eighths = sum * ratio * (4.0 * std::f32::consts::FRAC_1_PI);
    let first = if steep { 2.0 - eighths } else { eighths };
    let upper = if x < 0.0 { 4.0 - first } else { first };
    if y < 0.0 { 8.0 - upper } else { upper }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn functions_agree_with_the_library_s() {
        for i in -4000..=4000 {
            let x = f64::from(i) * 0.002;
            let (cosine, sine) = cos_sin(x);
            assert!((cosine - x.cos()).abs() < 1e-13 && (sine - x.sin()).abs() < 1e-13, "{x}");
            let far = x * 10.0 - 80.0;
            assert!((exp(far) / far.exp() - 1.0).abs() < 1e-13, "{far}");
            let single = (x - 8.0) as f32 * 5.0;
            assert!((f64::from(exp_f32(single)) / f64::from(single).exp() - 1.0).abs() < 6e-6, "{single}");
            let eighths = f64::from(direction_in_eighths(cosine as f32, sine as f32));
            let turn = (x / std::f64::consts::TAU * 8.0 - eighths) / 8.0;
            assert!((turn - turn.round()).abs() < 1e-5, "{x} {eighths}");
        }
        assert!((0.0..=8.0).contains(&direction_in_eighths(0.0, 0.0)));
    }
}
