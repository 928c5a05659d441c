//! The chain's implicit operator with contact rows on its links: `A + sum w f f'`.
//!
//! A row that presses adds the rank-one stiffness `w f f'` to the body it presses on and `w` to the diagonal
//! of a stopped flexure, so the articulated-body algorithm factors the sum at the cost of the operator alone:
//! O(links), independent of the number of rows. All spatial quantities are expressed at the base origin; N is
//! the number of their components (4 in the bending plane with the out-of-plane velocity, 6 in space).
//! Tendons that couple the joints follow by the Woodbury identity (see `coupling`).

use super::dense::{lanes, lanes_mut};
use crate::manipulator::MAX_TENDONS;
use crate::manipulator::coupling::Kernel;

/// A symmetric operator from motions to forces or back.
pub(in crate::manipulator) type Square<const N: usize> = [[f64; N]; N];

#[inline(always)]
pub(super) fn dot<const N: usize>(a: &[f64; N], b: &[f64; N]) -> f64 {
    let mut sum = 0.0;
    for i in 0..N {
        sum += a[i] * b[i];
    }
    sum
}

/// Adds scale b to a.
#[inline(always)]
pub(in crate::manipulator) fn add_scaled<const N: usize>(a: &mut [f64; N], scale: f64, b: &[f64; N]) {
    for i in 0..N {
        a[i] += scale * b[i];
    }
}

/// Returns m v for a symmetric m: columns equal rows, so no sum runs across SIMD lanes.
#[inline(always)]
pub(super) fn times<const N: usize>(m: &Square<N>, v: &[f64; N]) -> [f64; N] {
    let mut out = [0.0; N];
    for (row, x) in m.iter().zip(v) {
        add_scaled(&mut out, *x, row);
    }
    out
}

/// Adds scale a a' to m.
#[inline(always)]
pub(super) fn add_outer<const N: usize>(m: &mut Square<N>, scale: f64, a: &[f64; N]) {
    for (row, x) in m.iter_mut().zip(a) {
        add_scaled(row, scale * x, a);
    }
}

/// Row length from which rows are processed with explicit SIMD; the compiler vectorises shorter ones by
/// itself.
const WIDE: usize = 8;

/// Same as [`add_outer`], bit for bit.
#[inline(always)]
pub(super) fn add_outer_by<S: pulp::Simd, const N: usize>(
    simd: S,
    m: &mut Square<N>,
    scale: f64,
    a: &[f64; N],
) {
    if N < WIDE {
        return add_outer(m, scale, a);
    }
    for (row, x) in m.iter_mut().zip(a) {
        add_scaled_by(simd, row, scale * x, a);
    }
}

/// Same as [`add_scaled`], bit for bit.
#[inline(always)]
pub(super) fn add_scaled_by<S: pulp::Simd, const N: usize>(
    simd: S,
    a: &mut [f64; N],
    scale: f64,
    b: &[f64; N],
) {
    if N < WIDE {
        return add_scaled(a, scale, b);
    }
    let scale = simd.splat_f64s(scale);
    for (a, b) in lanes_mut::<S>(a).iter_mut().zip(lanes::<S>(b)) {
        *a = simd.add_f64s(*a, simd.mul_f64s(scale, *b));
    }
}

/// Same as [`times`], bit for bit.
#[inline(always)]
pub(super) fn times_by<S: pulp::Simd, const N: usize>(simd: S, m: &Square<N>, v: &[f64; N]) -> [f64; N] {
    if N < WIDE {
        return times(m, v);
    }
    let mut out = [0.0; N];
    for (b, out) in lanes_mut::<S>(&mut out).iter_mut().enumerate() {
        let mut sum = *out;
        for (row, x) in m.iter().zip(v) {
            sum = simd.add_f64s(sum, simd.mul_f64s(simd.splat_f64s(*x), lanes::<S>(row)[b]));
        }
        *out = sum;
    }
    out
}

