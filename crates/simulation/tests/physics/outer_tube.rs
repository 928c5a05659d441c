//! A tool that slides out of a straight outer tube, rotates in it and drills: shape and stiffness against
//! closed forms, the drive against the double-S profile, the rest against invariants.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a helper that fails is a failed test")]

use crate::common;

use std::path::{Path, PathBuf};

use crate::common::arm::{Uniform, rest_to_rest_s};
use crate::common::{bone, latched};
use messages::{
    ArmMode, ArmProtectiveStop, Command, Latched, SOURCE_FRESH, SOURCE_HELD, SOURCE_NONE, State, TubeMode,
};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use scene::Scene;
use simulation::manipulator::{
    AnyManipulator, BaseMotion, ManipulatorModel, ManipulatorParameters, Rung, SphereKind, StepInput,
    TendonCommand, Wrench,
};
use simulation::{CtView, Simulation, manipulator_parameters};
use test_support::scenes::TOOL;

const DT_S: f64 = 1e-3;
/// The curved part of the shipped tool.
const CURVED_M: f64 = 0.04;
/// Reciprocal of its radius of 50 mm.
const CURVATURE_PER_M: f64 = 20.0;
/// Straight section from its end to the burr.
const BEHIND_M: f64 = 2.375e-3;

/// E I of the nitinol tube and of the steel tube, N m², from the dimensions in the file.
fn rigidities_nm2() -> [f64; 2] {
    let of = |modulus_pa: f64, [outer_m, inner_m]: [f64; 2]| {
        modulus_pa * core::f64::consts::PI / 64.0 * (outer_m.powi(4) - inner_m.powi(4))
    };
    [of(15e9, [3.6e-3, 3.1e-3]), of(193e9, [5.0e-3, 3.7e-3])]
}

fn scene_with(more: &str) -> Scene {
    scene_of(more, None)
}

/// A scene with the shipped tool, optionally with another outer tube.
fn scene_of(more: &str, outer_tube: Option<&str>) -> Scene {
    let folder: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/tools");
    let text = format!(
        "name = \"tubes\"\nrun = {{ mode = \"lockstep\", duration_s = 60.0 }}\n{more}\n[manipulator]\n\
         file = \"tube_in_tube.toml\"\n{TOOL}"
    );
    let read = |file: &Path| {
        let text = std::fs::read_to_string(file)?;
        let Some(other) = outer_tube else { return Ok(text) };
        let [before, after] = ["[outer_tube]", "[stop]"].map(|table| text.find(table).unwrap());
        Ok(format!("{}{other}{}", &text[..before], &text[after..]))
    };
    Scene::parse_with(&text, &folder.join("scene.toml"), &read).unwrap()
}

fn parameters() -> ManipulatorParameters {
    let mut p = manipulator_parameters(&scene_with("")).unwrap();
    p.damping_ratio = 1.0;
    p.mount_stiffness_n_per_m = [1e9; 3];
    p
}

const RUNGS: [Rung; 3] = [Rung::Planar, Rung::Spatial, Rung::Full];

/// The tool at rest under a force on its burr, deployed by a length out of the outer tube; base at the
/// origin.
fn settled(rung: Rung, p: &ManipulatorParameters, deployed_m: f64, force_n: Vector3<f64>) -> AnyManipulator {
    let base = BaseMotion::at_rest(Isometry3::identity());
    let mut tool = AnyManipulator::new(rung, p.clone(), &base).unwrap();
    tool.set_deployed(deployed_m);
    let tip_wrench = Wrench { force_n, torque_nm: Vector3::zeros() };
    let input = StepInput { base, tendon: TendonCommand::EachForce([0.0; 4]), tip_wrench, contacts: &[] };
    for _ in 0..3000 {
        tool.step(DT_S, &input).unwrap();
    }
    tool
}

