//! A rendered town through masks, and through a COLMAP database and back.
#![cfg(feature = "sqlite")]

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use terrane_pipeline::output::{self, RunCosts};
use terrane_pipeline::{
    Cancel, ExecutionContext, KnownArtefacts, PipelineError, PlanState, RunConfig, RunFigures, Stage, Store,
    execute, plan,
};
use terrane_scene::codec::FeatureBatchReader;
use terrane_scene::colmap::database::{Database, DatabaseWriter, SIFT_DESCRIPTORS};
use terrane_testkit::town::{Town, TownOptions};

const NUM_PHOTOGRAPHS: usize = 6;

/// Photographs in a folder below, a finished run of them, and its database.
struct Original {
    folder: tempfile::TempDir,
    store: Store,
    figures: RunFigures,
}

impl Original {
    fn photos(&self) -> PathBuf {
        self.folder.path().join("photos")
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    fn database(&self) -> PathBuf {
        self.folder.path().join("database.db")
    }
}

fn original() -> &'static Original {
    static ORIGINAL: OnceLock<Original> = OnceLock::new();
    ORIGINAL.get_or_init(|| {
        let options = TownOptions {
            rows: 2,
            columns: NUM_PHOTOGRAPHS / 2,
            width_px: 480,
            height_px: 360,
            focal_px: 400.0,
            ..Default::default()
        };
        let town = Town::new(&options);
        let folder = tempfile::tempdir().unwrap();
        let flight = folder.path().join("photos/flight");
        std::fs::create_dir_all(&flight).unwrap();
        for index in 0..town.num_photographs() {
            std::fs::write(flight.join(town.name(index)), town.photograph(index).jpeg).unwrap();
        }
        let store = Store::local(&folder.path().join("store")).unwrap();
        let config = config(&folder.path().join("photos"));
        let figures = run(&config, &store).unwrap().1;
        let (out, costs) = (folder.path().join("out"), RunCosts::default());
        output::write(&config, &store, &mut KnownArtefacts::new(), &out, &costs).unwrap();
        let database = folder.path().join("database.db");
        let written = output::write_database(&out, &store, &database).unwrap();
        assert_eq!(written.images, NUM_PHOTOGRAPHS as u64);
        Original { folder, store, figures }
    })
}

fn config(photos: &Path) -> RunConfig {
    let mut config = RunConfig { photos: photos.to_path_buf(), ..Default::default() };
    config.workers.threads = 2;
    config.features.images_per_task = 4;
    config.features.sift.max_features = 1000;
    config
}

fn importing(database: &Path) -> RunConfig {
    RunConfig { import: Some(database.to_path_buf()), ..config(&original().photos()) }
}

/// Runs to the end. How many tasks were run, and what came out; or the error that ended it.
fn run(config: &RunConfig, store: &Store) -> Result<(usize, RunFigures), PipelineError> {
    let context = ExecutionContext::new(config.clone(), Cancel::default())?;
    let mut known = KnownArtefacts::new();
    let mut count = 0;
    loop {
        let planned = plan(config, store, &mut known)?;
        match planned.state {
            PlanState::Finished { figures } => return Ok((count, figures)),
            PlanState::Failed { reason } => return Err(PipelineError::invalid_input(reason)),
            PlanState::Working => assert!(!planned.ready.is_empty(), "{:?}", planned.progress),
        }
        for task in planned.ready {
            if let Err(error) = execute(&task, store, &context) {
                assert!(error.invalid_input, "{} {}: {error}", task.stage, task.item);
                return Err(PipelineError::invalid_input(error.message));
            }
            known.record(task.key);
            count += 1;
        }
    }
}

fn report(config: &RunConfig, store: &Store) -> serde_json::Value {
    let out = tempfile::tempdir().unwrap();
    output::write(config, store, &mut KnownArtefacts::new(), out.path(), &RunCosts::default()).unwrap();
    serde_json::from_slice(&std::fs::read(out.path().join("report.json")).unwrap()).unwrap()
}

/// A copy of the run's database after some statements are left to `change`.
fn copy(folder: &Path, change: impl FnOnce(&Database, &mut DatabaseWriter)) -> PathBuf {
    let path = folder.join("copy.db");
    let database = Database::open(&original().database()).unwrap();
    let mut writer = DatabaseWriter::create(&path).unwrap();
    for camera in database.cameras().unwrap() {
        writer.camera(camera.id, &camera.camera.unwrap(), camera.has_prior_focal).unwrap();
    }
    for image in database.images().unwrap() {
        writer.image(image.id, &image.name, image.camera).unwrap();
        writer.keypoints(image.id, &database.keypoints(image.id).unwrap().unwrap()).unwrap();
    }
    change(&database, &mut writer);
    writer.finish().unwrap();
    path
}

