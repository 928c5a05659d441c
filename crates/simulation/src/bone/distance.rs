//! Distance of a point from bone or from open space, for checks of a scene, not for the tick; and whether a
//! point is in bone, for both.

use nalgebra::Vector3;

use super::grid::floor_to_i64;
use super::voxels::Voxels;

/// The kind of voxel to search for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VoxelKind {
    /// A voxel of bone.
    Bone,
    /// A voxel without bone, or a point outside the volume.
    Open,
}

impl Voxels {
    /// Returns whether a world point is in a voxel of bone.
    pub(crate) fn holds_bone(&self, point_world_m: &Vector3<f64>) -> bool {
        let (point, h) = (self.geometry().point_to_grid(point_world_m), self.geometry().spacing_m);
        self.is_mostly_solid([0, 1, 2].map(|a| floor_to_i64(point[a] / h[a] + 0.5)))
    }

    /// Returns whether a ball touches the box of the volume.
    pub(crate) fn is_near(&self, centre_world_m: &Vector3<f64>, radius_m: f64) -> bool {
        let geometry = self.geometry();
        let centre = geometry.point_to_grid(centre_world_m);
        let beyond_m2: f64 = (0..3)
            .map(|a| {
                let (low_m, high_m) =
                    (-0.5 * geometry.spacing_m[a], (geometry.dims[a] as f64 - 0.5) * geometry.spacing_m[a]);
                let beyond_m = (low_m - centre[a]).max(centre[a] - high_m).max(0.0);
                beyond_m * beyond_m
            })
            .sum();
        beyond_m2 <= radius_m * radius_m
    }

    /// Returns the distance of a world point from the faces of the nearest voxel of this kind, m; 0 inside
    /// one. `None` if there is no such voxel.
    pub fn distance_m(&self, point_world_m: &Vector3<f64>, matter: VoxelKind) -> Option<f64> {
        let geometry = self.geometry();
        let (dims, h) = (geometry.dims.map(|n| n as i64), geometry.spacing_m);
        let point = geometry.point_to_grid(point_world_m);
        let beyond_m2 = |voxel: [i64; 3]| -> f64 {
            let beyond = |a: usize| ((point[a] - voxel[a] as f64 * h[a]).abs() - 0.5 * h[a]).max(0.0);
            (0..3).map(|a| beyond(a) * beyond(a)).sum()
        };
        let own = [0, 1, 2].map(|a| floor_to_i64(point[a] / h[a] + 0.5));
        // Start at the nearest voxel of the grid and visit the shells around it outward.
        let centre = [0, 1, 2].map(|a| own[a].clamp(0, dims[a] - 1));
        let (outside_m2, step_m) = (beyond_m2(centre), geometry.smallest_spacing_m());
        if matter == VoxelKind::Open && own != centre {
            return Some(0.0);
        }
        let mut nearest_m2 = f64::INFINITY;
        for radius in 0..=dims.into_iter().fold(0, i64::max) {
            // Nothing in this shell or beyond it is closer.
            let along_m = (radius - 1).max(0) as f64 * step_m;
            if outside_m2 + along_m * along_m > nearest_m2 {
                break;
            }
            for_each_of_shell(centre, radius, dims, |voxel| {
                let inside = (0..3).all(|a| (0..dims[a]).contains(&voxel[a]));
                let bone = inside && self.is_mostly_solid(voxel);
                if bone == (matter == VoxelKind::Bone) {
                    nearest_m2 = nearest_m2.min(beyond_m2(voxel));
                }
            });
        }
        nearest_m2.is_finite().then(|| libm::sqrt(nearest_m2))
    }
}

/// Visits the voxels whose largest distance from the centre along an axis is `radius`, in the grid and in one
/// layer around it.
fn for_each_of_shell(centre: [i64; 3], radius: i64, dims: [i64; 3], mut visit: impl FnMut([i64; 3])) {
    let range = |a: usize| (centre[a] - radius).max(-1)..=(centre[a] + radius).min(dims[a]);
    for z in range(2) {
        for y in range(1) {
            let is_face = (z - centre[2]).abs() == radius || (y - centre[1]).abs() == radius;
            if is_face {
                range(0).for_each(|x| visit([x, y, z]));
                continue;
            }
            let ends = [centre[0] - radius, centre[0] + radius];
            ends.into_iter().filter(|x| range(0).contains(x)).for_each(|x| visit([x, y, z]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bone::{BoneField, BoneParameters, GridGeometry};

    /// For a ball of bone of radius 5 mm in 0.5 mm voxels, the distances are those from its surface, to
    /// within a voxel.
    #[test]
    fn distances_are_those_from_the_surface_of_a_ball() {
        let (n, h_m) = (40, 0.5e-3);
        let geometry =
            GridGeometry::axis_aligned([n; 3], [h_m; 3], Vector3::repeat(-0.5 * h_m * (n - 1) as f64));
        let mut hu = vec![0; n * n * n];
        for (index, hu) in hu.iter_mut().enumerate() {
            let [i, j, k] = [index % n, index / n % n, index / (n * n)];
            if geometry.voxel_centre_world_m(i, j, k).norm() < 5e-3 {
                *hu = 1000;
            }
        }
        let field = BoneField::new(geometry, &hu, BoneParameters::default()).unwrap();
        let voxels = field.voxels();
        for (at_m, matter, expected_m) in [
            (8e-3, VoxelKind::Bone, 3e-3),
            (1.0, VoxelKind::Bone, 0.995),
            (4.9e-3, VoxelKind::Bone, 0.0),
            (0.0, VoxelKind::Open, 5e-3),
            (3e-3, VoxelKind::Open, 2e-3),
            (8e-3, VoxelKind::Open, 0.0),
        ] {
            for axis in 0..3 {
                let mut point = Vector3::zeros();
                point[axis] = at_m;
                let found_m = voxels.distance_m(&point, matter).unwrap();
                assert!((found_m - expected_m).abs() < 2.0 * h_m, "{at_m} {matter:?}: {found_m}");
            }
        }
        // Bone up to the border.
        let full = BoneField::new(geometry, &vec![1000; n * n * n], BoneParameters::default()).unwrap();
        for (x_m, expected_m) in [(0.0, 10e-3), (9e-3, 1e-3), (11e-3, 0.0), (1.0, 0.0)] {
            let found_m = full.voxels().distance_m(&Vector3::new(x_m, 0.0, 0.0), VoxelKind::Open).unwrap();
            assert!((found_m - expected_m).abs() < 1e-12, "{x_m}: {found_m}");
        }
        let none = BoneField::new(geometry, &vec![0; n * n * n], BoneParameters::default()).unwrap();
        assert_eq!(none.voxels().distance_m(&Vector3::zeros(), VoxelKind::Bone), None);
    }
}
