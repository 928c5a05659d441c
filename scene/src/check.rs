//! Checks a scene's ranges and combinations of keys.

use std::path::{Path, PathBuf};

use foreign_text::foreign_line;
use thiserror::Error;

use super::LONGEST_RUN_S;
use super::drr::{CArm, Display, Drr};
use super::model::{
    Arm, Body, Controller, CurvedDrilling, Drives, Feedback, ManipulatorRung, Scene, Skiving, TensionSweep,
    Tool, Volume,
};
use messages::{MAX_BODIES, MAX_CONTROLLERS, MAX_TENDONS};

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
    #[error("{file}, line {line}: {}", foreign_line(.cause))]
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
    /// Keys contradict each other, or a text is not one of the allowed ones.
    #[error("{file}: `{key}` {}", foreign_line(.problem))]
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
        // Written so that NaN fails.
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
    if let Some(tolerance) = &scene.tolerance {
        checker.optional("tolerance.tip_mm", tolerance.tip_mm, 1e-3, 100.0)?;
        checker.optional("tolerance.path_mm", tolerance.path_mm, 1e-3, 100.0)?;
        checker.optional("tolerance.drr_rel", tolerance.drr_rel, 1e-9, 1.0)?;
    }
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
    if scene.recording.keyframe_interval_s != 0.0 {
        checker.range("recording.keyframe_interval_s", scene.recording.keyframe_interval_s, 0.01, 3600.0)?;
    }
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
    checker.range("run.duration_s", scene.run.duration_s, 0.001, LONGEST_RUN_S)?;
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
    let links = manipulator.links.map(|links| links as f64);
    checker.optional("manipulator.links", links, 1.0, messages::MAX_JOINTS as f64)?;
    check_tendons(scene, checker)?;
    let [lateral, torsion] = [manipulator.lateral_stiffness_ratio, manipulator.torsion_stiffness_ratio];
    checker.optional("manipulator.lateral_stiffness_ratio", lateral, 1e-3, 1e3)?;
    checker.optional("manipulator.torsion_stiffness_ratio", torsion, 1e-3, 1e3)?;
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
    check_arm(&scene.arm, checker)
}

fn check_tendons(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    if scene.tendon.len() > MAX_TENDONS {
        let problem = format!("has {} entries; expected at most {MAX_TENDONS}", scene.tendon.len());
        return Err(checker.invalid("tendon", problem));
    }
    // A tolerance lets the tendons determine the model.
    let model = scene.manipulator.model;
    let flat = match model {
        None => !scene.tolerance.as_ref().is_some_and(|t| t.tip_mm.is_some() || t.path_mm.is_some()),
        Some(model) => matches!(model, ManipulatorRung::Planar | ManipulatorRung::ConstantCurvature),
    };
    for tendon in &scene.tendon {
        checker.range("tendon.toward_mm", tendon.toward_mm, -10.0, 10.0)?;
        checker.range("tendon.across_mm", tendon.across_mm, -10.0, 10.0)?;
        if flat && tendon.across_mm != 0.0 {
            let problem = "bends out of the plane; expected `manipulator.model` to be spatial or full";
            return Err(checker.invalid("tendon.across_mm", problem));
        }
    }
    Ok(())
}

