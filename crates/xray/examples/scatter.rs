//! Fits the scatter kernels, and measures the error and time of each scatter model.
//!
//! `cargo run --release -p xray --example scatter -- kernels [PHOTONS] > crates/xray/src/scatter/kernels.csv`
//! `cargo run --release -p xray --example scatter -- chart [PHOTONS]`
//!
//! The chart compares with Monte Carlo of `PHOTONS` photons, on a thigh and a pelvis of ellipsoids: the
//! scatter itself, relative r.m.s., and the scatter fraction S/(S + P), mean and r.m.s. difference, over
//! the pixels; and the time that the model adds to a frame of 512 x 512 pixels on two threads, least of the
//! rounds.

use std::error::Error;
use std::time::Instant;

use xray::reference::{Ellipsoid, thigh, voxelise};
use xray::scatter::Pencil;
use xray::scatter::kernel::{COMPONENTS, ENERGIES_KEV, GAPS_M, SIGMAS_M, THICKNESSES_M};
use xray::{
    CArm, DetectorFormat, DetectorParameters, Display, DisplayParameters, DrrError, DrrParameters,
    DrrRenderer, FrameSeed, Grid, Machine, Material, Output, PositionerAngles, Scatter, ScatterModel,
    Spectrum, Tool, VolumeView,
};

struct Desk;

