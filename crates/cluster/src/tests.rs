//! The whole shell in one process: coordinator on port 0, workers and clients over loopback, toy sums as tasks, aimed faults.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use bytes::Bytes;
use terrane_proto::types::*;
use terrane_proto::{Client, Endpoint, Token};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::coordinator::{Coordinator, CoordinatorOptions, Handle};
use crate::engine::*;
use crate::state::Policy;
use crate::worker::{self, WorkerOptions};
use crate::{ClusterError, types};

/// What goes wrong, once, at a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// The task stands still until the test opens the gate.
    Stall,
    Panic,
    Machine,
    /// The task says done and leaves nothing.
    Vanish,
}

#[derive(Default)]
struct Toy {
    store: BTreeMap<String, u64>,
    executed: BTreeMap<String, u32>,
    faults: Vec<(String, Fault)>,
    fired: Vec<String>,
    open: bool,
    closed: Option<(Verdict, RunTimings)>,
}

/// Sums in layers: task `l/i` is `i` plus the sum of layer `l - 1`. The store is shared by all processes of the test.
#[derive(Clone, Default)]
struct ToyEngine(Arc<(Mutex<Toy>, Condvar)>);

impl ToyEngine {
    fn with<T>(&self, body: impl FnOnce(&mut Toy) -> T) -> T {
        let result = body(&mut self.0.0.lock().unwrap());
        self.0.1.notify_all();
        result
    }

    fn wait_until(&self, what: impl Fn(&Toy) -> bool) {
        let mut toy = self.0.0.lock().unwrap();
        while !what(&toy) {
            let (guard, timeout) = self.0.1.wait_timeout(toy, Duration::from_secs(30)).unwrap();
            assert!(!timeout.timed_out(), "waited too long");
            toy = guard;
        }
    }
}

impl Engine for ToyEngine {
    fn planner(&self, description: &[u8]) -> Result<Box<dyn Planner>, EngineFailure> {
        let layers: Vec<u64> = serde_json::from_slice(description)
            .map_err(|error| EngineFailure { reason: format!("layers: {error}"), bad_input: true })?;
        Ok(Box::new(ToyPlanner { engine: self.clone(), layers, aside: BTreeSet::new() }))
    }

    fn executor(&self, _: &[u8]) -> Result<Arc<dyn Executor>, EngineFailure> {
        Ok(Arc::new(self.clone()))
    }
}

struct ToyPlanner {
    engine: ToyEngine,
    layers: Vec<u64>,
    aside: BTreeSet<String>,
}

impl Planner for ToyPlanner {
    fn plan(&mut self, news: News) -> Result<Planned, EngineFailure> {
        self.aside.extend(news.given_up.iter().map(|(key, _)| key.to_string()));
        let store = self.engine.with(|toy| toy.store.clone());
        let over = |key: &str| store.contains_key(key) || self.aside.contains(key);
        let keys = |layer: usize| (0..self.layers[layer]).map(move |index| format!("{layer}/{index}"));
        let open = (0..self.layers.len()).find(|&layer| !keys(layer).all(|key| over(&key)));
        let task = |key: String| PlannedTask {
            key: TaskKey::parse(&key).unwrap(),
            stage: key.split('/').next().unwrap().into(),
            item: key.clone(),
            spec: key.into(),
            peak_bytes: 1,
            expected_ms: 1,
        };
        let ready =
            open.map(|layer| keys(layer).filter(|key| !over(key)).map(task).collect()).unwrap_or_default();
        let stages = (0..self.layers.len()).map(|layer| PlannedStage {
            stage: layer.to_string(),
            done: keys(layer).filter(|key| over(key)).count() as u64,
            total: self.layers[layer],
        });
        Ok(Planned { ready, stages: stages.collect(), verdict: open.is_none().then_some(Verdict::Finished) })
    }

    fn close(&mut self, verdict: &Verdict, timings: &RunTimings) -> Result<Closing, EngineFailure> {
        self.engine.with(|toy| toy.closed = Some((verdict.clone(), timings.clone())));
        Ok(Closing::Written)
    }
}

