//! Scatter by kernels: the fast rung.
//!
//! Each part of the detector sends out the scatter of a thin beam through a slab of water of the thickness
//! that its attenuation corresponds to, as a sum of Gaussians (J. M. Boone, B. A. Arnold and J. A. Seibert
//! measured one to be a very good model, Med. Phys. 13 (1986) 254), whose shares depend on photon energy,
//! thickness and air gap. The shares in `kernels.csv` were fitted to [`Pencil`](super::Pencil) by `cargo run
//! --release -p xray --example scatter -- kernels`.

use std::sync::LazyLock;

use pulp::Arch;

use crate::attenuation::Material;
use crate::carm::CArm;
use crate::detector::add_scaled_row;
use crate::error::DrrError;
use crate::exposure::Anatomy;
use crate::lane_math;
use crate::lanes::lanes;
use crate::spectrum::SpectrumTable;
use crate::vector::{cross, dot, sub};

/// Standard deviations of the Gaussians, metres on the detector.
pub const SIGMAS_M: [f64; COMPONENTS] = [0.01, 0.025, 0.06, 0.14, 0.35];
/// Number of Gaussians.
pub const COMPONENTS: usize = 5;
/// Photon energies of the table.
pub const ENERGIES_KEV: [f64; 6] = [30.0, 45.0, 60.0, 80.0, 100.0, 120.0];
/// Air gaps of the table, from the patient's far side to the detector.
pub const GAPS_M: [f64; 6] = [0.02, 0.1, 0.2, 0.35, 0.6, 1.0];
/// Thicknesses of water of the table; without water there is no scatter.
pub const THICKNESSES_M: [f64; 8] = [0.025, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4];

/// Scatter over primary of each Gaussian, at each energy, gap and thickness in this order.
static TABLE: LazyLock<Vec<Shares>> = LazyLock::new(|| {
    let line = |line: &str| {
        let numbers: Vec<f64> = line.split(',').filter_map(|word| word.parse().ok()).collect();
        numbers.get(3..)?.try_into().ok()
    };
    include_str!("kernels.csv").lines().filter_map(line).collect()
});

type Shares = [f64; COMPONENTS];

/// Electrons per nucleon of water and of cortical bone (NIST's Z/A).
const Z_OVER_A: [f64; 2] = [0.555_08, 0.514_78];
/// Thicknesses at which a C-arm's shares are tabulated.
const STEP_M: f64 = 0.0125;
const STEPS: usize = 41;
/// A patient is not a slab: what thin parts scatter widely crosses the thick part beside them. This share
/// of the difference in thickness counts, and Gaussians up to this width do not. Fitted to Monte Carlo on a
/// thigh and a pelvis at 60 keV (`-- chart`).
const BESIDE: f64 = 0.25;
const NARROW_M: f64 = 0.05;
/// Share of the nodes behind the patient that the thick part's thickness exceeds, and the least thickness
/// that counts as patient.
const THICK_SHARE: f64 = 0.9;
const LEAST_M: f64 = 5e-3;
/// Pixels read per node, along each side.
const SAMPLES: usize = 4;
/// Smallest air gap.
const LEAST_GAP_M: f64 = GAPS_M[0];

/// The neighbours of a value among ascending nodes and the weight of the upper one; values outside are moved
/// to the ends.
fn between(nodes: &[f64], value: f64) -> (usize, f64) {
    let below = nodes.partition_point(|n| *n <= value).clamp(1, nodes.len() - 1) - 1;
    let share = (value - nodes[below]) / (nodes[below + 1] - nodes[below]);
    (below, share.clamp(0.0, 1.0))
}

fn mixed(a: Shares, b: Shares, share: f64) -> Shares {
    core::array::from_fn(|j| a[j] + share * (b[j] - a[j]))
}

