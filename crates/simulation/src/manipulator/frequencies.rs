//! Bending modes of the straight tool on a rigid mount, its buckling load, and the tension at which its
//! flexures reach their stops.

use nalgebra::{DMatrix, SymmetricEigen};

use super::geometry::{LinkBody, link_bodies, link_lengths_m};
use super::parameters::ManipulatorParameters;

impl ManipulatorParameters {
    /// Returns the frequencies of the lowest bending modes, Hz, ascending, at most one per flexure: solutions
    /// of `K x = omega^2 M x`, as the eigenvalues `1 / omega^2` of `K^-1/2 M K^-1/2`.
    pub fn bending_frequencies_hz(&self, count: usize) -> Vec<f64> {
        let length_m = link_lengths_m(self);
        let first_joint_m = self.joint_positions_m.first().copied().unwrap_or(0.0);
        let (n, mass) =
            (length_m.len(), mass_matrix(first_joint_m, &length_m, &link_bodies(self, &length_m)));
        let root = |i: usize| libm::sqrt(self.joint_stiffness_nm_per_rad[i]);
        let scaled = DMatrix::from_fn(n, n, |i, j| mass[i * n + j] / (root(i) * root(j)));
        let mut squared_s: Vec<f64> = SymmetricEigen::new(scaled).eigenvalues.iter().copied().collect();
        squared_s.sort_by(|a, b| b.total_cmp(a));
        let hz = |squared_s: f64| 1.0 / (core::f64::consts::TAU * libm::sqrt(squared_s));
        squared_s.into_iter().take(count).map(hz).collect()
    }

    /// Returns the angular frequency of the first mode on a rigid mount, rad/s, by inverse iteration on `K x
    /// = omega^2 M x`.
    pub(super) fn first_frequency_rad_per_s(&self) -> f64 {
        let (stiffness, length_m) = (&self.joint_stiffness_nm_per_rad, link_lengths_m(self));
        let n = length_m.len();
        let mass = mass_matrix(self.joint_positions_m[0], &length_m, &link_bodies(self, &length_m));
        let mut x = vec![1.0; n];
        let mut momentum = vec![0.0; n];
        let mut squared = 0.0;
        for _ in 0..200 {
            for i in 0..n {
                momentum[i] = (0..n).map(|j| mass[i * n + j] * x[j]).sum();
            }
            let kinetic: f64 = (0..n).map(|i| x[i] * momentum[i]).sum();
            let potential: f64 = (0..n).map(|i| x[i] * stiffness[i] * x[i]).sum();
            squared = potential / kinetic;
            let mut norm = 0.0;
            for i in 0..n {
                x[i] = momentum[i] / stiffness[i];
                norm += x[i] * x[i];
            }
            let scale = 1.0 / libm::sqrt(norm);
            x.iter_mut().for_each(|value| *value *= scale);
        }
        libm::sqrt(squared)
    }

    /// Returns the smallest tension of a single tendon that bends a flexure to its stop, at rest in free
    /// space and without friction, N: the flexure's stiffness times the stop angle over the tendon's lever
    /// arm, `k q = T (d cos(q/2) + g/2 sin(q/2))`. `None` without tendons.
    pub fn first_stop_n(&self) -> Option<f64> {
        let (sin, cos) = libm::sincos(0.5 * self.joint_limit_rad);
        let softest = self.joint_stiffness_nm_per_rad.iter().copied().fold(f64::INFINITY, f64::min);
        let routes = self.tendon_routes.iter().flatten().map(|route| route.channel_m[0].abs());
        let pair = self.tendon_routes.is_none().then_some(self.tendon.offset_m.abs());
        let offset_m = routes.chain(pair).fold(0.0, f64::max);
        let lever_m = offset_m * cos + 0.5 * self.tendon.gap_m * sin;
        (lever_m > 0.0).then_some(softest * self.joint_limit_rad / lever_m)
    }

    /// Returns Euler's buckling load of the tool clamped at its base, N: the axial load at the burr whose
    /// moments, `P (x_tip - x_i)`, equal those of the flexures of the straight tool. Uses power iteration.
    pub fn euler_load_n(&self) -> f64 {
        let length_m = link_lengths_m(self);
        let (mut shape, mut load_n) = (vec![1.0; length_m.len()], 0.0);
        for _ in 0..200 {
            let mut across = vec![0.0];
            let mut angle = 0.0;
            for (i, q) in shape.iter().enumerate() {
                angle += q;
                across.push(across[i] + angle * length_m[i]);
            }
            let tip = across[shape.len()];
            let stiffness = &self.joint_stiffness_nm_per_rad;
            let next: Vec<f64> = stiffness.iter().zip(&across).map(|(k, x)| (tip - x) / k).collect();
            let (before, after) = (shape.iter().sum::<f64>(), next.iter().sum::<f64>());
            load_n = before / after;
            shape = next.iter().map(|q| q * load_n).collect();
        }
        load_n
    }
}

/// Returns the joint-space mass matrix of the straight tool, row-major.
fn mass_matrix(first_joint_m: f64, length_m: &[f64], body: &[LinkBody]) -> Vec<f64> {
    let n = length_m.len();
    let mut z = vec![0.0; n];
    let mut position = first_joint_m;
    for i in 0..n {
        z[i] = position;
        position += length_m[i];
    }
    let mut mass = vec![0.0; n * n];
    for link in 0..n {
        let body = &body[link + 1];
        let centre = z[link] + body.centre_m;
        for i in 0..=link {
            for j in 0..=link {
                mass[i * n + j] += body.inertia_kg_m2 + body.mass_kg * (centre - z[i]) * (centre - z[j]);
            }
        }
    }
    mass
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Closed forms of a uniform cantilever: `omega = beta^2 sqrt(E I / (m L^4))` with beta L = 1.8751,
    /// 4.6941, 7.8548 (Blevins 1979, table 8-1), and `P = pi^2 E I / (4 L^2)`.
    #[test]
    fn a_uniform_beam_swings_and_buckles_as_in_its_closed_forms() {
        let (length_m, rigidity_nm2) = (0.1, 0.02);
        let beam = ManipulatorParameters {
            tube_radii_m: [1e-4, 0.0],
            ..ManipulatorParameters::uniform_beam(60, length_m, rigidity_nm2)
        };
        let scale = libm::sqrt(rigidity_nm2 / beam.linear_density_kg_per_m) / (length_m * length_m);
        let found = beam.bending_frequencies_hz(3);
        for (hz, beta) in found.iter().zip([1.875_104, 4.694_091, 7.854_757]) {
            let closed_hz = beta * beta * scale / core::f64::consts::TAU;
            println!("{hz:.3} Hz, closed form {closed_hz:.3}");
            // With 60 links, the error is the squared ratio of a link to a quarter wave.
            assert!((hz / closed_hz - 1.0).abs() < 5e-3, "{hz} {closed_hz}");
        }
        let closed_n = core::f64::consts::PI.powi(2) * rigidity_nm2 / (4.0 * length_m * length_m);
        println!("{:.4} N, closed form {closed_n:.4}", beam.euler_load_n());
        assert!((beam.euler_load_n() / closed_n - 1.0).abs() < 1e-3);
        let standard = ManipulatorParameters::jhu_27();
        let first = standard.first_frequency_rad_per_s();
        let own = standard.bending_frequencies_hz(1)[0] * core::f64::consts::TAU;
        assert!((own / first - 1.0).abs() < 1e-9, "{own} {first}");
    }
}
