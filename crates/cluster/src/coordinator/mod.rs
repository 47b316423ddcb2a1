//! The coordinator: the shell around [`crate::state::State`]. It keeps time, answers calls, and carries effects out.

mod log;
mod service;
mod shell;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use terrane_proto::types::{
    HeartbeatAnswer, LogPage, NextTask, Registration, RunId, RunPhase, Status, WorkerId,
};
use terrane_proto::{ServeOptions, Token};
use tokio::net::TcpListener;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;

use crate::ClusterError;
use crate::engine::{Closing, Engine, EngineFailure, Planner};
use crate::state::{Event, Planned, Policy, RequestId};
use log::Log;

/// How a coordinator works.
#[derive(Clone, Debug)]
pub struct CoordinatorOptions {
    /// How patient it is.
    pub policy: Policy,
    /// What callers must show; `None` lets everybody in who can reach the port.
    pub token: Option<Token>,
    /// How long it waits at its end for workers to come and be told to leave. Default one second.
    pub farewell: Duration,
}

impl Default for CoordinatorOptions {
    fn default() -> Self {
        Self { policy: Policy::default(), token: None, farewell: Duration::from_secs(1) }
    }
}

/// What the shell's loop is told.
enum Command {
    /// A worker announces itself.
    Register(WorkerId, Registration, oneshot::Sender<()>),
    /// A worker waits for a task.
    Ask(Event, RequestId, oneshot::Sender<NextTask>),
    /// A worker lives.
    Beat(Event, oneshot::Sender<HeartbeatAnswer>),
    /// A worker says how a task ended.
    Judge(Event, oneshot::Sender<bool>),
    /// A run was handed in.
    Submit(RunId, Bytes, Box<dyn Planner>),
    /// A plan is made; the planner comes back.
    Planned(RunId, u64, Result<Planned, EngineFailure>, Option<Box<dyn Planner>>),
    /// The result is written, or not; the planner comes back.
    Closed(RunId, Result<Closing, EngineFailure>, Option<Box<dyn Planner>>),
    /// The process of the worker of this name ended.
    Exited(String),
    /// What a run is.
    Describe(RunId, oneshot::Sender<Option<Bytes>>),
    /// Somebody ends a run.
    Cancel(RunId, oneshot::Sender<bool>),
    /// How everything stands.
    Status(oneshot::Sender<Status>),
}

struct Shared {
    engine: Arc<dyn Engine>,
    commands: mpsc::Sender<Command>,
    status: watch::Receiver<Status>,
    log: Log,
    next_id: AtomicU64,
    heartbeat_ms: u32,
}

/// Speaks to a coordinator in the same process. Clones speak to the same one.
#[derive(Clone)]
pub struct Handle(Arc<Shared>);

/// A coordinator that is about to run.
pub struct Coordinator {
    handle: Handle,
    shell: shell::Shell,
    options: CoordinatorOptions,
}

impl Coordinator {
    /// A coordinator of no runs and no workers.
    pub fn new(engine: Arc<dyn Engine>, options: CoordinatorOptions) -> Self {
        // Deep enough for a burst of every worker's call; callers wait when it is full.
        let (commands, inbox) = mpsc::channel(1024);
        let (published, status) = watch::channel(Status::default());
        let shared = Shared {
            engine,
            commands: commands.clone(),
            status,
            log: Log::new(),
            next_id: AtomicU64::new(1),
            heartbeat_ms: options.policy.heartbeat_ms,
        };
        let handle = Handle(Arc::new(shared));
        let shell = shell::Shell::new(handle.clone(), inbox, published, options.policy.clone());
        Self { handle, shell, options }
    }

    /// Speaks to this coordinator.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }

