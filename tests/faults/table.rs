//! Results of all trials.

use std::collections::BTreeMap;
use std::fmt::Write;

use crate::fault::Fault;

/// Result of one trial.
#[derive(Debug, Default)]
pub struct Outcome {
    /// Whether the machine does not permit this fault.
    pub skipped: bool,
    /// Whether the run continued until the test stopped it; otherwise it ended with an error that names the
    /// cause.
    pub went_on: bool,
    /// From the fault to the error, in polls of 5 ms.
    pub named_after_looks: Option<u64>,
    /// The same in milliseconds.
    pub named_after_ms: Option<u64>,
    /// From the fault to the end of the last process, in milliseconds; only for runs that ended.
    pub over_after_ms: Option<u64>,
    /// Ticks in the log.
    pub ticks: u64,
    /// Ticks that were published before the fault but are not in the log.
    pub lost_before: u64,
    /// Messages lost according to the log's end marker.
    pub lost_counted: u64,
}

#[derive(Debug, Default)]
struct Row {
    trials: u64,
    skipped: u64,
    went_on: u64,
    named: u64,
    slowest_name_looks: u64,
    slowest_name_ms: u64,
    slowest_end_ms: u64,
    ticks: u64,
    lost_before: u64,
    lost_counted: u64,
}

impl Row {
    fn add(&mut self, other: &Row) {
        self.trials += other.trials;
        self.skipped += other.skipped;
        self.went_on += other.went_on;
        self.named += other.named;
        self.slowest_name_looks = self.slowest_name_looks.max(other.slowest_name_looks);
        self.slowest_name_ms = self.slowest_name_ms.max(other.slowest_name_ms);
        self.slowest_end_ms = self.slowest_end_ms.max(other.slowest_end_ms);
        self.ticks += other.ticks;
        self.lost_before = self.lost_before.max(other.lost_before);
        self.lost_counted += other.lost_counted;
    }
}

/// Rows by fault, in the order of their first trial.
#[derive(Debug, Default)]
pub struct Table(BTreeMap<String, Row>);

impl Table {
    pub fn add(&mut self, fault: Fault, outcome: Outcome) {
        let of_one = match outcome.skipped {
            true => Row { trials: 1, skipped: 1, ..Row::default() },
            false => Row {
                trials: 1,
                skipped: 0,
                went_on: u64::from(outcome.went_on),
                named: u64::from(!outcome.went_on),
                slowest_name_looks: outcome.named_after_looks.unwrap_or(0),
                slowest_name_ms: outcome.named_after_ms.unwrap_or(0),
                slowest_end_ms: outcome.over_after_ms.unwrap_or(0),
                ticks: outcome.ticks,
                lost_before: outcome.lost_before,
                lost_counted: outcome.lost_counted,
            },
        };
        self.0.entry(fault.name()).or_default().add(&of_one);
    }

    pub fn text(&self) -> String {
        let mut text = String::from(
            "\n| fault | trials | skipped | run went on | run ended | slowest error, looks of 5 ms | slowest error ms | slowest end ms | \
             ticks replayed | most published ticks lost | messages lost in all |\n|---|---|---|---|---|---|---|---|---|---|---|\n",
        );
        let mut sum = Row::default();
        for (name, row) in &self.0 {
            write_row(&mut text, name, row);
            sum.add(row);
        }
        write_row(&mut text, "all", &sum);
        text
    }
}

fn write_row(text: &mut String, name: &str, row: &Row) {
    let _ = writeln!(
        text,
        "| {name} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
        row.trials,
        row.skipped,
        row.went_on,
        row.named,
        row.slowest_name_looks,
        row.slowest_name_ms,
        row.slowest_end_ms,
        row.ticks,
        row.lost_before,
        row.lost_counted
    );
}
