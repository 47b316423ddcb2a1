//! Elementary functions whose bits do not depend on the processor.
//!
//! The system's mathematical library picks other code on other processors, and its last bit may differ. What decides about
//! samples, models and stored angles uses these: additions, multiplications, divisions and square roots only, all of which
//! IEEE 754 defines exactly.

/// The natural logarithm, to 1e-15 of its size or of one; of zero minus infinity, of negative numbers not a number.
pub(crate) fn natural_log(x: f64) -> f64 {
    if !(x > 0.0) {
        return if x == 0.0 { f64::NEG_INFINITY } else { f64::NAN };
    }
    if x == f64::INFINITY {
        return x;
    }
    // Subnormal numbers are lifted by 2^54 first.
    let (x, lifted) = if x < f64::MIN_POSITIVE { (x * 18_014_398_509_481_984.0, 54.0) } else { (x, 0.0) };
    let bits = x.to_bits();
    let mut exponent = ((bits >> 52) as i64 - 1023) as f64 - lifted;
    let mut mantissa = f64::from_bits((bits & 0x000f_ffff_ffff_ffff) | 0x3ff0_0000_0000_0000);
    if mantissa > std::f64::consts::SQRT_2 {
        mantissa *= 0.5;
        exponent += 1.0;
    }
    // ln m = 2 artanh((m - 1) / (m + 1)), whose argument is below 0.172.
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    exponent * std::f64::consts::LN_2 + 2.0 * s * odd_series(s * s, 1.0)
}

/// `ln(1 - p)` for p from 0 to 1, exact also for tiny p.
pub(crate) fn log_of_complement(p: f64) -> f64 {
    if p < 1e-5 { -p * (1.0 + p * (0.5 + p / 3.0)) } else { natural_log(1.0 - p) }
}

/// The angle in [0, π] of a direction with this sine (not negative) and cosine, of any common scale; zero for two zeros.
pub(crate) fn angle_rad(sine: f64, cosine: f64) -> f64 {
    if sine.is_nan() || cosine.is_nan() {
        return f64::NAN;
    }
    let (low, high) = if cosine.abs() < sine { (cosine.abs(), sine) } else { (sine, cosine.abs()) };
    if !(high > 0.0) {
        return 0.0;
    }
    // tan(a / 2) = t / (1 + √(1 + t²)), three times, leaves an argument below 0.099.
    let mut t = low / high;
    for _ in 0..3 {
        t /= 1.0 + (1.0 + t * t).sqrt();
    }
    let acute = 8.0 * t * odd_series(t * t, -1.0);
    let first_quadrant = if cosine.abs() < sine { std::f64::consts::FRAC_PI_2 - acute } else { acute };
    if cosine < 0.0 { std::f64::consts::PI - first_quadrant } else { first_quadrant }
}

/// `1 + g z/3 + z²/5 + g z³/7 + …`, the series of artanh (`g` one) and arctan (`g` minus one) over their argument.
fn odd_series(z: f64, g: f64) -> f64 {
    let z = g * z;
    (0..11).rev().fold(0.0, |sum, k| sum * z + 1.0 / f64::from(2 * k + 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_agree_with_the_library() {
        for k in -3000..3000 {
            let x = 1.2_f64.powi(k) * 1.01;
            if x.is_normal() {
                let (ours, theirs) = (natural_log(x), x.ln());
                assert!((ours - theirs).abs() <= 1e-15 * theirs.abs().max(1.0), "{x}: {ours} {theirs}");
            }
        }
        assert!((natural_log(1e-320) - 1e-320_f64.ln()).abs() < 1e-10);
        assert_eq!((natural_log(1.0), natural_log(0.0)), (0.0, f64::NEG_INFINITY));
        assert!(natural_log(-1.0).is_nan() && natural_log(f64::NAN).is_nan());
        for p in [0.0_f64, 1e-300, 1e-12, 1e-6, 0.9e-5, 1.1e-5, 0.3, 0.999] {
            let theirs = (-p).ln_1p();
            assert!((log_of_complement(p) - theirs).abs() <= 1e-10 * theirs.abs(), "{p}");
        }
    }

    #[test]
    fn angles_agree_with_the_library() {
        for k in 0..=1000 {
            let angle = std::f64::consts::PI * f64::from(k) / 1000.0;
            let (sine, cosine) = (angle.sin().max(0.0), angle.cos());
            let ours = angle_rad(sine * 3.0, cosine * 3.0);
            assert!((ours - angle).abs() < 1e-15 * 4.0, "{angle} {ours}");
        }
        assert!((angle_rad(1e-9, 1.0) - 1e-9).abs() < 1e-24);
        assert_eq!(angle_rad(0.0, 0.0), 0.0);
        assert!(angle_rad(f64::NAN, 1.0).is_nan());
    }
}
