//! Arms, random numbers and limits shared by the arm tests.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use scene::Scene;
use simulation::arm::{
    Arm, ArmCommand, ArmParameters, ArmState, COMFORTABLE_Q_RAD, Joints, initial_q_rad, place_base_for,
    six_joints,
};
use std::path::Path;

pub const DT_S: f64 = 1e-3;

/// SplitMix64: a fixed stream of uniform numbers.
pub struct Uniform(pub u64);

impl Uniform {
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        low + (high - low) * ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn joints(&mut self, range: f64) -> Joints {
        six_joints(std::array::from_fn(|_| self.between(-range, range)))
    }

    pub fn vector(&mut self, range: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.between(-range, range))
    }
}

/// A UR5 with its flange at a pose of the patient frame, in a comfortable configuration.
pub fn arm() -> Arm {
    let mut parameters = ArmParameters::ur5(DT_S);
    let wanted = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.4, 0.5, -0.6));
    let q = COMFORTABLE_Q_RAD;
    let base = place_base_for(&parameters.geometry, &wanted, &q);
    parameters.t_world_arm_base = base;
    let Ok(arm) = Arm::new(parameters, &q) else { unreachable!("the UR5's own parameters are valid") };
    arm
}

/// Pose of the tool's base on the flange in these tests: offset and rotated.
pub fn t_flange_tool() -> Isometry3<f64> {
    Isometry3::new(Vector3::new(0.02, -0.01, 0.09), Vector3::new(0.3, -0.2, 0.5))
}

/// A UR5 that holds its tool at a pose of the patient frame, in a comfortable configuration.
pub fn guided_arm() -> Arm {
    let mut parameters = ArmParameters::ur5(DT_S);
    parameters.geometry = parameters.geometry.with_tool(Some(t_flange_tool()));
    let wanted = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.4, 0.5, -0.6));
    parameters.t_world_arm_base = place_base_for(&parameters.geometry, &wanted, &COMFORTABLE_Q_RAD);
    Arm::new(parameters, &COMFORTABLE_Q_RAD).unwrap()
}

/// The arm of the seven-joint example scene, a KUKA LBR iiwa 14 R820, with additional keys of `[arm]`.
pub fn seven_joint_arm(keys: &str) -> Arm {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/examples/arm_seven_joints.toml");
    let text = std::fs::read_to_string(&file).unwrap().replacen("[arm]\n", &format!("[arm]\n{keys}\n"), 1);
    let scene = Scene::parse(&text, &file).unwrap();
    let parameters = ArmParameters::of(&scene.arm, DT_S);
    assert_eq!(parameters.geometry.joints(), 7);
    Arm::new(parameters, &initial_q_rad(&scene.arm)).unwrap()
}

/// The flange moved by `shift` along its own axes and rotated by `turn` about them.
pub fn moved(from: &Isometry3<f64>, shift: Vector3<f64>, turn: Vector3<f64>) -> Isometry3<f64> {
    from * Isometry3::from_parts(Translation3::from(shift), UnitQuaternion::from_scaled_axis(turn))
}

pub fn move_cp(t_world_tool: Isometry3<f64>) -> ArmCommand {
    ArmCommand::MoveCp { t_world_tool, max_speed_m_s: None, max_angular_speed_rad_s: None }
}

/// The tool's base `before_m` in front of the pivot, rotated by `turn` about it.
pub fn about_pivot(
    from: &Isometry3<f64>,
    pivot_m: &Vector3<f64>,
    turn: Vector3<f64>,
    before_m: f64,
) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(turn) * from.rotation;
    let origin = pivot_m - rotation * Vector3::z() * before_m;
    Isometry3::from_parts(Translation3::from(origin), rotation)
}

/// Largest fractions of the joint limits used between two ticks: position excess (rad), velocity,
/// acceleration, jerk.
#[derive(Default, Debug)]
pub struct UsedLimits {
    pub beyond_rad: f64,
    pub velocity: f64,
    pub acceleration: f64,
    pub jerk: f64,
}

impl UsedLimits {
    pub fn add(&mut self, arm: &Arm, before: &ArmState) {
        let limits = &arm.parameters().joint_limits;
        let s = arm.state();
        for i in 0..limits.lower_rad.len() {
            let beyond = (s.q_rad[i] - limits.upper_rad[i]).max(limits.lower_rad[i] - s.q_rad[i]);
            self.beyond_rad = self.beyond_rad.max(beyond);
            self.velocity = self.velocity.max(s.qd_rad_s[i].abs() / limits.velocity_rad_s[i]);
            self.acceleration = self.acceleration.max(s.qdd_rad_s2[i].abs() / limits.acceleration_rad_s2[i]);
            let jerk = (s.qdd_rad_s2[i] - before.qdd_rad_s2[i]).abs() / DT_S;
            self.jerk = self.jerk.max(jerk / limits.jerk_rad_s3[i]);
        }
    }

    /// Asserts that the position is within its limits to `beyond_rad`, and velocity, acceleration and jerk
    /// within theirs apart from Ruckig's own tolerance (1e-8, 1e-10, 1e-12 in its README, of the end state;
    /// the last tick can change the acceleration by that much within 1 ms).
    pub fn check(&self, beyond_rad: f64) {
        assert!(self.beyond_rad <= beyond_rad, "{self:?}");
        assert!(
            self.velocity <= 1.0 + 1e-8 && self.acceleration <= 1.0 + 1e-8 && self.jerk <= 1.0 + 1e-4,
            "{self:?}"
        );
    }
}

/// Steps until done; returns the number of ticks.
pub fn finish(arm: &mut Arm, used: &mut UsedLimits) -> usize {
    let mut ticks = 0;
    while ticks == 0 || !arm.state().done {
        let before = *arm.state();
        arm.step();
        used.add(arm, &before);
        ticks += 1;
        assert!(ticks < 400_000, "the motion does not end");
    }
    ticks
}

/// Steps until done, passing every state to `look`; returns the number of ticks.
pub fn finish_looking(arm: &mut Arm, mut look: impl FnMut(&ArmState)) -> usize {
    let mut used = UsedLimits::default();
    for ticks in 1..400_000 {
        let before = *arm.state();
        arm.step();
        used.add(arm, &before);
        look(arm.state());
        assert_eq!(arm.state().fault, None);
        if arm.state().done {
            used.check(1e-8);
            return ticks;
        }
    }
    panic!("the motion does not end");
}

pub fn run(arm: &mut Arm, ticks: usize) {
    for _ in 0..ticks {
        arm.step();
    }
}

/// Rest-to-rest time over `distance` by symmetric jerk limits: the double-S profile of Biagiotti and
/// Melchiorri, "Trajectory Planning for Automatic Machines and Robots" (2008), section 3.4.
pub fn rest_to_rest_s(distance: f64, v: f64, a: f64, j: f64) -> f64 {
    let (jerk_s, acceleration_s) =
        if v * j >= a * a { (a / j, a / j + v / a) } else { ((v / j).sqrt(), 2.0 * (v / j).sqrt()) };
    let cruise_s = distance / v - acceleration_s;
    if cruise_s >= 0.0 {
        2.0 * acceleration_s + cruise_s
    } else if v * j >= a * a && distance >= 2.0 * a * a * a / (j * j) {
        jerk_s + (jerk_s * jerk_s + 4.0 * distance / a).sqrt()
    } else {
        4.0 * (distance / (2.0 * j)).cbrt()
    }
}
