//! Builds the messages that the bridge publishes for a state, as CDR.

use messages::{ArmMode, ArmStatus, MAX_TENDONS, Phase, SensorReading, State, TipJacobian};
use nalgebra::{UnitQuaternion, Vector3};
use scene::Structure;
use serde::Serialize;

use crate::cdr;
use crate::commander::OperatingState;
use crate::msg::{
    Clock, Float64, Float64MultiArray, Header, JointState, MultiArrayDimension, MultiArrayLayout,
    OperatingStateMessage, PoseStamped, Text, TfMessage, Time, TransformStamped, TwistStamped, UInt64,
    WrenchStamped,
};
use crate::robot::{FrameInParent, Robot, WORLD, isometry};
use crate::topics::{Output, TUBE_JOINT_NAMES, joint_names};

/// An outgoing message.
#[derive(Debug, Clone, PartialEq)]
pub struct Outgoing {
    /// Its topic.
    pub topic: Output,
    /// Its CDR.
    pub cdr: Vec<u8>,
}

/// Appends a message. Every message that this crate builds can be expressed in CDR.
pub(crate) fn push<T: Serialize>(to: &mut Vec<Outgoing>, topic: Output, message: &T) {
    to.extend(cdr::encode(message).ok().map(|cdr| Outgoing { topic, cdr }));
}

fn header(stamp: Time, frame_id: &str) -> Header {
    Header { stamp, frame_id: frame_id.to_owned() }
}

/// Returns the messages that change with a state.
pub fn of_state(robot: &Robot, state: &State) -> Vec<Outgoing> {
    let stamp = Time::of_simulated(state.sim_time_s);
    let mut out = Vec::with_capacity(16);
    push(&mut out, Output::Clock, &Clock { clock: stamp });
    arm(&mut out, robot, state, stamp);
    tool(&mut out, robot, state, stamp);
    let transforms = robot.moving(state).into_iter().map(|placed| transform(placed, stamp)).collect();
    push(&mut out, Output::Tf, &TfMessage { transforms });
    out
}

fn arm(out: &mut Vec<Outgoing>, robot: &Robot, state: &State, stamp: Time) {
    let name = robot.arm_joints().to_vec();
    let joints = name.len();
    let measured = JointState {
        header: header(stamp, ""),
        name: name.clone(),
        position: state.arm_joint_position_rad[..joints].to_vec(),
        velocity: state.arm_joint_velocity_rad_per_s[..joints].to_vec(),
        effort: Vec::new(),
    };
    push(out, Output::ArmMeasuredJs, &measured);
    let drive = |joint: usize| state.arm_joint_position_rad[joint] - state.arm_joint_deflection_rad[joint];
    let position = (0..joints).map(drive).collect();
    let setpoint = JointState { header: header(stamp, ""), name, position, ..JointState::default() };
    push(out, Output::ArmSetpointJs, &setpoint);

    let base = PoseStamped { header: header(stamp, WORLD), pose: (&state.t_world_base).into() };
    push(out, Output::ArmMeasuredCp, &base);
    if let Some([linear, angular]) = robot.base_velocity(state) {
        let (linear, angular) = (linear.into(), angular.into());
        push(out, Output::ArmMeasuredCv, &TwistStamped { header: header(stamp, WORLD), linear, angular });
    }
    if let Some(jacobian) = robot.base_jacobian(state) {
        push(out, Output::ArmJacobian, &Float64MultiArray::of_rows(jacobian));
    }
    let [force, torque] = wrench_in_base(state);
    let header = header(stamp, &robot.tool_base());
    push(out, Output::ArmMeasuredCf, &WrenchStamped { header, force: force.into(), torque: torque.into() });
}

/// Returns the wrench on the flange, about the tool's base, along the axes of the tool's base instead of the
/// world's.
fn wrench_in_base(state: &State) -> [[f64; 3]; 2] {
    let to_base: UnitQuaternion<f64> = isometry(&state.t_world_base).rotation.inverse();
    [state.flange_wrench.force_n, state.flange_wrench.torque_nm]
        .map(|in_world| (to_base * Vector3::from(in_world)).into())
}

fn tool(out: &mut Vec<Outgoing>, robot: &Robot, state: &State, stamp: Time) {
    let (tendons, flexures) = (robot.tendons(), robot.flexures());
    let motor = JointState {
        header: header(stamp, ""),
        name: joint_names("tendon", tendons),
        position: state.tendon_displacement_m[..tendons].to_vec(),
        velocity: Vec::new(),
        effort: state.tendon_tension_n[..tendons].to_vec(),
    };
    push(out, Output::TendonMeasuredJs, &motor);
    let chain = JointState {
        header: header(stamp, ""),
        name: joint_names("flexure", flexures),
        position: state.joint_position_rad[..flexures].to_vec(),
        velocity: state.joint_velocity_rad_per_s[..flexures].to_vec(),
        effort: Vec::new(),
    };
    push(out, Output::FlexureMeasuredJs, &chain);
    let tip = PoseStamped { header: header(stamp, WORLD), pose: (&state.t_world_tip).into() };
    push(out, Output::TipMeasuredCp, &tip);
    let burr = JointState {
        header: header(stamp, ""),
        name: vec!["burr".into()],
        velocity: vec![state.burr_speed_rad_per_s],
        ..JointState::default()
    };
    push(out, Output::BurrMeasuredJs, &burr);
    if robot.outer_tube().is_some() {
        let tube = JointState {
            header: header(stamp, ""),
            name: TUBE_JOINT_NAMES.map(str::to_owned).to_vec(),
            position: vec![state.tube_deployed_m, state.tube_roll_rad],
            velocity: vec![state.tube_deploying_m_per_s, state.tube_rolling_rad_per_s],
            effort: Vec::new(),
        };
        push(out, Output::TubeMeasuredJs, &tube);
    }
    push(out, Output::BurrForce, &Float64 { data: state.burr_force_n });
    push(out, Output::RemovedVoxels, &UInt64 { data: state.removed_total });
}

