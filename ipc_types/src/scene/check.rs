//! Ranges and combinations that a scene must keep.

use std::path::{Path, PathBuf};

use thiserror::Error;

use super::model::{Body, Controller, CurvedDrilling, Drives, Drr, Scene, Tool, Volume};
use crate::messages::{MAX_BODIES, MAX_CONTROLLERS};

/// Why a scene is refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SceneError {
    /// The file cannot be read.
    #[error("{file}: cannot be read ({cause})")]
    Unreadable {
        /// Scene file.
        file: PathBuf,
        /// The system's reason.
        cause: String,
    },
    /// Not TOML, an unknown or missing key, or a value of a wrong type.
    #[error("{file}, line {line}: {cause}")]
    Malformed {
        /// Scene file.
        file: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        cause: String,
    },
    /// A number is outside its range.
    #[error("{file}: `{key}` is {value}, allowed is {lowest} to {highest}")]
    OutOfRange {
        /// Scene file.
        file: PathBuf,
        /// Key with its path.
        key: String,
        /// Value given.
        value: f64,
        /// Lowest allowed.
        lowest: f64,
        /// Highest allowed.
        highest: f64,
    },
    /// Keys that contradict each other, or a text that is not one of the allowed ones.
    #[error("{file}: `{key}` {problem}")]
    Invalid {
        /// Scene file.
        file: PathBuf,
        /// Key with its path.
        key: String,
        /// What is wrong and what is expected.
        problem: String,
    },
}

struct Checker<'a> {
    file: &'a Path,
}

impl Checker<'_> {
    fn range(&self, key: &str, value: f64, lowest: f64, highest: f64) -> Result<(), SceneError> {
        // A NaN is in no range.
        if value >= lowest && value <= highest {
            return Ok(());
        }
        Err(SceneError::OutOfRange {
            file: self.file.to_owned(),
            key: key.to_owned(),
            value,
            lowest,
            highest,
        })
    }

    fn optional(&self, key: &str, value: Option<f64>, lowest: f64, highest: f64) -> Result<(), SceneError> {
        value.map_or(Ok(()), |value| self.range(key, value, lowest, highest))
    }

    fn each(&self, key: &str, values: &[f64; 3], lowest: f64, highest: f64) -> Result<(), SceneError> {
        values.iter().try_for_each(|value| self.range(key, *value, lowest, highest))
    }

    fn point_mm(&self, key: &str, point: &[f64; 3]) -> Result<(), SceneError> {
        self.each(key, point, -1e5, 1e5)
    }

    fn invalid(&self, key: &str, problem: impl Into<String>) -> SceneError {
        SceneError::Invalid { file: self.file.to_owned(), key: key.to_owned(), problem: problem.into() }
    }

    fn name(&self, key: &str, name: &str, allowed: fn(char) -> bool) -> Result<(), SceneError> {
        if !name.is_empty() && name.len() <= 64 && name.chars().all(allowed) {
            return Ok(());
        }
        Err(self.invalid(
            key,
            format!("is {name:?}; expected 1 to 64 letters, digits, `_` (and `-` in a scene's name)"),
        ))
    }
}

pub(super) fn check(scene: &Scene, file: &Path) -> Result<(), SceneError> {
    let checker = Checker { file };
    checker.name("name", &scene.name, |c| c.is_ascii_alphanumeric() || c == '_' || c == '-')?;
    check_run(scene, &checker)?;
    if let Some(volume) = &scene.volume {
        check_volume(volume, &checker)?;
    } else if !scene.predrill.is_empty() {
        return Err(checker.invalid("predrill", "needs a `[volume]` to be drilled into"));
    }
    for hole in &scene.predrill {
        checker.point_mm("predrill.from_mm", &hole.from_mm)?;
        checker.point_mm("predrill.to_mm", &hole.to_mm)?;
        checker.range("predrill.diameter_mm", hole.diameter_mm, 0.5, 50.0)?;
    }
    check_bodies(scene, &checker)?;
    check_tool(&scene.tool, &checker)?;
    checker.range("recording.image_every", scene.recording.image_every as f64, 1.0, 1e6)?;
    check_overrides(scene, &checker)?;
    if let Some(drr) = &scene.drr {
        check_drr(drr, &checker)?;
        if scene.volume.is_none() {
            return Err(checker.invalid("drr", "needs a `[volume]` to look through"));
        }
    }
    check_controllers(scene, &checker)
}

fn check_run(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    checker.range("run.duration_s", scene.run.duration_s, 0.001, 3600.0)?;
    checker.range("run.dt_ms", scene.run.dt_ms, 0.1, 10.0)?;
    checker.range("run.hold_ticks", scene.run.hold_ticks as f64, 0.0, 100_000.0)?;
    checker.range("run.controller_limit_ms", scene.run.controller_limit_ms, 10.0, 600_000.0)
}

