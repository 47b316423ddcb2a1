//! Rows of figures: printed for people, written for machines.

use std::path::Path;

use serde::Serialize;

/// One figure beside its bar.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// What was measured.
    pub figure: String,
    /// What came out; absent when it could not be measured.
    pub got: Option<f64>,
    /// Its unit.
    pub unit: String,
    /// What was asked for, as text: `<= 10`.
    pub bar: String,
    /// Whether the bar holds; absent when there is none or nothing was measured.
    pub holds: Option<bool>,
    /// What repeats it.
    pub command: String,
    /// What else belongs to it.
    pub note: String,
}

/// What a figure must satisfy.
#[derive(Clone, Copy, Debug)]
pub enum Bar {
    /// At most this.
    AtMost(f64),
    /// At least this.
    AtLeast(f64),
    /// Printed for information.
    None,
}

impl Row {
    /// A figure against its bar.
    pub fn new(figure: impl Into<String>, got: Option<f64>, unit: &str, bar: Bar) -> Self {
        let (text, holds) = match bar {
            Bar::AtMost(limit) => (format!("<= {limit}"), got.map(|value| value <= limit)),
            Bar::AtLeast(limit) => (format!(">= {limit}"), got.map(|value| value >= limit)),
            Bar::None => (String::new(), None),
        };
        Self {
            figure: figure.into(),
            got,
            unit: unit.into(),
            bar: text,
            holds,
            command: String::new(),
            note: String::new(),
        }
    }

    /// The row with the command that repeats it.
    pub fn command(mut self, command: &str) -> Self {
        self.command = command.into();
        self
    }

    /// The row with a note.
    pub fn note(mut self, note: impl Into<String>) -> Self {
        self.note = note.into();
        self
    }
}

/// Prints one row as it becomes known.
pub fn print(row: &Row) {
    let got = row.got.map_or("not measured".into(), |value| format!("{value:.4}"));
    let verdict = match row.holds {
        Some(true) => "holds",
        Some(false) => "FALLS SHORT",
        None => "",
    };
    println!("{:<58} {got:>12} {:<6} {:<10} {verdict:<12} {}", row.figure, row.unit, row.bar, row.note);
}

/// Writes all rows as JSON.
///
/// # Errors
/// When the file can't be written.
pub fn write_json(path: &Path, rows: &[Row]) -> anyhow::Result<()> {
    std::fs::write(path, serde_json::to_string_pretty(rows)?)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bars_are_inclusive_and_absence_is_not_success() {
        assert_eq!(Row::new("a", Some(10.0), "mm", Bar::AtMost(10.0)).holds, Some(true));
        assert_eq!(Row::new("a", Some(10.1), "mm", Bar::AtMost(10.0)).holds, Some(false));
        assert_eq!(Row::new("a", Some(9.0), "", Bar::AtLeast(10.0)).holds, Some(false));
        assert_eq!(Row::new("a", None, "", Bar::AtLeast(10.0)).holds, None);
        assert_eq!(Row::new("a", Some(1.0), "", Bar::None).holds, None);
    }
}
