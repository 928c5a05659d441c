//! UR5 kinematics against published poses, a second formulation, finite differences and its own inverse.

use crate::common::arm::Uniform;
use nalgebra::{Isometry3, Matrix3, Matrix4, SVector, Vector3, Vector6};
use simulation::arm::{
    ArmParameters, COMFORTABLE_Q_RAD, Joints, KinematicsError, UrGeometry, place_base_for, six_joints,
};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

const UR5: UrGeometry = UrGeometry::ur5();

/// Product of exponentials of the UR5: Lynch and Park, "Modern Robotics" (2017), example 4.5. Its space frame
/// is ours rotated by 180° about z; its joint angles and end frame are ours.
fn product_of_exponentials(q: &Joints, lengths: [f64; 6]) -> Matrix4<f64> {
    let [l1, l2, w1, w2, h1, h2] = lengths;
    let screws = [
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, -h1, 0.0, 0.0],
        [0.0, 1.0, 0.0, -h1, 0.0, l1],
        [0.0, 1.0, 0.0, -h1, 0.0, l1 + l2],
        [0.0, 0.0, -1.0, -w1, l1 + l2, 0.0],
        [0.0, 1.0, 0.0, h2 - h1, 0.0, l1 + l2],
    ];
    #[rustfmt::skip]
    let home = Matrix4::new(
        -1.0, 0.0, 0.0, l1 + l2,
        0.0, 0.0, 1.0, w1 + w2,
        0.0, 1.0, 0.0, h1 - h2,
        0.0, 0.0, 0.0, 1.0,
    );
    let exponentials = (0..6).map(|i| {
        let [wx, wy, wz, vx, vy, vz] = screws[i];
        let skew = Vector3::new(wx, wy, wz).cross_matrix();
        let (sin, cos) = q[i].sin_cos();
        let rotation = Matrix3::identity() + skew * sin + skew * skew * (1.0 - cos);
        let integral = Matrix3::identity() * q[i] + skew * (1.0 - cos) + skew * skew * (q[i] - sin);
        let mut transform = rotation.to_homogeneous();
        transform.fixed_view_mut::<3, 1>(0, 3).copy_from(&(integral * Vector3::new(vx, vy, vz)));
        transform
    });
    exponentials.fold(Matrix4::<f64>::identity(), |product, step| product * step) * home
}

#[test]
fn forward_kinematics_match_published_poses() {
    // Universal Robots' URDF at zero: tool0 at (0.81725, 0.19145, -0.005491) of base_link, which is our base
    // rotated by 180° about z.
    let zero = UR5.forward(&Joints::default()).translation.vector;
    assert!((zero - Vector3::new(-0.81725, -0.19145, -0.005491)).norm() < 1e-12, "{zero}");
    // Straight up, flange at 1.001059 m.
    let up = UR5.forward(&six_joints([0.0, -FRAC_PI_2, 0.0, -FRAC_PI_2, 0.0, 0.0])).translation.vector;
    assert!((up - Vector3::new(0.0, -0.19145, 1.001059)).norm() < 1e-12, "{up}");
    // Modern Robotics, figure 4.6: q2 = -90°, q5 = 90°, printed in millimetres, hence 1 mm.
    let printed = Vector3::new(0.095, 0.109, 0.988);
    let figure = UR5.forward(&six_joints([0.0, -FRAC_PI_2, 0.0, 0.0, FRAC_PI_2, 0.0])).translation.vector;
    let turned = Vector3::new(-figure.x, -figure.y, figure.z);
    assert!((turned - printed).amax() < 1e-3, "{turned}");
}

#[test]
fn forward_kinematics_match_the_product_of_exponentials() {
    let lengths = [0.425, 0.39225, 0.10915, 0.0823, 0.089159, 0.09465];
    let half_turn = Matrix4::from_diagonal(&nalgebra::Vector4::new(-1.0, -1.0, 1.0, 1.0));
    let mut uniform = Uniform(1);
    let mut worst: f64 = 0.0;
    for _ in 0..10_000 {
        let q = uniform.joints(TAU);
        let expected = product_of_exponentials(&q, lengths);
        let ours = half_turn * UR5.forward(&q).to_homogeneous();
        worst = worst.max((ours - expected).amax());
    }
    println!("forward kinematics against product of exponentials: worst entry {worst:.1e}");
    // Rounding of about fifty operations on numbers of order 1.
    assert!(worst < 5e-15);
}

#[test]
fn inverse_finds_every_pose_and_the_branch_it_came_from() {
    let limits = ArmParameters::ur5(1e-3).joint_limits;
    let mut uniform = Uniform(2);
    let (mut worst_pose, mut worst_branch) = (0.0f64, 0.0f64);
    let mut counts = [0usize; 9];
    for _ in 0..20_000 {
        let mut q = uniform.joints(TAU);
        q[2] *= 0.5;
        if UR5.manipulability_m3(&q) < 1e-4 {
            continue;
        }
        let pose = UR5.forward(&q);
        let solutions = UR5.inverse(&pose).unwrap();
        counts[solutions.as_slice().len()] += 1;
        for solution in solutions.as_slice() {
            let back = UR5.forward(solution);
            let turn = pose.rotation.angle_to(&back.rotation);
            worst_pose = worst_pose.max((back.translation.vector - pose.translation.vector).norm()).max(turn);
        }
        // From a nearby reference, the nearest branch is the one that produced the pose, including whole
        // turns.
        let reference = six_joints(std::array::from_fn(|i| q[i] + uniform.between(-1e-3, 1e-3)));
        let nearest = UR5.inverse_nearest(&pose, &reference, &limits.lower_rad, &limits.upper_rad).unwrap();
        for i in 0..6 {
            worst_branch = worst_branch.max((nearest[i] - q[i]).abs());
        }
    }
    println!(
        "inverse: worst pose {worst_pose:.1e} (m, rad), worst joint {worst_branch:.1e} rad, counts {counts:?}"
    );
    // Poses: rounding of about fifty operations. Joints: that, times 1/|det J| <= 1e4 and lengths of 1 m.
    assert!(worst_pose < 1e-13);
    assert!(worst_branch < 1e-10);
    assert!(counts.iter().sum::<usize>() > 19_000 && counts[8] > 5_000 && counts[1] + counts[3] == 0);
}