impl Executor for ToyEngine {
    fn execute(&self, spec: &[u8], _: &CancelFlag) -> Result<Bytes, Failure> {
        let key = String::from_utf8(spec.to_vec()).unwrap();
        let fault = self.with(|toy| {
            *toy.executed.entry(key.clone()).or_default() += 1;
            let at = toy.faults.iter().position(|(aim, _)| *aim == key)?;
            toy.fired.push(key.clone());
            Some(toy.faults.remove(at).1)
        });
        match fault {
            Some(Fault::Stall) => self.wait_until(|toy| toy.open),
            Some(Fault::Panic) => panic!("a toy breaks"),
            Some(Fault::Machine) => {
                return Err(Failure {
                    kind: FailureKind::Machine,
                    reason: "disk".into(),
                    detail: Bytes::new(),
                });
            }
            Some(Fault::Vanish) => return Ok(Bytes::new()),
            None => {}
        }
        let (layer, index) =
            key.split_once('/').map(|(a, b)| (a.parse::<u64>().unwrap(), b.parse::<u64>().unwrap())).unwrap();
        self.with(|toy| {
            let below: u64 = layer.checked_sub(1).map_or(0, |below| {
                toy.store
                    .iter()
                    .filter(|(key, _)| key.starts_with(&format!("{below}/")))
                    .map(|(_, value)| value)
                    .sum()
            });
            toy.store.entry(key).or_insert(below + index);
        });
        Ok(Bytes::new())
    }
}

/// A coordinator that serves on a port and a runtime of its own: without the runtime everything of it is gone, as after a kill.
struct Served {
    handle: Handle,
    endpoint: Endpoint,
    stop: CancellationToken,
    server: Option<JoinHandle<Result<(), ClusterError>>>,
    runtime: Option<tokio::runtime::Runtime>,
}

impl Drop for Served {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // On a thread of its own: a runtime may not be ended from within another one.
            let ended = std::thread::spawn(move || runtime.shutdown_timeout(Duration::from_secs(5))).join();
            assert!(ended.is_ok() || std::thread::panicking());
        }
    }
}

impl Served {
    fn start(engine: &ToyEngine) -> Self {
        Self::start_at(engine, "127.0.0.1:0", Token::random().unwrap())
    }

    fn start_at(engine: &ToyEngine, at: &str, token: Token) -> Self {
        let policy = Policy {
            // Long against a busy machine's hiccups, short against a person's patience.
            silence_ms: 2_000,
            heartbeat_ms: 50,
            wait_ms: 200,
            first_backoff_ms: 10,
            ..Policy::default()
        };
        let options =
            CoordinatorOptions { policy, token: Some(token.clone()), farewell: Duration::from_secs(15) };
        let coordinator = Coordinator::new(Arc::new(engine.clone()), options);
        let listener = std::net::TcpListener::bind(at).unwrap();
        listener.set_nonblocking(true).unwrap();
        let endpoint = Endpoint::new(format!("http://{}", listener.local_addr().unwrap()), Some(token));
        let (handle, stop) = (coordinator.handle(), CancellationToken::new());
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        let stopped = stop.clone();
        let server = runtime
            .spawn(async move { coordinator.run(TcpListener::from_std(listener).unwrap(), stopped).await });
        Self { handle, endpoint, stop, server: Some(server), runtime: Some(runtime) }
    }

    fn worker(
        &self,
        engine: &ToyEngine,
        name: &str,
    ) -> JoinHandle<Result<worker::WorkerReport, ClusterError>> {
        let offer = Registration { name: name.into(), memory_bytes: 100, threads: 1, slots: 1, process: 1 };
        let options =
            WorkerOptions { endpoint: self.endpoint.clone(), offer, patience: Duration::from_secs(20) };
        tokio::spawn(worker::run(Arc::new(engine.clone()), options, CancellationToken::new()))
    }

    async fn stop(mut self) {
        self.stop.cancel();
        self.server.take().unwrap().await.unwrap().unwrap();
    }
}

