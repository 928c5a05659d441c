//! `trabecula log export --dataset`: re-renders the frames of logs with labels, as a training data set.

use std::fs;
use std::path::{Path, PathBuf};

use foreign_text::{counted, foreign_path};
use ipc_types::messages::Tick;
use ipc_types::messages::layout::hex;
use ipc_types::scene::Drr;
use recorder_proc::exit_code::exit_code;
use recorder_proc::log_file::{LogFile, log_path};
use run_log::{LogError, Verdict, frames};
use serde_json::json;
use zerocopy::FromBytes;

use super::ended_with;
use super::export::ExportArguments;
use crate::dataset::{Dataset, DatasetFile, Format, Run, Sample};
use crate::failure::Failure;
use crate::replay::{FrameReplay, OpenedLog, Overrides, compare};

const NO_X_RAY: &str = "the scene has no X-ray";

/// Exports the data set.
///
/// # Errors
/// Not a log of this build, no frames in this range of ticks, incompatible runs, a folder that is not empty
/// (2); a frame that this build renders differently, a damaged log, a full disk (1); a log that has a gap, is
/// truncated or was not ended (3).
pub fn export(format: Format, arguments: &ExportArguments) -> Result<(), Failure> {
    refuse_used(&arguments.output)?;
    let bone_from_hu = checked(arguments)?;
    let dataset = Dataset::new(format, bone_from_hu, arguments.split.as_ref());
    let mut export = Export { arguments, dataset, in_gaps: 0 };
    let mut verdicts = Vec::with_capacity(arguments.logs.len());
    for (index, log) in arguments.logs.iter().enumerate() {
        verdicts.push(export.take(log, index)?);
    }
    let Export { dataset, in_gaps, .. } = export;
    let (frames, parts) = (dataset.len(), dataset.lengths());
    let folder = &arguments.output;
    dataset.end().into_iter().try_for_each(|file| write(folder, file))?;
    let shares: Vec<String> = parts.iter().map(|(name, frames)| format!("{name} {frames}")).collect();
    let shares = if shares.is_empty() { String::new() } else { format!(" ({})", shares.join(", ")) };
    let labelled = counted(frames, "labelled frame");
    let said = format!("{labelled}{shares}, {in_gaps} skipped in gaps of the log");
    let mut figures = json!({"frames": frames});
    if !parts.is_empty() {
        figures["split"] = parts.iter().map(|(name, n)| ((*name).to_owned(), json!(n))).collect();
    }
    arguments.say(&said, figures, &worst(&verdicts));
    for (name, _) in parts.iter().filter(|(_, frames)| *frames == 0) {
        tell!("trabecula: --split: `{name}` is empty; use more runs or another --seed");
    }
    judged_all(&arguments.logs, &verdicts)
}

/// Returns the worst verdict, which decides the exit code.
pub(super) fn worst(verdicts: &[Verdict]) -> Verdict {
    let badness = |verdict: &&Verdict| (!verdict.is_intact(), verdict.is_stopped_by_damage());
    verdicts.iter().max_by_key(badness).cloned().unwrap_or_default()
}

/// Prints what is wrong with each log; the worst verdict is the exit code.
pub(super) fn judged_all(logs: &[PathBuf], verdicts: &[Verdict]) -> Result<(), Failure> {
    for (log, verdict) in logs.iter().zip(verdicts).filter(|(_, verdict)| !verdict.is_intact()) {
        tell!("trabecula: {}: {verdict}", log_path(log).display());
    }
    ended_with(exit_code(&worst(verdicts)))
}

/// An export in progress.
struct Export<'a> {
    arguments: &'a ExportArguments,
    dataset: Dataset,
    in_gaps: u64,
}

impl Export<'_> {
    /// Exports the frames of a log.
    fn take(&mut self, log: &Path, index: usize) -> Result<Verdict, Failure> {
        let arguments = self.arguments;
        let log = open(log, arguments)?;
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let Some(mut replay) = FrameReplay::new(&log, threads)? else {
            return Err(refused(&log.path, NO_X_RAY));
        };
        let labels = log.scene.drr.as_ref().map(Drr::labels).unwrap_or_default();
        let bone_from_hu = self.dataset.bone_from_hu();
        let run = Run { images: labels.images, ..run(&log, arguments, index)? };
        while let Some(recorded) = replay.next_recorded()? {
            if !arguments.ticks().contains(Tick(recorded.frame.tick)) {
                continue;
            }
            let Some((rendered, labels)) = replay.label(&recorded.frame, bone_from_hu)? else {
                self.in_gaps += 1;
                continue;
            };
            // Labels that do not match the image would be worse than no labels.
            if let Some(difference) = compare(&recorded, &rendered) {
                return Err(Failure::failed(format!("frame {}: {difference}", recorded.frame.sequence)));
            }
            let greys = rendered.pixels.chunks_exact(2).filter_map(|grey| u16::read_from_bytes(grey).ok());
            let sample = Sample { frame: rendered.frame, greys: greys.collect(), labels };
            let files = self.dataset.add(&sample, &run).map_err(|what| refused(&log.path, &what))?;
            files.into_iter().try_for_each(|file| write(&arguments.output, file))?;
        }
        Ok(replay.verdict())
    }
}

