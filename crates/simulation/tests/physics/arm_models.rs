//! Every arm that a scene can have: property tests of inverse and Jacobian, masses, and arms described joint
//! by joint.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use nalgebra::{Isometry3, Vector3, Vector6};
use scene::ArmModel;
use simulation::arm::{
    Arm, ArmCommand, ArmError, ArmGeometry, ArmParameters, COMFORTABLE_Q_RAD, Joints, KinematicsError,
    Redundancy, SerialGeometry, SerialJoint, mass_matrix, place_base_for, six_joints,
};
use std::f64::consts::{FRAC_PI_2, PI};

use crate::common::arm::{DT_S, Uniform, move_cp};

const MODELS: [ArmModel; 7] = [
    ArmModel::Ur3,
    ArmModel::Ur3e,
    ArmModel::Ur5,
    ArmModel::Ur5e,
    ArmModel::Ur10e,
    ArmModel::Ur16e,
    ArmModel::Ur20,
];

fn joint(position_m: [f64; 3], roll_rad: f64, turns: bool) -> SerialJoint {
    SerialJoint {
        position_m: Vector3::from(position_m),
        roll_pitch_yaw_rad: Vector3::new(roll_rad, 0.0, 0.0),
        axis: turns.then(Vector3::z),
    }
}

/// A chain of Denavit-Hartenberg parameters a, d, alpha: each joint is followed by `Tz(d) Tx(a) Rx(alpha)`.
fn denavit_hartenberg<const N: usize>(rows: [[f64; 3]; N]) -> ArmGeometry {
    let after = rows.map(|[a, d, alpha]| ([a, 0.0, d], alpha));
    let mut joints = vec![joint([0.0; 3], 0.0, true)];
    joints.extend(after.iter().enumerate().map(|(i, (place, alpha))| joint(*place, *alpha, i + 1 < N)));
    ArmGeometry::Serial(SerialGeometry::new(joints, 2))
}

/// The PUMA 560: Corke and Armstrong-Helouvry, "A search for consensus among model parameters reported for
/// the PUMA 560 robot", IEEE ICRA 1994, table 1, with a flange 56.25 mm in front of the wrist. A spherical
/// wrist and a shoulder offset, unlike a UR.
fn puma() -> ArmGeometry {
    denavit_hartenberg([
        [0.0, 0.0, FRAC_PI_2],
        [0.4318, 0.0, 0.0],
        [0.0203, 0.150_05, -FRAC_PI_2],
        [0.0, 0.4318, FRAC_PI_2],
        [0.0, 0.0, -FRAC_PI_2],
        [0.0, 0.056_25, 0.0],
    ])
}

/// A KUKA LBR iiwa 14 R820, seven joints: shoulder, elbow and wrist 360, 420 and 400 mm apart, flange 126 mm
/// in front of the wrist (KUKA, "LBR iiwa 7 R800, LBR iiwa 14 R820, Specification", main dimensions).
fn lbr_iiwa_14() -> ArmGeometry {
    denavit_hartenberg([
        [0.0, 0.36, -FRAC_PI_2],
        [0.0, 0.0, FRAC_PI_2],
        [0.0, 0.42, FRAC_PI_2],
        [0.0, 0.0, -FRAC_PI_2],
        [0.0, 0.4, -FRAC_PI_2],
        [0.0, 0.0, FRAC_PI_2],
        [0.0, 0.126, 0.0],
    ])
}

/// Joint ranges of the LBR, from the same source.
const LBR_RANGES_DEG: [f64; 7] = [170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0];

/// The arms with their joint ranges.
fn arms() -> Vec<(String, ArmGeometry, [Joints; 2])> {
    let named = MODELS.map(|model| {
        let parameters = ArmParameters::named(model, DT_S);
        let limits = parameters.joint_limits;
        (format!("{model:?}"), parameters.geometry, [limits.lower_rad, limits.upper_rad])
    });
    let mut arms = named.to_vec();
    for (name, geometry, upper_deg) in [
        ("LbrIiwa14", lbr_iiwa_14(), LBR_RANGES_DEG),
        ("Puma560", puma(), six_joints([160.0, 110.0, 135.0, 266.0, 100.0, 266.0])),
    ] {
        let upper = upper_deg.map(f64::to_radians);
        arms.push((name.to_owned(), geometry, [upper.map(|x| -x), upper]));
    }
    arms
}

