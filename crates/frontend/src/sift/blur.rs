//! Gaussian kernels.
//!
//! An image that is blurred already holds next to nothing at high frequencies, so that a further blur may skip pixels: a
//! kernel with taps at every d-th pixel is the Gaussian plus its repetitions at multiples of the frequency 2π/d, and the
//! image has nothing there for them to act on (the algorithme à trous: Holschneider et al. 1989). The spacing is the
//! largest whose worst error, relative to the contrast of a grating, is below [`MAX_ALIAS`].

use super::isa::Isa;
use super::math::exp;
use super::rows::{MARGIN, MAX_TAPS};
use super::weighted::{Term, WEIGHT_BITS, sum_weighted};

/// The largest error that sparse taps may make, as a part of any grating's contrast.
const MAX_ALIAS: f64 = 3e-4;

/// A symmetric kernel: weights, which add up to 2¹⁵, by distance from its centre in pixels.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Taps {
    /// Distances rounded down: of a kernel centred between pixels 0 and 1, the pixel 1 lies at 1.
    distances: Vec<isize>,
    weights: Vec<i16>,
}

impl Taps {
    /// A Gaussian of a standard deviation in pixels, at most 4, cut off at four standard deviations, with taps at every
    /// pixel and its centre on a pixel or `between` two.
    pub(super) fn gaussian(sigma_px: f64, between: bool) -> Self {
        Self::spaced(sigma_px, 1, between)
    }

    /// The Gaussian that takes an image from a blur of `from_px` to one of `to_px`.
    pub(super) fn increment(from_px: f64, to_px: f64) -> Self {
        let (from, added) = (from_px * from_px, to_px * to_px - from_px * from_px);
        let alias = |spacing: usize| {
            let repetition = std::f64::consts::TAU / spacing as f64;
            exp(-0.5 * repetition * repetition * from * added / (from + added))
        };
        let spacing = (2..=4).take_while(|&spacing| alias(spacing) < MAX_ALIAS).last().unwrap_or(1);
        Self::spaced(added.sqrt(), spacing, false)
    }

    /// Taps whose weight is rounded to nothing are left out.
    fn spaced(sigma_px: f64, spacing: usize, between: bool) -> Self {
        let start = if between { 0.5 } else { 0.0 };
        let arm = ((4.0 * sigma_px - start) / spacing as f64).ceil().max(0.0) as usize;
        let arm = arm.min((MAX_TAPS - 2) / 2).min((MARGIN - 1) / spacing) as isize;
        let first = -arm;
        let last = if between { arm + 1 } else { arm };
        let distances: Vec<isize> = (first..=last).map(|k| k * spacing as isize).collect();
        let exact: Vec<f64> = distances
            .iter()
            .map(|distance| {
                let distance = (*distance as f64 - start) / sigma_px;
                exp(-0.5 * distance * distance)
            })
            .collect();
        let weights = fixed(&exact);
        let idle = weights.iter().take_while(|weight| **weight == 0).count();
        let used = idle..weights.len() - idle;
        Self { distances: distances[used.clone()].to_vec(), weights: weights[used].to_vec() }
    }

    /// How many pixels away from the centre's (rounded down) the kernel looks.
    pub(super) fn radius(&self) -> usize {
        self.distances.last().map_or(0, |distance| distance.unsigned_abs())
    }

    /// One row: the blur along columns of the rows that `row` gives for row numbers, possibly outside the image.
    pub(super) fn blur_rows<'a>(
        &self,
        isa: Isa,
        center: usize,
        row: impl Fn(isize) -> &'a [i16],
        out: &mut [i16],
    ) {
        let mut terms = [Term::default(); MAX_TAPS];
        for (term, (distance, weight)) in terms.iter_mut().zip(self.distances.iter().zip(&self.weights)) {
            *term = Term { pixels: row(center as isize + distance), weight: *weight };
        }
        sum_weighted(isa, &terms[..self.weights.len()], out);
    }

    /// The blur along a row whose pixel 0 stands at [`MARGIN`].
    pub(super) fn blur_columns(&self, isa: Isa, padded: &[i16], out: &mut [i16]) {
        let mut terms = [Term::default(); MAX_TAPS];
        for (term, (distance, weight)) in terms.iter_mut().zip(self.distances.iter().zip(&self.weights)) {
            *term = Term { pixels: &padded[MARGIN.wrapping_add_signed(*distance)..], weight: *weight };
        }
        sum_weighted(isa, &terms[..self.weights.len()], out);
    }
}

/// Weights as parts of 2¹⁵; what rounding leaves over goes to the middle.
fn fixed(exact: &[f64]) -> Vec<i16> {
    const ONE: i32 = 1 << WEIGHT_BITS;
    let sum: f64 = exact.iter().sum();
    let mut weights: Vec<i32> = exact.iter().map(|w| (w / sum * f64::from(ONE)).round() as i32).collect();
    let rest = ONE - weights.iter().sum::<i32>();
    let middle = weights.len() / 2;
    match weights.len() % 2 {
        1 => weights[middle] += rest,
        // A rest is even here, for the kernel is symmetric.
        _ => weights[middle - 1..=middle].iter_mut().for_each(|weight| *weight += rest / 2),
    }
    weights.into_iter().map(|weight| weight.clamp(0, ONE - 1) as i16).collect()
}

/// Repeats the first and the last of `width` pixels, which start at [`MARGIN`], into the margins.
pub(super) fn fill_margins(padded: &mut [i16], width: usize) {
    let first = padded[MARGIN];
    padded[..MARGIN].fill(first);
    let last = padded[MARGIN + width - 1];
    padded[MARGIN + width..].fill(last);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a kernel makes of a grating's contrast, and a Gaussian's exact answer.
    fn responses(taps: &Taps, sigma_px: f64, frequency: f64) -> (f64, f64) {
        let sum = |(distance, weight): (&isize, &i16)| {
            f64::from(*weight) / 32_768.0 * (frequency * *distance as f64).cos()
        };
        let got = taps.distances.iter().zip(&taps.weights).map(sum).sum();
        (got, (-0.5 * (frequency * sigma_px).powi(2)).exp())
    }

    #[test]
    fn increments_blur_as_gaussians_do_what_the_image_still_holds() {
        for level in 0..5 {
            let (from, to) =
                (1.6 * 2.0_f64.powf(level as f64 / 3.0), 1.6 * 2.0_f64.powf((level + 1) as f64 / 3.0));
            let taps = Taps::increment(from, to);
            assert_eq!(taps.weights.iter().map(|w| i32::from(*w)).sum::<i32>(), 32_768);
            assert!(taps.distances.len() <= 15 && taps.radius() <= 15);
            assert!(taps.weights.iter().all(|weight| *weight > 0));
            for k in 0..=100 {
                let frequency = std::f64::consts::PI * f64::from(k) / 100.0;
                let (got, exact) = responses(&taps, (to * to - from * from).sqrt(), frequency);
                let held = (-0.5 * (frequency * from).powi(2)).exp();
                assert!(held * (got - exact).abs() < 5e-4, "{level} {frequency}: {got} {exact}");
            }
        }
    }
}
