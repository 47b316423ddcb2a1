//! Bad input: a clear message that names the thing and the remedy, a documented exit code, and nothing lost.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use serde_json::Value;
use terrane_testkit::town::{Town, TownOptions};
use terrane_tests::{contents, terrane};

/// A few small photographs that overlap.
fn photographs() -> &'static [Vec<u8>] {
    static PHOTOGRAPHS: OnceLock<Vec<Vec<u8>>> = OnceLock::new();
    PHOTOGRAPHS.get_or_init(|| {
        let options = TownOptions {
            rows: 1,
            columns: 4,
            spacing_m: 12.0,
            width_px: 640,
            height_px: 480,
            focal_px: 530.0,
            texels_per_m: 8.0,
            ..Default::default()
        };
        let town = Town::new(&options);
        (0..town.num_photographs()).map(|index| town.photograph(index).jpeg).collect()
    })
}

struct Scratch {
    folder: tempfile::TempDir,
}

impl Scratch {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder for the test");
        std::fs::create_dir(folder.path().join("photos")).expect("a folder for photographs");
        Self { folder }
    }

    /// With this many good photographs.
    fn with_photographs(count: usize) -> Self {
        let scratch = Self::new();
        for (index, jpeg) in photographs().iter().take(count).enumerate() {
            scratch.add(&format!("good_{index}.jpg"), jpeg);
        }
        scratch
    }

    fn add(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.photos().join(name), bytes).expect("the photograph is written");
    }

    fn photos(&self) -> PathBuf {
        self.folder.path().join("photos")
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    fn command(&self) -> Command {
        let mut command = terrane();
        command.arg("run").arg(self.photos()).arg("-o").arg(self.out()).args(["--workers", "1"]);
        command
    }

    fn run(&self) -> Output {
        self.command().output().expect("terrane starts")
    }

    fn report(&self) -> Value {
        let bytes = std::fs::read(self.out().join("report.json")).expect("a report is written");
        serde_json::from_slice(&bytes).expect("the report is JSON")
    }
}

/// Checks the exit code, and that the message holds every one of these words.
fn expect(output: &Output, code: i32, words: &[&str]) {
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{message}");
    for word in words {
        assert!(message.contains(word), "`{word}` is missing in: {message}");
    }
}

#[test]
fn an_empty_folder_and_one_without_photographs_are_named() {
    let scratch = Scratch::new();
    expect(&scratch.run(), 2, &["photos", "is empty"]);
    scratch.add("readme.txt", b"no photograph");
    expect(&scratch.run(), 2, &["photos", "no photograph"]);
}

