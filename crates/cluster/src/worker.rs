//! A worker process: asks for a task, does it on a thread of its own, says what came of it.
//!
//! The reactor only talks; it keeps the leases alive while the task computes. A coordinator that is gone for longer than
//! the worker's patience ends the worker, so that no orphan computes on.

use std::collections::BTreeMap;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use terrane_proto::types::*;
use terrane_proto::{Client, Endpoint, ProtoError};
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;

use crate::ClusterError;
use crate::engine::{CancelFlag, Engine, Executor};
use crate::meter::{Meter, resident_bytes};

/// How a worker works.
#[derive(Clone, Debug)]
pub struct WorkerOptions {
    /// Where the coordinator is.
    pub endpoint: Endpoint,
    /// What the worker offers; it runs one task at a time whatever `slots` says.
    pub offer: Registration,
    /// How long the coordinator may be out of reach before the worker gives up.
    pub patience: Duration,
}

/// What a worker did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WorkerReport {
    /// Tasks done.
    pub done: u64,
    /// Tasks that failed.
    pub failed: u64,
}

/// Works until the coordinator says to leave or `shutdown` comes.
///
/// # Errors
/// When the coordinator refuses the worker, or is out of reach for longer than the worker's patience.
pub async fn run(
    engine: Arc<dyn Engine>,
    options: WorkerOptions,
    shutdown: CancellationToken,
) -> Result<WorkerReport, ClusterError> {
    let worker = Worker { engine, options };
    tokio::select! {
        result = worker.work() => result,
        () = shutdown.cancelled() => Ok(WorkerReport::default()),
    }
}

struct Worker {
    engine: Arc<dyn Engine>,
    options: WorkerOptions,
}

/// A registration in force.
struct Session {
    client: Client,
    id: WorkerId,
    heartbeat: Duration,
}

/// What became of a lease.
enum Outcome {
    Done(Bytes),
    Failed(Failure),
    /// Nobody waits for it any more.
    Revoked,
}

impl Worker {
    async fn work(&self) -> Result<WorkerReport, ClusterError> {
        let mut report = WorkerReport::default();
        let mut executors: BTreeMap<RunId, Arc<dyn Executor>> = BTreeMap::new();
        let mut session = self.join().await?;
        loop {
            let asked = self.patiently(|| session.client.next_task(session.id, &[])).await?;
            match asked {
                NextTask::Lease(lease) => {
                    self.serve(&mut session, &mut executors, lease, &mut report).await?
                }
                NextTask::Nothing => {}
                NextTask::Leave => return Ok(report),
                NextTask::Unknown => {
                    // Another coordinator may count its runs anew.
                    executors.clear();
                    session = self.join().await?;
                }
            }
        }
    }

    async fn join(&self) -> Result<Session, ClusterError> {
        let client = self.patiently(|| Client::connect(&self.options.endpoint)).await?;
        let offer = Registration { slots: 1, ..self.options.offer.clone() };
        let registered = self.patiently(|| client.register(offer.clone())).await?;
        let heartbeat = Duration::from_millis(u64::from(registered.heartbeat_ms));
        tracing::info!(worker = %registered.worker, "joined {}", self.options.endpoint.url);
        Ok(Session { client, id: registered.worker, heartbeat })
    }

    /// Repeats a call while the coordinator is out of reach, up to the worker's patience.
    async fn patiently<T, F: Future<Output = Result<T, ProtoError>>>(
        &self,
        call: impl Fn() -> F,
    ) -> Result<T, ClusterError> {
        let started = Instant::now();
        let mut pause = Duration::from_millis(50);
        loop {
            match call().await {
                Ok(answer) => return Ok(answer),
                Err(error) if error.is_unreachable() && started.elapsed() + pause < self.options.patience => {
                    tokio::time::sleep(pause).await;
                    pause = (pause * 2).min(Duration::from_secs(2));
                }
                Err(error) => return Err(error.into()),
            }
        }
    }

