//! One body, two compilations: the build's baseline, and 256-bit vectors where the processor has them.
//!
//! A body is plain Rust over blocks of a fixed number of lanes. It says every operation and its order, and never fuses
//! a multiplication with an addition, so that both compilations give the same bits.

/// Which compilation to run; only [`Path::detect`] makes one that needs more than the baseline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Path(Kind);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Baseline,
    #[cfg(target_arch = "x86_64")]
    Avx2,
}

impl Path {
    /// The plain path, the oracle of the other.
    #[cfg_attr(not(test), allow(dead_code))]
    pub(crate) const BASELINE: Self = Self(Kind::Baseline);

    /// The best that this processor has.
    pub(crate) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            return Self(Kind::Avx2);
        }
        Self(Kind::Baseline)
    }

    #[cfg(target_arch = "x86_64")]
    pub(crate) fn has_avx2(self) -> bool {
        self.0 == Kind::Avx2
    }
}

/// Makes a function that runs an `#[inline(always)]` body on a [`Path`].
macro_rules! compiled_twice {
    ($(#[$meta:meta])* $name:ident = $body:ident($($arg:ident: $type:ty),* $(,)?)) => {
        $(#[$meta])*
        fn $name(path: $crate::simd::Path, $($arg: $type),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn with_avx2($($arg: $type),*) {
                    $body($($arg),*)
                }
                if path.has_avx2() {
                    // SAFETY: a `Path` that says so is only made after the processor was seen to have AVX2.
                    return unsafe { with_avx2($($arg),*) };
                }
            }
            $body($($arg),*)
        }
    };
}

pub(crate) use compiled_twice;