#[test]
fn a_database_of_a_run_gives_the_run_again() {
    let original = original();
    assert_eq!(original.figures.registered, NUM_PHOTOGRAPHS as u64, "{:?}", original.figures);
    let store = Store::memory();
    let config = importing(&original.database());
    let (count, figures) = run(&config, &store).unwrap();
    assert!(count > 5);
    assert_eq!(figures.registered, NUM_PHOTOGRAPHS as u64, "{figures:?}");
    let (got, before) = (figures.mean_reprojection_error_px, original.figures.mean_reprojection_error_px);
    assert!((0.8 * before..1.2 * before).contains(&got), "{got} px, {before} px before");
    assert!(figures.georeferenced, "positions come from the photographs");
    assert_eq!(run(&config, &store).unwrap().0, 0, "nothing is computed twice");
    let inputs = report(&config, &store)["inputs"].clone();
    assert_eq!(inputs["database"]["images"], NUM_PHOTOGRAPHS);
    assert_eq!((&inputs["database"]["without_photograph"], &inputs["masks"]), (&0.into(), &().into()));
    assert!(inputs["database"]["pairs"].as_u64().unwrap() > 5);
}

#[test]
fn the_database_is_the_same_bytes_whenever_it_is_written() {
    let original = original();
    let again = original.folder.path().join("again.db");
    output::write_database(&original.out(), &original.store, &again).unwrap();
    assert!(std::fs::read(&again).unwrap() == std::fs::read(original.database()).unwrap());
    let nowhere = tempfile::tempdir().unwrap();
    let target = nowhere.path().join("a.db");
    for (out, store) in [(nowhere.path(), &original.store), (original.out().as_path(), &Store::memory())] {
        assert!(output::write_database(out, store, &target).unwrap_err().is_invalid_input());
        assert!(!target.exists());
    }
}

#[test]
fn keypoints_and_matches_alone_are_enough_and_photographs_may_be_absent() {
    let folder = tempfile::tempdir().unwrap();
    let path = copy(folder.path(), |database, writer| {
        for pair in database.pairs().unwrap() {
            let matches = database.matches(pair.first, pair.second).unwrap();
            writer.matches(pair.first, pair.second, &matches).unwrap();
        }
    });
    let photos = folder.path().join("empty");
    std::fs::create_dir(&photos).unwrap();
    std::fs::write(photos.join("other.jpg"), "no photograph").unwrap();
    let config = RunConfig { photos, ..importing(&path) };
    let store = Store::memory();
    let (_, figures) = run(&config, &store).unwrap();
    assert_eq!(figures.registered, NUM_PHOTOGRAPHS as u64, "{figures:?}");
    assert!(!figures.georeferenced);
    let report = report(&config, &store);
    assert_eq!(report["inputs"]["database"]["without_photograph"], NUM_PHOTOGRAPHS);
    assert_eq!(report["images"]["left_out"][0]["path"], "other.jpg");
}

#[test]
fn descriptors_are_matched_when_there_are_no_matches() {
    let folder = tempfile::tempdir().unwrap();
    let path = copy(folder.path(), |database, writer| {
        for image in database.images().unwrap() {
            let data = database.descriptors(image.id).unwrap();
            writer.descriptors(image.id, SIFT_DESCRIPTORS, data.len() / 128, &data).unwrap();
        }
    });
    let (_, figures) = run(&importing(&path), &Store::memory()).unwrap();
    assert_eq!(figures.registered, NUM_PHOTOGRAPHS as u64, "{figures:?}");
}

#[test]
fn what_can_not_be_matched_or_is_broken_ends_the_run_with_its_name() {
    let refused = |change: &dyn Fn(&Database, &mut DatabaseWriter)| {
        let folder = tempfile::tempdir().unwrap();
        let path = copy(folder.path(), change);
        let error = run(&importing(&path), &Store::memory()).unwrap_err();
        assert!(error.is_invalid_input() && error.to_string().contains("copy.db"), "{error}");
        error.to_string()
    };
    let none = refused(&|_, _| {});
    assert!(none.contains("has no descriptors"), "{none}");
    let learned = refused(&|database, writer| {
        for image in database.images().unwrap() {
            let count = database.keypoints(image.id).unwrap().unwrap().len();
            writer.descriptors(image.id, 1, count, &vec![1; count * 512]).unwrap();
        }
    });
    assert!(learned.contains("512 bytes and kind 1"), "{learned}");
    let outside = refused(&|_, writer| writer.matches(1, 2, &[[0, 0], [1_000_000, 1]]).unwrap());
    assert!(outside.contains("match of keypoints 1000000 and 1"), "{outside}");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("copy.db");
    std::fs::write(&path, "no database").unwrap();
    let error = run(&importing(&path), &Store::memory()).unwrap_err();
    assert!(error.to_string().contains("no SQLite database"), "{error}");
    let mut both = importing(&original().database());
    both.masks = Some(folder.path().to_path_buf());
    assert!(run(&both, &Store::memory()).unwrap_err().to_string().contains("masks"));
}

