//! One run: its tasks through their lives, its stages, its news for the next plan.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use terrane_proto::types::{
    Failure, FailureKind, LeaseId, RunId, RunPhase, RunStatus, StageStatus, TaskKey, TaskLease, WorkerId,
};

use super::events::{EngineFailure, News, Planned, Verdict};
use super::item::{Done, GaveUp, Item, PlannedTask, Ready, Running, Until};
use super::timings::Stopwatch;
use super::{Policy, Timestamp};

/// The order in which ready tasks are given out: earlier stages first, longer tasks first, then as planned.
type Rank = (usize, Reverse<u64>, u64);

struct Entry {
    task: PlannedTask,
    rank: Rank,
    item: Item,
    oversize_since: Option<Timestamp>,
}

/// Where a run is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    Working,
    Closing(Verdict),
    Over(RunPhase),
}

/// What became of a worker's word about a task.
pub(super) enum Judgement {
    /// It counts.
    Counts,
    /// It came too late, or twice.
    Ignored,
    /// It ends the run.
    Ends(RunPhase),
}

pub(super) struct Run {
    pub(super) id: RunId,
    pub(super) phase: Phase,
    pub(super) watch: Stopwatch,
    entries: BTreeMap<TaskKey, Entry>,
    ready: BTreeMap<Rank, TaskKey>,
    running: BTreeSet<TaskKey>,
    timed: BTreeSet<(Timestamp, TaskKey)>,
    stages: Vec<StageStatus>,
    sequence: u64,
    plans: u64,
    planning: bool,
    dirty: bool,
    news: News,
}

impl Run {
    pub(super) fn new(id: RunId, at: Timestamp) -> Self {
        Self {
            id,
            phase: Phase::Working,
            watch: Stopwatch::new(at),
            entries: BTreeMap::new(),
            ready: BTreeMap::new(),
            running: BTreeSet::new(),
            timed: BTreeSet::new(),
            stages: Vec::new(),
            sequence: 0,
            plans: 0,
            planning: false,
            dirty: true,
            news: News::default(),
        }
    }

    pub(super) fn is_working(&self) -> bool {
        self.phase == Phase::Working
    }

    /// The number and news of a plan to make now, if one is due: something changed, and workers may run dry.
    pub(super) fn plan_due(&mut self, workers: usize) -> Option<(u64, News)> {
        if !self.is_working() || self.planning || !self.dirty || self.ready.len() > workers {
            return None;
        }
        self.planning = true;
        self.dirty = false;
        self.plans += 1;
        Some((self.plans, std::mem::take(&mut self.news)))
    }

    /// Goes back to planning: the result could not be written from what is there.
    pub(super) fn reopen(&mut self) {
        self.phase = Phase::Working;
        self.dirty = true;
    }

    /// Takes a plan in; the verdict when the run is at its end.
    pub(super) fn planned(&mut self, number: u64, plan: Planned, policy: &Policy) -> Option<Verdict> {
        if !self.is_working() || number != self.plans || !self.planning {
            return None;
        }
        self.planning = false;
        self.take_stages(&plan);
        let listed: BTreeSet<TaskKey> = plan.ready.iter().map(|task| task.key.clone()).collect();
        for task in plan.ready {
            self.take_task(number, task, policy);
        }
        let vanished: Vec<TaskKey> =
            self.ready.values().filter(|key| !listed.contains(*key)).cloned().collect();
        for key in vanished {
            self.remove(&key);
        }
        if plan.verdict.is_none() && !self.planning && !self.dirty && self.is_stuck() {
            return Some(Verdict::FellShort(
                "no task can run and the run is not finished: this is a bug of terrane".into(),
            ));
        }
        plan.verdict
    }

    fn is_stuck(&self) -> bool {
        self.ready.is_empty() && self.running.is_empty() && self.timed.is_empty()
    }

