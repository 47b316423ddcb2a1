//! `terrane submit`, `status`, `cancel` and `logs`: calls to a coordinator elsewhere.

use std::time::Duration;

use terrane_cluster::Client;
use terrane_cluster::engine::RunDescription;
use terrane_cluster::types::{RunId, RunPhase, Status};

use crate::args::{CancelFlags, RemoteFlags, SubmitFlags};
use crate::exit::Failure;
use crate::progress::Progress;
use crate::{config, run, service};

async fn connect(remote: &RemoteFlags) -> Result<Client, Failure> {
    Ok(Client::connect(&service::endpoint(remote)?).await?)
}

/// Hands a run over, and follows it unless told otherwise.
pub async fn submit(flags: SubmitFlags, json: bool) -> Result<(), Failure> {
    let mut config = config::resolve(&flags.options)?;
    config::photographs(&mut config, &flags.photos)?;
    let (out, hidden) = run::result_folder(&flags.out)?;
    let store = hidden.join("store").to_str().map(str::to_owned);
    let store = store
        .ok_or_else(|| Failure::input(format!("{}: the path of the result must be text", out.display())))?;
    let client = connect(&flags.remote).await?;
    let workers = client.status().await?.workers.len() as u64;
    let description = RunDescription { config, store, out: out.clone(), workers };
    let id = client.submit(description.encode().map_err(|failure| Failure::input(failure.reason))?).await?;
    if json {
        println!("{}", serde_json::json!({ "event": "submitted", "run": id.0 }));
    } else {
        println!("run {id}");
    }
    if flags.detach {
        return Ok(());
    }
    let mut progress = Progress::new(id, json);
    let phase = tokio::select! {
        phase = follow(&client, id, &mut progress) => phase,
        () = service::asked_to_end() => return Err(Failure::interrupted()),
    };
    progress.close();
    run::finish(&out, &phase?, json)
}

async fn follow(client: &Client, run: RunId, progress: &mut Progress) -> Result<RunPhase, Failure> {
    loop {
        let status = client.status().await?;
        let row = status.runs.into_iter().find(|row| row.run == run);
        let row = row.ok_or_else(|| {
            Failure::system(format!("the coordinator doesn't know run {run} any more: submit again to go on"))
        })?;
        progress.show(&row);
        if row.phase.is_over() {
            return Ok(row.phase);
        }
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
}

/// Prints how a coordinator's runs and workers stand.
pub async fn status(flags: RemoteFlags, json: bool) -> Result<(), Failure> {
    let status = connect(&flags).await?.status().await?;
    if json {
        println!("{}", as_json(&status));
    } else {
        print!("{}", as_text(&status));
    }
    Ok(())
}

/// Ends a run.
pub async fn cancel(flags: CancelFlags, json: bool) -> Result<(), Failure> {
    let cancelled = connect(&flags.remote).await?.cancel(RunId(flags.run)).await?;
    match (cancelled, json) {
        (true, true) => println!("{}", serde_json::json!({ "event": "cancelled", "run": flags.run })),
        (true, false) => println!("run {} is cancelled; what it has computed is kept", flags.run),
        (false, _) => return Err(Failure::input(format!("run {} is not known or has ended", flags.run))),
    }
    Ok(())
}

/// Prints the log of a coordinator, as far as it keeps it.
pub async fn logs(flags: RemoteFlags, json: bool) -> Result<(), Failure> {
    let client = connect(&flags).await?;
    let mut next = 0;
    loop {
        let page = client.logs(next).await?;
        if page.lines.is_empty() {
            return Ok(());
        }
        for line in &page.lines {
            if json {
                println!(
                    "{}",
                    serde_json::json!({ "event": "log", "number": line.number, "at_ms": line.at_ms, "text": line.text })
                );
            } else {
                println!("{:>10.3} s  {}", line.at_ms as f64 * 1e-3, line.text);
            }
        }
        next = page.next;
    }
}

/// A phase in words, with its reason.
fn phase(phase: &RunPhase) -> (&'static str, Option<&str>) {
    match phase {
        RunPhase::Working => ("working", None),
        RunPhase::Closing => ("writing", None),
        RunPhase::Done => ("done", None),
        RunPhase::FellShort(reason) => ("fell short", Some(reason)),
        RunPhase::BadInput(reason) => ("bad input", Some(reason)),
        RunPhase::Failed(reason) => ("failed", Some(reason)),
        RunPhase::Cancelled => ("cancelled", None),
    }
}

fn as_json(status: &Status) -> serde_json::Value {
    let stage = |stage: &terrane_cluster::types::StageStatus| {
        serde_json::json!({ "stage": stage.stage, "done": stage.done, "total": stage.total, "running": stage.running,
            "computed": stage.computed, "set_aside": stage.given_up })
    };
    let runs = status.runs.iter().map(|run| {
        let (name, reason) = phase(&run.phase);
        serde_json::json!({ "run": run.run.0, "phase": name, "reason": reason, "stages": run.stages.iter().map(stage).collect::<Vec<_>>() })
    });
    let workers = status.workers.iter().map(|worker| {
        serde_json::json!({ "worker": worker.worker.0, "name": worker.name, "memory_bytes": worker.memory_bytes,
            "resident_bytes": worker.resident_bytes, "silent_ms": worker.silent_ms, "tasks": worker.tasks })
    });
    serde_json::json!({ "runs": runs.collect::<Vec<_>>(), "workers": workers.collect::<Vec<_>>() })
}

fn as_text(status: &Status) -> String {
    let mut text = String::new();
    for run in &status.runs {
        let (name, reason) = phase(&run.phase);
        let reason = reason.map_or_else(String::new, |reason| format!(": {reason}"));
        text.push_str(&format!("run {} {name}{reason}\n", run.run));
        for stage in run.stages.iter().filter(|stage| stage.total > 0) {
            let aside =
                if stage.given_up > 0 { format!("  {} set aside", stage.given_up) } else { String::new() };
            text.push_str(&format!(
                "  {:<12} {:>6} of {:<6} {:>3} running{aside}\n",
                stage.stage, stage.done, stage.total, stage.running
            ));
        }
    }
    for worker in &status.workers {
        let tasks = if worker.tasks.is_empty() { "idle".to_owned() } else { worker.tasks.join(", ") };
        text.push_str(&format!(
            "worker {:<16} {:>6} of {:>6} MiB  {tasks}\n",
            worker.name,
            worker.resident_bytes >> 20,
            worker.memory_bytes >> 20
        ));
    }
    if text.is_empty() {
        text.push_str("no runs, no workers\n");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_idle_coordinator_says_so() {
        assert_eq!(as_text(&Status::default()), "no runs, no workers\n");
        assert_eq!(as_json(&Status::default()), serde_json::json!({ "runs": [], "workers": [] }));
    }
}
