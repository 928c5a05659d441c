//! `trabecula plot LOG FIELD…`: plots fields of a log over simulated time.

use std::path::PathBuf;

use clap::Args;
use figures::{Axis, Figure, FigureError, HEAD, Panel, Point, Rect, Stroke, WIDTH};
use ipc_types::messages::{Tick, TickRange};
use recorder_proc::log_file::{LogFile, log_path};
use run_log::columns::{Column, columns, description_of_topic, read_rows};
use run_log::fields::Scalar;
use run_log::{LogError, Topic};

use super::log_name;
use crate::failure::Failure;
use crate::output::figure_place;
use crate::report::timeline::{Extremes, Timeline};

const PANEL_HEIGHT: f64 = 250.0;
/// Number of bins over the run. Each is drawn as its minimum and maximum, so that no peak is lost.
const BINS: usize = 2000;
/// Maximum number of lines per panel, and of panels per figure.
const MAX_LINES: usize = 8;
const MAX_PANELS: usize = 8;

/// Arguments of `plot`.
#[derive(Debug, Args)]
pub struct PlotArguments {
    /// `run.mcap`, `timing.mcap` or the folder of a run; `latest` is the newest run in `out`.
    #[arg(value_parser = log_name())]
    log: PathBuf,
    /// Fields, such as `tendon_tension_n[0]` or `t_world_tip.position_m`; one panel each.
    #[arg(required = true)]
    fields: Vec<String>,
    /// Topic that the fields belong to.
    #[arg(long, default_value = Topic::State.name())]
    topic: String,
    /// Path of the figure, with or without its extension; `.png` and `.svg` are written.
    #[arg(short, long, default_value = "plot")]
    output: PathBuf,
}

/// Draws the figure.
///
/// # Errors
/// A missing log or field, a figure that already exists (2), a damaged log, a full disk (1).
pub fn run(arguments: &PlotArguments) -> Result<(), Failure> {
    let log = log_path(&arguments.log);
    let description = description_of_topic(&LogFile::at(&log), &arguments.topic)?;
    if arguments.fields.len() > MAX_PANELS {
        let text =
            format!("{} fields given, expected at most {MAX_PANELS} per figure", arguments.fields.len());
        return Err(Failure::bad_input(text));
    }
    let place = figure_place(&arguments.output)?;
    let mut panels = Vec::new();
    for field in &arguments.fields {
        let mut chosen = columns(description, std::slice::from_ref(field))?;
        chosen.truncate(MAX_LINES);
        panels.push((field.as_str(), chosen));
    }
    let all: Vec<Column> = panels.iter().flat_map(|(_, columns)| columns.iter().cloned()).collect();
    let mut lines = vec![Timeline::new(BINS, 1_000_000, Extremes::EMPTY); all.len()];
    let mut add = |_: Tick, log_time_ns: u64, values: &[Scalar]| -> Result<(), LogError> {
        lines.iter_mut().zip(values).for_each(|(line, value)| line.bin(log_time_ns).add(value.nearest_f64()));
        Ok(())
    };
    read_rows(&LogFile::at(&log), &arguments.topic, &all, TickRange::ALL, &mut add)?;
    let title = format!("{}  {}", log.display(), arguments.topic);
    place.write(draw(&title, &panels, &lines))?;
    place.files.iter().for_each(|path| say!("{}", path.display()));
    Ok(())
}

fn draw(
    title: &str,
    panels: &[(&str, Vec<Column>)],
    lines: &[Timeline<Extremes>],
) -> Result<Figure, FigureError> {
    let height = HEAD + PANEL_HEIGHT * panels.len() as f64;
    let mut figure = Figure::titled(height, title)?;
    let mut rest = lines.iter();
    for (row, (field, columns)) in panels.iter().enumerate() {
        let outer = Rect { x: 0.0, y: HEAD + PANEL_HEIGHT * row as f64, width: WIDTH, height: PANEL_HEIGHT };
        let values: Vec<Vec<Point>> = rest.by_ref().take(columns.len()).map(points).collect();
        let of = |pick: fn(&Point) -> f64| values.iter().flatten().map(pick);
        let x = Axis::over("simulated time (s)", of(|p| p.0), 0.04, 5);
        let y = Axis::over("", of(|p| p.1), 0.04, 5);
        let mut panel = Panel::new(&mut figure, outer, field, x, y);
        for (index, (points, column)) in values.iter().zip(columns).enumerate() {
            let label = if columns.len() > 1 { column.name.as_str() } else { "" };
            panel.line(points, Stroke::of_palette(index, 1.4), label);
        }
        panel.finish();
    }
    Ok(figure)
}

/// Returns the minimum and maximum of each bin, alternating.
fn points(line: &Timeline<Extremes>) -> Vec<Point> {
    let both =
        |(time_s, bin): (f64, &Extremes)| {
            bin.range().map(|[low, _, high]| {
                if low == high { vec![(time_s, low)] } else { vec![(time_s, low), (time_s, high)] }
            })
        };
    line.iter().filter_map(both).flatten().collect()
}
