//! Times many poses of one volume, alternating: frames one by one, and as one batch.

use std::path::Path;
use std::time::Instant;

use drr_proc::ThisMachine;
use serde_json::json;
use xray::{
    CArm, DetectorFormat, DetectorParameters, DrrParameters, DrrRenderer, FrameSeed, Grid, Output,
    PositionerAngles, Shot, Tool, VolumeView,
};

use super::drr::thigh;
use super::failed;
use super::samples::median;
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::machine::Machine;

/// The real CT, and the folder in which it is searched; it is not part of the project.
const REAL_CT: &str = "totalsegmentator_example/example_ct.nii.gz";
const SHARED_DATA: &str = "../shared/data";
/// Pixels of the detector along an edge, and their pitch.
const SIDE: u32 = 512;
const PITCH_M: f64 = 0.6e-3;
const THREADS: usize = 2;
/// Voxel size of the thigh.
const SPACING_M: f64 = 0.5e-3;

/// Poses around a point.
struct Poses {
    name: &'static str,
    key: &'static str,
    c_arms: Vec<CArm>,
}

/// Renders `count` poses of a sweep and of a registration, in the thigh with these dimensions and in the real
/// CT if available.
///
/// # Errors
/// A volume that cannot be read or is too large for memory; a frame of a batch that is not bit-identical to
/// the single frame.
pub fn run(dimensions: [usize; 3], count: usize, rounds: usize, sheet: &mut Sheet) -> Result<(), Failure> {
    let machine = Machine::watch();
    sheet.line(&format!(
        "{count} poses, {SIDE} x {SIDE} pixels, {THREADS} threads; frames per second as best \
         (median) of {rounds} alternating rounds, \
         ratio as median of the rounds\n"
    ));
    let grid = Grid::centred(dimensions, [SPACING_M; 3]).map_err(Failure::bad_input)?;
    let hu = thigh(&grid, dimensions, SPACING_M);
    let view = VolumeView::new(grid, &hu).map_err(failed)?;
    sheet.line(&format!("thigh, {dimensions:?} voxels of 0.5 mm:"));
    sheet.within("thigh", |sheet| in_turn(&view, [0.0; 3], count, rounds, sheet))?;
    let folder = std::env::var_os("TRABECULA_SHARED_DATA").unwrap_or_else(|| SHARED_DATA.into());
    let path = Path::new(&folder).join(REAL_CT);
    if path.exists() {
        let (volume, _) = volume_io::read_as(&path, &volume_io::ReadOptions::default())?;
        let (view, dims) = (VolumeView::try_from(&volume).map_err(failed)?, volume.grid.dims());
        let centre_m = volume.grid.world_m(dims.map(|n| 0.5 * (n as f64 - 1.0)));
        sheet.line(&format!("\nabdomen of TotalSegmentator, {dims:?} voxels of 3 mm:"));
        sheet.within("abdomen", |sheet| in_turn(&view, centre_m, count, rounds, sheet))?;
    } else {
        let path = path.display();
        sheet.line(&format!("\n*** SKIPPED: {path} not found; set TRABECULA_SHARED_DATA ***"));
    }
    sheet.machine(&machine);
    Ok(())
}

/// Poses of a C-arm rotated through 180 degrees, and poses within 5 degrees and 10 mm of an oblique one, as
/// tried by a registration.
fn poses(centre_m: [f64; 3], count: usize) -> Result<[Poses; 2], Failure> {
    let format = DetectorFormat { columns: SIDE, rows: SIDE, pixel_pitch_m: [PITCH_M; 2] };
    let c_arm = |degrees: (f64, f64), shift_m: [f64; 3]| {
        let isocentre_m = [0, 1, 2].map(|axis| centre_m[axis] + shift_m[axis]);
        let angles = PositionerAngles::from_degrees(degrees.0, degrees.1);
        CArm::from_positioner_angles(isocentre_m, angles, 0.7, 1.0, format).map_err(failed)
    };
    let turned = |n: usize| c_arm((180.0 * n as f64 / count as f64 - 90.0, 0.0), [0.0; 3]);
    let mut random = fastrand::Rng::with_seed(1);
    let mut within = |most: f64| most * (2.0 * random.f64() - 1.0);
    let about = (0..count).map(|_| {
        let degrees = (37.0 + within(5.0), 18.0 + within(5.0));
        c_arm(degrees, [within(10e-3), within(10e-3), within(10e-3)])
    });
    Ok([
        Poses {
            name: "about an oblique pose",
            key: "registration",
            c_arms: about.collect::<Result<_, _>>()?,
        },
        Poses {
            name: "sweep of 180 degrees",
            key: "sweep",
            c_arms: (0..count).map(turned).collect::<Result<_, _>>()?,
        },
    ])
}

