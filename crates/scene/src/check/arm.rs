//! Checks how the keys of `[arm]` relate to each other.

use core::ops::RangeInclusive;

use messages::MAX_ARM_JOINTS;

use super::Checker;
use crate::declaration::Range;
use crate::error::SceneError;
use crate::model::{Arm, ArmJoint, ArmModel};

/// Number of revolute joints: fewer cannot place and orient a tool freely, and the messages have room for no
/// more.
pub(crate) const TURNING: RangeInclusive<usize> = 6..=MAX_ARM_JOINTS;

/// Smallest scale factor of a mesh, m per file unit: micrometres.
const LEAST_SCALE: f64 = 1e-6;

pub(super) fn check(arm: &Arm, checker: &Checker) -> Result<(), SceneError> {
    for (key, given) in [("arm.base_link", &arm.base_link), ("arm.tip_link", &arm.tip_link)] {
        if given.is_some() {
            return Err(checker.invalid(key, "names a URDF link, but `arm.urdf` is not set"));
        }
    }
    if arm.meshes.is_some() {
        let problem = "applies to the meshes of a URDF file, but `arm.urdf` is not set";
        return Err(checker.invalid("arm.meshes", problem));
    }
    check_meshes(arm, checker)?;
    if arm.xray_density_g_per_cm3.is_some() && arm.mesh.as_ref().is_none_or(Vec::is_empty) {
        let problem = "needs arm meshes, but the arm has none; set `arm.urdf` (with meshes) or `arm.mesh`";
        return Err(checker.invalid("arm.xray_density_g_per_cm3", problem));
    }
    if let Some(model @ (ArmModel::Fixed | ArmModel::Gantry)) = arm.model {
        check_bench(arm, model, checker)?;
    }
    if arm.travel_mm.is_some() && arm.model != Some(ArmModel::Gantry) {
        return Err(
            checker.invalid("arm.travel_mm", "applies only to a gantry; set `arm.model = \"gantry\"`")
        );
    }
    let [lower, upper] = match &arm.joint {
        None => {
            let standard = [360.0, 360.0, 180.0, 360.0, 360.0, 360.0];
            [standard.map(|angle: f64| -angle).to_vec(), standard.to_vec()]
        }
        Some(joints) => check_joints(arm, joints, checker)?,
    };
    check_redundant(arm, checker)?;
    let count = lower.len();
    for (key, given) in [
        ("arm.lower_joints_deg", &arm.lower_joints_deg),
        ("arm.upper_joints_deg", &arm.upper_joints_deg),
        ("arm.initial_joints_deg", &arm.initial_joints_deg),
    ] {
        if let Some(given) = given.as_ref().filter(|given| given.len() != count) {
            let problem = format!("has {} angles, expected {count}: one per revolute joint", given.len());
            return Err(checker.invalid(key, problem));
        }
    }
    let lower = arm.lower_joints_deg.as_ref().unwrap_or(&lower);
    let upper = arm.upper_joints_deg.as_ref().unwrap_or(&upper);
    for i in 0..count {
        // An arm's own joint limits can exceed those of the keys: 2 pi in a file is slightly more than 360
        // degrees.
        let above = Range { lowest: lower[i] + 1e-3, highest: upper[i].max(360.0), or_zero: false };
        checker.range("arm.upper_joints_deg", upper[i], above)?;
        if let Some(start) = &arm.initial_joints_deg {
            let joint = Range { lowest: lower[i], highest: upper[i], or_zero: false };
            checker.range("arm.initial_joints_deg", start[i], joint)?;
        }
    }
    Ok(())
}

/// Refuses joint keys on an arm without joints, and motion keys on a fixed one.
fn check_bench(arm: &Arm, model: ArmModel, checker: &Checker) -> Result<(), SceneError> {
    let given = [
        ("arm.joint", arm.joint.is_some()),
        ("arm.lower_joints_deg", arm.lower_joints_deg.is_some()),
        ("arm.upper_joints_deg", arm.upper_joints_deg.is_some()),
        ("arm.initial_joints_deg", arm.initial_joints_deg.is_some()),
        ("arm.max_joint_speed_deg_per_s", arm.max_joint_speed_deg_per_s.is_some()),
        ("arm.max_joint_acceleration_deg_per_s2", arm.max_joint_acceleration_deg_per_s2.is_some()),
        ("arm.max_joint_jerk_deg_per_s3", arm.max_joint_jerk_deg_per_s3.is_some()),
        ("arm.compliance", arm.compliance.is_some()),
        ("arm.max_turn_deg_per_s", arm.max_turn_deg_per_s.is_some()),
        ("arm.max_turn_deg_per_s2", arm.max_turn_deg_per_s2.is_some()),
        ("arm.max_turn_deg_per_s3", arm.max_turn_deg_per_s3.is_some()),
    ];
    if model == ArmModel::Fixed && arm.max_force_n.is_some() {
        return Err(
            checker.invalid("arm.max_force_n", "needs an arm that moves, but `arm.model` is \"fixed\"")
        );
    }
    match given.iter().find(|(_, given)| *given) {
        Some((key, _)) => {
            let name = if model == ArmModel::Gantry { "gantry" } else { "fixed" };
            let problem = format!("needs an arm with revolute joints, but `arm.model` is \"{name}\"");
            Err(checker.invalid(key, problem))
        }
        None => Ok(()),
    }
}