#[test]
fn broken_files_are_listed_one_by_one_and_the_run_goes_on() {
    let scratch = Scratch::with_photographs(4);
    let whole = &photographs()[0];
    scratch.add("truncated.jpg", &whole[..whole.len() / 2]);
    scratch.add("text.jpg", b"this is text");
    scratch.add("zero.jpg", b"");
    let one_pixel = [
        &b"\x89PNG\r\n\x1a\n"[..],
        b"\0\0\0\rIHDR\0\0\0\x01\0\0\0\x01\x08\0\0\0\0\x3a\x7e\x9b\x55",
        b"\0\0\0\x0aIDAT\x78\x9c\x63\x60\0\0\0\x02\0\x01\x48\xaf\xa4\x71",
        b"\0\0\0\0IEND\xae\x42\x60\x82",
    ];
    scratch.add("one_pixel.png", &one_pixel.concat());
    scratch.add("phone.jpg", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic");
    scratch.add("raw.tif", b"II\x2a\0\x10\0\0\0CR\x02\0\0\0\0\0");
    scratch.add("web.png", b"RIFF\x24\0\0\0WEBPVP8 ");
    expect(&scratch.run(), 0, &[]);
    let report = scratch.report();
    assert_eq!(report["images"]["registered"], 4, "{report:#}");
    let left_out = report["images"]["left_out"].as_array().expect("a list");
    for name in ["truncated.jpg", "text.jpg", "zero.jpg", "one_pixel.png"] {
        let entry = left_out.iter().find(|entry| entry["path"] == name);
        let reason = entry.and_then(|entry| entry["reason"].as_str()).unwrap_or_default();
        assert!(!reason.is_empty(), "{name} is not listed with a reason: {left_out:#?}");
    }
    for (name, format, remedy) in
        [("phone.jpg", "HEIC", "convert"), ("raw.tif", "CR2", "develop"), ("web.png", "WebP", "convert")]
    {
        let entry = left_out.iter().find(|entry| entry["path"] == name);
        let reason = entry.and_then(|entry| entry["reason"].as_str()).unwrap_or_default();
        assert!(reason.contains(format) && reason.contains(remedy), "{name}: {reason}");
    }
}

#[test]
fn what_can_not_be_reconstructed_is_an_outcome_with_a_reason() {
    let identical = Scratch::new();
    identical.add("a.jpg", &photographs()[0]);
    identical.add("b.jpg", &photographs()[0]);
    expect(&identical.run(), 1, &["nothing could be reconstructed", "report.json"]);
    assert!(identical.report()["nothing_reconstructed"].is_string());

    let strangers = Scratch::new();
    strangers.add("a.jpg", &photographs()[0]);
    let elsewhere = TownOptions {
        rows: 1,
        columns: 1,
        width_px: 640,
        height_px: 480,
        focal_px: 530.0,
        texels_per_m: 8.0,
        seed: terrane_geometry::Seed(99),
        ..Default::default()
    };
    strangers.add("b.jpg", &Town::new(&elsewhere).photograph(0).jpeg);
    expect(&strangers.run(), 1, &["nothing could be reconstructed"]);
}

#[test]
fn an_output_that_can_not_be_written_is_named() {
    let scratch = Scratch::with_photographs(2);
    std::fs::write(scratch.out(), b"a file where the folder should be").expect("written");
    expect(&scratch.run(), 3, &["out", "can't be written"]);
}

#[test]
fn a_busy_port_is_named() {
    let scratch = Scratch::with_photographs(2);
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = listener.local_addr().expect("an address").port().to_string();
    let output = scratch.command().args(["--port", &port]).output().expect("terrane starts");
    expect(&output, 3, &[&port]);
}

#[test]
fn unknown_flags_and_values_are_usage_errors() {
    let scratch = Scratch::with_photographs(2);
    for flags in
        [["--camera", "FISH:1"], ["--workers", "none"], ["--set", "no.such.option=1"], ["--wrokers", "2"]]
    {
        let output = scratch.command().args(flags).output().expect("terrane starts");
        assert_eq!(output.status.code(), Some(2), "{flags:?}: {}", String::from_utf8_lossy(&output.stderr));
    }
    assert!(!scratch.out().join("report.json").exists());
}

#[test]
fn a_full_disk_is_named_and_the_rerun_resumes() {
    let scratch = Scratch::with_photographs(3);
    std::fs::create_dir(scratch.out()).expect("made");
    let mounted =
        Command::new("mount").args(["-t", "tmpfs", "-o", "size=200k", "tmpfs"]).arg(scratch.out()).status();
    if !mounted.is_ok_and(|status| status.success()) {
        println!("a small file system can't be mounted here: this test was not run");
        return;
    }
    let output = scratch.run();
    let grown = Command::new("mount").args(["-o", "remount,size=64m"]).arg(scratch.out()).status();
    let resumed = scratch.run();
    let unmounted = Command::new("umount").arg(scratch.out()).status();
    expect(&output, 3, &["No space left on device", "free space"]);
    assert!(grown.is_ok_and(|status| status.success()) && unmounted.is_ok_and(|status| status.success()));
    expect(&resumed, 0, &[]);
}

#[test]
fn a_flipped_byte_is_found_and_computed_again() {
    let scratch = Scratch::with_photographs(4);
    expect(&scratch.run(), 0, &[]);
    let sparse = scratch.out().join("sparse");
    let before = contents(&sparse);
    flip_a_byte(&scratch.out().join(".terrane/store/artefacts/features"));
    // What depends on it must be wanted again for it to be read.
    for stage in ["match", "submap", "export"] {
        let _ = std::fs::remove_dir_all(scratch.out().join(".terrane/store/artefacts").join(stage));
    }
    std::fs::remove_dir_all(&sparse).expect("removed");
    expect(&scratch.run(), 0, &[]);
    assert_eq!(contents(&sparse), before, "the result after the repair differs");
    let stages = scratch.report()["costs"]["stages"].clone();
    let features =
        stages.as_array().expect("a list").iter().find(|stage| stage["stage"] == "features").cloned();
    assert!(features.is_some_and(|stage| stage["tasks_run"].as_u64() >= Some(1)), "{stages:#}");
}

/// Flips one byte in the middle of the only artefact of a stage.
fn flip_a_byte(stage: &Path) {
    let path =
        std::fs::read_dir(stage).expect("the stage has artefacts").flatten().next().expect("one").path();
    let mut bytes = std::fs::read(&path).expect("readable");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    std::fs::write(&path, bytes).expect("written");
}