/// Returns the messages of the tip's Jacobian.
pub fn of_tip_jacobian(robot: &Robot, jacobian: &TipJacobian) -> Vec<Outgoing> {
    let mut out = Vec::new();
    let row = |matrix: &[f64], columns: usize, row: usize| matrix[row * columns..][..columns].to_vec();
    let rows: [_; 6] = core::array::from_fn(|at| {
        let mut pulls = row(&jacobian.per_tension, MAX_TENDONS, at);
        pulls.truncate(robot.tendons());
        [pulls, row(&jacobian.per_base, 6, at)].concat()
    });
    push(&mut out, Output::TipJacobian, &Float64MultiArray::of_rows(rows));
    let compliance: [_; 6] = core::array::from_fn(|at| row(&jacobian.compliance, 6, at));
    push(&mut out, Output::TipCompliance, &Float64MultiArray::of_rows(compliance));
    out
}

/// Returns the message of a reading of kind `clearance`: the clearances of a scene's structures, m.
pub fn of_clearances(structures: &[Structure], reading: &SensorReading) -> Vec<Outgoing> {
    let mut out = Vec::new();
    let label = |structure: &Structure| structure.name.clone();
    let named = structures.iter().map(|it| MultiArrayDimension { label: label(it), size: 1, stride: 1 });
    let (dim, data) = named.zip(reading.clearances_m()).unzip();
    let layout = MultiArrayLayout { dim, data_offset: 0 };
    push(&mut out, Output::Clearance, &Float64MultiArray { layout, data });
    out
}

pub(crate) fn transform(placed: FrameInParent, stamp: Time) -> TransformStamped {
    TransformStamped {
        header: Header { stamp, frame_id: placed.parent },
        child_frame_id: placed.child,
        transform: (&placed.pose).into(),
    }
}

/// Returns the messages that do not change during the session.
pub fn of_session(robot: &Robot, urdf: String) -> Vec<Outgoing> {
    let mut out = Vec::new();
    let transforms = vec![transform(robot.fixed(), Time::default())];
    push(&mut out, Output::TfStatic, &TfMessage { transforms });
    push(&mut out, Output::RobotDescription, &Text { data: urdf });
    out
}

/// Returns the arm's state in CRTK's terms.
pub fn operating_state(phase: Phase, disabled: bool, state: &State) -> OperatingState {
    match phase {
        Phase::Paused => OperatingState::Paused,
        _ if disabled => OperatingState::Disabled,
        _ if state.arm_status() == Ok(ArmStatus::Fault) => OperatingState::Fault,
        _ => OperatingState::Enabled,
    }
}

/// Returns whether the arm is moving to a goal (CRTK's `is_busy`); servo commands do not count.
pub fn is_busy(state: &State) -> bool {
    let to_a_goal =
        matches!(state.arm_mode(), Ok(ArmMode::MoveJp | ArmMode::MoveCp | ArmMode::Insert | ArmMode::Rcm));
    to_a_goal && state.arm_status() == Ok(ArmStatus::Moving)
}

/// Returns the operating state as a message.
pub fn of_operating_state(operating: OperatingState, is_busy: bool, state: &State) -> Vec<Outgoing> {
    let mut out = Vec::new();
    let message = OperatingStateMessage {
        header: header(Time::of_simulated(state.sim_time_s), ""),
        state: operating.word().to_owned(),
        is_homed: true,
        is_busy,
    };
    push(&mut out, Output::OperatingState, &message);
    out
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use messages::SensorKind;
    use scene::Scene;
    use zerocopy::FromZeros;

    use super::*;

    /// The bytes are those of `rclpy.serialization.serialize_message` (Jazzy) for the same message, with
    /// zeros as padding.
    #[test]
    fn clearances_are_labelled_with_the_names_of_their_structures() {
        let text = "name = \"bench\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\n\
            burr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
            [[structure]]\nname = \"nerve\"\nball = { centre_mm = [0.0, 9.0, 0.0], radius_mm = 1.0 }\n\
            [[structure]]\nname = \"vessel\"\nball = { centre_mm = [9.0, 0.0, 0.0], radius_mm = 1.0 }\n";
        let scene = Scene::parse(text, Path::new("bench.toml")).unwrap();
        let kind = SensorKind::Clearance.code();
        let mut reading = SensorReading { kind, value_count: 4, ..SensorReading::new_zeroed() };
        reading.value[..4].copy_from_slice(&[2e-3, 7.0, -0.5e-3, 28.0]);
        let [Outgoing { topic: Output::Clearance, cdr }] = &of_clearances(&scene.structure, &reading)[..]
        else {
            panic!()
        };
        let hex: String = cdr.iter().map(|byte| format!("{byte:02x}")).collect();
        let expected = "02000000060000006e65727665000000010000000100000007000000\
                        76657373656c00000100000001000000\
                        000000000200000000000000fca9f1d24d62603ffca9f1d24d6240bf";
        assert_eq!(hex, expected);
    }
}
