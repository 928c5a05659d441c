//! A cutter as balls along the tool's axis, used by contact, drilling, X-ray and pictures alike.
//!
//! A cutter is a body of revolution. Its outline is the envelope of balls at the corners of the shape: a
//! cylinder between equal balls, a cone between unequal ones. Intermediate balls approximate the envelope;
//! between two of them the union is narrower by the scallop, and enough balls are used to keep the scallop
//! below a bound.

use crate::{CutterShape, ToolBurr};

/// Largest number of balls of a cutter: each is a contact sphere of the tool.
pub const MAX_CUTTER_BALLS: usize = 16;

/// Default scallop limit, mm: half of what a burr cuts beyond its surface.
pub const STANDARD_SCALLOP_MM: f64 = 0.05;

/// A ball of a cutter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CutterBall {
    /// Distance from the centre of the front ball back to its centre, along the tool's axis.
    pub behind_m: f64,
    /// Its radius.
    pub radius_m: f64,
}

/// A ball of a cutter and its share of the union: the part between the planes through the circles where it
/// meets its neighbours.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CutterZone {
    /// The ball.
    pub ball: CutterBall,
    /// Where its part begins and ends, from the ball's centre toward the front, m; its pole where it has no
    /// neighbour.
    pub ahead_m: [f64; 2],
}

/// Mass properties of a cutter of uniform density, per unit mass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CutterSolid {
    /// Distance from the centre of the front ball back to the centre of mass.
    pub behind_m: f64,
    /// Moment of inertia about a transverse axis through the centre of mass.
    pub across_m2: f64,
    /// Moment of inertia about the tool's axis.
    pub along_m2: f64,
}

/// A cutter: one or more balls, from front to back.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cutter {
    ball: [CutterBall; MAX_CUTTER_BALLS],
    count: usize,
}

impl Cutter {
    /// A cutter of a single ball.
    pub const fn ball(radius_m: f64) -> Self {
        Self { ball: [CutterBall { behind_m: 0.0, radius_m }; MAX_CUTTER_BALLS], count: 1 }
    }

    /// The balls, from front to back.
    pub fn balls(&self) -> &[CutterBall] {
        &self.ball[..self.count]
    }

    /// The radius if the cutter is a single ball.
    pub fn only_radius_m(&self) -> Option<f64> {
        (self.count == 1).then(|| self.ball[0].radius_m)
    }

    /// Radius of the front ball: how far the cutter extends ahead of its centre.
    pub fn front_radius_m(&self) -> f64 {
        self.ball[0].radius_m
    }

    /// Largest radius.
    pub fn widest_radius_m(&self) -> f64 {
        self.balls().iter().fold(0.0, |widest, ball| ball.radius_m.max(widest))
    }

    /// Distance between the centres of the first and last balls.
    pub fn span_m(&self) -> f64 {
        self.ball[self.count - 1].behind_m
    }

    /// The parts of the union, from front to back, without overlap.
    pub fn zones(&self) -> impl Iterator<Item = CutterZone> {
        let balls = self.balls();
        // Distance from a ball's centre back to the circle where it meets the next ball: the plane of equal
        // power.
        let meets = |index: usize| {
            let (own, next) = (balls.get(index)?, balls.get(index + 1)?);
            let apart_m = next.behind_m - own.behind_m;
            let squares = own.radius_m * own.radius_m - next.radius_m * next.radius_m;
            Some(0.5 * (apart_m + squares / apart_m))
        };
        balls.iter().enumerate().map(move |(index, ball)| {
            let last = index
                .checked_sub(1)
                .and_then(|before| Some(ball.behind_m - (balls.get(before)?.behind_m + meets(before)?)));
            let ahead_m =
                [meets(index).map_or(-ball.radius_m, |back_m| -back_m), last.unwrap_or(ball.radius_m)];
            CutterZone { ball: *ball, ahead_m }
        })
    }

    /// Mass properties of the union, integrated over its zones: a slice at z of a ball of radius r has the
    /// area `pi (r^2 - z^2)`.
    pub fn solid(&self) -> CutterSolid {
        let (mut volume, mut first, mut second, mut along) = (0.0, 0.0, 0.0, 0.0);
        for CutterZone { ball, ahead_m: [from, to] } in self.zones() {
            let r2 = ball.radius_m * ball.radius_m;
            // Integrals of 1, z, z^2, z^3, z^4 over the zone.
            let ends = [from, to].map(|z| {
                let z2 = z * z;
                [z, z2 / 2.0, z2 * z / 3.0, z2 * z2 / 4.0, z2 * z2 * z / 5.0]
            });
            let power: [f64; 5] = core::array::from_fn(|n| ends[1][n] - ends[0][n]);
            let [m0, m1, m2]: [f64; 3] = core::array::from_fn(|n| r2 * power[n] - power[n + 2]);
            volume += m0;
            first += m1 - m0 * ball.behind_m;
            second += m2 - 2.0 * m1 * ball.behind_m + m0 * ball.behind_m * ball.behind_m;
            along += 0.5 * (r2 * r2 * power[0] - 2.0 * r2 * power[2] + power[4]);
        }
        let (centre, along_m2) = (first / volume, along / volume);
        CutterSolid {
            behind_m: -centre,
            across_m2: second / volume - centre * centre + 0.5 * along_m2,
            along_m2,
        }
    }

