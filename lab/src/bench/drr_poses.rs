//! Times (ms) of X-ray line integrals from all sides, as multiples of the frontal frame's: a C-arm around a
//! field of 500 mm, with the detector behind, inside and in front of corners of the volume, and with the
//! source inside its box.

use drr_proc::ThisMachine;
use rayon::prelude::*;
use xray::ray::{IndexRay, RayFan};
use xray::reference;
use xray::removal::{AttenuationField, BlockMap, RemovedVoxels};
use xray::slice_ordered::{SliceOrdered, SliceOrderedOptions, Update};
use xray::{CArm, DetectorFormat, DrrError, Grid, Material, MuTable, PositionerAngles, VolumeView, joseph};

use serde_json::json;

use super::drr::Times;
use super::failed;
use crate::phantom::{Phantom, Solid};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::machine::Machine;

/// Distances from the source to the isocentre and to the detector, m. The first is that of `trabecula drr`.
const C_ARMS: [(f64, f64); 4] = [(0.7, 1.0), (0.7, 1.2), (0.7, 0.8), (0.2, 0.5)];
/// Edge of the field in the slices, and height of the volume, m.
const FIELD_M: f64 = 0.5;
/// Pixels of the detector along an edge, and their pitch.
const SIDE: u32 = 512;
const PITCH_M: f64 = 0.6e-3;
/// Photon energy, keV.
const ENERGY_KEV: f64 = 60.0;
const THREADS: usize = 2;

/// A pose and its times.
struct Pose {
    c_arm: CArm,
    distances_m: (f64, f64),
    degrees: (f64, f64),
    times: Times,
    /// Times of the frontal frame just before each.
    frontal: Times,
    /// Number of intermediate images, and of their samples.
    images: (usize, usize),
}

impl Pose {
    fn ratio(&self) -> f64 {
        self.times.ratio_to(&self.frontal)
    }
}

/// Times `count` poses, alternating with the frontal one, in a volume of these dimensions, filled with tissue
/// and with a thigh.
///
/// # Errors
/// A volume too large for memory.
pub fn run(dimensions: [usize; 3], count: usize, rounds: usize, sheet: &mut Sheet) -> Result<(), Failure> {
    let grid =
        Grid::centred(dimensions, dimensions.map(|n| FIELD_M / n as f64)).map_err(Failure::bad_input)?;
    // At size 1 the thigh is 190 x 160 mm thick; at this size 396 x 333 mm, and longer than the volume.
    let thigh = reference::thigh(FIELD_M / 0.24).into_iter().map(Solid::Ellipsoid).collect();
    let machine = Machine::watch();
    sheet.line(&format!(
        "volume {dimensions:?}, {FIELD_M} m; {SIDE} x {SIDE} pixels, {THREADS} threads; ms as minimum \
         (median) of {rounds} rounds, ratios to the frontal frame just before"
    ));
    for (name, key, hu) in [
        ("tissue in every voxel", "tissue", vec![100; grid.voxels()]),
        ("thigh of 396 x 333 mm", "thigh", Phantom { solids: thigh }.voxelise(&grid, 2)),
    ] {
        sheet.line(&format!("\n{name}:"));
        let view = VolumeView::new(grid, &hu).map_err(failed)?;
        sheet.within(key, |sheet| from_all_sides(&view, count, rounds, sheet))?;
    }
    sheet.machine(&machine);
    Ok(())
}

fn c_arm(degrees: (f64, f64), distances_m: (f64, f64)) -> Result<CArm, DrrError> {
    let format = DetectorFormat { columns: SIDE, rows: SIDE, pixel_pitch_m: [PITCH_M; 2] };
    let angles = PositionerAngles::from_degrees(degrees.0, degrees.1);
    CArm::from_positioner_angles([0.0; 3], angles, distances_m.0, distances_m.1, format)
}

/// Returns directions spread evenly over the sphere (Fibonacci lattice), cycling through the distances of the
/// C-arms.
fn poses(count: usize) -> Result<Vec<Pose>, DrrError> {
    let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
    let pose = |n: usize| {
        let height = 1.0 - (2 * n + 1) as f64 / count as f64;
        let degrees = (360.0 * (n as f64 * golden).fract() - 180.0, height.asin().to_degrees());
        let distances_m = C_ARMS[n % C_ARMS.len()];
        let (c_arm, times) = (c_arm(degrees, distances_m)?, Times::default());
        Ok(Pose { c_arm, distances_m, degrees, frontal: times.clone(), times, images: (0, 0) })
    };
    (0..count).map(pose).collect()
}

