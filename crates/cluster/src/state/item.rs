//! The life of a task at the coordinator.
//!
//! ```text
//!            planned                assigned
//! (unknown) ---------> Ready ---------------------> Running ----> Done
//!                       ^  ^   late answer            |            | its artefact is gone
//!                       |  |   ----------> Done       |            |
//!              time or  |  +--------------------------|------------+
//!              plan     |      worker lost            | failed
//!                      Waiting <----------------------+
//!                                                     |  too often
//!                                                     +-----------> GaveUp
//! ```

use bytes::Bytes;
use terrane_proto::types::{LeaseId, WorkerId};

use super::{Policy, Timestamp};

/// A task as it was planned.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlannedTask {
    /// Key of the artefact that it makes.
    pub key: terrane_proto::types::TaskKey,
    /// Its stage.
    pub stage: String,
    /// What it works on, for people.
    pub item: String,
    /// The engine's own encoding of it.
    pub spec: Bytes,
    /// Memory in bytes that it is expected to need at most.
    pub peak_bytes: u64,
    /// Milliseconds that it is expected to take; longer ones of a stage are given out first.
    pub expected_ms: u64,
}

/// Where a task is in its life, with what is known there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Item {
    /// Failed, and to be tried again later.
    Waiting(Waiting),
    /// Can be given out.
    Ready(Ready),
    /// Given out.
    Running(Running),
    /// A worker says that the artefact is in the store.
    Done(Done),
    /// Set aside.
    GaveUp(GaveUp),
}

/// How often a task was given out and what went wrong.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Strikes {
    /// Times given out.
    pub attempts: u32,
    /// Failures of its input.
    pub input: u32,
    /// Failures of machine or store, lost inputs and lost results.
    pub machine: u32,
    /// Workers that were lost while they ran it.
    pub lost: u32,
}

/// Waits for something before it can be tried again.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// What went wrong so far.
    pub strikes: Strikes,
    /// What it waits for.
    pub until: Until,
}

/// What a failed task waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Until {
    /// A time: back-off.
    Time(Timestamp),
    /// A plan with a number above this one: an input must be made again first.
    PlanAfter(u64),
}

/// Can be given out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ready {
    /// What went wrong so far.
    pub strikes: Strikes,
}

/// Given out to a worker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Running {
    /// What went wrong so far; this attempt counted.
    pub strikes: Strikes,
    /// Who runs it.
    pub worker: WorkerId,
    /// Under which lease.
    pub lease: LeaseId,
    /// Since when.
    pub since: Timestamp,
}

/// Done, as a worker says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Done {
    /// What went wrong before.
    pub strikes: Strikes,
    /// Number of the last plan that began before it was done: later plans see its artefact.
    pub known_after_plan: u64,
}

/// Set aside.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GaveUp {
    /// Why.
    pub reason: String,
    /// Times that it was given out.
    pub attempts: u32,
}

impl Ready {
    /// Gives the task out.
    pub fn assign(self, worker: WorkerId, lease: LeaseId, since: Timestamp) -> Running {
        let strikes = Strikes { attempts: self.strikes.attempts + 1, ..self.strikes };
        Running { strikes, worker, lease, since }
    }
}

impl Running {
    /// The worker was lost; after too many of them the task is the likely cause.
    pub fn lose(self, policy: &Policy) -> Item {
        let strikes = Strikes { lost: self.strikes.lost + 1, ..self.strikes };
        if strikes.lost < policy.max_losses {
            return Item::Ready(Ready { strikes });
        }
        let reason = format!(
            "{} workers died while they ran it, most likely for want of memory: give --memory or a smaller --cluster-size",
            strikes.lost
        );
        Item::GaveUp(GaveUp { reason, attempts: strikes.attempts })
    }

    /// The answer with the task never reached the worker: as if it had not been given out.
    pub fn take_back(self) -> Ready {
        Ready { strikes: Strikes { attempts: self.strikes.attempts.saturating_sub(1), ..self.strikes } }
    }

    /// The task failed on its input.
    pub fn fail_on_input(self, at: Timestamp, reason: &str, policy: &Policy) -> Item {
        let strikes = Strikes { input: self.strikes.input + 1, ..self.strikes };
        if strikes.input < policy.max_input_failures {
            return Item::Waiting(Waiting {
                strikes,
                until: Until::Time(at.after(policy.backoff_ms(strikes.input))),
            });
        }
        Item::GaveUp(GaveUp { reason: reason.to_owned(), attempts: strikes.attempts })
    }

    /// The machine or the store failed the task.
    pub fn fail_on_machine(self, until: Until, reason: &str, policy: &Policy) -> Item {
        match one_more(self.strikes, reason, policy) {
            Ok(strikes) => Item::Waiting(Waiting { strikes, until }),
            Err(gave_up) => Item::GaveUp(gave_up),
        }
    }
}

impl Done {
    /// A later plan did not find the artefact.
    pub fn lose_artefact(self, policy: &Policy) -> Item {
        match one_more(self.strikes, "its artefact was not in the store after the task was done", policy) {
            Ok(strikes) => Item::Ready(Ready { strikes }),
            Err(gave_up) => Item::GaveUp(gave_up),
        }
    }
}

/// One more failure of machine or store; the end of patience as an error.
fn one_more(before: Strikes, reason: &str, policy: &Policy) -> Result<Strikes, GaveUp> {
    let strikes = Strikes { machine: before.machine + 1, ..before };
    if strikes.machine < policy.max_machine_failures {
        return Ok(strikes);
    }
    Err(GaveUp { reason: reason.to_owned(), attempts: strikes.attempts })
}

impl Item {
    /// What went wrong so far.
    pub fn strikes(&self) -> Strikes {
        match self {
            Self::Waiting(Waiting { strikes, .. })
            | Self::Ready(Ready { strikes })
            | Self::Running(Running { strikes, .. })
            | Self::Done(Done { strikes, .. }) => *strikes,
            Self::GaveUp(gave_up) => Strikes { attempts: gave_up.attempts, ..Strikes::default() },
        }
    }
}
