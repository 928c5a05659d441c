//! Tendons that wind around the tool.
//!
//! The channel of such a tendon turns about the axis by an angle proportional to the length. A hole midway
//! between two flexures guides the tendon; between holes it runs straight. With the hole behind a flexure at
//! A and the one ahead at B, each relative to the flexure's centre in the axes of its own link, the chord is
//! `c = u + R B - A`, where R and u are the flexure's rotation and displacement, and the tool takes up `|B -
//! A| - |c|`. A rotation about a unit axis e changes `|c|` by `c . (e x R B) / |c|`, a displacement along e
//! by `c . e / |c|`.
//!
//! The shorter the flexures, the closer the chords are to the tangents of the path, and the forces at the
//! holes (tension times change of direction) to those of Rucker and Webster 2011 ("Statics and dynamics of
//! continuum robots with general tendon routing and external loading", IEEE Trans. Robotics 27(6):1033, doi
//! 10.1109/TRO.2011.2160469), which `clients/python/tests/test_helical_tendons.py` solves.

use nalgebra::Vector3;

use super::error::{ManipulatorError, check};
use super::parameters::{ManipulatorParameters, TendonRoute};

/// A tendon between the hole behind a flexure and the one ahead.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Crossing {
    /// Position of the hole behind, relative to the flexure's centre, axes of the link behind, m.
    behind_m: Vector3<f64>,
    /// Position of the hole ahead, relative to the flexure's centre, axes of the link ahead, m.
    ahead_m: Vector3<f64>,
    straight_m: f64,
    /// Rotation of the path itself, along x and y, rad.
    winding_rad: [f64; 2],
}

/// Effect of a bent flexure on a tendon that crosses it. Freedoms are in the order of the chain:
/// displacements (of six), bend, lateral bend, torsion (of three or six).
pub(super) struct Chord {
    /// Take-up, m.
    pub length_m: f64,
    /// Slope d take-up / d freedom.
    pub slope: [f64; 6],
    /// Curvature d^2 take-up / d freedom^2.
    pub curvature: [f64; 6],
    /// Wrap angle of the tendon in its channel, including that of the path itself, rad.
    pub turn_rad: f64,
    /// Slope d wrap / d (bend, lateral bend).
    pub turn_slope: [f64; 2],
}

/// Returns a tendon's crossings of the flexures that it bends; empty for a tendon parallel to the axis.
pub(super) fn crossings(p: &ManipulatorParameters, route: &TendonRoute) -> Vec<Crossing> {
    if route.twist_rad_per_m == 0.0 {
        return Vec::new();
    }
    let holes_m = p.cell_edges_m();
    let to = route.reach.to.unwrap_or(p.joint_positions_m.len());
    let start_m = holes_m[route.reach.from];
    let [toward_m, across_m] = route.channel_m;
    let angle_rad = |z_m: f64| route.twist_rad_per_m * (z_m - start_m);
    let hole_m = |z_m: f64, joint_m: f64| {
        let (sin, cos) = libm::sincos(angle_rad(z_m));
        Vector3::new(toward_m * cos - across_m * sin, toward_m * sin + across_m * cos, z_m - joint_m)
    };
    let crossing = |joint: usize| {
        let (from_m, to_m, at_m) = (holes_m[joint], holes_m[joint + 1], p.joint_positions_m[joint]);
        let (behind_m, ahead_m) = (hole_m(from_m, at_m), hole_m(to_m, at_m));
        let way_m = ahead_m - behind_m;
        let straight_m = way_m.norm();
        // The tangent of a helix turns toward the axis by its slope times the angle about the axis.
        let slope = libm::hypot(way_m.x, way_m.y) / straight_m;
        let turn_rad = slope * (angle_rad(to_m) - angle_rad(from_m)).abs();
        let middle_m = 0.5 * (behind_m + ahead_m);
        let radius_m = libm::hypot(middle_m.x, middle_m.y);
        let winding = |x_m: f64| if radius_m > 0.0 { -turn_rad * x_m / radius_m } else { 0.0 };
        Crossing { behind_m, ahead_m, straight_m, winding_rad: [winding(middle_m.x), winding(middle_m.y)] }
    };
    (route.reach.from..to).map(crossing).collect()
}

/// Rejects winding tendons, which only the spatial chains support.
pub(super) fn refuse(p: &ManipulatorParameters, allowed: &'static str) -> Result<(), ManipulatorError> {
    let twists = p.tendon_routes.iter().flatten().map(|route| route.twist_rad_per_m);
    for twist in twists {
        check("tendon_routes.twist_rad_per_m", twist, allowed, |twist| twist == 0.0)?;
    }
    Ok(())
}