fn check_volume(volume: &Volume, checker: &Checker) -> Result<(), SceneError> {
    match (&volume.phantom, &volume.path) {
        (Some(_), Some(_)) => {
            return Err(checker.invalid("volume", "has both `phantom` and `path`; expected one"));
        }
        (None, None) => {
            return Err(checker.invalid("volume", "has neither `phantom` nor `path`; expected one"));
        }
        _ => {}
    }
    if volume.mask && volume.path.is_none() {
        return Err(checker.invalid("volume.mask", "is for a file; a phantom is not a mask"));
    }
    if volume.resample_mm.is_some() && volume.path.is_none() {
        return Err(checker.invalid("volume.resample_mm", "is for a file; a phantom has `spacing_mm`"));
    }
    checker.optional("volume.resample_mm", volume.resample_mm, 0.25, 5.0)?;
    checker.range("volume.spacing_mm", volume.spacing_mm, 0.25, 2.0)?;
    checker.range("volume.bone_threshold_hu", f64::from(volume.bone_threshold_hu), -1000.0, 3000.0)?;
    checker.range("volume.block_density_ratio", volume.block_density_ratio, 0.1, 20.0)
}

fn check_bodies(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    checker.each("gravity_m_per_s2", &scene.gravity_m_per_s2, -100.0, 100.0)?;
    checker.range("body (their number)", scene.body.len() as f64, 0.0, MAX_BODIES as f64)?;
    for (index, body) in scene.body.iter().enumerate() {
        checker.name("body.name", &body.name, |c| c.is_ascii_alphanumeric() || c == '_')?;
        if scene.body[..index].iter().any(|other| other.name == body.name) {
            return Err(checker.invalid("body.name", format!("`{}` stands twice", body.name)));
        }
        check_shape(body, checker)?;
        checker.point_mm("body.position_mm", &body.position_mm)?;
        checker.each("body.rotation_vector_deg", &body.rotation_vector_deg, -360.0, 360.0)?;
        checker.range("body.density_kg_per_m3", body.density_kg_per_m3, 10.0, 25_000.0)?;
        checker.range("body.friction", body.friction, 0.0, 2.0)?;
    }
    Ok(())
}

fn check_shape(body: &Body, checker: &Checker) -> Result<(), SceneError> {
    let shapes = [body.cuboid.is_some(), body.ball.is_some(), body.capsule.is_some()];
    if shapes.iter().filter(|shape| **shape).count() != 1 {
        let problem = "needs exactly one of `cuboid`, `ball`, `capsule`";
        return Err(checker.invalid(&format!("body `{}`", body.name), problem));
    }
    let length = |key: &str, value_mm: f64| checker.range(key, value_mm, 0.1, 1000.0);
    if let Some(cuboid) = &body.cuboid {
        checker.each("body.cuboid.half_extents_mm", &cuboid.half_extents_mm, 0.1, 1000.0)?;
    }
    if let Some(ball) = &body.ball {
        length("body.ball.radius_mm", ball.radius_mm)?;
    }
    if let Some(capsule) = &body.capsule {
        length("body.capsule.half_height_mm", capsule.half_height_mm)?;
        length("body.capsule.radius_mm", capsule.radius_mm)?;
    }
    Ok(())
}

