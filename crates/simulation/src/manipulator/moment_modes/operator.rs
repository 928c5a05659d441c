//! Mass, loads and the dense implicit operator of the modes.
//!
//! Spatial quantities are planar and expressed at the base origin, as in [`crate::manipulator::articulated`].
//! With `a_j` the axis of flexure j, `B_j` its row of the basis, `I_j` the inertia of everything distal to it
//! and `S_j` the motion of link j per unit of each freedom, the mass matrix of a chain (composite rigid
//! bodies, Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 6) becomes
//!
//! `M = X + X'`, `X = sum over j of B_j (S_j-1 + 1/2 a_j B_j)' I_j a_j`
//!
//! with one outer product per flexure. A stiffness `s_j` of a single flexure adds `1/2 s_j` to its `1/2 a_j'
//! I_j a_j` at no extra cost.

use nalgebra::Vector3;

use super::MOUNT;
use super::basis::Basis;
use super::shape::{FlexureArray, LINKS, LinkArray, Links, Motion, Shape};
use crate::manipulator::MAX_JOINTS;
use crate::manipulator::contact::{Square, lanes, lanes_mut};
use crate::manipulator::loads::Frame;

/// Motions of a link per unit of each freedom: rows omega_y, v_x, v_z of its planar motion at the base
/// origin.
pub(super) type Jacobian<const N: usize> = [[f64; N]; 3];

/// Mass, loads and motions for one shape.
#[derive(Debug, Clone)]
pub(super) struct Dynamics<const N: usize> {
    /// Motion of each link, the shaft first.
    pub jacobian: [Jacobian<N>; LINKS],
    /// Generalised force of all loads and of the torques on the flexures.
    pub force: [f64; N],
    /// The mass matrix, with the stiffnesses of single flexures; 1 for each unused freedom.
    pub matrix: Square<N>,
    /// Moment of all loads about the base origin, base axes, N m.
    pub moment: Vector3<f64>,
    /// Planar momentum at the base origin (m_y, p_x, p_z) per unit of each freedom's velocity.
    momentum: Jacobian<N>,
    /// Total mass (kg), and its first moments along x and z (kg m).
    first_moments: [f64; 3],
    forces: Forces,
    distal: Distal,
}

/// Contributions of the flexures to a shape's dynamics.
#[derive(Debug, Clone, Copy)]
pub(super) struct FlexureLoads<'a> {
    /// Torques, N m.
    pub torque: &'a FlexureArray,
    /// Stiffnesses of single flexures in the operator, times the step squared, N m s²/rad.
    pub stiffness: &'a FlexureArray,
}

/// Forces on the links (N), their moments at the base origin about y (N m), and the links' centres of mass
/// (m).
#[derive(Debug, Clone)]
struct Forces {
    x: LinkArray,
    y: LinkArray,
    z: LinkArray,
    moment: LinkArray,
    centre_x: LinkArray,
    centre_z: LinkArray,
}

/// Per flexure: momentum (m_y, p_x, p_z) of everything distal per unit of its rate, half its own part of the
/// mass matrix, and its torque.
#[derive(Debug, Clone)]
struct Distal {
    momentum: [FlexureArray; 3],
    half: FlexureArray,
    torque: FlexureArray,
    /// First moments (x, z), inertia about the origin, force (x, z) and moment of everything distal; 0 past
    /// the last.
    behind: [FlexureArray; 6],
    /// Inertia of each link about the origin, kg m².
    about: LinkArray,
}

impl Forces {
    /// Adds the inertial forces of a rotating base on links that are displaced across the plane and move
    /// there.
    fn add_turning(
        &mut self,
        links: &Links,
        shape: &Shape,
        motion: &Motion,
        [lateral_m, lateral_rate]: [f64; 2],
        frame: &Frame,
    ) {
        let w = &frame.angular_velocity;
        for l in 0..=links.joints {
            let position = Vector3::new(self.centre_x[l], lateral_m, self.centre_z[l]);
            let arm = motion.omega[l] * links.centre_m[l];
            let (x, z) = (motion.vx[l] + arm * shape.cos[l], motion.vz[l] - arm * shape.sin[l]);
            let more = frame.angular_acceleration.cross(&position)
                + w.cross(&w.cross(&position))
                + w.cross(&Vector3::new(x, lateral_rate, z)) * 2.0;
            self.x[l] -= links.mass_kg[l] * more.x;
            self.y[l] -= links.mass_kg[l] * more.y;
            self.z[l] -= links.mass_kg[l] * more.z;
        }
    }
}

