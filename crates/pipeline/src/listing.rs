//! Which files a run is about.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::masks::MaskNames;
use crate::{PipelineError, RunConfig};

/// Files that look like photographs, by path relative to the run's folder, ascending.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Listing {
    /// Relative paths with `/` between parts.
    pub paths: Vec<String>,
    /// Digest of paths, sizes and times of change, of masks and of an imported database too.
    pub digest: String,
}

const EXTENSIONS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];

impl Listing {
    /// Lists the run's folder recursively, or checks its list. Links are followed, each folder once.
    ///
    /// # Errors
    /// When the folder can't be read or holds no photograph, unless features are imported: then there may be none.
    pub fn scan(config: &RunConfig) -> Result<Self, PipelineError> {
        let root = &config.photos;
        if !root.is_dir() {
            return Err(PipelineError::invalid_input(format!(
                "{} is not a folder: name the folder that holds the photographs",
                root.display()
            )));
        }
        if let Some(folder) = &config.masks {
            crate::masks::check_folder(folder, root)?;
        }
        let paths = match &config.list {
            Some(list) => checked_list(list)?,
            None => scan_folder(config)?,
        };
        let mut hasher = blake3::Hasher::new();
        for path in &paths {
            add_file(&mut hasher, path, &root.join(path));
        }
        if let Some(folder) = &config.masks {
            let names = MaskNames::new(paths.iter().map(String::as_str));
            hasher.update(b"masks");
            for mask in paths.iter().filter_map(|path| names.find(folder, path)) {
                add_file(&mut hasher, &mask, &folder.join(&mask));
            }
        }
        if let Some(database) = &config.import {
            hasher.update(b"import");
            hasher.update(stamp(database)?.as_bytes());
        }
        Ok(Self { paths, digest: crate::key::hex(hasher.finalize().as_bytes()) })
    }
}

/// Size and time of change of a database and of the log that may lie beside it.
///
/// # Errors
/// When there is no such file.
pub(crate) fn stamp(database: &Path) -> Result<String, PipelineError> {
    if !database.is_file() {
        return Err(PipelineError::invalid_input(format!(
            "{} is not a file: name the database that holds the features",
            database.display()
        )));
    }
    let mut log = database.as_os_str().to_owned();
    log.push("-wal");
    let mut hasher = blake3::Hasher::new();
    add_file(&mut hasher, "database", database);
    add_file(&mut hasher, "log", Path::new(&log));
    Ok(crate::key::hex(hasher.finalize().as_bytes()))
}

fn add_file(hasher: &mut blake3::Hasher, name: &str, path: &Path) {
    let (size, changed_ns) = match std::fs::metadata(path) {
        Ok(meta) => (meta.len(), changed_ns(&meta)),
        Err(_) => (u64::MAX, 0),
    };
    hasher.update(&(name.len() as u64).to_le_bytes());
    hasher.update(name.as_bytes());
    hasher.update(&size.to_le_bytes());
    hasher.update(&changed_ns.to_le_bytes());
}

#[cfg(unix)]
fn changed_ns(meta: &std::fs::Metadata) -> i64 {
    use std::os::unix::fs::MetadataExt;
    meta.mtime().wrapping_mul(1_000_000_000).wrapping_add(meta.mtime_nsec())
}

#[cfg(not(unix))]
fn changed_ns(_: &std::fs::Metadata) -> i64 {
    0
}

fn checked_list(list: &[String]) -> Result<Vec<String>, PipelineError> {
    let mut paths = BTreeSet::new();
    for path in list {
        let path = path.trim();
        if path.is_empty() {
            continue;
        }
        let leaves = Path::new(path).is_absolute() || path.split('/').any(|part| part == "..");
        if leaves {
            return Err(PipelineError::invalid_input(format!(
                "`{path}` in the list leaves the folder of the photographs: give paths relative to it"
            )));
        }
        paths.insert(path.to_owned());
    }
    if paths.is_empty() {
        return Err(PipelineError::invalid_input("the list of photographs is empty"));
    }
    Ok(paths.into_iter().collect())
}

/// Photographs of a folder and below; masks that lie within it are none.
fn scan_folder(config: &RunConfig) -> Result<Vec<String>, PipelineError> {
    let root = config.photos.as_path();
    let mut paths = Vec::new();
    let mut seen = BTreeSet::new();
    seen.extend(config.masks.as_ref().and_then(|masks| masks.canonicalize().ok()));
    let mut other_files = 0usize;
    let mut folders = vec![(root.to_path_buf(), String::new())];
    while let Some((folder, prefix)) = folders.pop() {
        let failed =
            |error: &std::io::Error| PipelineError::io(&format!("can't read {}", folder.display()), error);
        if !seen.insert(folder.canonicalize().map_err(|error| failed(&error))?) {
            continue;
        }
        let mut entries: Vec<(String, PathBuf)> = Vec::new();
        for entry in std::fs::read_dir(&folder).map_err(|error| failed(&error))? {
            let entry = entry.map_err(|error| failed(&error))?;
            match entry.file_name().into_string() {
                Ok(name) if !name.starts_with('.') => entries.push((name, entry.path())),
                _ => other_files += 1,
            }
        }
        // In order, so that of two links to one folder the same one is always taken; last on the stack is next.
        entries.sort();
        for (name, path) in entries.into_iter().rev() {
            let relative = format!("{prefix}{name}");
            if path.is_dir() {
                folders.push((path, format!("{relative}/")));
            } else if is_photograph(&name) && path.is_file() {
                paths.push(relative);
            } else {
                other_files += 1;
            }
        }
    }
    if paths.is_empty() && config.import.is_none() {
        let what = if other_files == 0 { "is empty" } else { "holds no photograph" };
        return Err(PipelineError::invalid_input(format!(
            "{} {what}: terrane reads files ending in {}",
            root.display(),
            EXTENSIONS.join(", ")
        )));
    }
    paths.sort();
    Ok(paths)
}