/// The burr of two arcs in series behind 40 mm of straight tool: x, z and bend.
fn two_arcs(covered_m: f64, covered_per_m: f64, out_m: f64) -> [f64; 3] {
    let (mut x, mut z, mut angle) = (0.0, 0.04, 0.0f64);
    for (length_m, curvature) in [(covered_m, covered_per_m), (out_m, CURVATURE_PER_M)] {
        let next = angle + curvature * length_m;
        if length_m > 0.0 {
            x += (angle.cos() - next.cos()) / curvature;
            z += (next.sin() - angle.sin()) / curvature;
        }
        angle = next;
    }
    [x + BEHIND_M * angle.sin(), z + BEHIND_M * angle.cos(), angle]
}

/// Where the tubes overlap, they share one curvature: the mean of theirs, weighted by E I.
#[test]
fn a_partly_covered_tube_rests_on_two_arcs() {
    let [inner, outer] = rigidities_nm2();
    let covered_per_m = CURVATURE_PER_M * inner / (inner + outer);
    for deployed_mm in [0.0, 5.0, 12.5, 20.3, 40.0] {
        let out_m = deployed_mm * 1e-3;
        let [x, z, bend] = two_arcs(CURVED_M - out_m, covered_per_m, out_m);
        for rung in RUNGS {
            let tool = settled(rung, &parameters(), out_m, Vector3::zeros());
            let burr = tool.t_world_tip().translation.vector;
            let off_um = 1e6 * (burr - Vector3::new(x, 0.0, z)).norm();
            println!(
                "{deployed_mm:4.1} mm out, {}: bend {:.3} deg, closed form {:.3}; burr {off_um:.2} um off",
                rung.name(),
                tool.bend_rad().to_degrees(),
                bend.to_degrees()
            );
            // Hinges at the midpoints of straight links: h² / 24 R times the length, and the same again where
            // the outer tube ends within a link.
            assert!(off_um < 10.0 && (tool.bend_rad() - bend).abs() < 1e-9, "{off_um}");
        }
    }
}

/// Castigliano's theorem for a cantilever of two bending stiffnesses and a rigid end; `full` includes shear.
#[test]
fn a_straight_tube_in_its_outer_tube_yields_as_a_cantilever_of_two_pieces() {
    let [inner, outer] = rigidities_nm2();
    let mut p = parameters();
    p.joint_rest_rad = Vec::new();
    let force_n = 0.05;
    for deployed_mm in [0.0, 10.0, 20.3, 40.0] {
        let out_m = deployed_mm * 1e-3;
        let cubed = |m: f64| m * m * m / 3.0;
        let (near_m, far_m) = (BEHIND_M + out_m, BEHIND_M + CURVED_M);
        let bent =
            (cubed(near_m) - cubed(BEHIND_M)) / inner + (cubed(far_m) - cubed(near_m)) / (inner + outer);
        let [r_o, r_i]: [f64; 2] = p.tube_radii_m;
        // Cowper's shear stiffness of the tool's own tube, over its whole length.
        let shear_n = inner * 4.0 / (r_o * r_o + r_i * r_i) / (4.0 + 3.0 * p.poisson_ratio);
        for rung in RUNGS {
            let sheared = if rung == Rung::Full { CURVED_M / shear_n } else { 0.0 };
            let closed_m = force_n * (bent + sheared);
            for (axis, direction) in [Vector3::x(), Vector3::y()].into_iter().enumerate() {
                if rung == Rung::Planar && axis == 1 {
                    continue;
                }
                let tool = settled(rung, &p, out_m, direction * force_n);
                let moved_m = tool.t_world_tip().translation.vector.dot(&direction);
                println!(
                    "{deployed_mm:4.1} mm out, {} along {}: {:.4} um, closed form {:.4}",
                    rung.name(),
                    ["x", "y"][axis],
                    1e6 * moved_m,
                    1e6 * closed_m
                );
                // Flexures of 1.25 mm: the square of a link over that of the length, and the link's position
                // at the outer tube's end.
                assert!((moved_m / closed_m - 1.0).abs() < 5e-3, "{moved_m} {closed_m}");
            }
        }
    }
}

