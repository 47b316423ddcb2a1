//! Every order of events ends with every task done once or set aside, and nothing lost.

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;
use terrane_proto::types::*;

use super::*;

mod histories;

const RUN: RunId = RunId(1);

/// A toy world: tasks in layers, each layer ready when the one before is done or set aside; a store of made artefacts.
struct World {
    state: State,
    now: u64,
    layers: Vec<Vec<PlannedTask>>,
    store: BTreeSet<TaskKey>,
    aside: BTreeSet<TaskKey>,
    made: BTreeMap<TaskKey, u32>,
    counted: BTreeMap<TaskKey, u32>,
    plans: Vec<(u64, Planned)>,
    answers: BTreeMap<RequestId, NextTask>,
    over: Option<RunPhase>,
    timings: Option<RunTimings>,
    next_request: u64,
    logs: Vec<String>,
}

fn task(layer: usize, index: usize, peak_bytes: u64) -> PlannedTask {
    let key = TaskKey::parse(&format!("s{layer}/{index}")).unwrap();
    PlannedTask {
        key,
        stage: format!("s{layer}"),
        item: index.to_string(),
        spec: Bytes::new(),
        peak_bytes,
        expected_ms: 1,
    }
}

fn offer(name: &str, slots: u32, memory_bytes: u64) -> Registration {
    Registration { name: name.into(), memory_bytes, threads: 1, slots, process: 1 }
}

fn failure(kind: FailureKind) -> Failure {
    Failure { kind, reason: "because".into(), detail: Bytes::new() }
}

impl World {
    fn new(sizes: &[usize], policy: Policy) -> Self {
        let layers =
            sizes.iter().enumerate().map(|(layer, &n)| (0..n).map(|index| task(layer, index, 10)).collect());
        let mut world = Self {
            state: State::new(policy),
            now: 0,
            layers: layers.collect(),
            store: BTreeSet::new(),
            aside: BTreeSet::new(),
            made: BTreeMap::new(),
            counted: BTreeMap::new(),
            plans: Vec::new(),
            answers: BTreeMap::new(),
            over: None,
            timings: None,
            next_request: 0,
            logs: Vec::new(),
        };
        world.event(Event::Submitted(RUN));
        world
    }

    /// Applies an event; plans are made from the store as it is now and delivered only by [`World::deliver_plans`].
    fn event(&mut self, event: Event) -> Option<bool> {
        let mut judged = None;
        for effect in self.state.apply(Timestamp(self.now), event) {
            match effect {
                Effect::Plan(run, number, news) => {
                    assert_eq!(run, RUN);
                    self.aside.extend(news.given_up.into_iter().map(|(key, _)| key));
                    let plan = self.plan();
                    self.plans.push((number, plan));
                }
                Effect::Answer(request, answer) => {
                    assert!(self.answers.insert(request, answer).is_none(), "a request was answered twice");
                }
                Effect::Judged(accepted) => judged = Some(accepted),
                Effect::Close(run, verdict, timings) => {
                    assert_eq!((run, verdict), (RUN, Verdict::Finished));
                    self.timings = Some(timings);
                }
                Effect::Over(_, phase) => assert!(self.over.replace(phase).is_none(), "a run ended twice"),
                Effect::Log(line) => self.logs.push(line),
                Effect::Heard { .. } => {}
            }
        }
        if self.timings.is_some() && self.over.is_none() {
            self.event(Event::Closed(RUN, Ok(Closing::Written)));
        }
        judged
    }

    fn plan(&self) -> Planned {
        let over = |task: &PlannedTask| self.store.contains(&task.key) || self.aside.contains(&task.key);
        let open = self.layers.iter().find(|layer| !layer.iter().all(over));
        let ready =
            open.map(|layer| layer.iter().filter(|task| !over(task)).cloned().collect()).unwrap_or_default();
        let stage = |(index, layer): (usize, &Vec<PlannedTask>)| PlannedStage {
            stage: format!("s{index}"),
            done: layer.iter().filter(|task| over(task)).count() as u64,
            total: layer.len() as u64,
        };
        let verdict = open.is_none().then_some(Verdict::Finished);
        Planned { ready, stages: self.layers.iter().enumerate().map(stage).collect(), verdict }
    }

    fn deliver_plans(&mut self) {
        for (number, plan) in std::mem::take(&mut self.plans) {
            self.event(Event::Planned(RUN, number, Ok(plan)));
        }
    }

