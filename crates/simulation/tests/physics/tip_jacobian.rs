//! The tip's Jacobian and compliance against closed forms and against differences of the settled tool.

#![allow(clippy::unwrap_used, reason = "a test that cannot build its tool has failed")]

use crate::common::{rest, wall_at};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use simulation::manipulator::{
    AnyManipulator, BaseMotion, ManipulatorModel, ManipulatorParameters, Rung, StepInput, TendonCommand,
    TipJacobian, Wrench,
};

const LENGTH_M: f64 = 0.035;
const RIGIDITY_NM2: f64 = 1.3369e-3;

/// Inputs of a tool that settles.
#[derive(Clone, Copy)]
struct Load {
    tension_n: [f64; 4],
    base: Isometry3<f64>,
    /// Wrench about the tip.
    wrench: [f64; 6],
    wall_m: Option<f64>,
}

fn front(m: &AnyManipulator) -> Isometry3<f64> {
    m.t_world_tip() * Translation3::new(0.0, 0.0, m.parameters().cutter.front_radius_m())
}

fn settle(m: &mut AnyManipulator, load: &Load, steps: usize) {
    for _ in 0..steps {
        let [fx, fy, fz, tx, ty, tz] = load.wrench;
        let (force_n, torque_nm) = (Vector3::new(fx, fy, fz), Vector3::new(tx, ty, tz));
        let lever = front(m).translation.vector - m.t_world_tip().translation.vector;
        let contacts = load.wall_m.map_or_else(Vec::new, |x_m| wall_at(m, x_m));
        let input = StepInput {
            base: BaseMotion::at_rest(load.base),
            tendon: TendonCommand::EachForce(load.tension_n),
            tip_wrench: Wrench { force_n, torque_nm: torque_nm + lever.cross(&force_n) },
            contacts: &contacts,
        };
        m.step(1e-3, &input).unwrap();
    }
}

/// Displacement from the first to the second pose: linear, then angular, world axes.
fn between(before: &Isometry3<f64>, after: &Isometry3<f64>) -> [f64; 6] {
    let v = after.translation.vector - before.translation.vector;
    let w = (after.rotation * before.rotation.inverse()).scaled_axis();
    [v.x, v.y, v.z, w.x, w.y, w.z]
}

/// Returns the derivative of the settled pose by an input that `moved` changes by its second argument.
fn difference(start: &AnyManipulator, load: &Load, step: f64, moved: impl Fn(&mut Load, f64)) -> [f64; 6] {
    let [before, after] = [-step, step].map(|step| {
        let (mut m, mut load) = (start.clone(), *load);
        moved(&mut load, step);
        settle(&mut m, &load, 600);
        front(&m)
    });
    between(&before, &after).map(|x| x / (2.0 * step))
}

/// Moves the base by a component of a twist about its origin.
fn move_base(load: &mut Load, k: usize, step: f64) {
    let mut twist = [Vector3::zeros(); 2];
    twist[k / 3][k % 3] = step;
    load.base.translation.vector += twist[0];
    load.base.rotation = UnitQuaternion::from_scaled_axis(twist[1]) * load.base.rotation;
}

/// Largest difference of two columns, relative to the larger of their linear and angular parts.
fn error(a: &[f64; 6], b: &[f64; 6], scale: &[f64; 2]) -> f64 {
    (0..6).map(|i| (a[i] - b[i]).abs() / scale[i / 3]).fold(0.0, f64::max)
}

/// Largest linear and angular entry.
fn scale(columns: &[[f64; 6]]) -> [f64; 2] {
    let largest = |rows: core::ops::Range<usize>| {
        columns.iter().flat_map(|c| c[rows.clone()].to_vec()).fold(0.0, |m: f64, x| m.max(x.abs()))
    };
    // Compared with a rotation by 1 rad, 1 mm is small; compared with a translation by 1 m, 1 rad is.
    let (linear, angular) = (largest(0..3), largest(3..6));
    [linear.max(1e-3 * angular), angular.max(linear)]
}

