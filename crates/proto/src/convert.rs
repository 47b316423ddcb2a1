//! Wire messages into terrane's own types (checked) and back (never fails).

use bytes::Bytes;

use crate::types::*;
use crate::{ProtoError, limits, v1};

fn text(path: &str, value: String, most: usize) -> Result<String, ProtoError> {
    if value.len() > most {
        return Err(ProtoError::invalid(
            path,
            format_args!("{} bytes exceed the limit of {most}", value.len()),
        ));
    }
    Ok(value)
}

fn blob(path: &str, value: Bytes, most: usize) -> Result<Bytes, ProtoError> {
    if value.len() > most {
        return Err(ProtoError::invalid(
            path,
            format_args!("{} bytes exceed the limit of {most}", value.len()),
        ));
    }
    Ok(value)
}

fn rows<T, U>(
    path: &str,
    list: Vec<T>,
    most: usize,
    each: impl FnMut(T) -> Result<U, ProtoError>,
) -> Result<Vec<U>, ProtoError> {
    if list.len() > most {
        return Err(ProtoError::invalid(
            path,
            format_args!("{} rows exceed the limit of {most}", list.len()),
        ));
    }
    list.into_iter().map(each).collect()
}

fn present<T>(path: &str, value: Option<T>) -> Result<T, ProtoError> {
    value.ok_or_else(|| ProtoError::invalid(path, "is missing"))
}

/// A text cut to a limit at a character's edge, for what we send ourselves.
pub(crate) fn clip(mut value: String, most: usize) -> String {
    if value.len() > most {
        let mut end = most;
        while !value.is_char_boundary(end) {
            end -= 1;
        }
        value.truncate(end);
    }
    value
}

pub(crate) fn description(value: Bytes) -> Result<Bytes, ProtoError> {
    blob("description", value, limits::DESCRIPTION_BYTES)
}

pub(crate) fn report(value: Bytes) -> Result<Bytes, ProtoError> {
    blob("report", value, limits::REPORT_BYTES)
}

pub(crate) fn leases(path: &str, list: Vec<u64>) -> Result<Vec<LeaseId>, ProtoError> {
    rows(path, list, limits::LEASES, |lease| Ok(LeaseId(lease)))
}

impl TryFrom<v1::RegisterRequest> for Registration {
    type Error = ProtoError;

    fn try_from(wire: v1::RegisterRequest) -> Result<Self, ProtoError> {
        let name = text("name", wire.name, limits::NAME_BYTES)?;
        if name.is_empty() || name.chars().any(char::is_control) {
            return Err(ProtoError::invalid("name", "must have visible characters only, and one at least"));
        }
        for (path, value) in [("threads", wire.threads), ("slots", wire.slots)] {
            if !(1..=limits::THREADS).contains(&value) {
                return Err(ProtoError::invalid(path, format_args!("must be 1 to {}", limits::THREADS)));
            }
        }
        Ok(Self {
            name,
            memory_bytes: wire.memory_bytes,
            threads: wire.threads,
            slots: wire.slots,
            process: wire.process,
        })
    }
}

impl From<Registration> for v1::RegisterRequest {
    fn from(own: Registration) -> Self {
        let Registration { name, memory_bytes, threads, slots, process } = own;
        Self { name, memory_bytes, threads, slots, process }
    }
}

impl TryFrom<v1::RegisterReply> for Registered {
    type Error = ProtoError;

    fn try_from(wire: v1::RegisterReply) -> Result<Self, ProtoError> {
        if wire.heartbeat_ms == 0 {
            return Err(ProtoError::invalid("heartbeat_ms", "must be positive"));
        }
        Ok(Self { worker: WorkerId(wire.worker), heartbeat_ms: wire.heartbeat_ms })
    }
}

impl TryFrom<v1::TaskLease> for TaskLease {
    type Error = ProtoError;

    fn try_from(wire: v1::TaskLease) -> Result<Self, ProtoError> {
        Ok(Self {
            lease: LeaseId(wire.lease),
            run: RunId(wire.run),
            key: TaskKey::parse(&wire.key)?,
            stage: text("stage", wire.stage, limits::NAME_BYTES)?,
            item: text("item", wire.item, limits::NAME_BYTES)?,
            attempt: wire.attempt,
            spec: blob("spec", wire.spec, limits::DESCRIPTION_BYTES)?,
        })
    }
}

