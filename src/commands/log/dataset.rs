//! `trabecula log export --dataset`: renders the frames of a log again, with labels, as a data set for training.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use foreign_text::foreign_path;
use ipc_types::messages::Tick;
use recorder_proc::exit_code::exit_code;
use serde_json::json;
use zerocopy::FromBytes;

use super::export::ExportArguments;
use super::{Out, concluded, json};
use crate::dataset::{Dataset, DatasetFile, Format, Sample};
use crate::failure::Failure;
use crate::replay::{FrameReplay, OpenedLog, Overrides, compare};

/// Exports it.
///
/// # Errors
/// Not a log of this build, no frames for these ticks, a folder that holds something (2); a frame that this build renders differently, a
/// damaged log, a full disk (1); a log that has a gap, is cut or was not ended (3).
pub fn export(format: Format, arguments: &ExportArguments, out: &mut Out<'_>) -> Result<(), Failure> {
    let folder = &arguments.output;
    refuse_used(folder)?;
    let overrides = Overrides {
        volume: arguments.volume.clone(),
        volume_files: arguments.volume_files,
        ..Overrides::default()
    };
    let log = OpenedLog::open(&arguments.log, &overrides)?;
    let nothing = |what: &str| Failure::bad_input(format!("--dataset: {}: {what}", foreign_path(&log.path)));
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let (Some(mut replay), Some(volume)) = (FrameReplay::new(&log, threads)?, &log.scene.volume) else {
        return Err(nothing("the scene has no X-ray"));
    };
    let bone_from_hu = arguments.bone_from_hu.unwrap_or(volume.bone_threshold_hu);
    let (mut dataset, mut in_gaps) = (Dataset::new(format, bone_from_hu), 0_u64);
    while let Some(recorded) = replay.next_recorded()? {
        if !arguments.ticks().contains(Tick(recorded.frame.tick)) {
            continue;
        }
        let Some((rendered, labels)) = replay.label(&recorded.frame, bone_from_hu)? else {
            in_gaps += 1;
            continue;
        };
        // Labels of another picture would be worse than none.
        if let Some(difference) = compare(&recorded, &rendered) {
            return Err(Failure::failed(format!("frame {}: {difference}", recorded.frame.sequence)));
        }
        let greys = rendered.pixels.chunks_exact(2).filter_map(|grey| u16::read_from_bytes(grey).ok());
        let sample = Sample { frame: rendered.frame, greys: greys.collect(), labels };
        let files = dataset.add(&sample).map_err(Failure::failed)?;
        files.into_iter().try_for_each(|file| write(folder, file))?;
    }
    if dataset.is_empty() {
        return Err(nothing("the log has no frames for these ticks"));
    }
    let frames = dataset.len();
    write(folder, dataset.end())?;
    let verdict = replay.verdict();
    let said = format!("{frames} frames with labels, {in_gaps} in gaps of the log");
    // Output errors are reported when the command ends.
    let _ = match arguments.figures.json {
        true => {
            let verdict = json::of_verdict(&verdict);
            let answer = json!({"output": folder, "exported": said, "frames": frames, "verdict": verdict});
            writeln!(out, "{answer}")
        }
        false => writeln!(out, "{}: {said}\n{}", folder.display(), verdict.ending.describe()),
    };
    if !verdict.is_intact() {
        tell!("trabecula: {}: {verdict}", log.path.display());
    }
    concluded(out, exit_code(&verdict))
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