/// Scatter over primary of each Gaussian at one of the table's gaps.
fn shares(energy_kev: f64, gap: usize, thickness_m: f64) -> Shares {
    let at = |energy: usize, thickness: usize| {
        let row = (energy * GAPS_M.len() + gap) * THICKNESSES_M.len() + thickness;
        TABLE.get(row).copied().unwrap_or_default()
    };
    let (energy, up) = between(&ENERGIES_KEV, energy_kev);
    let at_thickness = |thickness: usize| mixed(at(energy, thickness), at(energy + 1, thickness), up);
    if thickness_m < THICKNESSES_M[0] {
        return mixed([0.0; COMPONENTS], at_thickness(0), thickness_m.max(0.0) / THICKNESSES_M[0]);
    }
    let (thickness, share) = between(&THICKNESSES_M, thickness_m);
    mixed(at_thickness(thickness), at_thickness(thickness + 1), share)
}

/// Kernels of a beam, for a patient about a point.
#[derive(Debug, Clone)]
pub(super) struct Kernels {
    /// By gap, then thickness in steps of [`STEP_M`].
    by_gap: Vec<Vec<Shares>>,
    centre_m: [f64; 3],
    /// Water's attenuation at the frame's energy.
    water_per_m: f64,
}

impl Kernels {
    /// `centre_m` is the patient's centre of mass, from which the air gap follows; `beam` lists energies and
    /// their shares of the open field's signal.
    pub fn new(beam: &[(f64, f64)], energy_kev: f64, centre_m: [f64; 3]) -> Result<Self, DrrError> {
        let attenuations: Vec<f64> =
            beam.iter().map(|(energy, _)| Material::Water.mu_per_m(*energy)).collect::<Result<_, _>>()?;
        let of_gap = |gap: usize| {
            let of_step = |step: usize| {
                let thickness_m = step as f64 * STEP_M;
                let (mut sum, mut all) = ([0.0; COMPONENTS], 0.0);
                for ((energy, weight), mu) in beam.iter().zip(&attenuations) {
                    let passed = weight * lane_math::exp(-mu * thickness_m);
                    all += passed;
                    let shares = shares(*energy, gap, thickness_m);
                    sum.iter_mut().zip(shares).for_each(|(sum, share)| *sum += passed * share);
                }
                sum.map(|sum| sum / all)
            };
            (0..STEPS).map(of_step).collect()
        };
        let by_gap = (0..GAPS_M.len()).map(of_gap).collect();
        Ok(Self { by_gap, centre_m, water_per_m: Material::Water.mu_per_m(energy_kev)? })
    }

    /// Scatter over primary of each thickness, for a C-arm.
    fn of_c_arm(&self, c_arm: &CArm) -> Vec<Shares> {
        let normal = cross(c_arm.row_axis, c_arm.column_axis);
        let distance_m = dot(sub(c_arm.detector_centre_m, self.centre_m), normal).abs();
        let of_step = |step: usize| {
            let gap_m = (distance_m - 0.5 * STEP_M * step as f64).max(LEAST_GAP_M);
            let (gap, share) = between(&GAPS_M, gap_m);
            mixed(self.by_gap[gap][step], self.by_gap[gap + 1][step], share)
        };
        (0..STEPS).map(of_step).collect()
    }

