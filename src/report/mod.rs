//! The report of a finished run (figures, numbers, a table), and the progress line of a running one.
//!
//! [`write()`] reads `run.mcap` and `timing.mcap` of a run folder once each, in bounded memory, and writes
//! next to them:
//!
//! | file | contents |
//! |---|---|
//! | `drr_before.png`, `drr_half.png`, `drr_after.png` | first, middle and last frame |
//! | `tip_path.png`, `.svg` | path of the burr's centre with the manipulator's shape; tension, bend and burr force over time |
//! | `timing.png`, `.svg` | step time over the run; distributions of step, lateness and round trip |
//! | `summary.json` | [`Summary`] |
//! | `report.html` | all of the above on one page, with warnings, scene and replay command |
//!
//! Each file is on disk before the next is started. From a truncated, damaged or missing log, everything
//! readable is reported, and its faults are listed in `LogSummary::notes`.

pub mod anatomy;
pub mod calibration_figure;
mod cautions;
pub mod course;
pub mod distribution;
mod end_table;
mod live;
pub mod outcome;
mod page;
mod run_lane;
mod summary;
mod table;
pub mod timing_figure;
mod timing_lane;
mod tip_figure;

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::Path;

use figures::FigureError;
use inputs::failure::Failure;
use ipc_types::messages::Tick;
use recorder_proc::ring_files::{open_logs, saved_logs};

pub use run_log::timeline;

pub use live::{LiveSnapshot, LiveStats, progress_line};
pub use outcome::{PlanSummary, StructureSummary};
pub use summary::{DrillingSummary, MissSummary, NOT_SHARED, Summary, ToolSummary};
pub use table::{History, json_line};

use anatomy::Anatomy;
use page::Picture;
use run_lane::RunLane;
use timing_lane::TimingLane;

/// The files that a run's report writes into its folder.
pub const FILES: [&str; 11] = [
    "run.mcap",
    "timing.mcap",
    "summary.json",
    "drr_before.png",
    "drr_half.png",
    "drr_after.png",
    "tip_path.png",
    "tip_path.svg",
    "timing.png",
    "timing.svg",
    "report.html",
];

/// Facts about a run that only the launcher knows.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RunFacts {
    /// Wall time from the first tick to the last.
    pub wall_s: f64,
    /// Wall time from the start to the first tick.
    pub startup_s: f64,
    /// Wall time of each phase of the run, by its name, s.
    pub phases_s: BTreeMap<String, f64>,
    /// How the run ended, as text.
    pub outcome: String,
    /// Peak memory (VmHWM) of each process by its name, bytes.
    pub peak_memory_bytes: BTreeMap<String, u64>,
    /// Processor time of each process, from its start, by its name, s.
    pub processor_s: BTreeMap<String, f64>,
    /// Distance between the volume's voxels along i, j, k; `None` without a volume.
    pub volume_spacing_m: Option<[f64; 3]>,
    /// The bone before the run; `None` without a volume.
    pub anatomy: Option<Anatomy>,
    /// Command line that replays the run.
    pub replay_command: String,
}

/// Errors of writing a report.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// One of its files could not be drawn or written.
    #[error(transparent)]
    Figure(#[from] FigureError),
    /// A histogram could not be created.
    #[error("cannot create a histogram of durations: {source}")]
    Histogram {
        /// The library's reason.
        source: hdrhistogram::CreationError,
    },
}

impl From<ReportError> for Failure {
    fn from(error: ReportError) -> Failure {
        match error {
            ReportError::Figure(FigureError::Output(error)) => Failure::from(error),
            other => Failure::failed(other),
        }
    }
}

/// A run's report, and errors about files that could not be written.
#[derive(Debug)]
pub struct Report {
    /// Its numbers.
    pub summary: Summary,
    /// Why files are missing, one error per file or figure.
    pub missing: Vec<FigureError>,
}

