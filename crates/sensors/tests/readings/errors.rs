//! Noise, bias, drift, resolution and drop-outs against their laws.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests fail")]

use crate::common::{deviation, first, mean, read, scene};

/// Allan deviation at `m` samples, non-overlapping (Allan 1966, "Statistics of atomic frequency standards",
/// Proc. IEEE 54): the root of half the mean square of differences of successive means.
fn allan(x: &[f64], m: usize) -> f64 {
    let means: Vec<f64> = x.chunks_exact(m).map(mean).collect();
    let squares = means.windows(2).map(|pair| (pair[1] - pair[0]).powi(2));
    (squares.sum::<f64>() / (2 * (means.len() - 1)) as f64).sqrt()
}

/// Four standard errors of an Allan deviation of n means, as a fraction of it. The relative variance of the
/// Allan variance of white noise is about 3/n (Lesage and Audoin 1973, IEEE Trans. Instrum. Meas. 22); its
/// square root, the deviation, has half the relative error.
fn allowed(x: &[f64], m: usize) -> f64 {
    let n = (x.len() / m) as f64;
    4.0 * 0.5 * (3.0 / n).sqrt()
}

#[test]
fn white_noise_has_the_level_asked_for_and_an_allan_deviation_of_slope_minus_a_half() {
    let x = first(&read(&scene("rate_hz = 1000.0\nload_cell = { noise_n = 0.05 }"), 1 << 17, |_| 3.0));
    assert_eq!(x.len(), 1 << 17);
    assert!((mean(&x) - 3.0).abs() < 4.0 * 0.05 / (x.len() as f64).sqrt());
    for m in [1, 4, 16, 64, 256, 1024] {
        let (found, law) = (allan(&x, m), 0.05 / (m as f64).sqrt());
        assert!((found / law - 1.0).abs() < allowed(&x, m), "m = {m}: {found}, expected {law}");
    }
}

/// Deviations of white noise and of a random walk that gains the variance K² per second: σ²(τ) = K² τ / 3 for
/// the walk (IEEE Std 952, annex C).
#[test]
fn drift_is_a_random_walk_of_the_level_asked_for() {
    let keys = "rate_hz = 1000.0\nforce_torque = { noise_n = 0.0, noise_nm = 0.0, drift_n = 0.3 }";
    let x = first(&read(&scene(keys), 1 << 17, |_| 0.0));
    for m in [16, 64, 256, 1024] {
        let (found, law) = (allan(&x, m), 0.3 * (m as f64 * 1e-3 / 3.0).sqrt());
        // Successive differences of a walk's means are correlated: twice the errors of white noise.
        assert!((found / law - 1.0).abs() < 2.0 * allowed(&x, m), "m = {m}: {found}, expected {law}");
    }
    let ends: Vec<f64> = (0..400)
        .map(|seed| {
            first(&read(
                &scene(&format!(
                    "seed = {seed}\nrate_hz = 10.0\nforce_torque = {{ noise_n = 0.0, drift_n = 0.3 }}"
                )),
                10_001,
                |_| 0.0,
            ))[100]
        })
        .collect();
    // 101 steps of 0.1 s; four standard errors of a deviation of 400 values.
    let law = 0.3 * 10.1_f64.sqrt();
    assert!(
        (deviation(&ends) / law - 1.0).abs() < 4.0 / 800.0_f64.sqrt(),
        "{}, expected {law}",
        deviation(&ends)
    );
}

#[test]
fn a_bias_stays_through_a_run_and_differs_between_seeds() {
    let of_seed = |seed: u64| {
        let keys = format!("seed = {seed}\nrate_hz = 100.0\nload_cell = {{ noise_n = 0.0, bias_n = 0.2 }}");
        let x = first(&read(&scene(&keys), 200, |_| 0.0));
        assert!(x.iter().all(|y| *y == x[0]), "seed {seed}: {x:?}");
        x[0]
    };
    let biases: Vec<f64> = (0..2000).map(of_seed).collect();
    assert!(mean(&biases).abs() < 4.0 * 0.2 / 2000.0_f64.sqrt());
    assert!((deviation(&biases) / 0.2 - 1.0).abs() < 4.0 / 4000.0_f64.sqrt(), "{}", deviation(&biases));
}

