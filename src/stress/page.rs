//! The report as one self-contained HTML page.

use std::path::Path;

use askama::Template;
use figures::duration_label;
use run_log::misses::Cause;

use super::report::{COLUMNS, CombinationResult, StressReport, causes, comparison, yes_or_no};
use crate::machine::Grade;
use crate::report::distribution::Quantiles;

#[derive(Template)]
#[template(path = "stress.html")]
struct Page<'a> {
    report: &'a StressReport,
    done: String,
    quota: String,
    steal: String,
    /// The class of each row, and its cells.
    results: Vec<(&'static str, [String; 16])>,
    /// Start of the earlier test, and the changes since.
    changes: Option<(&'a str, Vec<[String; 6]>)>,
    map: String,
    distributions: Vec<[String; 8]>,
    letters: String,
    combinations: Vec<Section<'a>>,
}

/// The section of a combination.
struct Section<'a> {
    tested: &'a CombinationResult,
    processor: String,
    remarks: Vec<&'a str>,
    figure: String,
}

/// Renders the page with the folder's figures embedded.
pub fn html(
    report: &StressReport,
    old: Option<&StressReport>,
    folder: &Path,
) -> Result<String, askama::Error> {
    let steal = report.tested.iter().map(|tested| tested.stolen_percent).fold(0.0, f64::max);
    let page = Page {
        report,
        done: match (report.tested.len(), report.planned) {
            (1, 1) => "1 combination".to_owned(),
            (done, planned) if done == planned => format!("{planned} combinations"),
            (done, planned) => format!("{done} of {planned} combinations (interrupted)"),
        },
        quota: report.quota_percent.map_or(String::new(), |percent| format!(", CPU quota {percent} %")),
        steal: format!("{steal:.2}"),
        results: report.tested.iter().map(result).collect(),
        changes: old.map(|old| (old.began.as_str(), comparison(old, report))),
        map: picture(folder, "map.svg"),
        distributions: report.tested.iter().flat_map(distributions).collect(),
        letters: Cause::ALL.map(|cause| format!("{} {}", cause.letter(), cause.name())).join(", "),
        combinations: report.tested.iter().map(|tested| section(tested, folder)).collect(),
    };
    page.render()
}

fn result(tested: &CombinationResult) -> (&'static str, [String; 16]) {
    let CombinationResult { combination, measured: m, stolen_percent, failure, .. } = tested;
    let none = || "–".to_owned();
    let late = |of: fn(&Quantiles) -> f64| m.lateness_us.map_or_else(none, |q| duration_label(of(&q)));
    let number = |value: Option<f64>| value.map_or_else(none, |value| format!("{value:.2}"));
    let percent = |share: Option<f64>| share.map_or_else(none, |share| format!("{:.1} %", 100.0 * share));
    let cells = [
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
        m.frame_age_us.map_or_else(none, |q| duration_label(q.p50)),
        m.dropped.to_string(),
        yes_or_no(m.log_complete).to_owned(),
        yes_or_no(m.replays).to_owned(),
        format!("{stolen_percent:.2} %"),
        failure.clone().unwrap_or_else(|| causes(m)),
    ];
    (if failure.is_some() || !m.replays || !m.log_complete { "bad" } else { "" }, cells)
}

fn distributions(tested: &CombinationResult) -> impl Iterator<Item = [String; 8]> {
    COLUMNS.into_iter().filter_map(|(name, of)| {
        let q = of(&tested.measured)?;
        let [p50, p90, p99, p99_9, max] = q.values().map(duration_label);
        let name = name.replace('_', " ");
        Some([tested.combination.to_string(), name, q.count.to_string(), p50, p90, p99, p99_9, max])
    })
}

fn section<'a>(tested: &'a CombinationResult, folder: &Path) -> Section<'a> {
    let shares = tested.measured.processor_share.iter();
    let shares: Vec<String> = shares.map(|(name, share)| format!("{name} {:.1} %", 100.0 * share)).collect();
    let remarks = tested.not_permitted.iter().chain(&tested.measured.remarks).chain(&tested.failure);
    Section {
        tested,
        processor: shares.join(", "),
        remarks: remarks.map(String::as_str).collect(),
        figure: picture(folder, &tested.figure),
    }
}

/// Returns the figure's SVG element without the parts that only a standalone file needs.
fn picture(folder: &Path, name: &str) -> String {
    let svg = std::fs::read_to_string(folder.join(name)).unwrap_or_default();
    svg.find("<svg").map_or(String::new(), |at| svg[at..].to_owned())
}
