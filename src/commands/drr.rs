//! `trabecula drr`: renders X-ray frames of a volume from any pose to files.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use clap::Args;
use drr_proc::ThisMachine;
use foreign_text::number;
use nalgebra::Vector3;
use voxel_grid::{Volume, VoxelGrid};
use xray::{
    CArm, DetectorParameters, Display, DisplayParameters, DrrError, DrrParameters, DrrRenderer, Projector,
    Spectrum, VolumeView,
};

use super::{Choice, choice};
use crate::failure::Failure;
use crate::launcher::volume_source::VolumeChoice;
use crate::output::refuse_existing;
use crate::say::{Figures, path_text};
use crate::x_ray::dicom::{Series, write_dicom};
use crate::x_ray::files::{Animation, write_nrrd, write_png};
use crate::x_ray::poses::{self, DEFAULT_PITCH_MM, LARGEST_PITCH_MM, Pose, ResolvedPose};
use crate::x_ray::series::{RenderStyle, render_and_write};
use inputs::suspicions;

/// Arguments of `drr`.
#[derive(Debug, Args)]
pub struct DrrArguments {
    /// Volume: NIfTI, NRRD, MetaImage, or a DICOM folder.
    volume: PathBuf,
    #[command(flatten)]
    choice: VolumeChoice,
    /// Output file: .png (16-bit), .nrrd (32-bit float) or .dcm (X-ray angiography). Several poses give
    /// numbered files.
    #[arg(short, long)]
    output: PathBuf,
    /// Pose file: .toml or .json with one pose or a list named `pose`, or .csv with angles. The keys are the
    /// same as in a scene's `[drr]` and `[drr.carm]`.
    #[arg(long)]
    pose: Option<PathBuf>,
    /// DICOM primary angle, degrees: at 0 the detector is in front of the chest, at +90 on the patient's
    /// left.
    #[arg(long, allow_negative_numbers = true)]
    primary_deg: Option<f64>,
    /// DICOM secondary angle, degrees: positive is cranial.
    #[arg(long, allow_negative_numbers = true)]
    secondary_deg: Option<f64>,
    /// Distance from the source to the isocentre; default: 700.
    #[arg(long)]
    source_isocentre_mm: Option<f64>,
    /// Distance from the source to the detector; default: 1000.
    #[arg(long)]
    source_detector_mm: Option<f64>,
    /// Point that the C-arm rotates about, in the patient frame (LPS); default: the volume's centre.
    #[arg(long, num_args = 3, allow_negative_numbers = true, value_names = ["X", "Y", "Z"])]
    isocentre_mm: Option<Vec<f64>>,
    /// Pixel columns.
    #[arg(long, default_value_t = 512)]
    columns: u32,
    /// Pixel rows.
    #[arg(long, default_value_t = 512)]
    rows: u32,
    /// Distance between pixel centres on the detector; default: the whole volume is in every frame.
    #[arg(long)]
    pixel_pitch_mm: Option<f64>,
    /// Rotate the C-arm through this primary angle, degrees, in `--frames` steps.
    #[arg(long, allow_negative_numbers = true)]
    sweep: Option<f64>,
    /// Number of frames in a sweep, 2 to 3600; default: 60.
    #[arg(long, requires = "sweep", value_parser = clap::value_parser!(u32).range(2..=3600))]
    frames: Option<u32>,
    /// Write one animated .png instead of a numbered series.
    #[arg(long)]
    animate: bool,
    /// How line integrals are computed.
    #[arg(long, value_parser = choice(&PROJECTORS), default_value = "slice-ordered")]
    projector: Projector,
    /// How the detector signal maps to grey values.
    #[arg(long, value_parser = choice(&DISPLAYS), default_value = "bone-dark")]
    display: Display,
    /// Photon energy, 30 to 120 keV.
    #[arg(long, default_value_t = 60.0, conflicts_with = "tube_kv")]
    energy_kev: f64,
    /// Use the spectrum of this tube voltage, 50 to 120 kV, filtered by 3 mm of aluminium, instead of a
    /// single energy.
    #[arg(long)]
    tube_kv: Option<f64>,
    /// Photons per unattenuated pixel; default: no noise.
    #[arg(long)]
    photons: Option<f64>,
    /// Detector blur (standard deviation), pixels.
    #[arg(long, default_value_t = 0.0)]
    blur_pixels: f64,
    /// Noise seed.
    #[arg(long, default_value_t = 0, requires = "photons")]
    seed: u64,
    /// Number of render threads.
    #[arg(long, default_value_t = 2)]
    threads: usize,
    #[command(flatten)]
    figures: Figures,
}

