//! Times X-ray line integrals (ms), with their error and this machine's memory bandwidth for comparison.

use std::time::Instant;

use drr_proc::ThisMachine;
use rayon::prelude::*;
use xray::ray::{IndexRay, RayFan};
use xray::reference::{self, relative_rms};
use xray::removal::{AttenuationField, BlockMap, RemovedVoxels};
use xray::slice_ordered::{Instructions, SliceOrdered, SliceOrderedOptions, Update};
use xray::{CArm, DetectorFormat, DrrError, Grid, Material, MuTable, PositionerAngles, VolumeView, siddon};

use serde_json::json;

use super::failed;
use crate::phantom::{Phantom, Solid};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::machine::Machine;

/// Poses by primary and secondary angle, degrees.
const POSES: [(&str, f64, f64); 3] = [("ap", 0.0, 0.0), ("oblique", 37.0, 18.0), ("lateral", 90.0, 5.0)];
/// Sampling stride of the error in both directions, because Siddon's method is slow.
const ERROR_STRIDE: u32 = 8;
/// Voxel size up to 512 voxels along an edge; larger volumes get smaller voxels, so that the C-arm still fits
/// around them.
const SPACING_M: f64 = 0.5e-3;
/// Field of view of the detector, m.
const FIELD_M: f64 = 0.307;
/// Photon energy, keV.
const ENERGY_KEV: f64 = 60.0;

/// Times of one case over several rounds.
#[derive(Debug, Clone, Default)]
pub(super) struct Times(Vec<f64>);

impl Times {
    pub(super) fn add<T>(&mut self, what: impl FnOnce() -> T) -> T {
        let began = Instant::now();
        let result = what();
        self.0.push(began.elapsed().as_secs_f64() * 1e3);
        result
    }