/// Contact spheres have the radius of the outermost tube at their position.
#[test]
fn spheres_are_as_thick_as_the_outer_tube_where_it_covers_them() {
    let base = BaseMotion::at_rest(Isometry3::identity());
    let mut p = parameters();
    p.joint_rest_rad = Vec::new();
    for rung in RUNGS {
        let mut tool = AnyManipulator::new(rung, p.clone(), &base).unwrap();
        for deployed_m in [0.0, 0.013, 0.04, 0.0] {
            tool.set_deployed(deployed_m);
            let mut seen = [0; 3];
            for sphere in tool.proxy_spheres().iter().filter(|sphere| sphere.kind != SphereKind::Burr) {
                let beyond_m = sphere.centre_m.z + deployed_m - 0.08;
                let radius_mm = sphere.radius_m * 1e3;
                let place = if beyond_m > 0.0 { 0 } else { 1 + usize::from(beyond_m < -2.5e-3) };
                seen[place] += 1;
                let is_right = match place {
                    0 => radius_mm == 1.8,
                    1 => (1.8..=2.5).contains(&radius_mm),
                    _ => (radius_mm - 2.5).abs() < 1e-12,
                };
                assert!(is_right, "{radius_mm} mm at {beyond_m}");
            }
            assert!(seen[2] > 0 && (seen[0] > 0) == (deployed_m > 0.0), "{seen:?}");
        }
    }
    let refused = AnyManipulator::new(Rung::ConstantCurvature, p, &base).unwrap_err().to_string();
    assert!(refused.contains("outer_tube.end_m"), "{refused}");
}

fn move_tube(deployed_mm: f64, roll_deg: f64, speed_mm_per_s: f64) -> Command {
    Command {
        sequence: 1,
        tube_mode: TubeMode::MoveJp.code(),
        tube_deployed_m: deployed_mm * 1e-3,
        tube_roll_rad: roll_deg.to_radians(),
        tube_speed_m_per_s: speed_mm_per_s * 1e-3,
        ..Command::zeroed()
    }
}

/// Sends a command in the next tick, then steps while `look` returns true. Returns the number of ticks.
fn drive(
    simulation: &mut Simulation,
    command: Command,
    most: u64,
    mut look: impl FnMut(&State) -> bool,
) -> u64 {
    let mut source = SOURCE_FRESH;
    for ticks in 1..=most {
        let tick = simulation.state().tick;
        simulation.step(&latched(tick, source, 0, command)).unwrap();
        source = SOURCE_HELD;
        if !look(simulation.state()) {
            return ticks;
        }
    }
    most
}

fn new(more: &str) -> Simulation<'static> {
    Simulation::new(&scene_with(more), None).unwrap()
}

/// The drive reaches its speed in 0.1 s, and its acceleration in half of that.
#[test]
fn the_tube_takes_the_time_of_its_double_s_and_the_base_stays() {
    let cases: [(f64, f64, f64); 4] =
        [(40.0, 0.0, 0.0), (20.0, 0.0, 3.0), (0.5, 0.0, 0.0), (0.0, -270.0, 0.0)];
    for (goal_mm, roll_deg, speed_mm_per_s) in cases {
        let mut simulation = new("");
        let base = simulation.state().t_world_base;
        let is_on_its_way = |state: &State| {
            assert!((0..3).all(|i| (state.t_world_base.position_m[i] - base.position_m[i]).abs() < 1e-6));
            (state.tube_deployed_m - goal_mm * 1e-3).abs() > 1e-12
                || (state.tube_roll_rad - roll_deg.to_radians()).abs() > 1e-12
        };
        let ticks =
            drive(&mut simulation, move_tube(goal_mm, roll_deg, speed_mm_per_s), 10_000, is_on_its_way);
        let closed_s = match goal_mm {
            0.0 => rest_to_rest_s(
                270f64.to_radians(),
                90f64.to_radians(),
                900f64.to_radians(),
                18_000f64.to_radians(),
            ),
            _ => rest_to_rest_s(goal_mm * 1e-3, if speed_mm_per_s > 0.0 { 3e-3 } else { 0.01 }, 0.1, 2.0),
        };
        println!("{goal_mm} mm, {roll_deg} deg: {ticks} ticks, closed form {:.2}", closed_s / DT_S);
        assert!((ticks as f64 - (closed_s / DT_S).ceil()).abs() <= 1.0);
    }
}

