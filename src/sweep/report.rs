//! What the rows of a sweep say about its parameters.

use serde_json::{Value, json};
use sweep::{Design, Index, Study, indices, spearman};

use super::row::{Ending, FIGURES, Row};
use crate::failure::Failure;
use crate::report::ReportError;
use crate::report::axis::{Axis, bounds};
use crate::report::panel::{COLOURS, Panel};
use crate::report::shapes::{Figure, HEAD, Point};

/// How a figure depends on each parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensitivity {
    /// The figure.
    pub figure: String,
    /// Rows with this figure, of all.
    pub rows: [usize; 2],
    /// Lowest, mean and highest value.
    pub range: [f64; 3],
    /// By parameter: rank correlation; Sobol indices of a Saltelli design.
    pub parameters: Vec<(String, Option<f64>, Option<Index>)>,
    /// What the runs gave with each value of a parameter that is no number.
    pub groups: Vec<Group>,
    /// Samples of a Saltelli design without the figure in one of their rows.
    pub left_out: usize,
}

/// The runs with one value of a parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// The parameter.
    pub key: String,
    /// Its value.
    pub value: Value,
    /// How many runs.
    pub runs: usize,
    /// Lowest, median and highest value of the figure.
    pub range: [f64; 3],
}

impl Group {
    /// As in a scene.
    fn name(&self) -> String {
        match &self.value {
            Value::String(text) => format!("{} = {text}", self.key),
            value => format!("{} = {value}", self.key),
        }
    }
}

/// Refuses a name that no row has.
///
/// # Errors
/// Bad input: names the figures.
pub fn check_figure(name: &str) -> Result<(), Failure> {
    if FIGURES.contains(&name) {
        return Ok(());
    }
    Err(Failure::bad_input(format!(
        "--of {name}: no figure of a row, expected one of {}",
        FIGURES.join(", ")
    )))
}

/// Of the rows that completed. `None` without any.
pub fn sensitivity(study: &Study, rows: &[Row], figure: &str) -> Option<Sensitivity> {
    let of = |row: &Row| row.figure(figure).filter(|_| row.outcome == Ending::Completed);
    let values: Vec<f64> = rows.iter().filter_map(of).collect();
    if values.is_empty() {
        return None;
    }
    let fold = |pick: fn(f64, f64) -> f64| values.iter().copied().reduce(pick).unwrap_or(f64::NAN);
    let range = [fold(f64::min), values.iter().sum::<f64>() / values.len() as f64, fold(f64::max)];
    let keys = study.keys();
    let sobol = (study.design == Design::Saltelli).then(|| {
        let mut results = vec![None; study.count() as usize];
        rows.iter().for_each(|row| results[row.point as usize] = of(row));
        indices(&results, keys.len())
    });
    let (found, left_out) = sobol.flatten().unwrap_or_default();
    let parameter = |(place, key): (usize, &&str)| {
        let pairs: Vec<(f64, f64)> =
            rows.iter().filter_map(|row| Some((row.parameter(key)?, of(row)?))).collect();
        ((*key).to_owned(), spearman(&pairs), found.get(place).copied())
    };
    Some(Sensitivity {
        figure: figure.to_owned(),
        rows: [values.len(), rows.len()],
        range,
        parameters: keys.iter().enumerate().map(parameter).collect(),
        groups: keys.iter().flat_map(|key| groups(key, rows, of)).collect(),
        left_out,
    })
}

/// The values of a parameter in the order in which they first occur; none if it is a number.
fn groups(key: &str, rows: &[Row], of: impl Fn(&Row) -> Option<f64>) -> Vec<Group> {
    let mut found: Vec<(&Value, Vec<f64>)> = Vec::new();
    for (value, figure) in rows.iter().filter_map(|row| Some((row.value(key)?, of(row)?))) {
        match found.iter_mut().find(|(known, _)| *known == value) {
            Some((_, figures)) => figures.push(figure),
            None => found.push((value, vec![figure])),
        }
    }
    if found.iter().all(|(value, _)| value.is_number()) {
        return Vec::new();
    }
    let group = |(value, mut figures): (&Value, Vec<f64>)| {
        figures.sort_by(f64::total_cmp);
        let range = [figures[0], median(&figures), figures[figures.len() - 1]];
        Group { key: key.to_owned(), value: value.clone(), runs: figures.len(), range }
    };
    found.into_iter().map(group).collect()
}

/// Of sorted numbers, at least one.
fn median(sorted: &[f64]) -> f64 {
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 { sorted[middle] } else { 0.5 * (sorted[middle - 1] + sorted[middle]) }
}

