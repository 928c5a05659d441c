//! Noise against the Poisson distribution, blur and display against their definitions.

use drr_proc::detector::{blur_column_into_row, blur_row, gaussian_weights, photon_number};
use drr_proc::display::{display_value, to_8_bit, window_limits};
use drr_proc::{DetectorParameters, DisplayMode, DisplayParameters, FrameSeed, Window};

const DRAWS: u64 = 200_000;

fn draws(mean: f64) -> impl Iterator<Item = f64> {
    let seed = FrameSeed { seed: 3, frame: mean.to_bits() };
    (0..DRAWS).map(move |i| photon_number(mean, seed.hash(i)))
}

#[test]
fn photon_numbers_have_the_poisson_mean_and_variance() {
    for mean in [0.3, 4.0, 29.9, 30.0, 300.0, 20_000.0] {
        let n = DRAWS as f64;
        let average = draws(mean).sum::<f64>() / n;
        let variance = draws(mean).map(|x| (x - average).powi(2)).sum::<f64>() / n;
        println!("mean {mean}: average {average:.4}, variance {variance:.4}");
        // Four standard errors: of the mean sqrt(mean/n); of the variance sqrt((mean + 2 mean^2)/n). The rounding of the
        // normal approximation adds 1/12 to the variance.
        assert!((average - mean).abs() < 4.0 * (mean / n).sqrt(), "{mean} {average}");
        let rounding = if mean < 30.0 { 0.0 } else { 1.0 / 12.0 };
        let bound = 4.0 * ((mean + 2.0 * mean * mean) / n).sqrt();
        assert!((variance - mean - rounding).abs() < bound, "{mean} {variance}");
        assert!(draws(mean).all(|x| x >= 0.0 && x.fract() == 0.0));
    }
}

#[test]
fn below_30_the_distribution_is_poissons() {
    // Chi-square of 5 classes of a mean of 2; the 0.1 % point with 4 degrees of freedom is 18.5.
    let mean = 2.0_f64;
    let mut counts = [0.0; 5];
    draws(mean).for_each(|x| counts[(x as usize).min(4)] += 1.0);
    let mut expected = [1.0, mean, mean.powi(2) / 2.0, mean.powi(3) / 6.0, 0.0].map(|p| p * (-mean).exp());
    expected[4] = 1.0 - expected[..4].iter().sum::<f64>();
    let chi_square: f64 =
        counts.iter().zip(&expected).map(|(c, p)| (c - p * DRAWS as f64).powi(2) / (p * DRAWS as f64)).sum();
    println!("chi-square {chi_square:.2}");
    assert!(chi_square < 18.5);
}

#[test]
fn noise_of_neighbouring_pixels_and_frames_is_uncorrelated() {
    let normal = |frame, pixel| {
        let seed = FrameSeed { seed: 11, frame };
        (photon_number(400.0, seed.hash(pixel)) - 400.0) / 20.0
    };
    for shift in [(0, 1), (0, 384), (1, 0), (1, 1)] {
        let n = 50_000;
        let c: f64 = (0..n).map(|p| normal(0, p) * normal(shift.0, p + shift.1)).sum::<f64>() / n as f64;
        // Four standard errors of a correlation of independent numbers.
        assert!(c.abs() < 4.0 / (n as f64).sqrt(), "{shift:?}: {c}");
    }
}

#[test]
fn without_noise_the_detector_is_beer_lambert() {
    let quiet = DetectorParameters { quantum_noise: false, ..DetectorParameters::default() };
    for l in [0.0, 0.5, 3.0, 12.0] {
        assert!((quiet.expose(l, FrameSeed::default(), 0) / (-l).exp() - 1.0).abs() < 1e-14);
    }
}

#[test]
fn blur_keeps_the_sum_and_has_the_asked_width() {
    for sigma in [0.8, 1.0, 2.5] {
        let weights = gaussian_weights(sigma);
        let reach = (weights.len() / 2) as f64;
        assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-14);
        let variance: f64 = weights.iter().enumerate().map(|(i, w)| w * (i as f64 - reach).powi(2)).sum();
        // Cutting at 3 sigma takes up to 3 % of the variance away; sampling a narrow bell changes it by as much.
        assert!((variance.sqrt() / sigma - 1.0).abs() < 0.04, "{sigma} {variance}");
    }
    assert_eq!(gaussian_weights(0.0), [1.0]);
}

