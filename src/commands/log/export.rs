//! `trabecula log export`: exports a topic as a table, or the frames as images.

use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use clap::Args;
use foreign_text::foreign_path;
use ipc_types::messages::{Tick, TickRange};
use output_file::{OutputError, OutputFile};
use recorder_proc::log_file::{LogFile, log_path};
use recorder_proc::parquet_file::Parquet;
use run_log::columns::{Rows, columns, description_of_topic, read_rows};
use run_log::csv::Csv;
use run_log::fields::Scalar;
use run_log::{FrameRecord, LogError, ReadOptions, Topic, Verdict, frames};

use super::geometry::{self, Geometry};
use super::{Out, dataset, foxglove, json, judged};
use crate::commands::in_order;
use crate::dataset::{Format, Split, grey16};
use crate::failure::Failure;
use crate::launcher::volume_source::VolumeFiles;
use crate::output::refuse_existing;
use crate::say::Figures;

/// Arguments of `log export`.
#[derive(Debug, Args)]
pub struct ExportArguments {
    /// Log file, or the folder of a run; with `--dataset`, one or more.
    #[arg(required = true)]
    pub(super) logs: Vec<PathBuf>,
    /// New `.csv` or `.parquet` file; with `--frames`, a folder for the images; with `--dataset`, a new or empty folder; with `--geometry`, a file of a format that it has.
    #[arg(short, long)]
    pub(super) output: PathBuf,
    /// Topic to export.
    #[arg(long, default_value = Topic::State.name())]
    topic: String,
    /// Field to export (may be repeated); default: all. An array becomes one column per element.
    #[arg(long = "field")]
    fields: Vec<String>,
    /// First tick.
    #[arg(long, default_value_t = 0)]
    from: u64,
    /// Last tick, included.
    #[arg(long)]
    to: Option<u64>,
    /// Export one 16-bit PNG per frame, with the recorded pixel values, instead of a table.
    #[arg(long, conflicts_with_all = ["fields", "topic"])]
    frames: bool,
    /// Export geometry instead of a table, in the patient frame (LPS) and mm, as of the last tick (`--to`).
    #[arg(long, value_enum, value_name = "WHAT", conflicts_with_all = ["fields", "frames", "topic", "from"])]
    pub(super) geometry: Option<Geometry>,
    /// Export a `.mcap` file that Lichtblick and Foxglove open as it is: `/tf`, the tool, its contacts and paths for the 3D panel, X-ray
    /// frames, states and commands for plots.
    #[arg(long, conflicts_with_all = ["fields", "frames", "topic", "geometry"])]
    foxglove: bool,
    /// With `--foxglove`: states a second of simulated time, 1 to 1000.
    #[arg(long, value_name = "HZ", default_value_t = 30.0, requires = "foxglove")]
    pub(super) rate: f64,
    /// Export a data set for training instead of a table: every frame is rendered again, with masks of bone, tool, burr and tunnel, keypoints
    /// of the tool, camera and pose.
    #[arg(long, value_enum, value_name = "FORMAT", conflicts_with_all = ["fields", "frames", "topic", "geometry", "foxglove"])]
    dataset: Option<Format>,
    /// With `--dataset`: voxels at or above this are bone; default: `drr.labels.bone_from_hu` of the scene, or else its `volume.bone_threshold_hu`.
    #[arg(long, value_name = "HU", requires = "dataset", allow_negative_numbers = true)]
    pub(super) bone_from_hu: Option<i16>,
    /// With `--dataset`: parts of the data set and their shares of the runs, of `train`, `val` and `test`; the frames of a run, and of all
    /// with its scene and volume, are in one part.
    #[arg(long, value_name = "NAME=SHARE,...", requires = "dataset", conflicts_with_all = ["frames", "geometry", "foxglove"], value_parser = Split::parse)]
    pub(super) split: Option<Split>,
    /// With `--split`: another seed gives the runs other parts.
    #[arg(long, default_value_t = 0, requires = "split")]
    pub(super) seed: u64,
    /// With `--geometry tunnel` or `--dataset`: current path of the log's CT file.
    #[arg(long, value_name = "PATH")]
    pub(super) volume: Option<PathBuf>,
    #[command(flatten)]
    pub(super) volume_files: VolumeFiles,
    /// How its figures are printed.
    #[command(flatten)]
    pub(super) figures: Figures,
}