/// `|det J|` of the six joints that move on a path: all but the third of seven.
fn determinant_m3(geometry: &ArmGeometry, q: &Joints) -> f64 {
    let held = if geometry.joints() == 7 { 2 } else { 6 };
    geometry.frames(q).jacobian().remove_column(held).determinant().abs()
}

fn apart(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    (a.translation.vector - b.translation.vector).norm().max(a.rotation.angle_to(&b.rotation))
}

#[test]
fn every_arm_comes_back_to_the_joints_that_its_pose_is_of() {
    let tool = Isometry3::new(Vector3::new(0.02, -0.01, 0.09), Vector3::new(0.3, -0.2, 0.5));
    let mut uniform = Uniform(21);
    for (name, geometry, [lower, upper]) in arms() {
        let geometry = geometry.with_tool(Some(tool));
        let (mut worst_pose, mut worst_joint, mut tried) = (0.0f64, 0.0f64, 0);
        while tried < 2_000 {
            let q: Joints = std::array::from_fn(|i| uniform.between(lower[i], upper[i]) * 0.99);
            if determinant_m3(&geometry, &q) < 1e-3 {
                continue;
            }
            tried += 1;
            let pose = geometry.forward(&q);
            let mut near: Joints = std::array::from_fn(|i| q[i] + uniform.between(-1e-3, 1e-3));
            if geometry.joints() == 7 {
                // Selects one of the many solutions.
                near[2] = q[2];
            }
            let found = geometry.inverse_nearest(&pose, &near, &lower, &upper, Redundancy::Held).unwrap();
            worst_pose = worst_pose.max(apart(&geometry.forward(&found), &pose));
            worst_joint =
                (0..geometry.joints()).fold(worst_joint, |worst, i| worst.max((found[i] - q[i]).abs()));
        }
        println!("{name}: worst pose {worst_pose:.1e} (m, rad), worst joint {worst_joint:.1e} rad");
        // The accuracy that the numeric inverse guarantees; for the joints, that divided by the least
        // singular value of J at |det J| >= 1e-3 m³.
        assert!(worst_pose < 2e-12 && worst_joint < 1e-9, "{name}");
    }
}

#[test]
fn every_jacobian_is_the_derivative_of_the_pose_and_its_determinant_the_manipulability() {
    let (step, mut uniform) = (1e-6, Uniform(22));
    for (name, geometry, _) in arms() {
        let (mut worst, mut worst_det) = (0.0f64, 0.0f64);
        for _ in 0..200 {
            let q: Joints = std::array::from_fn(|_| uniform.between(-PI, PI));
            let jacobian = geometry.frames(&q).jacobian();
            for i in 0..7 {
                let moved = |by: f64| {
                    let mut q = q;
                    q[i] += by;
                    geometry.forward(&q)
                };
                let (ahead, behind) = (moved(step), moved(-step));
                let linear = ahead.translation.vector - behind.translation.vector;
                let angular = (ahead.rotation * behind.rotation.inverse()).scaled_axis();
                let expected = Vector6::new(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
                    / (2.0 * step);
                worst = worst.max((jacobian.column(i) - expected).amax());
            }
            // For seven joints, the root of the sum of squares over all choices of six (Cauchy-Binet).
            let minors = (0..7).map(|held| jacobian.remove_column(held).determinant().powi(2));
            worst_det = worst_det.max((minors.sum::<f64>().sqrt() - geometry.manipulability_m3(&q)).abs());
        }
        println!("{name}: Jacobian against central differences {worst:.1e}, determinant {worst_det:.1e} m³");
        // Central differences at h = 1e-6: rounding of numbers up to 2 over h.
        assert!(worst < 2e-9 && worst_det < 1e-12, "{name}");
    }
}

/// From the standard start the tool can move 100 mm in every direction, as scenes without an explicit start
/// need.
#[test]
fn every_named_arm_starts_comfortably() {
    for model in MODELS {
        let mut parameters = ArmParameters::named(model, DT_S);
        let start = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.4, 0.5, -0.6));
        parameters.t_world_arm_base = place_base_for(&parameters.geometry, &start, &COMFORTABLE_Q_RAD);
        println!("{model:?}: {:.4} m³", parameters.geometry.manipulability_m3(&COMFORTABLE_Q_RAD));
        for axis in 0..6 {
            let mut arm = Arm::new(parameters, &COMFORTABLE_Q_RAD).unwrap();
            let way = Vector3::ith(axis % 3, if axis < 3 { 0.1 } else { -0.1 });
            let mut goal = arm.state().t_world_tool;
            goal.translation.vector += way;
            arm.command(move_cp(goal)).unwrap_or_else(|refused| panic!("{model:?} {way}: {refused}"));
        }
    }
}

