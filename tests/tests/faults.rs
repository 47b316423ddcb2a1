//! Aimed faults on real processes: the run must end with the bytes of an undisturbed one, and leave nothing behind.
//!
//! The photographs are rendered: a small town, cut into several clusters.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use tempfile::TempDir;
use terrane_testkit::town::{Town, TownOptions};
use terrane_tests::processes::{Running, children, eventually, lives, signal};
use terrane_tests::{contents, terrane};

/// Files by name with their bytes.
type Files = Vec<(PathBuf, Vec<u8>)>;

const FLAGS: &[&str] = &["--cluster-size", "14", "--seed", "3"];

fn photographs() -> &'static Path {
    static FOLDER: OnceLock<TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a folder for photographs");
        let small = TownOptions {
            rows: 4,
            columns: 5,
            width_px: 600,
            height_px: 450,
            focal_px: 500.0,
            texels_per_m: 8.0,
            ..TownOptions::default()
        };
        let town = Town::new(&small);
        for index in 0..town.num_photographs() {
            let photograph = town.photograph(index);
            std::fs::write(folder.path().join(&photograph.name), photograph.jpeg)
                .expect("photographs can be written");
        }
        folder
    });
    folder.path()
}

fn flags(workers: &'static str) -> Vec<&'static str> {
    [FLAGS, &["--workers", workers]].concat()
}

fn model(out: &Path) -> Files {
    contents(&out.join("sparse/0"))
}

fn report(out: &Path) -> serde_json::Value {
    let text = std::fs::read(out.join("report.json")).expect("a report is written");
    serde_json::from_slice(&text).expect("the report is JSON")
}

fn finish(mut run: Running) -> Running {
    let status = run.finish();
    assert!(status.success(), "{status}: {:?}", run.seen.last());
    run
}

/// What one worker makes when nobody disturbs it.
fn undisturbed() -> &'static Files {
    static FILES: OnceLock<Files> = OnceLock::new();
    FILES.get_or_init(|| {
        let out = tempfile::tempdir().expect("a folder for results");
        finish(Running::start(photographs(), out.path(), &flags("1")));
        let report = report(out.path());
        let clusters = report["clusters"].as_array().map_or(0, Vec::len);
        assert!(clusters >= 2, "{clusters} clusters are too few to disturb");
        assert_eq!(report["images"]["registered"], 20, "{}", report["images"]);
        model(out.path())
    })
}

/// Artefacts in the store of a result, by stage.
fn artefacts(out: &Path) -> Vec<PathBuf> {
    contents(&out.join(".terrane/store")).into_iter().map(|(path, _)| path).collect()
}

fn tasks(report: &serde_json::Value, what: &str) -> u64 {
    let stages = report["costs"]["stages"].as_array().expect("costs by stage");
    stages.iter().filter_map(|stage| stage[what].as_u64()).sum()
}

fn assert_no_process_left(workers: &[u32]) {
    for worker in workers {
        eventually("workers end with their coordinator", || !lives(*worker));
    }
}

#[test]
fn any_number_of_workers_gives_the_same_bytes() {
    for workers in ["2", "3"] {
        let out = tempfile::tempdir().expect("a folder for results");
        finish(Running::start(photographs(), out.path(), &flags(workers)));
        assert!(model(out.path()) == *undisturbed(), "{workers} workers give other bytes");
    }
}

#[test]
fn workers_killed_while_they_map_are_replaced() {
    let out = tempfile::tempdir().expect("a folder for results");
    let mut run = Running::start(photographs(), out.path(), &flags("2"));
    assert!(run.wait_for_running("submap"), "submaps are made");
    let doomed = children(run.id());
    assert_eq!(doomed.len(), 2);
    doomed.iter().for_each(|worker| signal(*worker, libc::SIGKILL));
    let run = finish(run);
    let lost = run.log_lines("is lost");
    assert!(lost.iter().any(|line| line.contains("submap")), "the fault did not fire: {lost:?}");
    assert!(model(out.path()) == *undisturbed());
    assert!(tasks(&report(out.path()), "retries") >= 1);
}

#[test]
fn a_killed_coordinator_takes_its_workers_along_and_the_next_one_goes_on() {
    let out = tempfile::tempdir().expect("a folder for results");
    let mut run = Running::start(photographs(), out.path(), &flags("2"));
    assert!(run.wait_for_running("submap"), "submaps are made");
    let workers = children(run.id());
    signal(run.id(), libc::SIGKILL);
    assert_no_process_left(&workers);
    drop(run);
    let before = artefacts(out.path());
    assert!(before.len() >= 5, "{before:?}");

    let run = finish(Running::start(photographs(), out.path(), &flags("2")));
    assert!(model(out.path()) == *undisturbed());
    let report = report(out.path());
    let (computed, reused) = (tasks(&report, "tasks_run"), tasks(&report, "tasks_reused"));
    assert_eq!(reused as usize, before.len(), "finished tasks were computed again: {:?}", run.log_lines(""));
    assert_eq!((computed + reused) as usize, artefacts(out.path()).len());
    assert!(before.iter().all(|path| artefacts(out.path()).contains(path)));
}

