//! Closed-form kinematics: a rigid section, an arc of constant curvature, a rigid section.

use crate::manipulator::parameters::ManipulatorParameters;

/// Bend, rad, below which the arc functions use their power series, because the closed forms lose digits to
/// cancellation.
const SERIES_BELOW_RAD: f64 = 0.3;
/// Number of terms of the series: 0.3^(2 k + 1) / (2 k + 2)! is below rounding from k = 6 on.
const TERMS: usize = 7;

/// Start and end of the arc on the straight tool, m.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arc {
    pub start_m: f64,
    pub length_m: f64,
}

/// A point on the tool axis in the bending plane, (x, z), and its derivatives with respect to the bend.
#[derive(Debug, Clone, Copy)]
pub(super) struct AxisPoint {
    pub point: [f64; 2],
    pub first: [f64; 2],
    pub second: [f64; 2],
    /// Axis angle at this point divided by the bend.
    pub share: f64,
}

impl Arc {
    pub fn new(p: &ManipulatorParameters) -> Self {
        let edges = p.cell_edges_m();
        let start_m = edges[0];
        Self { start_m, length_m: edges[edges.len() - 1] - start_m }
    }

    /// Returns the point at `z_m` on the straight tool, after bending by `bend_rad`.
    pub fn place(&self, z_m: f64, bend_rad: f64) -> AxisPoint {
        let along = z_m - self.start_m;
        if along <= 0.0 {
            return AxisPoint { point: [0.0, z_m], first: [0.0; 2], second: [0.0; 2], share: 0.0 };
        }
        let share = (along / self.length_m).min(1.0);
        let ([x, z], [x1, z1], [x2, z2]) = unit_arc(share, bend_rad);
        let l = self.length_m;
        let mut place = AxisPoint {
            point: [l * x, self.start_m + l * z],
            first: [l * x1, l * z1],
            second: [l * x2, l * z2],
            share,
        };
        let past = along - l;
        if past > 0.0 {
            let (sin, cos) = libm::sincos(bend_rad);
            let add = |to: &mut [f64; 2], by: [f64; 2]| {
                to[0] += past * by[0];
                to[1] += past * by[1];
            };
            add(&mut place.point, [sin, cos]);
            add(&mut place.first, [cos, -sin]);
            add(&mut place.second, [-sin, -cos]);
        }
        place
    }
}

/// ((1 - cos a t) / t, sin(a t) / t) and its first two derivatives with respect to t.
fn unit_arc(a: f64, t: f64) -> ([f64; 2], [f64; 2], [f64; 2]) {
    if t.abs() < SERIES_BELOW_RAD {
        return unit_arc_series(a, t);
    }
    let (sin, cos) = libm::sincos(a * t);
    let (x, z) = ((1.0 - cos) / t, sin / t);
    let (x1, z1) = ((a * sin - x) / t, (a * cos - z) / t);
    let (x2, z2) = ((a * a * cos - 2.0 * x1) / t, (-a * a * sin - 2.0 * z1) / t);
    ([x, z], [x1, z1], [x2, z2])
}

fn unit_arc_series(a: f64, t: f64) -> ([f64; 2], [f64; 2], [f64; 2]) {
    // (1 - cos a t)/t = sum c_m t^(m - 1) over even m >= 2, sin(a t)/t = sum c_m t^(m - 1) over odd m, |c_m|
    // = a^m / m!
    let (mut value, mut first, mut second) = ([0.0; 2], [0.0; 2], [0.0; 2]);
    let mut c = a;
    let mut powers = [1.0, 0.0, 0.0];
    for m in 1..=2 * TERMS {
        let component = usize::from(m % 2 == 1);
        let signed = if (m - 1) / 2 % 2 == 0 { c } else { -c };
        let e = (m - 1) as f64;
        value[component] += signed * powers[0];
        first[component] += signed * e * powers[1];
        second[component] += signed * e * (e - 1.0) * powers[2];
        powers = [powers[0] * t, powers[0], powers[1]];
        c *= a / (m + 1) as f64;
    }
    (value, first, second)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn series_and_closed_form_meet() {
        for a in [0.1, 0.5, 1.0] {
            let (below, above) = (unit_arc_series(a, 0.3), unit_arc(a, 0.3));
            for (s, c) in [(below.0, above.0), (below.1, above.1), (below.2, above.2)] {
                // The closed form divides a difference of numbers near 1 by t = 0.3 twice, hence the
                // tolerance.
                assert!((s[0] - c[0]).abs() < 1e-13 && (s[1] - c[1]).abs() < 1e-13, "{s:?} {c:?}");
            }
        }
    }
}
