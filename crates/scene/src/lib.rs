//! Scenes: one TOML file holds everything that a run needs.
//!
//! Keys carry their unit (`_mm`, `_deg`, `_rpm`); what a scene does not name is not simulated: without
//! `[volume]` no bone, without `[drr]` no X-ray process. Parsing checks every key and every range; errors
//! name file, key, value and allowed range.
//!
//! **Boundary:** text in, a [`Scene`] or a [`SceneError`] out. Files are opened elsewhere
//! (`ipc_types::scene_file`).
//!
//! **Invariants:** a [`Scene`] from [`Scene::parse`] is within every range and consistent, so no later code
//! checks it again; an unknown key is an error. **One declaration a key**, in `model`: type, unit, range,
//! default and text. `schemars` derives the JSON schema from it ([`json_schema`]); the range checks, their
//! errors and the [`reference`](mod@reference) are made from that schema, so each knows every key.
//!
//! ```
//! use std::path::Path;
//!
//! use scene::Scene;
//!
//! let text = r#"
//! name = "straight"
//! [run]
//! mode = "lockstep"
//! duration_s = 2.0
//! [tool]
//! burr_start_mm = [0.0, 0.0, 0.0]
//! direction = [1.0, 0.0, 0.0]
//! bend_toward = [0.0, 0.0, 1.0]
//! "#;
//! let scene = Scene::parse(text, Path::new("straight.toml")).unwrap();
//! assert_eq!(scene.tick_count(), 2000);
//! assert!(scene.volume.is_none());
//!
//! let error = Scene::parse(&text.replace("2.0", "-2.0"), Path::new("straight.toml")).unwrap_err();
//! assert!(error.to_string().contains("run.duration_s"), "{error}");
//! ```

mod check;
pub mod closed_mesh;
mod cutter;
mod declaration;
mod error;
pub mod mesh;
mod model;
mod named_file;
mod no_effect;
mod place;
pub mod plan;
mod planned_path;
mod ranges;
pub mod reference;
mod schema;
mod tool;
mod tool_file;
mod truth;
mod urdf;
mod urdf_meshes;

pub use cutter::{Cutter, CutterBall, CutterSolid, CutterZone, MAX_CUTTER_BALLS, STANDARD_SCALLOP_MM};
pub use error::SceneError;
pub use model::*;
pub use named_file::ReadText;
pub use no_effect::{NoEffect, keys_without_effect};
pub use planned_path::planned_path_mm;
pub use schema::json_schema;
pub use tool::{FlexurePlace, Holder, OuterTubeSize, STANDARD_HOLDER, STANDARD_RADII, ToolRadii};
pub use truth::planned_path_in_bone_mm;

use std::path::{Path, PathBuf};

/// Longest run. MCAP numbers a channel's messages with 32 bits: at the shortest time step, 0.1 ms, a day
/// needs a fifth of them. All other counts of ticks, frames and bytes have 64 bits.
pub const LONGEST_RUN_S: f64 = 86_400.0;

/// Most readings of a sensor that are measured and have not arrived: its rate times its longest delay.
pub const MAX_READINGS_UNDERWAY: usize = 256;

/// The error of a text that was parsed, which is the file's or was completed from it.
fn malformed(text: &str, path: &Path, parsed: &str, cause: &toml::de::Error) -> SceneError {
    let start = cause.span().map(|span| span.start);
    let key = start.and_then(|start| place::key_at(parsed, start));
    let line = match (&key, start) {
        (_, Some(start)) if parsed == text => place::line_at(text, start),
        (Some(key), _) => place::line_of(text, key).unwrap_or(0),
        _ => 0,
    };
    let cause = match key {
        Some(key) => format!("`{key}`: {}", place::in_words(cause.message())),
        None => cause.message().to_owned(),
    };
    SceneError::Malformed { file: path.to_owned(), line, cause }
}

/// The path from the root of the file system: a scene's text is copied into the session's folder and into the
/// log.
fn absolute(path: PathBuf) -> PathBuf {
    std::path::absolute(&path).unwrap_or(path)
}