/// Returns the largest relative errors of tensions, base and compliance.
fn errors(m: &AnyManipulator, load: &Load) -> [f64; 3] {
    let TipJacobian { per_tension, per_base, compliance } = m.tip_jacobian();
    let tendons = m.tendon_count();
    let all = |columns: &[[f64; 6]], of: &dyn Fn(usize) -> [f64; 6]| {
        // Forces and torques, or translations and rotations, have columns of their own scale.
        let kind = if columns.len() == 6 { 3 } else { columns.len() };
        (0..columns.len()).step_by(kind).fold(0.0f64, |worst, from| {
            let part = from..from + kind;
            let scale = scale(&columns[part.clone()]);
            part.fold(worst, |worst, k| worst.max(error(&columns[k], &of(k), &scale)))
        })
    };
    [
        all(&per_tension[..tendons], &|t| difference(m, load, 1e-3, |load, step| load.tension_n[t] += step)),
        all(&per_base, &|k| difference(m, load, 1e-6, |load, step| move_base(load, k, step))),
        all(&compliance, &|k| {
            difference(m, load, if k < 3 { 1e-3 } else { 1e-5 }, |load, step| load.wrench[k] += step)
        }),
    ]
}

fn tool(rung: Rung, change: impl Fn(&mut ManipulatorParameters), load: &Load) -> AnyManipulator {
    let mut p = ManipulatorParameters::jhu_27();
    p.damping_ratio = 1.0;
    p.joint_limit_rad = 1.0;
    p.gravity_m_per_s2 = Vector3::zeros();
    p.tendon.friction_coefficient = 0.0;
    p.contact.friction_coefficient = 0.0;
    p.contact.burr_friction_coefficient = 0.0;
    change(&mut p);
    let mut m = AnyManipulator::new(rung, p, &BaseMotion::at_rest(load.base)).unwrap();
    settle(&mut m, load, 1500);
    m
}

fn turned() -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -0.8, 0.5));
    Isometry3::from_parts(Translation3::new(0.02, -0.01, 0.05), turn)
}

#[test]
fn every_rung_in_free_space_is_the_difference_of_settled_poses() {
    let load = Load { tension_n: [6.0, 1.0, 0.0, 0.0], base: turned(), wrench: [0.0; 6], wall_m: None };
    for rung in Rung::ALL {
        let m = tool(rung, |_| (), &load);
        let errors = errors(&m, &load);
        println!("{}: errors of tensions, base, compliance {errors:?}", rung.name());
        // What has not settled in 0.6 s.
        assert!(errors.iter().all(|error| *error < 2e-5), "{}: {errors:?}", rung.name());
    }
}

#[test]
fn a_wall_holds_the_tip_in_every_rung() {
    let load =
        Load { tension_n: [6.0, 1.0, 0.0, 0.0], base: Isometry3::identity(), wrench: [0.0; 6], wall_m: None };
    for rung in Rung::ALL {
        let free = tool(rung, |_| (), &load);
        let reach_m = free.proxy_spheres().iter().map(|s| s.centre_m.x + s.radius_m).fold(0.0, f64::max);
        let load = Load { wall_m: Some(reach_m - 3e-4), ..load };
        let m = tool(rung, |_| (), &load);
        let pressed_n: f64 = m.contact_results().iter().map(|result| result.normal_force_n).sum();
        let (held, without) = (m.tip_jacobian(), free.tip_jacobian());
        let errors = errors(&m, &load);
        println!(
            "{}: {pressed_n:.4} N, {:.3e} of {:.3e} m/N, errors {errors:?}",
            rung.name(),
            held.compliance[0][0],
            without.compliance[0][0]
        );
        assert!(pressed_n > 1e-3 && held.compliance[0][0] < 0.05 * without.compliance[0][0]);
        // The contact force turns with the wall, not with the tool, which the model leaves out.
        assert!(errors.iter().all(|error| *error < 5e-3), "{}: {errors:?}", rung.name());
    }
}

#[test]
fn a_uniform_beam_is_the_cantilever_of_euler_and_bernoulli() {
    for rung in Rung::ALL {
        let links = 32;
        let mut p = ManipulatorParameters::uniform_beam(links, LENGTH_M, RIGIDITY_NM2);
        p.mount_stiffness_n_per_m = [1e12; 3];
        // Thin, so that the axial and shear stiffnesses of the full rung do not matter.
        p.tube_radii_m = [1e-5, 0.0];
        let m = AnyManipulator::new(rung, p, &rest()).unwrap();
        // The burr is a rigid end.
        let r = m.parameters().cutter.front_radius_m();
        let (c, l) = (m.tip_jacobian().compliance, LENGTH_M + r);
        let bend = [
            (c[0][0], (l * l * l - r * r * r) / (3.0 * RIGIDITY_NM2)),
            (c[0][4], (l * l - r * r) / (2.0 * RIGIDITY_NM2)),
            (c[4][0], (l * l - r * r) / (2.0 * RIGIDITY_NM2)),
            (c[4][4], LENGTH_M / RIGIDITY_NM2),
        ];
        println!("{}: L^3/3EI {:.6e}, here {:.6e}", rung.name(), bend[0].1, bend[0].0);
        for (own, closed) in bend {
            // Hinges at the centres of their cells: 1 / (4 n^2). One arc cannot take a cantilever's shape.
            let allowed = if rung == Rung::ConstantCurvature { 0.26 } else { 3e-4 };
            assert!((own / closed - 1.0).abs() < allowed, "{}: {own} {closed}", rung.name());
        }
    }
}

