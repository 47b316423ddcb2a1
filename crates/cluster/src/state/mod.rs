//! The coordinator's state: a pure function of what happened so far.
//!
//! [`State::apply`] takes the time of receipt and an [`Event`] and returns what should be done, as data. It owns no clock, no
//! channel and no store, so that every order of events can be tried in tests. Properties that tests hold it to:
//! every task of every plan ends done or set aside; no task counts twice; a lost worker loses no task; late, duplicate and
//! unknown answers change nothing; nothing is given to a worker beyond its slots or its memory.

mod events;
mod item;
mod run;
#[cfg(test)]
mod tests;
mod timings;

use std::collections::BTreeMap;

use terrane_proto::types::{
    Failure, LeaseId, NextTask, Registration, RunId, RunPhase, Status, TaskCost, TaskKey, WorkerId,
    WorkerStatus,
};

pub use events::{
    Closing, Effect, EngineFailure, Event, News, Planned, PlannedStage, Policy, RequestId, Timestamp, Verdict,
};
pub use item::{Done, GaveUp, Item, PlannedTask, Ready, Running, Strikes, Until, Waiting};
pub use timings::{RunTimings, StageTiming};

use run::{Judgement, Phase, Run};

struct Worker {
    offer: Registration,
    heard: Timestamp,
    resident_bytes: u64,
    leases: Vec<LeaseId>,
    request: Option<(RequestId, Timestamp)>,
}

/// Everything that the coordinator knows.
pub struct State {
    policy: Policy,
    runs: BTreeMap<RunId, Run>,
    workers: BTreeMap<WorkerId, Worker>,
    leases: BTreeMap<LeaseId, (RunId, TaskKey)>,
    /// Leases of lost workers: one that lives after all may still say that its task is done.
    stale: BTreeMap<LeaseId, (RunId, TaskKey)>,
    last_lease: u64,
    draining: bool,
}

impl State {
    /// Knows of no run and no worker.
    pub fn new(policy: Policy) -> Self {
        let (runs, workers) = (BTreeMap::new(), BTreeMap::new());
        Self {
            policy,
            runs,
            workers,
            leases: BTreeMap::new(),
            stale: BTreeMap::new(),
            last_lease: 0,
            draining: false,
        }
    }

    /// Takes an event in and says what to do. `at` is the coordinator's time of receipt and never runs backwards.
    pub fn apply(&mut self, at: Timestamp, event: Event) -> Vec<Effect> {
        let mut effects = Vec::new();
        self.take(at, event, &mut effects);
        self.settle(at, &mut effects);
        effects
    }

    fn take(&mut self, at: Timestamp, event: Event, effects: &mut Vec<Effect>) {
        match event {
            Event::Submitted(run) => {
                self.runs.entry(run).or_insert_with(|| Run::new(run, at));
            }
            Event::Planned(run, number, outcome) => self.planned(run, number, outcome, effects),
            Event::Registered(worker, offer) => self.registered(at, worker, offer, effects),
            Event::Asked(worker, request, held) => self.asked(at, worker, request, &held, effects),
            Event::Heartbeat(worker, held, resident_bytes) => {
                self.heartbeat(at, worker, &held, resident_bytes, effects)
            }
            Event::Completed(worker, lease, cost) => self.completed(at, worker, lease, cost, effects),
            Event::Failed(worker, lease, failure, cost) => {
                self.failed(at, (worker, lease), &failure, cost, effects)
            }
            Event::Exited(worker) => self.lose_worker(worker, "its process ended", effects),
            Event::Cancelled(run) => {
                if self.runs.get(&run).is_some_and(|run| run.is_working()) {
                    self.end(run, RunPhase::Cancelled, effects);
                }
            }
            Event::Closed(run, result) => self.closed(run, result, effects),
            Event::Drain => self.draining = true,
            Event::Tick => self.tick(at, effects),
        }
    }

