//! `trabecula log export --dataset`: renders the frames of a log again, with labels, as a data set for training.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use foreign_text::foreign_path;
use ipc_types::messages::Tick;
use ipc_types::scene::Scene;
use recorder_proc::exit_code::exit_code;
use recorder_proc::log_file::{LogFile, log_path};
use run_log::{MessageStream, ReadOptions, Verdict};
use serde_json::json;
use zerocopy::FromBytes;

use super::export::ExportArguments;
use super::{Out, concluded, json};
use crate::dataset::{Dataset, DatasetFile, Format, Part, Run, Sample};
use crate::failure::Failure;
use crate::replay::{FrameReplay, OpenedLog, Overrides, compare};

const NO_X_RAY: &str = "the scene has no X-ray";

/// Exports it.
///
/// # Errors
/// Not a log of this build, no frames for these ticks, fewer runs than parts, a folder that holds something (2); a frame that this build
/// renders differently, a damaged log, a full disk (1); a log that has a gap, is cut or was not ended (3).
pub fn export(format: Format, arguments: &ExportArguments, out: &mut Out<'_>) -> Result<(), Failure> {
    let folder = &arguments.output;
    refuse_used(folder)?;
    let logs: Vec<&PathBuf> = std::iter::once(&arguments.log).chain(&arguments.more).collect();
    let (runs, bone_from_hu) = runs(format, &logs, arguments)?;
    let (mut dataset, mut in_gaps) = (Dataset::new(format, bone_from_hu, runs), 0_u64);
    let mut verdicts = Vec::new();
    for (run, log) in logs.into_iter().enumerate() {
        verdicts.push(add(&mut dataset, (run, log), bone_from_hu, arguments, &mut in_gaps)?);
    }
    let frames = dataset.len();
    dataset.end().into_iter().try_for_each(|file| write(folder, file))?;
    let said = format!("{frames} frames with labels, {in_gaps} in gaps of the log");
    // Output errors are reported when the command ends.
    let _ = match (arguments.figures.json, verdicts.as_slice()) {
        (true, [(_, verdict)]) => {
            let verdict = json::of_verdict(verdict);
            let answer = json!({"output": folder, "exported": said, "frames": frames, "verdict": verdict});
            writeln!(out, "{answer}")
        }
        (true, several) => {
            let verdicts: Vec<_> = several.iter().map(|(_, verdict)| json::of_verdict(verdict)).collect();
            let answer = json!({"output": folder, "exported": said, "frames": frames, "verdicts": verdicts});
            writeln!(out, "{answer}")
        }
        (false, [(_, verdict)]) => {
            writeln!(out, "{}: {said}\n{}", folder.display(), verdict.ending.describe())
        }
        (false, several) => writeln!(out, "{}: {said}, of {} runs", folder.display(), several.len()),
    };
    for (path, verdict) in verdicts.iter().filter(|(_, verdict)| !verdict.is_intact()) {
        tell!("trabecula: {}: {verdict}", path.display());
    }
    // Damage (1) says more than a gap (3).
    let codes = verdicts.iter().map(|(_, verdict)| exit_code(verdict));
    concluded(out, codes.filter(|code| *code != 0).min().unwrap_or_default())
}