/// Adds a s s' + b (s t' + t s') + c t t' to m.
#[inline(always)]
pub(super) fn add_pair_by<S: pulp::Simd, const N: usize>(
    simd: S,
    m: &mut Square<N>,
    [a, b, c]: [f64; 3],
    [s, t]: [&[f64; N]; 2],
) {
    for i in 0..N {
        let (x, y) = (a * s[i] + b * t[i], b * s[i] + c * t[i]);
        if N < WIDE {
            for j in 0..N {
                m[i][j] += x * s[j] + y * t[j];
            }
            continue;
        }
        let (x, y) = (simd.splat_f64s(x), simd.splat_f64s(y));
        let vectors = lanes::<S>(s).iter().zip(lanes::<S>(t));
        for (entry, (s, t)) in lanes_mut::<S>(&mut m[i]).iter_mut().zip(vectors) {
            *entry = simd.add_f64s(*entry, simd.add_f64s(simd.mul_f64s(x, *s), simd.mul_f64s(y, *t)));
        }
    }
}

/// Contributions of the rows to the operator, and their impulses.
#[derive(Debug, Clone)]
pub(in crate::manipulator) struct Pressing<const N: usize> {
    /// Sum of w f f' on each link.
    pub link: Vec<Square<N>>,
    /// Stiffness that stops add to each freedom.
    pub freedom: Vec<f64>,
    /// Impulse on each link, and in each freedom.
    pub link_impulse: Vec<[f64; N]>,
    pub freedom_impulse: Vec<f64>,
}

impl<const N: usize> Pressing<N> {
    pub(super) fn new(links: usize, freedoms: usize) -> Self {
        Self {
            link: vec![[[0.0; N]; N]; links],
            freedom: vec![0.0; freedoms],
            link_impulse: vec![[0.0; N]; links],
            freedom_impulse: vec![0.0; freedoms],
        }
    }

    #[inline(always)]
    pub fn clear(&mut self) {
        self.link.fill([[0.0; N]; N]);
        self.freedom.fill(0.0);
        self.link_impulse.fill([0.0; N]);
        self.freedom_impulse.fill(0.0);
    }
}

/// The operator of a step as Newton's method needs it: `A + sum w f f'` and its inverse.
pub(in crate::manipulator) trait Operator<const N: usize> {
    /// Returns the contributions of the rows, to be set by the caller.
    fn pressing(&mut self) -> &mut Pressing<N>;
    /// Factors the operator with the contributions in `pressing`.
    fn factor<S: pulp::Simd>(&mut self, simd: S);
    /// Solves for the velocities under the impulses in `pressing`.
    fn solve(&mut self);
    /// Returns the solution: motions of the links.
    fn motion(&self) -> &[[f64; N]];
    /// Returns the solution: velocities of the freedoms.
    fn velocity(&self) -> &[f64];
    /// Computes the motions of the links at velocities `x` of the freedoms.
    fn motions_of(&self, x: &[f64], out: &mut [[f64; N]]);
    /// Calls `link` with the mobility of each link to a force on itself and `freedom` with that of each
    /// freedom to its own torque, base to tip, for the present factor.
    fn mobilities<S: pulp::Simd>(
        &self,
        simd: S,
        freedom: impl FnMut(usize, f64),
        link: impl FnMut(usize, &Square<N>),
    );
}

impl<const N: usize> Operator<N> for Chain<N> {
    #[inline(always)]
    fn pressing(&mut self) -> &mut Pressing<N> {
        &mut self.pressing
    }

    #[inline(always)]
    fn factor<S: pulp::Simd>(&mut self, _: S) {
        self.factor_chain();
    }

    #[inline(always)]
    fn solve(&mut self) {
        self.solve_chain();
    }

    #[inline(always)]
    fn motion(&self) -> &[[f64; N]] {
        &self.motion
    }

    #[inline(always)]
    fn velocity(&self) -> &[f64] {
        &self.velocity
    }

    #[inline(always)]
    fn motions_of(&self, x: &[f64], out: &mut [[f64; N]]) {
        self.motions(x, out);
    }

    #[inline(always)]
    fn mobilities<S: pulp::Simd>(
        &self,
        _: S,
        freedom: impl FnMut(usize, f64),
        link: impl FnMut(usize, &Square<N>),
    ) {
        self.link_mobilities(freedom, link);
    }
}