    fn ask(&mut self, worker: u64, held: Vec<LeaseId>) -> RequestId {
        self.next_request += 1;
        let request = RequestId(self.next_request);
        self.event(Event::Asked(WorkerId(worker), request, held));
        request
    }

    fn finish(&mut self, worker: u64, lease: &TaskLease) -> bool {
        *self.made.entry(lease.key.clone()).or_default() += 1;
        self.store.insert(lease.key.clone());
        let counted =
            self.event(Event::Completed(WorkerId(worker), lease.lease, TaskCost::default())).unwrap();
        *self.counted.entry(lease.key.clone()).or_default() += u32::from(counted);
        counted
    }

    fn take(&mut self, request: RequestId) -> Option<TaskLease> {
        match self.answers.remove(&request) {
            Some(NextTask::Lease(lease)) => Some(lease),
            _ => None,
        }
    }

    /// A faultless worker works until the run is over.
    fn work_off(&mut self, worker: u64) {
        self.event(Event::Registered(WorkerId(worker), offer(&format!("w{worker}"), 1, 100)));
        for _ in 0..10_000 {
            self.deliver_plans();
            if self.over.is_some() {
                return;
            }
            self.now += 1_000;
            self.event(Event::Tick);
            let request = self.ask(worker, vec![]);
            if let Some(lease) = self.take(request) {
                self.finish(worker, &lease);
            }
        }
        panic!("the run did not end: {:?}", self.state.status(Timestamp(self.now)));
    }
}

#[test]
fn a_run_without_faults_does_every_task_once() {
    let mut world = World::new(&[3, 5, 1], Policy::default());
    world.work_off(1);
    assert_eq!(world.over, Some(RunPhase::Done));
    assert_eq!(world.made.values().copied().collect::<Vec<_>>(), vec![1; 9]);
    let timings = world.timings.unwrap();
    assert_eq!(timings.stages["s1"].tasks, 5);
    assert_eq!(timings.stages["s1"].retries, 0);
    assert!(timings.stages["s1"].wall_ms >= 4_000, "{timings:?}");
}

#[test]
fn a_store_that_has_everything_ends_the_run_at_once() {
    let mut world = World::new(&[2, 2], Policy::default());
    world.plans.clear();
    for layer in world.layers.clone() {
        world.store.extend(layer.into_iter().map(|task| task.key));
    }
    let plan = world.plan();
    world.event(Event::Planned(RUN, 1, Ok(plan)));
    assert_eq!(world.over, Some(RunPhase::Done));
    assert!(world.made.is_empty());
}

#[test]
fn a_lost_workers_task_is_given_to_another() {
    let mut world = World::new(&[1], Policy::default());
    world.deliver_plans();
    world.event(Event::Registered(WorkerId(1), offer("a", 1, 100)));
    let request = world.ask(1, vec![]);
    let lease = world.take(request).unwrap();
    assert_eq!(lease.attempt, 1);
    world.event(Event::Exited(WorkerId(1)));
    world.event(Event::Registered(WorkerId(2), offer("b", 1, 100)));
    let request = world.ask(2, vec![]);
    let again = world.take(request).unwrap();
    assert_eq!((again.attempt, &again.key), (2, &lease.key));
    // The first one lives after all: its word counts once, the second's doesn't.
    assert!(world.finish(1, &lease));
    assert!(!world.finish(2, &again));
    world.deliver_plans();
    assert_eq!(world.over, Some(RunPhase::Done));
}

#[test]
fn silence_is_loss_and_heartbeats_prevent_it() {
    let mut world = World::new(&[1], Policy::default());
    world.deliver_plans();
    world.event(Event::Registered(WorkerId(1), offer("a", 1, 100)));
    let request = world.ask(1, vec![]);
    let lease = world.take(request).unwrap();
    for _ in 0..10 {
        world.now += 15_000;
        world.event(Event::Heartbeat(WorkerId(1), vec![lease.lease], 5));
        world.event(Event::Tick);
        assert_eq!(world.state.status(Timestamp(world.now)).workers[0].tasks, ["s0 0"]);
    }
    world.now += 20_001;
    world.event(Event::Tick);
    assert!(world.state.status(Timestamp(world.now)).workers.is_empty());
    let effects =
        world.state.apply(Timestamp(world.now), Event::Heartbeat(WorkerId(1), vec![lease.lease], 5));
    assert_eq!(effects, vec![Effect::Heard { known: false, revoked: vec![] }]);
}

