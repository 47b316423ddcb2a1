//! The latest lines of the coordinator's log, for clients that ask.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use terrane_proto::types::{LogLine, LogPage};

/// Lines kept, and lines of a page.
const KEPT: usize = 4096;
const PAGE: usize = 256;

pub(super) struct Log {
    started: Instant,
    lines: Mutex<VecDeque<LogLine>>,
}

impl Log {
    pub(super) fn new() -> Self {
        Self { started: Instant::now(), lines: Mutex::new(VecDeque::new()) }
    }

    pub(super) fn elapsed_ms(&self) -> u64 {
        u64::try_from(self.started.elapsed().as_millis()).unwrap_or(u64::MAX)
    }

    pub(super) fn add(&self, text: String) {
        tracing::info!("{text}");
        let at_ms = self.elapsed_ms();
        let mut lines = self.lines.lock().unwrap_or_else(PoisonError::into_inner);
        let number = lines.back().map_or(0, |line| line.number + 1);
        if lines.len() == KEPT {
            lines.pop_front();
        }
        lines.push_back(LogLine { number, at_ms, text });
    }

    pub(super) fn page(&self, from: u64) -> LogPage {
        let lines = self.lines.lock().unwrap_or_else(PoisonError::into_inner);
        let page: Vec<LogLine> =
            lines.iter().filter(|line| line.number >= from).take(PAGE).cloned().collect();
        let next = page.last().map_or(from, |line| line.number + 1);
        LogPage { lines: page, next }
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn pages_follow_each_other_and_old_lines_go() {
        let log = super::Log::new();
        for number in 0..super::KEPT + 10 {
            log.add(number.to_string());
        }
        let first = log.page(0);
        assert_eq!((first.lines[0].number, first.lines.len()), (10, super::PAGE));
        assert_eq!(log.page(first.next).lines[0].number, first.next);
        let end = (super::KEPT + 10) as u64;
        assert_eq!((log.page(end).lines.len(), log.page(end).next), (0, end));
    }
}