/// The operator of one step, as a tree of single-DoF joints in series.
#[derive(Debug, Clone)]
pub(in crate::manipulator) struct Chain<const N: usize> {
    /// The freedoms that move link l relative to the previous one are `first[l]..first[l + 1]`.
    first: Vec<usize>,
    /// Motion of everything distal per unit of each freedom's velocity.
    pub axis: Vec<[f64; N]>,
    /// Inertia of each link.
    pub body: Vec<Square<N>>,
    /// Damping and stiffness of each freedom, dt d + dt^2 k.
    pub diagonal: Vec<f64>,
    /// Number of tendons that couple the joints.
    pub coupled: usize,
    /// Take-up of each tendon per unit of each freedom, and the weight of its rank-one stiffness.
    pub slope: [Vec<f64>; MAX_TENDONS],
    pub weight: [f64; MAX_TENDONS],
    pub(super) pressing: Pressing<N>,
    /// The factor: articulated inertia times axis, and 1 / (axis . bias + diagonal).
    bias: Vec<[f64; N]>,
    inverse: Vec<f64>,
    torque: Vec<f64>,
    response: [Vec<f64>; MAX_TENDONS],
    kernel: Kernel,
    /// The solution: velocities of the freedoms and motions of the links.
    pub(super) velocity: Vec<f64>,
    pub(super) motion: Vec<[f64; N]>,
}

impl<const N: usize> Chain<N> {
    /// Creates a chain; `first` holds the first freedom of each link, then the number of freedoms.
    pub fn new(first: Vec<usize>) -> Self {
        let links = first.len() - 1;
        let freedoms = first[links];
        let blank = || vec![0.0; freedoms];
        Self {
            axis: vec![[0.0; N]; freedoms],
            body: vec![[[0.0; N]; N]; links],
            diagonal: blank(),
            coupled: 0,
            slope: core::array::from_fn(|_| blank()),
            weight: [0.0; MAX_TENDONS],
            pressing: Pressing::new(links, freedoms),
            bias: vec![[0.0; N]; freedoms],
            inverse: blank(),
            torque: blank(),
            response: core::array::from_fn(|_| blank()),
            kernel: Kernel::NONE,
            velocity: blank(),
            motion: vec![[0.0; N]; links],
            first,
        }
    }

    #[inline(always)]
    fn freedoms_of(&self, link: usize) -> core::ops::Range<usize> {
        self.first[link]..self.first[link + 1]
    }

    /// Factors the operator with the contributions in `pressing`.
    #[inline(always)]
    pub(super) fn factor_chain(&mut self) {
        let mut inertia = [[0.0; N]; N];
        for link in (0..self.body.len()).rev() {
            let (own, added) = (&self.body[link], &self.pressing.link[link]);
            for i in 0..N {
                for j in 0..N {
                    inertia[i][j] += own[i][j] + added[i][j];
                }
            }
            for k in self.freedoms_of(link).rev() {
                let bias = times(&inertia, &self.axis[k]);
                let diagonal = self.diagonal[k] + self.pressing.freedom[k];
                let inverse = 1.0 / (dot(&self.axis[k], &bias) + diagonal);
                add_outer(&mut inertia, -inverse, &bias);
                self.bias[k] = bias;
                self.inverse[k] = inverse;
            }
        }
        self.couple();
    }

    /// Computes the Woodbury kernel of the tendons for the present factor.
    #[inline(always)]
    fn couple(&mut self) {
        let none = [0.0; N];
        let mut s = [[0.0; MAX_TENDONS]; MAX_TENDONS];
        for t in 0..self.coupled {
            for k in (0..self.axis.len()).rev() {
                self.torque[k] = self.slope[t][k];
            }
            self.sweep_inward(|_| none);
            self.sweep_outward();
            self.response[t].copy_from_slice(&self.velocity);
            for i in 0..=t {
                s[i][t] = self.slope[i].iter().zip(&self.response[t]).map(|(g, z)| g * z).sum();
            }
        }
        if self.coupled > 0 {
            self.kernel = Kernel::new(self.coupled, &self.weight, &s);
        }
    }

