//! The plan before any stage has run.

use super::*;

#[test]
fn a_folder_begins_with_one_task_and_bad_ones_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let config = RunConfig { photos: dir.path().to_path_buf(), ..Default::default() };
    let store = Store::memory();
    let error = plan(&config, &store, &mut KnownArtefacts::new()).unwrap_err();
    assert!(error.is_invalid_input(), "{error}");

    std::fs::write(dir.path().join("a.jpg"), b"not a photograph").unwrap();
    let mut known = KnownArtefacts::new();
    let first = plan(&config, &store, &mut known).unwrap();
    assert_eq!((first.ready.len(), first.ready[0].stage), (1, Stage::Ingest));
    assert_eq!(plan(&config, &store, &mut known).unwrap(), first);
    let json = serde_json::to_vec(&first.ready[0]).unwrap();
    assert_eq!(serde_json::from_slice::<Task>(&json).unwrap(), first.ready[0]);

    std::fs::write(dir.path().join("b.jpg"), b"another").unwrap();
    assert_ne!(plan(&config, &store, &mut known).unwrap().ready[0].key, first.ready[0].key);

    let second = plan(&config, &store, &mut known).unwrap();
    known.set_aside(second.ready[0].key, "disk on fire");
    let failed = plan(&config, &store, &mut known).unwrap();
    assert!(matches!(failed.state, PlanState::Failed { ref reason } if reason.contains("disk on fire")));
    assert!(failed.ready.is_empty());
}