impl<const N: usize> Dynamics<N> {
    pub fn new() -> Self {
        Self {
            jacobian: [[[0.0; N]; 3]; LINKS],
            force: [0.0; N],
            matrix: [[0.0; N]; N],
            moment: Vector3::zeros(),
            momentum: [[0.0; N]; 3],
            first_moments: [0.0; 3],
            forces: Forces {
                x: [0.0; LINKS],
                y: [0.0; LINKS],
                z: [0.0; LINKS],
                moment: [0.0; LINKS],
                centre_x: [0.0; LINKS],
                centre_z: [0.0; LINKS],
            },
            distal: Distal {
                momentum: [[0.0; MAX_JOINTS]; 3],
                half: [0.0; MAX_JOINTS],
                torque: [0.0; MAX_JOINTS],
                behind: [[0.0; MAX_JOINTS]; 6],
                about: [0.0; LINKS],
            },
        }
    }

    /// Evaluates everything for a shape and its motion, whose mount is displaced across the plane by
    /// `lateral_m` and moves there at the second value, m/s.
    #[inline(always)]
    pub fn evaluate<S: pulp::Simd>(
        &mut self,
        simd: S,
        (links, basis): (&Links, &Basis<N>),
        (shape, motion, lateral): (&Shape, &Motion, [f64; 2]),
        on: FlexureLoads<'_>,
        frame: &Frame,
    ) {
        self.force = [0.0; N];
        self.loads(links, shape, motion, lateral, frame);
        self.sweep_inward(links, shape, on);
        self.sweep_outward(simd, (links, basis), shape);
        let [mass, mx, mz] = self.first_moments;
        for k in 0..MOUNT {
            self.matrix[k][k] += mass;
        }
        for k in MOUNT + basis.modes..N {
            self.matrix[k][k] = 1.0;
        }
        (self.momentum[0][0], self.momentum[0][2]) = (mz, -mx);
        (self.momentum[1], self.momentum[2]) = (self.matrix[0], self.matrix[2]);
    }

    /// Computes gravity, base acceleration, velocity products and the tip load, as in
    /// [`crate::manipulator::loads`]. Sets the lateral force and the moments about x and z.
    #[inline(always)]
    fn loads(
        &mut self,
        links: &Links,
        shape: &Shape,
        motion: &Motion,
        [lateral_m, lateral_rate]: [f64; 2],
        frame: &Frame,
    ) {
        let f = &mut self.forces;
        for l in 0..LINKS {
            let (along, m, squared) =
                (links.centre_m[l], links.mass_kg[l], motion.omega[l] * motion.omega[l]);
            let (x, z) = (along * shape.sin[l], along * shape.cos[l]);
            (f.centre_x[l], f.centre_z[l]) = (shape.x[l] + x, shape.z[l] + z);
            f.x[l] = m * (frame.gravity.x - motion.ax[l] + squared * x);
            f.z[l] = m * (frame.gravity.z - motion.az[l] + squared * z);
            f.y[l] = m * frame.gravity.y;
        }
        if frame.angular_velocity != Vector3::zeros() || frame.angular_acceleration != Vector3::zeros() {
            f.add_turning(links, shape, motion, [lateral_m, lateral_rate], frame);
        }
        // Sums of the forces, and of the moments about x and z.
        let mut sums = [[0.0; 4]; 5];
        for l in 0..LINKS {
            let (x, z) = (f.x[l], f.z[l]);
            let spin = links.inertia_kg_m2[l] * frame.angular_acceleration.y;
            f.moment[l] = f.centre_z[l] * x - f.centre_x[l] * z - spin;
        }
        for four in 0..LINKS / 4 {
            for lane in 0..4 {
                let l = 4 * four + lane;
                let each = [f.x[l], f.y[l], f.z[l], f.centre_z[l] * f.y[l], f.centre_x[l] * f.y[l]];
                for (sum, each) in sums.iter_mut().zip(each) {
                    sum[lane] += each;
                }
            }
        }
        let [sum_x, sum_y, sum_z, about_x, about_z] = sums.map(|s| (s[0] + s[1]) + (s[2] + s[3]));
        let n = links.joints;
        let ([x, z], tip) = (shape.point(n, links.length_m[n]), &frame.tip_wrench);
        let (force, torque) = (&tip.force_n, &tip.torque_nm);
        f.x[n] += force.x;
        f.z[n] += force.z;
        f.moment[n] += z * force.x - x * force.z + torque.y;
        self.force[1] = sum_y + force.y;
        self.moment.x = torque.x + lateral_m * (sum_z + force.z) - about_x - z * force.y;
        self.moment.z = torque.z + about_z + x * force.y - lateral_m * (sum_x + force.x);
    }

