//! The ways to compute every product of two images' descriptors, and the choice among them.

use std::sync::OnceLock;

use terrane_scene::DESCRIPTOR_LEN;

#[cfg(target_arch = "x86_64")]
use super::{amx, avx_vnni, avx2, avx512};
use super::{nearest::Nearest, scalar};

type Descriptor = [u8; DESCRIPTOR_LEN];

/// One way to find nearest neighbours among all pairs; all give the same answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MatchKernel {
    path: Path,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Path {
    Scalar,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    AvxVnni,
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Amx,
}

impl Path {
    /// Slowest first.
    const ALL: &[Path] = &[
        Path::Scalar,
        #[cfg(target_arch = "x86_64")]
        Path::Avx2,
        #[cfg(target_arch = "x86_64")]
        Path::AvxVnni,
        #[cfg(target_arch = "x86_64")]
        Path::Avx512,
        #[cfg(target_arch = "x86_64")]
        Path::Amx,
    ];

    fn is_available(self) -> bool {
        match self {
            Path::Scalar => true,
            #[cfg(target_arch = "x86_64")]
            Path::Avx2 => avx2::is_available(),
            #[cfg(target_arch = "x86_64")]
            Path::AvxVnni => avx_vnni::is_available(),
            #[cfg(target_arch = "x86_64")]
            Path::Avx512 => avx512::is_available(),
            #[cfg(target_arch = "x86_64")]
            Path::Amx => amx::is_available(),
        }
    }
}

/// Descriptors laid out by a kernel as the first side of a product.
pub struct PackedRows(Rows);

/// Descriptors laid out by a kernel as the second side of a product.
pub struct PackedColumns(Columns);

enum Rows {
    Scalar(Vec<Descriptor>),
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Rows),
    #[cfg(target_arch = "x86_64")]
    Avx512(avx512::Rows),
    #[cfg(target_arch = "x86_64")]
    Amx(amx::Rows),
}

enum Columns {
    Scalar(Vec<Descriptor>),
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Columns),
    #[cfg(target_arch = "x86_64")]
    Avx512(avx512::Columns),
}

impl MatchKernel {
    /// The kernels that this processor can run, slowest first. The first is the scalar oracle; each other one has
    /// given the oracle's answer to a small problem in this process, or it is left out.
    pub fn available() -> &'static [Self] {
        static AVAILABLE: OnceLock<Vec<MatchKernel>> = OnceLock::new();
        AVAILABLE.get_or_init(|| {
            let able = Path::ALL.iter().filter(|path| path.is_available()).map(|&path| Self { path });
            able.filter(|kernel| gives_the_oracles_answer(|a, b| kernel.nearest(a, b))).collect()
        })
    }

    /// The fastest kernel that this processor can run.
    pub fn fastest() -> Self {
        Self::available().last().copied().unwrap_or(Self { path: Path::Scalar })
    }

    /// Which path this is: `scalar`, `avx2`, `avx-vnni`, `avx512-vnni` or `amx-int8`.
    pub fn name(&self) -> &'static str {
        match self.path {
            Path::Scalar => "scalar",
            #[cfg(target_arch = "x86_64")]
            Path::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Path::AvxVnni => "avx-vnni",
            #[cfg(target_arch = "x86_64")]
            Path::Avx512 => "avx512-vnni",
            #[cfg(target_arch = "x86_64")]
            Path::Amx => "amx-int8",
        }
    }

    /// Lays out the first side, once for all products that it takes part in. At most 2³² − 1 descriptors.
    pub fn pack_rows(&self, descriptors: &[Descriptor]) -> PackedRows {
        PackedRows(match self.path {
            Path::Scalar => Rows::Scalar(descriptors.to_vec()),
            #[cfg(target_arch = "x86_64")]
            Path::Avx2 | Path::AvxVnni => Rows::Avx2(avx2::rows(descriptors)),
            #[cfg(target_arch = "x86_64")]
            Path::Avx512 => Rows::Avx512(avx512::rows(descriptors)),
            #[cfg(target_arch = "x86_64")]
            Path::Amx => Rows::Amx(amx::rows(descriptors)),
        })
    }

    /// Lays out the second side. At most 2³² − 1 descriptors.
    pub fn pack_columns(&self, descriptors: &[Descriptor]) -> PackedColumns {
        PackedColumns(match self.path {
            Path::Scalar => Columns::Scalar(descriptors.to_vec()),
            #[cfg(target_arch = "x86_64")]
            Path::Avx2 | Path::AvxVnni => Columns::Avx2(avx2::columns(descriptors)),
            #[cfg(target_arch = "x86_64")]
            Path::Avx512 => Columns::Avx512(avx512::columns(descriptors)),
            #[cfg(target_arch = "x86_64")]
            Path::Amx => Columns::Avx512(amx::columns(descriptors)),
        })
    }

    /// Nearest neighbours in both directions, of two sides that this kernel has laid out.
    ///
    /// # Panics
    /// When another kernel has laid them out.
    pub fn nearest_packed(&self, rows: &PackedRows, columns: &PackedColumns) -> Nearest {
        match (self.path, &rows.0, &columns.0) {
            (Path::Scalar, Rows::Scalar(rows), Columns::Scalar(columns)) => scalar::nearest(rows, columns),
            #[cfg(target_arch = "x86_64")]
            (Path::Avx2, Rows::Avx2(rows), Columns::Avx2(columns)) => avx2::nearest(rows, columns),
            #[cfg(target_arch = "x86_64")]
            (Path::AvxVnni, Rows::Avx2(rows), Columns::Avx2(columns)) => avx_vnni::nearest(rows, columns),
            #[cfg(target_arch = "x86_64")]
            (Path::Avx512, Rows::Avx512(rows), Columns::Avx512(columns)) => avx512::nearest(rows, columns),
            #[cfg(target_arch = "x86_64")]
            (Path::Amx, Rows::Amx(rows), Columns::Avx512(columns)) => amx::nearest(rows, columns),
            #[cfg(target_arch = "x86_64")]
            _ => panic!("laid out by another kernel than {}", self.name()),
        }
    }

    /// Nearest neighbours in both directions. At most 2³² − 1 descriptors a side.
    pub fn nearest(&self, first: &[Descriptor], second: &[Descriptor]) -> Nearest {
        self.nearest_packed(&self.pack_rows(first), &self.pack_columns(second))
    }
}

/// Whether a kernel agrees with the oracle on a small problem with great bytes, copies and zeros, on which no tile is
/// full: a processor or a system that computes something else must not change what a run finds.
pub(super) fn gives_the_oracles_answer(nearest: impl Fn(&[Descriptor], &[Descriptor]) -> Nearest) -> bool {
    let mut state = 1_u32;
    let mut next = |limit: u32| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        ((state >> 16) % (limit + 1)) as u8
    };
    let mut descriptors = |count: usize| -> Vec<Descriptor> {
        let limit = |at: usize| if at.is_multiple_of(7) { 255 } else { 127 };
        (0..count).map(|at| std::array::from_fn(|_| next(limit(at)))).collect()
    };
    let (mut first, mut second) = (descriptors(71), descriptors(83));
    second[11] = first[5];
    second[40] = first[5];
    second[60] = first[30];
    first[17] = [0; DESCRIPTOR_LEN];
    first[18] = [255; DESCRIPTOR_LEN];
    second[82] = [255; DESCRIPTOR_LEN];
    nearest(&first, &second) == scalar::nearest(&first, &second)
}