/// Deployed, then rolled: the burr moves around the axis. `planar` bends in its own plane, which rotates with
/// it.
#[test]
fn a_roll_turns_the_burr_about_the_axis() {
    for model in ["planar", "spatial", "full"] {
        let scene = {
            let mut scene = scene_with("");
            scene.manipulator.model = Some(match model {
                "planar" => scene::ManipulatorRung::Planar,
                "spatial" => scene::ManipulatorRung::Spatial,
                _ => scene::ManipulatorRung::Full,
            });
            scene
        };
        let mut simulation = Simulation::new(&scene, None).unwrap();
        drive(&mut simulation, move_tube(25.0, 0.0, 0.0), 4000, |_| true);
        let from = *simulation.state();
        drive(&mut simulation, move_tube(25.0, 110.0, 0.0), 4000, |_| true);
        let to = *simulation.state();
        let base = |state: &State| Vector3::from(state.t_world_base.position_m);
        let burr = |state: &State| Vector3::from(state.t_world_burr.position_m) - base(state);
        // In TOOL, the tool's axis is the world's +z.
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 110f64.to_radians());
        let off_m = (turn * burr(&from) - burr(&to)).norm();
        println!(
            "{model}: {:.3} mm from the axis, {:.1e} m off after the roll",
            1e3 * burr(&from).xy().norm(),
            off_m
        );
        assert!(burr(&from).xy().norm() > 5e-3 && off_m < 1e-8, "{off_m}");
        assert!((to.bend_rad - from.bend_rad).abs() < 1e-8);
    }
}

#[test]
fn any_commands_keep_travel_and_limits_and_a_keyframe_and_a_snapshot_continue() {
    let (mut simulation, mut uniform) = (new(""), Uniform(5));
    let mut before = *simulation.state();
    let mut most = [0.0f64; 4];
    for sequence in 1..150 {
        let command = match uniform.between(0.0, 5.0) as usize {
            0 => Command { tube_mode: TubeMode::Hold.code(), ..Command::zeroed() },
            _ => move_tube(
                uniform.between(0.0, 40.0),
                uniform.between(-300.0, 300.0),
                uniform.between(0.0, 12.0),
            ),
        };
        let ticks = uniform.between(1.0, 500.0) as u64;
        drive(&mut simulation, Command { sequence, ..command }, ticks, |state| {
            assert!((0.0..=0.04).contains(&state.tube_deployed_m));
            let speeds = [state.tube_deploying_m_per_s, state.tube_rolling_rad_per_s];
            let moved =
                [state.tube_deployed_m - before.tube_deployed_m, state.tube_roll_rad - before.tube_roll_rad];
            for axis in 0..2 {
                let was = [before.tube_deploying_m_per_s, before.tube_rolling_rad_per_s][axis];
                let acceleration = (speeds[axis] - was) / DT_S;
                let unit = [0.01, 90f64.to_radians()][axis];
                most[axis] = most[axis].max(speeds[axis].abs() / unit);
                most[2 + axis] = most[2 + axis].max(acceleration.abs() / (10.0 * unit));
                // The trapezoid of the speeds gives the distance, except for the jerk's contribution, j dt³ /
                // 12.
                let off = moved[axis] - 0.5 * (speeds[axis] + was) * DT_S;
                assert!(off.abs() <= 200.0 * unit * DT_S.powi(3) / 12.0 * 1.01, "{off}");
            }
            before = *state;
            true
        });
        assert!(simulation.refusals().is_empty());
    }
    println!("speeds and accelerations used, of their limits: {most:?}");
    assert!(most.iter().all(|share| (0.9..=1.0 + 1e-9).contains(share)), "{most:?}");

    drive(&mut simulation, move_tube(0.0, 0.0, 0.0), 9000, |_| true);
    drive(&mut simulation, move_tube(30.0, 90.0, 0.0), 700, |_| true);
    assert!(simulation.state().tube_deploying_m_per_s > 0.0, "still moving");
    let mut bytes = vec![0; 1 << 20];
    let length = simulation.write_keyframe(&mut bytes).unwrap();
    let snapshot = simulation.snapshot();
    let mut other = new("");
    other.restore_keyframe(&bytes[..length]).unwrap();
    let command = move_tube(30.0, 90.0, 0.0);
    let on = |simulation: &mut Simulation| {
        for _ in 0..500 {
            let tick = simulation.state().tick;
            simulation.step(&latched(tick, SOURCE_HELD, 0, command)).unwrap();
        }
        simulation.state().hash
    };
    let hash = on(&mut simulation);
    assert_eq!(on(&mut other), hash);
    simulation.restore(&snapshot).unwrap();
    assert_eq!(on(&mut simulation), hash);
    let mut of_another = Simulation::new(
        &common::scene("name = \"a\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }"),
        None,
    )
    .unwrap();
    assert!(of_another.restore_keyframe(&bytes[..length]).is_err(), "another tool");

    let reset = Latched { reset: 1, ..latched(simulation.state().tick, SOURCE_NONE, 0, Command::zeroed()) };
    simulation.step(&reset).unwrap();
    assert_eq!((simulation.state().tube_deployed_m, simulation.state().tube_roll_rad), (0.0, 0.0));
}

