//! JSON output of the `log` commands.

use run_log::diff::DiffReport;
use run_log::difference::Divergence;
use run_log::repair::RepairReport;
use run_log::{LogInfo, Verdict, hash_text};
use serde_json::{Value, json};

/// A verdict: whether the log is intact, its faults as text, and how it ends.
pub(crate) fn of_verdict(verdict: &Verdict) -> Value {
    let faults = (!verdict.is_intact()).then(|| verdict.to_string());
    json!({"intact": verdict.is_intact(), "faults": faults, "ending": verdict.ending.describe()})
}

/// The summary of a log.
pub(super) fn of_log(log: &LogInfo) -> Value {
    let topics: serde_json::Map<String, Value> = log
        .topics
        .iter()
        .map(|(name, count)| {
            let lost = log.lost(name);
            (name.clone(), json!({"messages": count.messages, "bytes": count.bytes, "lost": lost}))
        })
        .collect();
    json!({
        "scene": log.header.scene_name,
        "mode": log.header.mode.name(),
        "metadata": log.metadata,
        "simulated_s": log.end_ns as f64 * 1e-9,
        "file_bytes": log.file_bytes,
        "bytes_per_simulated_s": log.bytes_per_second(),
        "last_hash": log.ending.marker.as_ref().and_then(|marker| marker.hash).map(hash_text),
        "missed_ticks": log.misses.missed(),
        "topics": topics,
        "fmus": super::fmus(log),
        "verdict": of_verdict(&log.verdict),
    })
}

/// The comparison of two logs.
pub(super) fn of_diff(report: &DiffReport) -> Value {
    let divergence = |found: &Divergence| {
        let fields: Vec<Value> = found
            .differences
            .iter()
            .map(|field| {
                let text = |value: Option<run_log::fields::Scalar>| value.map(|value| value.to_string());
                json!({"field": field.path, "first": text(field.recorded), "second": text(field.replayed), "ulp": field.ulps})
            })
            .collect();
        json!({"topic": found.topic.name(), "tick": found.tick.0, "differing_values": found.total, "fields": fields})
    };
    let all = report.ticks.iter().chain(&report.frames).chain(&report.messages);
    let header: Vec<Value> = report
        .header
        .iter()
        .map(|entry| json!({"name": entry.name, "first": entry.first, "second": entry.second}))
        .collect();
    json!({
        "same_run": report.same_run(),
        "identical_ticks": report.identical_ticks,
        "identical_frames": report.identical_frames,
        "header": header,
        "divergences": all.map(divergence).collect::<Vec<_>>(),
        "remarks": report.remarks,
        "verdicts": report.verdicts.each_ref().map(of_verdict),
    })
}

/// The report of a repair.
pub(super) fn of_repair(report: &RepairReport) -> Value {
    json!({
        "was_whole": report.was_whole(),
        "before": of_verdict(&report.before),
        "after": of_verdict(&report.after),
        "left_out_bytes": report.left_out_bytes,
        "undeclared_messages": report.undeclared,
        "complete_tick": report.complete_tick.map(|tick| tick.0),
        "last_tick": report.last_tick.map(|tick| tick.0),
    })
}
