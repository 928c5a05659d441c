//! The report as one self-contained HTML page.

use std::path::Path;

use run_log::misses::Cause;

use super::report::{COLUMNS, StressReport, Tested, causes, comparison, yes_or_no};
use crate::machine::{Finding, Grade};
use crate::report::axis::duration_label;

const STYLE: &str = "
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1180px; padding: 0 1em; color: #222; }
h1 { font-size: 1.5em; } h2 { font-size: 1.2em; margin-top: 2em; }
table { border-collapse: collapse; font-size: 13px; } th, td { padding: 3px 9px; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child, td.text, th.text { text-align: left; } td:not(.text):not(:first-child) { white-space: nowrap; } tr.bad td { background: #fbe3dc; }
.wide { overflow-x: auto; } svg { max-width: 100%; height: auto; } .note { color: #555; }
";

/// The page, with the folder's figures embedded.
pub fn html(report: &StressReport, old: Option<&StressReport>, folder: &Path) -> String {
    let mut text = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\"><title>Stress test: {scene}</title>\n<style>{STYLE}</style></head><body>\n<h1>Stress test: {scene}</h1>\n{}",
        head(report),
        scene = escape(&report.scene),
    );
    text += &results(report);
    if let Some(old) = old {
        text += &changes(old, report);
    }
    text += "<h2>Map</h2>\n";
    text += &picture(folder, "map.svg");
    text += &quantiles(report);
    let letters = Cause::ALL.map(|cause| format!("{} {}", cause.letter(), cause.name())).join(", ");
    text += &format!("<h2>Combinations</h2>\n<p class=\"note\">Letters beside the marks: {letters}.</p>\n");
    for tested in &report.tested {
        text += &one(tested, folder);
    }
    text += &machine(report);
    text += "</body></html>\n";
    text
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn cells(tag: &str, values: impl IntoIterator<Item = String>) -> String {
    values.into_iter().map(|value| format!("<{tag}>{}</{tag}>", escape(&value))).collect()
}

fn head(report: &StressReport) -> String {
    let facts = &report.machine;
    let steal = report.tested.iter().map(|tested| tested.stolen_percent).fold(0.0, f64::max);
    let done = if report.tested.len() == report.planned {
        format!("{} combination{}", report.planned, if report.planned == 1 { "" } else { "s" })
    } else {
        format!("{} of {} combinations, then interrupted", report.tested.len(), report.planned)
    };
    let explained = report.explained().map_or(String::new(), |share| format!("<p>{share}.</p>\n"));
    let quota = report.quota_percent.map_or(String::new(), |percent| format!(", CPU quota {percent} %"));
    format!(
        "<p>{done} of {} s each, seed {}{quota}, begun {}, trabecula {}.</p>\n<p>{}, {} cores, {}; up to {steal:.2} % of the machine stolen during a run.</p>\n{explained}",
        report.seconds,
        report.seed,
        escape(&report.began),
        escape(&report.trabecula),
        escape(&facts.processor),
        facts.cores,
        escape(&facts.kernel),
    )
}

fn results(report: &StressReport) -> String {
    let mut text = String::from("<h2>Results</h2>\n<div class=\"wide\"><table>\n<tr>");
    let titles = [
        "combination",
        "late p50",
        "p99",
        "p99.9",
        "max",
        "missed",
        "on time*",
        "confirmed",
        "real time",
        "DRR/s",
        "frame age p50",
        "drops",
        "log complete",
        "replays",
        "stolen",
        "late because",
    ];
    text += &cells("th", titles.map(str::to_owned));
    text += "</tr>\n";
    for Tested { combination, measured: m, stolen_percent, failure, .. } in &report.tested {
        let late = |of: fn(&crate::report::distribution::Quantiles) -> f64| {
            m.lateness_us.map_or("–".to_owned(), |q| duration_label(of(&q)))
        };
        let number = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.2}"));
        let percent =
            |share: Option<f64>| share.map_or("–".to_owned(), |share| format!("{:.1} %", 100.0 * share));
        let bad = failure.is_some() || !m.replays || !m.log_complete;
        text += if bad { "<tr class=\"bad\">" } else { "<tr>" };
        let values = [
            combination.to_string(),
            late(|q| q.p50),
            late(|q| q.p99),
            late(|q| q.p99_9),
            late(|q| q.max),
            m.missed.to_string(),
            format!("{:.2} %", 100.0 * m.on_time_share),
            percent(m.misses.confirmed_share),
            number(m.real_time_factor),
            number(m.frames_per_s),
            m.frame_age_us.map_or("–".to_owned(), |q| duration_label(q.p50)),
            m.dropped.to_string(),
            yes_or_no(m.log_complete).to_owned(),
            yes_or_no(m.replays).to_owned(),
            format!("{stolen_percent:.2} %"),
            failure.clone().unwrap_or_else(|| causes(m)),
        ];
        text += &cells("td", values);
        text += "</tr>\n";
    }
    text += "</table></div>\n<p class=\"note\">* of the ticks that no hypervisor held up. A miss is a tick that begins more than a period late. Confirmed: of the lost time, what readings name a cause for.</p>\n";
    text
}

fn quantiles(report: &StressReport) -> String {
    let mut text = String::from("<h2>Distributions</h2>\n<div class=\"wide\"><table>\n<tr>");
    let titles = ["combination", "of", "count", "p50", "p90", "p99", "p99.9", "max"];
    text += &cells("th", titles.map(str::to_owned));
    text += "</tr>\n";
    for tested in &report.tested {
        for (name, of) in COLUMNS {
            let Some(q) = of(&tested.measured) else { continue };
            let values = [q.p50, q.p90, q.p99, q.p99_9, q.max].map(duration_label);
            let first = [tested.combination.to_string(), name.replace('_', " "), q.count.to_string()];
            text += &format!("<tr>{}</tr>\n", cells("td", first.into_iter().chain(values)));
        }
    }
    text + "</table></div>\n"
}

fn changes(old: &StressReport, new: &StressReport) -> String {
    let mut text = format!("<h2>Change since {}</h2>\n<div class=\"wide\"><table>\n<tr>", escape(&old.began));
    let titles = ["combination", "late p50", "late p99", "step p50", "round trip p50", "missed"];
    text += &cells("th", titles.map(str::to_owned));
    text += "</tr>\n";
    for row in comparison(old, new) {
        text += &format!("<tr>{}</tr>\n", cells("td", row));
    }
    text + "</table></div>\n"
}

fn one(tested: &Tested, folder: &Path) -> String {
    let mut text = format!("<h3>{}</h3>\n", escape(&tested.combination.to_string()));
    let shares = tested.measured.processor_share.iter();
    let shares: Vec<String> = shares.map(|(name, share)| format!("{name} {:.1} %", 100.0 * share)).collect();
    text += &format!(
        "<p>Processor: {}; the machine was {:.0} % busy.</p>\n",
        escape(&shares.join(", ")),
        tested.busy_percent
    );
    let remarks = tested.not_permitted.iter().chain(&tested.measured.remarks).chain(&tested.failure);
    for remark in remarks {
        text += &format!("<p class=\"note\">{}</p>\n", escape(remark));
    }
    text + &picture(folder, &tested.figure)
}

/// The figure's SVG element, without the parts that only a standalone file needs.
fn picture(folder: &Path, name: &str) -> String {
    let svg = std::fs::read_to_string(folder.join(name)).unwrap_or_default();
    svg.find("<svg").map_or(String::new(), |at| format!("{}\n", &svg[at..]))
}

fn machine(report: &StressReport) -> String {
    let mut text = String::from("<h2>Machine</h2>\n<div class=\"wide\"><table>\n<tr>");
    for title in ["what", "state", "found", "costs where missing", "granted by"] {
        text += &format!("<th class=\"text\">{title}</th>");
    }
    text += "</tr>\n";
    for Finding { name, grade, found, cost, grant } in &report.machine.findings {
        let grade = match grade {
            Grade::Good => "good",
            Grade::Limited => "limited",
            Grade::Missing => "missing",
        };
        let values = [name.clone(), grade.to_owned(), found.clone(), cost.clone(), grant.clone()];
        let values: String =
            values.iter().map(|value| format!("<td class=\"text\">{}</td>", escape(value))).collect();
        text += &format!("<tr>{values}</tr>\n");
    }
    text + "</table></div>\n"
}
