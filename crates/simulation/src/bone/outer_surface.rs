//! The outer surface of a bone, and how much of it was drilled away other than where the tool came in.
//!
//! The surface consists of the faces between a voxel of bone and a neighbour outside ([`Outside`]), before
//! anything is drilled. Of a slanting surface these faces have up to 1.73 times its area. A face therefore
//! counts with the cosine of the angle between it and the surface around it, whose normal is the mean of
//! those of the faces within [`NEAR_VOXELS`]. The sum is the area of a plane in any orientation.
//!
//! The entry is a cylinder about the tool's line at the start of the run, at the first point at which that
//! line enters the bone: surface that faces the tool in there is not counted.

use nalgebra::Vector3;

use super::grid::{GridGeometry, VoxelIndex};
use super::outside::Outside;

/// Distance along each axis within which faces determine the normal of the surface, voxels.
const NEAR_VOXELS: i64 = 2;
/// The directions to the neighbours of a voxel.
const NEIGHBOURS: [[i64; 3]; 6] = [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]];

/// Where a tool enters the bone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    /// A point of the tool's line, world frame, m; later, where the line enters the bone.
    pub at_m: Vector3<f64>,
    /// Direction of the line, of length 1, world frame.
    pub along: Vector3<f64>,
    /// Radius of the entry, m. It extends over two radii along the line to either side.
    pub radius_m: f64,
}

impl Entry {
    /// Returns whether a point of a surface with this normal, out of the bone, belongs to the entry.
    fn holds(&self, point_m: &Vector3<f64>, normal: &Vector3<f64>) -> bool {
        let away_m = point_m - self.at_m;
        let along_m = away_m.dot(&self.along);
        normal.dot(&self.along) < 0.0
            && along_m.abs() <= 2.0 * self.radius_m
            && (away_m - along_m * self.along).norm() <= self.radius_m
    }
}

/// The outer surface of a bone.
#[derive(Debug, Clone, PartialEq)]
pub struct OuterSurface {
    outside: Outside,
    /// `None` if the tool's line does not meet the bone.
    entry: Option<Entry>,
}

impl OuterSurface {
    /// Takes the surface of the bone beyond `outside`, which a tool on the line of `entry` enters: ahead of
    /// its point, or behind it if the point is in the bone.
    pub fn new(outside: Outside, entry: Entry) -> OuterSurface {
        let entry = first_meeting_m(&outside, &entry).map(|at_m| Entry { at_m, ..entry });
        OuterSurface { outside, entry }
    }

    /// Returns the area, m², of the surface of these voxels, which were drilled, without that of the entry.
    pub fn removed_m2(&self, drilled: &[u32]) -> f64 {
        let geometry = self.outside.geometry();
        let area = |number: &u32| {
            let voxel = geometry.voxel(VoxelIndex::new(*number)).map(|index| index as i64);
            self.counted_m2(geometry, voxel)
        };
        // Without a negative zero.
        drilled.iter().map(area).sum::<f64>() + 0.0
    }

    /// Returns the area of a voxel's part of the surface outside of the entry, m².
    fn counted_m2(&self, geometry: &GridGeometry, voxel: [i64; 3]) -> f64 {
        if self.faces_m2(geometry, voxel).next().is_none() {
            return 0.0;
        }
        let Some(normal) = self.normal(geometry, voxel) else { return 0.0 };
        let normal_world = geometry.direction_world_grid * normal;
        let is_counted = |face_m2: &Vector3<f64>| {
            let half_m = face_m2.normalize().component_mul(&Vector3::from(geometry.spacing_m)) * 0.5;
            let centre_m = Vector3::from(geometry.voxel_position(voxel)) + half_m;
            let world_m = geometry.point_to_world(&centre_m);
            !self.entry.is_some_and(|entry| entry.holds(&world_m, &normal_world))
        };
        let counted = self.faces_m2(geometry, voxel).filter(is_counted);
        counted.map(|face_m2| face_m2.dot(&normal)).sum::<f64>().max(0.0)
    }