    /// Solves for the velocities under the impulses in `pressing`.
    #[inline(always)]
    pub(super) fn solve_chain(&mut self) {
        self.torque.copy_from_slice(&self.pressing.freedom_impulse);
        let impulse = core::mem::take(&mut self.pressing.link_impulse);
        self.sweep_inward(|link| impulse[link]);
        self.pressing.link_impulse = impulse;
        self.sweep_outward();
        if self.coupled > 0 {
            let p: [f64; MAX_TENDONS] = core::array::from_fn(|t| {
                if t < self.coupled {
                    self.slope[t].iter().zip(&self.velocity).map(|(g, x)| g * x).sum()
                } else {
                    0.0
                }
            });
            let w = self.kernel.weigh(&p);
            for (response, w) in self.response[..self.coupled].iter().zip(w) {
                for (x, z) in self.velocity.iter_mut().zip(response) {
                    *x -= w * z;
                }
            }
            self.move_links();
        }
    }

    /// Eliminates the freedoms from tip to base: converts the impulses in `torque` to those of the factored
    /// joints.
    #[inline(always)]
    fn sweep_inward(&mut self, impulse: impl Fn(usize) -> [f64; N]) {
        let mut sum = [0.0; N];
        for link in (0..self.body.len()).rev() {
            add_scaled(&mut sum, 1.0, &impulse(link));
            for k in self.freedoms_of(link).rev() {
                let t = (self.torque[k] + dot(&self.axis[k], &sum)) * self.inverse[k];
                add_scaled(&mut sum, -t, &self.bias[k]);
                self.torque[k] = t;
            }
        }
    }

    /// Computes the velocities from base to tip.
    #[inline(always)]
    fn sweep_outward(&mut self) {
        let mut v = [0.0; N];
        for link in 0..self.body.len() {
            for k in self.freedoms_of(link) {
                let x = self.torque[k] - dot(&self.bias[k], &v) * self.inverse[k];
                add_scaled(&mut v, x, &self.axis[k]);
                self.velocity[k] = x;
            }
            self.motion[link] = v;
        }
    }

    /// Updates `motion` for the present `velocity`.
    #[inline(always)]
    fn move_links(&mut self) {
        let mut motion = core::mem::take(&mut self.motion);
        self.motions(&self.velocity, &mut motion);
        self.motion = motion;
    }

    /// Computes the motions of the links at velocities `x` of the freedoms.
    #[inline(always)]
    pub(super) fn motions(&self, x: &[f64], out: &mut [[f64; N]]) {
        let mut v = [0.0; N];
        for (link, out) in out.iter_mut().enumerate() {
            for k in self.freedoms_of(link) {
                add_scaled(&mut v, x[k], &self.axis[k]);
            }
            *out = v;
        }
    }

    /// Calls `link` with the mobility of each link to a force on itself and `freedom` with that of each
    /// freedom to its own torque, base to tip, for the present factor (Kreutz-Delgado, Jain and Rodriguez
    /// 1992). Ignores the tendons' coupling, which only stiffens.
    #[inline(always)]
    pub(super) fn link_mobilities(
        &self,
        mut freedom: impl FnMut(usize, f64),
        mut link: impl FnMut(usize, &Square<N>),
    ) {
        let mut m = [[0.0; N]; N];
        for l in 0..self.body.len() {
            for k in self.freedoms_of(l) {
                // P' W P + s s'/d with P = 1 - u s'/d  =  W - (w s' + s w')/d + s s' (u.w/d^2 + 1/d),  w = W
                // u.
                let (s, u, inverse) = (&self.axis[k], &self.bias[k], self.inverse[k]);
                let w = times(&m, u);
                let scale = (dot(u, &w) * inverse + 1.0) * inverse;
                freedom(k, scale);
                for i in 0..N {
                    let (a, b) = (scale * s[i] - inverse * w[i], inverse * s[i]);
                    for j in 0..N {
                        m[i][j] += a * s[j] - b * w[j];
                    }
                }
            }
            link(l, &m);
        }
    }
}
