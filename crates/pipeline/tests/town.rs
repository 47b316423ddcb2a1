//! A small rendered town through every stage, in this process: what comes out is near the truth, reruns compute nothing,
//! broken artefacts are computed again, and bytes do not depend on threads or order.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use terrane_frontend::pairs::PairMode;
use terrane_geometry::alignment::umeyama;
use terrane_pipeline::output::{self, RunCosts};
use terrane_pipeline::{
    ArtefactKey, Cancel, ExecutionContext, FeatureMethod, KnownArtefacts, PlanState, RunConfig, RunFigures,
    Stage, Store, execute, plan,
};
use terrane_scene::colmap::{ModelFiles, read_binary};
use terrane_testkit::town::{Town, TownOptions};

const NUM_PHOTOGRAPHS: usize = 12;

/// The photographs of all tests, rendered once, beside three files that can't be used.
fn photographs() -> &'static (tempfile::TempDir, Town) {
    static PHOTOGRAPHS: OnceLock<(tempfile::TempDir, Town)> = OnceLock::new();
    PHOTOGRAPHS.get_or_init(|| {
        let options = TownOptions {
            rows: 2,
            columns: NUM_PHOTOGRAPHS / 2,
            width_px: 480,
            height_px: 360,
            focal_px: 400.0,
            ..Default::default()
        };
        let town = Town::new(&options);
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("flight")).unwrap();
        for index in 0..town.num_photographs() {
            std::fs::write(dir.path().join("flight").join(town.name(index)), town.photograph(index).jpeg)
                .unwrap();
        }
        let whole = town.photograph(0).jpeg;
        std::fs::write(dir.path().join("truncated.jpg"), &whole[..whole.len() / 2]).unwrap();
        std::fs::write(dir.path().join("text.jpg"), "not a photograph").unwrap();
        std::fs::write(dir.path().join("zero.jpg"), "").unwrap();
        (dir, town)
    })
}

fn config(threads: u32) -> RunConfig {
    let mut config = RunConfig { photos: photographs().0.path().to_path_buf(), ..Default::default() };
    config.workers.threads = threads;
    config.features.images_per_task = 5;
    config.features.sift.max_features = 1200;
    config.partition.max_cluster_size = 9;
    config.partition.min_overlap_images = 4;
    config
}

/// Runs to the end; tasks of a wave in their order or against it. Returns how many tasks were run.
fn run(config: &RunConfig, store: &Store, backwards: bool) -> (usize, RunFigures) {
    let context = ExecutionContext::new(config.clone(), Cancel::default()).unwrap();
    let mut known = KnownArtefacts::new();
    let mut count = 0;
    loop {
        let mut planned = plan(config, store, &mut known).unwrap();
        match planned.state {
            PlanState::Finished { figures } => return (count, figures),
            PlanState::Failed { reason } => panic!("{reason}"),
            PlanState::Working => assert!(!planned.ready.is_empty(), "{:?}", planned.progress),
        }
        if backwards {
            planned.ready.reverse();
        }
        for task in planned.ready {
            match execute(&task, store, &context) {
                Ok(_) => known.record(task.key),
                Err(error) => match error.corrupt_input {
                    Some(key) => known.discard(store, &key).unwrap(),
                    None => panic!("{} {}: {error}", task.stage, task.item),
                },
            }
            count += 1;
        }
    }
}

fn write(config: &RunConfig, store: &Store, out: &Path) {
    output::write(config, store, &mut KnownArtefacts::new(), out, &RunCosts::default()).unwrap();
}

/// Every file below a folder, by its path in it.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            let inner = files(&path).into_iter();
            found.extend(inner.map(|(name, bytes)| (Path::new(path.file_name().unwrap()).join(name), bytes)));
        } else {
            found.insert(PathBuf::from(path.file_name().unwrap()), std::fs::read(&path).unwrap());
        }
    }
    found
}

fn read_model(folder: &Path) -> terrane_scene::colmap::ColmapModel {
    let open = |name: &str| std::io::BufReader::new(std::fs::File::open(folder.join(name)).unwrap());
    read_binary(ModelFiles {
        cameras: open("cameras.bin"),
        images: open("images.bin"),
        points: open("points3D.bin"),
    })
    .unwrap()
}

