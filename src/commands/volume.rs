//! `trabecula volume` and `trabecula phantom`: inspect and write volume files.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use volume_io::{VolumeInfo, phantom, read_as, write_nifti, write_nrrd};
use voxel_grid::{Ct, Volume};

use super::log::{json, judged};
use super::log_name;
use crate::failure::Failure;
use crate::launcher::volume_source::{VolumeChoice, VolumeFiles};
use crate::output::refuse_existing;
use crate::replay::{OpenedLog, Overrides, RemovedBone};
use crate::say::{Figures, path_text};

/// Arguments of `volume`.
#[derive(Debug, Subcommand)]
pub enum VolumeCommand {
    /// Print geometry, Hounsfield range and warnings of a volume file or DICOM folder.
    Info {
        /// Volume: NIfTI, NRRD, MetaImage, or a DICOM folder.
        file: PathBuf,
        #[command(flatten)]
        choice: VolumeChoice,
        #[command(flatten)]
        figures: Figures,
    },
    /// Print the Hounsfield units at points of a volume.
    Probe(ProbeArguments),
    /// Write a run's CT with the drilled voxels set to air, as NRRD or NIfTI; also works during the run.
    Drilled(DrilledArguments),
}

/// Arguments of `volume probe`.
#[derive(Debug, Args)]
pub struct ProbeArguments {
    /// Volume: NIfTI, NRRD, MetaImage, or a DICOM folder.
    file: PathBuf,
    /// Point in the patient frame (LPS: +x left, +y posterior, +z head), mm (may be repeated).
    #[arg(long, value_name = "X,Y,Z", required = true, allow_hyphen_values = true, value_parser = place)]
    at: Vec<[f64; 3]>,
    /// The points are in RAS, as 3D Slicer shows them.
    #[arg(long)]
    ras: bool,
    #[command(flatten)]
    choice: VolumeChoice,
    #[command(flatten)]
    figures: Figures,
}

/// Parses three comma-separated numbers.
fn place(text: &str) -> Result<[f64; 3], String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    let three = <[f64; 3]>::try_from(numbers).ok();
    let three =
        three.filter(|three| text.split(',').count() == 3 && three.iter().all(|number| number.is_finite()));
    three.ok_or_else(|| "expected three numbers such as -150.2,-135.1,101.5".to_owned())
}

fn probe(arguments: &ProbeArguments) -> Result<(), Failure> {
    let (volume, _) = read_as(&arguments.file, &arguments.choice.options())?;
    let mut found = Vec::new();
    for given @ [x, y, z] in &arguments.at {
        let lps_mm = if arguments.ras { [-x, -y, *z] } else { *given };
        let place_m = lps_mm.map(|x| x * 1e-3);
        let hu = volume.hu_at(place_m).ok_or_else(|| {
            let far = volume.grid.dims().map(|count| count as f64 - 0.5);
            let corners = [[-0.5; 3], far].map(|corner| volume.grid.world_m(corner));
            let [[a, b, c], [d, e, f]] = corners.map(|corner| corner.map(|x| x * 1e3));
            let hint = match volume.holds([-place_m[0], -place_m[1], place_m[2]]) {
                true if arguments.ras => "; without --ras (LPS) it lies inside",
                true => "; with --ras it lies inside",
                false => "",
            };
            Failure::bad_input(format!(
                "--at is [{x}, {y}, {z}], expected a point within the volume, from [{a:.1}, {b:.1}, {c:.1}] \
                 to [{d:.1}, {e:.1}, {f:.1}] mm (LPS){hint}"
            ))
        })?;
        let (voxel, dims) = (volume.grid.voxel_at(place_m), volume.grid.dims());
        let voxel = [0, 1, 2].map(|axis| voxel[axis].round().clamp(0.0, (dims[axis] - 1) as f64) as usize);
        let voxel_hu = volume.at(voxel);
        found.push(serde_json::json!({"lps_mm": lps_mm, "hu": hu, "voxel": voxel, "voxel_hu": voxel_hu}));
    }
    arguments.figures.say(
        || {
            let line = |it: &serde_json::Value| {
                let hu = it["hu"].as_f64().unwrap_or_default();
                format!("{}: {hu:.1} HU (voxel {}: {} HU)", it["lps_mm"], it["voxel"], it["voxel_hu"])
            };
            found.iter().map(line).collect::<Vec<_>>().join("\n")
        },
        || serde_json::json!({"places": found}),
    );
    Ok(())
}

/// Arguments of `volume drilled`.
#[derive(Debug, Args)]
pub struct DrilledArguments {
    /// Folder of a run, or its `run.mcap`; `latest` is the newest run in `out`.
    #[arg(value_parser = log_name())]
    log: PathBuf,
    /// New file: NIfTI if it ends in `.nii` or `.nii.gz`, otherwise NRRD (gzip).
    #[arg(short, long)]
    output: PathBuf,
    /// Bone after this tick; default: the last tick of the log.
    #[arg(long)]
    tick: Option<u64>,
    /// Current path of the log's CT file.
    #[arg(long)]
    volume: Option<PathBuf>,
    #[command(flatten)]
    volume_files: VolumeFiles,
    #[command(flatten)]
    figures: Figures,
}

/// Value of a drilled voxel: air.
const AIR_HU: i16 = -1000;

/// Writes NIfTI if the name ends in `.nii` or `.nii.gz`, otherwise NRRD.
fn write_by_name(output: &Path, volume: &Volume) -> Result<(), Failure> {
    let name = output.to_string_lossy().to_lowercase();
    match name.ends_with(".nii") || name.ends_with(".nii.gz") {
        true => Ok(write_nifti(output, volume)?),
        false => Ok(write_nrrd(output, volume)?),
    }
}

