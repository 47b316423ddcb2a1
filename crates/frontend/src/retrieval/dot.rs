//! Dot products of one signed-byte vector with many: exact in integers, so that every path gives the same bits.

/// Vectors are padded with zeros to a multiple of this many bytes.
pub(super) const LANES: usize = 32;

/// One way to compute dot products; all give the same answer.
#[derive(Clone, Copy, Debug)]
pub struct DotKernel {
    name: &'static str,
    dots: fn(&[i8], &[i8], &mut Vec<i32>),
}

impl DotKernel {
    /// The kernels that this processor can run, slowest first. The first is the scalar oracle.
    pub fn available() -> Vec<Self> {
        #[allow(unused_mut)]
        let mut kernels = vec![Self { name: "scalar", dots: scalar }];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") {
                kernels.push(Self { name: "avx2", dots: x86::avx2 });
            }
            if x86::has_vnni() {
                kernels.push(Self { name: "avx512-vnni", dots: x86::vnni });
            }
        }
        kernels
    }

    /// The fastest kernel that this processor can run.
    pub fn fastest() -> Self {
        Self::available().pop().unwrap_or(Self { name: "scalar", dots: scalar })
    }

    /// Which path this is: `scalar`, `avx2` or `avx512-vnni`.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Appends the dot product of `query` with each of the `rows` (of the query's length, one after another) to `dots`.
    /// No value may be -128; the length is a multiple of 32. Rows that are cut short are left out.
    pub fn dots(&self, query: &[i8], rows: &[i8], dots: &mut Vec<i32>) {
        if !query.is_empty() {
            (self.dots)(query, rows, dots);
        }
    }
}

fn scalar(query: &[i8], rows: &[i8], dots: &mut Vec<i32>) {
    let dot = |row: &[i8]| row.iter().zip(query).map(|(&a, &b)| i32::from(a) * i32::from(b)).sum::<i32>();
    dots.extend(rows.chunks_exact(query.len()).map(dot));
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::LANES;

    /// Queries up to this many registers stay in them.
    const MAX_REGISTERS: usize = 16;

    pub(super) fn has_vnni() -> bool {
        is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("avx512vnni")
            && is_x86_feature_detected!("avx512vl")
    }

    /// Only made available after AVX2 was detected.
    pub(super) fn avx2(query: &[i8], rows: &[i8], dots: &mut Vec<i32>) {
        if !fits(query) {
            return super::scalar(query, rows, dots);
        }
        // SAFETY: `DotKernel::available` gives this path only where the processor has AVX2.
        unsafe { dots_avx2(query, rows, dots) }
    }

    /// Only made available after VNNI was detected.
    pub(super) fn vnni(query: &[i8], rows: &[i8], dots: &mut Vec<i32>) {
        if !fits(query) {
            return super::scalar(query, rows, dots);
        }
        // SAFETY: `DotKernel::available` gives this path only where the processor has AVX-512 VNNI and VL.
        unsafe { dots_vnni(query, rows, dots) }
    }

    fn fits(query: &[i8]) -> bool {
        query.len().is_multiple_of(LANES) && query.len() <= MAX_REGISTERS * LANES
    }

    /// `vpmaddubsw` multiplies unsigned by signed bytes: the query's sizes by the row's values with the query's signs.
    /// Two products of at most 127 · 127 fit 16 bits.
    #[target_feature(enable = "avx2")]
    fn dots_avx2(query: &[i8], rows: &[i8], dots: &mut Vec<i32>) {
        let query_parts = query.as_chunks::<LANES>().0;
        let ones = _mm256_set1_epi16(1);
        for row in rows.chunks_exact(query.len()) {
            let mut sums = [_mm256_setzero_si256(); 2];
            for (at, (q, r)) in query_parts.iter().zip(row.as_chunks::<LANES>().0).enumerate() {
                let (q, r) = (load(q), load(r));
                let pairs = _mm256_maddubs_epi16(_mm256_abs_epi8(q), _mm256_sign_epi8(r, q));
                sums[at % 2] = _mm256_add_epi32(sums[at % 2], _mm256_madd_epi16(pairs, ones));
            }
            dots.push(sum(_mm256_add_epi32(sums[0], sums[1])));
        }
    }

    #[target_feature(enable = "avx2,avx512vnni,avx512vl")]
    fn dots_vnni(query: &[i8], rows: &[i8], dots: &mut Vec<i32>) {
        let query_parts = query.as_chunks::<LANES>().0;
        for row in rows.chunks_exact(query.len()) {
            let mut sums = [_mm256_setzero_si256(); 2];
            for (at, (q, r)) in query_parts.iter().zip(row.as_chunks::<LANES>().0).enumerate() {
                let (q, r) = (load(q), load(r));
                sums[at % 2] = _mm256_dpbusd_epi32(sums[at % 2], _mm256_abs_epi8(q), _mm256_sign_epi8(r, q));
            }
            dots.push(sum(_mm256_add_epi32(sums[0], sums[1])));
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn load(values: &[i8; LANES]) -> __m256i {
        bytemuck::must_cast(*values)
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn sum(values: __m256i) -> i32 {
        let half = _mm_add_epi32(_mm256_castsi256_si128(values), _mm256_extracti128_si256::<1>(values));
        let quarter = _mm_add_epi32(half, _mm_shuffle_epi32::<0b00_00_11_10>(half));
        _mm_cvtsi128_si32(_mm_add_epi32(quarter, _mm_shuffle_epi32::<0b00_00_00_01>(quarter)))
    }
}
