//! `trabecula-lab chart drr`: each projector's error against its time, on a phantom with line integrals in
//! closed form.
//!
//! The phantom's box is 256 x 256 x 200 mm, at full resolution 512 x 512 x 400 voxels of 0.5 mm; source to
//! isocentre 700 mm, to the detector 1000 mm, detector 307 mm square. Times are those of a full frame at a
//! new pose, without noise and blur, as minimum and median over rounds; errors are relative to the root mean
//! square (r.m.s.) and the maximum of the reference.

mod figure;
mod peers;
mod rungs;
mod spectrum;
mod table;

use std::path::PathBuf;
use std::time::Instant;

use drr_proc::ThisMachine;
use xray::ray::RayFan;
use xray::{
    CArm, DetectorFormat, DetectorParameters, DisplayParameters, DrrParameters, DrrRenderer, FrameSeed, Grid,
    Material, PositionerAngles, Projector, Tool, VolumeView, Window,
};

use crate::phantom::Phantom;
use trabecula::failure::Failure;
use trabecula::output::{refuse_existing, within};

/// Measurements and output of the chart.
#[derive(Debug, Clone)]
pub struct Plan {
    pub out: PathBuf,
    pub quick: bool,
    pub peers: Option<PathBuf>,
    pub rounds: usize,
    /// If set, write this file of projector errors instead of a chart.
    pub rungs: Option<PathBuf>,
}

/// One point of the chart.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// Projector, or peer.
    pub method: String,
    /// Voxel size as a multiple of the full-resolution one.
    pub coarseness: usize,
    pub pose: &'static str,
    pub threads: usize,
    /// Time of each round.
    pub times_ms: Vec<f64>,
    /// Errors against the closed-form line integrals, and against Siddon's sum in f64 at full resolution.
    pub exact: Errors,
    pub siddon: Errors,
}

impl Point {
    /// Minimum and median over the rounds.
    pub fn least_and_median_ms(&self) -> (f64, f64) {
        let mut times = self.times_ms.clone();
        times.sort_by(f64::total_cmp);
        (times.first().copied().unwrap_or(0.0), times.get(times.len() / 2).copied().unwrap_or(0.0))
    }

    /// Whether the point is a peer's.
    pub fn is_peer(&self) -> bool {
        self.method.starts_with("peer:")
    }
}

/// Differences between an image and a reference, relative to the reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Errors {
    pub rms: f64,
    pub max: f64,
}

impl Errors {
    /// Errors of `image` against `reference`.
    pub fn of(image: &[f64], reference: &[f64]) -> Errors {
        let largest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
        let difference = largest(&mut image.iter().zip(reference).map(|(a, b)| (a - b).abs()));
        let scale = largest(&mut reference.iter().map(|b| b.abs()));
        Errors { rms: xray::reference::relative_rms(image, reference), max: difference / scale }
    }
}

/// A pose with its references.
pub struct PosedReference {
    pub name: &'static str,
    pub c_arm: CArm,
    pub exact: Vec<f64>,
    pub siddon: Vec<f64>,
}

/// The default projector, timed again after each peer.
pub const STANDARD: (&str, Projector) = ("slice_ordered 1", Projector::SLICE_ORDERED);

/// The projectors of the chart, from exact to fast.
fn projectors() -> Vec<(&'static str, Projector)> {
    let slices = |oversampling, sharpen| Projector::SliceOrdered { oversampling, sharpen };
    vec![
        ("siddon", Projector::Siddon),
        ("joseph", Projector::Joseph),
        ("slice_ordered 1, unsharpened", slices(1.0, false)),
        STANDARD,
        ("slice_ordered 0.9", slices(0.9, true)),
        ("slice_ordered 0.8", slices(0.8, true)),
        ("slice_ordered 1.5", slices(1.5, true)),
        ("slice_ordered 2", slices(2.0, true)),
        ("preview 2", Projector::PREVIEW),
        ("preview 4", Projector::Preview { reduction: 4 }),
    ]
}