/// Whether a file's name ends like that of a photograph that terrane reads.
pub fn is_photograph(name: &str) -> bool {
    let extension = name.rsplit_once('.').map(|(_, extension)| extension.to_ascii_lowercase());
    extension.is_some_and(|extension| EXTENSIONS.contains(&extension.as_str()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(root: &Path) -> RunConfig {
        RunConfig { photos: root.to_path_buf(), ..Default::default() }
    }

    #[test]
    fn folders_are_listed_in_order_and_loops_end() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(dir.path().join("b/c")).unwrap();
        for name in ["z.JPG", "a.png", "b/c/x.tiff", "b/notes.txt", ".hidden.jpg"] {
            std::fs::write(dir.path().join(name), name).unwrap();
        }
        #[cfg(unix)]
        std::os::unix::fs::symlink(dir.path(), dir.path().join("b/loop")).unwrap();
        let listing = Listing::scan(&config(dir.path())).unwrap();
        assert_eq!(listing.paths, ["a.png", "b/c/x.tiff", "z.JPG"]);
        assert_eq!(Listing::scan(&config(dir.path())).unwrap(), listing);
        std::fs::write(dir.path().join("a.png"), "longer than before").unwrap();
        assert_ne!(Listing::scan(&config(dir.path())).unwrap().digest, listing.digest);
    }

    #[test]
    fn folders_without_photographs_are_said_to_be() {
        let dir = tempfile::tempdir().unwrap();
        let error = Listing::scan(&config(dir.path())).unwrap_err();
        assert!(error.is_invalid_input() && error.to_string().contains("is empty"), "{error}");
        std::fs::write(dir.path().join("notes.txt"), "").unwrap();
        let error = Listing::scan(&config(dir.path())).unwrap_err();
        assert!(error.is_invalid_input() && error.to_string().contains("no photograph"), "{error}");
        let error = Listing::scan(&config(&dir.path().join("absent"))).unwrap_err();
        assert!(error.is_invalid_input(), "{error}");
    }

    #[test]
    fn masks_are_watched_and_are_no_photographs() {
        let dir = tempfile::tempdir().unwrap();
        let masks = dir.path().join("masks");
        std::fs::create_dir(&masks).unwrap();
        std::fs::write(dir.path().join("a.jpg"), "a").unwrap();
        std::fs::write(masks.join("a.jpg.png"), "mask").unwrap();
        let plain = Listing::scan(&config(dir.path())).unwrap();
        assert_eq!(plain.paths, ["a.jpg", "masks/a.jpg.png"]);
        let masked = RunConfig { masks: Some(masks.clone()), ..config(dir.path()) };
        let before = Listing::scan(&masked).unwrap();
        assert_eq!(before.paths, ["a.jpg"]);
        assert_ne!(before.digest, plain.digest);
        std::fs::write(masks.join("unrelated.png"), "x").unwrap();
        assert_eq!(Listing::scan(&masked).unwrap(), before);
        std::fs::write(masks.join("a.jpg.png"), "another mask").unwrap();
        assert_ne!(Listing::scan(&masked).unwrap().digest, before.digest);
        for wrong in [dir.path().join("absent"), dir.path().to_path_buf()] {
            let config = RunConfig { masks: Some(wrong), ..config(dir.path()) };
            assert!(Listing::scan(&config).unwrap_err().is_invalid_input());
        }
    }

    #[test]
    fn an_imported_database_is_watched_and_needs_no_photographs() {
        let dir = tempfile::tempdir().unwrap();
        let database = dir.path().join("database.db");
        let config = RunConfig { import: Some(database.clone()), ..config(dir.path()) };
        assert!(Listing::scan(&config).unwrap_err().is_invalid_input());
        std::fs::write(&database, "x").unwrap();
        let before = Listing::scan(&config).unwrap();
        assert!(before.paths.is_empty());
        std::fs::write(&database, "longer").unwrap();
        let changed = Listing::scan(&config).unwrap();
        assert_ne!(changed, before);
        std::fs::write(dir.path().join("database.db-wal"), "log").unwrap();
        assert_ne!(Listing::scan(&config).unwrap(), changed);
    }

    #[test]
    fn a_list_may_not_leave_the_folder() {
        let dir = tempfile::tempdir().unwrap();
        let mut config = config(dir.path());
        config.list = Some(vec!["b.jpg".into(), "a.jpg".into(), "b.jpg".into(), "  ".into()]);
        assert_eq!(Listing::scan(&config).unwrap().paths, ["a.jpg", "b.jpg"]);
        config.list = Some(vec!["../a.jpg".into()]);
        assert!(Listing::scan(&config).unwrap_err().is_invalid_input());
        config.list = Some(vec![]);
        assert!(Listing::scan(&config).unwrap_err().is_invalid_input());
    }
}
