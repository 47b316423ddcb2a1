//! Which pairs of sketches may be near: a bound on every pair of two images, at a quarter of the cost of the distances.
//!
//! A pair *survives* where `code_a · code_b ≥ base_a + base_b − max(min(reach_a, reach_b), lone_a, lone_b)`. The limits
//! are set so that every pair whose squared distance is within the smaller of its two reaches, or within a lone reach of
//! either side, survives; see `sketch`. No product may exceed
//! its two bases by more than [`MAX_EXCESS`]. Where limits or the difference leave 16 bits on the other side, a path may let more
//! pairs survive than the scalar one, never fewer.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
pub(super) mod closest;
#[cfg(target_arch = "x86_64")]
mod closest_avx512;
mod scalar;

use std::ops::Range;
use std::sync::OnceLock;

use super::sketch::Code;

/// Columns that one call should be given: their codes, 16 KiB, stay in the first-level cache while all rows pass.
pub(super) const CHUNK: usize = 512;
/// Most by which a product may exceed the sum of its bases.
pub(super) const MAX_EXCESS: i32 = 14_000;
/// Most survivors that a sweep collects, 64 MiB of them.
pub(super) const MOST_SURVIVORS: usize = 1 << 23;
/// A reach beyond every bound: the pair's other side decides alone.
pub(super) const ANY_REACH: i32 = i32::MAX;

/// A reach that no pair is within.
pub(super) const NO_REACH: i32 = -(1 << 26);

/// The limits of each code of a side; see the module.
#[derive(Clone, Debug, Default)]
pub(super) struct Limits {
    pub(super) base: Vec<i32>,
    /// At least 0, or [`NO_REACH`].
    pub(super) reach: Vec<i32>,
    /// A reach that needs no consent of the other side; likewise.
    pub(super) lone: Vec<i32>,
}

/// One way to sweep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SweepPath {
    Scalar,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

/// Codes laid out for a path as the first side.
pub(super) enum SweepRows {
    Scalar(Vec<Code>),
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Rows),
    #[cfg(target_arch = "x86_64")]
    Avx512(avx512::Rows),
}

/// Codes laid out for a path as the second side.
pub(super) enum SweepColumns {
    Scalar(Vec<Code>),
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Columns),
    #[cfg(target_arch = "x86_64")]
    Avx512(avx512::Columns),
}

impl SweepPath {
    /// The paths that this processor can run, slowest first; each has let survive what the scalar one does in a small
    /// problem in this process, or it is left out.
    pub(super) fn available() -> &'static [Self] {
        static AVAILABLE: OnceLock<Vec<SweepPath>> = OnceLock::new();
        AVAILABLE.get_or_init(|| {
            #[allow(unused_mut)]
            let mut able = vec![SweepPath::Scalar];
            #[cfg(target_arch = "x86_64")]
            {
                able.extend(avx2::is_available().then_some(SweepPath::Avx2));
                able.extend(avx512::is_available().then_some(SweepPath::Avx512));
            }
            able.retain(|path| scalar::is_matched_by(*path));
            able
        })
    }

    pub(super) fn fastest() -> Self {
        Self::available().last().copied().unwrap_or(SweepPath::Scalar)
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            SweepPath::Scalar => "scalar",
            #[cfg(target_arch = "x86_64")]
            SweepPath::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            SweepPath::Avx512 => "avx512-vnni",
        }
    }

    pub(super) fn rows(self, codes: &[Code]) -> SweepRows {
        match self {
            SweepPath::Scalar => SweepRows::Scalar(codes.to_vec()),
            #[cfg(target_arch = "x86_64")]
            SweepPath::Avx2 => SweepRows::Avx2(avx2::Rows::new(codes)),
            #[cfg(target_arch = "x86_64")]
            SweepPath::Avx512 => SweepRows::Avx512(avx512::Rows::new(codes)),
        }
    }

    pub(super) fn columns(self, codes: &[Code]) -> SweepColumns {
        match self {
            SweepPath::Scalar => SweepColumns::Scalar(codes.to_vec()),
            #[cfg(target_arch = "x86_64")]
            SweepPath::Avx2 => SweepColumns::Avx2(avx2::Columns::new(codes)),
            #[cfg(target_arch = "x86_64")]
            SweepPath::Avx512 => SweepColumns::Avx512(avx512::Columns::new(codes)),
        }
    }
}

/// Appends the pairs `(row, column)` that survive among all rows and a range of columns, which begins at a multiple of
/// [`CHUNK`]. Their order depends on the path. Ends early, with more than [`MOST_SURVIVORS`], when there are so many.
///
/// # Panics
/// When rows and columns were laid out for different paths.
pub(super) fn sweep(
    (rows, row_limits): (&SweepRows, &Limits),
    (columns, column_limits): (&SweepColumns, &Limits),
    range: Range<usize>,
    survivors: &mut Vec<(u32, u32)>,
) {
    match (rows, columns) {
        (SweepRows::Scalar(rows), SweepColumns::Scalar(columns)) => {
            scalar::sweep((rows, row_limits), (columns, column_limits), range, survivors)
        }
        #[cfg(target_arch = "x86_64")]
        (SweepRows::Avx2(rows), SweepColumns::Avx2(columns)) => {
            avx2::sweep((rows, row_limits), (columns, column_limits), range, survivors)
        }
        #[cfg(target_arch = "x86_64")]
        (SweepRows::Avx512(rows), SweepColumns::Avx512(columns)) => {
            avx512::sweep((rows, row_limits), (columns, column_limits), range, survivors)
        }
        #[cfg(target_arch = "x86_64")]
        _ => panic!("the sides are laid out for different paths"),
    }
}