#[test]
fn a_town_comes_out_as_it_is_and_a_rerun_computes_nothing() {
    let town = &photographs().1;
    let store_dir = tempfile::tempdir().unwrap();
    let store = Store::local(store_dir.path()).unwrap();
    let (count, figures) = run(&config(2), &store, false);
    assert!(count > 10, "{count}");
    assert_eq!((figures.images, figures.rejected), (NUM_PHOTOGRAPHS as u64 + 3, 3));
    assert_eq!(figures.registered, NUM_PHOTOGRAPHS as u64, "{figures:?}");
    assert_eq!(figures.components, 1, "{figures:?}");
    assert!(figures.clusters >= 2 && figures.georeferenced && figures.nothing.is_none(), "{figures:?}");
    assert!((0.05..1.0).contains(&figures.mean_reprojection_error_px), "{figures:?}");

    let out = tempfile::tempdir().unwrap();
    write(&config(2), &store, out.path());
    let names: Vec<_> = files(out.path()).into_keys().map(|path| path.display().to_string()).collect();
    let model = ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"];
    let top = ["cameras.geojson", "points.ply", "report.json", "run.json"];
    assert_eq!(names, top.iter().chain(&model).map(|name| (*name).to_owned()).collect::<Vec<_>>());
    let model = read_model(&out.path().join("sparse/0"));
    assert!(model.names.iter().all(|(_, name)| name.starts_with("flight/")), "{:?}", model.names);
    let truth = town.truth();
    let centers: Vec<_> =
        model.reconstruction.images.iter().map(|image| image.cam_from_world.center()).collect();
    let true_centers: Vec<_> = truth.images.iter().map(|image| image.cam_from_world.center()).collect();
    let truth_from_ours = umeyama(&centers, &true_centers, None).unwrap();
    for (ours, theirs) in centers.iter().zip(&true_centers) {
        let error_m = (truth_from_ours.transform_point(ours) - theirs).norm();
        assert!(error_m < 0.3, "{error_m}");
    }
    assert!((truth_from_ours.scale - 1.0).abs() < 0.05, "{}", truth_from_ours.scale);
    let report: serde_json::Value =
        serde_json::from_slice(&files(out.path())[Path::new("report.json")]).unwrap();
    assert_eq!(report["images"]["left_out"].as_array().unwrap().len(), 3);
    assert_eq!(report["images"]["registered"], NUM_PHOTOGRAPHS);

    assert_eq!(run(&config(2), &store, false).0, 0);
    let mut other = config(2);
    other.adjust.rounds += 1;
    assert_eq!(run(&other, &store, false).0, 3, "adjust, geo-register and export depend on the option");
}

#[test]
fn threads_order_and_broken_artefacts_do_not_change_a_byte() {
    let store_dir = tempfile::tempdir().unwrap();
    let store = Store::local(store_dir.path()).unwrap();
    run(&config(1), &store, false);
    let plain = tempfile::tempdir().unwrap();
    write(&config(1), &store, plain.path());

    let other = Store::memory();
    run(&config(3), &other, true);
    let backwards = tempfile::tempdir().unwrap();
    write(&config(3), &other, backwards.path());
    let sparse = |dir: &tempfile::TempDir| files(&dir.path().join("sparse"));
    assert_eq!(sparse(&plain), sparse(&backwards));

    // A flipped byte in an artefact of each stage, and everything after the stage gone, so that it is read again.
    for stage in [Stage::Ingest, Stage::Features, Stage::Pairs, Stage::Match, Stage::Submap, Stage::Merge] {
        let later = Stage::ALL.into_iter().filter(|later| *later > stage);
        for key in later.flat_map(|later| store.list_stage(later).unwrap()) {
            store.delete(&key.path()).unwrap();
        }
        let broken: ArtefactKey = store.list_stage(stage).unwrap()[0];
        let file = store_dir.path().join(broken.path());
        let mut bytes = std::fs::read(&file).unwrap();
        let middle = bytes.len() * 2 / 3;
        bytes[middle] ^= 0x10;
        std::fs::write(&file, bytes).unwrap();
        run(&config(1), &store, false);
    }
    let healed = tempfile::tempdir().unwrap();
    write(&config(1), &store, healed.path());
    assert_eq!(sparse(&plain), sparse(&healed));
}

#[test]
fn every_kind_of_features_brings_the_town_out() {
    let store = Store::memory();
    for method in FeatureMethod::ALL {
        let mut config = config(2);
        config.features.method = method;
        (config.features.corners.max_features, config.features.surf.max_features) = (1200, 1200);
        if method == FeatureMethod::Orb {
            // Binary descriptors, with pairs found by appearance.
            config.pairs.select.mode = PairMode::Retrieval;
            config.pairs.select.retrieval_neighbours = 8;
        }
        let (_, figures) = run(&config, &store, false);
        assert_eq!(figures.registered, NUM_PHOTOGRAPHS as u64, "{method}: {figures:?}");
        assert!((0.05..1.5).contains(&figures.mean_reprojection_error_px), "{method}: {figures:?}");
    }
}

#[test]
fn photographs_with_nothing_in_common_end_with_a_reason() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("a.jpg"), photographs().1.photograph(0).jpeg).unwrap();
    let config = RunConfig { photos: dir.path().to_path_buf(), ..Default::default() };
    let store = Store::memory();
    let (_, figures) = run(&config, &store, false);
    assert_eq!((figures.images, figures.registered, figures.components), (1, 0, 0));
    assert!(figures.nothing.is_some_and(|reason| reason.contains("nothing could be reconstructed")));
    let out = tempfile::tempdir().unwrap();
    write(&config, &store, out.path());
    assert!(files(out.path()).contains_key(Path::new("report.json")));
}
