//! COLMAP's own figures, by the scripts in `benches/peers`.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use terrane_benches::{process, root};

use crate::sets::Set;

/// What a script printed.
pub struct Answer {
    /// Its JSON.
    pub value: Value,
    /// How it came about, for a row's note.
    pub note: &'static str,
}

/// A number at a path of keys.
pub fn number(value: &Value, keys: &[&str]) -> Option<f64> {
    keys.iter().try_fold(value, |value, key| value.get(key)).and_then(Value::as_f64)
}

/// Runs a script of `benches/peers`; `None` when there is no Python with pycolmap or the script fails, which is told.
pub fn script(name: &str, args: &[String]) -> Option<Answer> {
    let python = process::python()?;
    let cached = cache(name, args);
    if let Some(bytes) = cached.as_ref().and_then(|path| std::fs::read(path).ok()) {
        let value = serde_json::from_slice(&bytes).ok()?;
        return Some(Answer { value, note: "COLMAP's figure was measured before on this machine" });
    }
    let mut command = Command::new(python);
    command.arg(root().join("benches/peers").join(name)).args(args);
    match process::run(&mut command) {
        Ok((_, text)) => {
            let line = text.lines().next_back()?;
            if let Some(path) = cached {
                let _ = std::fs::create_dir_all(path.parent()?).and_then(|()| std::fs::write(&path, line));
            }
            let value = serde_json::from_str(line).ok()?;
            Some(Answer { value, note: "COLMAP measured in the same go" })
        }
        Err(error) => {
            println!("the peer did not run: {error}");
            None
        }
    }
}

/// COLMAP's front end on a set.
pub fn frontend(set: &Set, flags: &[&str]) -> Option<Answer> {
    let work = work(set, flags);
    let mut args = vec![set.path().display().to_string(), work.display().to_string()];
    args.extend(set.camera.iter().flat_map(|camera| ["--camera".to_owned(), (*camera).to_owned()]));
    args.extend(set.spatial.iter().flat_map(|count| ["--spatial".to_owned(), count.to_string()]));
    args.extend(flags.iter().map(|flag| (*flag).to_owned()));
    script("colmap_frontend.py", &args)
}

/// Where COLMAP's database of a set is left.
pub fn work(set: &Set, flags: &[&str]) -> PathBuf {
    let folder = std::env::var_os("TERRANE_PEER_CACHE").map_or_else(std::env::temp_dir, PathBuf::from);
    folder.join(format!("terrane-peer-{}{}", set.name, flags.join("").replace("--", "-")))
}

/// Where an answer is kept, when that is wanted.
fn cache(name: &str, args: &[String]) -> Option<PathBuf> {
    let folder = PathBuf::from(std::env::var_os("TERRANE_PEER_CACHE")?);
    let text: String = args
        .iter()
        .map(|arg| Path::new(arg).file_name().map_or(arg.clone(), |n| n.to_string_lossy().into_owned()))
        .collect::<Vec<_>>()
        .join("_");
    let parent = args.first().map(|path| path.replace('/', "_")).unwrap_or_default();
    Some(folder.join(format!("{name}{parent}{text}.json")))
}
