//! The elastica under a dead force perpendicular to its undeformed axis at the tip.

/// Steps of the integration.
const STEPS: usize = 4000;

/// Tip (across, along) over the length for `load` = P L² / EI: theta'' = -load cos theta, theta(0) = 0,
/// theta'(1) = 0, by shooting on theta'(0) with the classical Runge-Kutta method.
pub fn elastica(load: f64) -> [f64; 2] {
    let (mut low, mut high) = (0.0, load);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if shoot(load, middle)[1] > 0.0 { high = middle } else { low = middle }
    }
    let end = shoot(load, 0.5 * (low + high));
    [end[2], end[3]]
}

fn shoot(load: f64, curvature: f64) -> [f64; 4] {
    let h = 1.0 / STEPS as f64;
    let rate = |y: [f64; 4]| [y[1], -load * y[0].cos(), y[0].sin(), y[0].cos()];
    let add = |y: [f64; 4], s: f64, k: [f64; 4]| [0, 1, 2, 3].map(|i| y[i] + s * k[i]);
    let mut y = [0.0, curvature, 0.0, 0.0];
    for _ in 0..STEPS {
        let k1 = rate(y);
        let k2 = rate(add(y, 0.5 * h, k1));
        let k3 = rate(add(y, 0.5 * h, k2));
        let k4 = rate(add(y, h, k3));
        y = [0, 1, 2, 3].map(|i| y[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]));
    }
    y
}

#[cfg(test)]
mod tests {
    use super::elastica;

    #[test]
    fn elastica_is_mattiassons() {
        // Mattiasson 1981 (Int. J. Numer. Methods Eng. 17): lateral and shortening over L, five digits.
        for (load, lateral, shortening) in
            [(1.0, 0.30172, 0.05643), (5.0, 0.71379, 0.38763), (10.0, 0.81061, 0.55500)]
        {
            let [x, z] = elastica(load);
            assert!((x - lateral).abs() < 6e-6 && (1.0 - z - shortening).abs() < 6e-6, "{load}: {x} {z}");
        }
    }
}