    pub(super) fn least(&self) -> f64 {
        self.0.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// Returns the median ratio of these times to those of another, taken alternately.
    pub(super) fn ratio_to(&self, other: &Times) -> f64 {
        let ratios: Vec<f64> = self.0.iter().zip(&other.0).map(|(mine, other)| mine / other).collect();
        super::samples::median(&ratios)
    }

    pub(super) fn figures(&self) -> serde_json::Value {
        json!({"least_ms": self.least(), "median_ms": super::samples::median(&self.0)})
    }

    pub(super) fn text(&self) -> String {
        format!("{:8.3} ({:.3})", self.least(), super::samples::median(&self.0))
    }
}

pub(super) fn pool(threads: usize) -> Result<rayon::ThreadPool, Failure> {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().map_err(failed)
}

pub(super) fn pose(primary: f64, secondary: f64, side: u32) -> Result<CArm, DrrError> {
    let format = DetectorFormat { columns: side, rows: side, pixel_pitch_m: [FIELD_M / f64::from(side); 2] };
    let angles = PositionerAngles::from_degrees(primary, secondary);
    CArm::from_positioner_angles([0.0; 3], angles, 0.7, 1.0, format)
}

/// Returns a thigh as wide as the volume: at size 1 it fills 240 x 200 x 320 mm; it extends beyond the ends
/// of a shorter volume.
pub(super) fn thigh(grid: &Grid, dimensions: [usize; 3], spacing_m: f64) -> Vec<i16> {
    let size = dimensions[0].min(dimensions[1]) as f64 * spacing_m / 0.24;
    let solids = reference::thigh(size).into_iter().map(Solid::Ellipsoid).collect();
    Phantom { solids }.voxelise(grid, 2)
}

/// Renders a phantom of these dimensions `rounds` times from three sides.
///
/// # Errors
/// A volume too large for memory.
pub fn run(dimensions: [usize; 3], rounds: usize, sheet: &mut Sheet) -> Result<(), Failure> {
    let longest = dimensions.into_iter().max().unwrap_or(1);
    let spacing_m = SPACING_M * (512.0 / longest as f64).min(1.0);
    let grid = Grid::centred(dimensions, [spacing_m; 3]).map_err(Failure::bad_input)?;
    let hu = thigh(&grid, dimensions, spacing_m);
    let view = VolumeView::new(grid, &hu).map_err(failed)?;
    let machine = Machine::watch();
    sheet.line(&format!(
        "volume {dimensions:?}, {spacing_m} m; ms as minimum (median) of {rounds} interleaved rounds\n"
    ));
    let bandwidth = bandwidth(&hu, rounds, sheet)?;
    for instructions in Instructions::available() {
        // Scalar code is the reference for correctness, not speed.
        let rounds = if instructions == Instructions::SCALAR { rounds.min(3) } else { rounds };
        frames(&view, instructions, rounds, bandwidth, sheet)?;
    }
    errors(&view, sheet)?;
    removals(&view, sheet)?;
    super::drr_layers::run(&view, rounds, sheet)?;
    sheet.machine(&machine);
    Ok(())
}

/// Returns the sequential read bandwidth of one and two threads, bytes per second.
fn bandwidth(hu: &[i16], rounds: usize, sheet: &mut Sheet) -> Result<[f64; 2], Failure> {
    let mut rates = [0.0; 2];
    for (rate, threads) in rates.iter_mut().zip([1, 2]) {
        let (pool, mut times) = (pool(threads)?, Times::default());
        for _ in 0..rounds {
            let read = || hu.par_chunks(1 << 19).map(xor).reduce(|| 0, |a, b| a ^ b);
            std::hint::black_box(times.add(|| pool.install(read)));
        }
        *rate = size_of_val(hu) as f64 / times.least() * 1e3;
        sheet.line(&format!("{:<46} {:.1} GB/s", format!("streaming read, {threads} threads"), *rate * 1e-9));
        sheet.push("streaming_read", json!({"threads": threads, "bytes_per_s": *rate}));
    }
    Ok(rates)
}

fn xor(values: &[i16]) -> i16 {
    values.iter().fold(0, |all, v| all ^ v)
}

fn projector(view: &VolumeView<'_>, options: SliceOrderedOptions) -> Result<SliceOrdered, Failure> {
    let table = MuTable::new(ENERGY_KEV, -900).map_err(failed)?;
    let unit_per_m = Material::Water.mu_per_m(ENERGY_KEV).map_err(failed)? / 1000.0;
    SliceOrdered::new(view, &table, unit_per_m, 0.0, options, &ThisMachine).map_err(failed)
}

fn frames(
    view: &VolumeView<'_>,
    instructions: Instructions,
    rounds: usize,
    bandwidth: [f64; 2],
    sheet: &mut Sheet,
) -> Result<(), Failure> {
    let removed = RemovedVoxels::new(view.grid());
    let options = SliceOrderedOptions { instructions, ..SliceOrderedOptions::default() };
    let mut slices = projector(view, options)?;
    for (_, primary, secondary) in POSES {
        let c_arm = pose(primary, secondary, 64).map_err(failed)?;
        pool(2)?.install(|| slices.prepare(view, &removed, &c_arm)).map_err(failed)?;
    }
    // Times by pose, number of threads, and detector size. The pose changes between frames, so each frame is
    // rendered in full.
    let cases = [(1, 512), (2, 512), (1, 1024), (2, 1024)];
    let mut times = vec![Times::default(); POSES.len() * cases.len()];
    let pools = [pool(1)?, pool(2)?];
    for _ in 0..rounds {
        for (case, (threads, side)) in cases.into_iter().enumerate() {
            let pool = &pools[threads - 1];
            // As in the running hub, the image memory has been written before.
            let mut image = vec![1.0; side as usize * side as usize];
            for (which, (_, primary, secondary)) in POSES.into_iter().enumerate() {
                let c_arm = pose(primary, secondary, side).map_err(failed)?;
                let project = || slices.project(view, &removed, &c_arm, &mut image);
                let update =
                    times[which * cases.len() + case].add(|| pool.install(project)).map_err(failed)?;
                if update != Update::Full {
                    return Err(Failure::failed(format!("not a full frame: {update:?}")));
                }
            }
        }
    }
    let memory = slices.memory();
    let name = instructions.name();
    let figures = json!({"total_bytes": memory.total(), "copies_bytes": memory.copies});
    let text = format!("{:.1} MB", memory.total() as f64 * 1e-6);
    sheet.row(&format!("{name}: memory incl. intermediate image"), &text, &format!("memory_{name}"), figures);
    let copies = memory.copies.map(|bytes| format!("{:.1}", bytes as f64 * 1e-6)).join(" + ");
    sheet.line(&format!("{:<46} {copies}", format!("{name}: copies across x, y, z, MB")));
    let shares = slices.cell_shares().map(Option::unwrap_or_default);
    let text =
        shares.map(|share| format!("{:.0}/{:.0}", 100.0 * share.occupied, 100.0 * share.mixed)).join(" ");
    sheet.line(&format!("{:<46} {text}", format!("{name}: cells not air / with several values, %")));
    for ((pose, ..), times) in POSES.iter().zip(times.chunks(4)) {
        let [one, two, one_large, two_large] = times else { continue };
        // Across x from the side, otherwise across y.
        let slow = usize::from(*pose != "lateral");
        let bytes = memory.copies[slow] as f64 * shares[slow].occupied;
        let share = |times: &Times, rate: f64| 100.0 * bytes / rate / (times.least() * 1e-3);
        let text = format!("{} {}; {} {}", one.text(), two.text(), one_large.text(), two_large.text());
        sheet.line(&format!("{:<46} {text}", format!("{name} {pose}: 512, 1 and 2 threads; 1024")));
        let shares = [share(one, bandwidth[0]), share(two, bandwidth[1])];
        let text = format!("{:.0} %, {:.0} % (512)", shares[0], shares[1]);
        sheet.line(&format!("{:<46} {text}", "  of the streaming rate over non-air voxels"));
        sheet.push(
            "frames",
            json!({
                "instructions": name, "pose": pose, "side_512_by_threads": [one.figures(), two.figures()],
                "side_1024_by_threads": [one_large.figures(), two_large.figures()],
                "streaming_percent_by_threads": shares,
            }),
        );
    }
    Ok(())
}

/// Errors against Siddon's method on the same voxels.
fn errors(view: &VolumeView<'_>, sheet: &mut Sheet) -> Result<(), Failure> {
    let (removed, pool) = (RemovedVoxels::new(view.grid()), pool(2)?);
    let table = MuTable::new(ENERGY_KEV, -900).map_err(failed)?;
    let blocks = BlockMap::new(view, &table);
    let field = AttenuationField {
        view: *view,
        removed: &removed,
        blocks: &blocks,
        table: &table,
        fill_mu_per_m: 0.0,
    };
    let rungs = [
        ("os 1", SliceOrderedOptions::default()),
        ("os 1, not sharpened", SliceOrderedOptions { sharpen: false, ..SliceOrderedOptions::default() }),
        ("os 0.9", SliceOrderedOptions { oversampling: 0.9, ..SliceOrderedOptions::default() }),
        ("os 0.8", SliceOrderedOptions { oversampling: 0.8, ..SliceOrderedOptions::default() }),
        ("os 1.5", SliceOrderedOptions { oversampling: 1.5, ..SliceOrderedOptions::default() }),
        ("preview 2", SliceOrderedOptions { reduction: 2, ..SliceOrderedOptions::default() }),
    ];
    for (name, options) in rungs {
        let mut slices = projector(view, options)?;
        let mut text = String::new();
        for (pose_name, primary, secondary) in POSES {
            let c_arm = pose(primary, secondary, 512).map_err(failed)?;
            let fan = RayFan::new(view.grid(), &c_arm);
            let mut image = vec![0.0; c_arm.pixels()];
            let mut times = Times::default();
            pool.install(|| slices.prepare(view, &removed, &c_arm)).map_err(failed)?;
            times
                .add(|| pool.install(|| slices.project(view, &removed, &c_arm, &mut image)))
                .map_err(failed)?;
            let some: Vec<(u32, u32)> = (0..512 / ERROR_STRIDE)
                .flat_map(|r| (0..512 / ERROR_STRIDE).map(move |c| (c * ERROR_STRIDE, r * ERROR_STRIDE)))
                .collect();
            let exact: Vec<f64> = pool.install(|| {
                let trace = |&(c, r): &(u32, u32)| {
                    let ray = IndexRay::new(view.grid(), &fan.world_ray(c, r));
                    siddon::line_integral(&field, &ray, (0.0, 1.0))
                };
                some.par_iter().map(trace).collect()
            });
            let got: Vec<f64> = some.iter().map(|&(c, r)| image[(r * 512 + c) as usize]).collect();
            let error_rel = relative_rms(&got, &exact);
            text.push_str(&format!("{error_rel:.2e} ({:.1} ms)  ", times.least()));
            let frame_ms = times.least();
            let figures =
                json!({"rung": name, "pose": pose_name, "error_rel": error_rel, "frame_ms": frame_ms});
            sheet.push("errors_from_siddon", figures);
        }
        sheet.line(&format!("{:<46} {text}", format!("rel. rms from Siddon, {name}")));
    }
    Ok(())
}

/// Times updates after removals around the centre of the bone, and scattered over the volume.
fn removals(view: &VolumeView<'_>, sheet: &mut Sheet) -> Result<(), Failure> {
    let (pool, c_arm) = (pool(2)?, pose(37.0, 18.0, 512).map_err(failed)?);
    let mut image = vec![0.0; c_arm.pixels()];
    let mut removed = RemovedVoxels::new(view.grid());
    let mut slices = projector(view, SliceOrderedOptions::default())?;
    pool.install(|| slices.project(view, &removed, &c_arm, &mut image)).map_err(failed)?;
    let dims = view.grid().dims();
    let mut ball = by_distance(view, dims.map(|n| n / 2)).into_iter();
    for count in [10, 100, 1000, 10_000, 100_000] {
        let mut times = Times::default();
        let mut kind = Update::Unchanged;
        for _ in 0..if count < 10_000 { 20 } else { 1 } {
            let batch: Vec<usize> = ball.by_ref().take(count).collect();
            times.add(|| -> Result<(), Failure> {
                for &linear in &batch {
                    if removed.insert(linear) {
                        slices.remove(view, linear).map_err(failed)?;
                    }
                }
                // As in the renderer, a few changes are applied without waking the worker threads.
                kind = match slices.refresh(&c_arm, &mut image) {
                    None => {
                        let project = || slices.project(view, &removed, &c_arm, &mut image);
                        pool.install(project).map_err(failed)?
                    }
                    Some(update) => update,
                };
                Ok(())
            })?;
        }
        let how = if kind == Update::Full { "full" } else { "incremental" };
        let name = format!("update after {count} neighbouring removals, ms");
        sheet.line(&format!("{name:<46} {} {how}", times.text()));
        sheet.push("updates", json!({"removals": count, "times": times.figures(), "how": how}));
    }
    Ok(())
}

/// Returns attenuating voxels, sorted by their distance from a voxel.
fn by_distance(view: &VolumeView<'_>, centre: [usize; 3]) -> Vec<usize> {
    const REACH: i64 = 60;
    let grid = view.grid();
    let mut voxels = Vec::new();
    for z in -REACH..=REACH {
        for y in -REACH..=REACH {
            for x in -REACH..=REACH {
                let place = [(centre[0], x), (centre[1], y), (centre[2], z)];
                let voxel = place.map(|(c, d)| c.wrapping_add_signed(d as isize));
                if let Some(linear) = grid.linear_of(voxel).filter(|&l| view.hu()[l] > -900) {
                    voxels.push((x * x + y * y + z * z, linear));
                }
            }
        }
    }
    voxels.sort_unstable();
    voxels.into_iter().map(|(_, linear)| linear).collect()
}
