//! Elastic joints of the arm: statics and vibration against closed forms, and stability of the coupling with
//! the tool.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::path::Path;

use crate::common::held;
use messages::{ARM_INSERT, ARM_MOVE_CP, Command, State, TENDON_SERVO_JF};
use nalgebra::{Matrix6, Vector3, Vector6};
use scene::Scene;
use simulation::Simulation;
use simulation::arm::{
    Arm, ArmParameters, COMFORTABLE_Q_RAD, Compliance, ComplianceParameters, Joints, Link, UrGeometry,
    mass_matrix,
};
use zerocopy::IntoBytes;

const STIFFNESS: [f64; 6] = [4e4, 3e4, 2e4, 8e3, 6e3, 5e3];

fn ur5_links() -> [Link; 6] {
    ArmParameters::ur5(1e-3).links.unwrap()
}

fn alone(stiffness_nm_per_rad: [f64; 6], damping: f64) -> Compliance {
    Compliance::new(ComplianceParameters {
        links: ur5_links(),
        stiffness_nm_per_rad,
        damping_nms_per_rad: stiffness_nm_per_rad.map(|k| damping * k),
        tool_stiffness_n_per_m: 0.0,
        tool_damping_n_s_per_m: 0.0,
        tool_length_m: 0.0,
    })
    .unwrap()
}

fn arm(dt_s: f64) -> Arm {
    Arm::new(ArmParameters::ur5(dt_s), &COMFORTABLE_Q_RAD).unwrap()
}

/// Deflection of the tool's base under a wrench: `J K⁻¹ Jᵀ w`.
#[test]
fn the_base_gives_way_as_the_closed_form_says() {
    let arm = arm(1e-3);
    let jacobian = arm.jacobian().fixed_columns::<6>(0).into_owned();
    let compliance = Matrix6::from_diagonal(&Vector6::from(STIFFNESS.map(|k| 1.0 / k)));
    let mut worst = 0.0f64;
    for column in 0..6 {
        let mut wrench = Vector6::zeros();
        wrench[column] = if column < 3 { 10.0 } else { 1.0 };
        let (force, torque) =
            (Vector3::new(wrench[0], wrench[1], wrench[2]), wrench.fixed_rows::<3>(3).into());
        let mut joints = alone(STIFFNESS, 0.02);
        for _ in 0..3_000 {
            joints.step(&arm, &force, &torque).unwrap();
        }
        let base = joints.base(&arm);
        let expected = jacobian * compliance * jacobian.transpose() * wrench;
        let moved = base.t_world_tool.translation.vector - arm.state().t_world_tool.translation.vector;
        let turned = (base.t_world_tool.rotation * arm.state().t_world_tool.rotation.inverse()).scaled_axis();
        let off =
            (moved - expected.fixed_rows::<3>(0)).norm().max((turned - expected.fixed_rows::<3>(3)).norm());
        worst = worst.max(off / expected.norm());
        assert!(joints.state().rate_rad_s.iter().all(|rate| rate.abs() < 1e-9), "the arm is at rest");
    }
    println!("static deflection against J K^-1 J' w: worst relative difference {worst:.1e}");
    // The closed form is linear; deflections of up to 1e-3 rad leave a second-order error of that relative
    // size.
    assert!(worst < 2e-3);
}

/// One soft joint among stiff ones swings at sqrt(k / M_ii).
#[test]
fn a_soft_joint_swings_at_its_natural_frequency() {
    let arm = arm(2e-5);
    let mass = mass_matrix(&UrGeometry::ur5().into(), &ur5_links(), &COMFORTABLE_Q_RAD);
    for joint in [0, 2, 5] {
        let mut stiffness = [1e9; 6];
        stiffness[joint] = mass[(joint, joint)] * (200.0f64).powi(2);
        let mut joints = alone(stiffness, 0.0);
        let mut start = *joints.state();
        start.deflection_rad[joint] = 1e-4;
        joints.restore(&start);
        let mut crossings = Vec::new();
        let mut before = start.deflection_rad[joint];
        for tick in 1..8_000 {
            joints.step(&arm, &Vector3::zeros(), &Vector3::zeros()).unwrap();
            let now = joints.state().deflection_rad[joint];
            if before > 0.0 && now <= 0.0 {
                crossings.push((f64::from(tick) - now / (now - before)) * 2e-5);
            }
            before = now;
        }
        let period_s = (crossings[crossings.len() - 1] - crossings[0]) / (crossings.len() - 1) as f64;
        let frequency = std::f64::consts::TAU / period_s;
        println!("joint {}: {frequency:.3} rad/s, closed form 200", joint + 1);
        // The other joints are not infinitely stiff: they contribute less than 1e-4 of the compliance.
        // Implicit Euler lowers the frequency by (w h)²/3 = 5e-6.
        assert!((frequency / 200.0 - 1.0).abs() < 1e-3);
    }
    // Wrist 3 rotates about its own axis: its tabulated inertia applies, because its centre of mass lies on
    // the axis.
    assert!((mass[(5, 5)] - 1.321_172e-4).abs() < 1e-12);
    // The masses do not depend on the orientation of the whole arm.
    let mut turned = COMFORTABLE_Q_RAD;
    turned[0] += 1.0;
    assert!((mass - mass_matrix(&UrGeometry::ur5().into(), &ur5_links(), &turned)).amax() < 1e-12);
    assert!(mass.cholesky().is_some());
}