/// Checks that the redundant joint is a revolute joint of a seven-joint arm.
fn check_redundant(arm: &Arm, checker: &Checker) -> Result<(), SceneError> {
    let Some(name) = &arm.redundant_joint else { return Ok(()) };
    let joints = arm.joint.as_deref().unwrap_or_default();
    let turning: Vec<&str> =
        joints.iter().filter(|joint| joint.axis.is_some()).map(|joint| joint.name.as_str()).collect();
    let problem = if turning.len() != MAX_ARM_JOINTS {
        format!("needs an arm with {MAX_ARM_JOINTS} revolute joints; this arm has no redundant joint")
    } else if turning.contains(&name.as_str()) {
        return Ok(());
    } else {
        let known = turning.iter().map(|name| foreign_text::foreign(name).to_string()).collect::<Vec<_>>();
        format!("is `{}`, expected a revolute joint: {}", foreign_text::foreign(name), known.join(", "))
    };
    Err(checker.invalid("arm.redundant_joint", problem))
}

/// Checks that each mesh names an existing joint and has a nonzero scale.
fn check_meshes(arm: &Arm, checker: &Checker) -> Result<(), SceneError> {
    let Some(meshes) = &arm.mesh else { return Ok(()) };
    let Some(joints) = &arm.joint else {
        let problem = "needs `arm.joint`, the joints that the meshes move with";
        return Err(checker.invalid("arm.mesh", problem));
    };
    for mesh in meshes {
        if let Some(name) = &mesh.joint
            && !joints.iter().any(|joint| joint.name == *name)
        {
            let name = foreign_text::foreign(name);
            let problem =
                format!("is `{name}`, expected the name of an `arm.joint`; omit the key for the base");
            return Err(checker.invalid("arm.mesh.joint", problem));
        }
        if let Some(digits) = &mesh.file_xxh3
            && !(digits.len() == 32 && digits.bytes().all(|byte| byte.is_ascii_hexdigit()))
        {
            let problem = format!("is `{}`, expected 32 hexadecimal digits", foreign_text::foreign(digits));
            return Err(checker.invalid("arm.mesh.file_xxh3", problem));
        }
        if mesh.scale.iter().any(|factor| factor.abs() < LEAST_SCALE) {
            let problem = format!(
                "is {:?}, expected factors of at least {LEAST_SCALE} in magnitude (negative ones mirror)",
                mesh.scale
            );
            return Err(checker.invalid("arm.mesh.scale", problem));
        }
    }
    Ok(())
}

/// Returns the joint limits of an arm described in the scene.
fn check_joints(arm: &Arm, joints: &[ArmJoint], checker: &Checker) -> Result<[Vec<f64>; 2], SceneError> {
    let refused = |key: &str, problem: String| Err(checker.invalid(key, problem));
    if arm.model.is_some() {
        return refused(
            "arm.model",
            "and `arm.joint` or `arm.urdf` are mutually exclusive; set only one".to_owned(),
        );
    }
    if arm.compliance.is_some() {
        return refused(
            "arm.compliance",
            "needs the arm's link masses, which only a named `arm.model` has".to_owned(),
        );
    }
    let turning: Vec<&ArmJoint> = joints.iter().filter(|joint| joint.axis.is_some()).collect();
    let count = turning.len();
    if !TURNING.contains(&count) {
        let (least, most) = (TURNING.start(), TURNING.end());
        let problem = format!(
            "has {count} revolute joints, expected {least} or {most}: fewer cannot place a tool freely, \
             and the state has room for no more"
        );
        return refused("arm.joint", problem);
    }
    for (index, joint) in joints.iter().enumerate() {
        if joints[..index].iter().any(|other| other.name == joint.name) {
            return refused(
                "arm.joint.name",
                format!("has a duplicate: `{}`", foreign_text::foreign(&joint.name)),
            );
        }
    }
    let mut ends = [Vec::new(), Vec::new()];
    for joint in turning {
        let name = foreign_text::foreign(&joint.name);
        let length = joint.axis.unwrap_or_default().iter().map(|x| x * x).sum::<f64>().sqrt();
        if length < 1e-6 {
            return refused(
                "arm.joint.axis",
                format!("of `{name}` is the zero vector; expected a direction of any other length"),
            );
        }
        let (Some(lower), Some(upper), Some(_)) =
            (joint.lower_deg, joint.upper_deg, joint.max_speed_deg_per_s)
        else {
            let problem =
                format!("`{name}` is revolute; set its `lower_deg`, `upper_deg` and `max_speed_deg_per_s`");
            return refused("arm.joint", problem);
        };
        checker.at_least("arm.joint.upper_deg", upper, lower + 1e-3)?;
        ends[0].push(lower);
        ends[1].push(upper);
    }
    if arm.initial_joints_deg.is_none() {
        let problem = "is missing; expected the arm's start angles, away from singularities".to_owned();
        return refused("arm.initial_joints_deg", problem);
    }
    Ok(ends)
}