/// Values of `--projector`.
const PROJECTORS: [Choice<Projector>; 4] = [
    ("siddon", "Exact for constant voxels; slow", Projector::Siddon),
    ("joseph", "Bilinear interpolation, ray by ray", Projector::Joseph),
    (
        "slice-ordered",
        "Bilinear interpolation, slice by slice; fastest at full resolution",
        Projector::SLICE_ORDERED,
    ),
    ("preview", "Like slice-ordered, on voxels binned 2 x 2 x 2", Projector::PREVIEW),
];

/// Values of `--display`.
const DISPLAYS: [Choice<Display>; 3] = [
    ("bone-dark", "Bone dark, as on the detector", Display::BoneDark),
    ("bone-bright", "Bone bright", Display::BoneBright),
    ("linear", "The raw detector readout", Display::Linear),
];

/// Default number of frames in a sweep.
const SWEEP_FRAMES: u32 = 60;

/// Margin around a framed volume.
const MARGIN: f64 = 1.02;
/// Nearest that a framed volume comes to the source, as a share of the detector's distance.
const NEAREST_SHARE: f64 = 0.02;

/// Output formats, by file extension.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Png,
    Nrrd,
    Dicom,
}

/// Runs the command.
///
/// # Errors
/// An invalid volume, pose or option, or a folder that cannot be written (2, and nothing is written); a full
/// disk (1).
pub fn run(arguments: &DrrArguments) -> Result<(), Failure> {
    let kind = kind_of(&arguments.output)?;
    let poses = all_poses(arguments)?;
    if arguments.animate && kind != Kind::Png {
        return Err(Failure::bad_input(
            "--animate needs a .png output; without --animate, several poses give numbered files",
        ));
    }
    if arguments.animate && poses.len() == 1 {
        return Err(Failure::bad_input("--animate needs several poses; use --sweep, or --pose with a list"));
    }
    let paths = match poses.len() {
        1 => vec![arguments.output.clone()],
        _ if arguments.animate => vec![arguments.output.clone()],
        count => (0..count).map(|number| numbered(&arguments.output, number)).collect(),
    };
    refuse_existing(&paths)?;
    let (volume, info) = volume_io::read_as(&arguments.volume, &arguments.choice.options())?;
    for note in info.notes.iter().chain(&suspicions::of_a_mask(&volume)) {
        tell!("{}: {note}", arguments.volume.display());
    }
    let placed = place(poses, &volume)?;
    let sides: Vec<(u32, u32)> = placed.iter().map(|p| (p.c_arm.columns, p.c_arm.rows)).collect();
    if arguments.animate && sides.iter().any(|side| *side != sides[0]) {
        return Err(Failure::bad_input("--animate: all poses must have the same columns and rows"));
    }
    let view = VolumeView::try_from(&volume).map_err(Failure::bad_input)?;
    let mut renderer = DrrRenderer::new(&view, parameters(arguments), &ThisMachine).map_err(of_flag)?;
    let series = Series::new(volume_io::volume_hash(&volume), &placed, arguments.tube_kv);
    let look = RenderStyle {
        as_values: kind == Kind::Nrrd,
        linear: arguments.display == Display::Linear,
        dense_is_dark: arguments.display == Display::BoneDark,
        seed: arguments.seed,
    };
    let animation = match arguments.animate {
        true => Some(Mutex::new(Animation::create(&arguments.output, sides[0], placed.len())?)),
        false => None,
    };
    let seconds = render_and_write(&mut renderer, &view, &placed, look, |number, picture| {
        if let Some(animation) = &animation {
            return animation.lock().unwrap_or_else(PoisonError::into_inner).add(number, &picture);
        }
        let path = &paths[number];
        match kind {
            Kind::Png => write_png(path, &picture),
            Kind::Nrrd => write_nrrd(path, &picture),
            Kind::Dicom => write_dicom(path, &picture, &series, number + 1),
        }
    })?;
    if let Some(animation) = animation {
        animation.into_inner().unwrap_or_else(PoisonError::into_inner).finish()?;
    }
    let (count, output) = (placed.len(), arguments.output.display());
    let (all_ms, frames_per_s) = (seconds * 1e3, count as f64 / seconds);
    let pitch_mm = number(1e3 * placed[0].c_arm.pixel_pitch_m[0]);
    arguments.figures.say(
        || {
            format!(
                "{output}: {count} frame(s), rendered in {all_ms:.1} ms ({frames_per_s:.1} per second), \
                 pixels of {pitch_mm} mm"
            )
        },
        || {
            serde_json::json!({
                "output": path_text(&arguments.output), "frames": count, "render_ms": all_ms,
                "frames_per_s": frames_per_s, "pixel_pitch_mm": 1e3 * placed[0].c_arm.pixel_pitch_m[0],
            })
        },
    );
    Ok(())
}

