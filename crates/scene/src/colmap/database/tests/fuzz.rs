//! Damaged databases by the thousand: whatever is in the file, reading ends, with a value or an error.

use super::*;
use crate as terrane_scene_under_test;

#[path = "../../../../examples/fuzz_database/mutate.rs"]
mod mutate;

#[test]
fn damaged_databases_are_read_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = sample(folder.path(), "a.db");
    mutate::shrink(&path);
    let whole = std::fs::read(&path).unwrap();
    let target = folder.path().join("b.db");
    let mut outcomes = [0, 0];
    for seed in 0..600 {
        std::fs::write(&target, mutate::bytes(&whole, seed)).unwrap();
        outcomes[usize::from(mutate::read_all(&target).is_ok())] += 1;
    }
    for seed in 0..60 {
        std::fs::write(&target, &whole).unwrap();
        mutate::values(&target, seed);
        outcomes[usize::from(mutate::read_all(&target).is_ok())] += 1;
    }
    // Most damage is noticed; some hits what nobody reads.
    assert!(outcomes[0] > 150 && outcomes[1] > 50, "{outcomes:?}");
}
