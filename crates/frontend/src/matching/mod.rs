//! Features of two photographs that look alike: nearest neighbours in both directions, with ratio and mutual tests.
//!
//! Distance is Euclidean between descriptors as bytes. Its square is an integer, `|a|² + |b|² − 2 a·b`, so every kernel
//! gives the same bits. For descriptors of equal length it orders neighbours as the angle between them does, and it
//! needs no assumption on how they were scaled. Ratio test: Lowe 2004.
//!
//! Three matchers. [`Matcher::Exact`] computes every product, with the best kernel that the processor has.
//! [`Matcher::Cascade`] gives the same answer, bit for bit, from bounds that reject nearly all pairs first.
//! [`Matcher::Ann`] looks for neighbours in a few cells only and misses some: `docs/benchmarks.md` has its recall.
//!
//! Images are [prepared](PreparedImage) once and then matched with as many others as need be.

#[cfg(target_arch = "x86_64")]
mod amx;
mod ann;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "x86_64")]
mod avx_vnni;
mod cascade;
mod cells;
mod distance;
pub mod guided;
pub mod hamming;
mod kernel;
mod nearest;
#[cfg(target_arch = "x86_64")]
mod pack;
mod prepared;
mod scalar;
mod sketch;
mod sweep;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_cascade;

use serde::{Deserialize, Serialize};
use terrane_scene::{DESCRIPTOR_LEN, Features};

pub use kernel::{MatchKernel, PackedColumns, PackedRows};
pub use nearest::{Nearest, Neighbour};
pub use prepared::{PreparedImage, cascade_paths, match_prepared};

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

/// How neighbours are found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Matcher {
    /// Among all, every product computed.
    Exact,
    /// Among all, most rejected by bounds: the answer of [`Matcher::Exact`]; in half the time where the processor has no
    /// VNNI, in more where it has.
    Cascade,
    /// In a few cells of the other image: about one match in a hundred is missed, in a seventh of the time.
    #[default]
    Ann,
}

impl Matcher {
    /// Every matcher.
    pub const ALL: [Matcher; 3] = [Matcher::Exact, Matcher::Cascade, Matcher::Ann];

    /// The name in options and flags.
    pub fn name(self) -> &'static str {
        match self {
            Matcher::Exact => "exact",
            Matcher::Cascade => "cascade",
            Matcher::Ann => "ann",
        }
    }
}

impl std::str::FromStr for Matcher {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        let known = || Matcher::ALL.map(Matcher::name).join(", ");
        let found = Matcher::ALL.into_iter().find(|matcher| matcher.name() == name);
        found.ok_or_else(|| format!("`{name}` is no matcher; known are {}", known()))
    }
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
    /// How neighbours are found. Default `ann`.
    pub matcher: Matcher,
    /// Limits for binary descriptors, in place of the two above.
    pub binary: hamming::BinaryMatchOptions,
}

impl Default for MatchOptions {
    fn default() -> Self {
        let binary = hamming::BinaryMatchOptions::default();
        Self { max_ratio: 0.8, mutual: true, max_distance: 0.7, matcher: Matcher::default(), binary }
    }
}

/// Matches two images' features. Ascending in `first`; one thread. Descriptors of different kinds never match. Whoever
/// matches an image more than once prepares it.
pub fn match_features(first: &Features, second: &Features, options: &MatchOptions) -> Vec<Match> {
    match_prepared(&PreparedImage::new(first, options), &PreparedImage::new(second, options), options)
}

/// [`match_features`] with every product computed by a kernel of choice, for tests and benches.
pub fn match_features_with(
    kernel: MatchKernel,
    first: &Features,
    second: &Features,
    options: &MatchOptions,
) -> Vec<Match> {
    let first = first.descriptors.as_chunks::<DESCRIPTOR_LEN>().0;
    let second = second.descriptors.as_chunks::<DESCRIPTOR_LEN>().0;
    matches_of(&kernel.nearest(first, second), first, second, options)
}

/// The matches among neighbours.
fn matches_of(
    nearest: &Nearest,
    first: &[[u8; DESCRIPTOR_LEN]],
    second: &[[u8; DESCRIPTOR_LEN]],
    options: &MatchOptions,
) -> Vec<Match> {
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
