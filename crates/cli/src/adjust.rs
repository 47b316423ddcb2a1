//! `terrane adjust`: one bundle adjustment of a whole problem, and `terrane hold`, its worker process.

use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use terrane_cluster::adjustment::{HolderOptions, RemoteHost, RemoteOptions};
use terrane_cluster::local::{LocalOptions, LocalWorkers, die_with_parent};
use terrane_cluster::{Token, with_causes};
use terrane_pipeline::Store;
use terrane_pipeline::adjustment::{
    self, BundleError, BundleOptions, BundleReport, LocalHost, PartWorker, RefineIntrinsics, ResidualFigures,
    StoredParts, WholeProblem, problems,
};
use terrane_pipeline::resources::peak_resident_bytes;
use terrane_scene::bal;
use terrane_scene::colmap::{self, ColmapModel, ModelFiles};

use crate::args::{AdjustFlags, HoldFlags};
use crate::exit::Failure;
use crate::machine::Share;
use crate::{log, models, service};

/// Parts lie in this folder of the scratch store.
const PARTS: &str = "adjustment";

/// Parts may be without a holder for so long.
const PATIENCE: Duration = Duration::from_secs(60);

/// Where a problem came from, which is how its result is written.
enum Source {
    Bal(PathBuf),
    Model(Box<ColmapModel>),
}

/// Reads, solves, writes, prints.
pub fn adjust(flags: &AdjustFlags, json: bool) -> Result<(), Failure> {
    // Zero means all cores, which are this process's own until workers start.
    let threads = flags.threads.filter(|_| flags.workers == 0).map_or(0, |threads| threads.get() as usize);
    let built = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
    built.map_err(|error| Failure::system(format!("no threads can be had: {error}")))?;
    let mut options = BundleOptions {
        loss: flags.loss,
        loss_scale_px: flags.loss_scale_px,
        max_iterations: flags.max_iterations,
        cost_tolerance: flags.cost_tolerance,
        initial_damping: flags.initial_damping,
        solver: flags.solver,
        preconditioner: flags.preconditioner,
        precision: flags.precision,
        linear_tolerance: flags.linear_tolerance,
        ..BundleOptions::default()
    };
    let started = Instant::now();
    let (source, mut whole) = read(flags)?;
    options.behind_camera = whole.behind_camera;
    let read_seconds = started.elapsed().as_secs_f64();
    let before = ResidualFigures::of(&whole);
    let started = Instant::now();
    let report = if flags.workers > 0 {
        solve_on_workers(flags, &options, &mut whole)?
    } else if let Some(memory_bytes) = flags.memory {
        solve_from_disk(flags, &options, &mut whole, memory_bytes)?
    } else {
        adjustment::solve(&mut whole.problem, &mut whole.shards, &options).map_err(failed)?
    };
    let solve_seconds = started.elapsed().as_secs_f64();
    if whole.shards.0.iter().all(|shard| shard.observations.is_empty()) {
        // They were let go while parts held them.
        for (shard, read) in whole.shards.0.iter_mut().zip(read(flags)?.1.shards.0) {
            shard.observations = read.observations;
        }
    }
    let after = ResidualFigures::of(&whole);
    write(&source, &whole, &flags.out)?;
    let outcome = Outcome { whole: &whole, report: &report, before, after, read_seconds, solve_seconds };
    if json {
        println!("{}", outcome.as_json())
    } else {
        print!("{}", outcome.as_text())
    }
    if report.termination.converged() {
        return Ok(());
    }
    Err(Failure::short(format!(
        "stopped before a minimum was reached ({}): the result is the best so far; give more iterations or look at the problem",
        outcome.termination()
    )))
}

fn read(flags: &AdjustFlags) -> Result<(Source, WholeProblem), Failure> {
    let shown = flags.problem.display();
    let invalid = |error: &dyn std::fmt::Display| Failure::input(format!("{shown}: {error}"));
    if flags.problem.is_dir() {
        let model = models::read(&models::folder(&flags.problem, 0)?)?;
        let whole =
            problems::from_model(&model.reconstruction, refine(&flags.refine)?).map_err(|e| invalid(&e))?;
        return Ok((Source::Model(Box::new(model)), whole));
    }
    let whole = problems::read_bal(open(&flags.problem)?).map_err(|error| invalid(&error))?;
    Ok((Source::Bal(flags.problem.clone()), whole))
}

fn open(path: &Path) -> Result<BufReader<File>, Failure> {
    let file = File::open(path).map_err(|error| Failure::input(format!("{}: {error}", path.display())))?;
    Ok(BufReader::with_capacity(1 << 20, file))
}

