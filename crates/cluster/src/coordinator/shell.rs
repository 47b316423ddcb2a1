//! The loop that owns the state: one command at a time in, effects out.

use std::collections::BTreeMap;
use std::time::Duration;

use bytes::Bytes;
use terrane_proto::types::{HeartbeatAnswer, NextTask, RunId, Status, WorkerId};
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;

use super::{Command, Handle};
use crate::engine::{EngineFailure, News, Planned, Planner, RunTimings, Verdict};
use crate::state::{Effect, Event, Policy, RequestId, State, Timestamp};

/// How often time passes for the state, and at most how often the status is published.
const TICK: Duration = Duration::from_millis(100);

struct Run {
    description: Bytes,
    /// Away while it plans.
    planner: Option<Box<dyn Planner>>,
}

pub(super) struct Shell {
    handle: Handle,
    inbox: mpsc::Receiver<Command>,
    published: watch::Sender<Status>,
    state: State,
    runs: BTreeMap<RunId, Run>,
    names: BTreeMap<String, WorkerId>,
    waiting: BTreeMap<RequestId, oneshot::Sender<NextTask>>,
}

/// Who waits for the direct answer to an event.
enum Caller {
    Nobody,
    Beat(oneshot::Sender<HeartbeatAnswer>),
    Judge(oneshot::Sender<bool>),
}

impl Shell {
    pub(super) fn new(
        handle: Handle,
        inbox: mpsc::Receiver<Command>,
        published: watch::Sender<Status>,
        policy: Policy,
    ) -> Self {
        let (runs, names, waiting) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        Self { handle, inbox, published, state: State::new(policy), runs, names, waiting }
    }

    /// Runs until `shutdown`, then bids the workers farewell and cancels `closing`.
    pub(super) async fn run(
        mut self,
        shutdown: CancellationToken,
        closing: CancellationToken,
        farewell: Duration,
    ) {
        let mut tick = tokio::time::interval(TICK);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut leaving = None;
        loop {
            tokio::select! {
                () = shutdown.cancelled(), if leaving.is_none() => {
                    leaving = Some(tokio::time::Instant::now() + farewell);
                    self.apply(Event::Drain, Caller::Nobody);
                }
                () = closing.cancelled() => break,
                _ = tick.tick() => {
                    self.apply(Event::Tick, Caller::Nobody);
                    self.publish();
                }
                Some(command) = self.inbox.recv() => self.take(command),
            }
            if leaving.is_some_and(|end| self.state.num_workers() == 0 || tokio::time::Instant::now() >= end)
            {
                closing.cancel();
                break;
            }
        }
        self.publish();
    }

    fn publish(&mut self) {
        let status = self.state.status(self.now());
        self.published.send_if_modified(|old| {
            let differs = *old != status;
            *old = status;
            differs
        });
    }

    fn now(&self) -> Timestamp {
        Timestamp(self.handle.0.log.elapsed_ms())
    }

    fn take(&mut self, command: Command) {
        match command {
            Command::Register(worker, registration, answer) => {
                self.names.insert(registration.name.clone(), worker);
                self.apply(Event::Registered(worker, registration), Caller::Nobody);
                let _ = answer.send(());
            }
            Command::Ask(event, request, answer) => {
                self.waiting.insert(request, answer);
                self.apply(event, Caller::Nobody);
            }
            Command::Beat(event, answer) => self.apply(event, Caller::Beat(answer)),
            Command::Judge(event, answer) => self.apply(event, Caller::Judge(answer)),
            Command::Submit(run, description, planner) => {
                self.runs.insert(run, Run { description, planner: Some(planner) });
                self.apply(Event::Submitted(run), Caller::Nobody);
                self.publish();
            }
            Command::Planned(run, number, outcome, planner) => {
                if let Some(row) = self.runs.get_mut(&run) {
                    row.planner = planner;
                }
                self.apply(Event::Planned(run, number, outcome), Caller::Nobody);
            }
            Command::Closed(run, result, planner) => {
                if let Some(row) = self.runs.get_mut(&run) {
                    row.planner = planner;
                }
                self.apply(Event::Closed(run, result), Caller::Nobody);
            }
            Command::Exited(name) => {
                if let Some(worker) = self.names.remove(&name) {
                    self.apply(Event::Exited(worker), Caller::Nobody);
                }
            }
            Command::Describe(run, answer) => {
                let _ = answer.send(self.runs.get(&run).map(|run| run.description.clone()));
            }
            Command::Cancel(run, answer) => {
                let open = self.state.phase(run).is_some_and(|phase| !phase.is_over());
                self.apply(Event::Cancelled(run), Caller::Nobody);
                let _ = answer.send(open);
            }
            Command::Status(answer) => {
                let _ = answer.send(self.state.status(self.now()));
            }
        }
    }

    fn apply(&mut self, event: Event, caller: Caller) {
        let mut caller = caller;
        for effect in self.state.apply(self.now(), event) {
            match effect {
                // A caller that has gone is no loss: its worker asks again, or is found silent.
                Effect::Answer(request, answer) => {
                    if let Some(waiting) = self.waiting.remove(&request) {
                        let _ = waiting.send(answer);
                    }
                }
                Effect::Heard { known, revoked } => {
                    if let Caller::Beat(answer) = std::mem::replace(&mut caller, Caller::Nobody) {
                        let _ = answer.send(HeartbeatAnswer { known, revoked });
                    }
                }
                Effect::Judged(accepted) => {
                    if let Caller::Judge(answer) = std::mem::replace(&mut caller, Caller::Nobody) {
                        let _ = answer.send(accepted);
                    }
                }
                Effect::Plan(run, number, news) => self.plan(run, number, news),
                Effect::Close(run, verdict, timings) => self.close(run, verdict, timings),
                Effect::Over(run, phase) => {
                    tracing::info!(%run, ?phase, "run is over");
                    self.runs.entry(run).and_modify(|run| run.planner = None);
                    self.publish();
                }
                Effect::Log(line) => self.handle.0.log.add(line),
            }
        }
    }

    /// Plans on a thread that may block; the planner travels there and back.
    fn plan(&mut self, run: RunId, number: u64, news: News) {
        let Some(mut planner) = self.runs.get_mut(&run).and_then(|run| run.planner.take()) else { return };
        let handle = self.handle.clone();
        let planning = tokio::task::spawn_blocking(move || {
            let outcome: Result<Planned, EngineFailure> = planner.plan(news);
            (outcome, planner)
        });
        tokio::spawn(async move {
            let (outcome, planner) = match planning.await {
                Ok((outcome, planner)) => (outcome, Some(planner)),
                Err(_) => (Err(broken("planning")), None),
            };
            let _ = handle.tell(Command::Planned(run, number, outcome, planner)).await;
        });
    }

    fn close(&mut self, run: RunId, verdict: Verdict, timings: RunTimings) {
        let Some(mut planner) = self.runs.get_mut(&run).and_then(|run| run.planner.take()) else { return };
        let handle = self.handle.clone();
        let closing = tokio::task::spawn_blocking(move || (planner.close(&verdict, &timings), planner));
        tokio::spawn(async move {
            let (result, planner) = match closing.await {
                Ok((result, planner)) => (result, Some(planner)),
                Err(_) => (Err(broken("writing the result")), None),
            };
            let _ = handle.tell(Command::Closed(run, result, planner)).await;
        });
    }
}

fn broken(what: &str) -> EngineFailure {
    EngineFailure {
        reason: format!("{what} stopped on a broken invariant: this is a bug of terrane"),
        bad_input: false,
    }
}
