//! `trabecula log export`: exports a topic as a table, or the frames as images.

use std::io::BufWriter;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use foreign_text::foreign_path;
use ipc_types::messages::{Tick, TickRange};
use output_file::{OutputError, OutputFile};
use recorder_proc::log_file::{LogFile, log_path};
use recorder_proc::parquet_file::Parquet;
use run_log::columns::{Column, Rows, columns, description_of_topic, read_rows};
use run_log::csv::Csv;
use run_log::fields::Scalar;
use run_log::{FrameRecord, LogError, ReadOptions, Topic, Verdict, frames};
use serde_json::{Value, json};

use super::geometry::{self, Geometry};
use super::json::of_verdict;
use super::lerobot::Demonstration;
use super::{dataset, foxglove, judged, lerobot};
use crate::commands::{in_order, log_name};
use crate::dataset::{Format, Split};
use crate::failure::Failure;
use crate::launcher::volume_source::VolumeFiles;
use crate::output::refuse_existing;
use crate::say::{Figures, merged, path_text};
use figures::picture::grey16;

/// Format of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum DatasetFormat {
    /// `images/*.png` (16 bits) and `annotations.json` with masks, boxes and keypoints, for pycocotools.
    Coco,
    /// `images/*.png` (8 bits), `labels/*.txt` with boxes and keypoints, and `data.yaml`, for pose estimation
    /// with Ultralytics.
    Yolo,
    /// The same with mask polygons in `labels/*.txt`, for segmentation with Ultralytics.
    YoloSegment,
    /// A NumPy `.npz` per frame with the image and all labels, and `dataset.json`.
    Npz,
    /// LeRobot's format v3.0: an episode per run with observations, X-ray, commands and reward.
    Lerobot,
}

impl DatasetFormat {
    /// Returns the format of labelled frames, if it is one.
    fn labelled(self) -> Option<Format> {
        match self {
            DatasetFormat::Coco => Some(Format::Coco),
            DatasetFormat::Yolo => Some(Format::Yolo),
            DatasetFormat::YoloSegment => Some(Format::YoloSegment),
            DatasetFormat::Npz => Some(Format::Npz),
            DatasetFormat::Lerobot => None,
        }
    }
}

/// Arguments of `log export`.
#[derive(Debug, Args)]
pub struct ExportArguments {
    /// Log file, or the folder of a run (`latest`: the newest in `out`); with `--dataset`, one or more.
    #[arg(required = true, value_parser = log_name())]
    pub(super) logs: Vec<PathBuf>,
    /// New `.csv` or `.parquet` file; with `--frames`, a folder for the images; with `--dataset`, a new or
    /// empty folder; with `--geometry`, a file in one of its formats.
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
    /// Last tick (inclusive).
    #[arg(long)]
    to: Option<u64>,
    /// Export one 16-bit PNG per frame, with the recorded pixel values, instead of a table.
    #[arg(long, conflicts_with_all = ["fields", "topic"])]
    frames: bool,
    /// Export geometry instead of a table, in the patient frame (LPS, mm), at the last tick (`--to`).
    #[arg(long, value_enum, value_name = "WHAT", conflicts_with_all = ["fields", "frames", "topic", "from"])]
    pub(super) geometry: Option<Geometry>,
    /// Export a `.mcap` file for Lichtblick and Foxglove, with `/tf`, the tool, its contacts and paths for
    /// the 3D panel, X-ray frames, and states and commands for plots.
    #[arg(long, conflicts_with_all = ["fields", "frames", "topic", "geometry"])]
    foxglove: bool,
    /// With `--foxglove`: states per second of simulated time, 1 to 1000 (30). With `--dataset lerobot`: rows
    /// per second, a whole number (`drr.rate_hz`, or else 30).
    #[arg(long, value_name = "HZ")]
    pub(super) rate: Option<f64>,
    /// Export a training data set instead of a table: labelled frames, with masks of bone, tool, burr and
    /// tunnel, keypoints of the tool, camera and pose; or (`lerobot`) what was observed and commanded.
    #[arg(long, value_enum, value_name = "FORMAT", conflicts_with_all = ["fields", "frames", "topic", "geometry", "foxglove"])]
    dataset: Option<DatasetFormat>,
    #[command(flatten)]
    pub(super) demonstration: Demonstration,
    /// With `--dataset`: threshold at or above which voxels are bone; default: `drr.labels.bone_from_hu` of
    /// the scene, or else its `volume.bone_threshold_hu`.
    #[arg(long, value_name = "HU", requires = "dataset", allow_negative_numbers = true)]
    pub(super) bone_from_hu: Option<i16>,
    /// With `--dataset`: split into `train`, `val` and `test` by these shares of the runs; all runs of the
    /// same scene and volume go to the same part.
    #[arg(long, value_name = "NAME=SHARE,...", requires = "dataset", conflicts_with_all = ["frames", "geometry", "foxglove"], value_parser = Split::parse)]
    pub(super) split: Option<Split>,
    /// With `--split`: seed of the random assignment of runs to parts.
    #[arg(long, default_value_t = 0, requires = "split")]
    pub(super) seed: u64,
    /// With `--geometry tunnel` or `--dataset`: current path of the log's CT file.
    #[arg(long, value_name = "PATH")]
    pub(super) volume: Option<PathBuf>,
    #[command(flatten)]
    pub(super) volume_files: VolumeFiles,
    #[command(flatten)]
    pub(super) figures: Figures,
}

