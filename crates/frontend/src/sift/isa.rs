//! Which instructions the kernels use.
//!
//! A kernel is written once, as plain Rust over blocks of a fixed number of lanes with fused multiply-add where it
//! pays, and compiled twice: for the processor that every build must run on, and with AVX2 and FMA switched on, where
//! its loops become vectors. Both do the same operations in the same order, so that their results are equal bit for bit.

/// The instructions to use; only [`Isa::detect`] makes one that needs more than the build's baseline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Isa(Kind);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Baseline,
    #[cfg(target_arch = "x86_64")]
    Avx2Fma,
}

impl Isa {
    /// The plain path, which is the oracle of the others.
    #[cfg_attr(not(test), allow(dead_code))]
    pub(super) const BASELINE: Self = Self(Kind::Baseline);

    /// The best that this processor has.
    pub(super) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            return Self(Kind::Avx2Fma);
        }
        Self(Kind::Baseline)
    }

    #[cfg(target_arch = "x86_64")]
    pub(super) fn has_avx2_fma(self) -> bool {
        self.0 == Kind::Avx2Fma
    }
}

/// Makes a function that runs an `#[inline(always)]` body with the instructions of an [`Isa`].
macro_rules! kernel {
    ($(#[$meta:meta])* $name:ident = $body:ident($($arg:ident: $type:ty),* $(,)?)) => {
        $(#[$meta])*
        pub(super) fn $name(isa: Isa, $($arg: $type),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                fn with_avx2_fma($($arg: $type),*) {
                    $body($($arg),*)
                }
                if isa.has_avx2_fma() {
                    // SAFETY: an `Isa` that says so is only made after the processor was seen to have AVX2 and FMA.
                    return unsafe { with_avx2_fma($($arg),*) };
                }
            }
            $body($($arg),*)
        }
    };
}

pub(super) use kernel;
