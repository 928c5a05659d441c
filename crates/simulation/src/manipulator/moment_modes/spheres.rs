//! Positions and velocities of the proxy spheres.

use nalgebra::Vector3;

use super::MOUNT;
use super::shape::{LINKS, LinkArray, Links, Motion, Shape};
use crate::manipulator::geometry::{SphereKind, SphereLayout};
use crate::manipulator::state::{BaseMotion, ProxySphere};
use crate::manipulator::{MAX_JOINTS, MAX_SPHERES};

/// Workspace for processing all spheres as arrays: position and velocity in the bending plane, then along one
/// world axis.
#[derive(Debug, Clone)]
pub(super) struct SphereWork {
    /// Distance of each segment's sphere from its link's origin, m.
    segment_m: LinkArray,
    /// Number of spheres before the first segment's, that is, on the shaft.
    before: usize,
    /// Positions x, z, m, and their rates relative to the base, m/s.
    local: [[f64; MAX_SPHERES]; 4],
    world: [[f64; MAX_SPHERES]; 2],
}

impl SphereWork {
    /// Creates the workspace for spheres in this order: shaft, one per segment from base to tip, burr.
    pub fn new(layout: &[SphereLayout]) -> Self {
        let mut segment_m = [0.0; LINKS];
        for fixed in layout.iter().filter(|fixed| matches!(fixed.kind, SphereKind::Segment(_))) {
            segment_m[fixed.link] = fixed.along_m;
        }
        let before = layout.iter().filter(|fixed| fixed.kind == SphereKind::Shaft).count();
        Self { segment_m, before, local: [[0.0; MAX_SPHERES]; 4], world: [[0.0; MAX_SPHERES]; 2] }
    }

    /// Updates the spheres of a tool on `base` whose mount is at `mount` (m) and moves at `mount_rate` (m/s).
    #[inline(always)]
    pub fn place(
        &mut self,
        (spheres, layout): (&mut [ProxySphere], &[SphereLayout]),
        (links, shape, motion): (&Links, &Shape, &Motion),
        (mount, mount_rate): (&[f64; MOUNT], &[f64; MOUNT]),
        base: &BaseMotion,
    ) {
        self.place_local(layout, links, shape, motion);
        let axes = base.t_world_base.rotation.to_rotation_matrix();
        let turn = axes.transpose() * base.angular_velocity_rad_per_s;
        let origin = base.t_world_base.translation.vector + axes * Vector3::new(0.0, mount[1], 0.0);
        // Velocity of a point (x, mount, z): its own, that of the base, and that of the rotation, (wy z - wz
        // y, wz x - wx z, wx y - wy x).
        let drift = axes * Vector3::new(-turn.z * mount[1], mount_rate[1], turn.x * mount[1])
            + base.linear_velocity_m_per_s;
        let count = layout.len().min(MAX_SPHERES);
        for axis in 0..3 {
            let [ex, ey, ez] = [axes[(axis, 0)], axes[(axis, 1)], axes[(axis, 2)]];
            let (per_x, per_z) = (ey * turn.z - ez * turn.y, ex * turn.y - ey * turn.x);
            let [x, z, vx, vz] = &self.local;
            let [place, velocity] = &mut self.world;
            for i in 0..count {
                place[i] = origin[axis] + ex * x[i] + ez * z[i];
                velocity[i] = drift[axis] + (ex * vx[i] + ez * vz[i]) + (per_x * x[i] + per_z * z[i]);
            }
            for ((sphere, place), velocity) in spheres.iter_mut().zip(&self.world[0]).zip(&self.world[1]) {
                (sphere.centre_m[axis], sphere.velocity_m_per_s[axis]) = (*place, *velocity);
            }
        }
    }

    /// Updates the spheres in the bending plane, those of the segments as arrays.
    #[inline(always)]
    fn place_local(&mut self, layout: &[SphereLayout], links: &Links, shape: &Shape, motion: &Motion) {
        let joints = links.joints.min(MAX_JOINTS);
        let [x, z, vx, vz] = self.local.each_mut().map(|of| &mut of[self.before..][..joints]);
        for i in 0..joints {
            let (l, along) = (i + 1, self.segment_m[i + 1]);
            let arm = motion.omega[l] * along;
            (x[i], z[i]) = (shape.x[l] + along * shape.sin[l], shape.z[l] + along * shape.cos[l]);
            (vx[i], vz[i]) = (motion.vx[l] + arm * shape.cos[l], motion.vz[l] - arm * shape.sin[l]);
        }
        let others = (0..self.before).chain(self.before + joints..layout.len().min(MAX_SPHERES));
        for i in others {
            let (link, along) = (layout[i].link, layout[i].along_m);
            let arm = motion.omega[link] * along;
            [self.local[0][i], self.local[1][i]] = shape.point(link, along);
            self.local[2][i] = motion.vx[link] + arm * shape.cos[link];
            self.local[3][i] = motion.vz[link] - arm * shape.sin[link];
        }
    }
}