fn in_turn(
    view: &VolumeView<'_>,
    centre_m: [f64; 3],
    count: usize,
    rounds: usize,
    sheet: &mut Sheet,
) -> Result<(), Failure> {
    let detector =
        DetectorParameters { quantum_noise: false, blur_sigma_px: 0.0, ..DetectorParameters::default() };
    let parameters = DrrParameters { threads: THREADS, detector, ..DrrParameters::default() };
    let renderer = DrrRenderer::new(view, parameters, &ThisMachine).map_err(failed)?;
    let mut renders = Renders { renderer, view, tool: Tool::default() };
    for Poses { name, key, c_arms } in poses(centre_m, count)? {
        let (mut single, mut batch) = (Vec::new(), Vec::new());
        // The first round uses memory that has been written to.
        for round in 0..=rounds {
            let (one, alone) = timed(c_arms.len(), |images| renders.one_by_one(&c_arms, images))?;
            let (many, together) = timed(c_arms.len(), |images| renders.at_once(&c_arms, images))?;
            if alone != together {
                return Err(Failure::failed("a frame of a batch differs from the single frame"));
            }
            if round > 0 {
                single.push(one);
                batch.push(many);
            }
        }
        let ratio = median(&batch.iter().zip(&single).map(|(many, one)| many / one).collect::<Vec<f64>>());
        let best = |rates: &[f64]| rates.iter().copied().fold(0.0, f64::max);
        let text = |rates: &[f64]| format!("{:.1} ({:.1})", best(rates), median(rates));
        let figures = json!({
            "single_per_s": median(&single), "batch_per_s": median(&batch),
            "ratio": ratio, "poses": c_arms.len(),
        });
        let text = format!("{} single, {} as a batch: {ratio:.2} times", text(&single), text(&batch));
        sheet.row(name, &text, key, figures);
    }
    Ok(())
}

/// Returns frames per second, and the frames.
fn timed(
    count: usize,
    render: impl FnOnce(&mut [Vec<u16>]) -> Result<(), Failure>,
) -> Result<(f64, Vec<Vec<u16>>), Failure> {
    // Written to before, as in a long-running program.
    let mut images = vec![vec![1; (SIDE * SIDE) as usize]; count];
    let began = Instant::now();
    render(&mut images)?;
    Ok((count as f64 / began.elapsed().as_secs_f64(), images))
}

/// Renders frames of a volume in both ways.
struct Renders<'a> {
    renderer: DrrRenderer,
    view: &'a VolumeView<'a>,
    tool: Tool,
}

impl Renders<'_> {
    fn one_by_one(&mut self, c_arms: &[CArm], images: &mut [Vec<u16>]) -> Result<(), Failure> {
        let Self { renderer, view, tool } = self;
        c_arms.iter().zip(images).try_for_each(|(c_arm, image)| {
            renderer.render(view, c_arm, tool, FrameSeed::default(), image).map(drop).map_err(failed)
        })
    }

    fn at_once(&mut self, c_arms: &[CArm], images: &mut [Vec<u16>]) -> Result<(), Failure> {
        let Self { renderer, view, tool } = self;
        let seed = FrameSeed::default();
        let shot = |(c_arm, image)| Shot { c_arm, tool, seed, output: Output::Mono16(image) };
        let images = images.iter_mut().map(|image| &mut image[..]);
        let mut shots: Vec<Shot<'_>> = c_arms.iter().copied().zip(images).map(shot).collect();
        renderer.render_batch(view, &mut shots).map(drop).map_err(failed)
    }
}