#[test]
fn blur_of_an_impulse_is_the_outer_product_of_the_weights() {
    let (columns, rows) = (9, 11);
    let weights = gaussian_weights(1.0);
    let mut image = vec![0.0; columns * rows];
    image[5 * columns + 4] = 1.0;
    let mut along = image.clone();
    for (out, row) in along.chunks_mut(columns).zip(image.chunks(columns)) {
        blur_row(row, &weights, out);
    }
    let mut both = along.clone();
    for (r, out) in both.chunks_mut(columns).enumerate() {
        blur_column_into_row(&along, columns, r, &weights, out);
    }
    for r in 2..=8 {
        for c in 1..=7 {
            let want = weights[r - 2] * weights[c - 1];
            assert!((both[r * columns + c] - want).abs() < 1e-16);
        }
    }
    // Edges repeat: a constant image stays constant.
    let mut constant = vec![0.0; columns];
    blur_row(&vec![2.0; columns], &weights, &mut constant);
    assert!(constant.iter().all(|v| (v - 2.0).abs() < 1e-14));
}

#[test]
fn display_modes_are_what_they_say() {
    let window = (1.0, 3.0);
    let show = |mode, l: f64| display_value(mode, window, (-l).exp(), 1.0);
    assert_eq!(show(DisplayMode::BoneDark, 1.0), 65535);
    assert_eq!(show(DisplayMode::BoneDark, 3.0), 0);
    assert_eq!(show(DisplayMode::BoneDark, 2.0), 32768);
    assert_eq!(show(DisplayMode::BoneDark, 9.0), 0);
    assert_eq!(show(DisplayMode::BoneDark, 0.0), 65535);
    assert_eq!(show(DisplayMode::BoneBright, 3.0), 65535);
    assert_eq!(show(DisplayMode::BoneBright, 1.5), 16384);
    assert_eq!(display_value(DisplayMode::BoneDark, window, 0.0, 1.0), 0);
    assert_eq!(display_value(DisplayMode::Linear, window, 0.25, 1.0), 16384);
    // Metal over the anatomy: attenuation 2 of anatomy and 4 of metal is the anatomy's grey times exp(-4).
    let (anatomy, metal) = (2.0_f64, 4.0_f64);
    let shown =
        display_value(DisplayMode::BoneBrightToolBlack, window, (-anatomy - metal).exp(), (-metal).exp());
    assert_eq!(shown, (0.5 * (-metal).exp() * 65535.0_f64).round() as u16);
    assert_eq!(to_8_bit(&[0, 255, 256, 65535]), [0, 0, 1, 255]);
}

#[test]
fn the_automatic_window_spans_the_object_and_leaves_room_for_metal() {
    // A ramp of attenuation from 1 to 3 behind an object, and open field.
    let mut anatomy: Vec<f64> = (0..=20_000).map(|i| 1.0 + f64::from(i) * 1e-4).collect();
    anatomy.extend([0.0; 5000]);
    let window = Window::Automatic { low_share: 0.1, high_share: 0.05, metal_room: 0.5 };
    let (low, high) = window_limits(window, &anatomy);
    // Percentiles to a histogram bin (0.005).
    assert!((low - 1.2).abs() < 0.005, "{low}");
    assert!((high - (1.2 + 1.5 * (2.9 - 1.2))).abs() < 0.01, "{high}");
    assert_eq!(window_limits(Window::Fixed { low: 0.5, high: 4.0 }, &anatomy), (0.5, 4.0));
    let (low, high) = window_limits(window, &[0.0; 10]);
    assert!(low < high);
    let inverted = Window::Fixed { low: 2.0, high: 1.0 };
    assert!(DisplayParameters { mode: DisplayMode::BoneDark, window: inverted }.validate().is_err());
}