fn check_arm(arm: &Arm, checker: &Checker) -> Result<(), SceneError> {
    checker.range("arm.max_speed_mm_per_s", arm.max_speed_mm_per_s, 0.01, 1000.0)?;
    checker.range("arm.max_acceleration_mm_per_s2", arm.max_acceleration_mm_per_s2, 0.1, 1e4)?;
    checker.range("arm.max_jerk_mm_per_s3", arm.max_jerk_mm_per_s3, 1.0, 1e6)?;
    checker.optional("arm.max_turn_deg_per_s", arm.max_turn_deg_per_s, 0.01, 360.0)?;
    checker.optional("arm.max_turn_deg_per_s2", arm.max_turn_deg_per_s2, 0.1, 1e4)?;
    checker.optional("arm.max_turn_deg_per_s3", arm.max_turn_deg_per_s3, 1.0, 1e6)?;
    checker.optional("arm.max_joint_speed_deg_per_s", arm.max_joint_speed_deg_per_s, 0.01, 180.0)?;
    let acceleration = arm.max_joint_acceleration_deg_per_s2;
    checker.optional("arm.max_joint_acceleration_deg_per_s2", acceleration, 0.1, 1e4)?;
    checker.optional("arm.max_joint_jerk_deg_per_s3", arm.max_joint_jerk_deg_per_s3, 1.0, 1e6)?;
    let standard = [360.0, 360.0, 180.0, 360.0, 360.0, 360.0];
    let lower = arm.lower_joints_deg.unwrap_or(standard.map(|angle: f64| -angle));
    let upper = arm.upper_joints_deg.unwrap_or(standard);
    for i in 0..6 {
        checker.range("arm.lower_joints_deg", lower[i], -360.0, 360.0)?;
        checker.range("arm.upper_joints_deg", upper[i], lower[i] + 1e-3, 360.0)?;
        if let Some(start) = arm.initial_joints_deg {
            checker.range("arm.initial_joints_deg", start[i], lower[i], upper[i])?;
        }
    }
    if let Some(compliance) = &arm.compliance {
        let key = |name: &str| format!("arm.compliance.{name}");
        for i in 0..6 {
            let (stiffness, damping) =
                (compliance.joint_stiffness_nm_per_rad[i], compliance.joint_damping_nms_per_rad[i]);
            checker.range(&key("joint_stiffness_nm_per_rad"), stiffness, 1.0, 1e7)?;
            checker.range(&key("joint_damping_nms_per_rad"), damping, 0.0, 1e5)?;
        }
    }
    checker.each("arm.tool_position_mm", &arm.tool_position_mm, -1000.0, 1000.0)?;
    checker.each("arm.tool_rotation_vector_deg", &arm.tool_rotation_vector_deg, -360.0, 360.0)
}

fn check_drr(drr: &Drr, checker: &Checker) -> Result<(), SceneError> {
    checker.range("drr.rate_hz", drr.rate_hz, 0.0, 200.0)?;
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
    checker.range("drr.oversampling", drr.oversampling, 0.8, 4.0)?;
    checker.range("drr.reduction", f64::from(drr.reduction), 2.0, 8.0)?;
    checker.range("drr.detector.gain", drr.detector.gain, 0.01, 100.0)?;
    checker.range("drr.detector.offset", drr.detector.offset, 0.0, 0.5)?;
    checker.optional("drr.detector.saturation", drr.detector.saturation, 0.01, 100.0)?;
    if let Some(spectrum) = &drr.spectrum {
        checker.range("drr.spectrum.tube_kv", spectrum.tube_kv, 50.0, 120.0)?;
        checker.range("drr.spectrum.aluminium_mm", spectrum.aluminium_mm, 0.0, 20.0)?;
        checker.range("drr.spectrum.ct_energy_kev", spectrum.ct_energy_kev, 30.0, 120.0)?;
        checker.range("drr.spectrum.bone_above_hu", spectrum.bone_above_hu, 0.0, 1000.0)?;
    }
    if let Some(notch) = &drr.notch {
        checker.range("drr.notch.width_mm", notch.width_mm, 0.01, 5.0)?;
        checker.range("drr.notch.depth_mm", notch.depth_mm, 0.01, 5.9)?;
    }
    if let Some(carm) = &drr.carm {
        check_c_arm(carm, checker)?;
    }
    checker.range("drr.threads", drr.threads as f64, 1.0, 64.0)
}