fn kind_of(path: &Path) -> Result<Kind, Failure> {
    match path.extension().and_then(|e| e.to_str()) {
        Some("png") => Ok(Kind::Png),
        Some("nrrd") => Ok(Kind::Nrrd),
        Some("dcm") => Ok(Kind::Dicom),
        _ => {
            let given = path.display();
            Err(Failure::bad_input(format!("--output is {given}, expected a .png, .nrrd or .dcm file")))
        }
    }
}

/// Returns the poses of the file or the command line, expanded by the sweep.
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
        pixel_pitch_mm: arguments.pixel_pitch_mm,
        ..Pose::default()
    };
    let poses: Vec<Pose> = match &arguments.pose {
        Some(path) => poses::read(path)?.iter().map(|pose| pose.or(&line)).collect(),
        None => vec![line],
    };
    let Some(sweep) = arguments.sweep else { return Ok(poses) };
    if !(sweep.abs() > 0.0 && sweep.abs() <= 360.0) {
        return Err(Failure::bad_input(format!(
            "--sweep is {sweep}; allowed: -360 to 360 degrees, except 0"
        )));
    }
    let [pose] = poses.as_slice() else {
        return Err(Failure::bad_input(
            "--sweep needs a single pose to start from; the pose file has several",
        ));
    };
    if pose.is_given() {
        return Err(Failure::bad_input(
            "--sweep needs a pose given by C-arm angles; this one is a camera matrix or a set of points",
        ));
    }
    let start = pose.primary_angle_deg.unwrap_or(0.0);
    let frames = arguments.frames.unwrap_or(SWEEP_FRAMES);
    let turned = |i: u32| {
        let angle = start + sweep * f64::from(i) / f64::from(frames);
        // Wrap to -180 to 180.
        let angle = angle - 360.0 * ((angle + 180.0) / 360.0).floor();
        Pose { primary_angle_deg: Some(angle), ..pose.clone() }
    };
    Ok((0..frames).map(turned).collect())
}

/// Resolves all poses, so that a bad one is reported before anything is rendered. Poses by C-arm angles
/// without a pixel pitch share the one that has the whole volume in every frame.
fn place(mut poses: Vec<Pose>, volume: &Volume) -> Result<Vec<ResolvedPose>, Failure> {
    let grid = &volume.grid;
    let centre_m = grid.world_m(grid.dims().map(|n| 0.5 * (n as f64 - 1.0)));
    let failure = |i: usize, cause| Failure::bad_input(format!("pose {}: {cause}", i + 1));
    let is_framed = |pose: &Pose| pose.pixel_pitch_mm.is_none() && !pose.is_given();
    let mut pitch_mm = Some(0.0);
    for (i, pose) in poses.iter().enumerate().filter(|(_, pose)| is_framed(pose)) {
        let c_arm = pose.place(centre_m).map_err(|cause| failure(i, cause))?.c_arm;
        pitch_mm = pitch_mm.zip(framed_pitch_mm(&c_arm, grid)).map(|(most, own): (f64, f64)| most.max(own));
    }
    if pitch_mm.is_none() {
        tell!(
            "the volume reaches to the source, so it cannot be framed: pixels of {DEFAULT_PITCH_MM} mm; \
             --source-isocentre-mm, --source-detector-mm and --pixel-pitch-mm change that"
        );
    }
    poses.iter_mut().filter(|pose| is_framed(pose)).for_each(|pose| pose.pixel_pitch_mm = pitch_mm);
    poses.iter().enumerate().map(|(i, p)| p.place(centre_m).map_err(|cause| failure(i, cause))).collect()
}

/// Returns the pixel pitch, rounded up to a micrometre, at which all of a volume is projected onto the
/// detector; `None` if part of it is beside or behind the source, or the pitch would be out of range.
fn framed_pitch_mm(c_arm: &CArm, grid: &VoxelGrid) -> Option<f64> {
    let vector = |point_m: [f64; 3]| Vector3::from(point_m);
    let (source, row, column) = (vector(c_arm.source_m), vector(c_arm.row_axis), vector(c_arm.column_axis));
    let (normal, to_centre) = (row.cross(&column), vector(c_arm.detector_centre_m) - source);
    let distance_m = to_centre.dot(&normal);
    let last = grid.dims().map(|count| count as f64 - 0.5);
    let mut most_m = 0.0;
    for corner in 0..8 {
        let index = [0, 1, 2].map(|axis| if corner >> axis & 1 == 1 { last[axis] } else { -0.5 });
        let away = vector(grid.world_m(index)) - source;
        // The share of the way to the detector's plane.
        let share = away.dot(&normal) / distance_m;
        if share < NEAREST_SHARE {
            return None;
        }
        let on_detector = away / share - to_centre;
        let across = |axis: &Vector3<f64>, pixels: u32| 2.0 * on_detector.dot(axis).abs() / f64::from(pixels);
        most_m = f64::max(most_m, across(&row, c_arm.columns).max(across(&column, c_arm.rows)));
    }
    let pitch_mm = (1e6 * most_m * MARGIN).ceil() * 1e-3;
    (pitch_mm <= LARGEST_PITCH_MM).then_some(pitch_mm)
}