    fn take_stages(&mut self, plan: &Planned) {
        let before = std::mem::take(&mut self.stages);
        for stage in &plan.stages {
            let old = before.iter().find(|old| old.stage == stage.stage).cloned().unwrap_or_default();
            self.stages.push(StageStatus {
                stage: stage.stage.clone(),
                done: stage.done,
                total: stage.total,
                ..old
            });
        }
        // Tasks that were done while the plan was made may be in its figures or not: the next plan knows, until then no
        // stage has more done than it has tasks.
        for key in &self.news.done {
            if let Some(entry) = self.entries.get(key)
                && let Some(stage) = self.stages.iter_mut().find(|stage| stage.stage == entry.task.stage)
            {
                stage.done = stage.total.min(stage.done + 1);
            }
        }
    }

    fn take_task(&mut self, number: u64, task: PlannedTask, policy: &Policy) {
        let Some(entry) = self.entries.remove(&task.key) else {
            let place =
                self.stages.iter().position(|stage| stage.stage == task.stage).unwrap_or(self.stages.len());
            self.sequence += 1;
            let rank = (place, Reverse(task.expected_ms), self.sequence);
            let item = Item::Ready(Ready { strikes: super::item::Strikes::default() });
            self.insert(Entry { task, rank, item, oversize_since: None });
            return;
        };
        self.forget(&entry);
        let item = match entry.item {
            Item::Waiting(waiting) => match waiting.until {
                Until::PlanAfter(plan) if plan < number => Item::Ready(Ready { strikes: waiting.strikes }),
                _ => Item::Waiting(waiting),
            },
            Item::Done(done) if done.known_after_plan < number => done.lose_artefact(policy),
            other => other,
        };
        self.insert(Entry { task, item, ..entry });
    }

    /// Puts an entry into the tables, and into the indices of its state.
    fn insert(&mut self, entry: Entry) {
        let key = entry.task.key.clone();
        match &entry.item {
            Item::Ready(_) => {
                self.ready.insert(entry.rank, key.clone());
            }
            Item::Running(_) => {
                self.running.insert(key.clone());
            }
            Item::Waiting(waiting) => {
                if let Until::Time(time) = waiting.until {
                    self.timed.insert((time, key.clone()));
                }
            }
            Item::Done(_) => {}
            Item::GaveUp(gave_up) => self.note_given_up(&entry.task, gave_up.reason.clone()),
        }
        self.entries.insert(key, entry);
    }

    /// Takes an entry, already out of the table, out of the indices of its state.
    fn forget(&mut self, entry: &Entry) {
        match &entry.item {
            Item::Ready(_) => {
                self.ready.remove(&entry.rank);
            }
            Item::Running(_) => {
                self.running.remove(&entry.task.key);
            }
            Item::Waiting(waiting) => {
                if let Until::Time(time) = waiting.until {
                    self.timed.remove(&(time, entry.task.key.clone()));
                }
            }
            Item::Done(_) | Item::GaveUp(_) => {}
        }
    }

    fn note_given_up(&mut self, task: &PlannedTask, reason: String) {
        let known = self.news.given_up.iter().any(|(key, _)| *key == task.key);
        if !known {
            self.dirty = true;
            self.news.given_up.push((task.key.clone(), reason));
        }
    }

    fn remove(&mut self, key: &TaskKey) {
        if let Some(entry) = self.entries.remove(key) {
            self.forget(&entry);
        }
    }

    /// Replaces the state of a task by what `step` makes of it.
    fn advance(&mut self, key: &TaskKey, step: impl FnOnce(Item) -> Item) {
        if let Some(entry) = self.entries.remove(key) {
            self.forget(&entry);
            let item = step(entry.item);
            self.insert(Entry { item, ..entry });
        }
    }

