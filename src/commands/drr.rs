//! `trabecula drr`: renders X-ray frames of a volume from any pose to files.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::{Args, ValueEnum};
use drr_proc::ThisMachine;
use volume_io::Volume;
use xray::{
    DetectorParameters, DisplayMode, DisplayParameters, DrrParameters, DrrRenderer, FrameSeed, Grid, Output,
    Projector, Spectrum, Tool, VolumeView,
};

use crate::failure::Failure;
use crate::launcher::volume_source::VolumeFiles;
use crate::output::refuse_existing;
use crate::x_ray::files::{Picture, write_dicom, write_nrrd, write_png};
use crate::x_ray::poses::{self, Placed, Pose};

/// Arguments of `drr`.
#[derive(Debug, Args)]
pub struct DrrArguments {
    /// NIfTI, NRRD, MetaImage, or a DICOM folder.
    pub volume: PathBuf,
    /// Which files the volume may name.
    #[command(flatten)]
    pub volume_files: VolumeFiles,
    /// File to write: .png (16 bits), .nrrd (32-bit floats) or .dcm (X-ray angiography); several poses are numbered.
    #[arg(short, long)]
    pub output: PathBuf,
    /// Poses: a .toml or .json file of one pose or of a list `pose`, or a .csv file of angles; the keys are those of a scene's
    /// `[drr]` and `[drr.carm]`.
    #[arg(long)]
    pub pose: Option<PathBuf>,
    /// DICOM primary angle, degrees: 0 is detector in front of the chest, +90 at the patient's left.
    #[arg(long, allow_negative_numbers = true)]
    pub primary_deg: Option<f64>,
    /// DICOM secondary angle, degrees: positive is cranial.
    #[arg(long, allow_negative_numbers = true)]
    pub secondary_deg: Option<f64>,
    /// Source to isocentre.
    #[arg(long)]
    pub source_isocentre_mm: Option<f64>,
    /// Source to detector.
    #[arg(long)]
    pub source_detector_mm: Option<f64>,
    /// Point about which the C-arm turns, patient frame (LPS); the volume's centre by default.
    #[arg(long, num_args = 3, allow_negative_numbers = true, value_names = ["X", "Y", "Z"])]
    pub isocentre_mm: Option<Vec<f64>>,
    /// Pixel columns.
    #[arg(long, default_value_t = 512)]
    pub columns: u32,
    /// Pixel rows.
    #[arg(long, default_value_t = 512)]
    pub rows: u32,
    /// Distance of pixel centres on the detector.
    #[arg(long, default_value_t = 0.6)]
    pub pixel_pitch_mm: f64,
    /// Turn the C-arm by this primary angle, degrees, in `--frames` steps.
    #[arg(long, allow_negative_numbers = true)]
    pub sweep: Option<f64>,
    /// Frames of a sweep, 2 to 3600.
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u32).range(2..=3600))]
    pub frames: u32,
    /// Several poses as one animated picture (.png) instead of a numbered series.
    #[arg(long)]
    pub animate: bool,
    /// Line integral.
    #[arg(long, value_enum, default_value = "slice-ordered")]
    pub projector: ProjectorName,
    /// Which way round the greys are.
    #[arg(long, value_enum, default_value = "bone-dark")]
    pub display: DisplayName,
    /// Photon energy, 30 to 120 keV.
    #[arg(long, default_value_t = 60.0)]
    pub energy_kev: f64,
    /// A spectrum of this tube voltage, 50 to 120 kV, behind 3 mm of aluminium, instead of one energy.
    #[arg(long)]
    pub tube_kv: Option<f64>,
    /// Photons per unattenuated pixel; none: no noise.
    #[arg(long)]
    pub photons: Option<f64>,
    /// Detector blur (standard deviation), pixels.
    #[arg(long, default_value_t = 0.0)]
    pub blur_pixels: f64,
    /// Seed of the noise.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Threads that render.
    #[arg(long, default_value_t = 2)]
    pub threads: usize,
}

/// Projectors.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum ProjectorName {
    /// Exact for constant voxels; slow.
    Siddon,
    /// Bilinear, ray by ray.
    Joseph,
    /// Bilinear, slice by slice; the fastest of full resolution.
    SliceOrdered,
    /// The same with voxels joined two by two by two.
    Preview,
}