/// Writes the report of a run into its folder. Files are independent: if one cannot be written, the others
/// still are, and existing files are never replaced.
///
/// # Errors
/// [`ReportError::Histogram`], and no report is written. Unreadable logs are not an error.
pub fn write(folder: &Path, facts: &RunFacts) -> Result<Report, ReportError> {
    let paths = [folder.join("run.mcap"), folder.join("timing.mcap")];
    // Read the timing lane first: it gives the length of the run, which determines the middle frame.
    let timing = TimingLane::read(&paths[1])?;
    let mut run =
        RunLane::read(&paths[0], Some(timing.end_ns).filter(|&end_ns| end_ns > 0), facts.volume_spacing_m);
    // The bone drilled before a log begins is not known.
    let is_whole = run.header.as_ref().is_none_or(|header| header.first_tick == Tick::START);
    if let Some(anatomy) = facts.anatomy.as_ref().filter(|_| is_whole) {
        let drilled = std::mem::take(&mut run.drilled);
        run.course.note_drilled(anatomy, &drilled);
    }
    timing.breaches.iter().for_each(|(tick, text)| run.course.add_breach(*tick, text));
    let open = open_logs(folder);
    if !open.is_empty() {
        run.notes.push(format!("{} were not finished; replay them one by one", open.join(", ")));
    }
    let bytes = paths.map(|path| path.metadata().map_or(0, |metadata| metadata.len()));
    let frames = [("before", &run.frames.before), ("half", &run.frames.half), ("after", &run.frames.after)];
    let mut saved = saved_logs(folder);
    // The run ended while this one was to be continued.
    let became_last = timing.announced.iter().filter(|name| !saved.contains(name));
    saved.extend(became_last.map(|name| format!("{name} as run.mcap")).collect::<Vec<_>>());
    let summary = Summary::new(&run, &timing, facts, (bytes, saved));
    let mut missing: Vec<FigureError> = Vec::new();
    // Write the numbers first: they need the least space on a nearly full disk.
    missing.extend(write_json(&folder.join("summary.json"), &summary).err());
    let (mut pictures, mut drawn) = (Vec::new(), Vec::new());
    for (name, image) in frames {
        let Some(image) = image else { continue };
        let path = folder.join(format!("drr_{name}.png"));
        match image.png().map_err(FigureError::content(&path, "written as PNG")) {
            Ok(bytes) => {
                pictures.push(Picture::png(name, &bytes));
                missing.extend(output_file::write(&path, bytes).err().map(FigureError::from));
            }
            Err(error) => missing.push(error),
        }
    }
    // Drawing takes most of a report's time, so each figure has its own thread.
    let (tip, over_time) = std::thread::scope(|scope| {
        let draw_tip = || tip_figure::draw(&run).and_then(|figure| figure.files(folder, "tip_path"));
        let tip = std::thread::Builder::new().spawn_scoped(scope, draw_tip);
        let over_time =
            timing_figure::draw(&timing, run.end_ns).and_then(|figure| figure.files(folder, "timing"));
        // Without a thread it is drawn here.
        (tip.map_or_else(|_| Ok(draw_tip()), |tip| tip.join()), over_time)
    });
    let lost = || FigureError::content(&folder.join("tip_path.png"), "drawn")("its thread failed");
    for (stem, files) in [("tip_path", tip.unwrap_or_else(|_| Err(lost()))), ("timing", over_time)] {
        match files {
            Ok(files) => {
                drawn.push(Picture::svg(stem, &files[1].1));
                let written = files.iter().map(|(path, bytes)| output_file::write(path, bytes));
                missing.extend(written.filter_map(Result::err).map(FigureError::from));
            }
            Err(error) => missing.push(error),
        }
    }
    let scene = run.header.as_ref().map_or("", |header| header.scene_toml.as_str());
    let path = folder.join("report.html");
    let page = page::page(&summary, scene, &pictures, &drawn);
    let page = page.map_err(FigureError::content(&path, "filled in"));
    missing.extend(page.and_then(|page| Ok(output_file::write(&path, page)?)).err());
    Ok(Report { summary, missing })
}

fn write_json(path: &Path, summary: &Summary) -> Result<(), FigureError> {
    let text = serde_json::to_string_pretty(summary);
    let mut text = text.map_err(FigureError::content(path, "written as JSON"))?;
    text.push('\n');
    Ok(output_file::write(path, text)?)
}
