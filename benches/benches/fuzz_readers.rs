//! Damaged files by the million: images, EXIF and XMP. Counts panics, memory beyond a bound, and executions a second.
//!
//! `cargo bench -p terrane-benches --bench fuzz_readers -- [--executions N] [--seconds S] [--seed K] [--threads T]
//! [--target image|exif|xmp|all] [--json FILE] [--quick]`. A finding is printed with its target and number;
//! `--seed NUMBER --executions 1` repeats it. The same readers run a quarter of a million times in the tests.

use std::cell::Cell;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, bail};
use terrane_benches::table::{self, Bar, Row};
use terrane_frontend::{image, metadata};
use terrane_testkit::allocation::{Counting, peak_bytes};
use terrane_testkit::files;
use terrane_testkit::mutate::{Mutator, Specimen};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// What reading a damaged file of some kilobytes may take at most: one that claims to be packed as tightly as its format
/// allows takes a few megabytes.
const MAX_BYTES: u64 = 32 << 20;
const OPTIONS: image::DecodeOptions = image::DecodeOptions { max_pixels: 1_000_000, color: true };
const TARGETS: [&str; 3] = ["image", "exif", "xmp"];

thread_local! {
    /// Panics of this thread, also those that the reader catches.
    static PANICS: Cell<u64> = const { Cell::new(0) };
    static LAST_PANIC: Cell<String> = const { Cell::new(String::new()) };
}

struct Request {
    executions: u64,
    seconds: f64,
    seed: u64,
    threads: u64,
    target: Option<String>,
    json: Option<PathBuf>,
}

impl Request {
    fn from_args() -> anyhow::Result<Self> {
        let mut request = Self {
            executions: 12_000_000,
            seconds: f64::INFINITY,
            seed: 0,
            threads: 1,
            target: None,
            json: None,
        };
        let mut args = std::env::args().skip(1);
        while let Some(arg) = args.next() {
            if arg == "--bench" {
                continue;
            }
            if arg == "--quick" {
                request.executions = 300_000;
                continue;
            }
            let value = args.next().with_context(|| format!("{arg} needs a value"))?;
            match arg.as_str() {
                "--executions" => request.executions = value.parse()?,
                "--seconds" => request.seconds = value.parse()?,
                "--seed" => request.seed = value.parse()?,
                "--threads" => request.threads = value.parse()?,
                "--json" => request.json = Some(value.into()),
                "--target" if value == "all" => request.target = None,
                "--target" if TARGETS.contains(&value.as_str()) => request.target = Some(value),
                other => bail!("unknown flag or value {other} {value}"),
            }
        }
        Ok(request)
    }
}

/// What a target's executions came to.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    executions: u64,
    read: u64,
    caught_panics: u64,
    findings: u64,
    peak_bytes: u64,
    slowest_s: f64,
    seconds: f64,
}

fn main() -> anyhow::Result<()> {
    let request = Request::from_args()?;
    std::panic::set_hook(Box::new(|info| {
        PANICS.with(|panics| panics.set(panics.get() + 1));
        LAST_PANIC.with(|last| last.set(info.to_string().replace('\n', " ")));
    }));
    let targets: Vec<&str> =
        TARGETS.into_iter().filter(|name| request.target.as_deref().is_none_or(|t| t == *name)).collect();
    let mut rows = Vec::new();
    let mut findings = 0;
    for name in &targets {
        let share = request.executions / targets.len() as u64;
        let tally = hunt(name, share.max(1), request.seconds / targets.len() as f64, &request);
        findings += tally.findings;
        let figures = [
            ("executions", tally.executions as f64, ""),
            ("read without an error", tally.read as f64, ""),
            ("panics that escaped, or memory beyond the bound", tally.findings as f64, ""),
            ("panics of libraries, caught", tally.caught_panics as f64, ""),
            ("peak memory of one execution", tally.peak_bytes as f64 / 1024.0, "KiB"),
            ("slowest execution", tally.slowest_s * 1e3, "ms"),
            ("executions a second", tally.executions as f64 / tally.seconds, "/s"),
        ];
        for (what, value, unit) in figures {
            let bar = if what.contains("escaped") { Bar::AtMost(0.0) } else { Bar::None };
            let row = Row::new(format!("{name}: {what}"), Some(value), unit, bar)
                .command("cargo bench -p terrane-benches --bench fuzz_readers");
            table::print(&row);
            rows.push(row);
        }
    }
    if let Some(path) = &request.json {
        table::write_json(path, &rows)?;
    }
    if findings > 0 {
        bail!("{findings} findings, listed above");
    }
    Ok(())
}

