//! Dense operator for a tool of a few freedoms, treated as one body: the implicit operator is a dense matrix,
//! and a contact's force a vector over the freedoms.

use super::chain::{Operator, Pressing, Square};

/// Returns the vectors of a row of numbers; N is a multiple of their length.
#[inline(always)]
pub(in crate::manipulator) fn lanes<S: pulp::Simd>(row: &[f64]) -> &[S::f64s] {
    S::as_simd_f64s(row).0
}

#[inline(always)]
pub(in crate::manipulator) fn lanes_mut<S: pulp::Simd>(row: &mut [f64]) -> &mut [S::f64s] {
    S::as_mut_simd_f64s(row).0
}

/// A symmetric, positive definite matrix, factored as `U' D^-1 U` with D the diagonal of the upper triangle
/// U. N is 8 or 16.
#[derive(Debug, Clone)]
pub(in crate::manipulator) struct Factor<const N: usize> {
    /// The matrix to factor, then U and, below it, the remainders of the elimination.
    pub upper: Square<N>,
    /// 1 / D.
    inverse: [f64; N],
}

impl<const N: usize> Factor<N> {
    pub fn new() -> Self {
        Self { upper: [[0.0; N]; N], inverse: [0.0; N] }
    }

    /// Returns the factors of a matrix; `None` if it is not positive definite.
    pub fn of(matrix: &Square<N>) -> Option<Self> {
        let mut factor = Self { upper: *matrix, inverse: [0.0; N] };
        factor.factor(pulp::Scalar::new());
        factor.inverse.iter().all(|inverse| inverse.is_finite() && *inverse > 0.0).then_some(factor)
    }

    /// Factors the matrix in `upper` by elimination, whole rows at a time.
    #[inline(always)]
    pub fn factor<S: pulp::Simd>(&mut self, simd: S) {
        for k in 0..N {
            let (above, below) = self.upper.split_at_mut(k + 1);
            let pivot = &above[k];
            let inverse = 1.0 / pivot[k];
            self.inverse[k] = inverse;
            for (i, row) in (k + 1..N).zip(below) {
                subtract(simd, row, pivot[i] * inverse, pivot);
            }
        }
    }

    /// Returns A^-1 b.
    #[inline(always)]
    pub fn solve(&self, b: &[f64; N]) -> [f64; N] {
        let mut x = *b;
        for k in 0..N {
            let scale = x[k] * self.inverse[k];
            for j in k + 1..N {
                x[j] -= scale * self.upper[k][j];
            }
        }
        for k in (0..N).rev() {
            let mut rest = x[k];
            for j in k + 1..N {
                rest -= self.upper[k][j] * x[j];
            }
            x[k] = rest * self.inverse[k];
        }
        x
    }

    /// Returns the inverse: all its columns solved for side by side.
    #[inline(always)]
    fn inverse<S: pulp::Simd>(&self, simd: S) -> Square<N> {
        let mut x = [[0.0; N]; N];
        for k in 0..N {
            x[k][k] = 1.0;
        }
        for k in 0..N {
            let (above, below) = x.split_at_mut(k + 1);
            for (j, row) in (k + 1..N).zip(below) {
                subtract(simd, row, self.upper[k][j] * self.inverse[k], &above[k]);
            }
        }
        for k in (0..N).rev() {
            let (above, below) = x.split_at_mut(k + 1);
            for (j, row) in (k + 1..N).zip(&*below) {
                subtract(simd, &mut above[k], self.upper[k][j], row);
            }
            let scale = simd.splat_f64s(self.inverse[k]);
            for entry in lanes_mut::<S>(&mut above[k]) {
                *entry = simd.mul_f64s(scale, *entry);
            }
        }
        x
    }
}

/// Subtracts scale b from a.
#[inline(always)]
fn subtract<S: pulp::Simd, const N: usize>(simd: S, a: &mut [f64; N], scale: f64, b: &[f64; N]) {
    let scale = simd.splat_f64s(scale);
    for (a, b) in lanes_mut::<S>(a).iter_mut().zip(lanes::<S>(b)) {
        *a = simd.sub_f64s(*a, simd.mul_f64s(scale, *b));
    }
}

/// The operator as one matrix over the freedoms.
#[derive(Debug, Clone)]
pub(in crate::manipulator) struct Dense<const N: usize> {
    /// The operator without contacts.
    pub matrix: Square<N>,
    pressing: Pressing<N>,
    factor: Factor<N>,
    /// Motion of the only body: the velocities of the freedoms.
    motion: [[f64; N]; 1],
}

impl<const N: usize> Dense<N> {
    pub fn new() -> Self {
        Self {
            matrix: [[0.0; N]; N],
            pressing: Pressing::new(1, 0),
            factor: Factor::new(),
            motion: [[0.0; N]],
        }
    }
}

impl<const N: usize> Operator<N> for Dense<N> {
    #[inline(always)]
    fn pressing(&mut self) -> &mut Pressing<N> {
        &mut self.pressing
    }

    #[inline(always)]
    fn factor<S: pulp::Simd>(&mut self, simd: S) {
        for ((out, own), added) in self.factor.upper.iter_mut().zip(&self.matrix).zip(&self.pressing.link[0])
        {
            for ((out, own), added) in
                lanes_mut::<S>(out).iter_mut().zip(lanes::<S>(own)).zip(lanes::<S>(added))
            {
                *out = simd.add_f64s(*own, *added);
            }
        }
        self.factor.factor(simd);
    }

    #[inline(always)]
    fn solve(&mut self) {
        self.motion[0] = self.factor.solve(&self.pressing.link_impulse[0]);
    }

    #[inline(always)]
    fn motion(&self) -> &[[f64; N]] {
        &self.motion
    }

    #[inline(always)]
    fn velocity(&self) -> &[f64] {
        &self.motion[0]
    }

    #[inline(always)]
    fn motions_of(&self, x: &[f64], out: &mut [[f64; N]]) {
        out[0].copy_from_slice(x);
    }

    #[inline(always)]
    fn mobilities<S: pulp::Simd>(
        &self,
        simd: S,
        _: impl FnMut(usize, f64),
        mut link: impl FnMut(usize, &Square<N>),
    ) {
        link(0, &self.factor.inverse(simd));
    }
}