#[test]
fn noise_of_other_seeds_places_and_values_is_independent() {
    let keys = "rate_hz = 1000.0\nload_cell = { noise_n = 1.0 }";
    let a = read(&scene(keys), 20_000, |_| 0.0);
    let b = read(&scene(&format!("seed = 1\n{keys}")), 20_000, |_| 0.0);
    let two = scene(&format!("{keys}\n[[sensor]]\nname = \"other\"\n{keys}"));
    let c: Vec<_> =
        read(&two, 20_000, |_| 0.0).into_iter().filter(|reading| reading.sensor_index == 1).collect();
    let second: Vec<f64> = a.iter().map(|reading| reading.value[1]).collect();
    let delayed: Vec<f64> = first(&a).into_iter().cycle().skip(1).take(a.len()).collect();
    for (name, other) in [("seed", first(&b)), ("place", first(&c)), ("value", second), ("tick", delayed)] {
        let products: Vec<f64> = first(&a).iter().zip(&other).map(|(x, y)| x * y).collect();
        assert!(mean(&products).abs() < 4.0 / (products.len() as f64).sqrt(), "{name}: {}", mean(&products));
    }
}

#[test]
fn readings_without_noise_are_exact_and_a_resolution_rounds_them() {
    let ramp = |tick: u64| 1e-4 * tick as f64;
    let exact = read(&scene("rate_hz = 1000.0\nload_cell = { noise_n = 0.0 }"), 1000, ramp);
    assert!(exact.iter().all(|reading| reading.value[0] == ramp(reading.sample_tick)));
    // Regression: with a step too fine for `f64`, the readings were infinite but marked valid.
    let endless =
        read(&scene("rate_hz = 1000.0\nload_cell = { noise_n = 0.0, resolution_n = 1e-310 }"), 1000, ramp);
    assert!(endless.iter().all(|reading| (reading.value[0] - ramp(reading.sample_tick)).abs() < 1e-12));
    let steps =
        read(&scene("rate_hz = 1000.0\nload_cell = { noise_n = 0.0, resolution_n = 0.01 }"), 10_000, ramp);
    let errors: Vec<f64> = steps.iter().map(|reading| reading.value[0] - ramp(reading.sample_tick)).collect();
    assert!(
        steps
            .iter()
            .all(|reading| (reading.value[0] / 0.01 - (reading.value[0] / 0.01).round()).abs() < 1e-9)
    );
    assert!(errors.iter().all(|error| error.abs() <= 0.005 + 1e-12));
    // The error of a ramp is uniform over a step: its deviation is step / √12. The ramp samples 100 positions
    // of a step, which gives 5e-5 less.
    assert!((deviation(&errors) / (0.01 / 12.0_f64.sqrt()) - 1.0).abs() < 1e-3, "{}", deviation(&errors));
}

#[test]
fn the_share_asked_for_drops_out_and_says_so() {
    for share in [0.0_f64, 0.1, 1.0] {
        let keys = format!("rate_hz = 1000.0\ndropout = {share}\nload_cell = {{ noise_n = 0.0 }}");
        let all = read(&scene(&keys), 20_000, |_| 2.0);
        assert_eq!(all.len(), 20_000);
        assert!(all.iter().all(|reading| reading.value[0] == 2.0 * f64::from(reading.valid)));
        let lost = all.iter().filter(|reading| !reading.is_valid()).count() as f64;
        let error = (20_000.0 * share * (1.0 - share)).sqrt();
        assert!((lost - 20_000.0 * share).abs() <= 4.0 * error, "{lost} of 20000 at {share}");
    }
}

/// |H| of y += a (x − y): a / |1 − (1 − a) e^(−iω)|, with a = 1 − e^(−2π f dt). Near the corner this is the
/// analogue filter's 1/√2.
#[test]
fn the_low_pass_has_the_gain_of_a_first_order_filter() {
    let keys = "rate_hz = 1000.0\nforce_torque = { noise_n = 0.0, noise_nm = 0.0, low_pass_hz = 20.0 }";
    let a = 1.0 - (-std::f64::consts::TAU * 20.0 * 1e-3).exp();
    for hz in [5.0, 20.0, 80.0] {
        let omega = std::f64::consts::TAU * hz * 1e-3;
        let x = first(&read(&scene(keys), 4000, |tick| (omega * tick as f64).sin()));
        let tail = &x[2000..];
        let sum = |f: fn(f64) -> f64| {
            tail.iter().enumerate().map(|(i, y)| y * f(omega * (i + 2000) as f64)).sum::<f64>() * 2.0
                / tail.len() as f64
        };
        let gain = sum(f64::sin).hypot(sum(f64::cos));
        let (re, im) = (1.0 - (1.0 - a) * omega.cos(), (1.0 - a) * omega.sin());
        let law = a / re.hypot(im);
        // 2000 ticks hold whole periods of each frequency.
        assert!((gain / law - 1.0).abs() < 1e-6, "{hz} Hz: {gain}, expected {law}");
    }
}
