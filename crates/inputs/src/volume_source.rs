//! Generates or reads the scene's volume.

use std::path::Path;

use crate::cache;
use crate::cache::key::Key;
use crate::failure::Failure;
use crate::suspicions;
use foreign_text::foreign_path;
use ipc_types::scene::{Label as SceneLabel, Phantom, Resample, Scene, Volume as SceneVolume};
use volume_io::{
    DataFiles, GreyScale, Label, MaskModel, ReadOptions, SliceHandling, VolumeError, grid_of, identified,
    mask_to_hu, phantom, resample,
};
use voxel_grid::{Ct, Volume, density};

/// Which files a volume may refer to. A command-line option rather than a scene key, because a scene can be
/// as untrusted as its volume.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct VolumeFiles {
    /// Allow a volume header to name data files outside its own folder, and a slice folder to contain links
    /// out of it.
    #[arg(long)]
    pub allow_elsewhere: bool,
}

impl VolumeFiles {
    /// In the form that the volume readers expect.
    pub fn allowed(self) -> DataFiles {
        if self.allow_elsewhere { DataFiles::Anywhere } else { DataFiles::Beside }
    }
}

/// How to read a file as a volume, for commands that take a file and no scene.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct VolumeChoice {
    /// Which files it may name.
    #[command(flatten)]
    pub files: VolumeFiles,
    /// SeriesInstanceUID of the series to read, if the DICOM folder holds several; `UID#2` for the second of
    /// its phases; `all` to join all series of the folder.
    #[arg(long, value_name = "UID")]
    pub series: Option<String>,
    /// Resample unevenly spaced or sheared slices (tilted gantry) to a rectangular grid.
    #[arg(long)]
    pub rectify: bool,
    /// Hounsfield units per grey value of a file without Hounsfield units, as of a micro-CT.
    #[arg(long, value_name = "HU", allow_negative_numbers = true)]
    pub slope: Option<f64>,
    /// Hounsfield units of grey value 0.
    #[arg(long, value_name = "HU", allow_negative_numbers = true)]
    pub intercept: Option<f64>,
}

impl VolumeChoice {
    /// In the form that the volume readers expect.
    pub fn options(&self) -> ReadOptions {
        let slices = if self.rectify { SliceHandling::Rectify } else { SliceHandling::AsTheyLie };
        ReadOptions {
            data_files: self.files.allowed(),
            series: self.series.clone(),
            slices,
            label: None,
            grey: grey(self.slope.unwrap_or(1.0), self.intercept.unwrap_or(0.0)),
        }
    }
}

/// The conversion of grey values; `None` for a file with Hounsfield units.
fn grey(slope: f64, intercept: f64) -> Option<GreyScale> {
    ((slope, intercept) != (1.0, 0.0)).then_some(GreyScale { slope, intercept })
}

/// Read options for a scene's volume file.
fn options(source: &SceneVolume, files: VolumeFiles) -> ReadOptions {
    ReadOptions {
        data_files: files.allowed(),
        series: source.series.clone(),
        slices: match source.resample {
            Some(Resample::Rectify) => SliceHandling::Rectify,
            None => SliceHandling::AsTheyLie,
        },
        label: source.label.as_ref().map(|label| match label {
            SceneLabel::Value(value) => Label::Value(*value),
            SceneLabel::Name(name) => Label::Name(name.clone()),
        }),
        grey: grey(source.slope, source.intercept),
    }
}

/// Refuses a scene whose volume file does not exist, and says where to get one; `file` names the scene's
/// file.
///
/// # Errors
/// Bad input (2).
pub fn refuse_missing(file: &dyn std::fmt::Display, scene: &Scene) -> Result<(), Failure> {
    let path = scene.volume.as_ref().and_then(|volume| volume.path.as_ref());
    let Some(path) = path.filter(|path| !path.exists()) else { return Ok(()) };
    Err(Failure::bad_input(format!(
        "{file}: `volume.path` is {}, which does not exist. For a synthetic pelvis instead: `trabecula \
         phantom pelvis -o pelvis.nrrd`, then \
         `trabecula run … --set 'volume.path=\"'$PWD/pelvis.nrrd'\"'`; for free patient CTs see \
         docs/volumes.md, \"Where to get a CT\"",
        foreign_path(path)
    )))
}

