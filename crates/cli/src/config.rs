//! Options as resolved: defaults, then the file, then single ones, then flags. Unknown names are refused with the known ones.

use std::path::{Path, PathBuf};

use serde_json::Value;
use terrane_pipeline::RunConfig;

use crate::args::{ConfigFlags, OptionFlags};
use crate::exit::Failure;

/// Prints the options of a run.
pub fn dump(flags: &ConfigFlags) -> Result<(), Failure> {
    let config = resolve(&flags.options)?;
    let text = serde_json::to_string_pretty(&config)
        .map_err(|error| Failure::system(format!("options can't be printed: {error}")))?;
    println!("{text}");
    Ok(())
}

/// The options that the flags mean; photographs are set by [`photographs`].
pub fn resolve(flags: &OptionFlags) -> Result<RunConfig, Failure> {
    let bug = |error: serde_json::Error| Failure::system(format!("options can't be read back: {error}"));
    let mut value = serde_json::to_value(RunConfig::default()).map_err(bug)?;
    if let Some(path) = &flags.config {
        let text = std::fs::read_to_string(path)
            .map_err(|error| Failure::input(format!("{}: {error}", path.display())))?;
        let file: Value = serde_json::from_str(&text).map_err(|error| {
            Failure::input(format!(
                "{}: {error}; print a valid one with `terrane config --dump`",
                path.display()
            ))
        })?;
        merge(&mut value, file, "")
            .map_err(|problem| Failure::input(format!("{}: {problem}", path.display())))?;
    }
    for setting in &flags.set {
        let (key, text) = setting.split_once('=').ok_or_else(|| {
            Failure::input(format!("--set {setting}: write it as KEY=VALUE, as mapping.max_error_px=4"))
        })?;
        let leaf = serde_json::from_str(text).unwrap_or_else(|_| Value::String(text.to_owned()));
        let nested = key
            .rsplit('.')
            .fold(leaf, |inner, part| Value::Object([(part.to_owned(), inner)].into_iter().collect()));
        merge(&mut value, nested, "")
            .map_err(|problem| Failure::input(format!("--set {setting}: {problem}")))?;
    }
    let mut config: RunConfig =
        serde_json::from_value(value).map_err(|error| Failure::input(format!("options: {error}")))?;
    if let Some(size) = flags.cluster_size {
        set_number(&mut config, "partition.max_cluster_size", u64::from(size))?;
    }
    if let Some(camera) = &flags.camera {
        config.camera = Some(camera.clone());
    }
    if let Some(path) = &flags.pairs {
        set_pairs(&mut config, path)?;
    }
    if let Some(path) = &flags.vocabulary {
        set_vocabulary(&mut config, path)?;
    }
    if let Some(matcher) = flags.matcher {
        config.matching.matching.matcher = matcher;
    }
    if let Some(method) = flags.features {
        config.features.method = method;
    }
    if let Some(seed) = flags.seed {
        config.seed = seed;
    }
    if let Some(masks) = &flags.masks {
        config.masks = Some(whole_path(masks, "masks")?);
    }
    if let Some(database) = &flags.import {
        config.import = Some(whole_path(database, "database")?);
    }
    Ok(config)
}

/// The pairs of a list: two paths a line; the first ends at the first space or tab.
fn set_pairs(config: &mut RunConfig, path: &Path) -> Result<(), Failure> {
    let shown = path.display();
    let text = std::fs::read_to_string(path)
        .map_err(|error| Failure::input(format!("list of pairs {shown}: {error}")))?;
    let mut list = Vec::new();
    for (at, line) in text.lines().map(str::trim).enumerate() {
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (first, second) = line.split_once([' ', '\t']).ok_or_else(|| {
            Failure::input(format!("{shown}, line {}: write two paths with a space between them", at + 1))
        })?;
        list.push([first.to_owned(), second.trim_start().to_owned()]);
    }
    if list.is_empty() {
        return Err(Failure::input(format!("{shown} lists no pairs: write two paths a line")));
    }
    config.pairs.select.list = list;
    set_value(config, "pairs.select.mode", Value::from("list"))
}

/// The words of a file, which [`RunConfig::validate`] looks at.
fn set_vocabulary(config: &mut RunConfig, path: &Path) -> Result<(), Failure> {
    let bytes = std::fs::read(path)
        .map_err(|error| Failure::input(format!("vocabulary {}: {error}", path.display())))?;
    let hex = bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut hex, byte| {
        hex.extend([byte >> 4, byte & 15].map(|digit| char::from_digit(u32::from(digit), 16).unwrap_or('0')));
        hex
    });
    config.pairs.vocabulary.words = Some(hex);
    Ok(())
}

/// The path as every process finds it, whatever its working folder.
fn whole_path(path: &Path, what: &str) -> Result<PathBuf, Failure> {
    path.canonicalize().map_err(|error| Failure::input(format!("{what} {}: {error}", path.display())))
}

fn set_number(config: &mut RunConfig, key: &str, number: u64) -> Result<(), Failure> {
    set_value(config, key, Value::from(number))
}

fn set_value(config: &mut RunConfig, key: &str, leaf: Value) -> Result<(), Failure> {
    let bug = |error: serde_json::Error| Failure::input(format!("{key}: {error}"));
    let mut value = serde_json::to_value(&*config).map_err(bug)?;
    let nested = key
        .rsplit('.')
        .fold(leaf, |inner, part| Value::Object([(part.to_owned(), inner)].into_iter().collect()));
    merge(&mut value, nested, "").map_err(Failure::input)?;
    *config = serde_json::from_value(value).map_err(bug)?;
    Ok(())
}

