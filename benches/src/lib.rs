//! One contract for all benches: `cargo bench -p terrane-benches --bench NAME -- [--json FILE] [--quick]`.
//!
//! A bench prints a table and writes rows of figures, each beside its bar, the command that repeats it, and a note on
//! what was compared. Correctness stands beside time.

pub mod process;
pub mod table;
pub mod usage;

use std::path::PathBuf;

/// What a bench was asked for on its command line.
#[derive(Clone, Debug, Default)]
pub struct Request {
    /// Where to write the rows as JSON.
    pub json: Option<PathBuf>,
    /// Leave out what takes more than a few minutes.
    pub quick: bool,
    /// Only figures whose name contains this.
    pub only: Option<String>,
    /// Only sets of photographs whose name contains this, in sections that go through them.
    pub set: Option<String>,
}

impl Request {
    /// Reads the command line; `cargo bench` adds `--bench`, which is skipped.
    ///
    /// # Errors
    /// A flag that is not known, or one without its value.
    pub fn from_args() -> anyhow::Result<Self> {
        let mut request = Self::default();
        let mut args = std::env::args().skip(1);
        while let Some(arg) = args.next() {
            let mut value = || args.next().ok_or_else(|| anyhow::anyhow!("{arg} needs a value"));
            match arg.as_str() {
                "--bench" => {}
                "--quick" => request.quick = true,
                "--json" => request.json = Some(value()?.into()),
                "--only" => request.only = Some(value()?),
                "--set" => request.set = Some(value()?),
                other => anyhow::bail!(
                    "unknown flag {other}; known: --json FILE, --quick, --only TEXT, --set TEXT"
                ),
            }
        }
        Ok(request)
    }

    /// Whether a figure of this name is wanted.
    pub fn wants(&self, name: &str) -> bool {
        self.only.as_ref().is_none_or(|only| name.contains(only.as_str()))
    }

    /// Whether a set of this name is wanted; `is_quick` says whether it belongs to a quick run.
    pub fn wants_set(&self, name: &str, is_quick: bool) -> bool {
        (is_quick || !self.quick) && self.set.as_ref().is_none_or(|set| name.contains(set.as_str()))
    }
}

/// A group of figures: its name, and what measures it.
pub type Section = (&'static str, fn(&Request) -> anyhow::Result<Vec<table::Row>>);

/// Measures the sections that the command line asks for; prints rows as they become known, and writes them where asked.
///
/// # Errors
/// A bad command line, a section that fails, or a file that can't be written.
pub fn run(sections: &[Section]) -> anyhow::Result<()> {
    let request = Request::from_args()?;
    let mut rows = Vec::new();
    for (name, section) in sections.iter().filter(|(name, _)| request.wants(name)) {
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

/// The folder of photographs with known answers: `TERRANE_DATA`, or `../shared/data` beside the checkout.
pub fn data() -> PathBuf {
    std::env::var_os("TERRANE_DATA").map_or_else(|| root().join("../shared/data"), PathBuf::from)
}

/// The folder of the peers' scripts: `TERRANE_PEER`, or `../shared/peer` beside the checkout.
pub fn peer() -> PathBuf {
    std::env::var_os("TERRANE_PEER").map_or_else(|| root().join("../shared/peer"), PathBuf::from)
}

/// The root of the workspace.
pub fn root() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}
