//! Which mask belongs to which photograph.

use std::collections::BTreeMap;
use std::path::Path;

use crate::PipelineError;

/// Names of masks by the paths of photographs.
pub(crate) struct MaskNames {
    /// How many photographs share a path without its extension.
    of_stem: BTreeMap<String, u32>,
    /// How many share a file name without its extension, in whatever folder.
    of_name: BTreeMap<String, u32>,
}

impl MaskNames {
    /// Of a run's photographs, by path relative to its folder.
    pub fn new<'a>(photographs: impl IntoIterator<Item = &'a str>) -> Self {
        let (mut of_stem, mut of_name) = (BTreeMap::new(), BTreeMap::new());
        for path in photographs {
            let stem = stem(path);
            *of_stem.entry(stem.to_owned()).or_default() += 1;
            *of_name.entry(file_name(stem).to_owned()).or_default() += 1;
        }
        Self { of_stem, of_name }
    }

    /// Where the mask of a photograph may lie within the folder of masks, best first: COLMAP's `a/b.jpg.png`; then
    /// `a/b.png` and `b.png`, each only when no other photograph would share it.
    pub fn candidates(&self, photograph: &str) -> Vec<String> {
        let stem = stem(photograph);
        let name = file_name(stem);
        let mut candidates = vec![format!("{photograph}.png")];
        if self.of_stem.get(stem) == Some(&1) {
            candidates.push(format!("{stem}.png"));
        }
        if self.of_name.get(name) == Some(&1) && name != stem {
            candidates.push(format!("{name}.png"));
        }
        candidates
    }

    /// The mask of a photograph that is there, by its path within the folder of masks.
    pub fn find(&self, folder: &Path, photograph: &str) -> Option<String> {
        self.candidates(photograph).into_iter().find(|candidate| folder.join(candidate).is_file())
    }
}

/// A path without the extension of its last part.
fn stem(path: &str) -> &str {
    let name = path.rfind('/').map_or(0, |slash| slash + 1);
    match path[name..].rfind('.') {
        Some(dot) if dot > 0 => &path[..name + dot],
        _ => path,
    }
}

fn file_name(path: &str) -> &str {
    path.rsplit_once('/').map_or(path, |(_, name)| name)
}

/// Checks that the folder of masks is one, and another than that of the photographs: masks would be taken for some.
pub(crate) fn check_folder(folder: &Path, photographs: &Path) -> Result<(), PipelineError> {
    let wrong = if !folder.is_dir() {
        "is not a folder: name the folder that holds the masks"
    } else if folder.canonicalize().ok() == photographs.canonicalize().ok() {
        "holds the photographs themselves: put the masks into a folder of their own"
    } else {
        return Ok(());
    };
    Err(PipelineError::invalid_input(format!("{} {wrong}", folder.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_named_as_colmap_names_them_or_without_the_extension() {
        let names = MaskNames::new(["a/x.jpg", "b/x.jpg", "b/y.jpg", "b/y.png", "z.1.JPG", "plain"]);
        assert_eq!(names.candidates("a/x.jpg"), ["a/x.jpg.png", "a/x.png"]);
        assert_eq!(names.candidates("b/y.jpg"), ["b/y.jpg.png"]);
        assert_eq!(names.candidates("z.1.JPG"), ["z.1.JPG.png", "z.1.png"]);
        assert_eq!(names.candidates("plain"), ["plain.png", "plain.png"]);
        let names = MaskNames::new(["a/x.jpg", "b/y.jpg"]);
        assert_eq!(names.candidates("b/y.jpg"), ["b/y.jpg.png", "b/y.png", "y.png"]);
    }

    #[test]
    fn the_mask_of_the_whole_name_wins() {
        let folder = tempfile::tempdir().unwrap();
        let names = MaskNames::new(["a/x.jpg"]);
        assert_eq!(names.find(folder.path(), "a/x.jpg"), None);
        std::fs::create_dir(folder.path().join("a")).unwrap();
        for mask in ["x.png", "a/x.png", "a/x.jpg.png"] {
            std::fs::write(folder.path().join(mask), "").unwrap();
            assert_eq!(names.find(folder.path(), "a/x.jpg").as_deref(), Some(mask));
        }
        let inner = folder.path().join("a");
        assert!(check_folder(folder.path(), &inner).is_ok());
        assert!(check_folder(&folder.path().join("x.png"), &inner).unwrap_err().is_invalid_input());
        assert!(check_folder(&inner, &inner).unwrap_err().is_invalid_input());
    }
}