/// Puts `new` over `old`, object by object. Only names that are there can be set; an absent option (`null`) takes any value.
fn merge(old: &mut Value, new: Value, path: &str) -> Result<(), String> {
    match (old, new) {
        (Value::Object(old), Value::Object(new)) => {
            for (name, value) in new {
                let inner = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
                let known = || old.keys().cloned().collect::<Vec<_>>().join(", ");
                if !old.contains_key(&name) {
                    return Err(format!("`{inner}` is no option; known here: {}", known()));
                }
                if let Some(slot) = old.get_mut(&name) {
                    merge(slot, value, &inner)?;
                }
            }
            Ok(())
        }
        (old, new) => {
            *old = new;
            Ok(())
        }
    }
}

/// Puts the photographs into the options: a folder, or a file that lists paths relative to its own folder.
pub fn photographs(config: &mut RunConfig, photos: &Path) -> Result<(), Failure> {
    let shown = photos.display();
    let whole = photos.canonicalize().map_err(|error| {
        Failure::input(format!("photographs {shown}: {error}: give a folder of photographs"))
    })?;
    if whole.is_dir() {
        config.photos = whole;
        return Ok(());
    }
    let text = std::fs::read_to_string(&whole).map_err(|error| {
        Failure::input(format!("{shown} is no folder and no list of photographs: {error}"))
    })?;
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
    let list: Vec<String> = lines.map(str::to_owned).collect();
    if list.is_empty() {
        return Err(Failure::input(format!("{shown} lists no photographs: write one path a line")));
    }
    config.photos = whole.parent().map_or_else(|| PathBuf::from("/"), Path::to_path_buf);
    config.list = Some(list);
    Ok(())
}

#[cfg(test)]
mod tests {
    use terrane_pipeline::FeatureMethod;

    use super::*;
    use terrane_pipeline::Matcher;

    fn flags(set: &[&str]) -> OptionFlags {
        OptionFlags { set: set.iter().map(|&text| text.to_owned()).collect(), ..Default::default() }
    }

    #[test]
    fn options_are_set_by_path_and_unknown_ones_are_refused() {
        assert_eq!(resolve(&flags(&["seed=7"])).unwrap().seed, 7);
        assert_eq!(resolve(&flags(&["workers.threads=3"])).unwrap().workers.threads, 3);
        let refused = resolve(&flags(&["workers.treads=3"])).unwrap_err();
        assert!(
            refused.code() == 2
                && refused.message().contains("workers.treads")
                && refused.message().contains("threads")
        );
        for bad in ["seed", "seed=x", "seed=-1", "nothing.at.all=1"] {
            assert_eq!(resolve(&flags(&[bad])).unwrap_err().code(), 2, "{bad}");
        }
        assert_eq!(resolve(&OptionFlags { seed: Some(9), ..flags(&["seed=7"]) }).unwrap().seed, 9);
        let described =
            OptionFlags { features: Some(FeatureMethod::Orb), ..flags(&["features.method=surf"]) };
        assert_eq!(resolve(&described).unwrap().features.method, FeatureMethod::Orb);
        let sized = resolve(&OptionFlags { cluster_size: Some(50), ..Default::default() }).unwrap();
        assert_eq!(sized.partition.max_cluster_size, 50);
        let matched =
            OptionFlags { matcher: Some(Matcher::Ann), ..flags(&["matching.matching.matcher=exact"]) };
        assert_eq!(resolve(&matched).unwrap().matching.matching.matcher, Matcher::Ann);
    }

    #[test]
    fn the_dump_can_be_given_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("options.json");
        let config = resolve(&flags(&["seed=5"])).unwrap();
        std::fs::write(&path, serde_json::to_string_pretty(&config).unwrap()).unwrap();
        let back = resolve(&OptionFlags { config: Some(path.clone()), ..Default::default() }).unwrap();
        assert_eq!(back, config);
        std::fs::write(&path, "{").unwrap();
        assert_eq!(resolve(&OptionFlags { config: Some(path), ..Default::default() }).unwrap_err().code(), 2);
    }

    #[test]
    fn masks_and_databases_are_found_from_anywhere() {
        let folder = tempfile::tempdir().unwrap();
        let there = folder.path().to_path_buf();
        let whole = there.canonicalize().unwrap();
        let masked = resolve(&OptionFlags { masks: Some(there.clone()), ..Default::default() }).unwrap();
        assert_eq!(masked.masks, Some(whole.clone()));
        let importing = resolve(&OptionFlags { import: Some(there.clone()), ..Default::default() }).unwrap();
        assert_eq!(importing.import, Some(whole));
        let absent = Some(there.join("absent"));
        let flags = OptionFlags { masks: absent.clone(), ..Default::default() };
        assert_eq!(resolve(&flags).unwrap_err().code(), 2);
        let refused = resolve(&OptionFlags { import: absent, ..Default::default() }).unwrap_err();
        assert!(refused.code() == 2 && refused.message().contains("database"), "{}", refused.message());
    }

    #[test]
    fn photographs_are_a_folder_or_a_list() {
        let folder = tempfile::tempdir().unwrap();
        let list = folder.path().join("list.txt");
        std::fs::write(&list, "a.jpg\n# no\n\nb/c.jpg\n").unwrap();
        let mut config = RunConfig::default();
        photographs(&mut config, &list).unwrap();
        assert_eq!(config.list, Some(vec!["a.jpg".to_owned(), "b/c.jpg".to_owned()]));
        assert_eq!(config.photos, folder.path().canonicalize().unwrap());
        std::fs::write(&list, "\n").unwrap();
        assert_eq!(photographs(&mut config, &list).unwrap_err().code(), 2);
        assert_eq!(photographs(&mut config, &folder.path().join("absent")).unwrap_err().code(), 2);
    }
}
