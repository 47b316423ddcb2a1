//! Samples from the bytes of a row: predictors undone, byte orders and bit depths brought to u8, u16 or f32.

use super::directory::Order;
use crate::image::canvas::Sample;

/// How the samples of a file are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Encoding {
    pub bits: usize,
    pub kind: Kind,
    pub order: Order,
    pub predictor: Predictor,
    /// White is 0.
    pub is_inverted: bool,
    /// Samples of fewer than eight bits are indices and not scaled.
    pub is_palette: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Unsigned,
    Signed,
    Float,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Predictor {
    None,
    /// Differences of neighbours.
    Horizontal,
    /// Differences of bytes, after the bytes of a row are sorted by significance (Adobe Photoshop TIFF note 3).
    Float,
}

/// Bytes of a row of so many samples.
pub(super) fn row_bytes(num_samples: usize, bits: usize) -> usize {
    (num_samples * bits).div_ceil(8)
}

/// Undoes the predictor of a row in place; `stride` samples lie from a pixel to the next. The row is in the file's byte
/// order afterwards, or big-endian after the floating-point predictor.
pub(super) fn undo_predictor(row: &mut [u8], stride: usize, encoding: &mut Encoding, scratch: &mut Vec<u8>) {
    match (encoding.predictor, encoding.bits) {
        (Predictor::Horizontal, 8) => {
            (stride..row.len()).for_each(|k| row[k] = row[k].wrapping_add(row[k - stride]))
        }
        (Predictor::Horizontal, 16) => undo_words::<2>(row, stride, |a, b| {
            let order = encoding.order;
            let sum = order.u16(a).wrapping_add(order.u16(b));
            if order == Order::Little { sum.to_le_bytes() } else { sum.to_be_bytes() }
        }),
        (Predictor::Horizontal, 32) => undo_words::<4>(row, stride, |a, b| {
            let order = encoding.order;
            let sum = order.u32(a).wrapping_add(order.u32(b));
            if order == Order::Little { sum.to_le_bytes() } else { sum.to_be_bytes() }
        }),
        (Predictor::Float, bits) if bits >= 16 => {
            (stride..row.len()).for_each(|k| row[k] = row[k].wrapping_add(row[k - stride]));
            scratch.clear();
            scratch.extend_from_slice(row);
            let size = bits / 8;
            let count = row.len() / size;
            for (k, sample) in row.chunks_exact_mut(size).enumerate() {
                for (significance, byte) in sample.iter_mut().enumerate() {
                    *byte = scratch[significance * count + k];
                }
            }
            encoding.order = Order::Big;
        }
        _ => {}
    }
}

fn undo_words<const N: usize>(row: &mut [u8], stride: usize, add: impl Fn([u8; N], [u8; N]) -> [u8; N]) {
    let words = row.as_chunks_mut::<N>().0;
    for k in stride..words.len() {
        words[k] = add(words[k], words[k - stride]);
    }
}

/// A sample type that rows of some encodings unpack to.
pub(super) trait Unpack: Sample {
    /// Appends `count` samples of a row.
    fn unpack(row: &[u8], count: usize, encoding: &Encoding, out: &mut Vec<Self>);
}

impl Unpack for u8 {
    fn unpack(row: &[u8], count: usize, encoding: &Encoding, out: &mut Vec<Self>) {
        let start = out.len();
        match encoding.bits {
            8 => out.extend(row.iter().take(count)),
            bits => {
                let scale = if encoding.is_palette { 1 } else { 255 / ((1_u32 << bits) - 1) };
                out.extend(bit_fields(row, bits, count).map(|value| (value * scale) as u8));
            }
        }
        let flip = encoding.flip() as u8;
        out[start..].iter_mut().for_each(|sample| *sample ^= flip);
    }
}

