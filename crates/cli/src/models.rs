//! Finished results on disk: where their models are, and how they are read.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use terrane_scene::colmap::{ColmapModel, ModelFiles, read_binary};

use crate::exit::Failure;

/// The folder of a component's model: `OUT/sparse/N`, or `OUT` itself when it is a COLMAP model.
pub fn folder(out: &Path, component: u32) -> Result<PathBuf, Failure> {
    let nested = out.join("sparse").join(component.to_string());
    if nested.join("images.bin").is_file() {
        return Ok(nested);
    }
    if component == 0 && out.join("images.bin").is_file() {
        return Ok(out.to_path_buf());
    }
    let (shown, nested) = (out.display(), nested.display());
    Err(Failure::input(format!(
        "{shown} holds no model: {nested}/images.bin is not there; give the folder of a finished run"
    )))
}

/// The folders of all components of a result, the largest first.
pub fn folders(out: &Path) -> Result<Vec<PathBuf>, Failure> {
    let mut found = vec![folder(out, 0)?];
    while let Ok(next) = folder(out, found.len() as u32) {
        found.push(next);
    }
    Ok(found)
}

/// Reads a model in COLMAP's binary format.
pub fn read(folder: &Path) -> Result<ColmapModel, Failure> {
    let open = |name: &str| {
        let path = folder.join(name);
        File::open(&path)
            .map(BufReader::new)
            .map_err(|error| Failure::input(format!("{}: {error}", path.display())))
    };
    let files = ModelFiles {
        cameras: open("cameras.bin")?,
        images: open("images.bin")?,
        points: open("points3D.bin")?,
    };
    read_binary(files).map_err(|error| Failure::input(format!("{}: {error}", folder.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_are_found_in_results_and_alone() {
        let root = tempfile::tempdir().unwrap();
        assert_eq!(folder(root.path(), 0).unwrap_err().code(), 2);
        for component in ["0", "1"] {
            let nested = root.path().join("sparse").join(component);
            std::fs::create_dir_all(&nested).unwrap();
            std::fs::write(nested.join("images.bin"), [0; 8]).unwrap();
        }
        assert_eq!(folders(root.path()).unwrap().len(), 2);
        assert_eq!(folder(&root.path().join("sparse/1"), 0).unwrap(), root.path().join("sparse/1"));
        assert_eq!(read(&root.path().join("sparse/0")).unwrap_err().code(), 2);
    }
}
