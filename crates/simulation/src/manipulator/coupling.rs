//! Part of the implicit operator that couples all joints: elastic tendons under displacement control, and
//! tendon friction.
//!
//! For each tendon it is the rank-one matrix `a g'` with `g = dl/dq` and `a = -d torque / dl`. With friction,
//! `a` is not parallel to `g`. Contact needs a symmetric operator, so `a` is replaced by `alpha g` with
//! `alpha = (g' H^-1 a) / (g' H^-1 g)`. The take-up l, the only stiff direction, then responds as under the
//! exact operator, and statics are unaffected. The inverse follows from the Woodbury identity.

use super::MAX_TENDONS;
use super::contact::Chain;

/// Velocities or impulses of all freedoms.
pub(super) trait Freedoms: Clone {
    fn dot(&self, other: &Self) -> f64;
    /// Adds scale other to self.
    fn add_scaled(&mut self, scale: f64, other: &Self);
    fn clear(&mut self);
    /// Copies the entries into a list with the mount's first.
    fn copy_to(&self, list: &mut [f64]);
}

impl Freedoms for Vec<f64> {
    fn dot(&self, other: &Self) -> f64 {
        self.iter().zip(other).map(|(a, b)| a * b).sum()
    }

    fn add_scaled(&mut self, scale: f64, other: &Self) {
        for (s, o) in self.iter_mut().zip(other) {
            *s += scale * o;
        }
    }

    fn clear(&mut self) {
        self.fill(0.0);
    }

    fn copy_to(&self, list: &mut [f64]) {
        list.copy_from_slice(self);
    }
}

/// Contributions of a chain's tendons to its operator.
pub(super) struct TendonTerms<'t, V> {
    pub count: usize,
    /// True for each tendon whose gradient is not zero.
    pub coupled: &'t [bool; MAX_TENDONS],
    /// Slopes d take-up / dq and gradients -d force / d take-up.
    pub slope: &'t [V; MAX_TENDONS],
    pub gradient: &'t [V; MAX_TENDONS],
}

/// `A = H + sum_t c_t g_t g_t'` and its inverse.
#[derive(Debug, Clone)]
pub(super) struct Coupling<V> {
    /// True if any tendon couples the joints.
    active: bool,
    /// Symmetrised stiffness alpha of each tendon, N/m.
    alpha: [f64; MAX_TENDONS],
    /// Number of tendons.
    count: usize,
    slope: [V; MAX_TENDONS],
    /// Weights c_t.
    weight: [f64; MAX_TENDONS],
    /// Responses H^-1 g_t.
    response: [V; MAX_TENDONS],
    scratch: V,
    kernel: Kernel,
}

/// Symmetric kernel of the Woodbury identity: A^-1 = H^-1 - Z kernel Z', where the columns of Z are H^-1 g_t.
#[derive(Debug, Clone, Copy)]
pub(super) struct Kernel {
    pub entry: [[f64; MAX_TENDONS]; MAX_TENDONS],
    pub count: usize,
}

impl Kernel {
    pub const NONE: Self = Self { entry: [[0.0; MAX_TENDONS]; MAX_TENDONS], count: 0 };

    /// Creates the kernel from the weights c and the products s = G' H^-1 G: the first two tendons in closed
    /// form, each further one by bordering.
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

impl<V: Freedoms> Coupling<V> {
    /// Creates an inactive coupling; `zero` has all freedoms at 0.
    pub fn new(zero: V) -> Self {
        let blank = || core::array::from_fn(|_| zero.clone());
        Self {
            active: false,
            alpha: [0.0; MAX_TENDONS],
            count: 0,
            slope: blank(),
            weight: [0.0; MAX_TENDONS],
            response: blank(),
            scratch: zero,
            kernel: Kernel::NONE,
        }
    }

    /// Sets up the coupling for a factored H, whose inverse `solve` writes into its second argument. `scale`
    /// multiplies the rank-one stiffness (dt^2 for the present method).
    pub fn update(&mut self, terms: &TendonTerms<V>, scale: f64, mut solve: impl FnMut(&V, &mut V)) {
        self.count = terms.count;
        self.active = terms.coupled[..self.count].contains(&true);
        self.alpha = [0.0; MAX_TENDONS];
        if !self.active {
            return;
        }
        for t in 0..self.count {
            if !terms.coupled[t] {
                self.slope[t].clear();
                self.response[t].clear();
                continue;
            }
            self.slope[t].clone_from(&terms.slope[t]);
            solve(&terms.gradient[t], &mut self.scratch);
            let cross = self.slope[t].dot(&self.scratch);
            solve(&terms.slope[t], &mut self.response[t]);
            let own = self.slope[t].dot(&self.response[t]);
            self.alpha[t] = if own > 0.0 { (cross / own).max(0.0) } else { 0.0 };
        }
        self.weight = self.alpha.map(|a| a * scale);
        let mut s = [[0.0; MAX_TENDONS]; MAX_TENDONS];
        for i in 0..self.count {
            for j in i..self.count {
                s[i][j] = self.slope[i].dot(&self.response[j]);
            }
        }
        self.kernel = Kernel::new(self.count, &self.weight, &s);
    }

    /// Sets the tendons of the contact solver's chain.
    pub fn describe<const N: usize>(&self, chain: &mut Chain<N>) {
        chain.coupled = if self.active { self.count.max(2) } else { 0 };
        chain.weight = self.weight;
        for t in 0..chain.coupled {
            self.slope[t].copy_to(&mut chain.slope[t]);
        }
    }

    /// Subtracts the rank-one stiffnesses times the velocities `rate` from `rhs`.
    pub fn subtract_stiffness(&self, rate: &V, rhs: &mut V) {
        for t in 0..if self.active { self.count } else { 0 } {
            rhs.add_scaled(-self.alpha[t] * self.slope[t].dot(rate), &self.slope[t]);
        }
    }

    /// Converts H^-1 b to A^-1 b.
    pub fn correct(&self, x: &mut V) {
        if !self.active {
            return;
        }
        let mut p = [0.0; MAX_TENDONS];
        for t in 0..self.count {
            p[t] = self.slope[t].dot(x);
        }
        for (response, w) in self.response[..self.count].iter().zip(self.kernel.weigh(&p)) {
            x.add_scaled(-w, response);
        }
    }
}
