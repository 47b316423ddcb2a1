//! Progress for people and machines: bars with time left on a terminal, plain lines elsewhere, JSON lines on request.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use terrane_cluster::types::{LogPage, RunId, RunStatus, StageStatus};

/// Plain lines of a stage come at most this often while it works.
const PAUSE: Duration = Duration::from_secs(10);

/// Shows how a run stands.
pub struct Progress {
    run: RunId,
    shown: BTreeMap<String, (StageStatus, Instant)>,
    next_line: u64,
    mode: Mode,
}

enum Mode {
    Bars { all: MultiProgress, bars: BTreeMap<String, ProgressBar> },
    Lines,
    Json,
}

impl Progress {
    /// Bars when standard error is a terminal, lines elsewhere, JSON when asked for.
    pub fn new(run: RunId, json: bool) -> Self {
        let mode = match (json, std::io::stderr().is_terminal()) {
            (true, _) => Mode::Json,
            (false, true) => Mode::Bars { all: MultiProgress::new(), bars: BTreeMap::new() },
            (false, false) => Mode::Lines,
        };
        Self { run, shown: BTreeMap::new(), next_line: 0, mode }
    }

    /// Number of the first log line that was not shown yet.
    pub fn next_line(&self) -> u64 {
        self.next_line
    }

    /// Shows lines of the log.
    pub fn lines(&mut self, page: &LogPage) {
        self.next_line = page.next;
        for line in &page.lines {
            match &self.mode {
                // Fails only when the terminal is gone, and then nobody reads it.
                Mode::Bars { all, .. } => drop(all.println(&line.text)),
                Mode::Lines => eprintln!("{}", line.text),
                Mode::Json => println!(
                    "{}",
                    serde_json::json!({ "event": "log", "at_ms": line.at_ms, "text": line.text })
                ),
            }
        }
    }

    /// Shows how the run stands now.
    pub fn show(&mut self, status: &RunStatus) {
        for stage in status.stages.iter().filter(|stage| stage.total > 0) {
            let before = self.shown.get(&stage.stage);
            if before.is_some_and(|(old, _)| old == stage) {
                continue;
            }
            let over = stage.done >= stage.total;
            let due = before.is_none_or(|(old, at)| at.elapsed() >= PAUSE || (over && old.done < old.total));
            match &mut self.mode {
                Mode::Bars { all, bars } => show_bar(all, bars, stage),
                Mode::Lines if due => eprintln!("{}", line(stage)),
                Mode::Lines => continue,
                Mode::Json => println!("{}", json(self.run, stage)),
            }
            self.shown.insert(stage.stage.clone(), (stage.clone(), Instant::now()));
        }
    }

    /// Leaves the terminal as it should be.
    pub fn close(&mut self) {
        if let Mode::Bars { bars, .. } = &mut self.mode {
            for bar in bars.values().filter(|bar| !bar.is_finished()) {
                bar.abandon();
            }
        }
    }
}

fn show_bar(all: &MultiProgress, bars: &mut BTreeMap<String, ProgressBar>, stage: &StageStatus) {
    let bar = bars.entry(stage.stage.clone()).or_insert_with(|| {
        let bar = all.add(ProgressBar::new(stage.total));
        // The template is ours and fits; the plain bar is what remains if it ever did not.
        let template = "{prefix:>12} [{bar:32}] {pos}/{len} {elapsed_precise} {msg}";
        bar.set_style(
            ProgressStyle::with_template(template)
                .unwrap_or_else(|_| ProgressStyle::default_bar())
                .progress_chars("=> "),
        );
        bar.set_prefix(stage.stage.clone());
        bar.enable_steady_tick(Duration::from_millis(500));
        bar
    });
    bar.set_length(stage.total);
    bar.set_position(stage.done);
    if stage.done >= stage.total {
        bar.finish_with_message(remark(stage));
    } else {
        bar.set_message(format!("{:.0?} left{}", bar.eta(), remark(stage)));
    }
}

/// What is out of the ordinary.
fn remark(stage: &StageStatus) -> String {
    if stage.given_up > 0 { format!(" {} set aside", stage.given_up) } else { String::new() }
}

fn line(stage: &StageStatus) -> String {
    let running = if stage.running > 0 { format!(", {} running", stage.running) } else { String::new() };
    format!("{}: {} of {} done{running}{}", stage.stage, stage.done, stage.total, remark(stage))
}

fn json(run: RunId, stage: &StageStatus) -> serde_json::Value {
    serde_json::json!({
        "event": "progress",
        "run": run.0,
        "stage": stage.stage,
        "done": stage.done,
        "total": stage.total,
        "running": stage.running,
        "computed": stage.computed,
        "set_aside": stage.given_up,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_say_what_is_out_of_the_ordinary() {
        let stage =
            StageStatus { stage: "match".into(), done: 3, total: 9, running: 2, computed: 1, given_up: 1 };
        assert_eq!(line(&stage), "match: 3 of 9 done, 2 running 1 set aside");
        assert_eq!(json(RunId(4), &stage)["computed"], 1);
    }
}