    /// Returns the mean normal of the surface around a voxel, in the grid's axes.
    fn normal(&self, geometry: &GridGeometry, voxel: [i64; 3]) -> Option<Vector3<f64>> {
        let range = -NEAR_VOXELS..=NEAR_VOXELS;
        let mut sum_m2 = Vector3::zeros();
        for k in range.clone() {
            for j in range.clone() {
                for i in range.clone() {
                    let near = [voxel[0] + i, voxel[1] + j, voxel[2] + k];
                    sum_m2 += self.faces_m2(geometry, near).sum::<Vector3<f64>>();
                }
            }
        }
        sum_m2.try_normalize(0.0)
    }

    /// Returns the faces of a voxel that belong to the surface: area, m², times the normal out of the bone,
    /// in the grid's axes. Where the volume ends in bone, its border is the surface, as for
    /// [`Outside::holds`].
    fn faces_m2(&self, geometry: &GridGeometry, voxel: [i64; 3]) -> impl Iterator<Item = Vector3<f64>> {
        let [dx, dy, dz] = geometry.spacing_m;
        let areas_m2 = Vector3::new(dy * dz, dz * dx, dx * dy);
        let is_bone = self.outside.voxel(voxel) == Some(false);
        NEIGHBOURS.into_iter().filter_map(move |[i, j, k]| {
            let beside = [voxel[0] + i, voxel[1] + j, voxel[2] + k];
            let is_face = is_bone && self.outside.voxel(beside) != Some(false);
            is_face.then(|| Vector3::new(i as f64, j as f64, k as f64).component_mul(&areas_m2))
        })
    }
}

