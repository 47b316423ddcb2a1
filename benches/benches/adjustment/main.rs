//! Bundle adjustment: `terrane adjust` beside Ceres on real problems and on cities; workers, memory, growth.
//!
//! Sections are chosen by `--only TEXT`; `--quick` leaves out what takes more than minutes. Ceres runs through the peers'
//! `ba_ceres.py`, in the same run with the same threads.

mod city;
mod peers;
mod problems;
mod scaling;

use terrane_benches::Request;
use terrane_benches::table::{self, Row};

/// A group of figures.
type Section = (&'static str, fn(&Request) -> anyhow::Result<Vec<Row>>);

const SECTIONS: &[Section] = &[
    ("real", problems::real),
    ("cities", problems::cities),
    ("iterations", scaling::iterations),
    ("workers", scaling::workers),
    ("large city", problems::large_city),
    ("hundred thousand", scaling::hundred_thousand),
];

fn main() -> anyhow::Result<()> {
    let request = Request::from_args()?;
    let mut rows = Vec::new();
    for (name, section) in SECTIONS.iter().filter(|(name, _)| request.wants(name)) {
        println!("{name}");
        for row in section(&request)? {
            table::print(&row);
            rows.push(row);
        }
    }
    if let Some(path) = &request.json {
        table::write_json(path, &rows)?;
    }
    Ok(())
}