#[test]
fn a_lease_that_never_arrived_is_given_again_without_a_strike() {
    let mut world = World::new(&[1], Policy::default());
    world.deliver_plans();
    world.event(Event::Registered(WorkerId(1), offer("a", 1, 100)));
    for _ in 0..20 {
        let request = world.ask(1, vec![]);
        assert_eq!(world.take(request).unwrap().attempt, 1);
    }
}

#[test]
fn input_failures_set_a_task_aside_and_the_run_goes_on() {
    let policy = Policy::default();
    let mut world = World::new(&[2, 1], policy.clone());
    world.event(Event::Registered(WorkerId(1), offer("a", 1, 100)));
    let mut failures = 0;
    for _ in 0..100 {
        world.deliver_plans();
        world.now += 1_000;
        world.event(Event::Tick);
        let request = world.ask(1, vec![]);
        let Some(lease) = world.take(request) else { continue };
        if lease.key.as_str() == "s0/1" {
            failures += 1;
            let failed =
                Event::Failed(WorkerId(1), lease.lease, failure(FailureKind::Input), TaskCost::default());
            assert_eq!(world.event(failed.clone()), Some(true));
            assert_eq!(world.event(failed), Some(false), "a repeated answer counts no more");
        } else {
            world.finish(1, &lease);
        }
    }
    assert_eq!(failures, policy.max_input_failures);
    assert_eq!(world.over, Some(RunPhase::Done));
    let item = world.state.runs[&RUN].item(&TaskKey::parse("s0/1").unwrap());
    assert_eq!(item, Some(&Item::GaveUp(GaveUp { reason: "because".into(), attempts: 2 })));
    assert!(
        world.logs.iter().any(|line| line.contains("s0 1 failed, it is set aside: because")),
        "{:?}",
        world.logs
    );
}

#[test]
fn a_task_that_kills_its_workers_is_set_aside() {
    let policy = Policy::default();
    let mut world = World::new(&[1], policy.clone());
    for worker in 1..=u64::from(policy.max_losses) {
        world.deliver_plans();
        world.event(Event::Registered(WorkerId(worker), offer("same", 1, 100)));
        let request = world.ask(worker, vec![]);
        assert!(world.take(request).is_some());
        world.event(Event::Exited(WorkerId(worker)));
    }
    world.deliver_plans();
    assert_eq!(world.over, Some(RunPhase::Done));
}

#[test]
fn failures_that_end_the_run_end_it() {
    let ends = [
        (FailureKind::BadRun, RunPhase::BadInput("because".into())),
        (FailureKind::Storage, RunPhase::Failed("because".into())),
    ];
    for (kind, phase) in ends {
        let mut world = World::new(&[2], Policy::default());
        world.deliver_plans();
        world.event(Event::Registered(WorkerId(1), offer("a", 2, 100)));
        let first = world.ask(1, vec![]);
        let lease = world.take(first).unwrap();
        world.event(Event::Failed(WorkerId(1), lease.lease, failure(kind), TaskCost::default()));
        assert_eq!(world.over, Some(phase));
        let none = world.ask(1, vec![]);
        assert!(world.take(none).is_none());
    }
}

#[test]
fn an_artefact_that_vanished_is_made_again() {
    let mut world = World::new(&[1, 1], Policy::default());
    world.deliver_plans();
    world.event(Event::Registered(WorkerId(1), offer("a", 1, 100)));
    let request = world.ask(1, vec![]);
    let lease = world.take(request).unwrap();
    // Said to be done, but not in the store when the next plan looks.
    world.event(Event::Completed(WorkerId(1), lease.lease, TaskCost::default()));
    world.deliver_plans();
    let request = world.ask(1, vec![]);
    let again = world.take(request).unwrap();
    assert_eq!((again.key.as_str(), again.attempt), ("s0/0", 2));
    world.finish(1, &again);
    world.work_off(1);
    assert_eq!(world.over, Some(RunPhase::Done));
}