impl Crossing {
    /// Returns the chord of a flexure with `D` freedoms, 1, 3 or 6, at these coordinates.
    pub fn chord<const D: usize>(&self, q: &[f64]) -> Chord {
        let bend = if D == 6 { 3 } else { 0 };
        let at = |k: usize| if k < D { q[k] } else { 0.0 };
        let moved_m = if D == 6 { Vector3::new(at(0), at(1), at(2)) } else { Vector3::zeros() };
        let (sb, cb) = libm::sincos(at(bend));
        let (sl, cl) = libm::sincos(at(bend + 1));
        let (sw, cw) = libm::sincos(at(bend + 2));
        // R B, R = R_y(bend) R_x(lateral) R_z(torsion), and the axes of the three rotations.
        let [x, y, z]: [f64; 3] = self.ahead_m.into();
        let (x, y) = (x * cw - y * sw, x * sw + y * cw);
        let (y, z) = (y * cl - z * sl, y * sl + z * cl);
        let turned_m = Vector3::new(x * cb + z * sb, y, z * cb - x * sb);
        let axes = [Vector3::y(), Vector3::new(cb, 0.0, -sb), Vector3::new(cl * sb, -sl, cl * cb)];
        let chord_m = moved_m + turned_m - self.behind_m;
        let length_m = chord_m.norm();
        let along = chord_m / length_m;
        let (mut slope, mut curvature) = ([0.0; 6], [0.0; 6]);
        let mut set = |k: usize, moves: Vector3<f64>, bends: Vector3<f64>| {
            let rate = along.dot(&moves);
            slope[k] = -rate;
            curvature[k] = -((moves.norm_squared() - rate * rate) / length_m + along.dot(&bends));
        };
        for k in 0..bend {
            set(k, Vector3::ith(k, 1.0), Vector3::zeros());
        }
        for (k, axis) in (bend..D).zip(&axes) {
            let moves = axis.cross(&turned_m);
            set(k, moves, axis.cross(&moves));
        }
        let turn = [at(bend) + self.winding_rad[0], self.winding_rad[1] - at(bend + 1)];
        let turn_rad = libm::hypot(turn[0], turn[1]);
        let share = |turn: f64| if turn_rad > 0.0 { turn / turn_rad } else { 0.0 };
        Chord {
            length_m: self.straight_m - length_m,
            slope,
            curvature,
            turn_rad,
            turn_slope: [share(turn[0]), -share(turn[1])],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wound(twist_rad_per_m: f64) -> Vec<Crossing> {
        let p = ManipulatorParameters::uniform_beam(8, 0.04, 1e-3);
        let route = TendonRoute { channel_m: [2.0e-3, 0.5e-3], twist_rad_per_m, ..TendonRoute::default() };
        crossings(&p, &route)
    }

    /// Slopes and curvatures agree with finite differences of the length; a step of 1e-5 leaves a relative
    /// error of 1e-6.
    #[test]
    fn slopes_and_curvatures_are_those_of_the_length() {
        let crossing = wound(60.0)[3];
        let q = [2e-5, -3e-5, 4e-5, 0.06, -0.04, 0.03];
        let chord = crossing.chord::<6>(&q);
        let step = 1e-5;
        for k in 0..6 {
            let at = |by: f64| {
                let mut moved = q;
                moved[k] += by;
                crossing.chord::<6>(&moved)
            };
            let slope = (at(step).length_m - at(-step).length_m) / (2.0 * step);
            let curvature = (at(step).slope[k] - at(-step).slope[k]) / (2.0 * step);
            assert!((slope - chord.slope[k]).abs() < 1e-6, "{k}: {slope} {}", chord.slope[k]);
            let size = curvature.abs().max(1e-3);
            assert!(
                (curvature - chord.curvature[k]).abs() < 1e-5 * size,
                "{k}: {curvature} {}",
                chord.curvature[k]
            );
        }
    }

    /// A straight helix with the pitch angle b and the radius r: a tension T twists the tool with `T r sin b`
    /// and compresses it with `T cos b`; its chords, with the angle f about the axis, have r cos(f/2) instead
    /// of r.
    #[test]
    fn a_straight_helix_twists_with_its_radius_times_the_sine_of_its_slope() {
        let (twist, pitch_m, radius_m) = (60.0, 0.005, 2.0e-3_f64.hypot(0.5e-3));
        for crossing in wound(twist) {
            let chord = crossing.chord::<6>(&[0.0; 6]);
            let across_m = 2.0 * radius_m * (0.5 * twist * pitch_m).sin();
            let slope = across_m.atan2(pitch_m);
            let arm_m = radius_m * (0.5 * twist * pitch_m).cos();
            assert!((chord.slope[5] + arm_m * slope.sin()).abs() < 1e-12, "{}", chord.slope[5]);
            assert!((chord.slope[2] + slope.cos()).abs() < 1e-12);
            assert!((chord.turn_rad - slope.sin() * twist * pitch_m).abs() < 1e-12);
        }
    }
}