impl From<TaskLease> for v1::TaskLease {
    fn from(own: TaskLease) -> Self {
        Self {
            lease: own.lease.0,
            run: own.run.0,
            key: own.key.as_str().to_owned(),
            stage: clip(own.stage, limits::NAME_BYTES),
            item: clip(own.item, limits::NAME_BYTES),
            attempt: own.attempt,
            spec: own.spec,
        }
    }
}

impl TryFrom<v1::NextTaskReply> for NextTask {
    type Error = ProtoError;

    fn try_from(wire: v1::NextTaskReply) -> Result<Self, ProtoError> {
        use v1::next_task_reply::Answer;
        Ok(match present("answer", wire.answer)? {
            Answer::Lease(lease) => Self::Lease(lease.try_into()?),
            Answer::Nothing(_) => Self::Nothing,
            Answer::Leave(_) => Self::Leave,
            Answer::Unknown(_) => Self::Unknown,
        })
    }
}

impl From<NextTask> for v1::NextTaskReply {
    fn from(own: NextTask) -> Self {
        use v1::next_task_reply::Answer;
        let answer = match own {
            NextTask::Lease(lease) => Answer::Lease(lease.into()),
            NextTask::Nothing => Answer::Nothing(v1::Nothing {}),
            NextTask::Leave => Answer::Leave(v1::Leave {}),
            NextTask::Unknown => Answer::Unknown(v1::Unknown {}),
        };
        Self { answer: Some(answer) }
    }
}

impl TryFrom<v1::HeartbeatReply> for HeartbeatAnswer {
    type Error = ProtoError;

    fn try_from(wire: v1::HeartbeatReply) -> Result<Self, ProtoError> {
        Ok(Self { known: wire.known, revoked: leases("revoked", wire.revoked)? })
    }
}

impl From<v1::TaskCost> for TaskCost {
    fn from(wire: v1::TaskCost) -> Self {
        Self { wall_ms: wire.wall_ms, cpu_ms: wire.cpu_ms, peak_bytes: wire.peak_bytes }
    }
}

impl From<TaskCost> for v1::TaskCost {
    fn from(own: TaskCost) -> Self {
        Self { wall_ms: own.wall_ms, cpu_ms: own.cpu_ms, peak_bytes: own.peak_bytes }
    }
}

pub(crate) fn cost(wire: Option<v1::TaskCost>) -> Result<TaskCost, ProtoError> {
    present("cost", wire).map(TaskCost::from)
}

pub(crate) fn failure(kind: i32, reason: String, detail: Bytes) -> Result<Failure, ProtoError> {
    let kind = match v1::FailureKind::try_from(kind) {
        Ok(v1::FailureKind::Input) => FailureKind::Input,
        Ok(v1::FailureKind::Machine) => FailureKind::Machine,
        Ok(v1::FailureKind::LostInput) => FailureKind::LostInput,
        Ok(v1::FailureKind::BadRun) => FailureKind::BadRun,
        Ok(v1::FailureKind::Storage) => FailureKind::Storage,
        _ => return Err(ProtoError::invalid("kind", format_args!("{kind} is not a kind of failure"))),
    };
    let detail = blob("detail", detail, limits::REPORT_BYTES)?;
    Ok(Failure { kind, reason: text("reason", reason, limits::TEXT_BYTES)?, detail })
}

pub(crate) fn failure_kind(own: FailureKind) -> i32 {
    (match own {
        FailureKind::Input => v1::FailureKind::Input,
        FailureKind::Machine => v1::FailureKind::Machine,
        FailureKind::LostInput => v1::FailureKind::LostInput,
        FailureKind::BadRun => v1::FailureKind::BadRun,
        FailureKind::Storage => v1::FailureKind::Storage,
    }) as i32
}

impl TryFrom<v1::StageStatus> for StageStatus {
    type Error = ProtoError;

    fn try_from(wire: v1::StageStatus) -> Result<Self, ProtoError> {
        let v1::StageStatus { stage, done, total, running, computed, given_up } = wire;
        Ok(Self {
            stage: text("stage", stage, limits::NAME_BYTES)?,
            done,
            total,
            running,
            computed,
            given_up,
        })
    }
}

impl From<StageStatus> for v1::StageStatus {
    fn from(own: StageStatus) -> Self {
        let StageStatus { stage, done, total, running, computed, given_up } = own;
        Self { stage, done, total, running, computed, given_up }
    }
}

impl TryFrom<v1::RunStatus> for RunStatus {
    type Error = ProtoError;

