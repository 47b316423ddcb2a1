//! COLMAP's databases and masks, end to end. What needs pycolmap says so and passes where it is not to be had; set
//! `TERRANE_PYTHON` to a Python that has it.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use serde_json::Value;
use terrane_testkit::town::{Town, TownOptions};
use terrane_tests::terrane;

const NUM_PHOTOGRAPHS: usize = 6;

/// Photographs of a town, and a finished run of them.
fn original() -> &'static Path {
    static ORIGINAL: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = ORIGINAL.get_or_init(|| {
        let options = TownOptions {
            rows: 2,
            columns: NUM_PHOTOGRAPHS / 2,
            width_px: 640,
            height_px: 480,
            focal_px: 530.0,
            ..Default::default()
        };
        let town = Town::new(&options);
        let folder = tempfile::tempdir().expect("a folder for the test");
        let photos = folder.path().join("photos");
        std::fs::create_dir(&photos).expect("a folder for photographs");
        for index in 0..town.num_photographs() {
            std::fs::write(photos.join(town.name(index)), town.photograph(index).jpeg)
                .expect("it is written");
        }
        expect(&run(&photos, &folder.path().join("out"), &[]), 0, &[]);
        expect(&export(&folder.path().join("out"), &folder.path().join("database.db")), 0, &["6 images"]);
        folder
    });
    folder.path()
}

fn run(photos: &Path, out: &Path, flags: &[&str]) -> Output {
    let mut command = terrane();
    command.arg("run").arg(photos).arg("-o").arg(out).args(["--workers", "1"]).args(flags);
    command.output().expect("terrane starts")
}

fn export(out: &Path, target: &Path) -> Output {
    let mut command = terrane();
    command.arg("export").arg(out).args(["--format", "colmap-db", "-o"]).arg(target);
    command.output().expect("terrane starts")
}

fn expect(output: &Output, code: i32, words: &[&str]) {
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{message}");
    for word in words {
        assert!(message.contains(word), "`{word}` is not in `{message}`");
    }
}

fn report(out: &Path) -> Value {
    let bytes = std::fs::read(out.join("report.json")).expect("a report is written");
    serde_json::from_slice(&bytes).expect("the report is JSON")
}

/// A Python that has pycolmap, or `None` with a message.
fn python() -> Option<PathBuf> {
    let python = std::env::var_os("TERRANE_PYTHON").map_or_else(|| "python3".into(), PathBuf::from);
    let has_it = Command::new(&python).args(["-c", "import pycolmap"]).output();
    if has_it.is_ok_and(|output| output.status.success()) {
        return Some(python);
    }
    println!("{} has no pycolmap: this test was not run; set TERRANE_PYTHON to run it", python.display());
    None
}

/// Runs a script, whose last line of output must be JSON.
fn script(python: &Path, text: &str, arguments: &[&Path]) -> Value {
    let output = Command::new(python).arg("-c").arg(text).args(arguments).output().expect("Python starts");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    let last = printed.lines().last().unwrap_or_default();
    serde_json::from_str(last).unwrap_or_else(|error| panic!("{error}: {printed}\n{errors}"))
}

#[test]
fn a_database_goes_out_and_comes_back_in() {
    let folder = original();
    let out = tempfile::tempdir().expect("a folder for results");
    let database = folder.join("database.db");
    let flags = ["--import", database.to_str().expect("the path is text")];
    expect(&run(&folder.join("photos"), out.path(), &flags), 0, &[]);
    let report = report(out.path());
    assert_eq!(report["images"]["registered"], NUM_PHOTOGRAPHS);
    assert_eq!(report["inputs"]["database"]["images"], NUM_PHOTOGRAPHS);
}

#[test]
fn what_is_no_database_or_no_run_is_bad_input() {
    let folder = original();
    let out = tempfile::tempdir().expect("a folder for results");
    let text = out.path().join("text.db");
    std::fs::write(&text, "this is text").expect("it is written");
    let flags = ["--import", text.to_str().expect("the path is text")];
    expect(
        &run(&folder.join("photos"), &out.path().join("out"), &flags),
        2,
        &["text.db", "no SQLite database"],
    );
    let absent = ["--import", "/nowhere/database.db"];
    expect(&run(&folder.join("photos"), &out.path().join("out"), &absent), 2, &["/nowhere/database.db"]);
    expect(&export(&folder.join("photos"), &out.path().join("a.db")), 2, &["finished run"]);
}

#[test]
fn masks_are_counted_and_a_folder_that_is_none_is_bad_input() {
    let folder = original();
    let out = tempfile::tempdir().expect("a folder for results");
    let masks = out.path().join("masks");
    std::fs::create_dir(&masks).expect("a folder for masks");
    let flags = ["--masks", masks.to_str().expect("the path is text")];
    expect(&run(&folder.join("photos"), &out.path().join("out"), &flags), 0, &[]);
    let inputs = report(&out.path().join("out"))["inputs"]["masks"].clone();
    assert_eq!((&inputs["found"], &inputs["missing"]), (&0.into(), &NUM_PHOTOGRAPHS.into()));
    let photos = folder.join("photos");
    let same = ["--masks", photos.to_str().expect("the path is text")];
    expect(&run(&photos, &out.path().join("out"), &same), 2, &["folder of their own"]);
}

#[test]
fn colmap_maps_our_database() {
    let Some(python) = python() else { return };
    let folder = original();
    let scratch = tempfile::tempdir().expect("a folder for results");
    let database = scratch.path().join("database.db");
    std::fs::copy(folder.join("database.db"), &database).expect("the database is copied");
    let text = "
import json, sys, pycolmap
database, images, out = sys.argv[1:]
with pycolmap.Database.open(database) as d:
    counts = dict(images=d.num_images(), keypoints=d.num_keypoints(), descriptors=d.num_descriptors(), pairs=d.num_verified_image_pairs(),
                  frames=d.num_frames(), rigs=d.num_rigs(), priors=d.num_pose_priors())
models = pycolmap.incremental_mapping(database, images, out)
best = max((m.num_reg_images() for m in models.values()), default=0)
print(); print(json.dumps(dict(counts, registered=best)))
";
    let found = script(&python, text, &[&database, &folder.join("photos"), scratch.path()]);
    for what in ["images", "frames", "priors"] {
        assert_eq!(found[what], NUM_PHOTOGRAPHS, "{what}: {found}");
    }
    assert_eq!(found["rigs"], 1, "{found}");
    assert_eq!(found["keypoints"], found["descriptors"], "{found}");
    assert!(found["pairs"].as_u64().is_some_and(|pairs| pairs >= 5), "{found}");
    assert_eq!(found["registered"], NUM_PHOTOGRAPHS, "{found}");
}

#[test]
fn colmaps_features_and_matches_are_reconstructed() {
    let Some(python) = python() else { return };
    let folder = original();
    let scratch = tempfile::tempdir().expect("a folder for results");
    let database = scratch.path().join("database.db");
    let text = "
import json, sys, pycolmap
database, images = sys.argv[1:]
pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE)
pycolmap.match_exhaustive(database)
print(); print(json.dumps(dict(done=True)))
";
    script(&python, text, &[&database, &folder.join("photos")]);
    let out = scratch.path().join("out");
    let flags = ["--import", database.to_str().expect("the path is text")];
    expect(&run(&folder.join("photos"), &out, &flags), 0, &[]);
    let report = report(&out);
    assert_eq!(report["images"]["registered"], NUM_PHOTOGRAPHS);
    let error_px = report["components"][0]["mean_reprojection_error_px"].as_f64().expect("the report has it");
    assert!((0.05..1.0).contains(&error_px), "{error_px} px");
}
