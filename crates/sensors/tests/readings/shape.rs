//! Fibre-Bragg shape and the tracker's line of sight, against closed forms.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail")]

use crate::common;

use crate::common::{identity, scene, state};
use messages::{Pose, State};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use sensors::{Fibre, MeasuredState, SensorArray, node_places};

fn pose(isometry: &Isometry3<f64>) -> Pose {
    let turn = isometry.rotation.coords;
    Pose {
        position_m: isometry.translation.vector.into(),
        orientation_xyzw: [turn.x, turn.y, turn.z, turn.w],
    }
}

const PITCH_M: f64 = 1.3e-3;

/// A tool of 27 flexures behind a shaft of 20 mm, whose flexure i bends by `turn_rad(i)` toward +x and +y.
fn tool(turn_rad: impl Fn(usize) -> [f64; 2]) -> State {
    let mut state = State { joint_count: 27, ..state(0, 0.0) };
    let mut here = Isometry3::from_parts(
        Translation3::new(0.1, -0.2, 0.3),
        UnitQuaternion::from_euler_angles(0.3, -0.5, 1.1),
    );
    state.t_world_base = pose(&here);
    here *= Translation3::new(0.0, 0.0, 20e-3);
    for i in 0..27 {
        let [toward, across] = turn_rad(i);
        here *= UnitQuaternion::from_scaled_axis(Vector3::new(-across, toward, 0.0));
        state.t_world_link[i] = pose(&here);
        here *= Translation3::new(0.0, 0.0, if i < 26 { PITCH_M } else { 5e-3 });
    }
    state.t_world_burr = pose(&here);
    state.t_world_tip = pose(&(here * Translation3::new(0.0, 0.0, 3e-3)));
    state
}

fn nodes(state: &State, nodes: u32) -> Vec<f64> {
    let scene =
        scene(&format!("rate_hz = 1.0\nfbg = {{ nodes = {nodes}, noise_per_m = 0.0, bias_per_m = 0.0 }}"));
    let mut sensors = SensorArray::new(&scene);
    sensors.see(state);
    sensors.readings()[0].values().to_vec()
}

/// Uniform bending by 90° over 27 flexures: every node reads angle / length, in the direction of the bend.
#[test]
fn the_nodes_of_an_even_bend_read_its_curvature() {
    let angle = std::f64::consts::FRAC_PI_2 / 27.0;
    for (toward, across) in [(1.0, 0.0), (0.6, -0.8)] {
        let values = nodes(&tool(|_| [angle * toward, angle * across]), 3);
        let curvature = angle / PITCH_M;
        for pair in values.chunks_exact(2) {
            assert!((pair[0] - curvature * toward).abs() < 1e-9, "{values:?}");
            assert!((pair[1] - curvature * across).abs() < 1e-9, "{values:?}");
        }
    }
    assert!(
        nodes(&State { joint_count: 0, ..state(0, 0.0) }, 3).iter().all(|value| *value == 0.0),
        "a rigid tool"
    );
}

/// Without gaps between the gauges, the nodes' curvatures times their section lengths add up to the bend.
#[test]
fn the_nodes_add_up_to_the_bend() {
    let turns = |i: usize| [0.02 + 0.002 * i as f64, 0.0];
    let state = tool(turns);
    let length_mm = 27.0 * PITCH_M * 1e3;
    let keys = format!(
        "rate_hz = 1.0\nfbg = {{ nodes = 9, gauge_mm = {}, noise_per_m = 0.0, bias_per_m = 0.0 }}",
        length_mm / 9.0
    );
    let mut sensors = SensorArray::new(&scene(&keys));
    sensors.see(&state);
    let sum: f64 = sensors.readings()[0].values().iter().step_by(2).map(|k| k * 27.0 * PITCH_M / 9.0).sum();
    let bend: f64 = (0..27).map(|i| turns(i)[0]).sum();
    assert!((sum - bend).abs() < 1e-12, "{sum}, expected {bend}");
}