fn write_drilled(arguments: &DrilledArguments) -> Result<(), Failure> {
    refuse_existing(&[&arguments.output])?;
    let overrides = Overrides {
        volume: arguments.volume.clone(),
        volume_files: arguments.volume_files,
        ..Overrides::default()
    };
    let mut log = OpenedLog::open(&arguments.log, &overrides)?;
    let gone = RemovedBone::of(&log, arguments.tick)?;
    let Some(Ct { mut volume, .. }) = log.ct.take() else {
        return Err(Failure::bad_input(format!("{}: this run has no volume", log.path.display())));
    };
    for index in &gone.voxels {
        if let Some(hu) = volume.hu.get_mut(*index as usize) {
            *hu = AIR_HU;
        }
    }
    write_by_name(&arguments.output, &volume)?;
    let (output, tick, count) = (arguments.output.display(), gone.tick, gone.voxels.len());
    arguments.figures.say(
        || format!("{output}: the CT after tick {tick}, {} removed", foreign_text::counted(count, "voxel")),
        || {
            let verdict = json::of_verdict(&gone.verdict);
            let path = path_text(&arguments.output);
            serde_json::json!({"output": path, "tick": tick, "removed_voxels": count, "verdict": verdict})
        },
    );
    judged(&log.path, &gone.verdict)
}

/// Runs the command.
///
/// # Errors
/// Not a volume, or not a log with one (2); a log that cannot be read to its end, a full disk (1); a log that
/// is truncated or was not ended (3).
pub fn run(command: &VolumeCommand) -> Result<(), Failure> {
    let (file, choice, figures) = match command {
        VolumeCommand::Info { file, choice, figures } => (file, choice, figures),
        VolumeCommand::Probe(arguments) => return probe(arguments),
        VolumeCommand::Drilled(arguments) => return write_drilled(arguments),
    };
    let (_, info) = read_as(file, &choice.options())?;
    figures.say(|| info.to_string(), || json_of(&info));
    Ok(())
}

fn json_of(info: &VolumeInfo) -> serde_json::Value {
    serde_json::json!({
        "format": info.format,
        "stored_as": info.stored_as,
        "units": info.units,
        "dimensions": info.grid.dims(),
        "spacing_m": info.grid.spacing_m(),
        "origin_m": info.grid.origin_m(),
        "direction": info.grid.direction(),
        "min_hu": info.hu.min_hu,
        "max_hu": info.hu.max_hu,
        "mean_hu": info.hu.mean_hu,
        "notes": info.notes,
    })
}

/// Arguments of `phantom`.
#[derive(Debug, Args)]
pub struct PhantomArguments {
    /// The volume to generate.
    #[arg(value_enum)]
    kind: PhantomKind,
    /// New file: NIfTI if it ends in `.nii` or `.nii.gz`, otherwise NRRD (gzip).
    #[arg(short, long)]
    output: PathBuf,
    /// Voxel size in millimetres, 0.25 to 2 (pelvis: at least 0.34, to limit the voxel count); default: 0.5,
    /// or 1 for the pelvis.
    #[arg(long)]
    spacing_mm: Option<f64>,
    #[command(flatten)]
    figures: Figures,
}

/// Built-in synthetic volumes.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum PhantomKind {
    /// A right proximal femur.
    Femur,
    /// A block of two materials.
    Block,
    /// A ball.
    Sphere,
    /// A pelvis with both proximal femurs, as a substitute for a patient's CT in `configs/pelvis_ct.toml`.
    Pelvis,
}

/// Writes a phantom.
///
/// # Errors
/// A spacing out of range, a file that already exists, a folder that cannot be written (2); a full disk (1).
pub fn write_phantom(arguments: &PhantomArguments) -> Result<(), Failure> {
    let usual = if matches!(arguments.kind, PhantomKind::Pelvis) { 1.0 } else { 0.5 };
    let spacing_mm = arguments.spacing_mm.unwrap_or(usual);
    if !(0.25..=2.0).contains(&spacing_mm) {
        return Err(Failure::bad_input(format!("--spacing-mm is {spacing_mm}; allowed: 0.25 to 2")));
    }
    refuse_existing(&[&arguments.output])?;
    let spacing_m = spacing_mm * 1e-3;
    let volume = match arguments.kind {
        PhantomKind::Femur => phantom::femur(&phantom::FemurSpec { spacing_m, ..Default::default() }),
        PhantomKind::Block => phantom::block(&phantom::BlockSpec::with_spacing(spacing_m)),
        PhantomKind::Sphere => phantom::sphere(&phantom::SphereSpec::with_spacing(spacing_m)),
        PhantomKind::Pelvis => phantom::pelvis(&phantom::PelvisSpec { spacing_m, ..Default::default() }),
    };
    let volume = volume.map_err(Failure::bad_input)?;
    write_by_name(&arguments.output, &volume)?;
    let (dimensions @ [i, j, k], spacing_m) = (volume.grid.dims(), volume.grid.spacing_m());
    let output = arguments.output.display();
    arguments.figures.say(
        || format!("{output}: synthetic, {i} x {j} x {k} voxels of {spacing_mm} mm"),
        || {
            let path = path_text(&arguments.output);
            serde_json::json!({"output": path, "dimensions": dimensions, "spacing_m": spacing_m})
        },
    );
    Ok(())
}
