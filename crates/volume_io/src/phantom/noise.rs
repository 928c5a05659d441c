//! Value noise on a lattice of integer hashes: stateless and identical on every machine.

/// A 64-bit finaliser (SplitMix64: Steele, Lea, Flood, OOPSLA 2014; constants of its reference
/// implementation).
fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// The value at a lattice point, uniform in [−1, 1).
fn lattice(seed: u64, i: i64, j: i64, k: i64) -> f64 {
    let step = 0x9e37_79b9_7f4a_7c15_u64;
    let x = mix(seed ^ (i as u64).wrapping_mul(step));
    let y = mix(x ^ (j as u64).wrapping_mul(step));
    let z = mix(y ^ (k as u64).wrapping_mul(step));
    // The top 53 bits are exact in an f64.
    (z >> 11) as f64 * (2.0 / (1_u64 << 53) as f64) - 1.0
}

/// Smooth noise in [−1, 1]: lattice values at integer coordinates, blended with the cubic 3t² − 2t³ along
/// each axis.
pub fn value_noise(seed: u64, p: [f64; 3]) -> f64 {
    // floor() by way of an integer: exact, and a few instructions instead of a function call.
    let base = p.map(|x| {
        let toward_zero = x as i64 as f64;
        if x < toward_zero { toward_zero - 1.0 } else { toward_zero }
    });
    let fade = [0, 1, 2].map(|axis| {
        let t = p[axis] - base[axis];
        t * t * (3.0 - 2.0 * t)
    });
    let [i, j, k] = base.map(|b| b as i64);
    let blend = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let row = |j: i64, k: i64| blend(lattice(seed, i, j, k), lattice(seed, i + 1, j, k), fade[0]);
    let plane = |k: i64| blend(row(j, k), row(j + 1, k), fade[1]);
    blend(plane(k), plane(k + 1), fade[2])
}