/// Frontal, oblique and lateral.
const POSES: [(&str, f64, f64); 3] = [("frontal", 0.0, 0.0), ("oblique", 37.0, 18.0), ("lateral", 90.0, 5.0)];
const EDGE_M: [f64; 3] = [0.256, 0.256, 0.2];

/// A voxelised phantom.
pub struct Sample {
    pub grid: Grid,
    pub hu: Vec<i16>,
    pub coarseness: usize,
}

/// Runs the chart.
///
/// # Errors
/// A file that cannot be written (1).
pub fn run(plan: &Plan) -> Result<(), Failure> {
    if let Some(path) = &plan.rungs {
        refuse_existing(&[path])?;
        return rungs::write(path, plan.rounds);
    }
    let files = within(&plan.out, &["drr.csv", "drr.md", "drr.svg", "drr.png"]);
    refuse_existing(&files)?;
    output_file::create_folder(&plan.out).map_err(Failure::folder(&plan.out))?;
    let (finest, side) = if plan.quick { (8, 128) } else { (1, 512) };
    let phantom = Phantom::pelvis(7);
    let samples: Vec<Sample> =
        [1, 2, 4].iter().map(|c| sample(&phantom, finest * c)).collect::<Result<_, _>>().map_err(failed)?;
    let poses = references(&phantom, &samples[0], side).map_err(failed)?;
    let stream_ms = stream_ms(samples[0].hu.len() * 2, plan.rounds);
    let mut points = Vec::new();
    for sample in &samples {
        for (name, projector) in projectors() {
            for threads in [1, 2] {
                measure(sample, &poses, &Candidate { name, projector, threads }, plan.rounds, &mut points)
                    .map_err(failed)?;
            }
        }
    }
    let notes = match &plan.peers {
        Some(folder) => peers::measure(folder, plan, &samples[0], &poses, &mut points)?,
        None => Vec::new(),
    };
    let spectrum = spectrum::errors().map_err(failed)?;
    let table = table::text(&points, &stream_ms, &spectrum);
    let [png, svg] = figure::draw(&points, stream_ms[1])
        .and_then(|figure| figure.files(&plan.out, "drr"))
        .map_err(failed)?;
    let contents = [table::csv(&points).into_bytes(), table.clone().into_bytes(), svg.1, png.1];
    output_file::write_all(&files.iter().zip(contents).collect::<Vec<_>>())?;
    say!("{}", table.trim_end());
    for note in &notes {
        say!("{note}");
    }
    Ok(())
}

fn failed(cause: impl ToString) -> Failure {
    Failure::failed(cause.to_string())
}

fn sample(phantom: &Phantom, coarseness: usize) -> Result<Sample, xray::DrrError> {
    let spacing_m = 0.5e-3 * coarseness as f64;
    let dims = EDGE_M.map(|edge| (edge / spacing_m + 0.5) as usize);
    let grid = Grid::centred(dims, [spacing_m; 3])?;
    let hu = phantom.voxelise(&grid, 8);
    Ok(Sample { grid, hu, coarseness })
}

/// No noise, no blur, no window search, and all values above -1000 HU attenuate: only the projection is
/// timed.
fn parameters(projector: Projector, threads: usize) -> DrrParameters {
    DrrParameters {
        projector,
        threads,
        air_below_hu: -999,
        detector: DetectorParameters {
            quantum_noise: false,
            blur_sigma_px: 0.0,
            ..DetectorParameters::default()
        },
        display: DisplayParameters {
            window: Window::Fixed { low: 0.0, high: 6.0 },
            ..DisplayParameters::default()
        },
        ..DrrParameters::default()
    }
}

