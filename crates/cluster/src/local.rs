//! Worker processes on this machine: started from this very binary, started again when they die, ended with their parent.
//!
//! Each process has a thread that starts it, waits for it, and starts it again: the system's parent-death signal is tied to the
//! thread that started the process, so that thread must live as long.

use std::fs::OpenOptions;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use terrane_proto::Token;
use tokio_util::sync::CancellationToken;

use crate::ClusterError;

/// The environment variable that carries the token to worker processes: unlike arguments it is not seen by other users.
pub const TOKEN_VARIABLE: &str = "TERRANE_TOKEN";

/// How worker processes are started.
#[derive(Clone, Debug)]
pub struct LocalOptions {
    /// The program, usually this one.
    pub program: PathBuf,
    /// Its arguments; `--name NAME` follows them.
    pub arguments: Vec<String>,
    /// How many processes.
    pub count: u32,
    /// The token that they show to the coordinator.
    pub token: Token,
    /// Folder that takes what they print, one file each, appended to.
    pub logs: PathBuf,
}

/// A process that dies younger than this counts as one that can't start.
const YOUNG: Duration = Duration::from_secs(2);
/// So many such deaths in a row, and it is not started again.
const MAX_YOUNG_DEATHS: u32 = 5;
/// How often a process is looked at.
const LOOK: Duration = Duration::from_millis(20);

/// Worker processes that run; dropped, they are killed.
pub struct LocalWorkers {
    stops: Vec<Sender<()>>,
    threads: Vec<JoinHandle<()>>,
    hopeless: CancellationToken,
    reason: Arc<Mutex<String>>,
}

impl LocalWorkers {
    /// Starts the processes. `on_exit` is called with the name of every process that ended, on a thread that may block.
    ///
    /// # Errors
    /// When the folder for their output can't be made or a thread can't be had.
    pub fn start(
        options: &LocalOptions,
        on_exit: impl Fn(&str) + Send + Sync + 'static,
    ) -> Result<Self, ClusterError> {
        std::fs::create_dir_all(&options.logs).map_err(|error| {
            ClusterError::failed(format!(
                "folder {} for the workers' logs can't be made: {error}",
                options.logs.display()
            ))
        })?;
        let on_exit: Arc<dyn Fn(&str) + Send + Sync> = Arc::new(on_exit);
        let (hopeless, reason) = (CancellationToken::new(), Arc::new(Mutex::new(String::new())));
        let mut workers = Self { stops: Vec::new(), threads: Vec::new(), hopeless, reason };
        let left = Arc::new(std::sync::atomic::AtomicU32::new(options.count));
        for index in 0..options.count {
            let (stop, stopped) = channel();
            let keeper = Keeper {
                name: format!("local-{index}"),
                options: options.clone(),
                on_exit: on_exit.clone(),
                stopped,
            };
            let (hopeless, reason, left) = (workers.hopeless.clone(), workers.reason.clone(), left.clone());
            let body = move || {
                if let Err(why) = keeper.keep() {
                    tracing::error!("{why}");
                    *reason.lock().unwrap_or_else(PoisonError::into_inner) = why;
                    if left.fetch_sub(1, std::sync::atomic::Ordering::SeqCst) == 1 {
                        hopeless.cancel();
                    }
                }
            };
            let thread = std::thread::Builder::new().name(format!("keeper-{index}")).spawn(body);
            let thread = thread.map_err(|error| {
                ClusterError::failed(format!("no thread can be had for a worker: {error}"))
            })?;
            workers.stops.push(stop);
            workers.threads.push(thread);
        }
        Ok(workers)
    }

    /// Resolves when none of the processes can be kept running, with the reason.
    pub async fn hopeless(&self) -> String {
        self.hopeless.cancelled().await;
        self.reason.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Ends the processes: those that have not left by themselves within `grace` are killed. Blocks.
    pub fn stop(mut self, grace: Duration) {
        let end = Instant::now() + grace;
        while Instant::now() < end && self.threads.iter().any(|thread| !thread.is_finished()) {
            std::thread::sleep(LOOK);
        }
        self.end();
    }

    fn end(&mut self) {
        self.stops.clear();
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

impl Drop for LocalWorkers {
    fn drop(&mut self) {
        self.end();
    }
}

/// Keeps one process running.
struct Keeper {
    name: String,
    options: LocalOptions,
    on_exit: Arc<dyn Fn(&str) + Send + Sync>,
    stopped: Receiver<()>,
}

impl Keeper {
    /// Until the process leaves by itself or we are told to stop; an error when it can't be kept running.
    fn keep(&self) -> Result<(), String> {
        let mut young_deaths = 0;
        loop {
            let started = Instant::now();
            let mut child = self.spawn()?;
            let Some(status) = self.watch(&mut child) else { return Ok(()) };
            (self.on_exit)(&self.name);
            if status.success() {
                return Ok(());
            }
            young_deaths = if started.elapsed() < YOUNG { young_deaths + 1 } else { 0 };
            if young_deaths >= MAX_YOUNG_DEATHS {
                let log = self.log_path();
                return Err(format!(
                    "worker {} ends as soon as it is started ({status}): see {}",
                    self.name,
                    log.display()
                ));
            }
            tracing::warn!("worker {} ended ({status}) and is started again", self.name);
            if young_deaths > 1
                && !matches!(
                    self.stopped.recv_timeout(Duration::from_millis(100 << young_deaths)),
                    Err(RecvTimeoutError::Timeout)
                )
            {
                return Ok(());
            }
        }
    }

    fn log_path(&self) -> PathBuf {
        self.options.logs.join(format!("{}.log", self.name))
    }

    fn spawn(&self) -> Result<Child, String> {
        let path = self.log_path();
        let failed = |error: std::io::Error| format!("worker {} can't be started: {error}", self.name);
        let log = OpenOptions::new().create(true).append(true).open(&path);
        let log =
            log.map_err(|error| format!("the worker's log {} can't be written: {error}", path.display()))?;
        let mut command = Command::new(&self.options.program);
        command
            .args(&self.options.arguments)
            .args(["--name", &self.name])
            .env(TOKEN_VARIABLE, self.options.token.secret())
            .stdin(Stdio::null())
            .stdout(log.try_clone().map_err(failed)?)
            .stderr(log);
        // A group of its own: Ctrl-C in the terminal is for us, and we end the workers.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        command.spawn().map_err(failed)
    }

    /// Waits for the process; `None` when we were told to stop and have killed it.
    fn watch(&self, child: &mut Child) -> Option<ExitStatus> {
        loop {
            match child.try_wait() {
                Ok(Some(status)) => return Some(status),
                Ok(None) => {}
                Err(error) => tracing::warn!("worker {} can't be waited for: {error}", self.name),
            }
            if !matches!(self.stopped.recv_timeout(LOOK), Err(RecvTimeoutError::Timeout)) {
                let _ = child.kill();
                let _ = child.wait();
                return None;
            }
        }
    }
}

/// Makes the system kill this process when the one that started it ends, and ends now when that has happened already.
///
/// # Errors
/// When the parent is not `parent` any more.
pub fn die_with_parent(parent: u32) -> Result<(), ClusterError> {
    #[cfg(target_os = "linux")]
    {
        // SAFETY: prctl(PR_SET_PDEATHSIG) takes a signal number and touches no memory of ours.
        let result = unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) };
        if result != 0 {
            tracing::warn!(
                "the system refuses the parent-death signal: this worker ends when its coordinator stays silent"
            );
        }
    }
    if std::os::unix::process::parent_id() != parent {
        return Err(ClusterError::lost(format!("the process {parent} that started this worker has ended")));
    }
    Ok(())
}