fn parameters(arguments: &DrrArguments) -> DrrParameters {
    DrrParameters {
        projector: arguments.projector,
        energy_kev: arguments.energy_kev,
        spectrum: arguments.tube_kv.map(|tube_kv| Spectrum { tube_kv, ..Spectrum::default() }),
        threads: arguments.threads,
        detector: DetectorParameters {
            photons_per_pixel: arguments.photons.unwrap_or(1e5),
            quantum_noise: arguments.photons.is_some(),
            blur_sigma_px: arguments.blur_pixels,
            ..DetectorParameters::default()
        },
        display: DisplayParameters { mode: arguments.display, ..DisplayParameters::default() },
        ..DrrParameters::default()
    }
}

/// Converts a projector error to one that names the flag.
fn of_flag(error: DrrError) -> Failure {
    let DrrError::OutOfRange { field, given, expected } = error else { return Failure::bad_input(error) };
    let flag = match field {
        "photons_per_pixel" => "photons",
        "blur_sigma_px" => "blur-pixels",
        other => &other.replace('_', "-"),
    };
    Failure::bad_input(format!("--{flag} is {given:?}; allowed: {expected}"))
}

/// `name.png` becomes `name_0007.png`.
fn numbered(path: &Path, number: usize) -> PathBuf {
    let part = |text: Option<&std::ffi::OsStr>| text.unwrap_or_default().to_string_lossy().into_owned();
    path.with_file_name(format!("{}_{number:04}.{}", part(path.file_stem()), part(path.extension())))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: of a CT 366 mm long, the frame showed the middle 215 mm.
    #[test]
    fn the_whole_volume_is_in_every_frame_and_fills_it() {
        for (dims, spacing_m) in [([366, 235, 240], 1e-3), ([195, 205, 180], 19e-6), ([64, 512, 700], 0.7e-3)]
        {
            let grid = VoxelGrid::axis_aligned(dims, [spacing_m; 3], [0.1, -0.2, 0.3]).unwrap();
            let volume = Volume { grid, hu: Vec::new() };
            let angles = [(0.0, 0.0), (37.0, 0.0), (90.0, -20.0), (-135.0, 30.0)];
            let poses = angles.map(|(primary, secondary)| Pose {
                primary_angle_deg: Some(primary),
                secondary_angle_deg: Some(secondary),
                columns: Some(512),
                rows: Some(400),
                ..Pose::default()
            });
            let placed = place(poses.to_vec(), &volume).unwrap();
            let corners = (0..8).map(|corner| {
                grid.world_m(
                    [0, 1, 2]
                        .map(|axis| if corner >> axis & 1 == 1 { dims[axis] as f64 - 0.5 } else { -0.5 }),
                )
            });
            let mut filled: f64 = 0.0;
            for (pose, corner) in
                placed.iter().flat_map(|pose| corners.clone().map(move |corner| (pose, corner)))
            {
                // By the camera, which the framing does not use.
                let camera = pose.c_arm.camera(xray::PixelCentre::Whole);
                let rows = camera.rotation.map(|row| Vector3::from(row).dot(&Vector3::from(corner)));
                let [x, y, z] = [0, 1, 2].map(|axis| rows[axis] + camera.translation_m[axis]);
                let [k0, k1, _] = camera.intrinsics;
                let (u, v) = (k0[0] * x / z + k0[2], k1[1] * y / z + k1[2]);
                assert!((-0.5..=511.5).contains(&u) && (-0.5..=399.5).contains(&v), "{corner:?} at {u} {v}");
                filled = filled.max((u - 255.5).abs() / 256.0).max((v - 199.5).abs() / 200.0);
            }
            assert!(filled > 0.9, "the volume takes {filled} of the frame");
            assert!(placed.iter().all(|pose| pose.c_arm.pixel_pitch_m == placed[0].c_arm.pixel_pitch_m));
        }
    }

    #[test]
    fn a_given_pitch_a_camera_and_a_volume_around_the_source_are_not_framed() {
        let grid = VoxelGrid::axis_aligned([100; 3], [1e-3; 3], [0.0; 3]).unwrap();
        let volume = Volume { grid, hu: Vec::new() };
        let pitch_mm = |pose: Pose| 1e3 * place(vec![pose], &volume).unwrap()[0].c_arm.pixel_pitch_m[0];
        let given = Pose { pixel_pitch_mm: Some(0.3), ..Pose::default() };
        let inside = Pose { source_isocentre_mm: Some(30.0), ..Pose::default() };
        assert!((pitch_mm(given) - 0.3).abs() < 1e-12);
        assert!((pitch_mm(inside) - DEFAULT_PITCH_MM).abs() < 1e-12);
    }
}
