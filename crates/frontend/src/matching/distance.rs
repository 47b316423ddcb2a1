//! Squared distances of single pairs of descriptors: what is left to compute once bounds have rejected the rest.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

use terrane_scene::DESCRIPTOR_LEN;

use super::scalar;

type Descriptor = [u8; DESCRIPTOR_LEN];

/// A descriptor that fills two lines of the cache.
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Aligned(Descriptor);

/// Descriptors with what speeds up their distances.
pub(super) struct Measured {
    descriptors: Vec<Aligned>,
    /// Squared length of each.
    pub(super) norms: Vec<i32>,
    /// Whether no byte of it exceeds 127: two products of such bytes fit in i16.
    #[cfg_attr(not(target_arch = "x86_64"), allow(dead_code))]
    narrow: Vec<bool>,
    /// Squared length of each, less what a product gains when 128 is taken from each byte of the other side, twice.
    #[cfg_attr(not(target_arch = "x86_64"), allow(dead_code))]
    shifted_norms: Vec<i32>,
}

impl Measured {
    /// Of the descriptors at `order`, one after another.
    pub(super) fn new(descriptors: &[Descriptor], order: &[u32]) -> Self {
        let descriptors: Vec<Aligned> = order.iter().map(|&at| Aligned(descriptors[at as usize])).collect();
        let norm = |descriptor: &Aligned| descriptor.0.iter().map(|&byte| i32::from(byte).pow(2)).sum();
        let is_narrow = |descriptor: &Aligned| descriptor.0.iter().fold(0, |all, byte| all | byte) <= 127;
        let sum = |descriptor: &Aligned| descriptor.0.iter().map(|&byte| i32::from(byte)).sum::<i32>();
        let norms: Vec<i32> = descriptors.iter().map(norm).collect();
        Self {
            shifted_norms: descriptors.iter().zip(&norms).map(|(of, norm)| norm - 256 * sum(of)).collect(),
            norms,
            narrow: descriptors.iter().map(is_narrow).collect(),
            descriptors,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.descriptors.len()
    }

    pub(super) fn descriptors(&self) -> &[Descriptor] {
        bytemuck::must_cast_slice(&self.descriptors)
    }

    #[inline]
    pub(super) fn at(&self, at: u32) -> &Descriptor {
        &self.descriptors[at as usize].0
    }
}

/// The squared distance of each pair `(first, second)`, in the order of the pairs.
pub(super) fn distances(first: &Measured, second: &Measured, pairs: &[(u32, u32)], distances: &mut Vec<i32>) {
    distances.clear();
    distances.reserve(pairs.len());
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vnni") {
        // SAFETY: the processor has AVX-512 F and VNNI.
        return unsafe { distances_avx512(first, second, pairs, distances) };
    }
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { distances_avx2(first, second, pairs, distances) };
    }
    distances.extend(pairs.iter().map(|&(a, b)| scalar::distance_squared(first.at(a), second.at(b))));
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn distances_avx2(first: &Measured, second: &Measured, pairs: &[(u32, u32)], distances: &mut Vec<i32>) {
    for (at, &(a, b)) in pairs.iter().enumerate() {
        if let Some(&(a, b)) = pairs.get(at + AHEAD) {
            fetch(first.at(a));
            fetch(second.at(b));
        }
        let dot = match first.narrow[a as usize] && second.narrow[b as usize] {
            true => dot_narrow(first.at(a), second.at(b)),
            false => dot_wide(first.at(a), second.at(b)),
        };
        distances.push(first.norms[a as usize] + second.norms[b as usize] - 2 * dot);
    }
}

/// Pairs whose products are summed up side by side.
#[cfg(target_arch = "x86_64")]
const TOGETHER: usize = 16;