/// A scene with a tool that hangs sideways on the arm, with text to vary.
fn scene(dt_ms: f64, compliance: Option<([f64; 6], f64)>, rest: &str) -> Scene {
    let list = |values: [f64; 6]| format!("{values:?}");
    let compliance = compliance.map_or(String::new(), |(stiffness, damping)| {
        format!(
            "[arm.compliance]\njoint_stiffness_nm_per_rad = {}\njoint_damping_nms_per_rad = {}\n",
            list(stiffness),
            list(stiffness.map(|k| k * damping))
        )
    });
    let text = format!(
        "name = \"compliance\"\n{rest}\n[run]\nmode = \"lockstep\"\nduration_s = 3.0\ndt_ms = {dt_ms:?}\n\
         [tool]\n\
         burr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
         {compliance}\
         [[body]]\nname = \"wall\"\ncuboid = {{ half_extents_mm = [30.0, 30.0, 10.0] }}\nmotion = \"fixed\"\n\
         position_mm = [0.0, 0.0, 14.0]\n[[controller]]\nname = \"test\"\ndrives = [\"tendon\", \"arm\"]\n\
         external = true\n"
    );
    Scene::parse(&text, Path::new("compliance.toml")).unwrap()
}

/// Runs under one held command; `look` sees each state.
fn play(simulation: &mut Simulation, ticks: u64, command: Command, mut look: impl FnMut(&State)) {
    for tick in 0..ticks {
        simulation.step(&held(tick, Command { sequence: 1, ..command })).unwrap();
        look(simulation.state());
    }
}

/// In closed loop, with the tool's weight on elastic joints: the deflection in the state matches the wrench
/// in the state.
#[test]
fn in_a_scene_the_deflection_is_that_of_the_reported_wrench() {
    let scene = scene(1.0, Some((STIFFNESS, 0.02)), "gravity_m_per_s2 = [0.0, 9.81, 0.0]");
    let mut simulation = Simulation::new(&scene, None).unwrap();
    let start = *simulation.state();
    play(&mut simulation, 3_000, Command::zeroed(), |_| ());
    let state = simulation.state();
    let mut parameters = ArmParameters::ur5(1e-3);
    let wanted = {
        let p = &start.t_world_flange;
        let [x, y, z, w] = p.orientation_xyzw;
        nalgebra::Isometry3::from_parts(
            nalgebra::Translation3::from(Vector3::from(p.position_m)),
            nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z)),
        )
    };
    parameters.t_world_arm_base =
        simulation::arm::place_base_for(&parameters.geometry, &wanted, &COMFORTABLE_Q_RAD);
    let arm = Arm::new(parameters, &COMFORTABLE_Q_RAD).unwrap();
    let wrench = &state.flange_wrench;
    let wrench = Vector6::from_iterator(wrench.force_n.into_iter().chain(wrench.torque_nm));
    let torque = arm.jacobian().transpose() * wrench;
    assert!(wrench.norm() > 0.05, "the tool has weight: {wrench}");
    let mut worst = 0.0f64;
    for i in 0..6 {
        let expected = torque[i] / STIFFNESS[i];
        worst = worst.max((state.arm_joint_deflection_rad[i] - expected).abs());
        let measured = state.arm_joint_position_rad[i] - COMFORTABLE_Q_RAD[i];
        assert!((measured - state.arm_joint_deflection_rad[i]).abs() < 1e-15);
    }
    let moved =
        Vector3::from(state.t_world_flange.position_m) - Vector3::from(start.t_world_flange.position_m);
    println!("flange moved by {:.3e} m, joints off the closed form by {worst:.1e} rad", moved.norm());
    // The tool's own oscillation has settled to a millionth of its weight.
    assert!(worst < 1e-9 && moved.norm() > 1e-7);
}

