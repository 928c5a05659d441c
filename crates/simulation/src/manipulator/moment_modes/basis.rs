//! Moment modes: shapes of the bending moment along the tool, and the resulting flexure angles.
//!
//! Mode m is a bending moment that varies along the tool as a polynomial of degree m. Flexure i, at `xi` from
//! -1 (first flexure) to 1 (burr), of stiffness `k_i`, bends by its moment over its stiffness:
//!
//! `q_i - rest_i = (sum over m of c_m p_m(xi_i)) / k_i`
//!
//! The polynomials are Legendre polynomials, orthonormalised under the compliance weight, `sum over i of
//! p_m(xi_i) p_n(xi_i) / k_i = delta_mn`, by Gram-Schmidt. The elastic energy is then `1/2 |c|^2`: the
//! stiffness of every mode is 1, and c is in sqrt(J). Moments vary smoothly along a loaded tool even where
//! its stiffness does not, so a few modes approximate all flexures well. This is the geometric variable
//! strain approach of Boyer et al. (2021, IEEE Trans. Robotics 37(3), 847), with moments instead of strains.

use super::MOUNT;
use crate::manipulator::MAX_JOINTS;
use crate::manipulator::parameters::ManipulatorParameters;

/// Angles of the flexures per unit of each freedom. N is the number of freedoms including the mount's; the
/// last ones may be unused.
#[derive(Debug, Clone)]
pub(super) struct Basis<const N: usize> {
    /// Number of modes.
    pub modes: usize,
    /// One row per flexure, rad/sqrt(J); the entries of mount and unused freedoms are 0.
    pub of_flexure: [[f64; N]; MAX_JOINTS],
    /// Transpose, one row per freedom, so that loops over the flexures access contiguous memory.
    of_freedom: [[f64; MAX_JOINTS]; N],
}

impl<const N: usize> Basis<N> {
    /// Creates the modes of a tool, at most one per flexure. `parameters` must be valid and have at most
    /// [`MAX_JOINTS`] flexures.
    pub fn new(parameters: &ManipulatorParameters) -> Self {
        let moments = moments(parameters);
        let (mut of_flexure, mut of_freedom) = ([[0.0; N]; MAX_JOINTS], [[0.0; MAX_JOINTS]; N]);
        for (m, moment) in moments.iter().enumerate() {
            for (i, (value, k)) in moment.iter().zip(&parameters.joint_stiffness_nm_per_rad).enumerate() {
                of_flexure[i][MOUNT + m] = value / k;
                of_freedom[MOUNT + m][i] = value / k;
            }
        }
        Self { modes: moments.len(), of_flexure, of_freedom }
    }

    /// Returns the angles from rest (rad), or rates (rad/s), of the flexures for amplitudes or velocities
    /// `x`; 0 past the last flexure.
    #[inline(always)]
    pub fn angles(&self, x: &[f64; N]) -> [f64; MAX_JOINTS] {
        let mut out = [0.0; MAX_JOINTS];
        for (scale, row) in x.iter().zip(&self.of_freedom).skip(MOUNT) {
            for (angle, value) in out.iter_mut().zip(row) {
                *angle += scale * value;
            }
        }
        out
    }

    /// Returns the generalised forces of torques on the flexures, N m; 0 for the mount.
    #[inline(always)]
    pub fn project(&self, torque: &[f64; MAX_JOINTS]) -> [f64; N] {
        let mut out = [0.0; N];
        for (torque, row) in torque.iter().zip(&self.of_flexure) {
            for (sum, value) in out.iter_mut().zip(row) {
                *sum += torque * value;
            }
        }
        out
    }
}

/// Returns the orthonormal moments at the flexures, one row per mode, N m/sqrt(J).
fn moments(p: &ManipulatorParameters) -> Vec<Vec<f64>> {
    let z = &p.joint_positions_m;
    let (first, last) = (z.first().copied().unwrap_or(0.0), p.burr_centre_m());
    let xi: Vec<f64> = z.iter().map(|z| 2.0 * (z - first) / (last - first) - 1.0).collect();
    let product = |a: &[f64], b: &[f64]| -> f64 {
        a.iter().zip(b).zip(&p.joint_stiffness_nm_per_rad).map(|((a, b), k)| a * b / k).sum()
    };
    let mut modes: Vec<Vec<f64>> = Vec::new();
    for degree in 0..p.moment_modes.min(z.len()) {
        let mut mode: Vec<f64> = xi.iter().map(|x| legendre(degree, *x)).collect();
        // Orthogonalise twice: the second pass removes the rounding of the first.
        for _ in 0..2 {
            for earlier in &modes {
                let share = product(&mode, earlier);
                mode.iter_mut().zip(earlier).for_each(|(value, e)| *value -= share * e);
            }
        }
        let scale = 1.0 / libm::sqrt(product(&mode, &mode));
        mode.iter_mut().for_each(|value| *value *= scale);
        modes.push(mode);
    }
    modes
}

/// Returns the Legendre polynomial of this degree, by Bonnet's recursion.
fn legendre(degree: usize, x: f64) -> f64 {
    let (mut before, mut value) = (0.0, 1.0);
    for n in 0..degree {
        let n = n as f64;
        (before, value) = (value, ((2.0 * n + 1.0) * x * value - n * before) / (n + 1.0));
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modes_are_orthonormal_under_the_compliance_and_reach_every_low_polynomial() {
        let p = ManipulatorParameters { moment_modes: 8, ..ManipulatorParameters::jhu_27() };
        let found = moments(&p);
        let k = &p.joint_stiffness_nm_per_rad;
        let product = |a: &[f64], b: &[f64]| -> f64 { (0..27).map(|i| a[i] * b[i] / k[i]).sum() };
        for (m, a) in found.iter().enumerate() {
            for (n, b) in found.iter().enumerate() {
                let expected = f64::from(u8::from(m == n));
                assert!((product(a, b) - expected).abs() < 1e-12, "{m} {n}: {}", product(a, b));
            }
        }
        // z^7 is a sum of the eight modes.
        let cube: Vec<f64> = p.joint_positions_m.iter().map(|z| libm::pow(z / 0.05, 7.0)).collect();
        let mut left = cube.clone();
        for mode in &found {
            let share = product(&cube, mode);
            left.iter_mut().zip(mode).for_each(|(value, m)| *value -= share * m);
        }
        let size = |x: &[f64]| libm::sqrt(product(x, x));
        assert!(size(&left) < 1e-10 * size(&cube), "{}", size(&left) / size(&cube));
    }

    #[test]
    fn a_tool_of_few_flexures_has_as_many_modes() {
        let p = ManipulatorParameters::uniform_beam(3, 0.05, 0.01);
        assert_eq!(Basis::<8>::new(&p).modes, 3);
    }
}
