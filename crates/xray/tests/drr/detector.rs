//! Noise against the Poisson distribution, blur and display against their definitions.

use xray::{
    CArm, DetectorParameters, Display, DisplayParameters, DrrParameters, DrrRenderer, FrameSeed, Grid,
    Output, Scale, Tool, VolumeView, Window, WindowLimits, blur_row, gaussian_weights, photon_number,
    window_limits,
};

use crate::machine::Desk;

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
        // Four standard errors: of the mean sqrt(mean/n); of the variance sqrt((mean + 2 mean^2)/n). The
        // rounding of the normal approximation adds 1/12 to the variance.
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

/// 30 mm of water over half of the detector.
fn half_covered() -> (Grid, Vec<i16>, CArm) {
    let grid = Grid::axis_aligned([30, 30, 30], [1e-3; 3], [0.0, -0.0145, -0.0145]).unwrap();
    let hu = vec![0; grid.voxels()];
    (grid, hu, crate::poses::c_arm(0.0, 0.0, 96, 0.03))
}

/// Renders a frame and returns it with its line integrals.
fn frame(
    detector: DetectorParameters,
    mode: Display,
    seed: FrameSeed,
    threads: usize,
) -> (Vec<f32>, Vec<f64>) {
    let (grid, hu, c_arm) = half_covered();
    let view = VolumeView::new(grid, &hu).unwrap();
    let display = DisplayParameters { mode, window: Window::Fixed { low: 0.0, high: 2.0 } };
    let parameters = DrrParameters { detector, display, threads, ..DrrParameters::default() };
    let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
    let mut image = vec![0.0; c_arm.pixels()];
    renderer.render_to(&view, &c_arm, &Tool::default(), seed, Output::Float32(&mut image)).unwrap();
    (image, renderer.line_integrals())
}

const PLAIN: DetectorParameters = DetectorParameters {
    photons_per_pixel: 1e4,
    quantum_noise: false,
    blur_sigma_px: 0.0,
    gain: 1.0,
    offset: 0.0,
    saturation: None,
};

#[test]
fn without_noise_the_detector_is_beer_lambert_and_a_readout() {
    let readouts =
        [(1.0, 0.0, None), (1.7, 0.0, None), (1.0, 0.1, None), (1.0, 0.0, Some(0.7)), (2.0, 0.05, Some(1.5))];
    for (gain, offset, saturation) in readouts {
        let detector = DetectorParameters { gain, offset, saturation, ..PLAIN };
        let (linear, integrals) = frame(detector, Display::Linear, FrameSeed::default(), 1);
        let (logarithmic, _) = frame(detector, Display::BoneDark, FrameSeed::default(), 1);
        for ((l, g), integral) in linear.iter().zip(&logarithmic).zip(&integrals) {
            let want = (gain * (-integral).exp() + offset).min(saturation.unwrap_or(f64::INFINITY));
            // Single precision of the output.
            assert!((f64::from(*l) - want).abs() < 1e-6 && (f64::from(*g) + want.ln()).abs() < 1e-6);
        }
    }
}

#[test]
fn noise_of_a_frame_has_the_mean_and_variance_of_its_photons() {
    // 1e4 photons (normal), and 20 (exact Poisson).
    for photons in [1e4, 20.0] {
        let detector = DetectorParameters { photons_per_pixel: photons, quantum_noise: true, ..PLAIN };
        let (mut sum, mut squares, mut n) = (0.0, 0.0, 0.0);
        for number in 0..8 {
            let (image, integrals) =
                frame(detector, Display::Linear, FrameSeed { seed: 5, frame: number }, 2);
            for (share, integral) in image.iter().zip(&integrals) {
                let mean = photons * (-integral).exp();
                let deviate = (f64::from(*share) * photons - mean) / mean.sqrt();
                (sum, squares, n) = (sum + deviate, squares + deviate * deviate, n + 1.0);
            }
        }
        let (mean, variance) = (sum / n, squares / n);
        println!("{photons} photons: mean {mean:.4}, variance {variance:.4} of {n} standardised pixels");
        // Four standard errors; the variance of a squared Poisson deviate is 2 + 1/mean, of means above 10.
        assert!(mean.abs() < 4.0 / f64::sqrt(n) && (variance - 1.0).abs() < 4.0 * f64::sqrt(2.1 / n));
    }
}

#[test]
fn a_frame_depends_on_its_seed_and_not_on_threads_and_what_is_off_changes_nothing() {
    let noisy = DetectorParameters { quantum_noise: true, blur_sigma_px: 0.8, ..PLAIN };
    let seed = FrameSeed { seed: 1, frame: 2 };
    let one = frame(noisy, Display::BoneDark, seed, 1).0;
    assert_eq!(one, frame(noisy, Display::BoneDark, seed, 3).0);
    for other in [FrameSeed { seed: 2, frame: 2 }, FrameSeed { seed: 1, frame: 3 }] {
        assert_ne!(one, frame(noisy, Display::BoneDark, other, 1).0);
    }
    // With everything off, the logarithmic image is the line integral itself.
    let (image, integrals) = frame(PLAIN, Display::BoneBright, seed, 2);
    assert!(image.iter().zip(&integrals).all(|(a, b)| *a == *b as f32));
}

