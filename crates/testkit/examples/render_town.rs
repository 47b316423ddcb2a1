//! Writes the demo's photographs into a folder: `cargo run --release -p terrane-testkit --example render_town -- FOLDER`.

use std::path::PathBuf;

use rayon::prelude::*;
use terrane_testkit::town::{Town, TownOptions};

fn main() -> std::io::Result<()> {
    let folder = PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| "town".into()));
    std::fs::create_dir_all(&folder)?;
    let town = Town::new(&TownOptions::default());
    (0..town.num_photographs()).into_par_iter().try_for_each(|index| {
        let photograph = town.photograph(index);
        std::fs::write(folder.join(&photograph.name), photograph.jpeg)
    })
}
