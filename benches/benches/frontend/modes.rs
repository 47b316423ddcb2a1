//! Other features, other matchers and masks: does each reconstruct a flight?

use std::path::Path;
use std::process::Command;

use serde_json::Value;
use terrane_benches::table::{Bar, Row};
use terrane_benches::{Request, process};

use crate::sets::Set;

/// Flags beyond those of every run.
const MODES: [&[&str]; 9] = [
    &["--features", "sift-upright"],
    &["--features", "sift-affine"],
    &["--features", "harris"],
    &["--features", "fast"],
    &["--features", "orb"],
    &["--features", "surf"],
    &["--features", "surf-upright"],
    &["--matcher", "exact"],
    &["--matcher", "ann"],
];

pub fn rows(_: &Request) -> anyhow::Result<Vec<Row>> {
    let terrane = process::terrane()?;
    let set = Set::named("brighton-half");
    let masks = tempfile::tempdir()?;
    write_masks(set, masks.path())?;
    let mut modes: Vec<Vec<String>> =
        MODES.iter().map(|mode| mode.iter().map(|flag| (*flag).to_owned()).collect()).collect();
    modes.push(vec!["--masks".to_owned(), masks.path().display().to_string()]);
    let mut rows = Vec::new();
    for mode in modes {
        let out = tempfile::tempdir()?;
        let mut run = Command::new(&terrane);
        run.arg("run").arg(set.path()).arg("-o").arg(out.path()).args(&mode);
        let ended = process::run(&mut run);
        let report = std::fs::read(out.path().join("report.json")).ok();
        let report: Value = report.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default();
        let component = &report["components"][0];
        let shown = if mode[0] == "--masks" {
            "--masks, a band of each photograph".to_owned()
        } else {
            mode.join(" ")
        };
        let figure = |what: &str| format!("brighton-half {shown}: {what}");
        let cpu = ended.as_ref().ok().map(|(usage, _)| usage.cpu_s);
        rows.push(Row::new(figure("registered of 18"), component["images"].as_f64(), "", Bar::AtLeast(18.0)));
        rows.push(Row::new(figure("GPS RMSE"), component["gps"]["rmse_m"].as_f64(), "m", Bar::None));
        rows.push(Row::new(figure("CPU of the run"), cpu, "s", Bar::None));
    }
    Ok(rows)
}

/// A mask for each photograph that keeps features out of its lower fifth.
fn write_masks(set: &Set, folder: &Path) -> anyhow::Result<()> {
    for photograph in set.photographs(usize::MAX)? {
        let (width, height) =
            (photograph.camera.camera.width_px as usize, photograph.camera.camera.height_px as usize);
        let data: Vec<u8> = (0..height)
            .flat_map(|y| std::iter::repeat_n(if 5 * y < 4 * height { 255 } else { 0 }, width))
            .collect();
        let file = std::fs::File::create(folder.join(format!("{}.png", photograph.name)))?;
        let mut encoder = png::Encoder::new(std::io::BufWriter::new(file), width as u32, height as u32);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.write_header()?.write_image_data(&data)?;
    }
    Ok(())
}
