//! The patch of an obstacle being cut: all its contacts recede within the step at one common speed, which
//! depends on the sum of their forces.
//!
//! With P the sum of the normal impulses of the contacts that recede, the patch's speed is `back = slope (P -
//! from)`, at least 0 and at most `most`. It is a degree of freedom without inertia, which is eliminated: for
//! given speeds of the contacts it is the root of a decreasing function, and in a Newton step its equation is
//! linear and local to the link, because all those contacts are on one link.

use super::chain::{Square, add_outer, add_scaled, dot};
use super::laws::ContactRow;
use crate::contact_plane::RecessionLaw;

/// Maximum iterations toward the root; each leaves fewer pressing contacts.
const ROOT_STEPS: usize = 32;

/// Recession law of the receding contacts.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(in crate::manipulator) struct Patch {
    /// Sum of normal impulses below which nothing recedes, N s.
    pub from: f64,
    /// Recession speed per impulse, m/s per N s; 0 if nothing recedes.
    pub slope: f64,
    /// Maximum recession speed, m/s.
    pub most: f64,
}

/// The patch's equation in a Newton step: `back = (offset - along . motion) / weight` of the link.
#[derive(Debug, Clone, Copy)]
pub(super) enum BackLaw<const N: usize> {
    /// A fixed speed, m/s.
    Fixed(f64),
    Free {
        link: usize,
        offset: f64,
        along: [f64; N],
        weight: f64,
    },
}

impl Patch {
    /// Creates the law for a step of `dt` s.
    pub fn new(give: &RecessionLaw, dt: f64) -> Patch {
        Patch { from: give.from_n * dt, slope: give.m_per_n / (dt * dt), most: give.most_m / dt }
    }

    /// Returns the recession speed under a sum of impulses.
    #[inline(always)]
    fn speed(&self, sum: f64) -> f64 {
        (self.slope * (sum - self.from)).max(0.0).min(self.most)
    }

    /// Returns the recession speed under the rows' present impulses.
    #[inline(always)]
    pub(super) fn carried<const N: usize>(&self, rows: &[ContactRow<N>]) -> f64 {
        if self.slope == 0.0 {
            return 0.0;
        }
        self.speed(rows.iter().filter(|row| row.recedes).map(|row| row.impulse[0]).sum())
    }

    /// Returns the recession speed at which the laws of the rows and of the patch hold simultaneously, with
    /// each row at its speed plus the fraction `t` of its step. Uses Newton's method: the sum of the impulses
    /// is decreasing and convex in the speed, so each iterate approaches the root from below.
    #[inline(always)]
    pub(super) fn root<const N: usize>(&self, rows: &[ContactRow<N>], t: f64) -> f64 {
        if self.slope == 0.0 {
            return 0.0;
        }
        let mut back = 0.0;
        for _ in 0..ROOT_STEPS {
            let (mut sum, mut weight) = (0.0, 1.0 / self.slope);
            for row in rows.iter().filter(|row| row.recedes) {
                let normal = row.normal_law(row.speed[0] + t * (row.next_speed[0] - row.speed[0]), back);
                sum += normal;
                weight += if normal > 0.0 && normal < row.strength { 1.0 / row.compliance } else { 0.0 };
            }
            let left = sum - self.from - back / self.slope;
            let next = (back + left / weight).max(0.0).min(self.most);
            if (next - back).abs() <= 1e-12 * next {
                return next;
            }
            back = next;
        }
        back
    }

    /// Eliminates the patch from a Newton step, with the rows' tangents at the speed `back`: adds its
    /// contribution to the link's matrix and impulse.
    #[inline(always)]
    pub(super) fn eliminate<const N: usize>(
        &self,
        rows: &[ContactRow<N>],
        back: f64,
        (link_matrix, link_impulse): (&mut [Square<N>], &mut [[f64; N]]),
    ) -> BackLaw<N> {
        let mut receding = rows.iter().filter(|row| row.recedes);
        let Some(link) = receding.clone().map(|row| row.link).next().filter(|_| back > 0.0) else {
            return BackLaw::Fixed(0.0);
        };
        let (mut along, mut offset, mut weight) = ([0.0; N], -self.from, 1.0 / self.slope);
        for row in receding.by_ref() {
            let w = row.tangent.normal;
            add_scaled(&mut along, w, &row.force[0]);
            offset += row.tangent.offset[0] - w * row.drive[0];
            weight += w;
        }
        if back >= self.most {
            add_scaled(&mut link_impulse[link], -self.most, &along);
            return BackLaw::Fixed(self.most);
        }
        add_outer(&mut link_matrix[link], -1.0 / weight, &along);
        add_scaled(&mut link_impulse[link], -offset / weight, &along);
        BackLaw::Free { link, offset, along, weight }
    }
}

impl<const N: usize> BackLaw<N> {
    /// Returns the recession speed at these motions of the links.
    #[inline(always)]
    pub(super) fn at(&self, motion: &[[f64; N]]) -> f64 {
        match self {
            BackLaw::Fixed(back) => *back,
            BackLaw::Free { link, offset, along, weight } => (offset - dot(along, &motion[*link])) / weight,
        }
    }
}
