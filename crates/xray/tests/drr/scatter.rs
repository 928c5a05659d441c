//! Monte Carlo scatter against deterministic sums and an independent Monte Carlo in Python, with xraylib's
//! cross sections; kernels against Monte Carlo; and frames with either.

use xray::reference::{Ellipsoid, relative_rms, thigh, voxelise};
use xray::scatter::{Estimate, MonteCarlo, Phantom};
use xray::{
    AntiScatterGrid, CArm, DetectorParameters, Display, DisplayParameters, DrrParameters, DrrRenderer,
    FrameSeed, Grid, Machine, Output, Scatter, ScatterModel, Shot, Spectrum, Tool, VolumeView,
};

use crate::machine::Desk;
use crate::poses::c_arm;

const PACKAGES: [&str; 2] = ["numpy==2.2.6", "xraylib==4.3.0"];
const ENVIRONMENT: &str = "xraylib-numpy";
const TABLES_PY: &str = include_str!("../../src/scatter/tables.py");
const TABLES_RS: &str = include_str!("../../src/scatter/tables.rs");
const SINGLE_PY: &str = include_str!("scatter_single.py");
const ANALOG_PY: &str = include_str!("scatter_analog.py");

/// Numbers in a table's text.
fn numbers(text: &str) -> Vec<f64> {
    let words = text.split(['[', ']', ',', ';', ' ', '\n', '=']);
    words.filter(|word| word.contains("e")).filter_map(|word| word.parse().ok()).collect()
}

#[test]
fn tables_are_those_that_xraylib_gives() {
    let Some(theirs) = crate::run_python(ENVIRONMENT, &PACKAGES, "numpy, xraylib", TABLES_PY) else {
        return;
    };
    let (ours, theirs) = (numbers(TABLES_RS), numbers(&theirs));
    assert_eq!(ours.len(), 25 + 73 + 2 * (3 * 25 + 2 * 73));
    assert_eq!(ours, theirs);
}

/// A slab across the beam of the frontal view, whose photons fly along -y.
#[derive(Debug, Clone, Copy)]
struct Setup {
    /// 0 for water, 1 for cortical bone.
    material: usize,
    energy_kev: f64,
    thickness_m: f64,
    /// Side of the detector.
    field_m: f64,
}

/// Side of the slab.
const SIDE_M: f64 = 0.4;

impl Setup {
    fn phantom(&self) -> Phantom {
        let cells = [20, 10, 20];
        let grid = Grid::centred(cells, [SIDE_M / 20.0, self.thickness_m / 10.0, SIDE_M / 20.0]).unwrap();
        let mut fraction = [0.0; 2];
        fraction[self.material] = 1.0;
        Phantom::new(grid, vec![fraction; grid.voxels()]).unwrap()
    }

    fn c_arm(&self) -> CArm {
        c_arm(0.0, 0.0, 64, self.field_m)
    }

    fn estimate(&self, photons: f64, orders: u32) -> Estimate {
        let monte_carlo = MonteCarlo { photons, nodes: 8, orders };
        monte_carlo.estimate(&self.phantom(), &self.c_arm(), &[(self.energy_kev, 1.0)]).unwrap()
    }

    /// The setup as a line of Python.
    fn row(&self) -> String {
        let Self { material, energy_kev, thickness_m, field_m } = self;
        format!("({material}, {energy_kev:?}, {thickness_m:?}, {field_m:?}, {SIDE_M:?})")
    }
}

/// The middle quarter of the 8 x 8 nodes.
fn middle(column: usize, row: usize) -> bool {
    (2..6).contains(&column) && (2..6).contains(&row)
}

const fn setup(material: usize, energy_kev: f64, thickness_m: f64, field_m: f64) -> Setup {
    Setup { material, energy_kev, thickness_m, field_m }
}

