//! What the two ends of a distributed adjustment say to each other: a small record, and vectors as they lie in memory.

use std::sync::Arc;

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use terrane_optim::bundle::implicit::{CameraSide, Clusters, PartRequest};
use terrane_optim::bundle::{BundleOptions, BundleProblem};
use terrane_scene::SceneError;
use terrane_scene::codec::{Archive, ArchiveWriter, Kind, Packing, Tag};

const RECORD: Tag = Tag(*b"what");
const NUMBERS: Tag = Tag(*b"numb");
const INDICES: Tag = Tag(*b"indx");
const LENGTHS: Tag = Tag(*b"lens");

/// What the solver says to a holder.
pub enum FromSolver {
    /// The cameras of the problem, where they were accepted last, and how much memory parts may take.
    Setup {
        /// The camera side.
        side: Arc<CameraSide>,
        /// Accepted steps so far.
        step: u64,
        /// The accepted cameras as numbers.
        cameras: Vec<f64>,
    },
    /// Take these parts over from the store.
    Take(Vec<u32>),
    /// Answer, for all held parts or only for some.
    Ask {
        /// Comes back with the answer.
        number: u64,
        /// The parts that shall answer; all when absent.
        only: Option<Vec<u32>>,
        /// What is asked.
        request: PartRequest,
    },
}

/// What a holder says to the solver.
pub enum FromHolder {
    /// It is there.
    Joined {
        /// A name for the log.
        name: String,
    },
    /// The answers to a question, by part.
    Answers {
        /// The question's number.
        number: u64,
        /// Part and answer.
        answers: Vec<(u32, Vec<f64>)>,
    },
    /// It can't go on, and why.
    Failed(String),
}

#[derive(Serialize, Deserialize)]
enum SolverRecord {
    Setup { problem: Box<BundleProblem>, options: Box<BundleOptions>, step: u64 },
    Take,
    Ask { number: u64, some: bool, what: RequestRecord },
}

#[derive(Serialize, Deserialize)]
enum RequestRecord {
    Linearise { damping: f64, anew: bool },
    Prepare { coarse: bool },
    Multiply,
    Solve,
    Try { damping: f64 },
    Accept,
    Points,
}

#[derive(Serialize, Deserialize)]
enum HolderRecord {
    Joined { name: String },
    Answers { number: u64 },
    Failed { reason: String },
}

/// One message before it is bytes.
struct Message<'a, R> {
    record: &'a R,
    numbers: &'a [f64],
    indices: &'a [u32],
    lengths: &'a [u32],
}

impl<R: Serialize> Message<'_, R> {
    fn encode(&self) -> Result<Bytes, SceneError> {
        let mut archive = ArchiveWriter::new(Kind::AdjustmentMessage);
        archive.json(RECORD, 0, self.record)?;
        archive.column(NUMBERS, 0, self.numbers, Packing::Raw)?;
        archive.column(INDICES, 0, self.indices, Packing::Raw)?;
        archive.column(LENGTHS, 0, self.lengths, Packing::Raw)?;
        Ok(archive.finish().into())
    }
}

impl FromSolver {
    /// The message as bytes.
    ///
    /// # Errors
    /// Only without memory.
    pub fn encode(&self) -> Result<Bytes, SceneError> {
        match self {
            Self::Setup { side, step, cameras } => {
                let record = SolverRecord::Setup {
                    problem: Box::new(side.problem().clone()),
                    options: Box::new(side.options().clone()),
                    step: *step,
                };
                let observed: Vec<u32> = side.observed().iter().map(|seen| u32::from(*seen)).collect();
                let clusters = &side.clusters().of_pose;
                Message { record: &record, numbers: cameras, indices: clusters, lengths: &observed }.encode()
            }
            Self::Take(parts) => {
                Message { record: &SolverRecord::Take, numbers: &[], indices: parts, lengths: &[] }.encode()
            }
            Self::Ask { number, only, request } => {
                let (what, numbers): (_, &[f64]) = match request {
                    PartRequest::Linearise { damping, anew } => {
                        (RequestRecord::Linearise { damping: *damping, anew: *anew }, &[])
                    }
                    PartRequest::Prepare { diagonal, coarse } => {
                        (RequestRecord::Prepare { coarse: *coarse }, diagonal)
                    }
                    PartRequest::Multiply(x) => (RequestRecord::Multiply, x),
                    PartRequest::Solve(r) => (RequestRecord::Solve, r),
                    PartRequest::Try { damping, step } => (RequestRecord::Try { damping: *damping }, step),
                    PartRequest::Accept => (RequestRecord::Accept, &[]),
                    PartRequest::Points => (RequestRecord::Points, &[]),
                };
                let record = SolverRecord::Ask { number: *number, some: only.is_some(), what };
                let indices = only.as_deref().unwrap_or_default();
                Message { record: &record, numbers, indices, lengths: &[] }.encode()
            }
        }
    }