fn from_all_sides(
    view: &VolumeView<'_>,
    count: usize,
    rounds: usize,
    sheet: &mut Sheet,
) -> Result<(), Failure> {
    let removed = RemovedVoxels::new(view.grid());
    let table = MuTable::new(ENERGY_KEV, -900).map_err(failed)?;
    let unit_per_m = Material::Water.mu_per_m(ENERGY_KEV).map_err(failed)? / 1000.0;
    let options = SliceOrderedOptions::default();
    let mut slices =
        SliceOrdered::new(view, &table, unit_per_m, 0.0, options, &ThisMachine).map_err(failed)?;
    let pool = super::drr::pool(THREADS)?;
    let mut poses = poses(count).map_err(failed)?;
    let frontal = c_arm((0.0, 0.0), C_ARMS[0]).map_err(failed)?;
    for c_arm in poses.iter().map(|pose| &pose.c_arm).chain([&frontal]) {
        pool.install(|| slices.prepare(view, &removed, c_arm)).map_err(failed)?;
    }
    // As in the running hub, the image memory has been written before.
    let mut image = vec![1.0; frontal.pixels()];
    let mut project = |c_arm: &CArm, times: &mut Times| -> Result<(usize, usize), Failure> {
        let update = times.add(|| pool.install(|| slices.project(view, &removed, c_arm, &mut image)));
        match update.map_err(failed)? {
            Update::Full => Ok((slices.sums().images, slices.sums().values.len())),
            other => Err(Failure::failed(format!("not a full frame: {other:?}"))),
        }
    };
    let mut of_frontal = (0, 0);
    for _ in 0..rounds {
        for pose in &mut poses {
            of_frontal = project(&frontal, &mut pose.frontal)?;
            pose.images = project(&pose.c_arm, &mut pose.times)?;
        }
    }
    let frontal = &poses[0].frontal;
    let text = format!("{}; {}", frontal.text(), images_text(of_frontal));
    sheet.row("frontal", &text, "frontal", frontal.figures());
    for distances_m in C_ARMS {
        tell_ratios(&poses, distances_m, sheet);
    }
    let by_ray = ray_by_ray(view, &table, &poses[0], &pool)?;
    sheet.row("the first pose ray by ray (joseph), once", &by_ray.text(), "ray_by_ray", by_ray.figures());
    Ok(())
}

fn tell_ratios(poses: &[Pose], distances_m: (f64, f64), sheet: &mut Sheet) {
    let mut of: Vec<&Pose> = poses.iter().filter(|pose| pose.distances_m == distances_m).collect();
    of.sort_by(|a, b| a.ratio().total_cmp(&b.ratio()));
    let (Some(least), Some(worst)) = (of.first(), of.last()) else { return };
    let (source_mm, detector_mm) = (distances_m.0 * 1e3, distances_m.1 * 1e3);
    let (primary, secondary) = worst.degrees;
    let median = of[of.len() / 2].ratio();
    let text = format!(
        "{:.2} minimum, {median:.2} median, {:.2} worst (at {primary:.0}, {secondary:.0} degrees: {}; {})",
        least.ratio(),
        worst.ratio(),
        worst.times.text(),
        images_text(worst.images)
    );
    let name = format!("{} poses, source {source_mm} mm, detector {detector_mm} mm", of.len());
    sheet.line(&format!("{name:<46} {text}"));
    sheet.push(
        "ratios_to_frontal",
        json!({
            "poses": of.len(), "source_mm": source_mm, "detector_mm": detector_mm, "least": least.ratio(),
            "median": median, "worst": worst.ratio(), "worst_angles_deg": [primary, secondary],
            "worst_images": worst.images.0, "worst_samples": worst.images.1,
        }),
    );
}

fn images_text((images, samples): (usize, usize)) -> String {
    format!("{images} images, {:.2} M samples", samples as f64 * 1e-6)
}

/// Renders the same frame with the projector `joseph`.
fn ray_by_ray(
    view: &VolumeView<'_>,
    table: &MuTable,
    pose: &Pose,
    pool: &rayon::ThreadPool,
) -> Result<Times, Failure> {
    let (removed, blocks) = (RemovedVoxels::new(view.grid()), BlockMap::new(view, table));
    let field =
        AttenuationField { view: *view, removed: &removed, blocks: &blocks, table, fill_mu_per_m: 0.0 };
    let fan = RayFan::new(view.grid(), &pose.c_arm);
    let mut image = vec![1.0; pose.c_arm.pixels()];
    let mut times = Times::default();
    times.add(|| {
        pool.install(|| {
            image.par_chunks_mut(SIDE as usize).zip(0_u32..SIDE).for_each(|(line, row)| {
                for (value, column) in line.iter_mut().zip(0_u32..) {
                    let ray = IndexRay::new(view.grid(), &fan.world_ray(column, row));
                    *value = joseph::line_integral(&field, &ray);
                }
            });
        });
    });
    std::hint::black_box(&image);
    Ok(times)
}