/// The runs of some logs, with the part of the data set that each belongs to; and from which HU on voxels are bone.
fn runs(format: Format, logs: &[&PathBuf], arguments: &ExportArguments) -> Result<(Vec<Run>, i16), Failure> {
    let mut runs = Vec::new();
    let mut bone_from_hu = arguments.bone_from_hu;
    for log in logs {
        let path = log_path(log);
        let refused = |what: &str| nothing(&path, what);
        let header = MessageStream::open(&LogFile::at(&path), ReadOptions::default())?.header().clone();
        let scene = Scene::parse(&header.scene_toml, &path).map_err(Failure::bad_input)?;
        let (Some(_), Some(volume)) = (&scene.drr, &scene.volume) else { return Err(refused(NO_X_RAY)) };
        let own = arguments.bone_from_hu.unwrap_or(volume.bone_threshold_hu);
        let first = *bone_from_hu.get_or_insert(own);
        if own != first {
            let what = format!(
                "bone is from {own} HU in its scene, from {first} in the first one's; give --bone-from-hu"
            );
            return Err(refused(&what));
        }
        runs.push(Run {
            log: foreign_path(log).to_string(),
            scene_sha256: header.scene_sha256(),
            part: None,
        });
    }
    if let Some(shares) = &arguments.split {
        let refused = |cause: String| Failure::bad_input(format!("--split: {cause}"));
        let is_yolo = matches!(format, Format::Yolo | Format::YoloSeg);
        if let Some(missing) = [Part::Train, Part::Val].into_iter().find(|part| is_yolo && !shares.has(*part))
        {
            return Err(refused(format!("Ultralytics needs a part `{}`", missing.name())));
        }
        let scenes: Vec<String> = runs.iter().map(|run| run.scene_sha256.clone()).collect();
        let parts = shares.deal(&scenes, arguments.seed).map_err(refused)?;
        runs.iter_mut().zip(parts).for_each(|(run, part)| run.part = Some(part));
    }
    Ok((runs, bone_from_hu.unwrap_or_default()))
}

fn nothing(path: &Path, what: &str) -> Failure {
    Failure::bad_input(format!("--dataset: {}: {what}", foreign_path(path)))
}

/// Adds a run's frames, and writes the files of each alone.
fn add(
    dataset: &mut Dataset,
    (run, log): (usize, &Path),
    bone_from_hu: i16,
    arguments: &ExportArguments,
    in_gaps: &mut u64,
) -> Result<(PathBuf, Verdict), Failure> {
    let overrides = Overrides {
        volume: arguments.volume.clone(),
        volume_files: arguments.volume_files,
        ..Overrides::default()
    };
    let log = OpenedLog::open(log, &overrides)?;
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let Some(mut replay) = FrameReplay::new(&log, threads)? else {
        return Err(nothing(&log.path, NO_X_RAY));
    };
    let before = dataset.len();
    while let Some(recorded) = replay.next_recorded()? {
        if !arguments.ticks().contains(Tick(recorded.frame.tick)) {
            continue;
        }
        let Some((rendered, labels)) = replay.label(&recorded.frame, bone_from_hu)? else {
            *in_gaps += 1;
            continue;
        };
        // Labels of another picture would be worse than none.
        if let Some(difference) = compare(&recorded, &rendered) {
            return Err(Failure::failed(format!("frame {}: {difference}", recorded.frame.sequence)));
        }
        let greys = rendered.pixels.chunks_exact(2).filter_map(|grey| u16::read_from_bytes(grey).ok());
        let sample = Sample { run, frame: rendered.frame, greys: greys.collect(), labels };
        let files = dataset.add(&sample).map_err(Failure::failed)?;
        files.into_iter().try_for_each(|file| write(&arguments.output, file))?;
    }
    if dataset.len() == before {
        return Err(nothing(&log.path, "the log has no frames for these ticks"));
    }
    let verdict = replay.verdict();
    Ok((log.path.clone(), verdict))
}

/// Refuses a folder that holds something, and what is no folder.
fn refuse_used(folder: &Path) -> Result<(), Failure> {
    if folder.symlink_metadata().is_err() {
        return Ok(());
    }
    let refused = |path: &Path| {
        let (path, folder) = (foreign_path(path), foreign_path(folder));
        Failure::bad_input(format!(
            "{path}: already exists; --output is {folder}, expected a new folder or an empty one"
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

fn write(folder: &Path, (name, bytes): DatasetFile) -> Result<(), Failure> {
    let path = folder.join(name);
    let parent = output_file::folder_of(&path);
    output_file::create_folder(parent).map_err(Failure::folder(parent))?;
    Ok(output_file::write(&path, bytes)?)
}