    /// The best ready task that needs at most `free_bytes`, given out under `lease`.
    pub(super) fn assign(
        &mut self,
        at: Timestamp,
        worker: WorkerId,
        lease: LeaseId,
        free_bytes: u64,
    ) -> Option<TaskLease> {
        let fits =
            |key: &&TaskKey| self.entries.get(*key).is_some_and(|entry| entry.task.peak_bytes <= free_bytes);
        let key = self.ready.values().find(fits)?.clone();
        self.advance(&key, |item| match item {
            Item::Ready(ready) => Item::Running(ready.assign(worker, lease, at)),
            other => other,
        });
        let entry = self.entries.get(&key)?;
        let attempt = entry.item.strikes().attempts;
        self.watch.begin(at, &entry.task.stage, attempt);
        let PlannedTask { stage, item, spec, .. } = entry.task.clone();
        Some(TaskLease { lease, run: self.id, key, stage, item, attempt, spec })
    }

    /// Memory in bytes that a task is expected to need.
    pub(super) fn peak_bytes(&self, key: &TaskKey) -> u64 {
        self.entries.get(key).map_or(0, |entry| entry.task.peak_bytes)
    }

    /// Stage and item of a task, for people.
    pub(super) fn title(&self, key: &TaskKey) -> String {
        self.entries
            .get(key)
            .map_or_else(String::new, |entry| format!("{} {}", entry.task.stage, entry.task.item))
    }

    /// The stage of a task.
    pub(super) fn stage(&self, key: &TaskKey) -> String {
        self.entries.get(key).map_or_else(String::new, |entry| entry.task.stage.clone())
    }

    /// The lease under which a task runs now.
    pub(super) fn lease_of(&self, key: &TaskKey) -> Option<(WorkerId, LeaseId)> {
        match &self.entries.get(key)?.item {
            Item::Running(running) => Some((running.worker, running.lease)),
            _ => None,
        }
    }

    /// A worker says that a task is done; it counts even when its lease is lost, for the artefact is there all the same.
    pub(super) fn complete(&mut self, key: &TaskKey) -> Judgement {
        if !self.is_working() {
            return Judgement::Ignored;
        }
        let open = match self.entries.get(key).map(|entry| &entry.item) {
            Some(Item::Running(_) | Item::Ready(_) | Item::Waiting(_)) => true,
            Some(Item::Done(_) | Item::GaveUp(_)) | None => false,
        };
        if !open {
            return Judgement::Ignored;
        }
        let known_after_plan = self.plans;
        self.advance(key, |item| Item::Done(Done { strikes: item.strikes(), known_after_plan }));
        self.news.done.push(key.clone());
        self.dirty = true;
        let stage = self.stage(key);
        if let Some(stage) = self.stages.iter_mut().find(|row| row.stage == stage) {
            stage.done += 1;
            stage.computed += 1;
        }
        Judgement::Counts
    }

    /// A worker says that the task of its lease can't be done.
    pub(super) fn fail(
        &mut self,
        at: Timestamp,
        key: &TaskKey,
        failure: &Failure,
        policy: &Policy,
    ) -> Judgement {
        if !self.is_working() || self.lease_of(key).is_none() {
            return Judgement::Ignored;
        }
        match failure.kind {
            FailureKind::BadRun => return Judgement::Ends(RunPhase::BadInput(failure.reason.clone())),
            FailureKind::Storage => return Judgement::Ends(RunPhase::Failed(failure.reason.clone())),
            FailureKind::LostInput => {
                self.news.failures.push(failure.detail.clone());
                self.dirty = true;
            }
            FailureKind::Input | FailureKind::Machine => {}
        }
        let plans = self.plans;
        self.advance(key, |item| match item {
            Item::Running(running) => fail_running(running, at, failure, plans, policy),
            other => other,
        });
        Judgement::Counts
    }

    /// The worker that ran a task is lost.
    pub(super) fn lose(&mut self, key: &TaskKey, policy: &Policy) {
        self.advance(key, |item| match item {
            Item::Running(running) => running.lose(policy),
            other => other,
        });
    }

    /// The task never reached its worker.
    pub(super) fn take_back(&mut self, key: &TaskKey) {
        self.advance(key, |item| match item {
            Item::Running(running) => Item::Ready(running.take_back()),
            other => other,
        });
    }