fn check_tool(tool: &Tool, checker: &Checker) -> Result<(), SceneError> {
    checker.point_mm("tool.burr_start_mm", &tool.burr_start_mm)?;
    let length = |v: &[f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    for (key, vector) in [("tool.direction", &tool.direction), ("tool.bend_toward", &tool.bend_toward)] {
        checker.range(key, length(vector), 1e-6, 1e6)?;
    }
    let [a, b] = [&tool.direction, &tool.bend_toward];
    let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    if length(&cross) < 1e-3 * length(a) * length(b) {
        return Err(
            checker.invalid("tool.bend_toward", "lies along `tool.direction`; expected another direction")
        );
    }
    Ok(())
}

fn check_overrides(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    let manipulator = &scene.manipulator;
    checker.optional("manipulator.tendon_friction", manipulator.tendon_friction, 0.0, 1.0)?;
    checker.optional("manipulator.damping_ratio", manipulator.damping_ratio, 0.001, 10.0)?;
    checker.optional("manipulator.stiffness_scale", manipulator.stiffness_scale, 0.001, 1000.0)?;
    checker.optional("manipulator.mass_scale", manipulator.mass_scale, 0.001, 1000.0)?;
    checker.optional("manipulator.mount_stiffness_n_per_m", manipulator.mount_stiffness_n_per_m, 1e3, 1e7)?;
    checker.optional("manipulator.burr_diameter_mm", manipulator.burr_diameter_mm, 1.0, 20.0)?;
    checker.optional("contact.friction", scene.contact.friction, 0.0, 2.0)?;
    checker.optional("contact.stiffness_n_per_m", scene.contact.stiffness_n_per_m, 1e3, 1e9)?;
    let drilling = &scene.drilling;
    checker.optional("drilling.specific_energy_j_per_mm3", drilling.specific_energy_j_per_mm3, 1e-4, 10.0)?;
    checker.optional("drilling.density_exponent", drilling.density_exponent, 0.0, 4.0)?;
    checker.optional("drilling.cutting_coefficient", drilling.cutting_coefficient, 0.01, 2.0)?;
    checker.range("arm.max_speed_mm_per_s", scene.arm.max_speed_mm_per_s, 0.01, 1000.0)?;
    checker.range("arm.max_acceleration_mm_per_s2", scene.arm.max_acceleration_mm_per_s2, 0.1, 1e4)?;
    checker.range("arm.max_jerk_mm_per_s3", scene.arm.max_jerk_mm_per_s3, 1.0, 1e6)
}

fn check_drr(drr: &Drr, checker: &Checker) -> Result<(), SceneError> {
    checker.range("drr.rate_hz", drr.rate_hz, 0.0, 100.0)?;
    checker.point_mm("drr.isocentre_mm", &drr.isocentre_mm)?;
    checker.range("drr.primary_angle_deg", drr.primary_angle_deg, -180.0, 180.0)?;
    checker.range("drr.secondary_angle_deg", drr.secondary_angle_deg, -90.0, 90.0)?;
    checker.range("drr.source_isocentre_mm", drr.source_isocentre_mm, 100.0, 2000.0)?;
    checker.range(
        "drr.source_detector_mm",
        drr.source_detector_mm,
        drr.source_isocentre_mm.max(200.0),
        3000.0,
    )?;
    checker.range("drr.columns", f64::from(drr.columns), 16.0, 4096.0)?;
    checker.range("drr.rows", f64::from(drr.rows), 16.0, 4096.0)?;
    checker.range("drr.pixel_pitch_mm", drr.pixel_pitch_mm, 0.05, 5.0)?;
    checker.range("drr.energy_kev", drr.energy_kev, 30.0, 120.0)?;
    checker.range("drr.photons_per_pixel", drr.photons_per_pixel, 0.0, 1e8)?;
    checker.range("drr.blur_pixels", drr.blur_pixels, 0.0, 5.0)?;
    checker.range("drr.threads", drr.threads as f64, 1.0, 64.0)
}

fn check_controllers(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    checker.range("controller (their number)", scene.controller.len() as f64, 0.0, MAX_CONTROLLERS as f64)?;
    let mut driven: Vec<(Drives, &str)> = Vec::new();
    for (index, controller) in scene.controller.iter().enumerate() {
        checker.name("controller.name", &controller.name, |c| c.is_ascii_alphanumeric() || c == '_')?;
        if scene.controller[..index].iter().any(|other| other.name == controller.name) {
            return Err(checker.invalid("controller.name", format!("`{}` stands twice", controller.name)));
        }
        for part in &controller.drives {
            if let Some((_, other)) = driven.iter().find(|(driven, _)| driven == part) {
                let problem =
                    format!("{part:?} is driven by `{other}` and by `{}`; expected one", controller.name);
                return Err(checker.invalid("controller.drives", problem));
            }
            driven.push((*part, &controller.name));
        }
        check_controller(controller, checker)?;
    }
    Ok(())
}

fn check_controller(controller: &Controller, checker: &Checker) -> Result<(), SceneError> {
    let kinds = [
        controller.curved_drilling.is_some(),
        controller.hold.is_some(),
        controller.command.is_some(),
        controller.external,
    ];
    if kinds.iter().filter(|kind| **kind).count() != 1 {
        let problem = "needs exactly one of `curved_drilling`, `hold`, `command`, `external`";
        return Err(checker.invalid(&format!("controller `{}`", controller.name), problem));
    }
    if let Some(drilling) = &controller.curved_drilling {
        check_curved_drilling(drilling, checker)?;
    }
    if let Some(hold) = &controller.hold {
        checker.range("controller.hold.tension_n", hold.tension_n, 0.0, 60.0)?;
    }
    if controller.command.as_ref().is_some_and(Vec::is_empty) {
        return Err(checker.invalid("controller.command", "is empty; expected a program and its arguments"));
    }
    Ok(())
}

fn check_curved_drilling(drilling: &CurvedDrilling, checker: &Checker) -> Result<(), SceneError> {
    let key = |name: &str| format!("controller.curved_drilling.{name}");
    checker.range(&key("feed_mm_per_s"), drilling.feed_mm_per_s, 0.01, 20.0)?;
    checker.range(&key("insertion_mm"), drilling.insertion_mm, 0.0, 200.0)?;
    checker.range(&key("tension_n"), drilling.tension_n, 0.0, 60.0)?;
    checker.range(&key("ramp_start_mm"), drilling.ramp_start_mm, 0.0, 200.0)?;
    checker.range(&key("ramp_end_mm"), drilling.ramp_end_mm, drilling.ramp_start_mm, 200.0)?;
    checker.range(&key("burr_speed_rpm"), drilling.burr_speed_rpm, 0.0, 60_000.0)?;
    checker.range(&key("guidance_gain_n_per_mm"), drilling.guidance_gain_n_per_mm, 0.0, 10.0)?;
    checker.range(&key("retraction_mm"), drilling.retraction_mm, 0.0, 200.0)?;
    checker.range(&key("retraction_mm_per_s"), drilling.retraction_mm_per_s, 0.01, 100.0)?;
    drilling.target_mm.as_ref().map_or(Ok(()), |target| checker.point_mm(&key("target_mm"), target))
}