    /// The message that bytes hold.
    ///
    /// # Errors
    /// When they hold none.
    pub fn decode(bytes: &[u8]) -> Result<Self, SceneError> {
        let archive = Archive::open(bytes, Kind::AdjustmentMessage)?;
        let numbers: Vec<f64> = archive.column(NUMBERS, 0)?;
        let indices: Vec<u32> = archive.column(INDICES, 0)?;
        Ok(match archive.json(RECORD, 0)? {
            SolverRecord::Setup { problem, options, step } => {
                let observed: Vec<u32> = archive.column(LENGTHS, 0)?;
                let n = problem.poses.len();
                let fits =
                    observed.len() == n && indices.len() == n && indices.iter().all(|c| (*c as usize) < n);
                if !fits || problem.validate().is_err() {
                    return Err(SceneError::invalid("the cameras of the adjustment contradict each other"));
                }
                let observed = observed.iter().map(|seen| *seen != 0).collect();
                let side = CameraSide::new(*problem, *options, observed, Clusters::new(indices));
                Self::Setup { side: Arc::new(side), step, cameras: numbers }
            }
            SolverRecord::Take => Self::Take(indices),
            SolverRecord::Ask { number, some, what } => {
                let request = match what {
                    RequestRecord::Linearise { damping, anew } => PartRequest::Linearise { damping, anew },
                    RequestRecord::Prepare { coarse } => PartRequest::Prepare { diagonal: numbers, coarse },
                    RequestRecord::Multiply => PartRequest::Multiply(numbers),
                    RequestRecord::Solve => PartRequest::Solve(numbers),
                    RequestRecord::Try { damping } => PartRequest::Try { damping, step: numbers },
                    RequestRecord::Accept => PartRequest::Accept,
                    RequestRecord::Points => PartRequest::Points,
                };
                Self::Ask { number, only: some.then_some(indices), request }
            }
        })
    }
}

impl FromHolder {
    /// The message as bytes.
    ///
    /// # Errors
    /// Only without memory.
    pub fn encode(&self) -> Result<Bytes, SceneError> {
        match self {
            Self::Joined { name } => {
                let record = HolderRecord::Joined { name: name.clone() };
                Message { record: &record, numbers: &[], indices: &[], lengths: &[] }.encode()
            }
            Self::Answers { number, answers } => {
                let parts: Vec<u32> = answers.iter().map(|(part, _)| *part).collect();
                let lengths: Vec<u32> = answers.iter().map(|(_, answer)| answer.len() as u32).collect();
                let numbers: Vec<f64> =
                    answers.iter().flat_map(|(_, answer)| answer.iter().copied()).collect();
                let record = HolderRecord::Answers { number: *number };
                Message { record: &record, numbers: &numbers, indices: &parts, lengths: &lengths }.encode()
            }
            Self::Failed(reason) => {
                let record = HolderRecord::Failed { reason: reason.clone() };
                Message { record: &record, numbers: &[], indices: &[], lengths: &[] }.encode()
            }
        }
    }

    /// The message that bytes hold.
    ///
    /// # Errors
    /// When they hold none.
    pub fn decode(bytes: &[u8]) -> Result<Self, SceneError> {
        let archive = Archive::open(bytes, Kind::AdjustmentMessage)?;
        Ok(match archive.json(RECORD, 0)? {
            HolderRecord::Joined { name } => Self::Joined { name },
            HolderRecord::Failed { reason } => Self::Failed(reason),
            HolderRecord::Answers { number } => {
                let numbers: Vec<f64> = archive.column(NUMBERS, 0)?;
                let parts: Vec<u32> = archive.column(INDICES, 0)?;
                let lengths: Vec<u32> = archive.column(LENGTHS, 0)?;
                let total: usize = lengths.iter().map(|n| *n as usize).sum();
                if parts.len() != lengths.len() || total != numbers.len() {
                    return Err(SceneError::invalid("the answers of a holder are cut short"));
                }
                let mut rest = numbers.as_slice();
                let answers = parts.into_iter().zip(lengths).map(|(part, n)| {
                    let (answer, after) = rest.split_at(n as usize);
                    rest = after;
                    (part, answer.to_vec())
                });
                Self::Answers { number, answers: answers.collect() }
            }
        })
    }
}