fn refine(names: &[String]) -> Result<RefineIntrinsics, Failure> {
    let mut refine = RefineIntrinsics::NONE;
    for name in names {
        match name.as_str() {
            "focal" => refine.focal = true,
            "principal-point" => refine.principal_point = true,
            "distortion" => refine.distortion = true,
            "none" => {}
            other => {
                return Err(Failure::input(format!(
                    "--refine {other}: choose from focal, principal-point, distortion, or none"
                )));
            }
        }
    }
    Ok(refine)
}

fn write(source: &Source, whole: &WholeProblem, out: &Path) -> Result<(), Failure> {
    let failed = |error: &dyn std::fmt::Display| Failure::system(format!("{}: {error}", out.display()));
    let create = |path: &Path| File::create(path).map(BufWriter::new).map_err(|error| failed(&error));
    match source {
        Source::Bal(original) => {
            // Beside its place until it is whole: the original may be the target.
            let part = out.with_extension("part");
            let (cameras, points) = problems::to_bal(whole);
            bal::write(open(original)?, create(&part)?, &cameras, &points).map_err(|error| failed(&error))?;
            std::fs::rename(&part, out).map_err(|error| failed(&error))
        }
        Source::Model(model) => {
            std::fs::create_dir_all(out).map_err(|error| failed(&error))?;
            let mut reconstruction = model.reconstruction.clone();
            problems::into_model(whole, &mut reconstruction);
            let files = ModelFiles {
                cameras: create(&out.join("cameras.bin"))?,
                images: create(&out.join("images.bin"))?,
                points: create(&out.join("points3D.bin"))?,
            };
            let name = |image| model.name(image).unwrap_or_default().to_owned();
            colmap::write_binary(&reconstruction, &name, files).map_err(|error| failed(&error))
        }
    }
}

/// The scratch folder of one solve, gone with it.
struct Scratch {
    folder: PathBuf,
    store: Store,
}

impl Scratch {
    fn new(flags: &AdjustFlags) -> Result<Self, Failure> {
        let beside = || flags.out.with_extension(format!("scratch-{}", std::process::id()));
        let folder = match &flags.scratch {
            Some(folder) => folder.join(format!("adjustment-{}", std::process::id())),
            None => beside(),
        };
        let folder = std::path::absolute(&folder)
            .map_err(|error| Failure::system(format!("{}: {error}", folder.display())))?;
        let store = Store::local(&folder).map_err(|error| Failure::system(error.to_string()))?;
        Ok(Self { folder, store })
    }

    fn parts(&self) -> StoredParts {
        StoredParts::new(self.store.clone(), PARTS)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // What can't be deleted now is only in the way.
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

/// In this process, with parts beyond `memory_bytes` on disk.
fn solve_from_disk(
    flags: &AdjustFlags,
    options: &BundleOptions,
    whole: &mut WholeProblem,
    memory_bytes: u64,
) -> Result<BundleReport, Failure> {
    let scratch = Scratch::new(flags)?;
    let stored = adjustment::store_parts(whole, options, &scratch.parts()).map_err(stored_badly)?;
    whole.shards.0.iter_mut().for_each(|shard| shard.observations = Vec::new());
    let mut worker = PartWorker::new(stored.side.clone(), Some(Arc::new(scratch.parts())), memory_bytes);
    for index in 0..stored.weights.len() as u32 {
        worker.take_stored(index).map_err(failed)?;
    }
    stored.solve(&mut LocalHost(worker), whole).map_err(failed)
}

/// With parts held by worker processes of this machine.
fn solve_on_workers(
    flags: &AdjustFlags,
    options: &BundleOptions,
    whole: &mut WholeProblem,
) -> Result<BundleReport, Failure> {
    log::to_stderr();
    let scratch = Scratch::new(flags)?;
    let stored = adjustment::store_parts(whole, options, &scratch.parts()).map_err(stored_badly)?;
    whole.shards.0.iter_mut().for_each(|shard| shard.observations = Vec::new());
    let runtime = service::reactor()?;
    let token = Token::random().map_err(|error| Failure::system(format!("no token can be made: {error}")))?;
    let listener = runtime.block_on(service::bind(([127, 0, 0, 1], 0).into()))?;
    let address = listener
        .local_addr()
        .map_err(|error| Failure::system(format!("the listener has no address: {error}")))?;
    let count = std::num::NonZeroU32::new(flags.workers);
    let Share { threads, memory_bytes, .. } = Share::resolve(count, flags.threads, flags.memory);
    let program = std::env::current_exe()
        .map_err(|error| Failure::system(format!("this program can't be found to start workers: {error}")))?;
    let arguments = [
        "hold".to_owned(),
        format!("--coordinator=http://{address}"),
        format!("--scratch={}", scratch.folder.display()),
        format!("--threads={threads}"),
        format!("--memory={memory_bytes}"),
        format!("--parent={}", std::process::id()),
    ];
    let local = LocalOptions {
        program,
        arguments: arguments.into(),
        count: flags.workers,
        token: token.clone(),
        logs: scratch.folder.join("logs"),
    };
    let workers = LocalWorkers::start(&local, |_| {})?;
    let remote = RemoteOptions { holders: flags.workers, token: Some(token), patience: PATIENCE };
    let weights = stored.weights.clone();
    let mut host =
        RemoteHost::start(runtime.handle().clone(), listener, stored.side.clone(), weights, remote)?;
    let result = stored.solve(&mut host, whole).map_err(failed);
    drop(host);
    workers.stop(Duration::from_secs(2));
    runtime.shutdown_background();
    result
}

/// Holds parts until the solver is done.
pub fn hold(flags: HoldFlags) -> Result<(), Failure> {
    log::to_stderr();
    if let Some(parent) = flags.parent {
        die_with_parent(parent)?;
    }
    let Share { threads, memory_bytes, .. } = Share::alone(flags.threads, flags.memory);
    let built = rayon::ThreadPoolBuilder::new().num_threads(threads as usize).build_global();
    built.map_err(|error| Failure::system(format!("no threads can be had: {error}")))?;
    let store = Store::local(&flags.scratch).map_err(|error| Failure::system(error.to_string()))?;
    let options = HolderOptions {
        endpoint: service::endpoint(&flags.remote)?,
        name: flags.name,
        memory_bytes,
        store: Arc::new(StoredParts::new(store, PARTS)),
    };
    service::reactor()?.block_on(terrane_cluster::adjustment::hold(options)).map_err(Failure::from)
}

fn failed(error: BundleError) -> Failure {
    let message = with_causes(&error);
    if error.is_invalid_input() { Failure::input(message) } else { Failure::system(message) }
}

fn stored_badly(error: terrane_pipeline::PipelineError) -> Failure {
    if error.is_invalid_input() {
        Failure::input(error.to_string())
    } else {
        Failure::system(error.to_string())
    }
}

/// What is told at the end.
struct Outcome<'a> {
    whole: &'a WholeProblem,
    report: &'a BundleReport,
    before: ResidualFigures,
    after: ResidualFigures,
    read_seconds: f64,
    solve_seconds: f64,
}

impl Outcome<'_> {
    fn termination(&self) -> String {
        name_of(&self.report.termination)
    }

