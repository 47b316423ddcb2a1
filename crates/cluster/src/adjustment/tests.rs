//! Holders in this process, one of which leaves in the midst of a solve.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use terrane_pipeline::Store;
use terrane_pipeline::adjustment::{
    BundleError, BundleOptions, BundleReport, BundleSolver, PartHost, PartRequest, StoredParts, WholeProblem,
    problems, solve, store_parts,
};
use terrane_proto::{Endpoint, Token};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio::task::JoinHandle;

use super::{HolderOptions, RemoteHost, RemoteOptions, hold};

/// A strip of cameras that look down on bumpy ground, as a BAL file: exact observations, a start that is off.
fn strip() -> WholeProblem {
    let wave = |i: usize, scale: f64| ((i as f64 + 0.5) * 12.9898).sin() * scale;
    let (cameras, points) = (30, 600);
    let mut observations = Vec::new();
    let place: Vec<[f64; 3]> =
        (0..points).map(|i| [i as f64 * 0.1 - 2.0, wave(i, 4.0), wave(i + 77, 1.5)]).collect();
    for camera in 0..cameras {
        let x = camera as f64 * 2.0;
        for (point, p) in place.iter().enumerate().filter(|(_, p)| (p[0] - x).abs() < 7.0) {
            // Looks down −z from 10 m: no rotation.
            let (u, v) = ((p[0] - x) / (10.0 - p[2]), p[1] / (10.0 - p[2]));
            observations.push(format!("{camera} {point} {:.6} {:.6}", 800.0 * u, 800.0 * v));
        }
    }
    let mut text = format!("{cameras} {points} {}\n{}\n", observations.len(), observations.join("\n"));
    for camera in 0..cameras {
        let x = camera as f64 * 2.0;
        let off = [wave(camera, 3e-3), wave(camera + 9, 3e-3), wave(camera + 5, 3e-3)];
        let t = [-x + wave(camera + 3, 0.05), wave(camera + 4, 0.05), -10.0 + wave(camera + 8, 0.05)];
        let numbers = [off[0], off[1], off[2], t[0], t[1], t[2], 803.0, 0.0, 0.0];
        numbers.iter().for_each(|value| text.push_str(&format!("{value}\n")));
    }
    for (i, p) in place.iter().enumerate() {
        let x = [p[0] + wave(i, 0.05), p[1] + wave(i + 1, 0.05), p[2] + wave(i + 2, 0.05)];
        x.iter().for_each(|value| text.push_str(&format!("{value}\n")));
    }
    problems::read_bal(text.as_bytes()).unwrap()
}

fn options() -> BundleOptions {
    BundleOptions { solver: BundleSolver::Implicit, cluster_poses: 4, ..BundleOptions::default() }
}

/// Lets through, but ends one holder before the question of a number.
struct Saboteur {
    inner: RemoteHost,
    asked: AtomicU64,
    at: u64,
    victim: Option<JoinHandle<()>>,
}

impl PartHost for Saboteur {
    fn ask(&mut self, request: &PartRequest) -> Result<Vec<Vec<f64>>, BundleError> {
        if self.asked.fetch_add(1, Ordering::SeqCst) == self.at
            && let Some(victim) = self.victim.take()
        {
            victim.abort();
        }
        self.inner.ask(request)
    }

    fn accepted(&mut self, cameras: Vec<f64>) {
        self.inner.accepted(cameras);
    }

    fn wants_cameras(&self) -> bool {
        true
    }
}

/// Solves with so many holders; the first is ended at a question. What came out, and how many questions there were.
fn solved(holders: u32, lose_at: Option<u64>, memory_bytes: u64) -> (WholeProblem, BundleReport, u64) {
    let runtime = Runtime::new().unwrap();
    let mut whole = strip();
    let parts = StoredParts::new(Store::memory(), "parts");
    let stored = store_parts(&whole, &options(), &parts).unwrap();
    let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let token = Token::random().unwrap();
    let start = |index: u32| {
        let endpoint = Endpoint::new(url.clone(), Some(token.clone()));
        let (name, store) = (format!("holder {index}"), Arc::new(parts.clone()));
        let options = HolderOptions { endpoint, name, memory_bytes, store };
        runtime.spawn(async move {
            let _ = hold(options).await;
        })
    };
    let mut holding: Vec<JoinHandle<()>> = (0..holders).map(start).collect();
    let remote = RemoteOptions { holders, token: Some(token.clone()), patience: Duration::from_secs(20) };
    let weights = stored.weights.clone();
    let inner =
        RemoteHost::start(runtime.handle().clone(), listener, stored.side.clone(), weights, remote).unwrap();
    assert_eq!(inner.num_holders(), holders as usize);
    let victim = Some(holding.remove(0));
    let at = lose_at.unwrap_or(u64::MAX);
    let mut host = Saboteur { inner, asked: AtomicU64::new(0), at, victim };
    let report = stored.solve(&mut host, &mut whole).unwrap();
    let asked = host.asked.load(Ordering::SeqCst);
    drop(host);
    runtime.shutdown_background();
    (whole, report, asked)
}

fn same(a: &WholeProblem, b: &WholeProblem) -> bool {
    a.problem == b.problem && a.shards == b.shards
}

#[test]
fn any_number_of_holders_gives_the_same_bytes() {
    let mut here = strip();
    let report = solve(&mut here.problem, &mut here.shards, &options()).unwrap();
    assert!(report.clusters > 5 && report.final_cost < 1e-3 * report.initial_cost, "{report:?}");
    for (holders, memory_bytes) in [(1, u64::MAX), (2, u64::MAX), (3, (64 << 20) + 200_000)] {
        let (there, told, _) = solved(holders, None, memory_bytes);
        assert!(same(&here, &there), "{holders} holders");
        assert_eq!(told.final_cost.to_bits(), report.final_cost.to_bits());
    }
}

#[test]
fn a_holder_that_is_lost_costs_no_step_and_no_bit() {
    let (whole, report, asked) = solved(2, None, u64::MAX);
    assert!(asked > 20, "{asked} questions");
    // Every kind of question comes within the first dozen; then one near the end.
    for at in (1..13).chain([asked - 2]) {
        let (there, told, again) = solved(2, Some(at), u64::MAX);
        assert!(same(&whole, &there), "lost at question {at}");
        assert_eq!((told.iterations, again), (report.iterations, asked), "lost at question {at}");
    }
}

#[test]
fn no_holder_at_all_is_an_error_that_says_so() {
    let runtime = Runtime::new().unwrap();
    let parts = StoredParts::new(Store::memory(), "parts");
    let stored = store_parts(&strip(), &options(), &parts).unwrap();
    let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
    let remote = RemoteOptions { holders: 1, token: None, patience: Duration::from_millis(200) };
    let started = RemoteHost::start(runtime.handle().clone(), listener, stored.side, stored.weights, remote);
    let error = started.err().expect("nobody joined");
    assert!(error.is_unreachable() && error.to_string().contains("0 of 1"), "{error}");
}