impl Scene {
    /// Parses and checks a scene's text; `path` names it in errors, and relative paths in the scene are
    /// relative to its folder.
    ///
    /// # Errors
    /// [`SceneError`]: a key is unknown or missing, or a value is out of its range; the scene names a file (a plan, a tool, a URDF), which
    /// [`Scene::parse_with`] reads.
    pub fn parse(text: &str, path: &Path) -> Result<Scene, SceneError> {
        let refused =
            |_: &Path| Err(std::io::Error::other("such a file is read with the scene's file alone"));
        Scene::parse_with(text, path, &refused)
    }

    /// The same, with a function that reads the files that the scene may name (`tool.plan`,
    /// `manipulator.file`, `arm.urdf`). The scene returned holds what follows from them, and names no file.
    ///
    /// # Errors
    /// As [`Scene::parse`]; a file cannot be read or is none of its kind, or gives what the scene gives, too.
    pub fn parse_with(text: &str, path: &Path, read: &ReadText) -> Result<Scene, SceneError> {
        let folder = path.parent().unwrap_or(Path::new("."));
        let mut given: toml::Table =
            toml::from_str(text).map_err(|cause| malformed(text, path, text, &cause))?;
        let checker = check::Checker { file: path };
        // The plan's pilot hole is as wide as the tool's burr.
        let tool = tool_file::put_in(&mut given, folder, read, &checker)?;
        let planned = plan::put_in(&mut given, folder, read, &checker)?;
        let arm = urdf::put_in(&mut given, folder, read, &checker)?;
        let completed = match tool || planned || arm {
            // The scene as it is written, with its lines.
            false => text.to_owned(),
            true => toml::to_string(&given).map_err(|cause| SceneError::Malformed {
                file: path.to_owned(),
                line: 0,
                cause: cause.to_string(),
            })?,
        };
        let mut scene: Scene =
            toml::from_str(&completed).map_err(|cause| malformed(text, path, &completed, &cause))?;
        scene.resolve_paths(folder);
        check::check(&scene, &given, path)?;
        Ok(scene)
    }

    fn resolve_paths(&mut self, folder: &Path) {
        for controller in &mut self.controller {
            if let Some(drilling) = &mut controller.curved_drilling
                && let Some(path) = &mut drilling.calibration
            {
                *path = absolute(folder.join(&*path));
            }
        }
        if let Some(volume) = &mut self.volume
            && let Some(path) = &mut volume.path
        {
            *path = absolute(folder.join(&*path));
        }
        for mesh in self.arm.mesh.iter_mut().flatten() {
            mesh.file = absolute(folder.join(&mesh.file));
        }
    }

    /// Time step in seconds.
    pub fn dt_s(&self) -> f64 {
        self.run.dt_ms * 1e-3
    }

    /// Time step in nanoseconds.
    pub fn dt_ns(&self) -> u64 {
        (self.run.dt_ms * 1e6 + 0.5) as u64
    }

    /// Number of ticks of the whole run.
    pub fn tick_count(&self) -> u64 {
        (self.run.duration_s / self.dt_s() + 0.5) as u64
    }

    /// The controllers' names in order.
    pub fn controller_names(&self) -> Vec<String> {
        self.controller.iter().map(|controller| controller.name.clone()).collect()
    }

    /// Ticks between two scheduled frames; `None` without DRR or with frames only on request.
    pub fn frame_period_ticks(&self) -> Option<u64> {
        let rate_hz = self.drr.as_ref()?.rate_hz;
        (rate_hz > 0.0).then(|| ((1.0 / (rate_hz * self.dt_s())) + 0.5).max(1.0) as u64)
    }

    /// The tick of the scheduled frame that controllers see at `tick` in lockstep: each is seen half a period
    /// after its tick, however long it took to render, so that a run repeats bit for bit. `None` where none
    /// is due.
    pub fn frame_seen_at(&self, tick: u64) -> Option<u64> {
        let period = self.frame_period_ticks()?;
        let frame = tick.checked_sub((period / 2).max(1))?;
        frame.is_multiple_of(period).then_some(frame)
    }

    /// Ticks between two keyframes; `None` without.
    pub fn keyframe_period_ticks(&self) -> Option<u64> {
        let interval_s = self.recording.keyframe_interval_s;
        (interval_s > 0.0).then(|| (interval_s / self.dt_s() + 0.5).max(1.0) as u64)
    }
}
