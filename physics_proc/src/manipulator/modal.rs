//! First bending mode of the straight tool on a rigid mount.

use super::MAX_JOINTS;
use super::geometry::Layout;

/// Angular frequency of the first mode, rad/s: inverse iteration on `K x = omega^2 M x`.
pub(super) fn first_frequency_rad_per_s(layout: &Layout, stiffness: &[f64; MAX_JOINTS]) -> f64 {
    let n = layout.joints;
    let mass = mass_matrix(layout);
    let mut x = [1.0; MAX_JOINTS];
    let mut squared = 0.0;
    for _ in 0..200 {
        let mut momentum = [0.0; MAX_JOINTS];
        for i in 0..n {
            momentum[i] = (0..n).map(|j| mass[i][j] * x[j]).sum();
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
        x[..n].iter_mut().for_each(|value| *value *= scale);
    }
    libm::sqrt(squared)
}

/// Joint-space mass matrix of the straight tool.
fn mass_matrix(layout: &Layout) -> [[f64; MAX_JOINTS]; MAX_JOINTS] {
    let n = layout.joints;
    let mut z = [0.0; MAX_JOINTS];
    let mut position = layout.first_joint_m;
    for i in 0..n {
        z[i] = position;
        position += layout.length_m[i];
    }
    let mut mass = [[0.0; MAX_JOINTS]; MAX_JOINTS];
    for link in 0..n {
        let body = &layout.body[link + 1];
        let centre = z[link] + body.centre_m;
        for i in 0..=link {
            for j in 0..=link {
                mass[i][j] += body.inertia_kg_m2 + body.mass_kg * (centre - z[i]) * (centre - z[j]);
            }
        }
    }
    mass
}