    fn as_json(&self) -> serde_json::Value {
        let figures = |f: &ResidualFigures| {
            serde_json::json!({
                "observations": f.observations,
                "not_projected": f.not_projected,
                "squared_cost": f.squared_cost,
                "mean_error_px": f.mean_error_px(),
            })
        };
        serde_json::json!({
            "event": "adjust",
            "report": self.report,
            "cameras": self.whole.problem.poses.len(),
            "points": self.whole.shards.0.iter().map(|shard| shard.points.len()).sum::<usize>(),
            "before": figures(&self.before),
            "after": figures(&self.after),
            "read_seconds": self.read_seconds,
            "solve_seconds": self.solve_seconds,
            "peak_bytes": peak_resident_bytes().unwrap_or(0),
        })
    }

    fn as_text(&self) -> String {
        let (report, before, after) = (self.report, &self.before, &self.after);
        let mut text = format!(
            "cameras        {}\npoints         {}\nobservations   {}\n",
            self.whole.problem.poses.len(),
            report.points,
            report.observations,
        );
        for (count, why) in [
            (report.behind_camera, "start behind their camera"),
            (report.seen_once, "are of points seen only once"),
        ] {
            if count > 0 {
                text.push_str(&format!("left out       {count} that {why}\n"));
            }
        }
        if !report.unconstrained_poses.is_empty() {
            text.push_str(&format!(
                "held           {} cameras that see no point that another sees\n",
                report.unconstrained_poses.len()
            ));
        }
        text.push_str(&format!("cost           {:.6e} -> {:.10e}\n", report.initial_cost, report.final_cost));
        text.push_str(&format!(
            "mean error     {:.3} px -> {:.3} px\n",
            before.mean_error_px(),
            after.mean_error_px()
        ));
        let solver = match report.linear_iterations {
            0 => name_of(&report.solver),
            n => format!(
                "{}, {n} iterations of conjugate gradients on {} clusters",
                name_of(&report.solver),
                report.clusters
            ),
        };
        text.push_str(&format!("steps          {} of {} tried\n", report.accepted_steps, report.iterations));
        text.push_str(&format!("solver         {solver}\nstopped        {}\n", self.termination()));
        text.push_str(&format!(
            "time           {:.2} s to read, {:.2} s to solve\npeak memory    {} MiB\n",
            self.read_seconds,
            self.solve_seconds,
            peak_resident_bytes().unwrap_or(0) >> 20
        ));
        text
    }
}

/// A name as options and reports write it, with dashes.
fn name_of(value: &impl serde::Serialize) -> String {
    serde_json::to_value(value)
        .ok()
        .and_then(|v| v.as_str().map(|text| text.replace('_', "-")))
        .unwrap_or_default()
}
