//! The numbers that kernels compute in: `f32` or `f64`, eight at a time.

use std::ops::{Add, AddAssign, Mul, Sub};

/// Observations that are worked on together.
pub(super) const LANES: usize = 8;

/// One number for each lane.
pub(super) type Lanes<T> = [T; LANES];

/// `f32` or `f64`.
pub(super) trait Real:
    Copy
    + Default
    + Send
    + Sync
    + PartialEq
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + AddAssign
    + 'static
{
    /// Rounded to this type.
    fn from_f64(value: f64) -> Self;
    /// Widened.
    fn to_f64(self) -> f64;
    /// `self · a + b`, rounded once, on every processor.
    fn mul_add(self, a: Self, b: Self) -> Self;
}

macro_rules! real {
    ($t:ty) => {
        impl Real for $t {
            #[inline(always)]
            fn from_f64(value: f64) -> Self {
                value as $t
            }

            #[inline(always)]
            fn to_f64(self) -> f64 {
                f64::from(self)
            }

            #[inline(always)]
            fn mul_add(self, a: Self, b: Self) -> Self {
                <$t>::mul_add(self, a, b)
            }
        }
    };
}

real!(f32);
real!(f64);

/// All lanes the same.
#[inline(always)]
pub(super) fn splat<T: Real>(value: T) -> Lanes<T> {
    [value; LANES]
}

/// One value for each lane; a loop, as closures of the standard library are not compiled for the caller's vectors.
#[inline(always)]
pub(super) fn each<T: Real>(value: impl Fn(usize) -> T) -> Lanes<T> {
    let mut lanes = [T::default(); LANES];
    for (l, lane) in lanes.iter_mut().enumerate() {
        *lane = value(l);
    }
    lanes
}

/// Three rows of lanes.
#[inline(always)]
pub(super) fn each3<T>(row: impl Fn(usize) -> T) -> [T; 3] {
    [row(0), row(1), row(2)]
}

/// `a · b` in each lane.
#[inline(always)]
pub(super) fn times<T: Real>(a: &Lanes<T>, b: &Lanes<T>) -> Lanes<T> {
    each(
        #[inline(always)]
        |l| a[l] * b[l],
    )
}

/// `a · b + c` in each lane, rounded once.
#[inline(always)]
pub(super) fn fused<T: Real>(a: &Lanes<T>, b: &Lanes<T>, c: &Lanes<T>) -> Lanes<T> {
    each(
        #[inline(always)]
        |l| a[l].mul_add(b[l], c[l]),
    )
}

/// `a + b` in each lane.
#[inline(always)]
pub(super) fn plus<T: Real>(a: &Lanes<T>, b: &Lanes<T>) -> Lanes<T> {
    each(
        #[inline(always)]
        |l| a[l] + b[l],
    )
}

/// `a − b` in each lane.
#[inline(always)]
pub(super) fn minus<T: Real>(a: &Lanes<T>, b: &Lanes<T>) -> Lanes<T> {
    each(
        #[inline(always)]
        |l| a[l] - b[l],
    )
}

/// The sum of the lanes, always in the same order, in `f64`.
#[inline(always)]
pub(super) fn sum<T: Real>(a: &Lanes<T>) -> f64 {
    let mut half = [0.0; 4];
    for (l, half) in half.iter_mut().enumerate() {
        *half = a[l].to_f64() + a[l + 4].to_f64();
    }
    (half[0] + half[2]) + (half[1] + half[3])
}

/// Runs an expression with constants for the stride of intrinsics and the width of a camera, six more, so that loops over
/// them are unrolled.
macro_rules! by_stride {
    ($stride:expr, $k:ident, $width:ident => $work:expr) => {
        by_stride!(@ $stride, $k, $width, $work, 0 1 2 3 4 6 8 12)
    };
    (@ $stride:expr, $k:ident, $width:ident, $work:expr, $($n:literal)*) => {
        match $stride {
            $($n => {
                const $k: usize = $n;
                #[allow(dead_code)]
                const $width: usize = 6 + $n;
                $work
            })*
            _ => {
                const $k: usize = terrane_geometry::camera::MAX_PARAMS;
                #[allow(dead_code)]
                const $width: usize = 6 + $k;
                $work
            }
        }
    };
}
pub(super) use by_stride;