    /// Largest scallop between its balls, m.
    pub fn scallop_m(&self) -> f64 {
        self.balls().windows(2).map(|pair| scallop_m(&pair[0], &pair[1])).fold(0.0, f64::max)
    }
}

/// How much narrower the union of two balls is than their envelope at the circle where they meet, m.
fn scallop_m(front: &CutterBall, back: &CutterBall) -> f64 {
    let apart_m = back.behind_m - front.behind_m;
    let sine = (back.radius_m - front.radius_m) / apart_m;
    let (r2, back2) = (front.radius_m * front.radius_m, back.radius_m * back.radius_m);
    let circle_m = 0.5 * (apart_m + (r2 - back2) / apart_m);
    // Distance of the circle from the envelope, along the envelope's normal.
    front.radius_m + circle_m * sine - ((r2 - circle_m * circle_m).max(0.0) * (1.0 - sine * sine)).sqrt()
}

impl ToolBurr {
    /// The balls at the corners of its shape, from front to back. The checks refuse shapes whose balls touch
    /// internally or are nested.
    pub(crate) fn corners(&self) -> Vec<CutterBall> {
        let radius_m = |diameter_mm: f64| diameter_mm / 2e3;
        let widest_m = radius_m(self.diameter_mm);
        let front_m = match self.shape() {
            CutterShape::Ball | CutterShape::Cylinder => widest_m,
            CutterShape::Cone | CutterShape::Bit => self.tip_diameter_mm.map_or(widest_m, radius_m),
        };
        let mut corners = vec![CutterBall { behind_m: 0.0, radius_m: front_m }];
        if self.shape() == CutterShape::Ball {
            return corners;
        }
        if let (CutterShape::Bit, Some(point_deg)) = (self.shape(), self.point_deg) {
            let flank_rad = 0.5 * point_deg * core::f64::consts::PI / 180.0;
            let behind_m = (widest_m - front_m) / libm::sin(flank_rad);
            corners.push(CutterBall { behind_m, radius_m: widest_m });
        }
        let behind_m = self.length_mm.unwrap_or(0.0) * 1e-3 - front_m - widest_m;
        corners.push(CutterBall { behind_m, radius_m: widest_m });
        corners
    }

    /// Distance between the centres of its first and last balls, to a nanometre.
    pub(crate) fn span_mm(&self) -> f64 {
        let span_m = self.corners().last().map_or(0.0, |corner| corner.behind_m);
        (span_m * 1e9).round() / 1e6
    }

    /// Its shape.
    pub fn shape(&self) -> CutterShape {
        self.shape.unwrap_or_default()
    }

    /// Largest allowed scallop, m.
    pub(crate) fn most_scallop_m(&self) -> f64 {
        self.scallop_mm.unwrap_or(STANDARD_SCALLOP_MM) / 1e3
    }

    /// Its balls: those at the corners, with as many in between as the scallop requires, up to the limit.
    pub fn cutter(&self) -> Cutter {
        let mut cutter = Cutter::ball(self.diameter_mm / 2e3);
        for (slot, ball) in cutter.ball.iter_mut().zip(self.balls()) {
            *slot = ball;
        }
        cutter.count = self.balls().take(MAX_CUTTER_BALLS).count();
        cutter
    }

    /// Number of balls that its scallop requires, regardless of the limit.
    pub(crate) fn balls_wanted(&self) -> usize {
        self.balls().count()
    }

    fn balls(&self) -> impl Iterator<Item = CutterBall> {
        let (corners, most_m) = (self.corners(), self.most_scallop_m());
        let first = corners.first().copied();
        let pairs: Vec<[CutterBall; 2]> = corners.windows(2).map(|pair| [pair[0], pair[1]]).collect();
        first.into_iter().chain(pairs.into_iter().flat_map(move |[front, back]| between(front, back, most_m)))
    }
}

/// Largest number of balls counted between two corners, far above the limit.
const MOST_COUNTED: usize = 1000;

