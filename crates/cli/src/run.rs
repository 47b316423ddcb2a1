//! `terrane run`: a coordinator in this process, worker processes beside it, and the way from one to the other's end.

use std::fs::File;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use terrane_cluster::Token;
use terrane_cluster::coordinator::{Coordinator, CoordinatorOptions, Handle};
use terrane_cluster::engine::{PipelineEngine, RunDescription};
use terrane_cluster::local::{LocalOptions, LocalWorkers};
use terrane_cluster::types::{RunId, RunPhase};
use terrane_pipeline::WorkerHints;
use tokio_util::sync::CancellationToken;

use crate::args::RunFlags;
use crate::exit::Failure;
use crate::machine::Share;
use crate::progress::Progress;
use crate::{config, log, service, summary};

/// Workers that are still busy at the end get this long to leave by themselves.
const GRACE: Duration = Duration::from_secs(2);

/// What the flags mean on this machine.
pub struct Plan {
    /// The run, as it is handed to the coordinator.
    pub description: RunDescription,
    /// How processes share the machine.
    pub share: Share,
    /// Folder of everything that is not the result.
    pub hidden: PathBuf,
    /// Port of the coordinator; zero for any free one.
    pub port: u16,
    /// Held for as long as the run, so that no other one writes the same result.
    _lock: File,
}

impl Plan {
    /// Reads the flags, looks at the machine, makes the result's folder.
    pub fn resolve(flags: &RunFlags) -> Result<Self, Failure> {
        let mut config = config::resolve(&flags.options)?;
        config::photographs(&mut config, &flags.photos)?;
        let share = Share::resolve(flags.workers, flags.threads, flags.memory);
        config.workers = WorkerHints { threads: share.threads, memory_bytes: share.memory_bytes };
        let problems = config.validate();
        if !problems.is_empty() {
            return Err(Failure::input(problems.join("; ")));
        }
        let (out, hidden) = result_folder(&flags.out)?;
        let lock = lock(&hidden)?;
        let store = hidden.join("store").to_str().map(str::to_owned);
        let store = store.ok_or_else(|| {
            Failure::input(format!("{}: the path of the result must be text", out.display()))
        })?;
        let description = RunDescription { config, store, out, workers: u64::from(share.workers) };
        Ok(Self { description, share, hidden, port: flags.port, _lock: lock })
    }
}

/// Makes the folder of the result and the hidden one in it.
pub fn result_folder(out: &Path) -> Result<(PathBuf, PathBuf), Failure> {
    let unwritable = |error: std::io::Error| {
        Failure::system(format!("result folder {} can't be written: {error}", out.display()))
    };
    std::fs::create_dir_all(out.join(".terrane")).map_err(unwritable)?;
    let out = out.canonicalize().map_err(unwritable)?;
    let hidden = out.join(".terrane");
    Ok((out, hidden))
}

fn lock(hidden: &Path) -> Result<File, Failure> {
    let path = hidden.join("lock");
    let unwritable = |error: std::io::Error| {
        Failure::system(format!("result folder can't be written: {}: {error}", path.display()))
    };
    let file = File::options().create(true).write(true).truncate(false).open(&path).map_err(unwritable)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(std::fs::TryLockError::WouldBlock) => Err(Failure::input(format!(
            "another terrane is writing {}: wait for it, or give another --out",
            hidden.display()
        ))),
        Err(std::fs::TryLockError::Error(error)) => Err(unwritable(error)),
    }
}

/// How a run on this machine ended.
enum End {
    Over(RunPhase),
    Interrupted,
    Hopeless(String),
}

/// Reconstructs on this machine.
pub async fn run(flags: RunFlags, json: bool) -> Result<(), Failure> {
    let plan = Plan::resolve(&flags)?;
    let phase = reconstruct(&plan, json).await?;
    finish(&plan.description.out, &phase, json)
}

/// Runs the coordinator and the workers until the run is over.
pub async fn reconstruct(plan: &Plan, json: bool) -> Result<RunPhase, Failure> {
    log::to_file(&plan.hidden)?;
    let listener = service::bind(SocketAddr::from((Ipv4Addr::LOCALHOST, plan.port))).await?;
    let address = listener
        .local_addr()
        .map_err(|error| Failure::system(format!("the listener has no address: {error}")))?;
    let token =
        Token::random().map_err(|error| Failure::system(format!("no random numbers can be had: {error}")))?;
    let engine = Arc::new(PipelineEngine { hints: plan.description.config.workers.clone() });
    let coordinator = Coordinator::new(
        engine,
        CoordinatorOptions { token: Some(token.clone()), ..CoordinatorOptions::default() },
    );
    let (handle, shutdown) = (coordinator.handle(), CancellationToken::new());
    let server = tokio::spawn(coordinator.run(listener, shutdown.clone()));

    let ended = supervise(plan, &handle, (address, token), json).await;
    shutdown.cancel();
    let (end, workers) = ended?;
    let grace = if matches!(end, End::Over(_)) { GRACE } else { Duration::ZERO };
    let stopped = tokio::task::spawn_blocking(move || workers.stop(grace));
    let _ = server.await;
    let _ = stopped.await;
    match end {
        End::Over(phase) => Ok(phase),
        End::Interrupted => Err(Failure::interrupted()),
        End::Hopeless(why) => Err(Failure::system(why)),
    }
}

