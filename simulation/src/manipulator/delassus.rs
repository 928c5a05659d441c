//! Contact-space mobility (Delassus operator) `R = B A^-1 B'` of the chain's implicit operator.
//!
//! A probe is a sphere centre (three rows: omega_y, v_x, v_z) or a flexure at its stop (one row: its velocity). All contacts of a sphere
//! share its probe, so R grows with the number of spheres in contact, not the number of contacts. The out-of-plane direction is one
//! scalar for the whole tool.

use super::articulated::{Articulated, Generalised, Spatial, joint_axis, velocity_at};
use super::coupling::Coupling;
use super::geometry::{Configuration, Layout, Planar};
use super::{MAX_JOINTS, MAX_ROWS, MAX_SPHERES, MAX_TENDONS};

/// The probes of one step and their mobility matrix.
#[derive(Debug, Clone)]
pub(super) struct Delassus {
    /// Link of each sphere probe, in non-decreasing order.
    link: [usize; MAX_SPHERES],
    centre: [Planar; MAX_SPHERES],
    pub sphere_count: usize,
    /// Joint of each stop probe, ascending.
    pub joint: [usize; MAX_JOINTS],
    pub joint_count: usize,
    /// Row of each joint's stop probe, if it has one.
    joint_row: [Option<usize>; MAX_JOINTS],
    /// Row-major, `rows` x `rows`.
    matrix: Vec<f64>,
    motions: [Spatial; MAX_JOINTS + 1],
}

impl Delassus {
    pub fn new() -> Self {
        Self {
            link: [0; MAX_SPHERES],
            centre: [[0.0; 2]; MAX_SPHERES],
            sphere_count: 0,
            joint: [0; MAX_JOINTS],
            joint_count: 0,
            joint_row: [None; MAX_JOINTS],
            matrix: vec![0.0; MAX_ROWS * MAX_ROWS],
            motions: [[0.0; 3]; MAX_JOINTS + 1],
        }
    }

    /// Forgets all probes.
    pub fn clear(&mut self) {
        self.sphere_count = 0;
        self.joint_count = 0;
        self.joint_row = [None; MAX_JOINTS];
    }

    /// Adds a sphere probe (call in ascending order, spheres before joints); returns its probe index.
    pub fn add_sphere(&mut self, layout: &Layout, configuration: &Configuration, sphere: usize) -> usize {
        let k = self.sphere_count;
        let fixed = &layout.spheres[sphere];
        self.link[k] = fixed.link;
        self.centre[k] = configuration.point(fixed.link, fixed.along_m);
        self.sphere_count += 1;
        k
    }

    /// Adds a stop probe (call in ascending order, after all spheres).
    pub fn add_joint(&mut self, joint: usize) {
        self.joint[self.joint_count] = joint;
        self.joint_row[joint] = Some(3 * self.sphere_count + self.joint_count);
        self.joint_count += 1;
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        3 * self.sphere_count + self.joint_count
    }

    /// Planar centre of a sphere probe, base axes.
    pub fn centre(&self, probe: usize) -> Planar {
        self.centre[probe]
    }

    /// Column `row` of R, which is also its row because R is symmetric.
    pub fn column(&self, row: usize) -> &[f64] {
        let rows = self.rows();
        &self.matrix[row * rows..(row + 1) * rows]
    }

    /// Fills R for the factored operator.
    pub fn assemble(&mut self, articulated: &mut Articulated, coupling: &Coupling, joints: usize) {
        articulated.update_mobility();
        for probe in 0..self.sphere_count {
            self.sweep_sphere(articulated, joints, probe);
        }
        for k in 0..self.joint_count {
            self.sweep_joint(articulated, joints, k);
        }
        if coupling.active {
            self.subtract_coupling(articulated, coupling);
        }
    }

    /// Propagates the responses to unit moment, force x and force z at a sphere centre outward from its link.
    fn sweep_sphere(&mut self, articulated: &Articulated, joints: usize, probe: usize) {
        let rows = self.rows();
        let c = self.centre[probe];
        let unit: [Spatial; 3] = [[1.0, 0.0, 0.0], [c[1], 1.0, 0.0], [-c[0], 0.0, 1.0]];
        let mut x = unit.map(|force| articulated.link_response(self.link[probe], &force));
        let mut next = self.write_spheres(probe, self.link[probe], 3 * probe, &x);
        for joint in self.link[probe]..joints {
            let rates = [0, 1, 2].map(|k| articulated.carry_outward(joint, &mut x[k]));
            if let Some(row) = self.joint_row[joint] {
                for (k, rate) in rates.iter().enumerate() {
                    self.set(rows, 3 * probe + k, row, *rate);
                }
            }
            next = self.write_spheres(next, joint + 1, 3 * probe, &x);
        }
    }