    /// Time passes: tasks whose back-off is over are ready again.
    pub(super) fn wake(&mut self, at: Timestamp) {
        while let Some((time, key)) = self.timed.first().cloned()
            && time <= at
        {
            self.advance(&key, |item| match item {
                Item::Waiting(waiting) => Item::Ready(Ready { strikes: waiting.strikes }),
                other => other,
            });
            self.timed.remove(&(time, key));
        }
    }

    /// Sets tasks aside that no worker has had the memory for in a while; returns their titles with the reason.
    pub(super) fn give_up_oversize(
        &mut self,
        at: Timestamp,
        largest_bytes: u64,
        policy: &Policy,
    ) -> Vec<String> {
        let mut lines = Vec::new();
        for key in self.ready.values().cloned().collect::<Vec<_>>() {
            let Some(entry) = self.entries.get_mut(&key) else { continue };
            if entry.task.peak_bytes <= largest_bytes {
                entry.oversize_since = None;
                continue;
            }
            let since = *entry.oversize_since.get_or_insert(at);
            if at.since(since) < policy.oversize_grace_ms {
                continue;
            }
            let reason = format!(
                "it needs {} MiB and the largest worker offers {} MiB: give --memory or a smaller --cluster-size",
                entry.task.peak_bytes >> 20,
                largest_bytes >> 20
            );
            lines.push(format!("{} {}: {reason}", entry.task.stage, entry.task.item));
            self.advance(&key, |item| Item::GaveUp(GaveUp { reason, attempts: item.strikes().attempts }));
        }
        lines
    }

    /// Whether a task can be given out.
    pub(super) fn has_ready(&self) -> bool {
        !self.ready.is_empty()
    }

    /// Why a task was set aside, if it was.
    pub(super) fn given_up(&self, key: &TaskKey) -> Option<&str> {
        match &self.entries.get(key)?.item {
            Item::GaveUp(gave_up) => Some(&gave_up.reason),
            _ => None,
        }
    }

    /// Why planning failed, as the end of the run.
    pub(super) fn planning_failed(&mut self, number: u64, failure: EngineFailure) -> Option<RunPhase> {
        if !self.is_working() || number != self.plans || !self.planning {
            return None;
        }
        self.planning = false;
        Some(if failure.bad_input {
            RunPhase::BadInput(failure.reason)
        } else {
            RunPhase::Failed(failure.reason)
        })
    }

    /// Where the run is in its life.
    pub(super) fn phase(&self) -> RunPhase {
        match &self.phase {
            Phase::Working => RunPhase::Working,
            Phase::Closing(_) => RunPhase::Closing,
            Phase::Over(phase) => phase.clone(),
        }
    }

    /// How the run stands.
    pub(super) fn status(&self) -> RunStatus {
        let mut stages = self.stages.clone();
        for row in &mut stages {
            row.running = self.running.iter().filter(|key| self.stage(key) == row.stage).count() as u64;
        }
        for entry in self.entries.values() {
            if let Item::GaveUp(_) = entry.item
                && let Some(row) = stages.iter_mut().find(|row| row.stage == entry.task.stage)
            {
                row.given_up += 1;
            }
        }
        RunStatus { run: self.id, phase: self.phase(), stages }
    }

    #[cfg(test)]
    pub(super) fn item(&self, key: &TaskKey) -> Option<&Item> {
        self.entries.get(key).map(|entry| &entry.item)
    }
}

fn fail_running(running: Running, at: Timestamp, failure: &Failure, plans: u64, policy: &Policy) -> Item {
    match failure.kind {
        FailureKind::Input => running.fail_on_input(at, &failure.reason, policy),
        FailureKind::LostInput => running.fail_on_machine(Until::PlanAfter(plans), &failure.reason, policy),
        FailureKind::Machine | FailureKind::BadRun | FailureKind::Storage => {
            let until = Until::Time(at.after(policy.backoff_ms(running.strikes.machine + 1)));
            running.fail_on_machine(until, &failure.reason, policy)
        }
    }
}
