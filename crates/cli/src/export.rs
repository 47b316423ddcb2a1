//! `terrane export`: a finished result in another format.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use serde_json::Value;
use terrane_scene::positions::{CameraPosition, write_geojson, write_kml};
use terrane_scene::{SceneError, colmap, ply};

use crate::args::{ExportFlags, Format};
use crate::exit::Failure;
use crate::models;

/// Writes what was asked for and says where.
pub fn export(flags: &ExportFlags) -> Result<(), Failure> {
    let target = flags.to.clone().unwrap_or_else(|| default_target(flags));
    match flags.format {
        Format::ColmapTxt => text_model(flags, &target)?,
        Format::Ply => {
            let model = models::read(&models::folder(&flags.out, flags.component)?)?;
            into_file(&target, |file| ply::write(&model.reconstruction, "terrane", file))?;
        }
        Format::Geojson => {
            let (positions, datum) = positions(&flags.out, flags.component)?;
            into_file(&target, |file| write_geojson(&positions, &datum, file))?;
        }
        Format::Kml => {
            let (positions, _) = positions(&flags.out, flags.component)?;
            into_file(&target, |file| write_kml(&positions, file))?;
        }
        Format::ColmapDb => database(&flags.out, &target)?,
    }
    println!("{}", target.display());
    Ok(())
}

fn default_target(flags: &ExportFlags) -> PathBuf {
    let suffix = if flags.component == 0 { String::new() } else { format!("-{}", flags.component) };
    flags.out.join(match flags.format {
        Format::ColmapTxt => format!("sparse-txt/{}", flags.component),
        Format::Ply => format!("points{suffix}.ply"),
        Format::Geojson => format!("cameras{suffix}.export.geojson"),
        Format::Kml => format!("cameras{suffix}.kml"),
        Format::ColmapDb => "database.db".to_owned(),
    })
}

/// Writes the run's features and matches, which lie in the store beside its result.
#[cfg(feature = "sqlite")]
fn database(out: &Path, target: &Path) -> Result<(), Failure> {
    use terrane_pipeline::{Store, output};

    let store = out.join(".terrane/store");
    if !out.join("run.json").is_file() || !store.is_dir() {
        return Err(Failure::input(format!(
            "{} holds no run with its artefacts (run.json and .terrane/store): give the folder of a finished run",
            out.display()
        )));
    }
    let written = Store::local(&store).and_then(|store| output::write_database(out, &store, target));
    let figures =
        written.map_err(|error| match error.is_invalid_input() || error.broken_artefact().is_some() {
            true => Failure::input(error.to_string()),
            false => Failure::system(error.to_string()),
        })?;
    let output::DatabaseFigures { images, keypoints, pairs, matches } = figures;
    eprintln!("{images} images, {keypoints} keypoints, {pairs} pairs, {matches} matches");
    Ok(())
}

#[cfg(not(feature = "sqlite"))]
fn database(_: &Path, _: &Path) -> Result<(), Failure> {
    Err(Failure::input("this terrane can't write databases: build it with `--features full`"))
}

fn text_model(flags: &ExportFlags, target: &Path) -> Result<(), Failure> {
    let model = models::read(&models::folder(&flags.out, flags.component)?)?;
    std::fs::create_dir_all(target)
        .map_err(|error| Failure::system(format!("{}: {error}", target.display())))?;
    let files = colmap::ModelFiles {
        cameras: create(&target.join("cameras.txt"))?,
        images: create(&target.join("images.txt"))?,
        points: create(&target.join("points3D.txt"))?,
    };
    let name = |image| model.name(image).unwrap_or_default().to_owned();
    colmap::write_text(&model.reconstruction, &name, files).map_err(|error| written(target, &error))
}

fn create(path: &Path) -> Result<BufWriter<File>, Failure> {
    File::create(path)
        .map(BufWriter::new)
        .map_err(|error| Failure::system(format!("{} can't be written: {error}", path.display())))
}