/// Bytes of the second side, less 128, are what `vpdpbusd` wants: signed.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vnni")]
fn distances_avx512(first: &Measured, second: &Measured, pairs: &[(u32, u32)], distances: &mut Vec<i32>) {
    for (at, together) in pairs.chunks(TOGETHER).enumerate() {
        for &(a, b) in pairs.iter().skip((at + 1) * TOGETHER).take(TOGETHER) {
            fetch(first.at(a));
            fetch(second.at(b));
        }
        let mut sums = [_mm512_setzero_si512(); TOGETHER];
        for (sum, &(a, b)) in sums.iter_mut().zip(together) {
            *sum = products(first.at(a), second.at(b));
        }
        let mut dots = [0; TOGETHER];
        // SAFETY: `dots` is 64 bytes long, and the store needs no alignment.
        unsafe { _mm512_storeu_si512(dots.as_mut_ptr().cast(), totals(sums)) };
        let distance = |(&(a, b), dot): (&(u32, u32), i32)| {
            first.shifted_norms[a as usize] + second.norms[b as usize] - 2 * dot
        };
        distances.extend(together.iter().zip(dots).map(distance));
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vnni")]
#[inline]
fn products(a: &Descriptor, b: &Descriptor) -> __m512i {
    let turn = _mm512_set1_epi8(i8::MIN);
    let mut sum = _mm512_setzero_si512();
    for (a, b) in a.as_chunks::<64>().0.iter().zip(b.as_chunks::<64>().0) {
        // SAFETY: both references cover 64 bytes, and the loads need no alignment.
        let (a, b) =
            unsafe { (_mm512_loadu_si512(a.as_ptr().cast()), _mm512_loadu_si512(b.as_ptr().cast())) };
        sum = _mm512_dpbusd_epi32(sum, a, _mm512_xor_si512(b, turn));
    }
    sum
}

/// The sum of each register's lanes.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
#[inline]
fn totals(sums: [__m512i; TOGETHER]) -> __m512i {
    let quarters: [__m512i; 4] = std::array::from_fn(|k| {
        let [a, b, c, d] = [sums[4 * k], sums[4 * k + 1], sums[4 * k + 2], sums[4 * k + 3]];
        // Two of each register, by turns; then one of each of four, in each quarter of a register.
        let ab = _mm512_add_epi32(_mm512_unpacklo_epi32(a, b), _mm512_unpackhi_epi32(a, b));
        let cd = _mm512_add_epi32(_mm512_unpacklo_epi32(c, d), _mm512_unpackhi_epi32(c, d));
        _mm512_add_epi32(_mm512_unpacklo_epi64(ab, cd), _mm512_unpackhi_epi64(ab, cd))
    });
    let [a, b, c, d] = quarters;
    add_quarters(add_quarters(a, b), add_quarters(c, d))
}

/// Sums of neighbouring quarters: those of `a`, then those of `b`.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
#[inline]
fn add_quarters(a: __m512i, b: __m512i) -> __m512i {
    _mm512_add_epi32(_mm512_shuffle_i32x4::<0b10_00_10_00>(a, b), _mm512_shuffle_i32x4::<0b11_01_11_01>(a, b))
}

/// Pairs between a descriptor's fetching and its use.
#[cfg(target_arch = "x86_64")]
const AHEAD: usize = 8;

/// Asks for a descriptor to be in the first-level cache soon.
#[cfg(target_arch = "x86_64")]
#[inline]
fn fetch(descriptor: &Descriptor) {
    let (lines, _) = descriptor.as_chunks::<64>();
    for line in lines {
        // SAFETY: a hint, which reads nothing.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(line.as_ptr().cast()) };
    }
}

/// Product of bytes that are all at most 127: two neighbours' products are at most 32,258.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[inline]
fn dot_narrow(a: &Descriptor, b: &Descriptor) -> i32 {
    let ones = _mm256_set1_epi16(1);
    let mut sum = _mm256_setzero_si256();
    for (a, b) in a.as_chunks::<32>().0.iter().zip(b.as_chunks::<32>().0) {
        let two = _mm256_maddubs_epi16(bytemuck::must_cast(*a), bytemuck::must_cast(*b));
        sum = _mm256_add_epi32(sum, _mm256_madd_epi16(two, ones));
    }
    total(sum)
}

/// Product of any bytes.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[inline]
fn dot_wide(a: &Descriptor, b: &Descriptor) -> i32 {
    let mut sum = _mm256_setzero_si256();
    for (a, b) in a.as_chunks::<16>().0.iter().zip(b.as_chunks::<16>().0) {
        let a = _mm256_cvtepu8_epi16(bytemuck::must_cast(*a));
        let b = _mm256_cvtepu8_epi16(bytemuck::must_cast(*b));
        sum = _mm256_add_epi32(sum, _mm256_madd_epi16(a, b));
    }
    total(sum)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[inline]
fn total(sum: __m256i) -> i32 {
    let four = _mm_add_epi32(_mm256_castsi256_si128(sum), _mm256_extracti128_si256::<1>(sum));
    let two = _mm_add_epi32(four, _mm_shuffle_epi32::<0b01_00_11_10>(four));
    let one = _mm_add_epi32(two, _mm_shuffle_epi32::<0b10_11_00_01>(two));
    _mm_cvtsi128_si32(one)
}

#[cfg(test)]
mod tests {
    use rand::RngExt;
    use terrane_geometry::Seed;

    use super::*;

    #[test]
    fn distances_are_those_of_the_oracle_on_every_path() {
        let mut rng = Seed(15).rng();
        let mut all: Vec<Descriptor> = Vec::new();
        for limit in [127, 255] {
            all.extend(
                (0..20).map(|_| -> Descriptor { std::array::from_fn(|_| rng.random_range(0..=limit)) }),
            );
        }
        all.extend([0, 255, 127, 128].map(|byte| [byte; DESCRIPTOR_LEN]));
        // No multiple of what is summed up together.
        let pairs: Vec<(u32, u32)> =
            (0..44).flat_map(|a| (0..44).map(move |b| (a, b))).chain([(3, 5), (43, 41), (0, 0)]).collect();
        let measured = Measured::new(&all, &(0..44).collect::<Vec<_>>());
        let truth: Vec<i32> = pairs
            .iter()
            .map(|&(a, b)| scalar::distance_squared(&all[a as usize], &all[b as usize]))
            .collect();
        let mut found = Vec::new();
        distances(&measured, &measured, &pairs, &mut found);
        assert_eq!(found, truth);
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            found.clear();
            // SAFETY: the processor has AVX2.
            unsafe { distances_avx2(&measured, &measured, &pairs, &mut found) };
            assert_eq!(found, truth);
        }
    }
}