const SETUPS: [Setup; 12] = [
    setup(0, 40.0, 0.1, 0.3),
    setup(0, 60.0, 0.05, 0.1),
    setup(0, 60.0, 0.1, 0.3),
    setup(0, 60.0, 0.2, 0.2),
    setup(0, 60.0, 0.2, 0.3),
    setup(0, 60.0, 0.25, 0.3),
    setup(0, 80.0, 0.2, 0.3),
    setup(0, 120.0, 0.2, 0.3),
    setup(1, 40.0, 0.01, 0.2),
    setup(1, 60.0, 0.02, 0.3),
    setup(1, 80.0, 0.04, 0.1),
    setup(1, 120.0, 0.05, 0.3),
];

#[test]
fn single_scatter_is_the_deterministic_integral() {
    let rows: Vec<String> = SETUPS.iter().map(Setup::row).collect();
    let script = SINGLE_PY.replace("SETUPS", &format!("[{}]", rows.join(", ")));
    let Some(text) = crate::run_python(ENVIRONMENT, &PACKAGES, "numpy, xraylib", &script) else { return };
    let theirs: Vec<f64> = text.split_whitespace().map(|word| word.parse().unwrap()).collect();
    for (setup, theirs) in SETUPS.iter().zip(theirs.chunks(2)) {
        let estimate = setup.estimate(4e5, 1);
        let ours = [estimate.average(|_, _| true), estimate.average(middle)];
        for ((mean, error), theirs) in ours.into_iter().zip(theirs) {
            println!("{setup:?}: {mean:.5} +- {error:.5}, integral {theirs:.5}, ratio {:.4}", mean / theirs);
            // The photons' numbers are fixed, so this holds for every run.
            assert!(error < 0.01 * mean && (mean / theirs - 1.0).abs() < 0.02);
        }
    }
}

/// All orders, against photons that are followed by plain sampling in Python and counted where they cross the
/// detector: no weights, no forced detection, and flights by each free path.
#[test]
fn all_orders_are_those_of_photons_that_are_counted() {
    let setups = [
        setup(0, 60.0, 0.1, 0.3),
        setup(0, 60.0, 0.2, 0.3),
        setup(0, 60.0, 0.25, 0.3),
        setup(1, 80.0, 0.04, 0.3),
    ];
    let rows: Vec<String> = setups.iter().map(Setup::row).collect();
    let script = ANALOG_PY.replace("SETUPS", &format!("[{}]", rows.join(", ")));
    let Some(text) = crate::run_python(ENVIRONMENT, &PACKAGES, "numpy, xraylib", &script) else { return };
    let theirs: Vec<f64> = text.split_whitespace().map(|word| word.parse().unwrap()).collect();
    for (setup, theirs) in setups.iter().zip(theirs.chunks(3)) {
        let (mean, error) = setup.estimate(4e5, 100).average(|_, _| true);
        let &[counted, counted_error, primary] = theirs else { panic!("three numbers a setup") };
        let allowed = 4.0 * (error * error + counted_error * counted_error).sqrt() + 0.005 * counted;
        println!(
            "{setup:?}: {mean:.5} +- {error:.5}, counted {counted:.5} +- {counted_error:.5}, \
             scatter to primary {:.3}",
            mean / primary
        );
        assert!((mean - counted).abs() < allowed, "{mean} {counted} {allowed}");
        assert!(allowed < 0.08 * counted);
    }
}

#[test]
fn threads_do_not_change_a_bit() {
    let setup = setup(0, 60.0, 0.1, 0.3);
    let one = Desk.workers(1).unwrap().install(|| setup.estimate(1e4, 100));
    let three = Desk.workers(3).unwrap().install(|| setup.estimate(1e4, 100));
    assert!(one == three);
}

const KERNEL: Scatter = Scatter { model: ScatterModel::Kernel, photons: 1e6 };

fn monte_carlo(photons: f64) -> Option<Scatter> {
    Some(Scatter { model: ScatterModel::MonteCarlo, photons })
}

