//! The front end: features, matching, verification, pair selection; each beside COLMAP on the same files and machine.
//!
//! COLMAP is run through pycolmap by the scripts in `benches/peers`. Its results are kept in `TERRANE_PEER_CACHE` when that is set,
//! and the rows then say that they were not measured in the same go.

mod extraction;
mod interchange;
mod kernels;
mod memory;
mod modes;
mod peer;
mod repeatability;
mod retrieval;
mod sets;
mod surveyed;
mod two_views;
mod whole;

use terrane_benches::Section;

const SECTIONS: &[Section] = &[
    ("extraction", extraction::rows),
    ("memory", memory::rows),
    ("repeatability", repeatability::rows),
    ("kernels", kernels::rows),
    ("two views", two_views::rows),
    ("whole", whole::rows),
    ("retrieval", retrieval::rows),
    ("modes", modes::rows),
    ("interchange", interchange::rows),
];

fn main() -> anyhow::Result<()> {
    if let Some(outcome) = memory::as_child() {
        return outcome;
    }
    terrane_benches::run(SECTIONS)
}