/// The burr is pushed 0.5 mm into a wall, for several stiffnesses and steps: nothing grows, and the thrust
/// does not depend on the step.
#[test]
fn pressing_on_a_wall_is_stable_over_stiffness_and_step() {
    for dt_ms in [0.2, 1.0, 5.0, 10.0] {
        for stiffness in [1e2, 1e4, 1e6] {
            // Near critical damping for the joints at the base, whose inertia is about 3 kg m², so that 2 s
            // suffice to settle.
            let damping = 2.0 * f64::sqrt(3.0 / stiffness);
            // Without friction, since a stationary burr would stick where it touches.
            let smooth = "contact = { friction = 0.0 }";
            let scene = scene(dt_ms, Some(([stiffness; 6], damping)), smooth);
            let mut simulation = Simulation::new(&scene, None).unwrap();
            let command = Command {
                arm_mode: ARM_INSERT,
                arm_axis: [0.0, 0.0, 1.0],
                arm_depth_m: 1.25e-3,
                arm_speed_m_per_s: 5e-3,
                tendon_mode: TENDON_SERVO_JF,
                tendon_force_n: [2.0, 2.0, 0.0, 0.0],
                ..Command::zeroed()
            };
            let ticks = (2_000.0 / dt_ms) as u64;
            let (mut peak, mut late, mut thrust_ns) = (0.0f64, 0.0f64, 0.0);
            play(&mut simulation, ticks, command, |state| {
                let rate = state.arm_joint_velocity_rad_per_s.iter().fold(0.0f64, |m, x| m.max(x.abs()));
                peak = peak.max(rate);
                if state.tick > ticks * 9 / 10 {
                    late = late.max(rate);
                    thrust_ns += state.flange_wrench.force_n[2] * dt_ms * 1e-3;
                }
            });
            let force_n = thrust_ns / 0.2;
            println!(
                "dt {dt_ms} ms, {stiffness:.0e} N m/rad: peak {peak:.2e} rad/s, at the end {late:.1e}, \
                 thrust {force_n:.2} N"
            );
            // 5 mm/s of feed over lever arms of some 0.1 m; a growing oscillation would exceed both bounds.
            assert!(peak < 0.05 && late < 0.15 * peak, "dt {dt_ms} ms, {stiffness} N m/rad");
            // The thrust does not depend on the step: the stabilising mass does not affect the statics. At 5
            // ms and more it slows the softest joints so much that they have not settled after 2 s.
            if stiffness > 1e3 {
                assert!((force_n / -1.32 - 1.0).abs() < 0.02, "{force_n} N");
            } else if dt_ms <= 1.0 {
                assert!((force_n / -0.10 - 1.0).abs() < 0.2, "{force_n} N");
            }
        }
    }
}

/// Without the table nothing is computed and nothing changes; very stiff joints approach that.
#[test]
fn stiff_joints_approach_the_rigid_arm_and_a_snapshot_continues() {
    let command = |start: &State| {
        let mut goal = start.t_world_flange;
        goal.position_m[2] -= 2e-3;
        Command { arm_mode: ARM_MOVE_CP, t_world_base: goal, arm_speed_m_per_s: 5e-3, ..Command::zeroed() }
    };
    let run = |compliance| {
        let scene = scene(1.0, compliance, "");
        let mut simulation = Simulation::new(&scene, None).unwrap();
        let command = command(simulation.state());
        play(&mut simulation, 800, command, |_| ());
        *simulation.state()
    };
    let (rigid, stiff) = (run(None), run(Some(([1e7; 6], 0.01))));
    assert_eq!(rigid.arm_joint_deflection_rad, Joints::default());
    let apart = Vector3::from(rigid.t_world_tip.position_m) - Vector3::from(stiff.t_world_tip.position_m);
    println!("stiff joints: tip {:.1e} m from that of the rigid arm", apart.norm());
    assert!(apart.norm() < 1e-7);

    let scene = scene(1.0, Some((STIFFNESS, 0.01)), "");
    let mut one = Simulation::new(&scene, None).unwrap();
    let mut other = Simulation::new(&scene, None).unwrap();
    let command = command(one.state());
    play(&mut one, 300, command, |_| ());
    other.restore(&one.snapshot()).unwrap();
    play(&mut one, 100, command, |_| ());
    play(&mut other, 100, command, |_| ());
    assert_eq!(one.state().as_bytes(), other.state().as_bytes());
}
