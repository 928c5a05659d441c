//! Generates or reads the scene's volume.

use std::path::Path;

use crate::cache::key::Key;
use crate::cache::{self, Made};
use crate::failure::Failure;
use crate::suspicions;
use foreign_text::foreign_path;
use ipc_types::layout::Message;
use ipc_types::messages::Volume as VolumeMessage;
use ipc_types::scene::{Label as SceneLabel, Phantom, Resample, Scene, Volume as SceneVolume};
use simulation::CtView;
use volume_io::{
    DataFiles, Label, MaskModel, ReadOptions, Slices, Volume, VolumeError, mask_to_hu, phantom, resample,
    volume_hash,
};

/// Which files a volume may refer to. A command-line option and not a scene key, because a scene may be as untrusted as
/// its volume.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct VolumeFiles {
    /// Allow a volume header to name data files outside its own folder, and a slice folder to contain links that leave it.
    #[arg(long)]
    pub allow_elsewhere: bool,
}

impl VolumeFiles {
    /// As the volume readers expect it.
    pub fn allowed(self) -> DataFiles {
        if self.allow_elsewhere { DataFiles::Anywhere } else { DataFiles::Beside }
    }
}

/// What of a file is read as a volume, for commands that take a file and no scene.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct VolumeChoice {
    /// Which files it may name.
    #[command(flatten)]
    pub files: VolumeFiles,
    /// SeriesInstanceUID of the series to read, if the DICOM folder holds several.
    #[arg(long, value_name = "UID")]
    pub series: Option<String>,
    /// Resample slices that are unevenly spaced or stacked askew (a tilted gantry) to a rectangular grid.
    #[arg(long)]
    pub rectify: bool,
}

impl VolumeChoice {
    /// As the volume readers expect it.
    pub fn options(&self) -> ReadOptions {
        let slices = if self.rectify { Slices::Rectify } else { Slices::AsTheyLie };
        ReadOptions { data_files: self.files.allowed(), series: self.series.clone(), slices, label: None }
    }
}

/// What a scene asks of its file.
fn options(source: &SceneVolume, files: VolumeFiles) -> ReadOptions {
    ReadOptions {
        data_files: files.allowed(),
        series: source.series.clone(),
        slices: match source.resample {
            Some(Resample::Rectify) => Slices::Rectify,
            None => Slices::AsTheyLie,
        },
        label: source.label.as_ref().map(|label| match label {
            SceneLabel::Value(value) => Label::Value(*value),
            SceneLabel::Name(name) => Label::Name(name.clone()),
        }),
    }
}

/// Refuses a scene whose volume is not there, and says where one is to be had; `file` names the scene's file.
///
/// # Errors
/// Bad input (2).
pub fn refuse_missing(file: &dyn std::fmt::Display, scene: &Scene) -> Result<(), Failure> {
    let path = scene.volume.as_ref().and_then(|volume| volume.path.as_ref());
    let Some(path) = path.filter(|path| !path.exists()) else { return Ok(()) };
    Err(Failure::bad_input(format!(
        "{file}: `volume.path` is {}, which does not exist. A synthetic pelvis in its place: `trabecula phantom pelvis -o pelvis.nrrd`, then \
         `trabecula run … --set 'volume.path=\"'$PWD/pelvis.nrrd'\"'`; a free CT of a patient: docs/volumes.md, \"Where to get a CT\"",
        foreign_path(path)
    )))
}

/// A loaded volume as the simulation takes it.
pub fn ct_view((volume, sha256): &(Volume, [u8; 32])) -> CtView<'_> {
    CtView::new(&message(volume, *sha256), &volume.hu)
}

/// The volume of a scene with its hash; `None` if the scene has none.
///
/// # Errors
/// The file is not a volume, or cannot be read.
pub fn load(scene: &Scene, files: VolumeFiles) -> Result<Option<(Volume, [u8; 32])>, VolumeError> {
    Ok(load_with_notes(scene, files)?.map(|loaded| (loaded.volume, loaded.sha256)))
}

/// The volume of a scene.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// Voxels and geometry.
    pub volume: Volume,
    /// Its hash.
    pub sha256: [u8; 32],
    /// What its reader assumed or changed, and what looks wrong about it for this scene.
    pub notes: Vec<String>,
}

/// The same, with what its reader assumed or changed, and what looks wrong about it for this scene.
///
/// # Errors
/// As [`load`].
pub fn load_with_notes(scene: &Scene, files: VolumeFiles) -> Result<Option<Loaded>, VolumeError> {
    let Some(source) = &scene.volume else { return Ok(None) };
    let made = match (&source.path, source.phantom) {
        (Some(path), _) => of_file(path, source, files)?,
        (None, Some(Phantom::Block)) => {
            let volume = block(source)?;
            Made { sha256: volume_hash(&volume), volume, notes: Vec::new() }
        }
        (None, _) => {
            let spacing_m = source.spacing_mm * 1e-3;
            let spec = phantom::FemurSpec { spacing_m, ..phantom::FemurSpec::default() };
            cache::through(&Key::of_phantom("femur", &spec), || Ok((phantom::femur(&spec)?, Vec::new())))?
        }
    };
    let made = if scene.has_registration_error() { moved(made, scene) } else { made };
    let Made { volume, sha256, mut notes } = made;
    // Refuse early whatever a part would refuse later.
    volume.check(source.path.as_deref().unwrap_or(Path::new("volume")))?;
    if source.path.is_some() {
        notes.extend(suspicions::of_places(&volume, scene));
    }
    Ok(Some(Loaded { volume, sha256, notes }))
}

