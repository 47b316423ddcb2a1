//! A whole run in one process: plan and execute in a loop, then write the output.
//!
//! `cargo run --release -p terrane-pipeline --example run_local -- PHOTOS OUT [cluster-size] [camera]`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use terrane_pipeline::output::{RunCosts, StageCost};
use terrane_pipeline::{
    Cancel, ExecutionContext, KnownArtefacts, PlanState, RunConfig, Stage, Store, Task, execute, output,
    plan, resources,
};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [photos, out, rest @ ..] = arguments.as_slice() else {
        eprintln!("usage: run_local PHOTOS OUT [cluster-size] [camera]");
        std::process::exit(2);
    };
    let mut config = RunConfig { photos: PathBuf::from(photos), ..Default::default() };
    config.workers.threads = std::thread::available_parallelism().map_or(1, |threads| threads.get() as u32);
    if let Some(size) = rest.first().and_then(|size| size.parse().ok()) {
        config.partition.max_cluster_size = size;
    }
    config.camera = rest.get(1).map(|camera| camera.parse().unwrap_or_else(|error| fail(&error)));
    run(&config, Path::new(out)).unwrap_or_else(|error| fail(&error));
}

fn fail<T>(error: &dyn std::fmt::Display) -> T {
    eprintln!("{error}");
    std::process::exit(1);
}

fn run(config: &RunConfig, out: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let begun = Instant::now();
    let store = Store::local(&out.join("store"))?;
    let context = ExecutionContext::new(config.clone(), Cancel::default())?;
    let mut known = KnownArtefacts::new();
    let mut costs = RunCosts { workers: 1, ..Default::default() };
    loop {
        let planned = plan(config, &store, &mut known)?;
        match planned.state {
            PlanState::Failed { reason } => return Err(reason.into()),
            PlanState::Finished { figures } => {
                costs.wall_seconds = begun.elapsed().as_secs_f64();
                let peak = resources::peak_resident_bytes().unwrap_or(0);
                costs.peak_bytes = BTreeMap::from([("run_local".to_owned(), peak)]);
                output::write(config, &store, &mut known, out, &costs)?;
                println!("{}", serde_json::to_string_pretty(&figures)?);
                println!("{:.1} s, {} MiB", costs.wall_seconds, peak >> 20);
                return Ok(());
            }
            PlanState::Working => {}
        }
        for task in planned.ready {
            perform(&task, &store, &context, &mut known, costs.stages.entry(task.stage).or_default())?;
        }
    }
}

fn perform(
    task: &Task,
    store: &Store,
    context: &ExecutionContext,
    known: &mut KnownArtefacts,
    cost: &mut StageCost,
) -> Result<(), Box<dyn std::error::Error>> {
    let (begun, cpu) = (Instant::now(), resources::cpu_seconds());
    match execute(task, store, context) {
        Ok(report) => {
            known.record(task.key);
            println!(
                "{:>11} {:<32} {:6.2} s  {:?}",
                name(task.stage),
                task.item,
                begun.elapsed().as_secs_f64(),
                report.counts
            );
        }
        Err(error) => match error.corrupt_input {
            Some(key) => known.discard(store, &key)?,
            None if error.invalid_input || error.storage => return Err(error.into()),
            None => {
                println!("{:>11} {:<32} failed: {error}", name(task.stage), task.item);
                known.set_aside(task.key, error.message);
            }
        },
    }
    cost.tasks_run += 1;
    cost.wall_seconds += begun.elapsed().as_secs_f64();
    cost.cpu_seconds += resources::cpu_seconds() - cpu;
    cost.peak_bytes = cost.peak_bytes.max(resources::peak_resident_bytes().unwrap_or(0));
    cost.predicted_peak_bytes = cost.predicted_peak_bytes.max(task.predicted_peak_bytes);
    Ok(())
}

fn name(stage: Stage) -> &'static str {
    stage.name()
}