impl Sensitivity {
    /// For people.
    pub fn text(&self) -> String {
        let [low, mean, high] = self.range;
        let [with, all] = self.rows;
        let mut lines =
            vec![format!("{}: {low:.4} to {high:.4}, mean {mean:.4}, of {with} of {all} rows", self.figure)];
        if self.left_out > 0 {
            lines.push(format!(
                "{} samples have a run without it and are left out of the indices",
                self.left_out
            ));
        }
        let width =
            self.parameters.iter().map(|(key, ..)| key.len()).max().unwrap_or(0).max("parameter".len());
        let has_indices = self.parameters.iter().any(|(.., index)| index.is_some());
        let indices = if has_indices { "  first order        total" } else { "" };
        lines.push(format!("{:width$}  rank correlation{indices}", "parameter"));
        for (key, rank, index) in &self.parameters {
            let rank = rank.map_or("-".to_owned(), |rank| format!("{rank:.3}"));
            let index = index.map_or(String::new(), |index| {
                format!(
                    "  {:6.3} ± {:.3}  {:6.3} ± {:.3}",
                    index.first_order, index.first_order_interval, index.total, index.total_interval
                )
            });
            lines.push(format!("{key:width$}  {rank:>16}{index}"));
        }
        lines.extend(self.group_lines());
        lines.join("\n")
    }

    fn group_lines(&self) -> Vec<String> {
        let named: Vec<(String, &Group)> = self.groups.iter().map(|group| (group.name(), group)).collect();
        let Some(width) = named.iter().map(|(name, _)| name.len()).max() else { return Vec::new() };
        let head = format!(
            "{:width$}  {:>6}  {:>10}  {:>10}  {:>10}",
            "runs with", "number", "lowest", "median", "highest"
        );
        let line = |(name, group): &(String, &Group)| {
            let [low, median, high] = group.range;
            format!("{name:width$}  {:>6}  {low:>10.4}  {median:>10.4}  {high:>10.4}", group.runs)
        };
        core::iter::once(head).chain(named.iter().map(line)).collect()
    }

    /// For programs.
    pub fn json(&self) -> Value {
        let parameter = |(key, rank, index): &(String, Option<f64>, Option<Index>)| {
            let index = index.map(|index| {
                json!({
                    "first_order": index.first_order,
                    "first_order_interval": index.first_order_interval,
                    "total": index.total,
                    "total_interval": index.total_interval,
                })
            });
            json!({"key": key, "rank_correlation": rank, "sobol": index})
        };
        json!({
            "figure": self.figure,
            "rows": {"with": self.rows[0], "all": self.rows[1]},
            "lowest": self.range[0],
            "mean": self.range[1],
            "highest": self.range[2],
            "samples_left_out": self.left_out,
            "parameters": self.parameters.iter().map(parameter).collect::<Vec<_>>(),
            "groups": self.groups.iter().map(|group| json!({
                "key": group.key,
                "value": group.value,
                "runs": group.runs,
                "lowest": group.range[0],
                "median": group.range[1],
                "highest": group.range[2],
            })).collect::<Vec<_>>(),
        })
    }
}

const PANEL_HEIGHT: f64 = 300.0;
/// Panels in a row.
const COLUMNS: usize = 3;

/// A picture: the figure against each parameter that is a number, a disc for each row that completed.
///
/// # Errors
/// The built-in font is refused.
pub fn draw(study: &Study, rows: &[Row], figure: &str) -> Result<Figure, ReportError> {
    let of = |row: &Row| row.figure(figure).filter(|_| row.outcome == Ending::Completed);
    let clouds: Vec<(&str, Vec<Point>)> = study
        .keys()
        .into_iter()
        .map(|key| (key, rows.iter().filter_map(|row| Some((row.parameter(key)?, of(row)?))).collect()))
        .filter(|(_, points): &(&str, Vec<Point>)| !points.is_empty())
        .collect();
    let lines = clouds.len().div_ceil(COLUMNS).max(1);
    let columns = clouds.len().clamp(1, COLUMNS);
    let completed = rows.iter().filter(|row| of(row).is_some()).count();
    let title = format!("{figure}: {completed} runs");
    let mut picture = Figure::titled(HEAD + PANEL_HEIGHT * lines as f64, &title)?;
    let cells = picture.cells(columns, lines, 0.0);
    for (area, (key, points)) in cells.into_iter().zip(&clouds) {
        let around = |title: &str, values: Vec<f64>, ticks: usize| {
            let (low, high) = bounds(values.into_iter()).unwrap_or((0.0, 1.0));
            let margin = 0.06 * (high - low).max(1e-9);
            Axis::linear(title, low - margin, high + margin, ticks)
        };
        let x = around(key, points.iter().map(|point| point.0).collect(), 4);
        let y = around(figure, points.iter().map(|point| point.1).collect(), 5);
        let mut panel = Panel::new(&mut picture, area, "", x, y);
        points.iter().for_each(|point| panel.disc(*point, 3.0, COLOURS[0]));
        panel.finish();
    }
    Ok(picture)
}