/// Signals without noise or blur.
fn plain(scatter: Option<Scatter>, spectrum: Option<Spectrum>) -> DrrParameters {
    DrrParameters {
        scatter,
        spectrum,
        detector: DetectorParameters { quantum_noise: false, blur_sigma_px: 0.0, ..Default::default() },
        display: DisplayParameters { mode: Display::Linear, ..Default::default() },
        ..Default::default()
    }
}

fn signal(view: &VolumeView<'_>, c_arm: &CArm, parameters: DrrParameters) -> Vec<f64> {
    let mut image = vec![0.0; c_arm.pixels()];
    let mut renderer = DrrRenderer::new(view, parameters, &Desk).unwrap();
    let output = Output::Float32(&mut image);
    renderer.render_to(view, c_arm, &Tool::default(), FrameSeed::default(), output).unwrap();
    image.into_iter().map(f64::from).collect()
}

/// A pelvis-like body, 340 mm wide and 220 mm deep, with femoral heads.
fn pelvis() -> Vec<Ellipsoid> {
    let ellipsoid = |x: f64, semi_axes_m: [f64; 3], added_hu: f64| Ellipsoid {
        centre_m: [x, 0.0, 0.0],
        semi_axes_m,
        added_hu,
    };
    vec![
        ellipsoid(0.0, [0.17, 0.11, 0.22], 1030.0),
        ellipsoid(-0.09, [0.025; 3], 500.0),
        ellipsoid(0.09, [0.025; 3], 500.0),
    ]
}

#[test]
fn kernels_are_within_15_percent_of_monte_carlo() {
    for (shapes, dims, beams) in [
        (thigh(1.0), [60, 50, 80], vec![None, Some(Spectrum::default())]),
        (pelvis(), [90, 60, 80], vec![None]),
    ] {
        let grid = Grid::centred(dims, [4e-3; 3]).unwrap();
        let hu = voxelise(&grid, &shapes, 2);
        let view = VolumeView::new(grid, &hu).unwrap();
        for spectrum in beams {
            let c_arm = c_arm(0.0, 0.0, 64, 0.307);
            let primary = signal(&view, &c_arm, plain(None, spectrum));
            let scatter_of = |scatter| -> Vec<f64> {
                let with = signal(&view, &c_arm, plain(scatter, spectrum));
                with.iter().zip(&primary).map(|(with, primary)| with - primary).collect()
            };
            let reference = scatter_of(monte_carlo(1.5e5));
            let error = relative_rms(&scatter_of(Some(KERNEL)), &reference);
            println!("{dims:?} {spectrum:?}: kernels differ from Monte Carlo by {error:.3}, r.m.s.");
            assert!(error < 0.15, "{error}");
        }
    }
}

/// Removals, batches and threads, with noise and blur: all give the frame of a fresh renderer.
#[test]
fn frames_with_scatter_are_functions_of_their_inputs() {
    let grid = Grid::centred([40, 40, 40], [4e-3; 3]).unwrap();
    let hu = vec![20_i16; grid.voxels()];
    let removed: Vec<u32> = (0..grid.voxels() as u32).filter(|i| i % 5 == 1).collect();
    let c_arm = c_arm(20.0, 10.0, 48, 0.2);
    let (tool, seed) = (Tool::default(), FrameSeed { seed: 3, frame: 5 });
    for scatter in [Some(KERNEL), monte_carlo(2e3)] {
        for spectrum in [None, Some(Spectrum::default())] {
            let parameters = DrrParameters { scatter, spectrum, ..Default::default() };
            let view = VolumeView::new(grid, &hu).unwrap();
            let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
            let (mut intact, mut image) = (vec![0; c_arm.pixels()], vec![0; c_arm.pixels()]);
            renderer.render(&view, &c_arm, &tool, seed, &mut intact).unwrap();
            renderer.remove(&view, &removed).unwrap();
            renderer.render(&view, &c_arm, &tool, seed, &mut image).unwrap();
            assert!(intact != image);
            let mut shot = vec![0; c_arm.pixels()];
            let output = Output::Mono16(&mut shot);
            renderer.render_batch(&view, &mut [Shot { c_arm, tool: &tool, seed, output }]).unwrap();
            assert!(shot == image);
            // A renderer that removes all voxels before its first frame, on one thread.
            let parameters = DrrParameters { threads: 1, ..parameters };
            let mut fresh = DrrRenderer::new(&view, parameters, &Desk).unwrap();
            fresh.remove(&view, &removed).unwrap();
            let mut other = vec![0; c_arm.pixels()];
            fresh.render(&view, &c_arm, &tool, seed, &mut other).unwrap();
            assert!(other == image);
        }
    }
    // `none` is no scatter.
    let view = VolumeView::new(grid, &hu).unwrap();
    let none = Some(Scatter { model: ScatterModel::None, photons: 1e6 });
    assert!(signal(&view, &c_arm, plain(none, None)) == signal(&view, &c_arm, plain(None, None)));
}