const LAYERS: &[u8] = b"[4, 6, 1]";

fn expected() -> u64 {
    let layer_0: u64 = (0..4).sum();
    (0..6).map(|index| layer_0 + index).sum()
}

fn result(engine: &ToyEngine) -> u64 {
    engine.with(|toy| toy.store["2/0"])
}

async fn ended(handle: &Handle, run: RunId) -> RunPhase {
    tokio::time::timeout(Duration::from_secs(60), handle.wait(run)).await.expect("the run ends").unwrap()
}

#[tokio::test]
async fn two_workers_do_every_task_once_and_leave_when_told() {
    let engine = ToyEngine::default();
    let served = Served::start(&engine);
    let workers = [served.worker(&engine, "a"), served.worker(&engine, "b")];
    let client = Client::connect(&served.endpoint).await.unwrap();
    let run = client.submit(Bytes::from_static(LAYERS)).await.unwrap();
    assert_eq!(ended(&served.handle, run).await, RunPhase::Done);
    assert_eq!(result(&engine), expected());
    engine.with(|toy| {
        assert!(toy.executed.values().all(|&times| times == 1), "{:?}", toy.executed);
        let (verdict, timings) = toy.closed.clone().unwrap();
        assert_eq!((verdict, timings.stages["1"].tasks), (Verdict::Finished, 6));
        assert!(timings.stages["1"].peak_bytes > 0 || cfg!(not(target_os = "linux")));
    });
    let status = client.status().await.unwrap();
    assert_eq!(status.runs[0].stages.iter().map(|stage| stage.done).collect::<Vec<_>>(), [4, 6, 1]);
    assert_eq!(status.workers.len(), 2);
    assert!(client.logs(0).await.unwrap().lines.iter().any(|line| line.text.contains("worker a joined")));
    served.stop().await;
    let mut done = 0;
    for worker in workers {
        done += worker.await.unwrap().unwrap().done;
    }
    assert_eq!(done, 11);
}

#[tokio::test]
async fn a_worker_that_dies_in_a_task_is_replaced() {
    let engine = ToyEngine::default();
    engine.with(|toy| toy.faults.push(("1/3".into(), Fault::Stall)));
    let served = Served::start(&engine);
    let doomed = served.worker(&engine, "doomed");
    let run = served.handle.submit(Bytes::from_static(LAYERS)).await.unwrap();
    let stalled = engine.clone();
    tokio::task::spawn_blocking(move || stalled.wait_until(|toy| toy.fired == ["1/3"])).await.unwrap();
    doomed.abort();
    let survivor = served.worker(&engine, "survivor");
    assert_eq!(ended(&served.handle, run).await, RunPhase::Done);
    assert_eq!((result(&engine), engine.with(|toy| toy.executed["1/3"])), (expected(), 2));
    // The dead one's task ends after all: its put comes second and changes nothing.
    engine.with(|toy| toy.open = true);
    assert!(served.handle.logs(0).lines.iter().any(|line| line.text.contains("worker doomed is lost")));
    served.stop().await;
    survivor.await.unwrap().unwrap();
}

#[tokio::test]
async fn panics_failures_and_lost_results_are_tried_again() {
    let engine = ToyEngine::default();
    let aims = [("0/1", Fault::Panic), ("1/2", Fault::Machine), ("1/5", Fault::Vanish)];
    engine.with(|toy| toy.faults.extend(aims.map(|(key, fault)| (key.to_owned(), fault))));
    let served = Served::start(&engine);
    let workers = [served.worker(&engine, "a"), served.worker(&engine, "b")];
    let run = served.handle.submit(Bytes::from_static(LAYERS)).await.unwrap();
    assert_eq!(ended(&served.handle, run).await, RunPhase::Done);
    assert_eq!(result(&engine), expected());
    engine.with(|toy| {
        assert_eq!(toy.fired.len(), 3);
        assert!(
            toy.executed.iter().all(|(key, &times)| times == if toy.fired.contains(key) { 2 } else { 1 }),
            "{:?}",
            toy.executed
        );
    });
    served.stop().await;
    for worker in workers {
        worker.await.unwrap().unwrap();
    }
}