/// Requires exactly one of the two forms, complete. The values are checked where they become a C-arm.
fn check_c_arm(carm: &CArm, checker: &Checker) -> Result<(), SceneError> {
    let camera = [carm.intrinsics.is_some(), carm.rotation.is_some(), carm.translation_mm.is_some()];
    let points = [
        carm.source_mm.is_some(),
        carm.detector_centre_mm.is_some(),
        carm.row_axis.is_some(),
        carm.column_axis.is_some(),
    ];
    let (any, all) = (|keys: &[bool]| keys.contains(&true), |keys: &[bool]| !keys.contains(&false));
    let as_camera = all(&camera) && !any(&points);
    let as_points = all(&points) && !any(&camera) && carm.pixel_centre.is_none();
    if as_camera || as_points {
        return Ok(());
    }
    let problem = "is not one C-arm; expected either `intrinsics`, `rotation`, `translation_mm` (and `pixel_centre`), or \
                   `source_mm`, `detector_centre_mm`, `row_axis`, `column_axis`";
    Err(checker.invalid("drr.carm", problem))
}

/// Names of the other parts, and end reasons that are not names of parts: a log's end names who caused it.
const RESERVED_NAMES: [&str; 6] = ["physics", "drr", "recorder", "launcher", "completed", "interrupted"];

fn check_controllers(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    checker.range("controller (their number)", scene.controller.len() as f64, 0.0, MAX_CONTROLLERS as f64)?;
    let mut driven: Vec<(Drives, &str)> = Vec::new();
    for (index, controller) in scene.controller.iter().enumerate() {
        checker.name("controller.name", &controller.name, |c| c.is_ascii_alphanumeric() || c == '_')?;
        if RESERVED_NAMES.contains(&controller.name.as_str()) {
            let problem = format!(
                "`{}` is the name of something else; expected none of {RESERVED_NAMES:?}",
                controller.name
            );
            return Err(checker.invalid("controller.name", problem));
        }
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
        check_image_feedback(controller, scene.drr.as_ref(), checker)?;
    }
    Ok(())
}

/// Image feedback finds the burr as the darkest end of the tool, so it needs frames in which metal is dark.
fn check_image_feedback(
    controller: &Controller,
    drr: Option<&Drr>,
    checker: &Checker,
) -> Result<(), SceneError> {
    let Some(drilling) = &controller.curved_drilling else { return Ok(()) };
    let problem = match drr {
        _ if drilling.feedback != Feedback::Image => return Ok(()),
        None if drilling.guidance_gain_n_per_mm > 0.0 => {
            "is `image` with a gain, but there is no `[drr]`; expected `[drr]`, or `shape` or `none`"
        }
        Some(drr) if drr.display != Display::BoneDark => {
            "is `image`, which finds the burr as the darkest; expected `drr.display = \"bone_dark\"`, or `shape` or `none`"
        }
        _ => return Ok(()),
    };
    Err(checker.invalid("controller.curved_drilling.feedback", problem))
}

fn check_controller(controller: &Controller, checker: &Checker) -> Result<(), SceneError> {
    let kinds = [
        controller.curved_drilling.is_some(),
        controller.skiving.is_some(),
        controller.tension_sweep.is_some(),
        controller.hold.is_some(),
        controller.command.is_some(),
        controller.external,
    ];
    if kinds.iter().filter(|kind| **kind).count() != 1 {
        let problem = "needs exactly one of `curved_drilling`, `skiving`, `tension_sweep`, `hold`, `command`, `external`";
        return Err(checker.invalid(&format!("controller `{}`", controller.name), problem));
    }
    checker.range("controller.connect_limit_s", controller.connect_limit_s, 1.0, 3600.0)?;
    if controller.optional && !controller.external && controller.command.is_none() {
        let problem = "is for a controller with `external` or `command`";
        return Err(checker.invalid("controller.optional", problem));
    }
    checker.range("controller.restarts", f64::from(controller.restarts), 0.0, 1000.0)?;
    if controller.restarts > 0 && controller.command.is_none() {
        return Err(checker.invalid("controller.restarts", "is for a controller with `command`"));
    }
    if let Some(drilling) = &controller.curved_drilling {
        check_curved_drilling(drilling, checker)?;
    }
    if let Some(skiving) = &controller.skiving {
        check_skiving(skiving, checker)?;
    }
    if let Some(sweep) = &controller.tension_sweep {
        check_sweep(sweep, checker)?;
    }
    if let Some(hold) = &controller.hold {
        checker.range("controller.hold.tension_n", hold.tension_n, 0.0, 60.0)?;
    }
    if controller.command.as_ref().is_some_and(Vec::is_empty) {
        return Err(checker.invalid("controller.command", "is empty; expected a program and its arguments"));
    }
    Ok(())
}

