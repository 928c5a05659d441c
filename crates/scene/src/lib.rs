//! Scenes: one TOML file holds everything that a run needs.
//!
//! Keys carry their unit (`_mm`, `_deg`, `_rpm`). A scene simulates only what it names: no bone without
//! `[volume]`, no X-ray process without `[drr]`. Parsing checks every key and every range; errors name file,
//! key, value and allowed range.
//!
//! **Boundary:** text in, a [`Scene`] or a [`SceneError`] out. Files are opened elsewhere
//! (`ipc_types::scene_file`).
//!
//! **Invariants:** a [`Scene`] from [`Scene::parse`] is within every range and consistent, so later code need
//! not check it again; an unknown key is an error. **One declaration per key**, in `model`: type, unit,
//! range, default and text. `schemars` derives the JSON schema from it ([`json_schema`]); the range checks,
//! their errors and the [`reference`](mod@reference) are generated from that schema, so all of them cover
//! every key.
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
mod structure_content;
mod structure_curve;
mod tool;
mod tool_file;
mod truth;
mod urdf;
mod urdf_meshes;

pub use cutter::{Cutter, CutterBall, CutterSolid, CutterZone, MAX_CUTTER_BALLS, STANDARD_SCALLOP_MM};
pub use declaration::list_default;
pub use error::SceneError;
pub use model::*;
pub use named_file::ReadText;
pub use no_effect::{NoEffect, keys_without_effect};
pub use place::is_number_with_comma;
pub use planned_path::planned_path_mm;
pub use schema::json_schema;
pub use structure_content::{FIELD_REACH_MM, MAX_STRUCTURE_TRIANGLES, MAX_STRUCTURE_VOXELS};
pub use tool::{FlexurePlace, Holder, OuterTubeSize, STANDARD_HOLDER, STANDARD_RADII, ToolRadii};
pub use truth::planned_path_in_bone_mm;

use std::path::{Path, PathBuf};

/// Longest run. MCAP counts a channel's messages in 32 bits: at the shortest time step, 0.1 ms, a day uses a
/// fifth of them. All other counts of ticks, frames and bytes have 64 bits.
pub const LONGEST_RUN_S: f64 = 86_400.0;

/// Largest number of readings of a sensor in transit, measured but not delivered: its rate times its longest
/// delay.
pub const MAX_READINGS_UNDERWAY: usize = 256;

/// What to do about a number with a decimal comma.
pub const DECIMAL_COMMA: &str = "write a decimal point, not a comma";

/// The advice for a backslash in double quotes.
pub const BACKSLASH: &str = "in double quotes a backslash starts an escape: write a path in single quotes, such \
                             as 'C:\\data', or with /";

/// Error of a parsed text, which is the file's own or was completed from it.
fn malformed(text: &str, path: &Path, parsed: &str, cause: &toml::de::Error) -> SceneError {
    let start = cause.span().map(|span| span.start);
    let key = start.and_then(|start| place::key_at(parsed, start));
    let line = match (&key, start) {
        (_, Some(start)) if parsed == text => foreign_text::line_at(text, start),
        (Some(key), _) => place::line_of(text, key).unwrap_or(0),
        _ => 0,
    };
    let is_comma = start.is_some_and(|start| place::is_decimal_comma(parsed, start));
    let cause = match key {
        _ if is_comma && key.is_none() => format!("{}; {DECIMAL_COMMA}", cause.message()),
        Some(key) => format!("`{key}`: {}", place::in_words(cause.message())),
        None => place::in_words(cause.message()),
    };
    SceneError::Malformed { file: path.to_owned(), line, cause }
}

/// Makes a path absolute: a scene's text is copied into the session's folder and into the log.
fn absolute(path: PathBuf) -> PathBuf {
    std::path::absolute(&path).unwrap_or(path)
}

impl Scene {
    /// Parses and checks a scene's text; `path` names it in errors, and relative paths in the scene are
    /// relative to its folder.
    ///
    /// # Errors
    /// [`SceneError`]: a key is unknown or missing, a value is out of range, or the scene names a file (a
    /// plan, a tool, a URDF), which only [`Scene::parse_with`] reads.
    pub fn parse(text: &str, path: &Path) -> Result<Scene, SceneError> {
        let refused = |_: &Path| {
            Err(std::io::Error::other(
                "files named by a scene are read only when the scene itself is read from a file",
            ))
        };
        Scene::parse_with(text, path, &refused)
    }

    /// As [`Scene::parse`], with a function that reads the files that the scene names (`tool.plan`,
    /// `manipulator.file`, `arm.urdf`, `structure.curve`). The returned scene holds their content and no
    /// longer names them.
    ///
    /// # Errors
    /// As [`Scene::parse`]; a file cannot be read, is of the wrong kind, or sets what the scene sets too.
    pub fn parse_with(text: &str, path: &Path, read: &ReadText) -> Result<Scene, SceneError> {
        let folder = path.parent().unwrap_or(Path::new("."));
        let mut given: toml::Table =
            toml::from_str(text).map_err(|cause| malformed(text, path, text, &cause))?;
        let checker = check::Checker { file: path };
        // The tool first: the plan's pilot hole is as wide as its burr.
        let tool = tool_file::put_in(&mut given, folder, read, &checker)?;
        let planned = plan::put_in(&mut given, folder, read, &checker)?;
        let arm = urdf::put_in(&mut given, folder, read, &checker)?;
        let curved = structure_curve::put_in(&mut given, folder, read, &checker)?;
        let completed = match tool || planned || arm || curved {
            // The scene as written, with its line numbers.
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
            if let Some(path) = &mut controller.fmu {
                *path = absolute(folder.join(&*path));
            }
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
        for object in self.drr.iter_mut().flat_map(|drr| &mut drr.object) {
            if let Some(mesh) = &mut object.mesh {
                mesh.file = absolute(folder.join(&mesh.file));
            }
        }
        for structure in &mut self.structure {
            let label = structure.label.iter_mut().map(|label| &mut label.file);
            for file in label.chain(structure.mesh.iter_mut().map(|mesh| &mut mesh.file)) {
                *file = absolute(folder.join(&*file));
            }
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

    /// The tick of the scheduled frame that controllers see at `tick` in lockstep: each becomes visible half
    /// a period after its tick, however long it took to render, so that a run repeats bit for bit. `None` if
    /// none is due.
    pub fn frame_seen_at(&self, tick: u64) -> Option<u64> {
        let period = self.frame_period_ticks()?;
        let frame = tick.checked_sub((period / 2).max(1))?;
        frame.is_multiple_of(period).then_some(frame)
    }

    /// Whether readings arrive: of sensors, or of the clearances from critical structures.
    pub fn has_readings(&self) -> bool {
        !self.sensor.is_empty() || !self.structure.is_empty()
    }

    /// Whether states are accompanied by the tip's Jacobian.
    pub fn has_tip_jacobian(&self) -> bool {
        self.manipulator.tip_jacobian == Some(true)
    }

    /// Ticks between two keyframes; `None` without keyframes.
    pub fn keyframe_period_ticks(&self) -> Option<u64> {
        let interval_s = self.recording.keyframe_interval_s;
        (interval_s > 0.0).then(|| (interval_s / self.dt_s() + 0.5).max(1.0) as u64)
    }
}
