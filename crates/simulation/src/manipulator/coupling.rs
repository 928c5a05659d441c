//! The part of the implicit operator that couples all joints: elastic tendons under displacement control, and tendon friction.
//!
//! Per tendon it is the rank-one matrix `a g'` with `g = dl/dq` and `a = -d torque / dl`. With friction, `a` is not parallel to `g`.
//! Contact needs a symmetric operator, so `a` is replaced by `alpha g` with `alpha = (g' H^-1 a) / (g' H^-1 g)`. The take-up l, the only
//! stiff direction, then responds as under the exact operator, and statics are unaffected. The inverse follows from the Woodbury
//! identity.

use super::articulated::{Articulated, Generalised, Spatial};
use super::contact::Chain;
use super::tendon::TendonLoad;
use super::{MAX_JOINTS, MAX_TENDONS};

/// `A = H + sum_t c_t g_t g_t'` and its inverse.
#[derive(Debug, Clone)]
pub(super) struct Coupling {
    /// True if any tendon couples the joints.
    pub active: bool,
    /// alpha of each tendon, N/m.
    pub alpha: [f64; MAX_TENDONS],
    /// Number of tendons.
    pub count: usize,
    slope: [[f64; MAX_JOINTS]; MAX_TENDONS],
    /// c_t.
    weight: [f64; MAX_TENDONS],
    /// H^-1 g_t.
    pub response: [Generalised; MAX_TENDONS],
    pub kernel: Kernel,
}

/// Symmetric kernel of the Woodbury identity: A^-1 = H^-1 - Z kernel Z', where the columns of Z are H^-1 g_t.
#[derive(Debug, Clone, Copy)]
pub(super) struct Kernel {
    pub entry: [[f64; MAX_TENDONS]; MAX_TENDONS],
    pub count: usize,
}

impl Kernel {
    pub const NONE: Self = Self { entry: [[0.0; MAX_TENDONS]; MAX_TENDONS], count: 0 };

    /// From the weights c and the products s = G' H^-1 G: the first two tendons in closed form, each further one by bordering.
    pub fn new(count: usize, c: &[f64; MAX_TENDONS], s: &[[f64; MAX_TENDONS]; MAX_TENDONS]) -> Self {
        let mut k = [[0.0; MAX_TENDONS]; MAX_TENDONS];
        let determinant = (1.0 + c[0] * s[0][0]) * (1.0 + c[1] * s[1][1]) - c[0] * c[1] * s[0][1] * s[0][1];
        k[0][0] = c[0] * (1.0 + c[1] * s[1][1]) / determinant;
        k[0][1] = -c[0] * c[1] * s[0][1] / determinant;
        k[1][0] = k[0][1];
        k[1][1] = c[1] * (1.0 + c[0] * s[0][0]) / determinant;
        for t in 2..count {
            // A^-1 g_t = z_t - Z u with u = kernel s_t; then the Sherman-Morrison formula.
            let mut u = [0.0; MAX_TENDONS];
            let mut own = s[t][t];
            for i in 0..t {
                for j in 0..t {
                    u[i] += k[i][j] * s[j][t];
                }
                own -= s[i][t] * u[i];
            }
            let f = c[t] / (1.0 + c[t] * own);
            for i in 0..t {
                for j in 0..t {
                    k[i][j] += f * u[i] * u[j];
                }
                k[i][t] = -f * u[i];
                k[t][i] = k[i][t];
            }
            k[t][t] = f;
        }
        Self { entry: k, count: count.max(2) }
    }

    /// Multiplies the kernel by a vector.
    pub fn weigh(&self, p: &[f64; MAX_TENDONS]) -> [f64; MAX_TENDONS] {
        let mut out = [0.0; MAX_TENDONS];
        for i in 0..self.count {
            out[i] = self.entry[i][0] * p[0] + self.entry[i][1] * p[1];
            for j in 2..self.count {
                out[i] += self.entry[i][j] * p[j];
            }
        }
        out
    }
}