/// The bone where it truly lies: `[truth]` has it elsewhere than the plan.
fn moved(made: Made, scene: &Scene) -> Made {
    let Made { mut volume, notes, .. } = made;
    volume.origin_m = scene.in_bone_mm(volume.origin_m.map(|x| x * 1e3)).map(|x| x * 1e-3);
    let column =
        |axis: usize| scene.turned_with_bone(core::array::from_fn(|row| volume.direction[row][axis]));
    let columns = [column(0), column(1), column(2)];
    volume.direction = core::array::from_fn(|row| core::array::from_fn(|axis| columns[axis][row]));
    Made { sha256: volume_hash(&volume), volume, notes }
}

/// The volume of a file, as the scene wants it: from the cache if it takes long to decode.
fn of_file(path: &Path, source: &SceneVolume, files: VolumeFiles) -> Result<Made, VolumeError> {
    let options = options(source, files);
    let treatment = match (source.mask, source.resample_mm) {
        (false, None) => String::new(),
        (mask, resample_mm) => format!("{:?}, {resample_mm:?} mm", mask.then_some(&MASK_MODEL)),
    };
    let make = || {
        let (mut volume, info) = volume_io::read_as(path, &options)?;
        let mut notes = info.notes;
        if source.mask {
            mask_to_hu(&mut volume, &MASK_MODEL)?;
        } else {
            notes.extend(suspicions::of_a_mask(&volume));
        }
        let volume = match source.resample_mm {
            Some(spacing_mm) => resample(&volume, spacing_mm * 1e-3)?,
            None => volume,
        };
        Ok((volume, notes))
    };
    match Key::of_file(path, &options, &treatment) {
        Some(key) => cache::through(&key, make),
        None => cache::fresh(make),
    }
}

/// Synthetic bone for a mask: cancellous down to the middle of a femoral head (22 mm deep), so that there is something
/// to drill; marrow only in thicker regions.
const MASK_MODEL: MaskModel = MaskModel {
    cortical_thickness_m: 2.0e-3,
    cortical_hu: 1500,
    cancellous_outer_hu: 450,
    cancellous_inner_hu: 200,
    marrow_depth_m: 30.0e-3,
    marrow_hu: -50,
    soft_tissue_m: 20.0e-3,
    soft_tissue_hu: 50,
    air_hu: -1000,
};

/// Apparent density at 0 HU and per HU, kg/m³ (the line of the drilling law, `simulation::bone::MaterialLaw`).
const DENSITY_AT_ZERO: f64 = 131.0;
const DENSITY_PER_HU: f64 = 1.067;
/// HU of the block's near half: cancellous bone.
const BLOCK_HU: i16 = 300;

/// A block 40 mm wide whose far half (+x) is denser by the scene's ratio.
fn block(source: &SceneVolume) -> Result<Volume, VolumeError> {
    let spacing_m = source.spacing_mm * 1e-3;
    let voxels = |length_m: f64| (length_m / spacing_m + 0.5) as usize;
    let dims = [voxels(0.04), voxels(0.04), voxels(0.06)];
    let centred = |n: usize| -0.5 * spacing_m * (n as f64 - 1.0);
    let near = DENSITY_AT_ZERO + DENSITY_PER_HU * f64::from(BLOCK_HU);
    let far_hu = (near * source.block_density_ratio - DENSITY_AT_ZERO) / DENSITY_PER_HU;
    phantom::block(&phantom::BlockSpec {
        dims,
        spacing_m: [spacing_m; 3],
        origin_m: dims.map(centred),
        plane_point_m: [0.0; 3],
        plane_normal: [1.0, 0.0, 0.0],
        hu_behind: BLOCK_HU,
        hu_ahead: far_hu.clamp(-1000.0, 30_000.0) as i16,
        ..phantom::BlockSpec::default()
    })
}

/// Header of the volume message.
pub fn message(volume: &Volume, sha256: [u8; 32]) -> VolumeMessage {
    let d = &volume.direction;
    VolumeMessage {
        sha256,
        origin_m: volume.origin_m,
        spacing_m: volume.spacing_m,
        // Axis by axis; the reader stores rows of a matrix whose columns are the axes.
        direction: [d[0][0], d[1][0], d[2][0], d[0][1], d[1][1], d[2][1], d[0][2], d[1][2], d[2][2]],
        dimensions: volume.dims.map(|n| n as u32),
        hu_length: volume.hu.len() as u32,
    }
}

/// Size of the volume message in bytes.
pub fn message_bytes(volume: &Volume) -> usize {
    VolumeMessage::DESCRIPTION.size + volume.hu.len() * 2
}