    /// Sweeps from tip to base: accumulates the momentum and the load of everything distal to each flexure.
    /// Sets the forces on the mount.
    #[inline(always)]
    fn sweep_inward(&mut self, links: &Links, shape: &Shape, on: FlexureLoads<'_>) {
        let (f, out) = (&self.forces, &mut self.distal);
        for l in 0..LINKS {
            let squared = f.centre_x[l] * f.centre_x[l] + f.centre_z[l] * f.centre_z[l];
            out.about[l] = links.inertia_kg_m2[l] + links.mass_kg[l] * squared;
        }
        let mut sum = [0.0; 6];
        for l in (0..=links.joints.min(MAX_JOINTS)).rev() {
            let m = links.mass_kg[l];
            let each = [m * f.centre_x[l], m * f.centre_z[l], out.about[l], f.x[l], f.z[l], f.moment[l]];
            for (sum, each) in sum.iter_mut().zip(each) {
                *sum += each;
            }
            if l > 0 {
                for (behind, sum) in out.behind.iter_mut().zip(sum) {
                    behind[l - 1] = sum;
                }
            }
        }
        let [mx, mz, _, x, z, moment] = sum;
        (self.first_moments, self.moment.y) = ([links.total_mass_kg, mx, mz], moment);
        (self.force[0], self.force[2]) = (x, z);
        for j in 0..MAX_JOINTS {
            let (x, z, mass) = (shape.x[j + 1], shape.z[j + 1], links.behind_kg[j]);
            let [mx, mz, about, fx, fz, moment] = out.behind.each_ref().map(|b| b[j]);
            // I a, with the axis a = (1, -z, x).
            let w = [about - mz * z - mx * x, mz - mass * z, mass * x - mx];
            out.half[j] = 0.5 * (w[0] - z * w[1] + x * w[2] + on.stiffness[j]);
            out.torque[j] = on.torque[j] + moment - z * fx + x * fz;
            for (out, w) in out.momentum.iter_mut().zip(w) {
                out[j] = w;
            }
        }
    }

    /// Sweeps from base to tip: accumulates the links' motions, the generalised forces and the mass matrix,
    /// one vector of freedoms at a time.
    #[inline(always)]
    fn sweep_outward<S: pulp::Simd>(&mut self, simd: S, (links, basis): (&Links, &Basis<N>), shape: &Shape) {
        let distal = &self.distal;
        let add = |sum: S::f64s, scale: f64, b: S::f64s| {
            simd.add_f64s(sum, simd.mul_f64s(simd.splat_f64s(scale), b))
        };
        let mut unit = [[0.0; N]; 3];
        (unit[1][0], unit[2][2]) = (1.0, 1.0);
        self.jacobian[0] = unit;
        let mut all = [[0.0; N]; N];
        let blocks = lanes::<S>(&unit[0]).len();
        for b in 0..blocks {
            let mut s = [lanes::<S>(&unit[0])[b], lanes::<S>(&unit[1])[b], lanes::<S>(&unit[2])[b]];
            let (mut force, mut about) = (simd.splat_f64s(0.0), simd.splat_f64s(0.0));
            let mut x = [simd.splat_f64s(0.0); N];
            for j in 0..links.joints.min(MAX_JOINTS) {
                let (entries, row) = (&basis.of_flexure[j], lanes::<S>(&basis.of_flexure[j])[b]);
                let w = [distal.momentum[0][j], distal.momentum[1][j], distal.momentum[2][j]];
                let u = simd.mul_f64s(simd.splat_f64s(distal.half[j]), row);
                let u = add(add(add(u, w[0], s[0]), w[1], s[1]), w[2], s[2]);
                for m in MOUNT..N {
                    x[m] = add(x[m], entries[m], u);
                }
                force = add(force, distal.torque[j], row);
                about = add(about, w[0], row);
                s[0] = simd.add_f64s(s[0], row);
                s[1] = add(s[1], -shape.z[j + 1], row);
                s[2] = add(s[2], shape.x[j + 1], row);
                let [turn, along_x, along_z] = &mut self.jacobian[j + 1];
                lanes_mut::<S>(turn)[b] = s[0];
                lanes_mut::<S>(along_x)[b] = s[1];
                lanes_mut::<S>(along_z)[b] = s[2];
            }
            let sum = &mut lanes_mut::<S>(&mut self.force)[b];
            *sum = simd.add_f64s(*sum, force);
            lanes_mut::<S>(&mut self.momentum[0])[b] = about;
            for m in MOUNT..N {
                lanes_mut::<S>(&mut all[m])[b] = x[m];
            }
        }
        for i in 0..N {
            for k in 0..N {
                self.matrix[i][k] = all[i][k] + all[k][i];
            }
        }
    }

    /// Returns the moment about the base origin that produces a change of the freedoms' velocities, with the
    /// mount displaced by `lateral_m` across the plane, N m s.
    #[inline(always)]
    pub fn momentum_moment(&self, change: &[f64; N], lateral_m: f64) -> Vector3<f64> {
        let along = |row: &[f64; N]| row.iter().zip(change).map(|(a, b)| a * b).sum::<f64>();
        let [about, x, z] = [along(&self.momentum[0]), along(&self.momentum[1]), along(&self.momentum[2])];
        let ([_, mx, mz], across) = (self.first_moments, change[1]);
        Vector3::new(lateral_m * z - across * mz, about, across * mx - lateral_m * x)
    }
}