#[tokio::test]
async fn a_coordinator_that_is_started_again_computes_only_what_is_missing() {
    let engine = ToyEngine::default();
    engine.with(|toy| toy.faults.push(("1/4".into(), Fault::Stall)));
    let first = Served::start(&engine);
    let worker = first.worker(&engine, "a");
    first.handle.submit(Bytes::from_static(LAYERS)).await.unwrap();
    let stalled = engine.clone();
    tokio::task::spawn_blocking(move || stalled.wait_until(|toy| toy.fired == ["1/4"])).await.unwrap();
    // Both go without a word.
    drop(first);
    worker.abort();
    let done_before = engine.with(|toy| toy.store.clone());
    let second = Served::start(&engine);
    let worker = second.worker(&engine, "a");
    let run = second.handle.submit(Bytes::from_static(LAYERS)).await.unwrap();
    assert_eq!(ended(&second.handle, run).await, RunPhase::Done);
    assert_eq!(result(&engine), expected());
    engine.with(|toy| {
        assert!(done_before.len() >= 4);
        assert!(done_before.keys().all(|key| toy.executed[key] == 1), "{:?}", toy.executed);
        let computed: u64 = toy.closed.as_ref().unwrap().1.stages.values().map(|stage| stage.tasks).sum();
        assert_eq!(computed as usize, 11 - done_before.len());
        toy.open = true;
    });
    second.stop().await;
    worker.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_worker_outlives_a_restart_of_its_coordinator() {
    let engine = ToyEngine::default();
    let first = Served::start(&engine);
    let (address, token) = (first.endpoint.url.replace("http://", ""), first.endpoint.token.clone().unwrap());
    let worker = first.worker(&engine, "stays");
    let run = first.handle.submit(Bytes::from_static(LAYERS)).await.unwrap();
    assert_eq!(ended(&first.handle, run).await, RunPhase::Done);
    drop(first);
    engine.with(|toy| toy.store.clear());
    let second = Served::start_at(&engine, &address, token);
    let run = second.handle.submit(Bytes::from_static(LAYERS)).await.unwrap();
    assert_eq!(ended(&second.handle, run).await, RunPhase::Done);
    second.stop().await;
    assert_eq!(worker.await.unwrap().unwrap().done, 22);
}

#[tokio::test]
async fn a_run_can_be_cancelled_and_nonsense_is_refused() {
    let engine = ToyEngine::default();
    engine.with(|toy| toy.faults.push(("0/0".into(), Fault::Stall)));
    let served = Served::start(&engine);
    let worker = served.worker(&engine, "a");
    let client = Client::connect(&served.endpoint).await.unwrap();
    let refused = client.submit(Bytes::from_static(b"nonsense")).await.unwrap_err();
    assert!(refused.is_invalid_input() && refused.to_string().contains("layers"), "{refused}");
    let run = client.submit(Bytes::from_static(LAYERS)).await.unwrap();
    assert!(client.cancel(run).await.unwrap());
    assert!(!client.cancel(run).await.unwrap());
    assert_eq!(ended(&served.handle, run).await, RunPhase::Cancelled);
    assert!(!client.cancel(types::RunId(777)).await.unwrap());
    engine.with(|toy| toy.open = true);
    served.stop().await;
    worker.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_worker_without_a_coordinator_gives_up() {
    let engine = ToyEngine::default();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = Endpoint::new(format!("http://{}", listener.local_addr().unwrap()), None);
    drop(listener);
    let offer = Registration { name: "alone".into(), memory_bytes: 1, threads: 1, slots: 1, process: 1 };
    let options = WorkerOptions { endpoint, offer, patience: Duration::from_millis(200) };
    let error = worker::run(Arc::new(engine), options, CancellationToken::new()).await.unwrap_err();
    assert!(error.is_unreachable(), "{error}");
}