impl ExportArguments {
    pub(super) fn ticks(&self) -> TickRange {
        TickRange { first: Tick(self.from), last: self.to.map(Tick) }
    }

    /// # Errors
    /// Bad input: incompatible flags, or a range of ticks that ends before it begins.
    fn check(&self) -> Result<(), Failure> {
        let is_lerobot = self.dataset == Some(DatasetFormat::Lerobot);
        if self.rate.is_some() && !self.foxglove && !is_lerobot {
            return Err(Failure::bad_input("--rate needs --foxglove or --dataset lerobot"));
        }
        if let Some(flag) = self.demonstration.given().filter(|_| !is_lerobot) {
            return Err(Failure::bad_input(format!("{flag} needs --dataset lerobot")));
        }
        if let Some(flag) = self.labels_only().filter(|_| is_lerobot) {
            return Err(Failure::bad_input(format!("--dataset lerobot does not use {flag}")));
        }
        let uses_volume = self.dataset.is_some() || self.geometry == Some(Geometry::Tunnel);
        if self.volume.is_some() && !uses_volume {
            return Err(Failure::bad_input("--volume needs --geometry tunnel or --dataset"));
        }
        in_order(self.ticks()).map(drop)
    }

    /// Returns the first flag in use that only labelled frames have.
    fn labels_only(&self) -> Option<&'static str> {
        [
            ("--bone-from-hu", self.bone_from_hu.is_some()),
            ("--split", self.split.is_some()),
            ("--volume", self.volume.is_some()),
        ]
        .into_iter()
        .find_map(|(flag, is_given)| is_given.then_some(flag))
    }

    /// Prints what was exported, as text with how the log ends, or as JSON.
    pub(super) fn say(&self, said: &str, figures: Value, verdict: &Verdict) {
        let text = || match self.geometry {
            Some(_) => format!("{}: {said}", self.output.display()),
            None => format!("{}: {said}\n{}", self.output.display(), verdict.ending.describe()),
        };
        let all =
            json!({"output": path_text(&self.output), "exported": said, "verdict": of_verdict(verdict)});
        self.figures.say(text, || merged(all, figures));
    }

    /// Returns the log of a single-log export; [`run`] rejects several.
    pub(super) fn log(&self) -> &Path {
        self.logs.first().map_or(Path::new(""), PathBuf::as_path)
    }
}

/// Runs the command.
///
/// # Errors
/// Not a log, an unknown topic, field or file extension, an output that already exists (2); a damaged log,
/// after writing the rows before the damage, or a full disk (1); a log that has a gap, is truncated or was
/// not ended (3).
pub fn run(arguments: &ExportArguments) -> Result<(), Failure> {
    arguments.check()?;
    if let Some(format) = arguments.dataset {
        return match format.labelled() {
            Some(format) => dataset::export(format, arguments),
            None => lerobot::export(arguments),
        };
    }
    if let [_, second, ..] = arguments.logs.as_slice() {
        let second = foreign_path(second);
        return Err(Failure::bad_input(format!(
            "{second}: expected a single log; only --dataset accepts several"
        )));
    }
    if let Some(what) = arguments.geometry {
        return geometry::export(what, arguments);
    }
    if arguments.foxglove {
        return foxglove::export(arguments);
    }
    let log = log_path(arguments.log());
    let (what, verdict) = match arguments.frames {
        true => pictures(&log, arguments)?,
        false => table(&log, arguments)?,
    };
    arguments.say(&what, json!({}), &verdict);
    judged(&log, &verdict)
}