    /// Serves on a bound listener until `shutdown`, then tells the workers to leave and returns.
    ///
    /// # Errors
    /// When the listener fails.
    pub async fn run(self, listener: TcpListener, shutdown: CancellationToken) -> Result<(), ClusterError> {
        let closing = CancellationToken::new();
        let options = ServeOptions { token: self.options.token.clone() };
        let server =
            terrane_proto::serve(listener, Arc::new(self.handle), options, closing.clone().cancelled_owned());
        let shell = self.shell.run(shutdown, closing.clone(), self.options.farewell);
        let server = async {
            tokio::select! {
                result = server => result,
                // Callers that keep their connection busy don't keep us.
                () = async { closing.cancelled().await; tokio::time::sleep(Duration::from_millis(500)).await } => Ok(()),
            }
        };
        let (served, ()) = tokio::join!(
            async {
                let served = server.await;
                closing.cancel();
                served
            },
            shell
        );
        Ok(served?)
    }
}

impl Handle {
    fn fresh_id(&self) -> u64 {
        self.0.next_id.fetch_add(1, Ordering::SeqCst)
    }

    async fn tell(&self, command: Command) -> Result<(), ClusterError> {
        self.0.commands.send(command).await.map_err(|_| ClusterError::lost("the coordinator has ended"))
    }

    async fn ask<T>(&self, command: impl FnOnce(oneshot::Sender<T>) -> Command) -> Result<T, ClusterError> {
        let (sender, receiver) = oneshot::channel();
        self.tell(command(sender)).await?;
        receiver.await.map_err(|_| ClusterError::lost("the coordinator has ended"))
    }

    /// Starts a run.
    ///
    /// # Errors
    /// When the description is no good, or its store can't be opened.
    pub async fn submit(&self, description: Bytes) -> Result<RunId, ClusterError> {
        let engine = self.0.engine.clone();
        let read = description.clone();
        let planner = tokio::task::spawn_blocking(move || engine.planner(&read)).await.map_err(|_| {
            ClusterError::failed("the description of the run could not be read: this is a bug of terrane")
        })?;
        let planner = planner.map_err(|failure| match failure.bad_input {
            true => ClusterError::bad_input(failure.reason),
            false => ClusterError::failed(failure.reason),
        })?;
        let run = RunId(self.fresh_id());
        self.tell(Command::Submit(run, description, planner)).await?;
        Ok(run)
    }

    /// Ends a run; false when it had ended before.
    ///
    /// # Errors
    /// When the coordinator has ended.
    pub async fn cancel(&self, run: RunId) -> Result<bool, ClusterError> {
        self.ask(|answer| Command::Cancel(run, answer)).await
    }

    /// How everything stands.
    ///
    /// # Errors
    /// When the coordinator has ended.
    pub async fn status(&self) -> Result<Status, ClusterError> {
        self.ask(Command::Status).await
    }

    /// How everything stands, several times a second.
    pub fn watch(&self) -> watch::Receiver<Status> {
        self.0.status.clone()
    }

    /// Waits until a run is over; how it ended.
    ///
    /// # Errors
    /// When the coordinator ends first.
    pub async fn wait(&self, run: RunId) -> Result<RunPhase, ClusterError> {
        let mut watch = self.watch();
        let over = |status: &Status| status.runs.iter().any(|row| row.run == run && row.phase.is_over());
        let status =
            watch.wait_for(over).await.map_err(|_| ClusterError::lost("the coordinator has ended"))?;
        let phase = status.runs.iter().find(|row| row.run == run).map(|row| row.phase.clone());
        phase.ok_or_else(|| ClusterError::failed(format!("run {run} is not known")))
    }

    /// Lines of the log from a number on.
    pub fn logs(&self, from: u64) -> LogPage {
        self.0.log.page(from)
    }

    /// Tells that the process of the worker of this name has ended. Blocks: not to be called on the reactor.
    pub fn worker_exited(&self, name: &str) {
        // Fails only when the coordinator has ended, and then nobody needs to know.
        let _ = self.0.commands.blocking_send(Command::Exited(name.to_owned()));
    }
}