/// Displays.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum DisplayName {
    /// As the detector sees them.
    BoneDark,
    /// Inverted.
    BoneBright,
    /// The readout itself.
    Linear,
}

/// File types, by extension.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Png,
    Nrrd,
    Dicom,
}

/// Runs the command.
///
/// # Errors
/// An invalid volume, pose or option, or a folder that cannot be written (2, and nothing is written); a full disk (1).
pub fn run(arguments: &DrrArguments) -> Result<(), Failure> {
    let kind = kind_of(&arguments.output)?;
    let poses = all_poses(arguments)?;
    if arguments.animate && kind != Kind::Png {
        return Err(Failure::bad_input("--animate is for .png: leave it out for a numbered series"));
    }
    let paths = match poses.len() {
        1 => vec![arguments.output.clone()],
        _ if arguments.animate => vec![arguments.output.clone()],
        count => (0..count).map(|number| numbered(&arguments.output, number)).collect(),
    };
    refuse_existing(&paths)?;
    let files = arguments.volume_files.allowed();
    let (volume, _) = volume_io::read_where(&arguments.volume, files)?;
    let placed = place(&poses, &volume)?;
    let sides: Vec<(u32, u32)> = placed.iter().map(|p| (p.c_arm.columns, p.c_arm.rows)).collect();
    if arguments.animate && sides.iter().any(|side| *side != sides[0]) {
        return Err(Failure::bad_input("--animate: the poses differ in columns or rows; expected one size"));
    }
    let grid = Grid::from(volume.grid(&arguments.volume)?);
    let view = VolumeView::new(grid, &volume.hu).map_err(Failure::bad_input)?;
    let mut renderer =
        DrrRenderer::new(&view, parameters(arguments), &ThisMachine).map_err(Failure::bad_input)?;
    let linear = matches!(arguments.display, DisplayName::Linear);
    let mut animation = Vec::new();
    let mut slowest_ms = 0.0_f64;
    for (number, placed) in placed.iter().enumerate() {
        let began = Instant::now();
        let picture = render(&mut renderer, &view, placed, arguments.seed, kind, linear)?;
        slowest_ms = slowest_ms.max(began.elapsed().as_secs_f64() * 1e3);
        if arguments.animate {
            animation.push(picture);
            continue;
        }
        let path = &paths[number];
        match kind {
            Kind::Png => write_png(path, std::slice::from_ref(&picture)),
            Kind::Nrrd => write_nrrd(path, &picture),
            Kind::Dicom => write_dicom(path, &picture),
        }?;
    }
    if arguments.animate {
        write_png(&arguments.output, &animation)?;
    }
    let (count, output) = (placed.len(), arguments.output.display());
    say!("{output}: {count} frame(s), the slowest took {slowest_ms:.1} ms");
    Ok(())
}

fn kind_of(path: &Path) -> Result<Kind, Failure> {
    match path.extension().and_then(|e| e.to_str()) {
        Some("png") => Ok(Kind::Png),
        Some("nrrd") => Ok(Kind::Nrrd),
        Some("dcm") => Ok(Kind::Dicom),
        _ => {
            let given = path.display();
            Err(Failure::bad_input(format!("--output is {given}; expected a .png, .nrrd or .dcm file")))
        }
    }
}