#[test]
fn changed_matches_recompute_what_depends_on_them() {
    let folder = tempfile::tempdir().unwrap();
    let matches = |keep: usize| {
        let _ = std::fs::remove_file(folder.path().join("copy.db"));
        copy(folder.path(), |database, writer| {
            for pair in database.pairs().unwrap().into_iter().take(keep) {
                let matches = database.matches(pair.first, pair.second).unwrap();
                writer.matches(pair.first, pair.second, &matches).unwrap();
            }
        })
    };
    let store = Store::memory();
    let config = importing(&matches(usize::MAX));
    run(&config, &store).unwrap();
    let batches = store.list_stage(Stage::Features).unwrap().len();
    let before = store.list_stage(Stage::Match).unwrap().len();
    matches(6);
    assert!(run(&config, &store).unwrap().0 > 3);
    assert_eq!(store.list_stage(Stage::Features).unwrap().len(), batches);
    assert!(store.list_stage(Stage::Match).unwrap().len() > before);
}

#[test]
fn masks_keep_features_out_and_change_only_what_they_cover() {
    let original = original();
    let masks = tempfile::tempdir().unwrap();
    std::fs::create_dir(masks.path().join("flight")).unwrap();
    let names: Vec<String> = {
        let mut names: Vec<_> = std::fs::read_dir(original.photos().join("flight"))
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    };
    // The upper third is dark, at half the size; one by its whole name, the others without the extension, one without.
    for (at, name) in names.iter().enumerate().skip(1) {
        let stem = name.rsplit_once('.').unwrap().0;
        let mask = if at == 1 { format!("{name}.png") } else { format!("{stem}.png") };
        let data: Vec<u8> = (0..180 * 240).map(|i| if i / 240 < 60 { 0 } else { 255 }).collect();
        std::fs::write(masks.path().join("flight").join(mask), png(240, 180, &data)).unwrap();
    }
    let masked = RunConfig { masks: Some(masks.path().to_path_buf()), ..config(&original.photos()) };
    let store = Store::memory();
    let (_, figures) = run(&masked, &store).unwrap();
    assert_eq!(figures.registered, NUM_PHOTOGRAPHS as u64, "{figures:?}");
    let mut image = 0;
    let keys = store.list_stage(Stage::Features).unwrap();
    let artefacts: Vec<_> = keys.iter().map(|key| store.get(&key.path()).unwrap().unwrap()).collect();
    let mut batches: Vec<_> =
        artefacts.iter().map(|artefact| FeatureBatchReader::open(artefact.as_ref()).unwrap()).collect();
    batches.sort_by_key(|batch| std::cmp::Reverse(batch.outcomes().len()));
    for batch in batches {
        for place in 0..batch.outcomes().len() {
            let features = batch.features(place).unwrap();
            assert!(features.len() > 200, "{}", features.len());
            let dark = features.keypoints.iter().filter(|keypoint| keypoint.y_px < 120.0).count();
            assert_eq!(dark > 0, image == 0, "image {image}: {dark} features in the dark");
            image += 1;
        }
    }
    let masks_report = report(&masked, &store)["inputs"]["masks"].clone();
    assert_eq!((&masks_report["found"], &masks_report["missing"]), (&5.into(), &1.into()));
    // Another mask for the last: its batch alone is computed again.
    let last = names.last().unwrap();
    std::fs::write(masks.path().join("flight").join(format!("{last}.png")), png(10, 10, &[255; 100]))
        .unwrap();
    run(&masked, &store).unwrap();
    assert_eq!(store.list_stage(Stage::Features).unwrap().len(), 3);
    let report = report(&masked, &store);
    let left_out = &report["images"]["left_out"][0];
    assert!(left_out["path"].as_str().unwrap().ends_with(last.as_str()), "{left_out}");
    assert!(left_out["reason"].as_str().unwrap().contains("another shape"), "{left_out}");
}

/// A grey PNG file.
fn png(width: u32, height: u32, data: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.write_header().unwrap().write_image_data(data).unwrap();
    bytes
}
