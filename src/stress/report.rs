//! Results of a stress test as JSON, CSV and a table, and comparison with an earlier test.

use std::fmt;
use std::path::Path;

use figures::duration_label;
use run_log::misses::Cause;
use serde::{Deserialize, Serialize};

use super::measure::RunMeasurements;
use super::plan::{Combination, policy_name, wait_name};
use crate::failure::Failure;
use crate::machine::MachineFacts;
use crate::report::distribution::Quantiles;

/// A combination that was run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CombinationResult {
    /// What was run.
    pub combination: Combination,
    /// Its measurements.
    pub measured: RunMeasurements,
    /// Share of the machine's core time that was busy during the run, percent.
    pub busy_percent: f64,
    /// Share of the machine's core time stolen by the hypervisor during the run, percent.
    pub stolen_percent: f64,
    /// Why the run failed, if it did.
    pub failure: Option<String>,
    /// Requests that were not permitted.
    pub not_permitted: Vec<String>,
    /// Name of its figure.
    pub figure: String,
}

/// A stress test.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StressReport {
    /// Version of the program.
    pub trabecula: String,
    /// Scene.
    pub scene: String,
    /// Seconds of each run.
    pub seconds: f64,
    /// Seed of the loads and of the choice of a subset.
    pub seed: u64,
    /// CPU quota in percent of one core, if requested.
    pub quota_percent: Option<u64>,
    /// When the test began.
    pub began: String,
    /// The machine it ran on.
    pub machine: MachineFacts,
    /// Number of combinations planned.
    pub planned: usize,
    /// The combinations run so far, in order.
    pub tested: Vec<CombinationResult>,
}

/// A column of distributions: its name and its accessor.
type Column = (&'static str, fn(&RunMeasurements) -> Option<Quantiles>);

/// The distributions of a combination, µs.
pub const COLUMNS: [Column; 5] = [
    ("lateness", |m| m.lateness_us),
    ("step", |m| m.step_us),
    ("latch_age", |m| m.latch_age_us),
    ("round_trip", |m| m.round_trip_us),
    ("frame_age", |m| m.frame_age_us),
];

/// Share of the lost time with an identified cause.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExplainedShare {
    /// Share of the lost time with an identified cause.
    pub confirmed: f64,
    /// Time attributed to steal.
    pub stolen_ms: f64,
    /// Steal shown by the machine's own counter, `/proc/stat`, for the late ticks: an upper bound on
    /// `stolen_ms`.
    pub counter_ms: f64,
}

impl fmt::Display for ExplainedShare {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ExplainedShare { confirmed, stolen_ms, counter_ms } = self;
        write!(
            out,
            "the cause of {:.1} % of the lost time is confirmed by measurements; {stolen_ms:.1} ms of it \
             are steal time, and \
             /proc/stat shows {counter_ms:.0} ms of steal at the late ticks",
            100.0 * confirmed
        )
    }
}

impl StressReport {
    /// Reads the JSON of an earlier test.
    pub fn read(path: &Path) -> Result<StressReport, Failure> {
        let bad = |cause: String| {
            Failure::bad_input(format!(
                "--compare {}: {cause}; expected the stress.json of a stress test",
                path.display()
            ))
        };
        let text = ipc_types::text_file::read(path).map_err(|cause| bad(cause.to_string()))?;
        serde_json::from_str(&text).map_err(|cause| bad(cause.to_string()))
    }

    /// The whole report as JSON.
    pub fn json(&self) -> Result<String, Failure> {
        let json = serde_json::to_string_pretty(self).map_err(Failure::failed)?;
        Ok(format!("{json}\n"))
    }