    /// After every event: give out what can be given out, and plan what is due.
    fn settle(&mut self, at: Timestamp, effects: &mut Vec<Effect>) {
        let waiting: Vec<WorkerId> =
            self.workers.iter().filter(|(_, worker)| worker.request.is_some()).map(|(id, _)| *id).collect();
        for worker in waiting {
            self.serve(at, worker, effects);
        }
        if !self.draining {
            let workers = self.workers.len();
            for run in self.runs.values_mut() {
                if let Some((number, news)) = run.plan_due(workers) {
                    effects.push(Effect::Plan(run.id, number, news));
                }
            }
        }
    }

    fn serve(&mut self, at: Timestamp, id: WorkerId, effects: &mut Vec<Effect>) {
        let Some(worker) = self.workers.get(&id) else { return };
        let Some((request, _)) = worker.request else { return };
        if self.draining {
            effects.push(Effect::Answer(request, NextTask::Leave));
            self.workers.remove(&id);
            return;
        }
        if worker.leases.len() >= worker.offer.slots as usize {
            return;
        }
        let used: u64 = worker.leases.iter().map(|lease| self.lease_bytes(*lease)).sum();
        let free = worker.offer.memory_bytes.saturating_sub(used);
        let lease = LeaseId(self.last_lease + 1);
        let given = self
            .runs
            .values_mut()
            .filter(|run| run.is_working())
            .find_map(|run| run.assign(at, id, lease, free));
        if let Some(task) = given {
            self.last_lease = lease.0;
            self.leases.insert(lease, (task.run, task.key.clone()));
            if let Some(worker) = self.workers.get_mut(&id) {
                worker.leases.push(lease);
                worker.request = None;
            }
            effects.push(Effect::Answer(request, NextTask::Lease(task)));
        }
    }

    fn lease_bytes(&self, lease: LeaseId) -> u64 {
        let Some((run, key)) = self.leases.get(&lease) else { return 0 };
        self.runs.get(run).map_or(0, |run| run.peak_bytes(key))
    }

    fn planned(
        &mut self,
        id: RunId,
        number: u64,
        outcome: Result<Planned, EngineFailure>,
        effects: &mut Vec<Effect>,
    ) {
        let Some(run) = self.runs.get_mut(&id) else { return };
        match outcome {
            Ok(plan) => {
                if let Some(verdict) = run.planned(number, plan, &self.policy) {
                    run.phase = Phase::Closing(verdict.clone());
                    effects.push(Effect::Close(id, verdict, run.watch.timings()));
                    self.release_run(id);
                }
            }
            Err(failure) => {
                if let Some(phase) = run.planning_failed(number, failure) {
                    self.end(id, phase, effects);
                }
            }
        }
    }

    fn closed(&mut self, id: RunId, result: Result<Closing, EngineFailure>, effects: &mut Vec<Effect>) {
        let Some(run) = self.runs.get_mut(&id) else { return };
        let Phase::Closing(verdict) = run.phase.clone() else { return };
        let phase = match (result, verdict) {
            (Ok(Closing::PlanAgain), _) => return run.reopen(),
            (Ok(Closing::Written), Verdict::Finished) => RunPhase::Done,
            (Ok(Closing::Written), Verdict::FellShort(reason)) => RunPhase::FellShort(reason),
            (Err(failure), _) if failure.bad_input => RunPhase::BadInput(failure.reason),
            (Err(failure), _) => RunPhase::Failed(failure.reason),
        };
        self.end(id, phase, effects);
    }

    fn end(&mut self, id: RunId, phase: RunPhase, effects: &mut Vec<Effect>) {
        if let Some(run) = self.runs.get_mut(&id) {
            run.phase = Phase::Over(phase.clone());
            effects.push(Effect::Over(id, phase));
        }
        self.release_run(id);
    }

    /// Drops the leases of a run: their workers learn of it with the next heartbeat.
    fn release_run(&mut self, id: RunId) {
        let gone: Vec<LeaseId> =
            self.leases.iter().filter(|(_, (run, _))| *run == id).map(|(lease, _)| *lease).collect();
        for lease in gone {
            self.release(lease);
        }
        self.stale.retain(|_, (run, _)| *run != id);
    }

    fn release(&mut self, lease: LeaseId) {
        self.leases.remove(&lease);
        for worker in self.workers.values_mut() {
            worker.leases.retain(|held| *held != lease);
        }
    }