    async fn serve(
        &self,
        session: &mut Session,
        executors: &mut BTreeMap<RunId, Arc<dyn Executor>>,
        lease: TaskLease,
        report: &mut WorkerReport,
    ) -> Result<(), ClusterError> {
        tracing::info!(stage = %lease.stage, item = %lease.item, attempt = lease.attempt, "begins");
        let meter = Meter::start();
        let outcome = match self.executor(session, executors, lease.run).await {
            Ok(executor) => self.compute(session, executor, &lease).await?,
            Err(failure) => Outcome::Failed(failure),
        };
        let cost = meter.cost();
        match outcome {
            Outcome::Done(words) => {
                tracing::info!(stage = %lease.stage, item = %lease.item, wall_ms = cost.wall_ms, "done");
                report.done += 1;
                self.patiently(|| session.client.complete(session.id, lease.lease, cost, words.clone()))
                    .await?;
            }
            Outcome::Failed(failure) => {
                tracing::warn!(stage = %lease.stage, item = %lease.item, reason = %failure.reason, "failed");
                report.failed += 1;
                self.patiently(|| session.client.fail(session.id, lease.lease, failure.clone(), cost))
                    .await?;
            }
            Outcome::Revoked => tracing::info!(stage = %lease.stage, item = %lease.item, "revoked"),
        }
        Ok(())
    }

    /// What executes the tasks of a run, made when the first of them comes.
    async fn executor(
        &self,
        session: &Session,
        executors: &mut BTreeMap<RunId, Arc<dyn Executor>>,
        run: RunId,
    ) -> Result<Arc<dyn Executor>, Failure> {
        if let Some(executor) = executors.get(&run) {
            return Ok(executor.clone());
        }
        let failed = |reason: String| Failure { kind: FailureKind::Machine, reason, detail: Bytes::new() };
        let description = self
            .patiently(|| session.client.describe_run(run))
            .await
            .map_err(|error| failed(error.to_string()))?;
        let engine = self.engine.clone();
        let made = tokio::task::spawn_blocking(move || engine.executor(&description)).await;
        let made = made.map_err(|_| {
            failed("the run's description broke an invariant: this is a bug of terrane".into())
        })?;
        let executor = made.map_err(|failure| Failure {
            kind: if failure.bad_input { FailureKind::BadRun } else { FailureKind::Machine },
            reason: failure.reason,
            detail: Bytes::new(),
        })?;
        executors.insert(run, executor.clone());
        Ok(executor)
    }

    /// Computes on a thread of its own, and keeps the lease alive meanwhile.
    async fn compute(
        &self,
        session: &mut Session,
        executor: Arc<dyn Executor>,
        lease: &TaskLease,
    ) -> Result<Outcome, ClusterError> {
        let cancel = CancelFlag::default();
        let mut computing = start(executor, lease.spec.clone(), cancel.clone());
        let mut beat = tokio::time::interval(session.heartbeat);
        beat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut heard = Instant::now();
        let mut revoked = false;
        loop {
            tokio::select! {
                outcome = &mut computing => {
                    let lost = || Outcome::Failed(panicked("its thread ended".into()));
                    return Ok(if revoked { Outcome::Revoked } else { outcome.unwrap_or_else(|_| lost()) });
                }
                _ = beat.tick() => match session.client.heartbeat(session.id, &[lease.lease], resident_bytes()).await {
                    Ok(answer) => {
                        heard = Instant::now();
                        if !answer.known {
                            // A new coordinator: what is computed lands in the store, where its plan finds it.
                            *session = self.join().await?;
                        } else if answer.revoked.contains(&lease.lease) {
                            revoked = true;
                            cancel.set();
                        }
                    }
                    Err(error) if heard.elapsed() > self.options.patience => return Err(error.into()),
                    Err(_) => {}
                },
            }
        }
    }
}

fn start(executor: Arc<dyn Executor>, spec: Bytes, cancel: CancelFlag) -> oneshot::Receiver<Outcome> {
    let (sender, receiver) = oneshot::channel();
    let body = move || {
        let done = std::panic::catch_unwind(AssertUnwindSafe(|| executor.execute(&spec, &cancel)));
        let outcome = match done {
            Ok(Ok(report)) => Outcome::Done(report),
            Ok(Err(failure)) => Outcome::Failed(failure),
            Err(panic) => Outcome::Failed(panicked(message_of(&*panic))),
        };
        // Nobody listens when the worker is leaving: the artefact is in the store all the same.
        let _ = sender.send(outcome);
    };
    // When no thread can be had, the sender is dropped and the receiver says so.
    let spawned = std::thread::Builder::new().name("task".into()).stack_size(8 << 20).spawn(body);
    if let Err(error) = spawned {
        tracing::error!(%error, "no thread can be had for a task");
    }
    receiver
}

fn message_of(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "no message".into())
}

fn panicked(message: String) -> Failure {
    let reason = format!("the task stopped on a broken invariant: {message} (this is a bug of terrane)");
    Failure { kind: FailureKind::Input, reason, detail: Bytes::new() }
}
