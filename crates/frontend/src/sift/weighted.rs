//! Weighted sums of vectors of 16-bit brightness, the work of every blur.
//!
//! Compilers widen the products to 32 bits before they see that only the upper halves are used, so the vector paths name
//! their instructions. The plain path is the oracle: all give the same bits.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::{
    __m256i, __m512i, _mm256_add_epi16, _mm256_mulhi_epu16, _mm256_set1_epi16, _mm512_add_epi16,
    _mm512_mulhi_epu16, _mm512_set1_epi16,
};

use super::isa::Isa;

/// Pixels that are summed at once: four vectors of sixteen.
pub(super) const BLOCK: usize = 64;

/// One term of a sum: pixels and the part of 65,536 that they weigh. Of each only as many as are asked for are looked at.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Term<'a> {
    pub pixels: &'a [u16],
    pub weight: u16,
}

/// Sums `terms`, each product rounded down, from a start of half a unit a term. `out` has whole blocks and every term is as
/// long.
pub(super) fn sum_weighted(isa: Isa, terms: &[Term<'_>], out: &mut [u16]) {
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
fn block<'a>(term: &Term<'a>, at: usize) -> &'a [u16; BLOCK] {
    term.pixels[at..].first_chunk().expect("terms are padded to whole blocks")
}

fn plain(terms: &[Term<'_>], out: &mut [u16]) {
    for (index, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
        *out = [terms.len() as u16 / 2; BLOCK];
        for term in terms {
            for (sum, pixel) in out.iter_mut().zip(block(term, index * BLOCK)) {
                *sum = sum.wrapping_add(((u32::from(*pixel) * u32::from(term.weight)) >> 16) as u16);
            }
        }
    }
}

/// Makes the path of a kind of vector from its instructions.
#[cfg(target_arch = "x86_64")]
macro_rules! vector_path {
    ($name:ident, $features:literal, $vector:ty, $splat:ident, $multiply:ident, $add:ident) => {
        #[target_feature(enable = $features)]
        fn $name(terms: &[Term<'_>], out: &mut [u16]) {
            const VECTORS: usize = 2 * BLOCK / size_of::<$vector>();
            for (index, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
                let mut sum = [$splat(terms.len() as i16 / 2); VECTORS];
                for term in terms {
                    let weight = $splat(term.weight as i16);
                    let pixels = *block(term, index * BLOCK);
                    // SAFETY: both are plain bits, any are valid, and `transmute` checks the sizes.
                    let pixels: [$vector; VECTORS] = unsafe { std::mem::transmute(pixels) };
                    for (sum, pixels) in sum.iter_mut().zip(pixels) {
                        *sum = $add(*sum, $multiply(pixels, weight));
                    }
                }
                // SAFETY: as above.
                *out = unsafe { std::mem::transmute::<[$vector; VECTORS], [u16; BLOCK]>(sum) };
            }
        }
    };
}

#[cfg(target_arch = "x86_64")]
vector_path!(with_avx2, "avx2", __m256i, _mm256_set1_epi16, _mm256_mulhi_epu16, _mm256_add_epi16);
#[cfg(target_arch = "x86_64")]
vector_path!(
    with_avx512,
    "avx512f,avx512bw",
    __m512i,
    _mm512_set1_epi16,
    _mm512_mulhi_epu16,
    _mm512_add_epi16
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_path_gives_the_same_bits_at_the_ends_of_the_range() {
        let extremes = [0, 1, 255, 256, 32_767, 32_768, 65_279, 65_280, 65_535];
        let value = |k: usize| match k % 3 {
            0 => extremes[(k / 3) % extremes.len()],
            _ => (k.wrapping_mul(40_503).wrapping_mul(k + 7) >> 3) as u16,
        };
        let long: Vec<u16> = (0..8 * BLOCK).map(value).collect();
        let weights = [2, 666, 14_000, 36_200, 14_000, 666, 2];
        assert_eq!(weights.iter().sum::<u32>(), 65_536);
        let term = |(k, weight): (usize, &u32)| Term { pixels: &long[5 * k..], weight: *weight as u16 };
        let terms: Vec<Term<'_>> = weights.iter().enumerate().map(term).collect();
        let run = |isa: Isa| {
            let mut out = vec![0; 4 * BLOCK];
            sum_weighted(isa, &terms, &mut out);
            out
        };
        let oracle = run(Isa::BASELINE);
        for isa in Isa::available() {
            assert_eq!(run(isa), oracle, "{isa:?}");
        }
    }

    #[test]
    fn a_level_image_stays_level_at_both_ends_of_the_range() {
        for value in [0, 1, 32_768, 65_279, 65_280] {
            let row = vec![value; BLOCK];
            let mut out = vec![0; BLOCK];
            let terms = [18_000, 29_536, 18_000].map(|weight| Term { pixels: &row, weight });
            sum_weighted(Isa::detect(), &terms, &mut out);
            assert!(out.iter().all(|v| v.abs_diff(value) <= 2), "{value} {}", out[0]);
        }
    }
}