#[test]
fn a_single_flexure_is_its_lever_squared_over_its_stiffness() {
    for rung in [Rung::Modal, Rung::Planar, Rung::Spatial, Rung::Full] {
        let mut p = ManipulatorParameters::uniform_beam(1, LENGTH_M, RIGIDITY_NM2);
        p.mount_stiffness_n_per_m = [1e12; 3];
        p.tube_radii_m = [1e-5, 0.0];
        let (k, tip_m) = (p.joint_stiffness_nm_per_rad[0], p.tip_offset_m);
        let m = AnyManipulator::new(rung, p, &rest()).unwrap();
        let lever = tip_m + m.parameters().cutter.front_radius_m();
        let c = m.tip_jacobian().compliance[0][0];
        assert!((c * k / (lever * lever) - 1.0).abs() < 1e-6, "{}: {c}", rung.name());
    }
}

#[test]
fn a_stopped_flexure_is_stiffer_and_slack_tendons_have_columns() {
    let load =
        Load { tension_n: [12.0, 1.0, 0.0, 0.0], base: rest().t_world_base, wrench: [0.0; 6], wall_m: None };
    for rung in [Rung::Planar, Rung::Spatial] {
        let free = tool(rung, |_| (), &load);
        let stopped = tool(rung, |p| p.joint_limit_rad = 0.03, &load);
        assert!(stopped.last_report().stopped_joint_count > 5);
        let errors = errors(&stopped, &load);
        println!("{}: at the stops, errors {errors:?}", rung.name());
        let of = |m: &AnyManipulator| m.tip_jacobian().compliance[4][4];
        assert!(of(&stopped) < 0.9 * of(&free));
        assert!(errors[0].max(errors[2]) < 1e-3, "{}: {errors:?}", rung.name());
        let slack = tool(rung, |_| (), &Load { tension_n: [0.0; 4], ..load }).tip_jacobian().per_tension;
        assert!(slack[0][4] > 0.05 && (slack[0][4] + slack[1][4]).abs() < 1e-12, "{slack:?}");
    }
}

#[test]
fn friction_of_a_sliding_tendon_takes_its_share() {
    let load =
        Load { tension_n: [6.0, 0.0, 0.0, 0.0], base: rest().t_world_base, wrench: [0.0; 6], wall_m: None };
    for rung in Rung::ALL {
        let mut own = [0.0; 2];
        for (own, mu) in own.iter_mut().zip([0.0, 0.2]) {
            let mut m =
                tool(rung, |p| p.tendon.friction_coefficient = mu, &Load { tension_n: [0.0; 4], ..load });
            // A ramp, so that the tendon slides in one direction.
            let ramp = |m: &mut AnyManipulator, from_n: f64, to_n: f64| {
                for k in 0..1000 {
                    let tension_n = from_n + (to_n - from_n) * (f64::from(k) / 999.0);
                    settle(m, &Load { tension_n: [tension_n, 0.0, 0.0, 0.0], ..load }, 1);
                }
                settle(m, &Load { tension_n: [to_n, 0.0, 0.0, 0.0], ..load }, 300);
                front(m)
            };
            let before = ramp(&mut m, 0.0, 6.0);
            let column = m.tip_jacobian().per_tension[0];
            let pulled = between(&before, &ramp(&mut m, 6.0, 6.1)).map(|x| x / 0.1);
            println!("{} mu {mu}: {:.4e} rad/N, pulled {:.4e}", rung.name(), column[4], pulled[4]);
            *own = column[4] / pulled[4];
        }
        assert!((own[0] - 1.0).abs() < 1e-2, "{}: {own:?}", rung.name());
        assert!((own[1] - 1.0).abs() < 0.1, "{}: {own:?}", rung.name());
    }
}