/// The requested poses: those of the file or the command line, each multiplied by the sweep.
fn all_poses(arguments: &DrrArguments) -> Result<Vec<Pose>, Failure> {
    let isocentre = arguments.isocentre_mm.as_deref();
    let line = Pose {
        primary_angle_deg: arguments.primary_deg,
        secondary_angle_deg: arguments.secondary_deg,
        source_isocentre_mm: arguments.source_isocentre_mm,
        source_detector_mm: arguments.source_detector_mm,
        isocentre_mm: isocentre.and_then(|v| v.try_into().ok()),
        columns: Some(arguments.columns),
        rows: Some(arguments.rows),
        pixel_pitch_mm: Some(arguments.pixel_pitch_mm),
        ..Pose::default()
    };
    let poses: Vec<Pose> = match &arguments.pose {
        Some(path) => poses::read(path)?.iter().map(|pose| pose.or(&line)).collect(),
        None => vec![line],
    };
    let Some(sweep) = arguments.sweep else { return Ok(poses) };
    if !(sweep.abs() > 0.0 && sweep.abs() <= 360.0) {
        return Err(Failure::bad_input(format!("--sweep is {sweep}, allowed is -360 to 360 degrees, not 0")));
    }
    let [pose] = poses.as_slice() else {
        return Err(Failure::bad_input("--sweep starts at one pose; the file has several"));
    };
    if pose.is_given() {
        return Err(Failure::bad_input("--sweep turns positioner angles; the pose is a camera or points"));
    }
    let start = pose.primary_angle_deg.unwrap_or(0.0);
    let turned = |i: u32| {
        let angle = start + sweep * f64::from(i) / f64::from(arguments.frames);
        // Wrap to -180 to 180.
        let angle = angle - 360.0 * ((angle + 180.0) / 360.0).floor();
        Pose { primary_angle_deg: Some(angle), ..pose.clone() }
    };
    Ok((0..arguments.frames).map(turned).collect())
}

/// Resolves all poses, so that a bad one is reported before anything is rendered.
fn place(poses: &[Pose], volume: &Volume) -> Result<Vec<Placed>, Failure> {
    let centre_m = volume.voxel_to_world_m(volume.dims.map(|n| 0.5 * (n as f64 - 1.0)));
    let number = |i: usize, cause| Failure::bad_input(format!("pose {}: {cause}", i + 1));
    poses.iter().enumerate().map(|(i, p)| p.place(centre_m).map_err(|cause| number(i, cause))).collect()
}

fn parameters(arguments: &DrrArguments) -> DrrParameters {
    DrrParameters {
        projector: match arguments.projector {
            ProjectorName::Siddon => Projector::Siddon,
            ProjectorName::Joseph => Projector::Joseph,
            ProjectorName::SliceOrdered => Projector::SLICE_ORDERED,
            ProjectorName::Preview => Projector::PREVIEW,
        },
        energy_kev: arguments.energy_kev,
        spectrum: arguments.tube_kv.map(|tube_kv| Spectrum { tube_kv, ..Spectrum::default() }),
        threads: arguments.threads,
        detector: DetectorParameters {
            photons_per_pixel: arguments.photons.unwrap_or(1e5),
            quantum_noise: arguments.photons.is_some(),
            blur_sigma_px: arguments.blur_pixels,
            ..DetectorParameters::default()
        },
        display: DisplayParameters {
            mode: match arguments.display {
                DisplayName::BoneDark => DisplayMode::BoneDark,
                DisplayName::BoneBright => DisplayMode::BoneBright,
                DisplayName::Linear => DisplayMode::Linear,
            },
            ..DisplayParameters::default()
        },
        ..DrrParameters::default()
    }
}

fn render(
    renderer: &mut DrrRenderer,
    view: &VolumeView<'_>,
    placed: &Placed,
    seed: u64,
    kind: Kind,
    linear: bool,
) -> Result<Picture, Failure> {
    let pixels = placed.c_arm.pixels();
    let mut picture = Picture { placed: *placed, linear, greys: Vec::new(), values: Vec::new() };
    let output = if kind == Kind::Nrrd {
        picture.values.resize(pixels, 0.0);
        Output::Float32(&mut picture.values)
    } else {
        picture.greys.resize(pixels, 0);
        Output::Mono16(&mut picture.greys)
    };
    let seed = FrameSeed { seed, frame: 0 };
    renderer
        .render_to(view, &placed.c_arm, &Tool::default(), seed, output)
        .map_err(|cause| Failure::failed(cause.to_string()))?;
    Ok(picture)
}

/// `name.png` becomes `name_0007.png`.
fn numbered(path: &Path, number: usize) -> PathBuf {
    let part = |text: Option<&std::ffi::OsStr>| text.unwrap_or_default().to_string_lossy().into_owned();
    path.with_file_name(format!("{}_{number:04}.{}", part(path.file_stem()), part(path.extension())))
}