fn references(phantom: &Phantom, finest: &Sample, side: u32) -> Result<Vec<PosedReference>, xray::DrrError> {
    let mu_water = Material::Water.mu_per_m(60.0)?;
    let view = VolumeView::new(finest.grid, &finest.hu)?;
    let format = DetectorFormat { columns: side, rows: side, pixel_pitch_m: [0.3072 / f64::from(side); 2] };
    let mut renderer = DrrRenderer::new(&view, parameters(Projector::Siddon, 2), &ThisMachine)?;
    let mut image = vec![0; side as usize * side as usize];
    POSES
        .into_iter()
        .map(|(name, primary, secondary)| {
            let angles = PositionerAngles::from_degrees(primary, secondary);
            let c_arm = CArm::from_positioner_angles([0.0; 3], angles, 0.7, 1.0, format)?;
            let fan = RayFan::new(&finest.grid, &c_arm);
            let ray = |i: u32| fan.world_ray(i % side, i / side);
            let exact = (0..side * side).map(|i| phantom.line_integral(&ray(i), mu_water)).collect();
            renderer.render(&view, &c_arm, &Tool::default(), FrameSeed::default(), &mut image)?;
            Ok(PosedReference { name, c_arm, exact, siddon: renderer.anatomy().to_vec() })
        })
        .collect()
}

/// A projector with its name in the chart.
struct Candidate<'a> {
    name: &'a str,
    projector: Projector,
    threads: usize,
}

/// Times and errors of one projector; the rounds of the poses are interleaved.
fn measure(
    sample: &Sample,
    poses: &[PosedReference],
    candidate: &Candidate<'_>,
    rounds: usize,
    points: &mut Vec<Point>,
) -> Result<(), xray::DrrError> {
    let &Candidate { name, projector, threads } = candidate;
    let view = VolumeView::new(sample.grid, &sample.hu)?;
    let mut renderer = DrrRenderer::new(&view, parameters(projector, threads), &ThisMachine)?;
    // Copies of the volume are made when it is loaded, not per frame.
    poses.iter().try_for_each(|pose| renderer.prepare(&view, &pose.c_arm))?;
    // Siddon's times are long and vary little.
    let rounds = if projector == Projector::Siddon { 1 } else { rounds };
    let mut times = vec![Vec::new(); poses.len()];
    let mut images = vec![Vec::new(); poses.len()];
    for _ in 0..rounds {
        for (i, pose) in poses.iter().enumerate() {
            let mut image = vec![0; pose.c_arm.pixels()];
            let began = Instant::now();
            renderer.render(&view, &pose.c_arm, &Tool::default(), FrameSeed::default(), &mut image)?;
            times[i].push(began.elapsed().as_secs_f64() * 1e3);
            images[i] = renderer.anatomy().to_vec();
        }
    }
    for ((pose, times_ms), image) in poses.iter().zip(times).zip(&images) {
        let (method, coarseness) = (name.to_owned(), sample.coarseness);
        let (exact, siddon) = (Errors::of(image, &pose.exact), Errors::of(image, &pose.siddon));
        let this = Point { method, coarseness, pose: pose.name, threads, times_ms, exact, siddon };
        let same = |p: &&mut Point| {
            (&p.method, p.coarseness, p.pose, p.threads)
                == (&this.method, this.coarseness, this.pose, this.threads)
        };
        // Already measured: append more rounds of the same point.
        match points.iter_mut().find(same) {
            Some(before) => before.times_ms.extend(this.times_ms),
            None => points.push(this),
        }
    }
    Ok(())
}

/// Shortest time (ms) to read `bytes` once from memory with 1 and with 2 threads: a lower bound for any
/// projector that reads every voxel.
fn stream_ms(bytes: usize, rounds: usize) -> [f64; 2] {
    let words = vec![1_u64; bytes / 8];
    [1, 2].map(|threads| {
        let mut least = f64::INFINITY;
        for _ in 0..rounds.max(3) {
            let began = Instant::now();
            let sum: u64 = std::thread::scope(|scope| {
                let parts = words.chunks(words.len().div_ceil(threads).max(1));
                let workers: Vec<_> =
                    parts.map(|part| scope.spawn(move || part.iter().sum::<u64>())).collect();
                workers.into_iter().map(|worker| worker.join().unwrap_or(0)).sum()
            });
            if std::hint::black_box(sum) == words.len() as u64 {
                least = least.min(began.elapsed().as_secs_f64() * 1e3);
            }
        }
        least
    })
}
