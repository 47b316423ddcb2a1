//! `terrane coordinator` and `terrane worker`: bind, run, end on a signal.

use std::sync::Arc;
use std::time::Duration;

use terrane_cluster::coordinator::{Coordinator, CoordinatorOptions};
use terrane_cluster::engine::PipelineEngine;
use terrane_cluster::local::{TOKEN_VARIABLE, die_with_parent};
use terrane_cluster::types::Registration;
use terrane_cluster::worker::{self, WorkerOptions};
use terrane_cluster::{Endpoint, Token};
use terrane_pipeline::WorkerHints;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

use crate::args::{CoordinatorFlags, RemoteFlags, WorkerFlags};
use crate::exit::Failure;
use crate::log;
use crate::machine::{self, Share};

/// What drives calls and waits. Two threads: nothing computes here.
pub fn reactor() -> Result<Runtime, Failure> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .map_err(|error| Failure::system(format!("no threads can be had: {error}")))
}

/// The token of the environment, if there is one.
pub fn token() -> Result<Option<Token>, Failure> {
    match std::env::var(TOKEN_VARIABLE) {
        Ok(text) => Ok(Some(
            Token::parse(&text).map_err(|error| Failure::input(format!("{TOKEN_VARIABLE}: {error}")))?,
        )),
        Err(_) => Ok(None),
    }
}

/// Where a coordinator is, with the token of the environment.
pub fn endpoint(remote: &RemoteFlags) -> Result<Endpoint, Failure> {
    Ok(Endpoint::new(remote.coordinator.clone(), token()?))
}

/// Binds an address, or says what to do about it.
pub async fn bind(address: std::net::SocketAddr) -> Result<TcpListener, Failure> {
    TcpListener::bind(address).await.map_err(|error| match error.kind() {
        std::io::ErrorKind::AddrInUse => Failure::system(format!(
            "{address} is in use by another program: choose another port, or 0 for any free one"
        )),
        _ => Failure::system(format!("{address} can't be listened on: {error}")),
    })
}

/// Resolves when the user or the system asks this process to end.
pub async fn asked_to_end() {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        if let Ok(mut terminate) = signal(SignalKind::terminate()) {
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = terminate.recv() => {}
            }
            return;
        }
    }
    // Without the signal's handler there is nothing to wait for but the run itself.
    if tokio::signal::ctrl_c().await.is_err() {
        std::future::pending::<()>().await;
    }
}

/// Serves until it is asked to end.
pub async fn coordinator(flags: CoordinatorFlags) -> Result<(), Failure> {
    log::to_stderr();
    let token = token()?;
    if !flags.listen.ip().is_loopback() && !flags.allow_plaintext {
        return Err(Failure::input(format!(
            "{} is reached by other machines and everything would travel in the clear: listen on 127.0.0.1 and tunnel, or give --allow-plaintext",
            flags.listen
        )));
    }
    if !flags.listen.ip().is_loopback() && token.is_none() {
        return Err(Failure::input(format!(
            "{} is reached by other machines: set a token in {TOKEN_VARIABLE}",
            flags.listen
        )));
    }
    let listener = bind(flags.listen).await?;
    let address = listener
        .local_addr()
        .map_err(|error| Failure::system(format!("the listener has no address: {error}")))?;
    let options = CoordinatorOptions { token, ..CoordinatorOptions::default() };
    let coordinator = Coordinator::new(Arc::new(PipelineEngine { hints: WorkerHints::default() }), options);
    println!("listening on http://{address}");
    let shutdown = CancellationToken::new();
    let serving = coordinator.run(listener, shutdown.clone());
    tokio::pin!(serving);
    tokio::select! {
        served = &mut serving => served?,
        () = asked_to_end() => {
            shutdown.cancel();
            serving.await?;
        }
    }
    Ok(())
}

/// Works until the coordinator says to leave, or it is asked to end.
pub async fn worker(flags: WorkerFlags) -> Result<(), Failure> {
    log::to_stderr();
    if let Some(parent) = flags.parent {
        die_with_parent(parent)?;
    }
    let Share { threads, memory_bytes, .. } = Share::alone(flags.threads, flags.memory);
    let offer = Registration {
        name: flags.name.unwrap_or_else(machine::worker_name),
        memory_bytes,
        threads,
        slots: 1,
        process: std::process::id(),
    };
    let options = WorkerOptions {
        endpoint: endpoint(&flags.remote)?,
        offer,
        patience: Duration::from_secs(flags.patience),
    };
    let engine = Arc::new(PipelineEngine { hints: WorkerHints { threads, memory_bytes } });
    let working = worker::run(engine, options, CancellationToken::new());
    tokio::pin!(working);
    let result = tokio::select! {
        worked = &mut working => worked.map(|_| ()).map_err(Failure::from),
        () = asked_to_end() => Err(Failure::interrupted()),
    };
    // A task may still compute on its own thread; nobody waits for it, and its artefact is written whole or not at all. Ending
    // the process here doesn't wait for it either.
    std::process::exit(i32::from(result.map_or_else(|failure| failure.tell(false), |()| 0)))
}