fn specimens(target: &str) -> Vec<Specimen> {
    match target {
        "image" => files::image_specimens(),
        "exif" => files::exif_specimens(),
        _ => files::xmp_specimens(),
    }
}

fn hunt(target: &str, executions: u64, seconds: f64, request: &Request) -> Tally {
    let specimens = specimens(target);
    let mutator = Mutator::new(&specimens, files::words(), 4096);
    let started = Instant::now();
    let threads = request.threads.max(1);
    let tallies: Vec<Tally> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads)
            .map(|thread| {
                let (mutator, specimens) = (&mutator, &specimens);
                scope.spawn(move || {
                    let mut tally = Tally::default();
                    for k in (thread..executions).step_by(threads as usize) {
                        if started.elapsed().as_secs_f64() > seconds {
                            break;
                        }
                        execute(target, mutator, specimens, request.seed + k, &mut tally);
                    }
                    tally
                })
            })
            .collect();
        workers.into_iter().map(|worker| worker.join().unwrap_or_default()).collect()
    });
    let mut sum = Tally { seconds: started.elapsed().as_secs_f64(), ..Tally::default() };
    for tally in tallies {
        sum.executions += tally.executions;
        sum.read += tally.read;
        sum.caught_panics += tally.caught_panics;
        sum.findings += tally.findings;
        sum.peak_bytes = sum.peak_bytes.max(tally.peak_bytes);
        sum.slowest_s = sum.slowest_s.max(tally.slowest_s);
    }
    sum
}

fn execute(target: &str, mutator: &Mutator<'_>, specimens: &[Specimen], seed: u64, tally: &mut Tally) {
    let (index, mut bytes) = mutator.variant(seed);
    // Three of four PNG get right checksums, so that what lies behind them is reached.
    if !seed.is_multiple_of(4) && bytes.starts_with(b"\x89PNG") {
        files::mend_png(&mut bytes);
    }
    let name = &specimens[index].name;
    let before = PANICS.with(Cell::get);
    let read = || {
        let started = Instant::now();
        let (outcome, peak) = peak_bytes(|| {
            std::panic::catch_unwind(|| match target {
                "image" => image::decode(&bytes, &OPTIONS).is_ok(),
                _ => metadata::read(&bytes).is_ok_and(|metadata| metadata.make.is_some()),
            })
        });
        (outcome, peak, started.elapsed().as_secs_f64())
    };
    let (outcome, peak, mut seconds) = read();
    let panics = PANICS.with(Cell::get) - before;
    // A machine that does something else in between is no finding: what is slow is read again.
    for _ in 0..3 {
        if seconds > 0.1 {
            seconds = seconds.min(read().2);
        }
    }
    if seconds > 1.0 {
        println!("{target} {seed} ({name}): {} bytes take {seconds:.2} s", bytes.len());
    }
    tally.slowest_s = tally.slowest_s.max(seconds);
    tally.executions += 1;
    tally.peak_bytes = tally.peak_bytes.max(peak);
    match outcome {
        Ok(read) => {
            tally.read += u64::from(read);
            if panics > 0 {
                tally.caught_panics += 1;
                if tally.caught_panics <= 20 {
                    println!("{target} {seed} ({name}): caught: {}", LAST_PANIC.with(Cell::take));
                }
            }
        }
        Err(_) => {
            tally.findings += 1;
            println!("{target} {seed} ({name}): PANIC: {}", LAST_PANIC.with(Cell::take));
        }
    }
    if peak > MAX_BYTES {
        tally.findings += 1;
        println!("{target} {seed} ({name}): {} bytes of file take {peak} bytes of memory", bytes.len());
    }
}
