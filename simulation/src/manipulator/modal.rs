//! First bending mode of the straight tool on a rigid mount.

use super::geometry::LinkBody;

/// Angular frequency of the first mode, rad/s, by inverse iteration on `K x = omega^2 M x`. `length_m` and `stiffness` have one entry per
/// flexure; `body` has the shaft, then one per flexure.
pub(super) fn first_frequency_rad_per_s(
    first_joint_m: f64,
    length_m: &[f64],
    body: &[LinkBody],
    stiffness: &[f64],
) -> f64 {
    let n = length_m.len();
    let mass = mass_matrix(first_joint_m, length_m, body);
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

/// Joint-space mass matrix of the straight tool, row-major.
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
