//! Features of two photographs that look alike: exact nearest neighbours in both directions, with ratio and mutual tests.
//!
//! Distance is Euclidean between descriptors as bytes. Its square is an integer, `|a|² + |b|² − 2 a·b`, so every kernel
//! gives the same bits. For descriptors of equal length it orders neighbours as the angle between them does, and it
//! needs no assumption on how they were scaled. Ratio test: Lowe 2004.
//!
//! A kernel computes each product once and keeps the best two scores of its row *and* of its column. A bound that
//! rejects candidates before their full product would stand in the kernels' `tile`, where second-best scores are known.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
pub mod hamming;
mod nearest;
#[cfg(target_arch = "x86_64")]
mod pack;
mod scalar;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};
use terrane_scene::{DESCRIPTOR_LEN, DescriptorKind, Features};

pub use nearest::{Nearest, Neighbour};

/// Two features that look alike.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// Feature of the first image.
    pub first: u32,
    /// Feature of the second image.
    pub second: u32,
    /// Distance to the match over distance to the runner-up, the worse of both directions when the test is mutual;
    /// zero without a runner-up. Lower is better: sort by it for PROSAC.
    pub ratio: f32,
}

/// How features are matched.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MatchOptions {
    /// Greatest distance to a match over the distance to the runner-up, in (0, 1]. Default 0.8 (Lowe 2004; COLMAP).
    /// A tie is never a match.
    pub max_ratio: f64,
    /// Whether each must be the other's nearest, and pass the ratio test from there. Default true (COLMAP).
    pub mutual: bool,
    /// Greatest distance between descriptors scaled to length one, in (0, 2]. Default 0.7 (COLMAP).
    pub max_distance: f64,
    /// Limits for binary descriptors, in place of the two above.
    pub binary: hamming::BinaryMatchOptions,
}

impl Default for MatchOptions {
    fn default() -> Self {
        let binary = hamming::BinaryMatchOptions::default();
        Self { max_ratio: 0.8, mutual: true, max_distance: 0.7, binary }
    }
}

/// One way to find nearest neighbours; all give the same answer.
#[derive(Clone, Copy, Debug)]
pub struct MatchKernel {
    name: &'static str,
    nearest: fn(&[[u8; DESCRIPTOR_LEN]], &[[u8; DESCRIPTOR_LEN]]) -> Nearest,
}

impl MatchKernel {
    /// The kernels that this processor can run, slowest first. The first is the scalar oracle.
    pub fn available() -> Vec<Self> {
        #[allow(unused_mut)]
        let mut kernels = vec![Self { name: "scalar", nearest: scalar::nearest }];
        #[cfg(target_arch = "x86_64")]
        {
            if avx2::is_available() {
                kernels.push(Self { name: "avx2", nearest: avx2::nearest });
            }
            if avx512::is_available() {
                kernels.push(Self { name: "avx512-vnni", nearest: avx512::nearest });
            }
        }
        kernels
    }

    /// The fastest kernel that this processor can run.
    pub fn fastest() -> Self {
        Self::available().pop().unwrap_or(Self { name: "scalar", nearest: scalar::nearest })
    }

    /// Which path this is: `scalar`, `avx2` or `avx512-vnni`.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Nearest neighbours in both directions. At most 2³² − 1 descriptors a side.
    pub fn nearest(&self, first: &[[u8; DESCRIPTOR_LEN]], second: &[[u8; DESCRIPTOR_LEN]]) -> Nearest {
        (self.nearest)(first, second)
    }
}

/// Matches two images' features with the fastest kernel for their descriptors. Ascending in `first`; one thread.
///
/// Descriptors of different kinds never match.
pub fn match_features(first: &Features, second: &Features, options: &MatchOptions) -> Vec<Match> {
    match (first.kind, second.kind) {
        (DescriptorKind::Bytes128, DescriptorKind::Bytes128) => {
            match_features_with(MatchKernel::fastest(), first, second, options)
        }
        (DescriptorKind::Bits256, DescriptorKind::Bits256) => hamming::match_features(first, second, options),
        _ => Vec::new(),
    }
}

/// [`match_features`] with a kernel of choice, for tests and benches.
pub fn match_features_with(
    kernel: MatchKernel,
    first: &Features,
    second: &Features,
    options: &MatchOptions,
) -> Vec<Match> {
    let first = first.descriptors.as_chunks::<DESCRIPTOR_LEN>().0;
    let second = second.descriptors.as_chunks::<DESCRIPTOR_LEN>().0;
    let nearest = kernel.nearest(first, second);
    let mut matches = Vec::new();
    for (row, neighbour) in nearest.rows.iter().enumerate() {
        let Some(column) = neighbour.index else { continue };
        let Some(mut ratio) = passing_ratio(neighbour, options) else { continue };
        if options.mutual {
            let back = &nearest.columns[column as usize];
            let Some(back_ratio) = passing_ratio(back, options) else { continue };
            if back.index != Some(row as u32) {
                continue;
            }
            ratio = ratio.max(back_ratio);
        }
        if is_near(neighbour, &first[row], &second[column as usize], options) {
            matches.push(Match { first: row as u32, second: column, ratio: ratio as f32 });
        }
    }
    matches
}

/// The ratio of a neighbour, or `None` when it is above the limit.
fn passing_ratio(neighbour: &Neighbour, options: &MatchOptions) -> Option<f64> {
    if neighbour.second_squared == u32::MAX {
        return Some(0.0);
    }
    let ratio = (f64::from(neighbour.distance_squared) / f64::from(neighbour.second_squared)).sqrt();
    (ratio <= options.max_ratio).then_some(ratio)
}

/// Whether two descriptors, scaled to length one, are within the greatest distance.
fn is_near(
    neighbour: &Neighbour,
    a: &[u8; DESCRIPTOR_LEN],
    b: &[u8; DESCRIPTOR_LEN],
    options: &MatchOptions,
) -> bool {
    let norm = |bytes: &[u8; DESCRIPTOR_LEN]| {
        f64::from(bytes.iter().map(|&byte| u32::from(byte) * u32::from(byte)).sum::<u32>())
    };
    let (aa, bb) = (norm(a), norm(b));
    // 2 a·b = |a|² + |b|² − d²; the squared distance of the unit vectors is 2 − 2 a·b / (|a| |b|).
    let twice_dot = aa + bb - f64::from(neighbour.distance_squared);
    let product = (aa * bb).sqrt();
    product > 0.0 && 2.0 - twice_dot / product <= options.max_distance * options.max_distance
}