fn written(path: &Path, error: &SceneError) -> Failure {
    Failure::system(format!("{}: {error}", path.display()))
}

/// Writes a file whole or not at all: a name beside it first, then renamed.
fn into_file(
    path: &Path,
    body: impl FnOnce(&mut dyn Write) -> Result<(), SceneError>,
) -> Result<(), Failure> {
    let unfinished = path.with_extension("unfinished");
    let mut file = create(&unfinished)?;
    let result = body(&mut file).map_err(|error| written(path, &error)).and_then(|()| {
        let flushed = file.flush().and_then(|()| std::fs::rename(&unfinished, path));
        flushed.map_err(|error| Failure::system(format!("{} can't be written: {error}", path.display())))
    });
    if result.is_err() {
        let _ = std::fs::remove_file(&unfinished);
    }
    result
}

/// The cameras of a component as `cameras.geojson` of the result has them, and the datum of their heights.
fn positions(out: &Path, component: u32) -> Result<(Vec<CameraPosition>, String), Failure> {
    let path = out.join("cameras.geojson");
    let text = std::fs::read_to_string(&path).map_err(|error| {
        Failure::input(format!("{}: {error}; give the folder of a finished run", path.display()))
    })?;
    let value: Value = serde_json::from_str(&text)
        .map_err(|error| Failure::input(format!("{}: {error}", path.display())))?;
    let features = value["features"]
        .as_array()
        .ok_or_else(|| Failure::input(format!("{}: `features` is missing", path.display())))?;
    let positions =
        features.iter().filter_map(position).filter(|position| position.component == component).collect();
    Ok((positions, value["terrane"]["height_datum"].as_str().unwrap_or("unknown").to_owned()))
}

fn position(feature: &Value) -> Option<CameraPosition> {
    let triple = |value: &Value| -> Option<[f64; 3]> {
        let numbers: Vec<f64> = value.as_array()?.iter().filter_map(Value::as_f64).collect();
        numbers.try_into().ok()
    };
    let properties = &feature["properties"];
    Some(CameraPosition {
        name: properties["image"].as_str()?.to_owned(),
        component: u32::try_from(properties["component"].as_u64()?).ok()?,
        x_in_world: triple(&properties["x_in_world"])?,
        lon_lat_height: triple(&feature["geometry"]["coordinates"]),
        gps_residual_m: triple(&properties["gps_residual_m"]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flags(out: &Path, format: Format) -> ExportFlags {
        ExportFlags { out: out.to_path_buf(), format, to: None, component: 0 }
    }

    #[test]
    fn positions_survive_their_way_through_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let position = |name: &str, component| CameraPosition {
            name: name.into(),
            component,
            x_in_world: [1.0, 2.0, 3.0],
            lon_lat_height: Some([-71.5, 42.25, 100.0]),
            gps_residual_m: None,
        };
        let all = [position("a.jpg", 0), position("b.jpg", 1)];
        let mut bytes = Vec::new();
        write_geojson(&all, "ellipsoid", &mut bytes).unwrap();
        std::fs::write(folder.path().join("cameras.geojson"), bytes).unwrap();
        assert_eq!(positions(folder.path(), 1).unwrap(), (vec![all[1].clone()], "ellipsoid".to_owned()));
        export(&flags(folder.path(), Format::Kml)).unwrap();
        assert!(std::fs::read_to_string(folder.path().join("cameras.kml")).unwrap().contains("a.jpg"));
        assert!(!folder.path().join("cameras.unfinished").exists());
    }

    #[test]
    fn a_folder_without_a_result_is_named() {
        let folder = tempfile::tempdir().unwrap();
        for format in [Format::ColmapTxt, Format::Ply, Format::Geojson, Format::Kml, Format::ColmapDb] {
            assert_eq!(export(&flags(folder.path(), format)).unwrap_err().code(), 2, "{format:?}");
        }
    }
}