#[test]
fn a_result_that_can_not_be_written_yet_is_planned_again() {
    let mut state = State::new(Policy::default());
    state.apply(Timestamp(0), Event::Submitted(RUN));
    let finished = || Planned { ready: vec![], stages: vec![], verdict: Some(Verdict::Finished) };
    state.apply(Timestamp(0), Event::Planned(RUN, 1, Ok(finished())));
    let effects = state.apply(Timestamp(0), Event::Closed(RUN, Ok(Closing::PlanAgain)));
    assert!(matches!(effects[..], [Effect::Plan(RUN, 2, _)]), "{effects:?}");
    let again = Planned { ready: vec![task(0, 0, 1)], verdict: None, ..finished() };
    state.apply(Timestamp(0), Event::Planned(RUN, 2, Ok(again)));
    assert_eq!(state.phase(RUN), Some(RunPhase::Working));
}

#[test]
fn a_lost_input_waits_for_a_plan_that_makes_it_again() {
    let mut world = World::new(&[1, 1], Policy::default());
    world.event(Event::Registered(WorkerId(1), offer("a", 1, 100)));
    world.deliver_plans();
    let request = world.ask(1, vec![]);
    let input = world.take(request).unwrap();
    world.finish(1, &input);
    world.deliver_plans();
    let request = world.ask(1, vec![]);
    let user = world.take(request).unwrap();
    world.store.remove(&input.key);
    world.event(Event::Failed(WorkerId(1), user.lease, failure(FailureKind::LostInput), TaskCost::default()));
    world.deliver_plans();
    let request = world.ask(1, vec![]);
    assert_eq!(world.take(request).unwrap().key, input.key);
    world.work_off(2);
    assert_eq!((world.over.clone(), world.made[&input.key]), (Some(RunPhase::Done), 2));
}

#[test]
fn memory_and_slots_are_kept_to() {
    let mut world = World::new(&[0], Policy::default());
    world.plans.clear();
    let ready = vec![task(0, 0, 60), task(0, 1, 60), task(0, 2, 30)];
    world.layers = vec![ready.clone()];
    let plan = world.plan();
    world.event(Event::Planned(RUN, 1, Ok(plan)));
    world.event(Event::Registered(WorkerId(1), offer("a", 3, 100)));
    let mut held = Vec::new();
    for expected in [Some("s0/0"), Some("s0/2"), None] {
        let request = world.ask(1, held.clone());
        let lease = world.take(request);
        assert_eq!(lease.as_ref().map(|lease| lease.key.as_str()), expected);
        held.extend(lease.map(|lease| lease.lease));
    }
}

#[test]
fn a_task_that_no_worker_can_hold_is_set_aside_with_the_remedy() {
    let mut world = World::new(&[1], Policy::default());
    world.plans.clear();
    world.layers = vec![vec![task(0, 0, 500 << 20)]];
    let plan = world.plan();
    world.event(Event::Planned(RUN, 1, Ok(plan)));
    world.event(Event::Registered(WorkerId(1), offer("a", 1, 100 << 20)));
    for _ in 0..30 {
        world.now += 1_000;
        world.event(Event::Heartbeat(WorkerId(1), vec![], 0));
        world.event(Event::Tick);
        world.deliver_plans();
    }
    assert_eq!(world.over, Some(RunPhase::Done));
    assert!(
        world.logs.iter().any(|line| line.contains("500 MiB") && line.contains("--memory")),
        "{:?}",
        world.logs
    );
}

#[test]
fn cancelled_and_drained_coordinators_give_nothing_out() {
    let mut world = World::new(&[3], Policy::default());
    world.deliver_plans();
    world.event(Event::Registered(WorkerId(1), offer("a", 1, 100)));
    let request = world.ask(1, vec![]);
    let lease = world.take(request).unwrap();
    world.event(Event::Cancelled(RUN));
    assert_eq!(world.over, Some(RunPhase::Cancelled));
    let effects = world.state.apply(Timestamp(1), Event::Heartbeat(WorkerId(1), vec![lease.lease], 0));
    assert_eq!(effects, vec![Effect::Heard { known: true, revoked: vec![lease.lease] }]);
    let waiting = world.ask(1, vec![]);
    world.event(Event::Drain);
    assert_eq!(world.answers.remove(&waiting), Some(NextTask::Leave));
}

#[test]
fn a_plan_that_goes_nowhere_ends_the_run_with_a_reason() {
    let mut state = State::new(Policy::default());
    state.apply(Timestamp(0), Event::Submitted(RUN));
    let plan = Planned { ready: vec![], stages: vec![], verdict: None };
    let effects = state.apply(Timestamp(0), Event::Planned(RUN, 1, Ok(plan)));
    assert!(matches!(&effects[..], [Effect::Close(_, Verdict::FellShort(_), _)]), "{effects:?}");
}