/// Checks every log before the first file is written, so that a rejected export leaves nothing behind.
/// Returns the bone threshold in HU.
fn checked(arguments: &ExportArguments) -> Result<i16, Failure> {
    let mut common = None;
    for log in &arguments.logs {
        let log = open(log, arguments)?;
        let (Some(_), Some(threshold_hu)) = (&log.scene.drr, log.scene.labels_bone_from_hu()) else {
            return Err(refused(&log.path, NO_X_RAY));
        };
        let own = (arguments.bone_from_hu.unwrap_or(threshold_hu), log.reader()?.initial().joint_count);
        let first = *common.get_or_insert(own);
        if own.0 != first.0 {
            let what = format!(
                "bone starts at {} HU, but at {} HU in the previous logs; set one threshold with \
                 --bone-from-hu",
                own.0, first.0
            );
            return Err(refused(&log.path, &what));
        }
        if own.1 != first.1 {
            let what = format!("its tool has {} joints, but {} in the previous logs", own.1, first.1);
            return Err(refused(&log.path, &what));
        }
        if !has_frames(&log, arguments)? {
            return Err(refused(&log.path, "the log has no frames in this range of ticks"));
        }
    }
    common
        .map(|(bone_from_hu, _)| bone_from_hu)
        .ok_or_else(|| Failure::bad_input("--dataset: expected at least one log"))
}

/// Returns whether a log has a frame in the requested ticks; the export itself reports damage.
fn has_frames(log: &OpenedLog, arguments: &ExportArguments) -> Result<bool, Failure> {
    let mut recorded = frames(&LogFile::at(&log.path), log.options())?;
    loop {
        match recorded.next() {
            None => return Ok(false),
            Some(Ok(record)) if !arguments.ticks().contains(Tick(record.frame.tick)) => {}
            Some(Err(LogError::Gap { .. })) if recorded.go_on() => {}
            Some(_) => return Ok(true),
        }
    }
}

fn open(log: &Path, arguments: &ExportArguments) -> Result<OpenedLog, Failure> {
    let overrides = Overrides {
        volume: arguments.volume.clone(),
        volume_files: arguments.volume_files,
        ..Overrides::default()
    };
    OpenedLog::open(log, &overrides)
}

pub(super) fn refused(log: &Path, what: &str) -> Failure {
    Failure::bad_input(format!("--dataset: {}: {what}", foreign_path(log)))
}

/// Describes the run of the log with this index.
fn run(log: &OpenedLog, arguments: &ExportArguments, index: usize) -> Result<Run, Failure> {
    let reader = log.reader()?;
    let header = reader.header();
    let volume = header.volume_sha256.map(|digest| hex(&digest)).unwrap_or_default();
    let id = format!("{} {volume}", header.scene_sha256());
    let part = arguments.split.as_ref().map_or(0, |split| split.part_of(arguments.seed, &id));
    Ok(Run { number: (arguments.logs.len() > 1).then_some(index + 1), id, part, images: Vec::new() })
}

/// Rejects a folder that is not empty, and anything that is not a folder.
pub(super) fn refuse_used(folder: &Path) -> Result<(), Failure> {
    if folder.symlink_metadata().is_err() {
        return Ok(());
    }
    let refused = |path: &Path| {
        let (path, folder) = (foreign_path(path), foreign_path(folder));
        Failure::bad_input(format!(
            "{path}: already exists; --output is {folder}, expected a new or empty folder"
        ))
    };
    match fs::read_dir(folder) {
        Ok(mut entries) => match entries.next() {
            None => Ok(()),
            Some(entry) => Err(refused(&entry.map_or_else(|_| folder.to_owned(), |entry| entry.path()))),
        },
        Err(_) => Err(refused(folder)),
    }
}

pub(super) fn write(folder: &Path, (name, bytes): DatasetFile) -> Result<(), Failure> {
    let path = folder.join(name);
    let parent = output_file::folder_of(&path);
    output_file::create_folder(parent).map_err(Failure::folder(parent))?;
    Ok(output_file::write(&path, bytes)?)
}
