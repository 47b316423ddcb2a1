//! Eight bits from samples that have more: thermal frames, dark scans and twelve bits in sixteen keep their contrast.
//!
//! Brightness that fills its range keeps its upper eight bits. Where 99.8 % of an image lie within a quarter of the
//! range, or samples are floating point, that part is stretched. The choice depends on the image alone.

/// Levels left free at either end of the eight bits for what lies beyond the quantiles.
const MARGIN: f32 = 12.0;
/// Share of the pixels below the lower and above the upper quantile.
const TAIL: f64 = 0.001;
/// Images whose brightness spans less of the 16 bits than this are stretched: a quarter.
const NARROW: f32 = 16_384.0;
/// Quantiles are taken from about so many pixels on a regular grid.
const MAX_SAMPLES: usize = 1 << 20;

/// A linear map to eight bits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Levels {
    low: f32,
    levels_per_unit: f32,
}

impl Levels {
    /// The level of a value; what is no number is black.
    pub fn apply(self, value: f32) -> u8 {
        // `as` saturates, and takes NaN to 0.
        ((value - self.low) * self.levels_per_unit + MARGIN + 0.5) as u8
    }

    fn between(low: f32, high: f32, min_span: f32) -> Self {
        let span = (high - low).max(min_span);
        let levels_per_unit =
            if span > 0.0 && span.is_finite() { (255.0 - 2.0 * MARGIN) / span } else { 0.0 };
        Self { low, levels_per_unit }
    }
}

/// `None` when the upper eight bits serve.
pub(super) fn of_sixteen_bits(luma: &[u16], width: usize) -> Option<Levels> {
    let mut values = on_grid(luma, width);
    values.sort_unstable();
    let (low, high) = quantiles(&values)?;
    let (low, high) = (f32::from(low), f32::from(high));
    // No more than one level a unit: beyond that only noise would grow.
    (high - low < NARROW).then(|| Levels::between(low, high, 255.0))
}

pub(super) fn of_floats(luma: &[f32], width: usize) -> Levels {
    let mut values = on_grid(luma, width);
    values.retain(|value| value.is_finite());
    values.sort_unstable_by(f32::total_cmp);
    let (low, high) = quantiles(&values).unwrap_or((0.0, 0.0));
    Levels::between(low, high, 0.0)
}

fn quantiles<T: Copy>(sorted: &[T]) -> Option<(T, T)> {
    let tail = (sorted.len() as f64 * TAIL) as usize;
    Some((*sorted.get(tail)?, *sorted.get(sorted.len().checked_sub(tail + 1)?)?))
}

/// Every n-th pixel of every n-th row.
fn on_grid<T: Copy>(luma: &[T], width: usize) -> Vec<T> {
    let step = ((luma.len() / MAX_SAMPLES) as f64).sqrt().ceil().max(1.0) as usize;
    luma.chunks(width.max(1)).step_by(step).flat_map(|row| row.iter().step_by(step).copied()).collect()
}