impl ExportArguments {
    pub(super) fn ticks(&self) -> TickRange {
        TickRange { first: Tick(self.from), last: self.to.map(Tick) }
    }

    /// # Errors
    /// Bad input: flags that have no effect together, or a range of ticks that ends before it begins.
    fn check(&self) -> Result<(), Failure> {
        let uses_volume = self.dataset.is_some() || self.geometry == Some(Geometry::Tunnel);
        if self.volume.is_some() && !uses_volume {
            return Err(Failure::bad_input("--volume is for --geometry tunnel and --dataset"));
        }
        in_order(self.ticks()).map(drop)
    }

    /// The log of an export of one; [`run`] refuses several.
    pub(super) fn log(&self) -> &Path {
        self.logs.first().map_or(Path::new(""), PathBuf::as_path)
    }
}

/// Runs the command.
///
/// # Errors
/// Not a log, no such topic or field, an unknown file extension, an output that already exists (2); a damaged log,
/// after writing the rows before the damage, or a full disk (1); a log that has a gap, is cut or was not ended (3).
pub fn run(arguments: &ExportArguments, out: &mut Out<'_>) -> Result<(), Failure> {
    arguments.check()?;
    if let Some(format) = arguments.dataset {
        return dataset::export(format, arguments, out);
    }
    if let [_, second, ..] = arguments.logs.as_slice() {
        let second = foreign_path(second);
        return Err(Failure::bad_input(format!("{second}: expected one log; --dataset alone takes several")));
    }
    if let Some(what) = arguments.geometry {
        return geometry::export(what, arguments);
    }
    if arguments.foxglove {
        return foxglove::export(arguments, out);
    }
    let log = log_path(arguments.log());
    let (what, verdict) = match arguments.frames {
        true => pictures(&log, arguments)?,
        false => table(&log, arguments)?,
    };
    // Output errors are reported when the command ends.
    let _ = match arguments.figures.json {
        true => {
            let verdict = json::of_verdict(&verdict);
            let answer =
                serde_json::json!({"output": arguments.output, "exported": what, "verdict": verdict});
            writeln!(out, "{answer}")
        }
        false => writeln!(out, "{}: {what}\n{}", arguments.output.display(), verdict.ending.describe()),
    };
    let _ = out.flush();
    judged(&log, &verdict)
}

/// A file name's extension, in lower case.
pub(super) fn ending_of(path: &Path) -> String {
    path.extension().map(|ending| ending.to_string_lossy().to_lowercase()).unwrap_or_default()
}

fn table(log: &Path, arguments: &ExportArguments) -> Result<(String, Verdict), Failure> {
    let ending = ending_of(&arguments.output);
    if !matches!(ending.as_str(), "csv" | "parquet") {
        let given = arguments.output.display();
        return Err(Failure::bad_input(format!("--output is {given}, expected a .csv or .parquet file")));
    }
    refuse_existing(&[&arguments.output])?;
    let description = description_of_topic(&LogFile::at(log), &arguments.topic)?;
    let columns = columns(description, &arguments.fields)?;
    // These errors do not name the file.
    let failure = |error| match error {
        LogError::Output { source } => OutputError::write(&arguments.output)(source).into(),
        other => Failure::from(other),
    };
    let file = OutputFile::create(&arguments.output)?;
    let rows_of = BufWriter::new(file.handle()?);
    let read_into = |rows: &mut dyn Rows| {
        let mut counted = Counted { rows, count: 0 };
        let verdict =
            read_rows(&LogFile::at(log), &arguments.topic, &columns, arguments.ticks(), &mut counted);
        verdict.map(|verdict| (counted.count, verdict))
    };
    // The rows before the damage still make a valid table.
    let (read, finished) = if ending == "csv" {
        let mut rows = Csv::new(rows_of, &columns).map_err(failure)?;
        (read_into(&mut rows), rows.finish())
    } else {
        let mut rows = Parquet::new(rows_of, &columns).map_err(failure)?;
        (read_into(&mut rows), rows.finish())
    };
    finished.map_err(failure)?;
    if !matches!(read, Err(LogError::Output { .. })) {
        file.keep()?;
    }
    let (count, verdict) = read.map_err(failure)?;
    let (columns, topic) = (columns.len() + 2, &arguments.topic);
    Ok((format!("{count} rows and {columns} columns of {topic}"), verdict))
}

