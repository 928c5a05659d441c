//! Branch-free exp, log and normal deviates, so that loops over pixels vectorise. They use only +, -, *, /,
//! sqrt and integer operations in a fixed order, so every instruction set gives the same bits.

/// 1.5 * 2^52: adding it rounds to the nearest integer, which is then in the low bits.
const MAGIC: f64 = 6_755_399_441_055_744.0;
/// ln 2 in two parts; the first ends in 32 zero bits, so that its product with an exponent is exact.
const LN2_HIGH: f64 = f64::from_bits(0x3FE6_2E42_FEE0_0000);
const LN2_LOW: f64 = 1.908_214_929_270_587_7e-10;
/// Bits of sqrt(1/2).
const ROOT_HALF: u64 = 0x3FE6_A09E_667F_3BCD;

/// e^x with x clamped to -700..=700; relative error below 1e-15.
#[inline(always)]
pub fn exp(x: f64) -> f64 {
    let x = x.clamp(-700.0, 700.0);
    let shifted = x * core::f64::consts::LOG2_E + MAGIC;
    let k = shifted - MAGIC;
    let r = x - k * LN2_HIGH - k * LN2_LOW;
    // Taylor series; |r| <= ln(2)/2, so the truncation error is below 1.7e-16.
    let mut sum = 1.0 / 479_001_600.0;
    for divisor in [
        1.0 / 39_916_800.0,
        1.0 / 3_628_800.0,
        1.0 / 362_880.0,
        1.0 / 40_320.0,
        1.0 / 5_040.0,
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
        1.0,
        1.0,
    ] {
        sum = sum * r + divisor;
    }
    sum * f64::from_bits(shifted.to_bits().wrapping_add(1023) << 52)
}

/// Natural logarithm of a positive normal number; absolute error below 1e-15 near 1, relative error below
/// 1e-15 elsewhere.
#[inline(always)]
pub fn log(x: f64) -> f64 {
    let bits = x.to_bits();
    // x = 2^k m with m in sqrt(1/2)..sqrt(2).
    let above = bits.wrapping_sub(ROOT_HALF).wrapping_add(1023 << 52);
    let biased = above >> 52;
    let m = f64::from_bits(bits.wrapping_sub((biased << 52).wrapping_sub(1023 << 52)));
    let k = small_integer(biased) - 1023.0;
    let s = (m - 1.0) / (m + 1.0);
    let ss = s * s;
    // 2 artanh s; s^2 <= 0.0295, so the truncation error is below 1e-16.
    let mut sum = 1.0 / 19.0;
    for coefficient in
        [1.0 / 17.0, 1.0 / 15.0, 1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0]
    {
        sum = sum * ss + coefficient;
    }
    k * LN2_HIGH + (2.0 * s + (2.0 * s * ss * sum + k * LN2_LOW))
}

/// cos(2 pi (u - 1/2)) for u in 0..=1; absolute error below 1e-11.
#[inline(always)]
pub fn cos_turn(u: f64) -> f64 {
    let half = core::f64::consts::PI * (u - 0.5);
    let square = half * half;
    // Taylor series of the cosine of the half angle, up to the 16th power.
    let mut sum = 1.0 / 20_922_789_888_000.0;
    for coefficient in [
        -1.0 / 87_178_291_200.0,
        1.0 / 479_001_600.0,
        -1.0 / 3_628_800.0,
        1.0 / 40_320.0,
        -1.0 / 720.0,
        1.0 / 24.0,
        -0.5,
        1.0,
    ] {
        sum = sum * square + coefficient;
    }
    2.0 * sum * sum - 1.0
}

/// The two halves of a random word as numbers in the open interval (0, 1).
#[inline(always)]
pub fn uniforms(random: u64) -> (f64, f64) {
    let unit = |half: u64| (small_integer(half) + 0.5) * (1.0 / 4_294_967_296.0);
    (unit(random >> 32), unit(random & 0xFFFF_FFFF))
}

/// A standard normal deviate from a random word (Box and Muller 1958, "A note on the generation of random
/// normal deviates", Ann. Math. Stat. 29), at most 6.8 in magnitude.
#[inline(always)]
pub fn normal(random: u64) -> f64 {
    let (a, b) = uniforms(random);
    (-2.0 * log(a)).sqrt() * cos_turn(b)
}

/// The nearest integer, for |x| below 2^51.
#[inline(always)]
pub fn round(x: f64) -> f64 {
    (x + MAGIC) - MAGIC
}

/// An integer below 2^52 as a float, without a conversion that vector units lack.
#[inline(always)]
fn small_integer(i: u64) -> f64 {
    const TWO_52: f64 = 4_503_599_627_370_496.0;
    f64::from_bits(TWO_52.to_bits() | i) - TWO_52
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_and_log_agree_with_the_library_to_rounding() {
        let mut worst = [0.0_f64; 3];
        for i in 0..200_000 {
            let x = f64::from(i) * 7e-3 - 700.0;
            worst[0] = worst[0].max((exp(x) / libm::exp(x) - 1.0).abs());
            let y = libm::exp(x * 0.5);
            worst[1] = worst[1].max((log(y) - libm::log(y)).abs() / libm::log(y).abs().max(1.0));
            let u = f64::from(i) / 200_000.0;
            worst[2] = worst[2].max((cos_turn(u) - libm::cos(core::f64::consts::TAU * (u - 0.5))).abs());
        }
        println!("exp {:.1e}, log {:.1e}, cos {:.1e}", worst[0], worst[1], worst[2]);
        // A few units in the last place (2.2e-16); the cosine as stated above.
        assert!(worst[0] < 1e-15 && worst[1] < 1e-15 && worst[2] < 1e-11, "{worst:?}");
        assert_eq!((exp(0.0), log(1.0), exp(-1e9)), (1.0, 0.0, exp(-700.0)));
    }

    #[test]
    fn round_and_uniforms_are_what_they_say() {
        assert_eq!([2.4, 2.6, -0.4, 1e9 + 0.2].map(round), [2.0, 3.0, 0.0, 1e9]);
        assert_eq!(uniforms(0), (0.5 / 4_294_967_296.0, 0.5 / 4_294_967_296.0));
        assert_eq!(uniforms(u64::MAX).0, 1.0 - 0.5 / 4_294_967_296.0);
    }
}