#[test]
fn a_goal_beyond_the_travel_and_a_tool_without_outer_tube_are_refused_and_nothing_moves() {
    let mut simulation = new("");
    drive(&mut simulation, move_tube(50.0, 0.0, 0.0), 1, |_| true);
    let reason = simulation.refusals()[0].reason.clone();
    assert!(reason.contains("`tube_deployed_m` is 0.05; allowed: 0 to 0.04"), "{reason}");
    let mut plain = Simulation::new(
        &common::scene("name = \"a\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }"),
        None,
    )
    .unwrap();
    drive(&mut plain, move_tube(1.0, 0.0, 0.0), 1, |_| true);
    assert!(plain.refusals()[0].reason.contains("no `outer_tube`"), "{:?}", plain.refusals());
    for simulation in [&mut simulation, &mut plain] {
        drive(simulation, Command::zeroed(), 50, |_| true);
        assert_eq!(simulation.state().tube_deployed_m, 0.0);
    }
}

/// The wrench on the flange is about the tool's base. As the tube slides away from it, the lever of its
/// weight grows by the same distance.
#[test]
fn the_flange_feels_the_tubes_weight_at_a_longer_lever() {
    let at = |simulation: &mut Simulation, deployed_mm: f64| {
        drive(simulation, move_tube(deployed_mm, 180.0, 0.0), 6000, |_| true);
        let wrench = simulation.state().flange_wrench;
        (Vector3::from(wrench.force_n), Vector3::from(wrench.torque_nm))
    };
    // Straight and stiff, so that the sliding tube keeps its shape.
    let mut scene = scene_with("gravity_m_per_s2 = [9.81, 0.0, 0.0]");
    if let Some(tool) = &mut scene.manipulator.tool {
        tool.flexure.iter_mut().for_each(|flexure| flexure.rest_deg = 0.0);
        tool.tube.youngs_modulus_gpa = Some(900.0);
    }
    let mut stiff = Simulation::new(&scene, None).unwrap();
    let (force_n, near_nm) = at(&mut stiff, 0.0);
    let (same_n, far_nm) = at(&mut stiff, 40.0);
    let grown = far_nm.y - near_nm.y;
    println!(
        "weight {:.5} N; torque {:.6} and {:.6} N mm, grown by {:.6}, lever {:.6}",
        force_n.x,
        1e3 * near_nm.y,
        1e3 * far_nm.y,
        1e3 * grown,
        40.0 * force_n.x
    );
    assert!(force_n.x > 0.02 && (same_n - force_n).norm() < 1e-6);
    assert!((grown - 0.04 * force_n.x).abs() < 1e-3 * grown.abs(), "{grown}");
}

