//! A log with its scene and volume, and where it does not match this build.

use std::path::{Path, PathBuf};

use foreign_text::foreign;
use ipc_types::messages::layout::hex;
use ipc_types::scene::Scene;
use recorder_proc::build_info;
use recorder_proc::log_file::{LogFile, log_path};
use run_log::{BuildInfo, LogReader, ReadOptions, layout_hashes};
use simulation::{CtView, Simulation};
use voxel_grid::Ct;

use crate::failure::Failure;
use crate::volume_source::{self, VolumeFiles};

/// What the user substitutes for the log's own values.
#[derive(Debug, Clone, Default)]
pub struct Overrides {
    /// Current path of the CT file.
    pub volume: Option<PathBuf>,
    /// Another scene to use.
    pub scene: Option<PathBuf>,
    /// Whether to continue despite mismatches.
    pub allow_mismatch: bool,
    /// Which files the volume may name.
    pub volume_files: VolumeFiles,
}

/// A log ready for replay.
pub struct OpenedLog {
    /// `run.mcap`.
    pub path: PathBuf,
    /// Scene.
    pub scene: Scene,
    /// The CT.
    pub ct: Option<Ct>,
    /// Mismatches with the log that the user allowed.
    pub mismatches: Vec<String>,
    options: ReadOptions,
}

impl OpenedLog {
    /// Opens a log, its scene and its volume.
    ///
    /// # Errors
    /// Bad input: not a log; or a different build, layout, scene or volume, listed by name, unless mismatches
    /// are allowed. Damage: no part of the log can be replayed.
    pub fn open(given: &Path, overrides: &Overrides) -> Result<OpenedLog, Failure> {
        let path = log_path(given);
        let options = ReadOptions { allow_other_layouts: overrides.allow_mismatch };
        let reader = LogReader::open_with(&LogFile::at(&path), options)?;
        let recorded = Scene::parse(&reader.header().scene_toml, &path).map_err(Failure::bad_input)?;
        let mut mismatches = build_mismatch(&reader);
        mismatches.extend(layout_mismatches(&reader));
        let mut scene = recorded.clone();
        if let Some(file) = &overrides.scene {
            scene = crate::scenes::load(file).map_err(Failure::bad_input)?;
            mismatches.extend(scene_mismatch(&recorded, &scene, file));
        }
        if let Some(file) = &overrides.volume {
            place_volume(&mut scene, file)?;
        }
        let ct = volume_source::load(&scene, overrides.volume_files).map_err(|cause| {
            let moved = overrides.volume.is_none() && scene.volume.as_ref().is_some_and(|v| v.path.is_some());
            let advice = if moved { "; if the file has moved, give its path with --volume" } else { "" };
            Failure::bad_input(format!("{cause}{advice}"))
        })?;
        mismatches.extend(volume_mismatch(&reader, ct.as_ref().map(|ct| &ct.sha256)));
        if !mismatches.is_empty() && !overrides.allow_mismatch {
            let list = mismatches.join("\n  ");
            let originals = original_build(&reader.header().build, &build_info::current());
            return Err(Failure::bad_input(format!(
                "{}: this log does not match this build or its inputs:\n  {list}\nuse the \
                 originals{originals}, or --allow-mismatch",
                path.display()
            )));
        }
        Ok(OpenedLog { path, scene, ct, mismatches, options })
    }

    /// Opens a reader at the first tick.
    ///
    /// # Errors
    /// The file can no longer be opened.
    pub fn reader(&self) -> Result<LogReader, Failure> {
        Ok(LogReader::open_with(&LogFile::at(&self.path), self.options)?)
    }

    /// Refuses a log that begins later than its run: the physics at tick 0 is not that of its first command.
    ///
    /// # Errors
    /// Bad input: it begins later; `done` says what cannot be done with it. The file can no longer be opened.
    pub fn require_start(&self, done: &str) -> Result<(), Failure> {
        match self.reader()?.beginning() {
            None => Ok(()),
            Some(start) => Err(Failure::bad_input(format!(
                "{}: begins at tick {}; only a log from the start of its run can be {done}",
                self.path.display(),
                start.tick
            ))),
        }
    }

    /// How to read the log.
    pub fn options(&self) -> ReadOptions {
        self.options
    }

    /// The physics of the scene at tick 0.
    ///
    /// # Errors
    /// The physics refuses the scene.
    pub fn simulation(&self) -> Result<Simulation<'_>, String> {
        let ct = self.ct.as_ref().map(|ct| CtView::from(&ct.volume));
        Simulation::new(&self.scene, ct).map_err(|cause| cause.to_string())
    }

    /// Label for every result, naming the allowed mismatches.
    pub fn label(&self) -> String {
        if self.mismatches.is_empty() {
            return String::new();
        }
        format!(" (MISMATCH ALLOWED: {})", self.mismatches.join("; "))
    }
}

