//! `trabecula volume info` and `trabecula phantom`: volumes as files.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use volume_io::{phantom, read_with_info, write_nrrd};

use crate::failure::Failure;

/// What to do with a volume.
#[derive(Debug, Subcommand)]
pub enum VolumeCommand {
    /// Geometry, Hounsfield units and notes of a volume file or DICOM folder.
    Info {
        /// NIfTI, NRRD, MetaImage, or a DICOM folder.
        file: PathBuf,
    },
}

/// Runs the command.
///
/// # Errors
/// Not a volume (2).
pub fn run(command: &VolumeCommand) -> Result<(), Failure> {
    let VolumeCommand::Info { file } = command;
    let (_, info) = read_with_info(file).map_err(Failure::bad_input)?;
    say!("{info}");
    Ok(())
}

/// Arguments of `phantom`.
#[derive(Debug, Args)]
pub struct PhantomArguments {
    /// Which one.
    #[arg(value_enum)]
    pub kind: PhantomKind,
    /// File to write (NRRD, gzip).
    pub file: PathBuf,
    /// Voxel size in millimetres, 0.25 to 2.
    #[arg(long, default_value_t = 0.5)]
    pub spacing_mm: f64,
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
}

/// Writes a phantom.
///
/// # Errors
/// A spacing out of range, or a file that cannot be written (2).
pub fn write_phantom(arguments: &PhantomArguments) -> Result<(), Failure> {
    if !(0.25..=2.0).contains(&arguments.spacing_mm) {
        let given = arguments.spacing_mm;
        return Err(Failure::bad_input(format!("--spacing-mm is {given}, allowed is 0.25 to 2")));
    }
    let spacing_m = arguments.spacing_mm * 1e-3;
    let volume = match arguments.kind {
        PhantomKind::Femur => phantom::femur(&phantom::FemurSpec { spacing_m, ..Default::default() }),
        PhantomKind::Block => {
            phantom::block(&phantom::BlockSpec { spacing_m: [spacing_m; 3], ..Default::default() })
        }
        PhantomKind::Sphere => {
            phantom::sphere(&phantom::SphereSpec { spacing_m: [spacing_m; 3], ..Default::default() })
        }
    };
    let volume = volume.map_err(Failure::bad_input)?;
    write_nrrd(&arguments.file, &volume).map_err(Failure::bad_input)?;
    let [i, j, k] = volume.dims;
    say!("{}: synthetic, {i} x {j} x {k} voxels of {} mm", arguments.file.display(), arguments.spacing_mm);
    Ok(())
}