#[test]
fn an_interrupted_run_says_so_and_goes_on_when_asked_again() {
    let out = tempfile::tempdir().expect("a folder for results");
    let mut run = Running::start(photographs(), out.path(), &flags("2"));
    assert!(run.wait_for_running("match"), "pairs are matched");
    let workers = children(run.id());
    signal(run.id(), libc::SIGINT);
    assert_eq!(run.finish().code(), Some(130));
    assert_no_process_left(&workers);
    let kept = artefacts(out.path()).len();
    finish(Running::start(photographs(), out.path(), &flags("1")));
    assert_eq!(tasks(&report(out.path()), "tasks_reused") as usize, kept);
    assert!(model(out.path()) == *undisturbed());
}

#[test]
fn a_flipped_byte_in_an_artefact_is_found_and_the_task_done_again() {
    let out = tempfile::tempdir().expect("a folder for results");
    finish(Running::start(photographs(), out.path(), &flags("1")));
    // What the output is read from, and what an earlier stage is read from once the later one is gone.
    flip(&only(&out.path().join(".terrane/store/artefacts/georegister")));
    flip(&only(&out.path().join(".terrane/store/artefacts/partition")));
    std::fs::remove_dir_all(out.path().join("sparse")).expect("results can be removed");
    std::fs::remove_dir_all(out.path().join(".terrane/store/artefacts/submap"))
        .expect("artefacts can be removed");
    finish(Running::start(photographs(), out.path(), &flags("1")));
    assert!(model(out.path()) == *undisturbed());
}

/// The first artefact of a stage.
fn only(folder: &Path) -> PathBuf {
    let (name, _) = contents(folder).into_iter().next().expect("the stage has an artefact");
    folder.join(name)
}

fn flip(path: &Path) {
    let mut bytes = std::fs::read(path).expect("artefacts can be read");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    std::fs::write(path, bytes).expect("artefacts can be written");
}

#[test]
fn a_busy_port_is_named_with_the_remedy() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port can be had");
    let address = taken.local_addr().expect("it has an address").to_string();
    let output = terrane().args(["coordinator", "--listen", &address]).output().expect("terrane starts");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(said.contains(&address) && said.contains("in use") && said.contains("another port"), "{said}");
}

#[test]
fn by_hand_the_same_processes_give_the_same_bytes() {
    let token = "a-token-for-this-test-only";
    let mut coordinator = terrane();
    coordinator.args(["coordinator", "--listen", "127.0.0.1:0"]).env("TERRANE_TOKEN", token);
    let mut coordinator = ByHand::start(coordinator);
    let url = coordinator.first_line().strip_prefix("listening on ").expect("it says where").to_owned();
    let workers: Vec<ByHand> = (0..2)
        .map(|index| {
            let mut worker = terrane();
            let name = format!("hand-{index}");
            worker.args([
                "worker",
                "--coordinator",
                &url,
                "--threads",
                "1",
                "--memory",
                "2GiB",
                "--name",
                &name,
            ]);
            worker.env("TERRANE_TOKEN", token);
            ByHand::start(worker)
        })
        .collect();
    let out = tempfile::tempdir().expect("a folder for results");
    let mut submit = terrane();
    submit.args(["--json", "submit"]).arg(photographs()).arg("-o").arg(out.path()).args(FLAGS);
    submit.args(["--coordinator", &url]).env("TERRANE_TOKEN", token);
    finish(Running::spawn(submit));
    assert!(model(out.path()) == *undisturbed());
    let refused = terrane().args(["status", "--coordinator", &url]).output().expect("terrane starts");
    assert_eq!(refused.status.code(), Some(3), "a client without the token");
    signal(coordinator.child.id(), libc::SIGTERM);
    assert!(coordinator.child.wait().expect("it ends").success());
    for mut worker in workers {
        assert!(worker.child.wait().expect("it ends").success(), "workers leave when they are told");
    }
}

/// A process that a person would have started.
struct ByHand {
    child: std::process::Child,
}

impl ByHand {
    fn start(mut command: std::process::Command) -> Self {
        let child = command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::null()).spawn();
        Self { child: child.expect("terrane starts") }
    }

    fn first_line(&mut self) -> String {
        let mut line = String::new();
        let stdout = self.child.stdout.as_mut().expect("its output is a pipe");
        std::io::BufRead::read_line(&mut std::io::BufReader::new(stdout), &mut line)
            .expect("its output is text");
        line.trim().to_owned()
    }
}

impl Drop for ByHand {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
