//! Finds the way out for a sphere whose centre is inside bone.

use nalgebra::Vector3;

use super::gather::Sphere;
use super::voxels::Voxels;

/// Cosine between the smoothed normal and the exit axis below which the normal is not trusted.
const NORMAL_AGREEMENT_COSINE: f64 = 0.3;

impl Voxels {
    /// Returns the plane that leads out of bone: a point on it and its normal in the grid's metric frame, and
    /// the gap, which is minus the sphere's radius minus the depth of its centre. The exit is the nearest one
    /// along the six grid directions; the edge of the grid counts as an exit. The normal is that of the
    /// smoothed surface there, which is exact for grid-aligned walls.
    pub(super) fn way_out(&self, sphere: &Sphere) -> (Vector3<f64>, Vector3<f64>, f64) {
        let Sphere { centre, voxel: centre_voxel, radius_m, .. } = *sphere;
        let spacing = self.geometry().spacing_m;
        let thinnest = spacing.iter().fold(f64::INFINITY, |low, h| low.min(*h));
        let mut best: Option<(f64, Vector3<f64>)> = None;
        let mut step = 1;
        // The edge of the grid is an exit, so the loop ends after at most as many steps as the smallest
        // dimension has voxels.
        while best.is_none_or(|(depth, _)| (step as f64 - 1.0) * thinnest <= depth) {
            for axis in 0..3 {
                for sign in [1i64, -1] {
                    let mut voxel = centre_voxel;
                    voxel[axis] += sign * step;
                    let face =
                        (centre_voxel[axis] as f64 + sign as f64 * (step as f64 - 0.5)) * spacing[axis];
                    let depth = sign as f64 * (face - centre[axis]);
                    if best.is_none_or(|(shortest, _)| depth < shortest) && !self.is_mostly_solid(voxel) {
                        let mut direction = Vector3::zeros();
                        direction[axis] = sign as f64;
                        best = Some((depth, direction));
                    }
                }
            }
            step += 1;
        }
        let (depth, axis) = best.unwrap_or((0.0, Vector3::z()));
        let exit = centre + axis * depth;
        let sample = self.sample_surface(&exit, &self.tent_sizes(radius_m), None);
        let smooth = sample.outward_per_m / sample.outward_per_m.norm().max(1e-300);
        let normal = if smooth.dot(&axis) > NORMAL_AGREEMENT_COSINE { smooth } else { axis };
        (exit, normal, -depth * normal.dot(&axis) - radius_m)
    }
}