impl Machine for Desk {
    fn workers(&self, threads: usize) -> Result<rayon::ThreadPool, String> {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().map_err(|cause| cause.to_string())
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let photons = |default: f64| arguments.get(1).map_or(Ok(default), |text| text.parse::<f64>());
    match arguments.first().map(String::as_str) {
        Some("kernels") => kernels(photons(2e4)? as u64)?,
        Some("chart") => chart(photons(1e6)?)?,
        _ => return Err("expected `kernels` or `chart`".into()),
    }
    Ok(())
}

/// Radius of the fit and its rings.
const RADIUS_M: f64 = 0.8;
const RINGS: usize = 160;

/// Prints the table of kernels.
fn kernels(photons: u64) -> Result<(), DrrError> {
    println!("energy_kev,gap_m,thickness_m,share_1,share_2,share_3,share_4,share_5");
    for energy_kev in ENERGIES_KEV {
        for gap_m in GAPS_M {
            for thickness_m in THICKNESSES_M {
                let kernel =
                    Pencil { energy_kev, thickness_m, gap_m }.kernel_per_m2(RADIUS_M, RINGS, photons)?;
                let primary = (-Material::Water.mu_per_m(energy_kev)? * thickness_m).exp();
                let words = fit(&kernel).map(|share| format!("{:.4}", share / primary));
                println!("{energy_kev},{gap_m},{thickness_m},{}", words.join(","));
            }
        }
    }
    Ok(())
}

/// The shares, none negative, whose Gaussians have the least squared difference from a kernel in energy per
/// metre of radius, by coordinate descent.
fn fit(kernel: &[f64]) -> [f64; COMPONENTS] {
    let width_m = RADIUS_M / RINGS as f64;
    let energy = |ring: usize, per_m2: f64| core::f64::consts::TAU * (ring as f64 + 0.5) * width_m * per_m2;
    let gaussian = |sigma_m: f64, ring: usize| {
        let z = (ring as f64 + 0.5) * width_m / sigma_m;
        energy(ring, (-0.5 * z * z).exp() / (core::f64::consts::TAU * sigma_m * sigma_m))
    };
    let columns = SIGMAS_M.map(|sigma_m| (0..RINGS).map(|ring| gaussian(sigma_m, ring)).collect::<Vec<_>>());
    let mut left: Vec<f64> = kernel.iter().enumerate().map(|(ring, k)| energy(ring, *k)).collect();
    let mut shares = [0.0; COMPONENTS];
    for _ in 0..2000 {
        for (share, column) in shares.iter_mut().zip(&columns) {
            let slope: f64 = left.iter().zip(column).map(|(l, c)| l * c).sum();
            let square: f64 = column.iter().map(|c| c * c).sum();
            let step = (slope / square).max(-*share);
            *share += step;
            left.iter_mut().zip(column).for_each(|(l, c)| *l -= step * c);
        }
    }
    shares
}

/// A pelvis about the world origin, 340 x 220 x 300 mm: soft tissue, two iliac shells, sacrum, two femoral
/// heads.
fn pelvis() -> Vec<Ellipsoid> {
    let ellipsoid = |centre_mm: [f64; 3], semi_axes_mm: [f64; 3], added_hu: f64| Ellipsoid {
        centre_m: centre_mm.map(|x| x * 1e-3),
        semi_axes_m: semi_axes_mm.map(|x| x * 1e-3),
        added_hu,
    };
    let mut shapes = vec![
        ellipsoid([0.0, 0.0, 0.0], [170.0, 110.0, 220.0], 1030.0),
        ellipsoid([0.0, 60.0, 40.0], [45.0, 25.0, 50.0], 450.0),
    ];
    for x in [-1.0, 1.0] {
        shapes.extend([
            ellipsoid([80.0 * x, 20.0, 50.0], [50.0, 45.0, 60.0], 700.0),
            ellipsoid([78.0 * x, 18.0, 50.0], [46.0, 41.0, 56.0], -700.0),
            ellipsoid([90.0 * x, 0.0, -60.0], [25.0, 25.0, 25.0], 500.0),
            ellipsoid([115.0 * x, 5.0, -110.0], [17.0, 17.0, 60.0], 900.0),
        ]);
    }
    shapes
}

const SIDE: u32 = 512;
const FIELD_M: f64 = 0.307;
const ROUNDS: usize = 9;

fn c_arm(primary: f64, secondary: f64) -> Result<CArm, DrrError> {
    let format = DetectorFormat { columns: SIDE, rows: SIDE, pixel_pitch_m: [FIELD_M / f64::from(SIDE); 2] };
    let angles = PositionerAngles::from_degrees(primary, secondary);
    CArm::from_positioner_angles([0.0; 3], angles, 0.7, 1.0, format)
}

fn renderer(
    view: &VolumeView<'_>,
    spectrum: Option<Spectrum>,
    scatter: Option<Scatter>,
) -> Result<DrrRenderer, DrrError> {
    let parameters = DrrParameters {
        spectrum,
        scatter,
        detector: DetectorParameters { quantum_noise: false, blur_sigma_px: 0.0, ..Default::default() },
        display: DisplayParameters { mode: Display::Linear, ..Default::default() },
        ..Default::default()
    };
    DrrRenderer::new(view, parameters, &Desk)
}

/// The signal of a frame, and the time of rendering it.
fn signal(
    renderer: &mut DrrRenderer,
    view: &VolumeView<'_>,
    c_arm: &CArm,
) -> Result<(Vec<f64>, f64), DrrError> {
    let mut image = vec![0.0_f32; c_arm.pixels()];
    let began = Instant::now();
    let output = Output::Float32(&mut image);
    renderer.render_to(view, c_arm, &Tool::default(), FrameSeed::default(), output)?;
    let time_ms = began.elapsed().as_secs_f64() * 1e3;
    Ok((image.into_iter().map(f64::from).collect(), time_ms))
}

fn chart(photons: f64) -> Result<(), DrrError> {
    println!("phantom,pose,beam,model,error_rel_rms,fraction,fraction_error,fraction_error_rms,added_ms");
    let models = [
        ("none", None),
        ("kernel", Some(Scatter { model: ScatterModel::Kernel, photons })),
        ("monte_carlo 1e4", Some(Scatter { model: ScatterModel::MonteCarlo, photons: 1e4 })),
        ("monte_carlo 1e5", Some(Scatter { model: ScatterModel::MonteCarlo, photons: 1e5 })),
    ];
    for (name, shapes, dims) in
        [("thigh", thigh(1.0), [120, 100, 160]), ("pelvis", pelvis(), [180, 120, 160])]
    {
        let grid = Grid::centred(dims, [2e-3; 3])?;
        let hu = voxelise(&grid, &shapes, 2);
        let view = VolumeView::new(grid, &hu)?;
        for (pose, primary, secondary) in
            [("frontal", 0.0, 0.0), ("oblique", 37.0, 18.0), ("lateral", 90.0, 5.0)]
        {
            let (here, away) = (c_arm(primary, secondary)?, c_arm(primary + 1.0, secondary)?);
            for (beam, spectrum) in [("60 keV", None), ("90 kV", Some(Spectrum::default()))] {
                let mut plain = renderer(&view, spectrum, None)?;
                let reference = Some(Scatter { model: ScatterModel::MonteCarlo, photons });
                let (with, _) = signal(&mut renderer(&view, spectrum, reference)?, &view, &here)?;
                let (primary, _) = signal(&mut plain, &view, &here)?;
                let truth: Vec<f64> = with.iter().zip(&primary).map(|(w, p)| w - p).collect();
                let cheaper = |s: Option<Scatter>| {
                    s.is_none_or(|s| s.model == ScatterModel::Kernel || s.photons < photons)
                };
                for (model, scatter) in models.into_iter().filter(|(_, scatter)| cheaper(*scatter)) {
                    let mut renderer = renderer(&view, spectrum, scatter)?;
                    let is_slow = scatter.is_some_and(|s| s.model == ScatterModel::MonteCarlo);
                    let (mut least, mut image) = ([f64::INFINITY; 2], Vec::new());
                    for _ in 0..if is_slow { 1 } else { ROUNDS } {
                        // A frame of another C-arm in between, so that none is cached.
                        signal(&mut plain, &view, &away)?;
                        least[0] = least[0].min(signal(&mut plain, &view, &here)?.1);
                        if !is_slow {
                            signal(&mut renderer, &view, &away)?;
                        }
                        let (got, time_ms) = signal(&mut renderer, &view, &here)?;
                        (least[1], image) = (least[1].min(time_ms), got);
                    }
                    let scattered: Vec<f64> = image.iter().zip(&primary).map(|(i, p)| i - p).collect();
                    let error = xray::reference::relative_rms(&scattered, &truth);
                    let fraction = |s: &f64, p: &f64| s / (s + p);
                    let fractions = truth.iter().zip(&primary).map(|(s, p)| fraction(s, p));
                    let mean = fractions.clone().sum::<f64>() / primary.len() as f64;
                    let differences: Vec<f64> = scattered
                        .iter()
                        .zip(&primary)
                        .zip(fractions)
                        .map(|((s, p), truth)| fraction(s, p) - truth)
                        .collect();
                    let count = differences.len() as f64;
                    let bias = differences.iter().sum::<f64>() / count;
                    let rms = (differences.iter().map(|d| d * d).sum::<f64>() / count).sqrt();
                    println!(
                        "{name},{pose},{beam},{model},{error:.3},{mean:.3},{bias:.3},{rms:.3},{:.2}",
                        least[1] - least[0]
                    );
                }
            }
        }
    }
    Ok(())
}