async fn supervise(
    plan: &Plan,
    handle: &Handle,
    at: (SocketAddr, Token),
    json: bool,
) -> Result<(End, LocalWorkers), Failure> {
    let description = plan.description.encode().map_err(|failure| Failure::input(failure.reason))?;
    let run = handle.submit(description).await?;
    let workers = LocalWorkers::start(&worker_options(plan, at)?, {
        let handle = handle.clone();
        move |name| handle.worker_exited(name)
    })?;
    let mut progress = Progress::new(run, json);
    let end = tokio::select! {
        phase = watched(handle, run, &mut progress) => End::Over(phase?),
        () = service::asked_to_end() => End::Interrupted,
        why = workers.hopeless() => End::Hopeless(why),
    };
    progress.close();
    Ok((end, workers))
}

fn worker_options(plan: &Plan, at: (SocketAddr, Token)) -> Result<LocalOptions, Failure> {
    let program = std::env::current_exe()
        .map_err(|error| Failure::system(format!("this program can't be found to start workers: {error}")))?;
    let arguments = [
        "worker".to_owned(),
        format!("--coordinator=http://{}", at.0),
        format!("--threads={}", plan.share.threads),
        format!("--memory={}", plan.share.memory_bytes),
        "--patience=10".to_owned(),
        format!("--parent={}", std::process::id()),
    ];
    Ok(LocalOptions {
        program,
        arguments: arguments.into(),
        count: plan.share.workers,
        token: at.1,
        logs: plan.hidden.join("logs"),
    })
}

/// Shows the progress of a run until it is over.
async fn watched(handle: &Handle, run: RunId, progress: &mut Progress) -> Result<RunPhase, Failure> {
    let mut watch = handle.watch();
    loop {
        progress.lines(&handle.logs(progress.next_line()));
        let status = watch.borrow_and_update().clone();
        if let Some(row) = status.runs.into_iter().find(|row| row.run == run) {
            progress.show(&row);
            if row.phase.is_over() {
                return Ok(row.phase);
            }
        }
        watch.changed().await.map_err(|_| Failure::system("the coordinator has ended"))?;
    }
}

/// Tells how a run came out, and maps it to the exit code.
pub fn finish(out: &Path, phase: &RunPhase, json: bool) -> Result<(), Failure> {
    match phase {
        RunPhase::Done => summary::print(out, json),
        RunPhase::FellShort(reason) => {
            Err(Failure::short(format!("{reason}; the report is in {}", out.join("report.json").display())))
        }
        RunPhase::BadInput(reason) => Err(Failure::input(reason.clone())),
        RunPhase::Failed(reason) => Err(Failure::system(reason.clone())),
        RunPhase::Cancelled => Err(Failure::short("the run was cancelled")),
        RunPhase::Working | RunPhase::Closing => Err(Failure::system("the run is not over")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_result_folder_is_made_and_locked() {
        let folder = tempfile::tempdir().unwrap();
        let (out, hidden) = result_folder(&folder.path().join("a/b")).unwrap();
        assert!(out.is_dir() && hidden.is_dir());
        let first = lock(&hidden).unwrap();
        assert_eq!(lock(&hidden).unwrap_err().code(), 2);
        drop(first);
        lock(&hidden).unwrap();
    }

    #[test]
    fn a_result_folder_that_can_not_be_made_is_a_storage_failure() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "x").unwrap();
        let failure = result_folder(&file.join("out")).unwrap_err();
        assert!(failure.code() == 3 && failure.message().contains("file/out"), "{}", failure.message());
    }

    #[test]
    fn every_end_has_its_code() {
        let out = Path::new("/nowhere");
        let reason = || "why".to_owned();
        let ends = [
            (RunPhase::FellShort(reason()), 1),
            (RunPhase::Cancelled, 1),
            (RunPhase::BadInput(reason()), 2),
            (RunPhase::Failed(reason()), 3),
        ];
        for (phase, code) in ends {
            assert_eq!(finish(out, &phase, false).unwrap_err().code(), code, "{phase:?}");
        }
    }
}
