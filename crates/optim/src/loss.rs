//! Robust losses for iteratively re-weighted least squares.

use serde::{Deserialize, Serialize};

/// A robust loss `ρ(s)` of a squared residual norm `s`, with `ρ(s) ≈ s` near zero; the cost of a residual is `ρ / 2`.
///
/// With `a` the scale, a length in the residual's unit beyond which a residual counts as an outlier.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// `s`: least squares.
    #[default]
    Squared,
    /// `s` up to `a²`, then `2 a √s − a²` (Huber 1964).
    Huber,
    /// `2 a² (√(1 + s/a²) − 1)`: Huber's, smooth.
    SoftL1,
    /// `a² ln(1 + s/a²)`: forgets outliers slowly.
    Cauchy,
    /// `s / (1 + s/a²)` (Geman & McClure 1985): forgets outliers, but is no longer convex from `a/√3` on.
    GemanMcclure,
}

impl Loss {
    /// `ρ(s)` and its derivative, the weight of the squared residual. `scale` must be positive.
    #[inline(always)]
    pub fn evaluate(self, squared_norm: f64, scale: f64) -> (f64, f64) {
        let s = squared_norm;
        match self {
            Self::Squared => (s, 1.0),
            Self::Huber => {
                if s <= scale * scale {
                    (s, 1.0)
                } else {
                    let norm = s.sqrt();
                    (2.0 * scale * norm - scale * scale, scale / norm)
                }
            }
            Self::SoftL1 => {
                let root = (1.0 + s / (scale * scale)).sqrt();
                // 2 a² (root − 1), without cancellation.
                (2.0 * s / (root + 1.0), 1.0 / root)
            }
            Self::Cauchy => {
                let ratio = s / (scale * scale);
                (scale * scale * ratio.ln_1p(), 1.0 / (1.0 + ratio))
            }
            Self::GemanMcclure => {
                let inverse = 1.0 / (1.0 + s / (scale * scale));
                (s * inverse, inverse * inverse)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Loss; 5] = [Loss::Squared, Loss::Huber, Loss::SoftL1, Loss::Cauchy, Loss::GemanMcclure];

    #[test]
    fn weight_is_the_derivative_and_losses_start_as_squared() {
        for loss in ALL {
            for s in [1e-3, 0.4, 2.0, 30.0] {
                let scale = 1.5;
                let h = 1e-6 * s;
                let difference = (loss.evaluate(s + h, scale).0 - loss.evaluate(s - h, scale).0) / (2.0 * h);
                assert!((difference - loss.evaluate(s, scale).1).abs() < 1e-6, "{loss:?} at {s}");
            }
            let (rho, weight) = loss.evaluate(1e-10, 1.0);
            assert!((rho - 1e-10).abs() < 1e-18 && (weight - 1.0).abs() < 1e-9, "{loss:?}");
        }
    }
}
