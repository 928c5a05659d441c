//! Quantities of a state whose values follow by hand.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use identify::quantity::{Body, Frame, Kind, Quantity};
use messages::{Pose, State, Wrench};

fn quantity(kind: Kind) -> Quantity {
    Quantity {
        kind,
        body: Body::Tip,
        link: 0,
        point_m: [0.0; 3],
        frame: Frame::Patient,
        gauge_m: 5e-3,
        field: None,
    }
}

fn pose(position_m: [f64; 3], orientation_xyzw: [f64; 4]) -> Pose {
    Pose { position_m, orientation_xyzw }
}

const PLAIN: [f64; 4] = [0.0, 0.0, 0.0, 1.0];
/// A quarter turn about z.
const QUARTER: [f64; 4] = [0.0, 0.0, core::f64::consts::FRAC_1_SQRT_2, core::f64::consts::FRAC_1_SQRT_2];

/// The tip is at (1, 2, 3), turned by 90° about z; the base at the origin, and now at (0, 2, 0).
fn states() -> (State, State) {
    let mut start = State::zeroed();
    start.t_world_base = pose([0.0; 3], PLAIN);
    start.t_world_burr = pose([0.0, 0.0, 1.0], PLAIN);
    let mut state = start;
    state.t_world_tip = pose([1.0, 2.0, 3.0], QUARTER);
    state.t_world_base = pose([0.0, 2.0, 0.0], QUARTER);
    state.t_world_burr = pose([1.0, 2.0, 2.5], QUARTER);
    state.flange_wrench = Wrench { force_n: [1.0, 0.0, 0.5], torque_nm: [0.0, 2.0, 0.0] };
    state.bend_rad = 0.25;
    state.tendon_tension_n[1] = 7.0;
    (state, start)
}

fn values(quantity: &Quantity, count: usize) -> Vec<f64> {
    let (state, start) = states();
    let mut out = Vec::new();
    // A camera that sees x and y in millimetres, and nothing behind z = 0.
    let project = |[x, y, z]: [f64; 3]| (z > 0.0).then_some([1e3 * x, 1e3 * y]);
    quantity.values(&state, &start, &project, count, &mut out);
    out
}

fn assert_near(found: &[f64], expected: &[f64]) {
    let is_near = found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12);
    assert!(is_near && found.len() == expected.len(), "{found:?}, expected {expected:?}");
}

#[test]
fn positions_and_forces_are_those_of_their_frame() {
    let position = quantity(Kind::Position);
    assert_near(&values(&position, 3), &[1.0, 2.0, 3.0]);
    // Base: one along the patient's x, which is the turned base's −y.
    assert_near(&values(&Quantity { frame: Frame::Base, ..position.clone() }, 3), &[0.0, -1.0, 3.0]);
    // A marker 0.5 along the tip's x is 0.5 along the patient's y.
    assert_near(&values(&Quantity { point_m: [0.5, 0.0, 0.0], ..position }, 3), &[1.0, 2.5, 3.0]);
    let force = Quantity { frame: Frame::Base, ..quantity(Kind::FlangeForce) };
    assert_near(&values(&force, 3), &[0.0, -1.0, 0.5]);
    let torque = Quantity { frame: Frame::Base, ..quantity(Kind::FlangeTorque) };
    assert_near(&values(&torque, 3), &[2.0, 0.0, 0.0]);
}

#[test]
fn numbers_pixels_and_fields_are_read_from_the_state() {
    assert_near(&values(&quantity(Kind::Bend), 1), &[0.25]);
    assert_near(&values(&quantity(Kind::Depth), 1), &[1.5]);
    assert_near(&values(&quantity(Kind::TendonTension), 2), &[0.0, 7.0]);
    assert_near(&values(&quantity(Kind::Pixel), 2), &[1000.0, 2000.0]);
    let behind = Quantity { body: Body::Flange, ..quantity(Kind::Pixel) };
    assert!(values(&behind, 2).iter().all(|value| value.is_nan()));
    let field = Some(Quantity::scalar("t_world_tip.position_m[2]").unwrap());
    assert_near(&values(&Quantity { field, ..quantity(Kind::Field) }, 1), &[3.0]);
    assert!(Quantity::scalar("t_world_tip").unwrap_err().contains("has 7 values"));
    assert!(Quantity::scalar("bend_rd").unwrap_err().contains("did you mean 'bend_rad'"));
}