/// Rows on their way to a file, counted: none is no fault, but one that is to be seen.
struct Counted<'a> {
    rows: &'a mut dyn Rows,
    count: u64,
}

impl Rows for Counted<'_> {
    fn row(&mut self, tick: Tick, log_time_ns: u64, values: &[Scalar]) -> Result<(), LogError> {
        self.count += 1;
        self.rows.row(tick, log_time_ns, values)
    }
}

fn pictures(log: &Path, arguments: &ExportArguments) -> Result<(String, Verdict), Failure> {
    let mut reader = frames(&LogFile::at(log), ReadOptions::default())?;
    let folder = &arguments.output;
    refuse_existing(&names(log, arguments))?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    let (mut written, mut without) = (0_u64, 0_u64);
    let mut damage = None;
    while let Some(record) = reader.next() {
        let record = match record {
            Ok(record) => record,
            Err(LogError::Gap { .. }) if reader.go_on() => continue,
            Err(error) => {
                damage = Some(Failure::from(error));
                break;
            }
        };
        let tick = record.frame.tick;
        if !arguments.ticks().contains(Tick(tick)) {
            continue;
        }
        if record.image.is_none() {
            without += 1;
            continue;
        }
        write_png(&folder.join(name(record.frame.sequence, tick)), &record)?;
        written += 1;
    }
    if let Some(damage) = damage {
        return Err(damage);
    }
    Ok((format!("{written} pictures, {without} frames without one in the log"), reader.verdict()))
}

fn name(sequence: u64, tick: u64) -> String {
    format!("frame_{sequence:06}_tick_{tick:08}.png")
}

/// The image paths, checked so that an export is refused before its first image. The frames' geometry is in chunks of
/// its own, so this is quick; faults of the log are reported when its images are read.
fn names(log: &Path, arguments: &ExportArguments) -> Vec<PathBuf> {
    let mut names = Names { folder: &arguments.output, paths: Vec::new() };
    let range = arguments.ticks();
    let _ = description_of_topic(&LogFile::at(log), Topic::DrrFrame.name())
        .and_then(|description| columns(description, &["sequence".to_owned()]))
        .and_then(|columns| {
            read_rows(&LogFile::at(log), Topic::DrrFrame.name(), &columns, range, &mut names)
        });
    names.paths
}

struct Names<'a> {
    folder: &'a Path,
    paths: Vec<PathBuf>,
}

impl Rows for Names<'_> {
    fn row(&mut self, tick: Tick, _log_time_ns: u64, values: &[Scalar]) -> Result<(), LogError> {
        self.paths.extend(values.first().map(|sequence| self.folder.join(name(sequence.bits(), tick.0))));
        Ok(())
    }
}

/// 16-bit greyscale with the recorded values.
fn write_png(path: &Path, record: &FrameRecord) -> Result<(), Failure> {
    let Some(image) = record.image else { return Ok(()) };
    let greys = record.pixels.chunks_exact(2).map(|pixel| u16::from_le_bytes([pixel[0], pixel[1]]));
    let bytes = grey16(image.width, image.height, greys)
        .map_err(|cause| Failure::failed(format!("{}: {cause}", path.display())))?;
    Ok(output_file::write(path, bytes)?)
}