/// A mass matrix is symmetric and positive definite.
#[test]
fn every_named_arm_has_masses() {
    // Sums over Universal Robots' table.
    let sums_kg = [8.63, 8.7985, 17.0489, 17.7, 29.104, 27.26, 60.96];
    for (model, sum_kg) in MODELS.into_iter().zip(sums_kg) {
        let parameters = ArmParameters::named(model, DT_S);
        let links = parameters.links.unwrap();
        assert!((links.iter().map(|link| link.mass_kg).sum::<f64>() - sum_kg).abs() < 1e-9, "{model:?}");
        let mut uniform = Uniform(23);
        for _ in 0..100 {
            let q: Joints = std::array::from_fn(|_| uniform.between(-PI, PI));
            let mass = mass_matrix(&parameters.geometry, &links, &q);
            assert!((mass - mass.transpose()).amax() < 1e-14 && mass.cholesky().is_some(), "{model:?}");
        }
    }
}

/// A UR5e described joint by joint equals the named one.
#[test]
fn an_arm_described_joint_by_joint_is_the_named_one() {
    let described = denavit_hartenberg([
        [0.0, 0.1625, FRAC_PI_2],
        [-0.425, 0.0, 0.0],
        [-0.3922, 0.0, 0.0],
        [0.0, 0.1333, FRAC_PI_2],
        [0.0, 0.0997, -FRAC_PI_2],
        [0.0, 0.0996, 0.0],
    ]);
    let named = ArmParameters::named(ArmModel::Ur5e, DT_S).geometry;
    let mut uniform = Uniform(24);
    let mut worst = 0.0f64;
    for _ in 0..1_000 {
        let q: Joints = std::array::from_fn(|_| uniform.between(-6.0, 6.0));
        worst =
            worst.max((named.forward(&q).to_homogeneous() - described.forward(&q).to_homogeneous()).amax());
    }
    println!("worst entry {worst:.1e}");
    // Rounding, and pi/2 as f64, which deviates from a right angle by 6e-17.
    assert!(worst < 1e-14);
}

/// Distant goals from an unrelated start: the numeric inverse finds most of them, within the ranges, and
/// always the same solution.
#[test]
fn the_numeric_inverse_finds_far_goals_within_the_ranges() {
    let (_, geometry, [lower, upper]) = arms().pop().unwrap();
    let near = six_joints([0.1; 6]);
    let mut uniform = Uniform(25);
    let (mut found, trials) = (0, 500);
    for _ in 0..trials {
        let q: Joints = std::array::from_fn(|i| uniform.between(lower[i], upper[i]) * 0.95);
        let pose = geometry.forward(&q);
        let inverse = || geometry.inverse_nearest(&pose, &near, &lower, &upper, Redundancy::Free);
        let Ok(solution) = inverse() else { continue };
        found += 1;
        assert!((0..6).all(|i| (lower[i]..=upper[i]).contains(&solution[i])), "{solution:?}");
        assert!((geometry.forward(&solution).to_homogeneous() - pose.to_homogeneous()).amax() < 2e-12);
        assert_eq!(inverse(), Ok(solution));
    }
    println!("{found} of {trials}");
    assert!(found > trials * 9 / 10);
    let mut far = geometry.forward(&near);
    far.translation.vector.x += 5.0;
    let error = geometry.inverse_nearest(&far, &near, &lower, &upper, Redundancy::Free).unwrap_err();
    assert!(matches!(error, KinematicsError::NotReached { missed_m, .. } if missed_m > 3.0), "{error}");
    far.translation.vector.x = f64::NAN;
    assert_eq!(
        geometry.inverse_nearest(&far, &near, &lower, &upper, Redundancy::Free),
        Err(KinematicsError::InvalidPose)
    );
}