impl Unpack for u16 {
    fn unpack(row: &[u8], count: usize, encoding: &Encoding, out: &mut Vec<Self>) {
        let start = out.len();
        match encoding.bits {
            16 => out.extend(row.as_chunks::<2>().0.iter().take(count).map(|b| encoding.order.u16(*b))),
            bits => out.extend(bit_fields(row, bits, count).map(|value| (value << (16 - bits)) as u16)),
        }
        let flip = encoding.flip() as u16;
        out[start..].iter_mut().for_each(|sample| *sample ^= flip);
    }
}

impl Unpack for f32 {
    fn unpack(row: &[u8], count: usize, encoding: &Encoding, out: &mut Vec<Self>) {
        let order = encoding.order;
        let start = out.len();
        match (encoding.bits, encoding.kind) {
            (16, _) => {
                out.extend(row.as_chunks::<2>().0.iter().take(count).map(|b| from_half(order.u16(*b))))
            }
            (64, _) => {
                let values = row.as_chunks::<8>().0.iter().take(count);
                out.extend(values.map(|b| f64::from_bits(order.u64(*b)) as f32));
            }
            (_, kind) => out.extend(row.as_chunks::<4>().0.iter().take(count).map(|b| {
                let word = order.u32(*b);
                match kind {
                    Kind::Float => f32::from_bits(word),
                    Kind::Unsigned => word as f32,
                    Kind::Signed => word as i32 as f32,
                }
            })),
        }
        if encoding.is_inverted {
            out[start..].iter_mut().for_each(|sample| *sample = -*sample);
        }
    }
}

impl Encoding {
    /// What integers are combined with so that they are unsigned and white is large: signed numbers have their sign
    /// bit the wrong way round.
    fn flip(&self) -> u32 {
        let sign = if self.kind == Kind::Signed { if self.bits > 8 { 1 << 15 } else { 1 << 7 } } else { 0 };
        let invert = if self.is_inverted { u32::MAX } else { 0 };
        sign ^ invert
    }
}

/// Numbers of `bits` bits, the most significant first (TIFF's fill order 1).
fn bit_fields(row: &[u8], bits: usize, count: usize) -> impl Iterator<Item = u32> {
    (0..count).map(move |k| {
        let at = k * bits;
        let byte = |index: usize| u32::from(row.get(index).copied().unwrap_or(0));
        let window = byte(at / 8) << 16 | byte(at / 8 + 1) << 8 | byte(at / 8 + 2);
        (window >> (24 - at % 8 - bits)) & ((1 << bits) - 1)
    })
}

/// IEEE 754 binary16.
fn from_half(half: u16) -> f32 {
    let sign = if half >> 15 == 1 { -1.0 } else { 1.0 };
    let (exponent, fraction) = (u32::from(half >> 10 & 31), u32::from(half & 1023));
    match (exponent, fraction) {
        (0, _) => sign * fraction as f32 * f32::from_bits((127 - 24) << 23),
        (31, 0) => sign * f32::INFINITY,
        (31, _) => f32::NAN,
        _ => sign * f32::from_bits((exponent + 112) << 23 | fraction << 13),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_floats_are_those_of_the_standard() {
        for (half, value) in [
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x3555, 0.333_251_95),
            (0x0001, 5.960_464_5e-8),
            (0x7bff, 65504.0),
        ] {
            assert_eq!(from_half(half), value);
        }
        assert!(from_half(0x7c00).is_infinite() && from_half(0x7c01).is_nan());
    }

    #[test]
    fn bit_fields_of_every_width_are_read() {
        let row = [0b1011_0011, 0b0101_1100, 0b1111_0000, 0xa5];
        assert_eq!(bit_fields(&row, 1, 8).collect::<Vec<_>>(), [1, 0, 1, 1, 0, 0, 1, 1]);
        assert_eq!(bit_fields(&row, 4, 4).collect::<Vec<_>>(), [11, 3, 5, 12]);
        assert_eq!(bit_fields(&row, 12, 2).collect::<Vec<_>>(), [0xb35, 0xcf0]);
        assert_eq!(bit_fields(&row, 15, 2).collect::<Vec<_>>(), [0x59ae, 0x3c29]);
    }
}