/// A stationary burr is pushed into the end of the hole: the arm's force limit stops the tube, and the arm's
/// `hold` lets it be retracted.
#[test]
fn a_protective_stop_stops_the_tube_too() {
    let more = "volume = { phantom = \"block\" }\narm = { max_force_n = 4.0 }\n[[predrill]]\n\
                from_mm = [0.0, 0.0, -110.0]\nto_mm = [0.0, 0.0, 0.0]\ndiameter_mm = 5.6\n";
    let (geometry, hu) = bone();
    let mut simulation = Simulation::new(&scene_with(more), Some(CtView { geometry, hu: &hu })).unwrap();
    let stopped = |state: &State| state.arm_protective_stop() == Ok(ArmProtectiveStop::Stopped);
    let ticks = drive(&mut simulation, move_tube(20.0, 0.0, 2.0), 8000, |state| !stopped(state));
    assert!(ticks < 8000, "never stopped");
    let at_m = simulation.state().tube_deployed_m;
    drive(&mut simulation, Command::zeroed(), 400, |_| true);
    let rests_m = simulation.state().tube_deployed_m;
    println!("stopped after {ticks} ticks at {:.3} mm, rests at {:.3} mm", 1e3 * at_m, 1e3 * rests_m);
    assert!(rests_m < at_m + 2.5e-4 && simulation.state().tube_deploying_m_per_s == 0.0);
    drive(&mut simulation, move_tube(0.0, 0.0, 0.0), 1, |_| true);
    assert!(simulation.refusals()[0].reason.contains("protective stop"), "{:?}", simulation.refusals());
    let released = Command { arm_mode: ArmMode::Hold.code(), ..move_tube(0.0, 0.0, 0.0) };
    drive(&mut simulation, released, 3000, |state| state.tube_deployed_m > 0.0);
    assert_eq!(simulation.state().tube_deployed_m, 0.0);
}

/// Thin and thick, soft and stiff, slow and fast, at every step: the tool is not lost, and comes to rest at
/// its goal.
#[test]
fn an_outer_tube_at_the_ends_of_its_ranges_loses_no_tool() {
    let ends: [(f64, f64, f64, f64, f64, f64); 5] = [
        (1e-3, 3.63, 3.6, 500.0, 1000.0, 3600.0),
        (1e-3, 30.0, 3.6, 0.1, 0.01, 0.1),
        (1000.0, 30.0, 3.6, 500.0, 1000.0, 3600.0),
        (1000.0, 3.63, 3.6, 40.0, 1000.0, 3600.0),
        (193.0, 30.0, 29.98, 500.0, 10.0, 90.0),
    ];
    for (modulus_gpa, outer_mm, inner_mm, travel_mm, speed, roll_speed) in ends {
        for (model, dt_ms) in [
            (scene::ManipulatorRung::Planar, 0.1),
            (scene::ManipulatorRung::Planar, 10.0),
            (scene::ManipulatorRung::Spatial, 1.0),
            (scene::ManipulatorRung::Full, 10.0),
        ] {
            let tubes = format!(
                "[outer_tube]\nend_mm = 80.0\nouter_diameter_mm = {outer_mm:?}\n\
                 inner_diameter_mm = {inner_mm:?}\n\
                 youngs_modulus_gpa = {modulus_gpa:?}\ntravel_mm = {travel_mm:?}\n\
                 speed_mm_per_s = {speed:?}\n\
                 roll_speed_deg_per_s = {roll_speed:?}\n"
            );
            let mut scene = scene_of("gravity_m_per_s2 = [0.0, 9.81, 0.0]", Some(&tubes));
            scene.manipulator.model = Some(model);
            scene.run.dt_ms = dt_ms;
            let mut simulation = Simulation::new(&scene, None).unwrap();
            let goal_mm = travel_mm.min(speed);
            drive(&mut simulation, move_tube(goal_mm, 360.0, 0.0), (3000.0 / dt_ms) as u64, |state| {
                let speeds = state.joint_velocity_rad_per_s.iter().chain(&state.joint_position_rad);
                assert!(speeds.copied().all(f64::is_finite));
                assert!((state.bend_rad.to_degrees()).abs() < 120.0, "{}", state.bend_rad);
                true
            });
            let state = simulation.state();
            let still = state.joint_velocity_rad_per_s.iter().fold(0.0f64, |most, v| most.max(v.abs()));
            let off_m = (state.tube_deployed_m - goal_mm * 1e-3).abs();
            assert!(off_m < 1e-12 || speed < 1.0, "{off_m}");
            assert!(still < 0.05, "{model:?}, {dt_ms} ms, {modulus_gpa} GPa: {still} rad/s at the end");
        }
    }
}