/// A path of an arm with a numeric inverse is as straight as one with a closed inverse.
#[test]
fn an_arm_described_joint_by_joint_follows_a_straight_line() {
    let start_rad = six_joints([0.1, 0.8, 0.3, 0.2, 0.9, 0.1]);
    let parameters = ArmParameters { geometry: puma(), ..ArmParameters::ur5(DT_S) };
    let mut arm = Arm::new(parameters, &start_rad).unwrap();
    let start = arm.state().t_world_tool;
    let axis_world = Vector3::new(0.0, 0.6, 0.8);
    arm.command(ArmCommand::Insert { axis_world, depth_m: 0.03, feed_m_s: 0.01 }).unwrap();
    let (mut worst, mut ticks) = (0.0f64, 0);
    while !arm.step().done {
        let state = arm.state();
        let moved = state.t_world_tool.translation.vector - start.translation.vector;
        worst = worst.max((moved - axis_world * moved.dot(&axis_world)).norm());
        worst = worst.max((state.t_world_tool.rotation.coords - start.rotation.coords).amax());
        ticks += 1;
        assert!(ticks < 10_000 && state.fault.is_none(), "{:?}", state.fault);
    }
    let moved = arm.state().t_world_tool.translation.vector - start.translation.vector;
    println!("off the line by {worst:.1e} (m, quaternion); depth {:.9} m", moved.norm());
    assert!(worst < 2e-12 && (moved.norm() - 0.03).abs() < 1e-11);
}

#[test]
fn a_fixed_tool_stays_and_says_why() {
    let tool = Isometry3::new(Vector3::new(0.02, -0.01, 0.09), Vector3::new(0.3, -0.2, 0.5));
    let mut parameters = ArmParameters::named(ArmModel::Fixed, DT_S);
    parameters.geometry = parameters.geometry.with_tool(Some(tool));
    let wanted = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.4, 0.5, -0.6));
    parameters.t_world_arm_base = place_base_for(&parameters.geometry, &wanted, &Joints::default());
    let mut arm = Arm::new(parameters, &Joints::default()).unwrap();
    let goal = moved_aside(&wanted);
    for command in [
        move_cp(goal),
        ArmCommand::ServoCp { t_world_tool: goal, speed_fraction: 1.0 },
        ArmCommand::ServoJp { q_rad: [0.1; 7], speed_fraction: 1.0 },
        ArmCommand::ServoJv { qd_rad_s: [0.1; 7] },
        ArmCommand::Insert { axis_world: Vector3::z(), depth_m: 0.01, feed_m_s: 0.01 },
    ] {
        assert_eq!(arm.command(command), Err(ArmError::NoArm));
    }
    assert!(ArmError::NoArm.to_string().contains("`arm.model` is \"fixed\""));
    arm.command(ArmCommand::Hold).unwrap();
    for _ in 0..10 {
        arm.step();
    }
    assert!(apart(&arm.state().t_world_tool, &wanted) < 1e-7);
    assert!((arm.state().t_world_tool.translation.vector - wanted.translation.vector).norm() < 1e-15);
    assert_eq!((arm.state().q_rad, arm.state().done), (Joints::default(), true));
}

fn moved_aside(pose: &Isometry3<f64>) -> Isometry3<f64> {
    Isometry3::translation(0.01, 0.0, 0.0) * pose
}
