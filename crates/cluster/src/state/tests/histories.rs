//! Random histories of events: no order of them loses a task or counts one twice.

use proptest::prelude::*;

use super::*;

#[derive(Clone, Copy, Debug)]
enum Step {
    Join(u64),
    Ask(u64),
    Complete(usize),
    CompleteAgain(usize),
    Fail(usize, bool),
    Exit(u64),
    Beat(u64),
    Lapse(u64),
    Plan,
    LoseArtefact(usize),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        (1u64..5).prop_map(Step::Join),
        (1u64..5).prop_map(Step::Ask),
        (1u64..5).prop_map(Step::Ask),
        (0usize..8).prop_map(Step::Complete),
        (0usize..8).prop_map(Step::Complete),
        (0usize..8).prop_map(Step::CompleteAgain),
        (0usize..8, any::<bool>()).prop_map(|(lease, input)| Step::Fail(lease, input)),
        (1u64..5).prop_map(Step::Exit),
        (1u64..5).prop_map(Step::Beat),
        (0u64..30_000).prop_map(Step::Lapse),
        Just(Step::Plan),
        Just(Step::Plan),
        (0usize..8).prop_map(Step::LoseArtefact),
    ]
}

/// A random history, then a faultless worker: the run must end, with every task done or set aside.
fn check_history(sizes: &[usize], steps: &[Step]) -> Result<(), TestCaseError> {
    let mut world = World::new(sizes, Policy::default());
    // Leases that workers hold, each with its worker; those that were answered stay to be answered again.
    let mut leases: Vec<(u64, TaskLease, bool)> = Vec::new();
    let mut lost = 0;
    for &step in steps {
        match step {
            Step::Join(worker) => {
                world.event(Event::Registered(WorkerId(worker), offer(&format!("w{worker}"), 2, 15)));
            }
            Step::Ask(worker) => {
                let held = leases
                    .iter()
                    .filter(|(by, _, open)| *by == worker && *open)
                    .map(|(_, lease, _)| lease.lease);
                let request = world.ask(worker, held.collect());
                if let Some(lease) = world.take(request) {
                    leases.push((worker, lease, true));
                }
            }
            Step::Complete(index) | Step::CompleteAgain(index) if index < leases.len() => {
                let (worker, lease, open) = leases[index].clone();
                if open || matches!(step, Step::CompleteAgain(_)) {
                    world.finish(worker, &lease);
                    leases[index].2 = false;
                }
            }
            Step::Fail(index, input) if index < leases.len() => {
                let (worker, lease, _) = leases[index].clone();
                let kind = if input { FailureKind::Input } else { FailureKind::Machine };
                world.event(Event::Failed(WorkerId(worker), lease.lease, failure(kind), TaskCost::default()));
                leases[index].2 = false;
            }
            Step::Exit(worker) => {
                world.event(Event::Exited(WorkerId(worker)));
            }
            Step::Beat(worker) => {
                world.event(Event::Heartbeat(WorkerId(worker), vec![], 1));
            }
            Step::Lapse(ms) => {
                world.now += ms;
                world.event(Event::Tick);
            }
            Step::Plan => world.deliver_plans(),
            Step::LoseArtefact(index) => {
                // Only what no finished layer stands on, as a store that lost a write would.
                if let Some(key) = world.store.iter().nth(index).cloned().filter(|_| world.over.is_none()) {
                    world.store.remove(&key);
                    lost += 1;
                }
            }
            _ => {}
        }
        for worker in world.state.status(Timestamp(world.now)).workers {
            prop_assert!(worker.tasks.len() <= 1, "memory of 15 holds one task of 10");
        }
    }
    world.now += 100_000;
    world.event(Event::Tick);
    world.work_off(99);
    prop_assert_eq!(world.over.clone(), Some(RunPhase::Done));
    for layer in &world.layers {
        for task in layer {
            let done = world.made.contains_key(&task.key) || world.aside.contains(&task.key);
            prop_assert!(done, "{} is lost", task.key);
            if lost == 0 {
                let counted = world.counted.get(&task.key).copied().unwrap_or(0);
                prop_assert!(counted <= 1, "{} counted {counted} times", task.key);
            }
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn no_order_of_events_loses_a_task(sizes in prop::collection::vec(1usize..5, 1..4), steps in prop::collection::vec(step(), 0..120)) {
        check_history(&sizes, &steps)?;
    }
}
