//! The surface of a tube with round ends, as triangles.

use std::f64::consts::TAU;

use nalgebra::Vector3;

use super::Triangle;

/// Corners around the tube: 48 lose 0.7 % of a ball's volume.
const AROUND: usize = 48;
/// Largest angle between two rings of a round end or of the outside of a bend, rad.
const STEP_RAD: f64 = TAU / AROUND as f64;
/// Points of the line closer than this are one: a shorter leg may have no direction.
const LEAST_LEG_M: f64 = 1e-9;
/// Least cosine of half a bend.
const LEAST_COSINE: f64 = 1e-9;

/// Returns the surface of all points within a radius of a polyline: a ball for one point. Its corners are on
/// that surface, except in a bend whose inside is wider than half of a leg next to it: those are within it.
/// Where a line comes back to itself, the surfaces of both parts overlap.
pub fn tube(points_m: &[Vector3<f64>], radius_m: f64) -> Vec<Triangle> {
    let mut line_m = points_m.to_vec();
    line_m.dedup_by(|next_m, point_m| (*next_m - *point_m).norm() < LEAST_LEG_M);
    let (Some(start_m), Some(end_m)) = (line_m.first(), line_m.last()) else { return Vec::new() };
    let ways: Vec<Vector3<f64>> = line_m.windows(2).map(|leg| (leg[1] - leg[0]).normalize()).collect();
    let (first, last) = ends(&ways);
    let mut around = directions(&first);
    let dome = |centre_m: &Vector3<f64>, out: &Vector3<f64>, around: &[Vector3<f64>], step: usize| {
        let (sin, cos) = (step as f64 * STEP_RAD).sin_cos();
        around.iter().map(|side| centre_m + (out * cos + side * sin) * radius_m).collect()
    };
    let mut rings: Vec<Vec<Vector3<f64>>> =
        (0..=AROUND / 4).map(|step| dome(start_m, &-first, &around, step)).collect();
    for (joint, (legs_m, ways)) in line_m.windows(3).zip(ways.windows(2)).enumerate() {
        let (before_m, after_m) = ((legs_m[1] - legs_m[0]).norm(), (legs_m[2] - legs_m[1]).norm());
        let bend = Bend {
            place_m: line_m[joint + 1],
            way: ways[0],
            // A line that turns back has every plane along it; one of them will do.
            normal: (ways[0] + ways[1]).try_normalize(LEAST_COSINE).unwrap_or(around[0]),
            radius_m,
            most_m: 0.5 * before_m.min(after_m),
        };
        rings.extend(bend.rings(&around));
        around.iter_mut().for_each(|side| *side -= bend.normal * (2.0 * side.dot(&bend.normal)));
    }
    rings.extend((0..=AROUND / 4).rev().map(|step| dome(end_m, &last, &around, step)));
    joined(&rings)
}

fn ends(ways: &[Vector3<f64>]) -> (Vector3<f64>, Vector3<f64>) {
    let end = |way: Option<&Vector3<f64>>| way.copied().unwrap_or(Vector3::z());
    (end(ways.first()), end(ways.last()))
}

/// Returns unit vectors around an axis, counterclockwise seen against it.
fn directions(axis: &Vector3<f64>) -> Vec<Vector3<f64>> {
    let aside = if axis.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
    let right = axis.cross(&aside).normalize();
    let up = axis.cross(&right);
    let direction = |step: usize| {
        let (sin, cos) = (step as f64 * STEP_RAD).sin_cos();
        right * cos + up * sin
    };
    (0..AROUND).map(direction).collect()
}

/// A bend of the line. The tube is symmetric about the plane that halves it.
struct Bend {
    place_m: Vector3<f64>,
    /// Direction of the line before it.
    way: Vector3<f64>,
    /// Normal of the plane of symmetry.
    normal: Vector3<f64>,
    radius_m: f64,
    /// Length of a leg that this bend may shorten on its inside.
    most_m: f64,
}

impl Bend {
    /// Returns the rings on both sides of the plane of symmetry and the one in it.
    fn rings(&self, around: &[Vector3<f64>]) -> Vec<Vec<Vector3<f64>>> {
        let half_rad = self.way.dot(&self.normal).clamp(-1.0, 1.0).acos();
        let count = (half_rad / STEP_RAD).ceil().max(1.0) as usize;
        let ring = |step: usize| -> Vec<Vector3<f64>> {
            around.iter().map(|side| self.corner(side, step as f64 / count as f64)).collect()
        };
        let mut rings: Vec<Vec<Vector3<f64>>> = (0..count).map(ring).collect();
        let mirrored: Vec<Vec<Vector3<f64>>> =
            rings.iter().rev().map(|ring| ring.iter().map(|at| at - self.off(at) * 2.0).collect()).collect();
        rings.push(ring(count).iter().map(|at| at - self.off(at)).collect());
        rings.extend(mirrored);
        rings
    }

    /// Returns a corner on the side `side` of the line. On the outside of the bend, where the tube is a
    /// ball, it is at this share of the angle to the plane of symmetry; on its inside, where the cylinder
    /// meets that plane.
    fn corner(&self, side: &Vector3<f64>, share: f64) -> Vector3<f64> {
        let along_m = -self.radius_m * side.dot(&self.normal) / self.way.dot(&self.normal).max(LEAST_COSINE);
        if along_m <= 0.0 {
            return self.place_m + side * self.radius_m + self.way * along_m.max(-self.most_m);
        }
        let (sin, cos) = (share * along_m.atan2(self.radius_m)).sin_cos();
        self.place_m + (side * cos + self.way * sin) * self.radius_m
    }

    fn off(&self, at_m: &Vector3<f64>) -> Vector3<f64> {
        self.normal * (at_m - self.place_m).dot(&self.normal)
    }
}

/// Returns the triangles between rings of corners.
fn joined(rings: &[Vec<Vector3<f64>>]) -> Vec<Triangle> {
    let mut triangles = Vec::new();
    for pair in rings.windows(2) {
        for at in 0..AROUND {
            let next = (at + 1) % AROUND;
            let [a, b, c, d] = [pair[0][at], pair[0][next], pair[1][next], pair[1][at]];
            triangles.extend([[a, b, c], [a, c, d]].map(|corners| corners.map(<[f64; 3]>::from)));
        }
    }
    triangles.retain(|[a, b, c]| a != b && b != c && c != a);
    triangles
}
