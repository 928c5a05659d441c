//! Comparison of two logs.

use std::collections::BTreeSet;

use ipc_types::messages::layout::Message;
use ipc_types::messages::{Latched, State, Tick};
use run_log::fields::Scalar;
use run_log::{Topic, difference};
use serde_json::{Value, json};

use super::file::{LogFile, PlayError};

/// Maximum number of rows in a comparison.
const MOST_ROWS: usize = 40;

/// Returns the first difference where two logs diverge: in the previous tick's command, or else in the state.
pub(super) fn first_difference(a: &LogFile, b: &LogFile, time_ns: u64) -> Result<String, PlayError> {
    let looks = [
        (Topic::Latched, Latched::DESCRIPTION, time_ns.saturating_sub(1)),
        (Topic::State, State::DESCRIPTION, time_ns),
    ];
    for (topic, description, time_ns) in looks {
        if let Some((a, b)) = a.newest(topic, time_ns)?.zip(b.newest(topic, time_ns)?)
            && let Some(found) = difference::compare(topic, Tick::START, description, a.body(), b.body())
            && let Some(difference) = found.differences.first()
        {
            return Ok(format!("; {topic}: {difference}"));
        }
    }
    Ok(String::new())
}

/// Returns the fields in which two states differ, at most [`MOST_ROWS`]. The state's own fields come before
/// those of its poses and contacts; within each group the largest relative difference comes first. An array
/// is represented by its most different element.
fn differing_fields(a: &[u8], b: &[u8]) -> Vec<Value> {
    let number = |scalar: Option<Scalar>| scalar.map(Scalar::nearest_f64);
    let mut rows: Vec<(f64, String, f64, f64)> = difference::all_differences(State::DESCRIPTION, a, b)
        .into_iter()
        .filter(|difference| !difference.path.starts_with("hash["))
        .filter_map(|found| {
            let (a, b) = number(found.recorded).zip(number(found.replayed))?;
            let relative = if a == b { 0.0 } else { (b - a).abs() / a.abs().max(b.abs()) };
            Some((relative, found.path, a, b))
        })
        .collect();
    let nested = |row: &(f64, String, f64, f64)| row.1.contains('.');
    // A stable sort keeps equal rows in field order.
    rows.sort_by(|one, other| nested(one).cmp(&nested(other)).then(other.0.total_cmp(&one.0)));
    let mut seen = BTreeSet::new();
    rows.retain(|row| seen.insert(row.1.replace(|c: char| c.is_ascii_digit(), "")));
    rows.truncate(MOST_ROWS);
    let row =
        |(_, name, a, b): (f64, String, f64, f64)| json!({"name": name, "a": a, "b": b, "difference": b - a});
    rows.into_iter().map(row).collect()
}

/// Returns the comparison at a time: the differing fields, or which of the logs has already ended.
pub(super) fn comparison(a: &LogFile, b: &LogFile, now: u64) -> Result<Value, PlayError> {
    let ended = |log: &LogFile| log.bounds_ns().1 < now;
    let (first, second) = (ended(a), ended(b));
    if first || second {
        let which = if first { "first" } else { "second" };
        let end_ns = if first { a.bounds_ns().1 } else { b.bounds_ns().1 };
        return Ok(json!({"time_ns": now, "ended": which, "end_ns": end_ns, "fields": []}));
    }
    let states = a.newest(Topic::State, now)?.zip(b.newest(Topic::State, now)?);
    let fields = states.map_or_else(Vec::new, |(a, b)| differing_fields(a.body(), b.body()));
    Ok(json!({"time_ns": now, "fields": fields}))
}