#[test]
fn blur_of_a_frame_is_the_two_dimensional_convolution() {
    let blurred = DetectorParameters { blur_sigma_px: 1.3, ..PLAIN };
    let got = frame(blurred, Display::Linear, FrameSeed::default(), 2).0;
    let sharp = frame(PLAIN, Display::Linear, FrameSeed::default(), 2).0;
    let weights = gaussian_weights(1.3);
    let reach = weights.len() as i64 / 2;
    for (row, column) in [(0, 0), (3, 95), (48, 47), (95, 50), (60, 1)] {
        let mut want = 0.0;
        for (i, wi) in weights.iter().enumerate() {
            for (j, wj) in weights.iter().enumerate() {
                let r = (row + i as i64 - reach).clamp(0, 95);
                let c = (column + j as i64 - reach).clamp(0, 95);
                want += wi * wj * f64::from(sharp[(r * 96 + c) as usize]);
            }
        }
        // Some tens of roundings in single precision.
        assert!((f64::from(got[(row * 96 + column) as usize]) - want).abs() < 1e-6);
    }
}

#[test]
fn a_readout_out_of_range_is_refused_by_name() {
    for (bad, name) in [
        (DetectorParameters { gain: 0.0, ..PLAIN }, "gain"),
        (DetectorParameters { offset: f64::NAN, ..PLAIN }, "offset"),
        (DetectorParameters { saturation: Some(-1.0), ..PLAIN }, "saturation"),
        (DetectorParameters { blur_sigma_px: 21.0, ..PLAIN }, "blur_sigma_px"),
    ] {
        assert!(bad.validate().unwrap_err().to_string().contains(name));
    }
}

#[test]
fn blur_keeps_the_sum_and_has_the_asked_width() {
    for sigma in [0.8, 1.0, 2.5] {
        let weights = gaussian_weights(sigma);
        let reach = (weights.len() / 2) as f64;
        assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-14);
        let variance: f64 = weights.iter().enumerate().map(|(i, w)| w * (i as f64 - reach).powi(2)).sum();
        // Truncation at 3 sigma removes up to 3 % of the variance; sampling a narrow Gaussian changes it by
        // as much.
        assert!((variance.sqrt() / sigma - 1.0).abs() < 0.04, "{sigma} {variance}");
    }
    assert_eq!(gaussian_weights(0.0), [1.0]);
}

#[test]
fn a_blurred_row_keeps_constants_and_turns_an_impulse_into_the_weights() {
    let weights: Vec<f32> = gaussian_weights(1.0).into_iter().map(|w| w as f32).collect();
    for columns in [3, 6, 7, 20] {
        let mut out = vec![0.0; columns];
        blur_row(&vec![2.0; columns], &weights, &mut out);
        assert!(out.iter().all(|v| (v - 2.0).abs() < 1e-6), "{columns}: {out:?}");
    }
    let mut impulse = [0.0; 20];
    impulse[9] = 1.0;
    let mut out = [0.0; 20];
    blur_row(&impulse, &weights, &mut out);
    assert_eq!(out[6..13], weights[..]);
}

#[test]
fn display_modes_are_what_they_say() {
    let window = WindowLimits { low: 1.0, high: 3.0 };
    let show = |mode, l: f64| Scale::new(mode, window).grey(l);
    assert_eq!(show(Display::BoneDark, 1.0), 65535);
    assert_eq!(show(Display::BoneDark, 3.0), 0);
    assert_eq!(show(Display::BoneDark, 2.0), 32768);
    assert_eq!(show(Display::BoneDark, 9.0), 0);
    assert_eq!(show(Display::BoneDark, 0.0), 65535);
    assert_eq!(show(Display::BoneBright, 3.0), 65535);
    assert_eq!(show(Display::BoneBright, 1.5), 16384);
    assert_eq!(show(Display::Linear, 0.25), 16384);
    assert_eq!(show(Display::Linear, 1.5), 65535);
}

#[test]
fn the_automatic_window_spans_the_object_and_leaves_room_for_metal() {
    // A ramp of attenuation from 1 to 3 behind an object, and open field.
    let mut anatomy: Vec<f64> = (0..=20_000).map(|i| 1.0 + f64::from(i) * 1e-4).collect();
    anatomy.extend([0.0; 5000]);
    let window = Window::Automatic { low_share: 0.1, high_share: 0.05, metal_room: 0.5 };
    let WindowLimits { low, high } = window_limits(window, &anatomy);
    // Percentiles are accurate to a histogram bin (0.005).
    assert!((low - 1.2).abs() < 0.005, "{low}");
    assert!((high - (1.2 + 1.5 * (2.9 - 1.2))).abs() < 0.01, "{high}");
    assert_eq!(
        window_limits(Window::Fixed { low: 0.5, high: 4.0 }, &anatomy),
        WindowLimits { low: 0.5, high: 4.0 }
    );
    let WindowLimits { low, high } = window_limits(window, &[0.0; 10]);
    assert!(low < high);
    let inverted = Window::Fixed { low: 2.0, high: 1.0 };
    assert!(DisplayParameters { mode: Display::BoneDark, window: inverted }.validate().is_err());
}
