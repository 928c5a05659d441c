//! 3D vectors as arrays.

/// Dot product.
pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Length.
pub fn length(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

/// `a + s b`.
pub fn plus(a: [f64; 3], s: f64, b: [f64; 3]) -> [f64; 3] {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

/// `a - b`.
pub fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    plus(a, -1.0, b)
}

/// The same direction with length 1.
pub fn unit(a: [f64; 3]) -> [f64; 3] {
    let length = length(a);
    a.map(|x| x / length)
}

/// The part of `a` perpendicular to a unit vector.
pub fn across(a: [f64; 3], unit: [f64; 3]) -> [f64; 3] {
    plus(a, -dot(a, unit), unit)
}

/// The cross product.
pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    core::array::from_fn(|i| {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        a[j] * b[k] - a[k] * b[j]
    })
}