    /// Propagates the response to a unit torque in a flexure outward from it.
    fn sweep_joint(&mut self, articulated: &Articulated, joints: usize, k: usize) {
        let rows = self.rows();
        let source = 3 * self.sphere_count + k;
        let first = self.joint[k];
        let (rate, mut x) = articulated.joint_response(first);
        self.set(rows, source, source, rate);
        let mut next = self.link[..self.sphere_count].partition_point(|&link| link <= first);
        next = self.write_spheres(next, first + 1, source, &[x]);
        for joint in first + 1..joints {
            let rate = articulated.carry_outward(joint, &mut x);
            if let Some(row) = self.joint_row[joint] {
                self.set(rows, source, row, rate);
            }
            next = self.write_spheres(next, joint + 1, source, &[x]);
        }
    }

    /// Writes the motions `x` (one per source row, starting at `source`) of all sphere probes on `link`, starting at probe `next`;
    /// returns the first probe beyond them.
    fn write_spheres(&mut self, mut next: usize, link: usize, source: usize, x: &[Spatial]) -> usize {
        let rows = self.rows();
        while next < self.sphere_count && self.link[next] == link {
            for (k, motion) in x.iter().enumerate() {
                let v = velocity_at(&self.centre[next], motion);
                self.set(rows, source + k, 3 * next, motion[0]);
                self.set(rows, source + k, 3 * next + 1, v[0]);
                self.set(rows, source + k, 3 * next + 2, v[1]);
            }
            next += 1;
        }
        next
    }

    fn set(&mut self, rows: usize, a: usize, b: usize, value: f64) {
        self.matrix[a * rows + b] = value;
        self.matrix[b * rows + a] = value;
    }

    /// R -= (B Z) kernel (B Z)'.
    fn subtract_coupling(&mut self, articulated: &Articulated, coupling: &Coupling) {
        let rows = self.rows();
        let mut z = [[0.0; MAX_ROWS]; MAX_TENDONS];
        for (response, out) in coupling.response[..coupling.count].iter().zip(&mut z) {
            self.velocities(articulated, response, out);
        }
        for a in 0..rows {
            let w = coupling.kernel.weigh(&core::array::from_fn(|t| z[t][a]));
            for b in 0..rows {
                self.matrix[a * rows + b] -= w[0] * z[0][b] + w[1] * z[1][b];
            }
            for t in 2..coupling.count {
                for b in 0..rows {
                    self.matrix[a * rows + b] -= w[t] * z[t][b];
                }
            }
        }
    }

    /// B x: probe velocities relative to the base frame.
    pub fn velocities(&mut self, articulated: &Articulated, x: &Generalised, out: &mut [f64; MAX_ROWS]) {
        articulated.link_motions(x, &mut self.motions);
        for probe in 0..self.sphere_count {
            let motion = &self.motions[self.link[probe]];
            let v = velocity_at(&self.centre[probe], motion);
            out[3 * probe] = motion[0];
            out[3 * probe + 1] = v[0];
            out[3 * probe + 2] = v[1];
        }
        for k in 0..self.joint_count {
            out[3 * self.sphere_count + k] = x.joint[self.joint[k]];
        }
    }

    /// B' p: link and joint impulses for probe impulses `p`.
    pub fn scatter(
        &self,
        p: &[f64; MAX_ROWS],
        force: &mut [Spatial; MAX_JOINTS + 1],
        joint: &mut [f64; MAX_JOINTS],
    ) {
        for probe in 0..self.sphere_count {
            let c = joint_axis(&self.centre[probe]);
            let (moment, fx, fz) = (p[3 * probe], p[3 * probe + 1], p[3 * probe + 2]);
            let target = &mut force[self.link[probe]];
            target[0] += moment - c[1] * fx - c[2] * fz;
            target[1] += fx;
            target[2] += fz;
        }
        for k in 0..self.joint_count {
            joint[self.joint[k]] += p[3 * self.sphere_count + k];
        }
    }
}