    fn registered(&mut self, at: Timestamp, id: WorkerId, offer: Registration, effects: &mut Vec<Effect>) {
        let same_name: Vec<WorkerId> = self
            .workers
            .iter()
            .filter(|(_, worker)| worker.offer.name == offer.name)
            .map(|(id, _)| *id)
            .collect();
        for old in same_name {
            self.lose_worker(old, "another process took its name", effects);
        }
        effects.push(Effect::Log(format!(
            "worker {} joined with {} MiB and {} threads",
            offer.name,
            offer.memory_bytes >> 20,
            offer.threads
        )));
        self.workers
            .insert(id, Worker { offer, heard: at, resident_bytes: 0, leases: Vec::new(), request: None });
    }

    fn asked(
        &mut self,
        at: Timestamp,
        id: WorkerId,
        request: RequestId,
        held: &[LeaseId],
        effects: &mut Vec<Effect>,
    ) {
        let Some(worker) = self.workers.get_mut(&id) else {
            effects.push(Effect::Answer(request, NextTask::Unknown));
            return;
        };
        worker.heard = at;
        if let Some((older, _)) = worker.request.replace((request, at)) {
            effects.push(Effect::Answer(older, NextTask::Nothing));
        }
        // What it was given but doesn't hold got lost on the way to it.
        let lost: Vec<LeaseId> =
            worker.leases.iter().filter(|lease| !held.contains(lease)).copied().collect();
        for lease in lost {
            if let Some((run, key)) = self.leases.get(&lease).cloned()
                && let Some(run) = self.runs.get_mut(&run)
                && run.lease_of(&key) == Some((id, lease))
            {
                run.take_back(&key);
            }
            self.release(lease);
        }
    }

    fn heartbeat(
        &mut self,
        at: Timestamp,
        id: WorkerId,
        held: &[LeaseId],
        resident_bytes: u64,
        effects: &mut Vec<Effect>,
    ) {
        let Some(worker) = self.workers.get_mut(&id) else {
            effects.push(Effect::Heard { known: false, revoked: Vec::new() });
            return;
        };
        worker.heard = at;
        worker.resident_bytes = resident_bytes;
        let revoked = held.iter().filter(|lease| !worker.leases.contains(lease)).copied().collect();
        effects.push(Effect::Heard { known: true, revoked });
    }

    fn completed(
        &mut self,
        at: Timestamp,
        id: WorkerId,
        lease: LeaseId,
        cost: TaskCost,
        effects: &mut Vec<Effect>,
    ) {
        let task = self.leases.get(&lease).cloned().or_else(|| self.stale.remove(&lease));
        let judged = task.is_some_and(|(run_id, key)| {
            let name = self.heard_from(at, id);
            let Some(run) = self.runs.get_mut(&run_id) else { return false };
            let other = run.lease_of(&key).map(|(_, lease)| lease);
            let counts = matches!(run.complete(&key), Judgement::Counts);
            if counts {
                run.watch.end(at, &run.stage(&key), &name, cost, true);
            }
            self.release(lease);
            if let Some(other) = other {
                self.release(other);
            }
            counts
        });
        effects.push(Effect::Judged(judged));
    }

    fn failed(
        &mut self,
        at: Timestamp,
        by: (WorkerId, LeaseId),
        failure: &Failure,
        cost: TaskCost,
        effects: &mut Vec<Effect>,
    ) {
        let (id, lease) = by;
        let Some((run_id, key)) = self.leases.get(&lease).cloned() else {
            effects.push(Effect::Judged(false));
            return;
        };
        let name = self.heard_from(at, id);
        let Some(run) = self.runs.get_mut(&run_id) else {
            effects.push(Effect::Judged(false));
            return;
        };
        let judgement = if run.lease_of(&key) == Some(by) {
            run.fail(at, &key, failure, &self.policy)
        } else {
            Judgement::Ignored
        };
        run.watch.end(at, &run.stage(&key), &name, cost, false);
        let title = run.title(&key);
        let next = if run.given_up(&key).is_some() { "it is set aside" } else { "it will be tried again" };
        self.release(lease);
        match judgement {
            Judgement::Ignored => effects.push(Effect::Judged(false)),
            Judgement::Counts => {
                effects.push(Effect::Judged(true));
                effects.push(Effect::Log(format!("{title} failed, {next}: {}", failure.reason)));
            }
            Judgement::Ends(phase) => {
                effects.push(Effect::Judged(true));
                self.end(run_id, phase, effects);
            }
        }
    }