fn build_mismatch(reader: &LogReader) -> Vec<String> {
    let (theirs, ours) = (&reader.header().build, build_info::current());
    if *theirs == ours {
        return Vec::new();
    }
    let name = |build: &BuildInfo| {
        format!(
            "{} for {} by {}",
            foreign(&build.version),
            foreign(&build.target),
            foreign(build.rustc.as_deref().unwrap_or("an unknown compiler"))
        )
    };
    vec![format!("build: the log was written by {}, this is {}", name(theirs), name(&ours))]
}

/// Advice, in parentheses, on how to get the build that wrote a log; empty if it is this build. The log's
/// text becomes part of a command that users paste, so it is used only if it looks like a version; and the
/// command installs a file, because no index need have the version.
fn original_build(theirs: &BuildInfo, ours: &BuildInfo) -> String {
    if theirs == ours {
        return String::new();
    }
    let number = |build: &BuildInfo| build.version.split('+').next().unwrap_or_default().to_owned();
    let theirs_number = number(theirs);
    let is_plain = theirs_number.split('.').count() == 3
        && theirs_number.len() <= 16
        && theirs_number.chars().all(|c| c.is_ascii_digit() || c == '.');
    if theirs_number != number(ours) && is_plain {
        format!(" (version {theirs_number} wrote it: `pip install trabecula-{theirs_number}-*.whl`)")
    } else {
        format!(" (a build whose `trabecula --version` says {} wrote it)", foreign(&theirs.version))
    }
}

/// Messages whose layout differs; nonempty only if the reader allows other layouts.
fn layout_mismatches(reader: &LogReader) -> Vec<String> {
    let ours = layout_hashes();
    let of_log = reader.stream().metadata().iter();
    let of_log = of_log.filter_map(|(key, hash)| Some((key.strip_prefix("layout/")?, hash)));
    let other = of_log.filter(|(message, hash)| ours.get(*message) != Some(*hash));
    other
        .map(|(message, hash)| {
            format!(
                "layout: {} has layout {} in the log, another one in this build",
                foreign(message),
                foreign(hash)
            )
        })
        .collect()
}

fn scene_mismatch(recorded: &Scene, given: &Scene, file: &Path) -> Option<String> {
    let differs = recorded != given;
    differs.then(|| {
        format!(
            "scene: {} differs from the `{}` that the log was recorded with",
            file.display(),
            recorded.name
        )
    })
}

fn place_volume(scene: &mut Scene, file: &Path) -> Result<(), Failure> {
    let Some(volume) = &mut scene.volume else {
        return Err(Failure::bad_input(format!(
            "--volume {}: the log's scene has no volume",
            file.display()
        )));
    };
    volume.phantom = None;
    volume.path = Some(file.to_owned());
    Ok(())
}

fn volume_mismatch(reader: &LogReader, ours: Option<&[u8; 32]>) -> Option<String> {
    let theirs = reader.header().volume_sha256;
    if theirs.as_ref() == ours {
        return None;
    }
    let name = |hash: Option<&[u8; 32]>| hash.map_or("none".to_owned(), |hash| hex(hash));
    Some(format!("volume: SHA-256 was {} in the log, is now {}", name(theirs.as_ref()), name(ours)))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic)]

    use super::*;

    fn build(version: &str) -> BuildInfo {
        BuildInfo { version: version.to_owned(), target: "a".to_owned(), rustc: None }
    }

    #[test]
    fn a_foreign_log_says_which_version_to_install() {
        let ours = build("0.2.0+aaaaaaaaaaaa");
        let advice = |version: &str| original_build(&build(version), &ours);
        assert_eq!(advice("0.2.0+aaaaaaaaaaaa"), "");
        assert!(advice("0.1.0+bbbbbbbbbbbb").contains("`pip install trabecula-0.1.0-*.whl`"));
        // The same version number with other sources: no package matches.
        let unreleased = advice("0.2.0+cccccccccccc");
        assert!(
            unreleased.contains("says 0.2.0+cccccccccccc") && !unreleased.contains("pip"),
            "{unreleased}"
        );
    }

    #[test]
    fn no_log_puts_words_into_a_command_that_users_paste() {
        for version in
            ["1.0.0;reboot", "1.0.0 --index-url x", "../..", "", "1.0", "1.0.0`id`", &"1".repeat(40)]
        {
            let advice = original_build(&build(version), &build("0.2.0+a"));
            assert!(!advice.contains("pip"), "{advice}");
        }
    }
}