/// Balls that approximate the envelope of two balls: those after `front`, up to and including `back`, whose
/// radius is no smaller.
///
/// Two balls of a cone with half angle a, the front one of radius r, leave the scallop h if they are `s = 2
/// (h sin a + cos a sqrt(h (2r - h))) / cos^2 a` apart: [`scallop_m`] solved for the distance. All steps are
/// then shortened in proportion so that the last one ends at the back ball. This leaves no larger scallop,
/// because the longest step grows less than proportionally to the radius.
fn between(front: CutterBall, back: CutterBall, most_m: f64) -> impl Iterator<Item = CutterBall> {
    let apart_m = back.behind_m - front.behind_m;
    let sine = (back.radius_m - front.radius_m) / apart_m;
    let cosine2 = 1.0 - sine * sine;
    let longest_m = move |radius_m: f64| {
        let h = most_m.min(radius_m);
        2.0 * (h * sine + (cosine2 * h * (2.0 * radius_m - h)).sqrt()) / cosine2
    };
    let mut ends_m = Vec::new();
    let mut at_m = 0.0;
    // Nested balls have no such step: the comparison fails, and one ball remains.
    while at_m < apart_m * (1.0 - 1e-9) && ends_m.len() < MOST_COUNTED {
        at_m += longest_m(front.radius_m + sine * at_m);
        ends_m.push(at_m);
    }
    ends_m.into_iter().map(move |end_m| {
        let along_m = apart_m * (end_m / at_m);
        CutterBall { behind_m: front.behind_m + along_m, radius_m: front.radius_m + sine * along_m }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn burr(shape: CutterShape, length_mm: f64) -> ToolBurr {
        ToolBurr {
            shape: Some(shape),
            diameter_mm: 4.0,
            length_mm: Some(length_mm),
            tip_diameter_mm: Some(0.5),
            point_deg: Some(118.0),
            rake_deg: None,
            scallop_mm: None,
            offset_mm: 10.0,
            mass_g: 1.0,
            cutting_coefficient: None,
        }
    }

    /// Volume and moments of the union by slicing: the widest of all balls at each position.
    fn by_slices(cutter: &Cutter) -> CutterSolid {
        let (from, to) = (-cutter.span_m() - 5e-3, 5e-3);
        let count = 400_000;
        let (mut volume, mut first, mut second, mut along) = (0.0, 0.0, 0.0, 0.0);
        for slice in 0..count {
            let z = from + (to - from) * (f64::from(slice) + 0.5) / f64::from(count);
            let square = |ball: &CutterBall| ball.radius_m * ball.radius_m - (z + ball.behind_m).powi(2);
            let square = cutter.balls().iter().map(square).fold(0.0, f64::max);
            volume += square;
            first += square * z;
            second += square * z * z;
            along += 0.5 * square * square;
        }
        let centre = first / volume;
        CutterSolid {
            behind_m: -centre,
            across_m2: second / volume - centre * centre + 0.5 * along / volume,
            along_m2: along / volume,
        }
    }

    /// The zones tile the union, so their sums equal the sliced ones; 1e-8 is the slicing error.
    #[test]
    fn the_zones_of_a_cutter_are_its_union() {
        for (shape, length_mm) in [
            (CutterShape::Ball, 4.0),
            (CutterShape::Cylinder, 9.0),
            (CutterShape::Cone, 8.0),
            (CutterShape::Bit, 9.0),
        ] {
            let cutter = burr(shape, length_mm).cutter();
            let (solid, sliced) = (cutter.solid(), by_slices(&cutter));
            println!("{shape:?}: {} balls, scallop {:.1} um", cutter.balls().len(), 1e6 * cutter.scallop_m());
            for (own, other) in [
                (solid.behind_m, sliced.behind_m),
                (solid.across_m2, sliced.across_m2),
                (solid.along_m2, sliced.along_m2),
            ] {
                assert!((own - other).abs() < 1e-8 * sliced.across_m2.sqrt().max(1e-3), "{own} {other}");
            }
            assert!(cutter.scallop_m() <= 0.05e-3 * (1.0 + 1e-9), "{}", cutter.scallop_m());
        }
    }

    /// A ball has 2/5 m r^2 about any axis; a bit has its point angle and its ends.
    #[test]
    fn shapes_have_the_dimensions_that_their_file_states() {
        let ball = Cutter::ball(2e-3);
        let solid = ball.solid();
        assert!((solid.across_m2 - 0.4 * 4e-6).abs() < 1e-18 && (solid.along_m2 - 0.4 * 4e-6).abs() < 1e-18);
        let bit = burr(CutterShape::Bit, 9.0).cutter();
        assert!((bit.front_radius_m() + bit.span_m() + bit.widest_radius_m() - 9e-3).abs() < 1e-12);
        // A ball of the envelope of a cone with the half angle a is r / sin a behind the apex.
        let [front, second] = [bit.balls()[0], bit.balls()[1]];
        let sine = (second.radius_m - front.radius_m) / (second.behind_m - front.behind_m);
        assert!((sine.asin().to_degrees() - 59.0).abs() < 1e-9, "{sine}");
        // Equal balls of radius r, s apart: the scallop is r - sqrt(r^2 - s^2/4).
        let cylinder = burr(CutterShape::Cylinder, 9.0).cutter();
        let apart_m: f64 = cylinder.balls()[1].behind_m;
        let scallop_m = 2e-3 - (4e-6 - 0.25 * apart_m * apart_m).sqrt();
        assert!((cylinder.scallop_m() - scallop_m).abs() < 1e-15);
        // One ball fewer exceeds the scallop.
        let fewer = apart_m * (cylinder.balls().len() - 1) as f64 / (cylinder.balls().len() - 2) as f64;
        assert!(2e-3 - (4e-6 - 0.25 * fewer * fewer).sqrt() > 0.05e-3);
    }
}