/// Returns the first point of a line in the bone, m: ahead of the line's own point, or, if that is in the
/// bone, the last one before it is outside behind it. In steps of half a voxel.
fn first_meeting_m(outside: &Outside, line: &Entry) -> Option<Vector3<f64>> {
    let geometry = outside.geometry();
    let last = geometry.dims.map(|count| count - 1);
    let corners_m =
        [geometry.voxel_centre_world_m(0, 0, 0), geometry.voxel_centre_world_m(last[0], last[1], last[2])];
    let far_m = corners_m.map(|corner_m| (corner_m - line.at_m).norm()).into_iter().fold(0.0, f64::max);
    let step_m = 0.5 * geometry.smallest_spacing_m();
    let diagonal_m = (corners_m[1] - corners_m[0]).norm();
    let steps = ((far_m + diagonal_m) / step_m) as usize;
    let is_inside = !outside.holds(&line.at_m);
    let sense = if is_inside { -1.0 } else { 1.0 };
    let point_m = |step: usize| line.at_m + line.along * (sense * step_m * step as f64);
    let changes = (1..=steps).find(|step| outside.holds(&point_m(*step)) == is_inside)?;
    Some(point_m(if is_inside { changes - 1 } else { changes }))
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: usize = 60;
    const RADIUS_MM: f64 = 3.3;

    /// Bone where `is_bone` holds, and the voxels within a cylinder about an axis through the origin, mm.
    fn drilled(
        spacing_mm: [f64; 3],
        is_bone: &dyn Fn(Vector3<f64>) -> bool,
        along: Vector3<f64>,
    ) -> (GridGeometry, Vec<i16>, Vec<u32>) {
        let corner_mm = spacing_mm.map(|h| -0.5 * h * (N - 1) as f64);
        let geometry =
            GridGeometry::axis_aligned([N; 3], spacing_mm.map(|h| h * 1e-3), Vector3::from(corner_mm) * 1e-3);
        let centre_mm =
            |index: usize| geometry.voxel_centre_world_m(index % N, index / N % N, index / (N * N)) * 1e3;
        let hu: Vec<i16> =
            (0..N * N * N).map(|index| if is_bone(centre_mm(index)) { 1000 } else { -1000 }).collect();
        let is_drilled = |index: &usize| {
            let at = centre_mm(*index);
            hu[*index] >= 150 && (at - at.dot(&along) * along).norm() < RADIUS_MM
        };
        let voxels = (0..N * N * N).filter(is_drilled).map(|index| index as u32).collect();
        (geometry, hu, voxels)
    }

    /// The surface of bone with a hole along `along`, and the voxels of the hole. The tool comes from -25 mm.
    fn hole(
        spacing_mm: [f64; 3],
        is_bone: &dyn Fn(Vector3<f64>) -> bool,
        along: Vector3<f64>,
    ) -> (OuterSurface, Vec<u32>) {
        let (geometry, hu, voxels) = drilled(spacing_mm, is_bone, along);
        let entry = Entry { at_m: -25e-3 * along, along, radius_m: RADIUS_MM * 1e-3 + 1.5e-3 };
        (OuterSurface::new(Outside::new(geometry, &hu, 150), entry), voxels)
    }

    /// The area of the exit of such a hole, mm2.
    fn exit_mm2(spacing_mm: [f64; 3], is_bone: &dyn Fn(Vector3<f64>) -> bool, along: Vector3<f64>) -> f64 {
        let (surface, voxels) = hole(spacing_mm, is_bone, along);
        1e6 * surface.removed_m2(&voxels)
    }

    /// A plate that the hole passes at an angle: a circle, or an ellipse of area pi r^2 / cos. The rim of
    /// 21 mm passes through about 50 voxels of 0.5 mm, each in or out by its centre, which leaves 1 to 2 % of
    /// the area; a mean normal that includes the face itself adds up to 2 %.
    #[test]
    fn the_exit_of_a_hole_through_a_plate_has_the_area_of_the_ellipse() {
        let circle_mm2 = std::f64::consts::PI * RADIUS_MM * RADIUS_MM;
        for (spacing_mm, tolerance) in [([0.5; 3], 0.05), ([0.4, 0.5, 0.6], 0.05), ([0.8; 3], 0.07)] {
            for slant_deg in [0.0, 20.0, 30.0, 45.0_f64] {
                let (sine, cosine) = slant_deg.to_radians().sin_cos();
                let normal = Vector3::new(sine, 0.0, cosine);
                let plate = |at: Vector3<f64>| at.dot(&normal).abs() < 4.0;
                let found_mm2 = exit_mm2(spacing_mm, &plate, Vector3::z());
                let share = found_mm2 / (circle_mm2 / cosine);
                println!("{spacing_mm:?} {slant_deg}: {share}");
                assert!((share - 1.0).abs() < tolerance, "{spacing_mm:?} {slant_deg}: {share}");
            }
        }
    }

    /// A blind hole removes only its entry; a hole along the surface and one through the side remove more.
    #[test]
    fn only_the_entry_itself_is_left_out() {
        let block = |at: Vector3<f64>| at.z.abs() < 20.0 && at.x > -1.0;
        let thick = |at: Vector3<f64>| at.z > -10.0;
        let (surface, voxels) = hole([0.6; 3], &thick, Vector3::z());
        let last_slice = |index: &&u32| **index as usize >= (N - 1) * N * N;
        let blind: Vec<u32> = voxels.iter().copied().filter(|index| !last_slice(&index)).collect();
        assert_eq!(surface.removed_m2(&blind), 0.0);
        assert!(surface.removed_m2(&[]).is_sign_positive());
        // Through the border of the volume, which cuts the bone: the faces of the last slice.
        let faces_mm2 = 0.6 * 0.6 * voxels.iter().filter(last_slice).count() as f64;
        assert!((1e6 * surface.removed_m2(&voxels) - faces_mm2).abs() < 1e-9 && faces_mm2 > 30.0);
        // A groove along the face x = -1: 2 sqrt(r^2 - 1) wide and as long as the block, without the entry.
        let groove_mm2 = exit_mm2([0.5; 3], &block, Vector3::z());
        let width_mm = 2.0 * (RADIUS_MM * RADIUS_MM - 1.0).sqrt();
        assert!(groove_mm2 > 0.8 * 30.0 * width_mm, "{groove_mm2}");
    }

    /// A tool that starts in its guide hole: the entry is behind it.
    #[test]
    fn the_entry_of_a_tool_that_starts_in_the_bone_is_behind_it() {
        let plate = |at: Vector3<f64>| at.z.abs() < 6.0;
        let (geometry, hu, _) = drilled([0.5; 3], &plate, Vector3::z());
        let outside = Outside::new(geometry, &hu, 150);
        let line = Entry { at_m: Vector3::zeros(), along: Vector3::z(), radius_m: 5e-3 };
        let at_m = first_meeting_m(&outside, &line).unwrap();
        assert!((at_m.z + 6e-3).abs() < 0.6e-3, "{at_m}");
        let beside = Entry { at_m: Vector3::new(0.0, 0.0, -9e-3), along: Vector3::x(), ..line };
        assert_eq!(OuterSurface::new(outside, beside).entry, None);
    }
}