    /// Scatter on the nodes of a detector, row-major, as a fraction of the open field's signal.
    pub fn image(
        &self,
        c_arm: &CArm,
        anatomy: Anatomy<'_>,
        table: Option<&SpectrumTable>,
        (columns, rows): (usize, usize),
    ) -> Vec<f32> {
        // Thickness of water with the electrons of one metre of cortical bone.
        let water_per_bone = Material::CorticalBone.density_g_per_cm3() * Z_OVER_A[1] / Z_OVER_A[0];
        let by_thickness = self.of_c_arm(c_arm);
        let mut sent = vec![[0.0_f32; COMPONENTS]; columns * rows];
        let mut depths = vec![[0.0; 2]; columns * rows];
        for (node, depth) in depths.iter_mut().enumerate() {
            let of = |image: &[f64]| mean(image, c_arm, (columns, rows), node);
            let total = of(anatomy.total);
            let (attenuation, water_m) = match table {
                None => (total, total / self.water_per_m),
                Some(table) => {
                    let bone_m = of(anatomy.bone_m);
                    (table.attenuation(total, bone_m), total + water_per_bone * bone_m)
                }
            };
            *depth = [attenuation, water_m];
        }
        let thick_m = thick(&depths);
        for (sent, &[attenuation, water_m]) in sent.iter_mut().zip(&depths) {
            let place = (water_m / STEP_M).clamp(0.0, (STEPS - 1) as f64);
            let below = (place as usize).min(STEPS - 2);
            let shares = mixed(by_thickness[below], by_thickness[below + 1], place - below as f64);
            let passed = lane_math::exp(-attenuation);
            let crossed = BESIDE * self.water_per_m * (thick_m - water_m).max(0.0);
            let through = lane_math::exp(-crossed);
            *sent = core::array::from_fn(|j| {
                let left = if SIGMAS_M[j] > NARROW_M { through } else { 1.0 };
                (passed * left * shares[j]) as f32
            });
        }
        let pitch_m = [
            f64::from(c_arm.columns) * c_arm.pixel_pitch_m[0] / columns as f64,
            f64::from(c_arm.rows) * c_arm.pixel_pitch_m[1] / rows as f64,
        ];
        let mut image = vec![0.0; columns * rows];
        let mut work = vec![0.0; columns * rows];
        let arch = Arch::new();
        for (component, sigma_m) in SIGMAS_M.into_iter().enumerate() {
            let amplitudes: Vec<f32> = sent.iter().map(|sent| sent[component]).collect();
            let (across, down) =
                (gaussian(sigma_m, pitch_m[0], columns), gaussian(sigma_m, pitch_m[1], rows));
            work.fill(0.0);
            let (amplitudes, across, down) = (&amplitudes[..], &across[..], &down[..]);
            arch.dispatch(Spread { amplitudes, columns, across, down, work: &mut work, image: &mut image });
        }
        image
    }
}

/// Thickness of the patient's thick part, from attenuation and water of every node.
fn thick(depths: &[[f64; 2]]) -> f64 {
    let mut behind: Vec<f64> =
        depths.iter().map(|depth| depth[1]).filter(|water_m| *water_m > LEAST_M).collect();
    if behind.is_empty() {
        return 0.0;
    }
    let rank = (behind.len() as f64 * THICK_SHARE) as usize;
    *behind.select_nth_unstable_by(rank, f64::total_cmp).1
}

/// Mean over a grid of pixels of one node.
fn mean(image: &[f64], c_arm: &CArm, (columns, rows): (usize, usize), node: usize) -> f64 {
    let range = |i: usize, nodes: usize, pixels: u32| {
        let pixels = pixels as usize;
        let (first, end) = (i * pixels / nodes, (i + 1) * pixels / nodes);
        (first..end).step_by(((end - first) / SAMPLES).max(1))
    };
    let (mut sum, mut count) = (0.0, 0.0);
    for row in range(node / columns, rows, c_arm.rows) {
        for column in range(node % columns, columns, c_arm.columns) {
            sum += image[row * c_arm.columns as usize + column];
            count += 1.0;
        }
    }
    sum / count
}

/// A Gaussian over node distances `-(nodes - 1)..nodes`, times the node's width.
fn gaussian(sigma_m: f64, pitch_m: f64, nodes: usize) -> Vec<f32> {
    let height = pitch_m / (sigma_m * (2.0 * core::f64::consts::PI).sqrt());
    let at = |i: usize| {
        let z = (i as f64 - (nodes - 1) as f64) * pitch_m / sigma_m;
        (height * lane_math::exp(-0.5 * z * z)) as f32
    };
    (0..2 * nodes - 1).map(at).collect()
}

lanes! {
    /// Adds the amplitudes, spread by a Gaussian along rows and along columns, to the image.
    Spread {
        amplitudes: &'a [f32],
        columns: usize,
        across: &'a [f32],
        down: &'a [f32],
        work: &'a mut [f32],
        image: &'a mut [f32],
    } -> () {
        let rows = amplitudes.len() / columns;
        for (sent, spread) in amplitudes.chunks(columns).zip(work.chunks_mut(columns)) {
            for (column, amplitude) in sent.iter().enumerate().filter(|(_, amplitude)| **amplitude != 0.0) {
                add_scaled_row(spread, *amplitude, &across[columns - 1 - column..]);
            }
        }
        for (row, out) in image.chunks_mut(columns).enumerate() {
            for (from, spread) in work.chunks(columns).enumerate() {
                add_scaled_row(out, down[rows - 1 + row - from], spread);
            }
        }
    }
}