    fn try_from(wire: v1::RunStatus) -> Result<Self, ProtoError> {
        let reason = text("reason", wire.reason, limits::TEXT_BYTES)?;
        let phase = match v1::RunPhase::try_from(wire.phase) {
            Ok(v1::RunPhase::Working) => RunPhase::Working,
            Ok(v1::RunPhase::Closing) => RunPhase::Closing,
            Ok(v1::RunPhase::Done) => RunPhase::Done,
            Ok(v1::RunPhase::FellShort) => RunPhase::FellShort(reason),
            Ok(v1::RunPhase::BadInput) => RunPhase::BadInput(reason),
            Ok(v1::RunPhase::Failed) => RunPhase::Failed(reason),
            Ok(v1::RunPhase::Cancelled) => RunPhase::Cancelled,
            _ => return Err(ProtoError::invalid("phase", format_args!("{} is not a phase", wire.phase))),
        };
        let stages = rows("stages", wire.stages, limits::ROWS, StageStatus::try_from)?;
        Ok(Self { run: RunId(wire.run), phase, stages })
    }
}

impl From<RunStatus> for v1::RunStatus {
    fn from(own: RunStatus) -> Self {
        let (phase, reason) = match own.phase {
            RunPhase::Working => (v1::RunPhase::Working, String::new()),
            RunPhase::Closing => (v1::RunPhase::Closing, String::new()),
            RunPhase::Done => (v1::RunPhase::Done, String::new()),
            RunPhase::FellShort(reason) => (v1::RunPhase::FellShort, reason),
            RunPhase::BadInput(reason) => (v1::RunPhase::BadInput, reason),
            RunPhase::Failed(reason) => (v1::RunPhase::Failed, reason),
            RunPhase::Cancelled => (v1::RunPhase::Cancelled, String::new()),
        };
        let stages = own.stages.into_iter().map(Into::into).collect();
        Self { run: own.run.0, phase: phase as i32, reason: clip(reason, limits::TEXT_BYTES), stages }
    }
}

impl TryFrom<v1::WorkerStatus> for WorkerStatus {
    type Error = ProtoError;

    fn try_from(wire: v1::WorkerStatus) -> Result<Self, ProtoError> {
        Ok(Self {
            worker: WorkerId(wire.worker),
            name: text("name", wire.name, limits::NAME_BYTES)?,
            memory_bytes: wire.memory_bytes,
            resident_bytes: wire.resident_bytes,
            silent_ms: wire.silent_ms,
            tasks: rows("tasks", wire.tasks, limits::LEASES, |task| {
                text("tasks", task, 2 * limits::NAME_BYTES + 1)
            })?,
        })
    }
}

impl From<WorkerStatus> for v1::WorkerStatus {
    fn from(own: WorkerStatus) -> Self {
        let WorkerStatus { worker, name, memory_bytes, resident_bytes, silent_ms, tasks } = own;
        let tasks = tasks.into_iter().map(|task| clip(task, 2 * limits::NAME_BYTES + 1)).collect();
        Self { worker: worker.0, name, memory_bytes, resident_bytes, silent_ms, tasks }
    }
}

impl TryFrom<v1::StatusReply> for Status {
    type Error = ProtoError;

    fn try_from(wire: v1::StatusReply) -> Result<Self, ProtoError> {
        Ok(Self {
            runs: rows("runs", wire.runs, limits::ROWS, RunStatus::try_from)?,
            workers: rows("workers", wire.workers, limits::ROWS, WorkerStatus::try_from)?,
        })
    }
}

impl From<Status> for v1::StatusReply {
    fn from(own: Status) -> Self {
        Self {
            runs: own.runs.into_iter().map(Into::into).collect(),
            workers: own.workers.into_iter().map(Into::into).collect(),
        }
    }
}

impl TryFrom<v1::LogsReply> for LogPage {
    type Error = ProtoError;

    fn try_from(wire: v1::LogsReply) -> Result<Self, ProtoError> {
        let lines = rows("lines", wire.lines, limits::ROWS, |line| {
            Ok(LogLine {
                number: line.number,
                at_ms: line.at_ms,
                text: text("text", line.text, limits::TEXT_BYTES)?,
            })
        })?;
        Ok(Self { lines, next: wire.next })
    }
}

impl From<LogPage> for v1::LogsReply {
    fn from(own: LogPage) -> Self {
        let line = |line: LogLine| v1::LogLine {
            number: line.number,
            at_ms: line.at_ms,
            text: clip(line.text, limits::TEXT_BYTES),
        };
        Self { lines: own.lines.into_iter().map(line).collect(), next: own.next }
    }
}