    /// One row per combination. Times in µs; missing values are empty.
    pub fn csv(&self) -> String {
        let mut text = String::from(
            "cores,load,policy,wait,ticks,missed,on_time_share,confirmed_share,real_time_factor,frames_per_s,dropped,log_complete,replays,busy_percent,stolen_percent",
        );
        for (name, _) in COLUMNS {
            for quantile in ["p50", "p90", "p99", "p99_9", "max"] {
                text += &format!(",{name}_{quantile}_us");
            }
        }
        text.push('\n');
        let or_empty = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.4}"));
        for CombinationResult { combination, measured: m, busy_percent, stolen_percent, .. } in &self.tested {
            let Combination { cores, load, policy, wait } = combination;
            text += &format!(
                "{cores},{load},{},{},{},{},{:.6},{},{},{},{},{},{},{busy_percent:.2},{stolen_percent:.2}",
                policy_name(*policy),
                wait_name(*wait),
                m.ticks,
                m.missed,
                m.on_time_share,
                or_empty(m.misses.confirmed_share),
                or_empty(m.real_time_factor),
                or_empty(m.frames_per_s),
                m.dropped,
                yes_or_no(m.log_complete),
                yes_or_no(m.replays),
            );
            for (_, of) in COLUMNS {
                for value in of(m).map_or([None; 5], |q| q.values().map(Some)) {
                    text += &format!(",{}", value.map_or(String::new(), |value| format!("{value:.3}")));
                }
            }
            text.push('\n');
        }
        text
    }

    /// Summarises the lost time over all combinations; returns `None` without lost time.
    pub fn explained(&self) -> Option<ExplainedShare> {
        let all = || self.tested.iter().map(|tested| &tested.measured.misses);
        let lost = |of: &dyn Fn(&str) -> bool| -> f64 {
            let parts = all().flat_map(|misses| &misses.lost_ms);
            parts.filter(|(name, _)| of(name)).map(|(_, lost_ms)| lost_ms).sum()
        };
        let (total_ms, unknown_ms) = (lost(&|_| true), lost(&|name| name == Cause::Unknown.name()));
        let stolen_ms = lost(&|name| name == Cause::Stolen.name());
        let counter_ms: f64 = all().map(|misses| misses.steal_counter_ms).sum();
        (total_ms > 0.0).then(|| ExplainedShare {
            confirmed: 1.0 - unknown_ms / total_ms,
            stolen_ms,
            counter_ms,
        })
    }

    /// Returns the result for a combination.
    pub fn find(&self, combination: &Combination) -> Option<&CombinationResult> {
        self.tested.iter().find(|tested| tested.combination == *combination)
    }
}

/// `yes` or `no`.
pub fn yes_or_no(value: bool) -> &'static str {
    if value { "yes" } else { "no" }
}

/// `8 run queue, 4 stolen`, or a dash.
pub fn causes(measured: &RunMeasurements) -> String {
    let each = measured.misses.by_cause.iter().map(|(name, count)| format!("{count} {name}"));
    let text = each.collect::<Vec<_>>().join(", ");
    if text.is_empty() { "–".to_owned() } else { text }
}

/// The table for a terminal.
pub fn table(report: &StressReport) -> String {
    let mut text = format!(
        "{:<34} {:>8} {:>8} {:>8} {:>7} {:>8} {:>7} {:>6} {:>5} {:>7}  {}\n",
        "",
        "late p50",
        "p99",
        "max",
        "missed",
        "on time",
        "factor",
        "DRR/s",
        "drops",
        "replays",
        "late due to"
    );
    for CombinationResult { combination, measured: m, failure, .. } in &report.tested {
        let late =
            |of: fn(&Quantiles) -> f64| m.lateness_us.map_or("-".to_owned(), |q| duration_label(of(&q)));
        let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
        text += &format!(
            "{:<34} {:>8} {:>8} {:>8} {:>7} {:>7.2}% {:>7} {:>6} {:>5} {:>7}  {}\n",
            combination.to_string(),
            late(|q| q.p50),
            late(|q| q.p99),
            late(|q| q.max),
            m.missed,
            100.0 * m.on_time_share,
            number(m.real_time_factor),
            number(m.frames_per_s),
            m.dropped,
            yes_or_no(m.replays),
            failure.clone().unwrap_or_else(|| causes(m)),
        );
    }
    text
}

/// Returns the changes for each combination present in both tests.
pub fn comparison(old: &StressReport, new: &StressReport) -> Vec<[String; 6]> {
    let label = |us: Option<f64>| us.map_or("–".to_owned(), duration_label);
    let pair = |a: Option<f64>, b: Option<f64>| {
        let change = match (a, b) {
            (Some(a), Some(b)) if a > 0.0 => format!(" (x {:.2})", b / a),
            _ => String::new(),
        };
        format!("{} → {}{change}", label(a), label(b))
    };
    let rows = new.tested.iter().filter_map(|now| {
        let before = &old.find(&now.combination)?.measured;
        let m = &now.measured;
        Some([
            now.combination.to_string(),
            pair(before.lateness_us.map(|q| q.p50), m.lateness_us.map(|q| q.p50)),
            pair(before.lateness_us.map(|q| q.p99), m.lateness_us.map(|q| q.p99)),
            pair(before.step_us.map(|q| q.p50), m.step_us.map(|q| q.p50)),
            pair(before.round_trip_us.map(|q| q.p50), m.round_trip_us.map(|q| q.p50)),
            format!("{} → {}", before.missed, m.missed),
        ])
    });
    rows.collect()
}
