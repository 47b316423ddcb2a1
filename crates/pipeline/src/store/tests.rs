//! One suite for every kind of store, then what only a folder does.

use super::*;

fn conforms(store: &Store) {
    assert_eq!(store.get("a/b").unwrap(), None);
    assert_eq!(store.head("a/b").unwrap(), None);
    assert_eq!(store.get_ranges("a/b", &[0..1, 1..2]).unwrap(), None);
    assert_eq!(store.put_if_absent("a/b", vec![1u8, 2, 3]).unwrap(), Put::Written);
    assert_eq!(store.put_if_absent("a/b", vec![9u8]).unwrap(), Put::Existed);
    assert_eq!(store.get("a/b").unwrap().unwrap().as_ref(), [1, 2, 3]);
    assert_eq!(store.head("a/b").unwrap(), Some(3));
    let parts = store.get_ranges("a/b", &[2..3, 0..2]).unwrap().unwrap();
    assert_eq!((parts[0].as_ref(), parts[1].as_ref()), (&[3u8][..], &[1u8, 2][..]));
    store.put("a/a", vec![0u8; 5]).unwrap();
    store.put("c", vec![0u8; 7]).unwrap();
    assert_eq!(store.list("a").unwrap(), [("a/a".to_owned(), 5), ("a/b".to_owned(), 3)]);
    store.delete("a/b").unwrap();
    store.delete("a/b").unwrap();
    assert_eq!(store.get("a/b").unwrap(), None);
    assert!(store.list("nothing").unwrap().is_empty());
    assert!(store.put("../up", vec![0u8]).is_err());
}

#[test]
fn memory_conforms() {
    conforms(&Store::memory());
}

#[test]
fn a_folder_conforms_and_keeps_its_objects() {
    let dir = tempfile::tempdir().unwrap();
    conforms(&Store::local(dir.path()).unwrap());
    let again = Store::open(dir.path().to_str().unwrap()).unwrap();
    assert_eq!(again.head("c").unwrap(), Some(7));
}

#[test]
fn racing_writers_leave_one_whole_object() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::local(dir.path()).unwrap();
    let wins: usize = std::thread::scope(|scope| {
        let writers: Vec<_> = (0..8u8)
            .map(|n| {
                let store = store.clone();
                scope.spawn(move || store.put_if_absent("x/y", vec![n; 100_000]).unwrap() == Put::Written)
            })
            .collect();
        writers.into_iter().map(|writer| usize::from(writer.join().unwrap())).sum()
    });
    assert_eq!(wins, 1);
    let bytes = store.get("x/y").unwrap().unwrap();
    assert!(bytes.len() == 100_000 && bytes.iter().all(|b| *b == bytes[0]));
}

#[test]
fn errors_of_the_disk_name_the_remedy() {
    let full = PipelineError::io("can't write x", &std::io::ErrorKind::StorageFull.into());
    assert!(full.is_storage_full() && !full.is_retryable() && full.to_string().contains("free space"));
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("file"), b"").unwrap();
    let error = Store::local(&dir.path().join("file/below")).unwrap_err();
    assert!(error.is_storage(), "{error}");
    assert!(Store::open("s3://bucket").unwrap_err().is_invalid_input());
}