fn check_skiving(skiving: &Skiving, checker: &Checker) -> Result<(), SceneError> {
    checker.range("controller.skiving.feed_mm_per_s", skiving.feed_mm_per_s, 0.01, 20.0)?;
    checker.range("controller.skiving.depth_mm", skiving.depth_mm, 0.1, 200.0)?;
    checker.range("controller.skiving.tension_n", skiving.tension_n, 0.0, 60.0)?;
    checker.range("controller.skiving.burr_speed_rpm", skiving.burr_speed_rpm, 0.0, 60_000.0)
}

fn check_sweep(sweep: &TensionSweep, checker: &Checker) -> Result<(), SceneError> {
    let key = |name: &str| format!("controller.tension_sweep.{name}");
    match (sweep.most_n.zip(sweep.step_n), sweep.most_mm.zip(sweep.step_mm)) {
        (Some((most_n, step_n)), None) if sweep.most_mm.is_none() && sweep.step_mm.is_none() => {
            checker.range(&key("most_n"), most_n, 0.1, 60.0)?;
            checker.range(&key("step_n"), step_n, 0.01, most_n)?;
        }
        (None, Some((most_mm, step_mm))) if sweep.most_n.is_none() && sweep.step_n.is_none() => {
            checker.range(&key("most_mm"), most_mm, 0.01, 20.0)?;
            checker.range(&key("step_mm"), step_mm, 0.001, most_mm)?;
        }
        _ => {
            let problem = "needs either `most_n` and `step_n` or `most_mm` and `step_mm`";
            return Err(checker.invalid("controller.tension_sweep", problem));
        }
    }
    checker.range(&key("settle_s"), sweep.settle_s, 0.02, 60.0)
}

fn check_curved_drilling(drilling: &CurvedDrilling, checker: &Checker) -> Result<(), SceneError> {
    let key = |name: &str| format!("controller.curved_drilling.{name}");
    checker.range(&key("feed_mm_per_s"), drilling.feed_mm_per_s, 0.01, 20.0)?;
    checker.range(&key("insertion_mm"), drilling.insertion_mm, 0.0, 200.0)?;
    if drilling.tension_n.is_some() == drilling.calibration.is_some() {
        return Err(
            checker.invalid("controller.curved_drilling", "needs either `tension_n` or `calibration`")
        );
    }
    if drilling.calibration.is_some() && drilling.target_mm.is_none() {
        return Err(checker.invalid(&key("calibration"), "needs a `target_mm`, from which the bend follows"));
    }
    checker.optional(&key("tension_n"), drilling.tension_n, 0.0, 60.0)?;
    checker.range(&key("ramp_start_mm"), drilling.ramp_start_mm, 0.0, 200.0)?;
    checker.range(&key("ramp_end_mm"), drilling.ramp_end_mm, drilling.ramp_start_mm, 200.0)?;
    checker.range(&key("burr_speed_rpm"), drilling.burr_speed_rpm, 0.0, 60_000.0)?;
    checker.range(&key("guidance_gain_n_per_mm"), drilling.guidance_gain_n_per_mm, 0.0, 10.0)?;
    checker.range(&key("retraction_mm"), drilling.retraction_mm, 0.0, 200.0)?;
    checker.range(&key("retraction_mm_per_s"), drilling.retraction_mm_per_s, 0.01, 100.0)?;
    drilling.target_mm.as_ref().map_or(Ok(()), |target| checker.point_mm(&key("target_mm"), target))
}