    /// Notes a sign of life; the worker's name.
    fn heard_from(&mut self, at: Timestamp, id: WorkerId) -> String {
        match self.workers.get_mut(&id) {
            Some(worker) => {
                worker.heard = at;
                worker.offer.name.clone()
            }
            None => format!("worker {id}"),
        }
    }

    fn lose_worker(&mut self, id: WorkerId, why: &str, effects: &mut Vec<Effect>) {
        let Some(worker) = self.workers.remove(&id) else { return };
        if let Some((request, _)) = worker.request {
            effects.push(Effect::Answer(request, NextTask::Unknown));
        }
        if self.draining {
            return;
        }
        let mut titles = Vec::new();
        for lease in worker.leases {
            let Some((run_id, key)) = self.leases.remove(&lease) else { continue };
            self.stale.insert(lease, (run_id, key.clone()));
            let Some(run) = self.runs.get_mut(&run_id) else { continue };
            if run.lease_of(&key) == Some((id, lease)) {
                run.watch.lose_worker();
                titles.push(run.title(&key));
                run.lose(&key, &self.policy);
            }
        }
        let tasks = if titles.is_empty() {
            String::new()
        } else {
            format!("; {} is given out again", titles.join(", "))
        };
        effects.push(Effect::Log(format!("worker {} is lost: {why}{tasks}", worker.offer.name)));
    }

    fn tick(&mut self, at: Timestamp, effects: &mut Vec<Effect>) {
        let silent: Vec<WorkerId> = self
            .workers
            .iter()
            .filter(|(_, worker)| at.since(worker.heard) > self.policy.silence_ms && worker.request.is_none())
            .map(|(id, _)| *id)
            .collect();
        for worker in silent {
            self.lose_worker(worker, "it was not heard for too long", effects);
        }
        for worker in self.workers.values_mut() {
            if let Some((request, since)) = worker.request
                && at.since(since) >= self.policy.wait_ms
            {
                worker.request = None;
                worker.heard = at;
                effects.push(Effect::Answer(request, NextTask::Nothing));
            }
        }
        let largest = self.workers.values().map(|worker| worker.offer.memory_bytes).max();
        for run in self.runs.values_mut().filter(|run| run.is_working()) {
            run.wake(at);
            if let Some(largest) = largest.filter(|_| run.has_ready()) {
                let lines = run.give_up_oversize(at, largest, &self.policy);
                effects.extend(lines.into_iter().map(|line| Effect::Log(format!("set aside: {line}"))));
            }
        }
    }

    /// How many workers are known.
    pub fn num_workers(&self) -> usize {
        self.workers.len()
    }

    /// Whether a run is over, and how; `None` when it is not known.
    pub fn phase(&self, run: RunId) -> Option<RunPhase> {
        self.runs.get(&run).map(Run::phase)
    }

    /// How everything stands.
    pub fn status(&self, at: Timestamp) -> Status {
        let tasks = |worker: &Worker| {
            let title = |lease: &LeaseId| {
                self.leases.get(lease).and_then(|(run, key)| Some(self.runs.get(run)?.title(key)))
            };
            worker.leases.iter().filter_map(title).collect()
        };
        let workers = self.workers.iter().map(|(id, worker)| WorkerStatus {
            worker: *id,
            name: worker.offer.name.clone(),
            memory_bytes: worker.offer.memory_bytes,
            resident_bytes: worker.resident_bytes,
            silent_ms: at.since(worker.heard),
            tasks: tasks(worker),
        });
        Status { runs: self.runs.values().map(Run::status).collect(), workers: workers.collect() }
    }
}
