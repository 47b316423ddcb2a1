//! Weighted sums of vectors of 16-bit brightness, the work of every blur.
//!
//! Two products at a time are added in 32 bits and rounded once at the end: rounding every product moves the second
//! differences that decide on weak blobs by a tenth. The plain path is the oracle: all give the same bits.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

use super::isa::Isa;

/// Pixels that are summed at once: four vectors of sixteen.
pub(super) const BLOCK: usize = 64;

/// Bits of a weight of one.
pub(super) const WEIGHT_BITS: u32 = 15;
/// Half a unit, so that sums are rounded to the nearest.
const HALF: i32 = 1 << (WEIGHT_BITS - 1);

/// One term of a sum: pixels and the part of 2¹⁵ that they weigh. Of each only as many as are asked for are looked at.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Term<'a> {
    pub pixels: &'a [i16],
    pub weight: i16,
}

/// Sums `terms`, whose weights add up to 2¹⁵. `out` has whole blocks and every term is as long.
pub(super) fn sum_weighted(isa: Isa, terms: &[Term<'_>], out: &mut [i16]) {
    #[cfg(target_arch = "x86_64")]
    {
        if isa.has_avx2_fma() {
            // SAFETY: an `Isa` that says so is only made after the processor was seen to have AVX2.
            return unsafe { with_avx2(terms, out) };
        }
        if isa.has_avx512() {
            // SAFETY: an `Isa` that says so is only made after the processor was seen to have AVX-512 F and BW.
            return unsafe { with_avx512(terms, out) };
        }
    }
    let _ = isa;
    plain(terms, out);
}

#[inline(always)]
fn block<'a>(term: &Term<'a>, at: usize) -> &'a [i16; BLOCK] {
    term.pixels[at..].first_chunk().expect("terms are padded to whole blocks")
}

fn plain(terms: &[Term<'_>], out: &mut [i16]) {
    for (index, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
        let mut sums = [HALF; BLOCK];
        for term in terms {
            for (sum, pixel) in sums.iter_mut().zip(block(term, index * BLOCK)) {
                *sum += i32::from(*pixel) * i32::from(term.weight);
            }
        }
        *out = sums.map(|sum| (sum >> WEIGHT_BITS) as i16);
    }
}

/// Makes the path of a kind of vector from its instructions.
#[cfg(target_arch = "x86_64")]
macro_rules! vector_path {
    ($name:ident, $features:literal, $vector:ty, [$splat:ident, $low:ident, $high:ident, $multiply:ident, $add:ident,
        $shift:ident, $pack:ident]) => {
        #[target_feature(enable = $features)]
        fn $name(terms: &[Term<'_>], out: &mut [i16]) {
            const VECTORS: usize = 2 * BLOCK / size_of::<$vector>();
            let of_block = |term: &Term<'_>, index: usize| -> [$vector; VECTORS] {
                // SAFETY: both are plain bits, any are valid, and `transmute` checks the sizes.
                unsafe { std::mem::transmute(*block(term, index * BLOCK)) }
            };
            for (index, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
                let mut sums = [[$splat(HALF); 2]; VECTORS];
                for pair in terms.chunks(2) {
                    let (first, second) = (pair[0], pair[pair.len() - 1]);
                    // The last of an odd number goes with itself at no weight.
                    let weight = if pair.len() == 2 { second.weight } else { 0 };
                    let weights = $splat(i32::from(weight) << 16 | i32::from(first.weight as u16));
                    let (first, second) = (of_block(&first, index), of_block(&second, index));
                    for (sums, (first, second)) in sums.iter_mut().zip(first.into_iter().zip(second)) {
                        sums[0] = $add(sums[0], $multiply($low(first, second), weights));
                        sums[1] = $add(sums[1], $multiply($high(first, second), weights));
                    }
                }
                // Packing puts the halves of each sixteen bytes back where unpacking took them from.
                let sums = sums.map(|[low, high]| {
                    $pack($shift::<{ WEIGHT_BITS as _ }>(low), $shift::<{ WEIGHT_BITS as _ }>(high))
                });
                // SAFETY: as above.
                *out = unsafe { std::mem::transmute::<[$vector; VECTORS], [i16; BLOCK]>(sums) };
            }
        }
    };
}

#[cfg(target_arch = "x86_64")]
vector_path!(
    with_avx2,
    "avx2",
    __m256i,
    [
        _mm256_set1_epi32,
        _mm256_unpacklo_epi16,
        _mm256_unpackhi_epi16,
        _mm256_madd_epi16,
        _mm256_add_epi32,
        _mm256_srai_epi32,
        _mm256_packs_epi32
    ]
);
#[cfg(target_arch = "x86_64")]
vector_path!(
    with_avx512,
    "avx512f,avx512bw",
    __m512i,
    [
        _mm512_set1_epi32,
        _mm512_unpacklo_epi16,
        _mm512_unpackhi_epi16,
        _mm512_madd_epi16,
        _mm512_add_epi32,
        _mm512_srai_epi32,
        _mm512_packs_epi32
    ]
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_path_gives_the_same_bits_at_the_ends_of_the_range() {
        let extremes = [0, 1, -1, 255, 256, 32_767, -32_768, -32_512, 32_512];
        let value = |k: usize| match k % 3 {
            0 => extremes[(k / 3) % extremes.len()],
            _ => (k.wrapping_mul(40_503).wrapping_mul(k + 7) >> 3) as i16,
        };
        let long: Vec<i16> = (0..8 * BLOCK).map(value).collect();
        let weights = [1, 333, 7_000, 18_100, 7_000, 333, 1];
        assert_eq!(weights.iter().map(|w| i32::from(*w)).sum::<i32>(), 32_768);
        let term = |(k, weight): (usize, &i16)| Term { pixels: &long[5 * k..], weight: *weight };
        // Odd and even numbers of terms.
        for first in [0, 1] {
            let terms: Vec<Term<'_>> = weights.iter().enumerate().skip(first).map(term).collect();
            let run = |isa: Isa| {
                let mut out = vec![0; 4 * BLOCK];
                sum_weighted(isa, &terms, &mut out);
                out
            };
            let oracle = run(Isa::BASELINE);
            for isa in Isa::available() {
                assert_eq!(run(isa), oracle, "{isa:?}");
            }
            for (x, got) in oracle.iter().enumerate() {
                let exact: f64 =
                    terms.iter().map(|t| f64::from(t.pixels[x]) * f64::from(t.weight)).sum::<f64>()
                        / 32_768.0;
                assert!((f64::from(*got) - exact).abs() <= 0.5, "{got} {exact}");
            }
        }
    }

    #[test]
    fn a_level_image_stays_level_at_both_ends_of_the_range() {
        for value in [i16::MIN, -32_767, -1, 0, 1, 32_512, i16::MAX] {
            let row = vec![value; BLOCK];
            let mut out = vec![0; BLOCK];
            let terms = [9_000, 14_768, 9_000].map(|weight| Term { pixels: &row, weight });
            sum_weighted(Isa::detect(), &terms, &mut out);
            assert!(out.iter().all(|v| *v == value), "{value} {}", out[0]);
        }
    }
}