#[test]
fn jacobian_matches_finite_differences_and_its_determinant_the_closed_form() {
    let mut uniform = Uniform(3);
    let step = 1e-6;
    let (mut worst, mut worst_bias) = (0.0f64, 0.0f64);
    for _ in 0..500 {
        let q = uniform.joints(PI);
        let frames = UR5.frames(&q);
        let jacobian = frames.jacobian();
        for i in 0..6 {
            let (mut ahead, mut behind) = (q, q);
            ahead[i] += step;
            behind[i] -= step;
            let expected = difference(&UR5.forward(&ahead), &UR5.forward(&behind)) / (2.0 * step);
            worst = worst.max((jacobian.column(i) - expected).amax());
        }
        assert!(
            (jacobian.fixed_columns::<6>(0).determinant().abs() - UR5.manipulability_m3(&q)).abs() < 1e-14
        );

        let rates = uniform.joints(2.0);
        let moved = |h: f64| UR5.frames(&std::array::from_fn(|i| q[i] + h * rates[i])).jacobian();
        let change = (moved(step) - moved(-step)) / (2.0 * step) * SVector::from(rates);
        worst_bias = worst_bias.max((frames.bias_acceleration(&rates) - change).amax());
    }
    println!("Jacobian against central differences: {worst:.1e}; J̇q̇: {worst_bias:.1e}");
    // Central differences at h = 1e-6: truncation 1e-12, rounding 1e-16 / 1e-6 = 1e-10; J̇q̇ is a product of
    // 12 of them.
    assert!(worst < 1e-9 && worst_bias < 1e-8);
}

fn difference(to: &Isometry3<f64>, from: &Isometry3<f64>) -> Vector6<f64> {
    let linear = to.translation.vector - from.translation.vector;
    let angular = (to.rotation * from.rotation.inverse()).scaled_axis();
    Vector6::new(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
}

#[test]
fn unreachable_and_singular_poses_are_told_apart() {
    let mut far = UR5.forward(&six_joints([0.3, -1.0, 1.2, -0.5, 1.0, 0.2]));
    far.translation.vector *= 3.0;
    assert!(matches!(UR5.inverse(&far), Err(KinematicsError::OutOfReach { .. })));

    let mut over_base = far;
    over_base.translation.vector =
        Vector3::new(0.0, 0.0, 0.6) + far.rotation * Vector3::new(0.0, 0.0, UR5.d6_m);
    assert!(matches!(UR5.inverse(&over_base), Err(KinematicsError::TooCloseToBase { .. })));

    // The other shoulder's solutions remain, but they are far away: the arm does not flip.
    let straight = six_joints([0.3, -1.0, 1.2, -0.5, 0.0, 0.2]);
    let wrist = UR5.forward(&straight);
    assert!(UR5.inverse(&wrist).unwrap().as_slice().iter().all(|q| (q[0] - straight[0]).abs() > 0.1));
    let near = UR5.inverse_nearest(&wrist, &straight, &[-TAU; 7], &[TAU; 7]);
    assert!(matches!(near, Err(KinematicsError::WristSingular { .. })), "{near:?}");

    // Fully stretched to the last digit: still reachable.
    let stretched = UR5.forward(&six_joints([0.3, -1.0, 0.0, -0.5, 1.0, 0.2]));
    assert!(UR5.inverse(&stretched).is_ok());

    let mut invalid = wrist;
    invalid.translation.x = f64::NAN;
    assert_eq!(UR5.inverse(&invalid), Err(KinematicsError::InvalidPose));

    let q = six_joints([0.3, -1.0, 1.2, -0.5, 1.0, 0.2]);
    let narrow = UR5.inverse_nearest(&UR5.forward(&q), &q, &[-0.1; 7], &[0.1; 7]);
    assert!(matches!(narrow, Err(KinematicsError::OutsideJointLimits { branches: 8 })), "{narrow:?}");
}

#[test]
fn a_base_is_placed_where_the_flange_is_wanted() {
    let wanted = Isometry3::new(Vector3::new(0.12, -0.34, 0.56), Vector3::new(1.0, -2.0, 0.5));
    let q = COMFORTABLE_Q_RAD;
    let base = place_base_for(&UR5.into(), &wanted, &q);
    let flange = base * UR5.forward(&q);
    assert!((flange.translation.vector - wanted.translation.vector).norm() < 1e-14);
    assert!(flange.rotation.rotation_to(&wanted.rotation).vector().norm() < 1e-15);
    println!("manipulability of the comfortable configuration: {:.4} m³", UR5.manipulability_m3(&q));
    assert!(UR5.manipulability_m3(&q) > 0.09);
}
