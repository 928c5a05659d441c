//! Sensitivity of a sweep's results to its parameters.

use figures::{Axis, COLOURS, Figure, FigureError, HEAD, Panel, Point};
use serde::Serialize;
use serde_json::Value;
use sweep::{Design, Index, Study, indices, spearman};

use super::row::{Ending, FIGURES, Row};
use crate::failure::Failure;

/// How a result depends on each parameter; serialized for `--json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sensitivity {
    pub figure: String,
    pub rows: RowCount,
    pub lowest: f64,
    pub mean: f64,
    pub highest: f64,
    pub parameters: Vec<Parameter>,
    /// Results for each value of a non-numeric parameter.
    pub groups: Vec<Group>,
    /// Samples of a Saltelli design with the result missing in one of their rows.
    pub samples_left_out: usize,
}

/// Number of rows with a result, and of all rows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RowCount {
    with: usize,
    all: usize,
}

/// How a result depends on a parameter.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Parameter {
    key: String,
    rank_correlation: Option<f64>,
    /// Indices of a Saltelli design.
    sobol: Option<Index>,
}

/// The runs with one value of a parameter, and their results.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Group {
    key: String,
    value: Value,
    runs: usize,
    lowest: f64,
    median: f64,
    highest: f64,
}

impl Group {
    /// Returns the setting as written in a scene.
    fn name(&self) -> String {
        match &self.value {
            Value::String(text) => format!("{} = {text}", self.key),
            value => format!("{} = {value}", self.key),
        }
    }
}

/// Rejects an unknown result name.
pub fn check_figure(name: &str) -> Result<(), Failure> {
    let names = FIGURES.map(|(figure, _)| figure);
    match names.contains(&name) {
        true => Ok(()),
        false => {
            let names = names.join(", ");
            Err(Failure::bad_input(format!("--of {name}: unknown result, expected one of {names}")))
        }
    }
}

/// Computes the sensitivity over the completed rows; `None` if there are none.
pub fn sensitivity(study: &Study, rows: &[Row], figure: &str) -> Option<Sensitivity> {
    let of = |row: &Row| row.figure(figure).filter(|_| row.outcome == Ending::Completed);
    let values: Vec<f64> = rows.iter().filter_map(of).collect();
    if values.is_empty() {
        return None;
    }
    let fold = |pick: fn(f64, f64) -> f64| values.iter().copied().reduce(pick).unwrap_or(f64::NAN);
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
        Parameter {
            key: (*key).to_owned(),
            rank_correlation: spearman(&pairs),
            sobol: found.get(place).copied(),
        }
    };
    Some(Sensitivity {
        figure: figure.to_owned(),
        rows: RowCount { with: values.len(), all: rows.len() },
        lowest: fold(f64::min),
        mean: values.iter().sum::<f64>() / values.len() as f64,
        highest: fold(f64::max),
        parameters: keys.iter().enumerate().map(parameter).collect(),
        groups: keys.iter().flat_map(|key| groups(key, rows, of)).collect(),
        samples_left_out: left_out,
    })
}

/// Groups rows by a parameter's values in order of first occurrence; empty if the parameter is numeric.
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
        Group {
            key: key.to_owned(),
            value: value.clone(),
            runs: figures.len(),
            lowest: figures[0],
            median: median(&figures),
            highest: figures[figures.len() - 1],
        }
    };
    found.into_iter().map(group).collect()
}

/// Returns the median of sorted numbers, at least one.
fn median(sorted: &[f64]) -> f64 {
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 { sorted[middle] } else { 0.5 * (sorted[middle - 1] + sorted[middle]) }
}

impl Sensitivity {
    /// Formats the sensitivity as text.
    pub fn text(&self) -> String {
        let Sensitivity {
            figure, rows: RowCount { with, all }, lowest, mean, highest, samples_left_out, ..
        } = self;
        let mut lines =
            vec![format!("{figure}: {lowest:.4} to {highest:.4}, mean {mean:.4}, in {with} of {all} rows")];
        if *samples_left_out > 0 {
            lines.push(format!(
                "{samples_left_out} samples have a run without it and are excluded from the indices"
            ));
        }
        let width = self.parameters.iter().map(|it| it.key.len()).max().unwrap_or(0).max("parameter".len());
        let has_indices = self.parameters.iter().any(|it| it.sobol.is_some());
        let indices = if has_indices { "  first order        total" } else { "" };
        lines.push(format!("{:width$}  rank correlation{indices}", "parameter"));
        for Parameter { key, rank_correlation, sobol } in &self.parameters {
            let rank = rank_correlation.map_or("-".to_owned(), |rank| format!("{rank:.3}"));
            let index = sobol.map_or(String::new(), |index| {
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
            "runs with", "count", "minimum", "median", "maximum"
        );
        let line = |(name, group): &(String, &Group)| {
            let Group { runs, lowest, median, highest, .. } = group;
            format!("{name:width$}  {runs:>6}  {lowest:>10.4}  {median:>10.4}  {highest:>10.4}")
        };
        core::iter::once(head).chain(named.iter().map(line)).collect()
    }
}

const PANEL_HEIGHT: f64 = 300.0;
/// Panels per row.
const COLUMNS: usize = 3;

/// Plots the result against each numeric parameter, with a disc for each completed row.
pub fn draw(study: &Study, rows: &[Row], figure: &str) -> Result<Figure, FigureError> {
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
    let title = format!("{figure}: {}", foreign_text::counted(completed, "run"));
    let mut picture = Figure::titled(HEAD + PANEL_HEIGHT * lines as f64, &title)?;
    let cells = picture.cells(columns, lines, 0.0);
    for (area, (key, points)) in cells.into_iter().zip(&clouds) {
        let x = Axis::over(key, points.iter().map(|point| point.0), 0.06, 4);
        let y = Axis::over(figure, points.iter().map(|point| point.1), 0.06, 5);
        let mut panel = Panel::new(&mut picture, area, "", x, y);
        points.iter().for_each(|point| panel.disc(*point, 3.0, COLOURS[0]));
        panel.finish();
    }
    Ok(picture)
}