/// Returns a file name's extension in lower case.
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
    let mut count = 0_u64;
    let verdict = write_table(&arguments.output, &columns, |rows| {
        let mut counted = |tick: Tick, log_time_ns: u64, values: &[Scalar]| -> Result<(), LogError> {
            count += 1;
            rows.row(tick, log_time_ns, values)
        };
        read_rows(&LogFile::at(log), &arguments.topic, &columns, arguments.ticks(), &mut counted)
    })?;
    let (columns, topic) = (columns.len() + 2, &arguments.topic);
    let rows = foreign_text::counted(count, "row");
    Ok((format!("{rows} and {columns} columns of {topic}"), verdict))
}

/// Writes a `.csv` file, or else a Parquet file. The rows before the damage of a log still make a valid
/// table.
pub(super) fn write_table<T>(
    output: &Path,
    columns: &[Column],
    fill: impl FnOnce(&mut dyn Rows) -> Result<T, LogError>,
) -> Result<T, Failure> {
    let file = OutputFile::create(output)?;
    let out = BufWriter::new(file.handle()?);
    let table: Result<Box<dyn Rows>, LogError> = match ending_of(output).as_str() {
        "csv" => Csv::new(out, columns).map(|table| Box::new(table) as _),
        _ => Parquet::new(out, columns).map(|table| Box::new(table) as _),
    };
    let mut table = table.map_err(unwritten(output))?;
    let filled = fill(&mut *table);
    table.finish().map_err(unwritten(output))?;
    if !matches!(filled, Err(LogError::Output { .. })) {
        file.keep()?;
    }
    filled.map_err(unwritten(output))
}

/// Converts an error to the export's failure; write errors do not name the file themselves.
pub(super) fn unwritten(output: &Path) -> impl Fn(LogError) -> Failure {
    move |error| match error {
        LogError::Output { source } => OutputError::write(output)(source).into(),
        other => Failure::from(other),
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
    let (images, frames) = (foreign_text::counted(written, "image"), foreign_text::counted(without, "frame"));
    Ok((format!("{images}, {frames} without an image in the log"), reader.verdict()))
}

fn name(sequence: u64, tick: u64) -> String {
    format!("frame_{sequence:06}_tick_{tick:08}.png")
}

/// Returns the image paths, so that existing files are rejected before the first image is written. Frame
/// geometry has its own chunks, so this is quick; log faults are reported when the images are read.
fn names(log: &Path, arguments: &ExportArguments) -> Vec<PathBuf> {
    let mut paths = Vec::new();
    let mut path = |tick: Tick, _: u64, values: &[Scalar]| -> Result<(), LogError> {
        paths.extend(values.first().map(|sequence| arguments.output.join(name(sequence.bits(), tick.0))));
        Ok(())
    };
    let (log, topic) = (LogFile::at(log), Topic::DrrFrame.name());
    let _ = description_of_topic(&log, topic)
        .and_then(|description| columns(description, &["sequence".to_owned()]))
        .and_then(|columns| read_rows(&log, topic, &columns, arguments.ticks(), &mut path));
    paths
}

/// Writes a 16-bit greyscale PNG with the recorded values.
fn write_png(path: &Path, record: &FrameRecord) -> Result<(), Failure> {
    let Some(image) = record.image else { return Ok(()) };
    let greys = record.pixels.chunks_exact(2).map(|pixel| u16::from_le_bytes([pixel[0], pixel[1]]));
    let bytes = grey16(image.width, image.height, greys)
        .map_err(|cause| Failure::failed(format!("{}: {cause}", path.display())))?;
    Ok(output_file::write(path, bytes)?)
}
