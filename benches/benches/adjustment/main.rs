//! Bundle adjustment: `terrane adjust` beside Ceres on real problems and on cities; workers, memory, growth.
//!
//! Sections are chosen by `--only TEXT`; `--quick` leaves out what takes more than minutes. Ceres runs through the peers'
//! `ba_ceres.py`, in the same run with the same threads.

mod city;
mod peers;
mod problems;
mod scaling;

use terrane_benches::Section;

const SECTIONS: &[Section] = &[
    ("real", problems::real),
    ("cities", problems::cities),
    ("iterations", scaling::iterations),
    ("workers", scaling::workers),
    ("large city", problems::large_city),
    ("hundred thousand", scaling::hundred_thousand),
];

fn main() -> anyhow::Result<()> {
    terrane_benches::run(SECTIONS)
}