/// Behind a grid: the scatter fraction of each pixel is S Ts / (P Tp + S Ts), and the noise is that of the
/// primary photons which pass.
#[test]
fn a_grid_passes_its_share_of_primary_and_scatter() {
    let grid = Grid::centred([60, 50, 80], [4e-3; 3]).unwrap();
    let hu = voxelise(&grid, &thigh(1.0), 2);
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = c_arm(0.0, 0.0, 48, 0.307);
    let (tp, ts) = (0.7, 0.1);
    let behind = |grid: Option<AntiScatterGrid>, scatter| DrrParameters { grid, ..plain(scatter, None) };
    let a_grid = Some(AntiScatterGrid { primary_transmission: tp, scatter_transmission: ts });
    let primary = signal(&view, &c_arm, behind(None, None));
    assert!(primary == signal(&view, &c_arm, behind(a_grid, None)));
    let without = signal(&view, &c_arm, behind(None, Some(KERNEL)));
    let with = signal(&view, &c_arm, behind(a_grid, Some(KERNEL)));
    let (mut worst, mut largest) = (0.0_f64, 0.0_f64);
    for ((p, without), with) in primary.iter().zip(&without).zip(&with) {
        let s = without - p;
        let (found, expected) = (1.0 - p / with, s * ts / (p * tp + s * ts));
        (worst, largest) = (worst.max((found - expected).abs()), largest.max(1.0 - p / without));
    }
    println!(
        "scatter fraction up to {largest:.2} without the grid; behind it within \
         {worst:.1e} of the closed form"
    );
    assert!(largest > 0.3 && worst < 1e-6, "{largest} {worst:e}");
    let air = vec![-1000; grid.voxels()];
    let air = VolumeView::new(grid, &air).unwrap();
    let noisy = |grid| {
        let detector =
            DetectorParameters { photons_per_pixel: 1000.0, blur_sigma_px: 0.0, ..Default::default() };
        let values = signal(&air, &c_arm, DrrParameters { detector, ..behind(grid, None) });
        values.iter().map(|x| (x - 1.0).powi(2)).sum::<f64>() / values.len() as f64
    };
    // Relative standard error of a variance of 2304 pixels: 3 %.
    assert!((noisy(a_grid) * 700.0 - 1.0).abs() < 0.12 && (noisy(None) * 1000.0 - 1.0).abs() < 0.12);
    let bad = Some(AntiScatterGrid { primary_transmission: 0.0, scatter_transmission: 0.1 });
    let refused = DrrRenderer::new(&view, behind(bad, None), &Desk).err().unwrap().to_string();
    assert!(refused.contains("primary_transmission"), "{refused}");
}

#[test]
fn too_few_photons_are_refused() {
    let grid = Grid::centred([2, 2, 2], [1e-3; 3]).unwrap();
    let hu = vec![0; 8];
    let view = VolumeView::new(grid, &hu).unwrap();
    let refused = DrrRenderer::new(&view, plain(monte_carlo(1.0), None), &Desk).err().unwrap();
    assert_eq!(refused.to_string(), "photons is 1.0, expected 1e3 to 1e10");
}
