//! Images made ready for matching, once for all pairs that they are in.

use std::sync::OnceLock;

use terrane_scene::{BINARY_DESCRIPTOR_LEN, DESCRIPTOR_LEN, DescriptorKind, Features};

use super::cascade::{self, CascadePaths, Prepared};
use super::kernel::{MatchKernel, PackedColumns, PackedRows};
use super::sweep::SweepPath;
use super::{Match, MatchOptions, Matcher, Nearest, ann, hamming, matches_of};

/// An image's descriptors, laid out for a matcher.
pub struct PreparedImage(Kind);

enum Kind {
    Exact { descriptors: Vec<[u8; DESCRIPTOR_LEN]>, rows: PackedRows, columns: PackedColumns },
    Cascade(Box<Prepared>),
    Ann(Box<ann::Prepared>),
    Bits(Vec<[u8; BINARY_DESCRIPTOR_LEN]>),
}

impl PreparedImage {
    /// Prepares an image for the matcher that the options name; binary descriptors have but one. Takes about three times the
    /// memory of the descriptors.
    pub fn new(features: &Features, options: &MatchOptions) -> Self {
        if features.kind == DescriptorKind::Bits256 {
            return Self(Kind::Bits(features.bits().to_vec()));
        }
        let descriptors = features.descriptors.as_chunks::<DESCRIPTOR_LEN>().0.to_vec();
        Self(match options.matcher {
            Matcher::Exact => {
                let kernel = MatchKernel::fastest();
                let (rows, columns) = (kernel.pack_rows(&descriptors), kernel.pack_columns(&descriptors));
                Kind::Exact { descriptors, rows, columns }
            }
            Matcher::Cascade => Kind::Cascade(Box::new(Prepared::new(paths(), &descriptors))),
            Matcher::Ann => Kind::Ann(Box::new(ann::Prepared::new(&descriptors, paths().sweep))),
        })
    }

    /// In the order of [`PreparedImage::order`].
    fn descriptors(&self) -> &[[u8; DESCRIPTOR_LEN]] {
        match &self.0 {
            Kind::Exact { descriptors, .. } => descriptors,
            Kind::Cascade(prepared) => prepared.descriptors(),
            Kind::Ann(prepared) => prepared.descriptors(),
            Kind::Bits(_) => &[],
        }
    }

    /// Where each descriptor was among those given; `None` where it still is there.
    fn order(&self) -> Option<&[u32]> {
        match &self.0 {
            Kind::Cascade(prepared) => Some(prepared.order()),
            Kind::Ann(prepared) => Some(prepared.order()),
            Kind::Exact { .. } | Kind::Bits(_) => None,
        }
    }
}

/// Matches two images that were prepared with these options. Ascending in `first`; one thread. Descriptors of different
/// kinds never match.
pub fn match_prepared(first: &PreparedImage, second: &PreparedImage, options: &MatchOptions) -> Vec<Match> {
    let nearest = match (&first.0, &second.0) {
        (Kind::Bits(first), Kind::Bits(second)) => return hamming::match_bits(first, second, options),
        (Kind::Bits(_), _) | (_, Kind::Bits(_)) => return Vec::new(),
        (Kind::Exact { rows, .. }, Kind::Exact { columns, .. }) => {
            MatchKernel::fastest().nearest_packed(rows, columns)
        }
        (Kind::Cascade(first), Kind::Cascade(second)) => cascaded(paths(), first, second, options),
        (Kind::Ann(first), Kind::Ann(second)) => ann::nearest(first, second),
        _ => MatchKernel::fastest().nearest(first.descriptors(), second.descriptors()),
    };
    let matches = matches_of(&nearest, first.descriptors(), second.descriptors(), options);
    as_given(matches, first.order(), second.order())
}

/// Matches of images in these orders, as those of the images as they were given.
pub(super) fn as_given(mut matches: Vec<Match>, first: Option<&[u32]>, second: Option<&[u32]>) -> Vec<Match> {
    let place = |order: Option<&[u32]>, at: u32| order.map_or(at, |order| order[at as usize]);
    for found in &mut matches {
        (found.first, found.second) = (place(first, found.first), place(second, found.second));
    }
    matches.sort_unstable_by_key(|found| found.first);
    matches
}

/// The cascade's neighbours, or all where bounds are of no use.
pub(super) fn cascaded(
    paths: CascadePaths,
    first: &Prepared,
    second: &Prepared,
    options: &MatchOptions,
) -> Nearest {
    cascade::nearest(paths, first, second, options)
        .unwrap_or_else(|| paths.kernel.nearest(first.descriptors(), second.descriptors()))
}

/// Which paths the cascade runs on this processor: that of its products and that of its bounds.
pub fn cascade_paths() -> (&'static str, &'static str) {
    (paths().kernel.name(), paths().sweep.name())
}

pub(super) fn paths() -> CascadePaths {
    static PATHS: OnceLock<CascadePaths> = OnceLock::new();
    *PATHS.get_or_init(|| CascadePaths { kernel: MatchKernel::fastest(), sweep: SweepPath::fastest() })
}
