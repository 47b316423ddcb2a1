//! Squared distances of single pairs of descriptors: what is left to compute once bounds have rejected the rest.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

use terrane_scene::DESCRIPTOR_LEN;

use super::scalar;

type Descriptor = [u8; DESCRIPTOR_LEN];

/// Descriptors with what speeds up their distances.
pub(super) struct Measured {
    pub(super) descriptors: Vec<Descriptor>,
    /// Squared length of each.
    pub(super) norms: Vec<i32>,
    /// Whether no byte of it exceeds 127: two products of such bytes fit in i16.
    #[cfg_attr(not(target_arch = "x86_64"), allow(dead_code))]
    narrow: Vec<bool>,
}

impl Measured {
    pub(super) fn new(descriptors: Vec<Descriptor>) -> Self {
        let norm = |descriptor: &Descriptor| descriptor.iter().map(|&byte| i32::from(byte).pow(2)).sum();
        let is_narrow = |descriptor: &Descriptor| descriptor.iter().all(|&byte| byte <= 127);
        Self {
            norms: descriptors.iter().map(norm).collect(),
            narrow: descriptors.iter().map(is_narrow).collect(),
            descriptors,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.descriptors.len()
    }
}

/// The squared distance of each pair `(first, second)`, in the order of the pairs.
pub(super) fn distances(first: &Measured, second: &Measured, pairs: &[(u32, u32)], distances: &mut Vec<i32>) {
    distances.clear();
    distances.reserve(pairs.len());
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { distances_avx2(first, second, pairs, distances) };
    }
    distances.extend(pairs.iter().map(|&(a, b)| {
        scalar::distance_squared(&first.descriptors[a as usize], &second.descriptors[b as usize])
    }));
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn distances_avx2(first: &Measured, second: &Measured, pairs: &[(u32, u32)], distances: &mut Vec<i32>) {
    for (at, &(a, b)) in pairs.iter().enumerate() {
        if let Some(&(a, b)) = pairs.get(at + AHEAD) {
            fetch(&first.descriptors[a as usize]);
            fetch(&second.descriptors[b as usize]);
        }
        let (a, b) = (a as usize, b as usize);
        let dot = match first.narrow[a] && second.narrow[b] {
            true => dot_narrow(&first.descriptors[a], &second.descriptors[b]),
            false => dot_wide(&first.descriptors[a], &second.descriptors[b]),
        };
        distances.push(first.norms[a] + second.norms[b] - 2 * dot);
    }
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