/// The end of a circular arc: (1 − cos θ) / κ to the side and sin θ / κ ahead, for any number of nodes.
#[test]
fn the_shape_of_even_curvatures_is_a_circle() {
    let fibre = Fibre { start_m: 20e-3, length_m: 35e-3, tip_m: 4e-3 };
    for (curvature, count) in [(45.0, 1), (45.0, 3), (0.0, 3), (-20.0, 16)] {
        let values: Vec<f64> = (0..count).flat_map(|_| [curvature, 0.0]).collect();
        let burr = fibre.burr(&identity(), &values);
        let angle: f64 = curvature * 35e-3;
        let [side, ahead] = if curvature == 0.0 {
            [0.0, 35e-3]
        } else {
            [(1.0 - angle.cos()) / curvature, angle.sin() / curvature]
        };
        let want = [side + 4e-3 * angle.sin(), 0.0, 20e-3 + ahead + 4e-3 * angle.cos()];
        for (found, want) in burr.position_m.iter().zip(want) {
            assert!((found - want).abs() < 1e-14, "{:?}, expected {want:?}", burr.position_m);
        }
    }
    assert_eq!(node_places(2).collect::<Vec<_>>(), [0.25, 0.75]);
}

/// A controller's state from three noise-free nodes. A chain of 27 hinges is an arc to within a few
/// micrometres. Three nodes do not see the curvature beyond the first and the last node: where it rises by
/// half from base to tip, that costs 0.19 mm, as much as the paper's entire shape error with this number of
/// nodes, 0.22 mm (Ma et al. 2023, arXiv 2303.03613). Sixteen nodes reduce it to a fifth.
#[test]
fn nodes_find_the_tip_of_a_chain() {
    for (turns, rise, nodes, allowed_m) in [
        ([0.04, 0.0], 0.0, 3, 20e-6),
        ([0.02, 0.03], 0.0, 3, 20e-6),
        ([0.04, 0.0], 0.4, 3, 220e-6),
        ([0.04, 0.0], 0.4, 16, 45e-6),
    ] {
        let exact = tool(|i| turns.map(|turn| turn * (1.0 + rise * (i as f64 / 26.0 - 0.5))));
        let scene = scene(&format!(
            "rate_hz = 1.0\nfbg = {{ nodes = {nodes}, noise_per_m = 0.0, bias_per_m = 0.0 }}"
        ));
        let mut sensors = SensorArray::new(&scene);
        sensors.see(&exact);
        let mut measured = MeasuredState::new(&scene, &["s".to_owned()]);
        assert!(!measured.is_complete());
        measured.see(&sensors.readings()[0]);
        assert!(measured.is_complete());
        let seen = measured.of(&exact);
        for (a, b) in [(seen.t_world_burr, exact.t_world_burr), (seen.t_world_tip, exact.t_world_tip)] {
            let error_m = (Vector3::from(a.position_m) - Vector3::from(b.position_m)).norm();
            println!("error {:.1} um", error_m * 1e6);
            assert!(error_m < allowed_m, "{error_m} m");
        }
        measured.forget_before(1);
        assert!(!measured.is_complete());
    }
}

#[test]
fn noise_of_a_tracker_has_the_level_asked_for_in_position_and_angle() {
    let scene = scene("rate_hz = 1000.0\ntracker = { position_noise_mm = 0.3, orientation_noise_deg = 0.2 }");
    let all = common::read(&scene, 40_000, |_| 0.0);
    for axis in 0..3 {
        let x: Vec<f64> = all.iter().map(|reading| reading.value[axis]).collect();
        assert!((common::deviation(&x) / 0.3e-3 - 1.0).abs() < 4.0 / 80_000.0_f64.sqrt());
        // The quaternion's component is half the angle, to third order.
        let angle: Vec<f64> = all.iter().map(|reading| 2.0 * reading.value[3 + axis]).collect();
        assert!((common::deviation(&angle) / 0.2_f64.to_radians() - 1.0).abs() < 4.0 / 80_000.0_f64.sqrt());
    }
    assert!(all.iter().all(|r| (r.value[3..7].iter().map(|q| q * q).sum::<f64>() - 1.0).abs() < 1e-12));
}

#[test]
fn an_optical_tracker_sees_its_marker_only_from_the_side_it_faces() {
    let sees = |camera: &str, view_deg: f64| {
        let keys = format!(
            "rate_hz = 1.0\ntracker = {{ on = \"flange\", camera_mm = {camera}, view_deg = {view_deg:?} }}"
        );
        common::read(&scene(&keys), 1, |_| 0.0)[0].is_valid()
    };
    // The marker faces -z; the camera is at 45° from that direction.
    assert!(sees("[1000.0, 0.0, -1000.0]", 46.0));
    assert!(!sees("[1000.0, 0.0, -1000.0]", 44.0));
    assert!(!sees("[0.0, 0.0, 1000.0]", 90.0));
    assert!(sees("[0.0, 0.0, 1000.0]", 180.0));
}
