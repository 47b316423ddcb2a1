//! Which instructions the kernels use.
//!
//! A kernel is written once, as plain Rust over blocks of a fixed number of lanes, and compiled for the processor that
//! every build must run on, with AVX2 and FMA, and with AVX-512, where its loops become vectors. All do the same
//! operations in the same order, so that their results are equal bit for bit.

/// The instructions to use; only [`Isa::available`] makes one that needs more than the build's baseline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Isa(Kind);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Baseline,
    #[cfg(target_arch = "x86_64")]
    Avx2Fma,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Isa {
    /// The plain path, which is the oracle of the others.
    pub(super) const BASELINE: Self = Self(Kind::Baseline);

    /// What this processor has, the plainest first.
    pub(super) fn available() -> impl Iterator<Item = Self> {
        #[cfg(target_arch = "x86_64")]
        let more = {
            use std::arch::is_x86_feature_detected as has;
            let avx2 = has!("avx2") && has!("fma");
            let avx512 = avx2 && has!("avx512f") && has!("avx512bw") && has!("avx512dq") && has!("avx512vl");
            [avx2.then_some(Self(Kind::Avx2Fma)), avx512.then_some(Self(Kind::Avx512))]
        };
        #[cfg(not(target_arch = "x86_64"))]
        let more = [None; 0];
        std::iter::once(Self::BASELINE).chain(more.into_iter().flatten())
    }

    /// The best that this processor has.
    pub(super) fn detect() -> Self {
        Self::available().last().unwrap_or(Self::BASELINE)
    }

    #[cfg(target_arch = "x86_64")]
    pub(super) fn has_avx2_fma(self) -> bool {
        self.0 == Kind::Avx2Fma
    }

    #[cfg(target_arch = "x86_64")]
    pub(super) fn has_avx512(self) -> bool {
        self.0 == Kind::Avx512
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
                #[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
                fn with_avx512($($arg: $type),*) {
                    $body($($arg),*)
                }
                if isa.has_avx2_fma() {
                    // SAFETY: an `Isa` that says so is only made after the processor was seen to have AVX2 and FMA.
                    return unsafe { with_avx2_fma($($arg),*) };
                }
                if isa.has_avx512() {
                    // SAFETY: an `Isa` that says so is only made after the processor was seen to have all of these.
                    return unsafe { with_avx512($($arg),*) };
                }
            }
            #[cfg(not(target_arch = "x86_64"))]
            let _ = isa;
            $body($($arg),*)
        }
    };
}

pub(super) use kernel;