fn dot_joints(a: &[f64; MAX_JOINTS], b: &[f64; MAX_JOINTS]) -> f64 {
    let mut sum = 0.0;
    for i in 0..MAX_JOINTS {
        sum += a[i] * b[i];
    }
    sum
}

impl Coupling {
    pub fn new() -> Self {
        Self {
            active: false,
            alpha: [0.0; MAX_TENDONS],
            count: 0,
            slope: [[0.0; MAX_JOINTS]; MAX_TENDONS],
            weight: [0.0; MAX_TENDONS],
            response: [Generalised::ZERO; MAX_TENDONS],
            kernel: Kernel::NONE,
        }
    }

    /// Sets up the coupling for a factored H. `scale` weighs the rank-one stiffness (dt^2 for the method in use).
    pub fn update(&mut self, articulated: &Articulated, load: &TendonLoad, scale: f64) {
        self.count = load.channels.count;
        self.active = load.coupled[..self.count].contains(&true);
        self.alpha = [0.0; MAX_TENDONS];
        if !self.active {
            return;
        }
        let none: [Spatial; MAX_JOINTS + 1] = [[0.0; 3]; MAX_JOINTS + 1];
        for t in 0..self.count {
            self.response[t] = Generalised::ZERO;
            if !load.coupled[t] {
                self.slope[t] = [0.0; MAX_JOINTS];
                continue;
            }
            self.slope[t] = load.slope[t];
            let slope = Generalised { joint: load.slope[t], mount: [0.0; 3] };
            let gradient = Generalised { joint: load.gradient[t], mount: [0.0; 3] };
            self.response[t] = articulated.solve(&none, &slope);
            let own = dot_joints(&self.slope[t], &self.response[t].joint);
            let cross = dot_joints(&self.slope[t], &articulated.solve(&none, &gradient).joint);
            self.alpha[t] = if own > 0.0 { (cross / own).max(0.0) } else { 0.0 };
        }
        let c = self.alpha.map(|a| a * scale);
        self.weight = c;
        let mut s = [[0.0; MAX_TENDONS]; MAX_TENDONS];
        for i in 0..self.count {
            for j in i..self.count {
                s[i][j] = dot_joints(&self.slope[i], &self.response[j].joint);
            }
        }
        self.kernel = Kernel::new(self.count, &c, &s);
    }

    /// Tells the contact solver's chain, whose freedoms before the joints are the mount's `mount`.
    pub fn describe<const N: usize>(&self, mount: usize, chain: &mut Chain<N>) {
        chain.coupled = if self.active { self.count.max(2) } else { 0 };
        chain.weight = self.weight;
        for t in 0..chain.coupled {
            chain.slope[t][..mount].fill(0.0);
            let joints = &mut chain.slope[t][mount..];
            joints.copy_from_slice(&self.slope[t][..joints.len()]);
        }
    }

    /// Adds `-weight` times the rank-one stiffness times joint velocities `rate` to `rhs`.
    pub fn subtract_stiffness(&self, rate: &[f64; MAX_JOINTS], weight: f64, rhs: &mut [f64; MAX_JOINTS]) {
        if !self.active {
            return;
        }
        for t in 0..self.count {
            let scale = weight * self.alpha[t] * dot_joints(&self.slope[t], rate);
            for (r, slope) in rhs.iter_mut().zip(&self.slope[t]) {
                *r -= scale * slope;
            }
        }
    }

    /// A^-1 b from H^-1 b.
    pub fn correct(&self, x: Generalised) -> Generalised {
        if !self.active {
            return x;
        }
        let mut p = [0.0; MAX_TENDONS];
        for t in 0..self.count {
            p[t] = dot_joints(&self.slope[t], &x.joint);
        }
        let w = self.kernel.weigh(&p);
        let mut sum = x;
        for t in 0..self.count {
            sum = sum.plus(-w[t], &self.response[t]);
        }
        sum
    }
}