/// Loads the CT of a scene; `None` if the scene has none.
///
/// # Errors
/// The file is not a volume, or cannot be read.
pub fn load(scene: &Scene, files: VolumeFiles) -> Result<Option<Ct>, VolumeError> {
    Ok(load_with_notes(scene, files)?.map(|loaded| loaded.ct))
}

/// A CT, and notes about it.
#[derive(Debug, Clone)]
pub struct VolumeWithNotes {
    /// The CT.
    pub ct: Ct,
    /// Assumptions and changes of its reader, and what looks wrong about it for a scene.
    pub notes: Vec<String>,
}

impl VolumeWithNotes {
    /// Adds the hash of the volume.
    pub(crate) fn of(volume: Volume, notes: Vec<String>) -> VolumeWithNotes {
        VolumeWithNotes { ct: identified(volume), notes }
    }
}

/// As [`load`], with the assumptions and changes of the reader, and what looks wrong about the volume for
/// this scene.
///
/// # Errors
/// As [`load`].
pub fn load_with_notes(scene: &Scene, files: VolumeFiles) -> Result<Option<VolumeWithNotes>, VolumeError> {
    let Some(source) = &scene.volume else { return Ok(None) };
    let loaded = match (&source.path, source.phantom) {
        (Some(path), _) => of_file(path, source, files)?,
        (None, Some(Phantom::Block)) => VolumeWithNotes::of(block(source)?, Vec::new()),
        (None, _) => {
            let spacing_m = source.spacing_mm * 1e-3;
            let spec = phantom::FemurSpec { spacing_m, ..phantom::FemurSpec::default() };
            cache::through(&Key::of_phantom("femur", &spec), || Ok((phantom::femur(&spec)?, Vec::new())))?
        }
    };
    let mut loaded = if scene.has_registration_error() { moved(loaded, scene)? } else { loaded };
    loaded.notes.extend(suspicions::of_places(&loaded.ct.volume, scene));
    Ok(Some(loaded))
}

/// Moves the bone to its true pose, if `[truth]` gives one that differs from the plan.
fn moved(loaded: VolumeWithNotes, scene: &Scene) -> Result<VolumeWithNotes, VolumeError> {
    let VolumeWithNotes { ct: Ct { volume: Volume { grid, hu }, .. }, notes } = loaded;
    let origin_m = scene.in_bone_mm(grid.origin_m().map(|x| x * 1e3)).map(|x| x * 1e-3);
    let axes = grid.axes().map(|axis| scene.turned_with_bone(axis));
    let grid = grid_of(Path::new("volume"), grid.dims(), grid.spacing_m(), origin_m, axes)?;
    Ok(VolumeWithNotes::of(Volume { grid, hu }, notes))
}

/// The volume of a file with the scene's options: from the cache if it takes long to decode.
fn of_file(path: &Path, source: &SceneVolume, files: VolumeFiles) -> Result<VolumeWithNotes, VolumeError> {
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

/// Fill for a mask: cancellous bone down to the middle of a femoral head (22 mm deep), so that there is
/// something to drill; marrow only in thicker regions.
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

/// HU of the block's near half: cancellous bone.
const BLOCK_HU: i16 = 300;

/// A block 40 mm wide whose far half (+x) is denser by the scene's ratio.
fn block(source: &SceneVolume) -> Result<Volume, VolumeError> {
    let spacing_m = source.spacing_mm * 1e-3;
    let voxels = |length_m: f64| (length_m / spacing_m + 0.5) as usize;
    let dims = [voxels(0.04), voxels(0.04), voxels(0.06)];
    let centred = |n: usize| -0.5 * spacing_m * (n as f64 - 1.0);
    let near_kg_m3 = density::AT_ZERO_KG_M3 + density::PER_HU_KG_M3 * f64::from(BLOCK_HU);
    let far_hu = density::hu_of(near_kg_m3 * source.block_density_ratio);
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
