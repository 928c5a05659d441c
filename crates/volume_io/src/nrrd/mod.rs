//! NRRD files: attached (.nrrd) and detached (.nhdr, one data file or several), raw, gzip, bzip2, hex or
//! text; 3D Slicer segmentations.
//!
//! Source: "Definition of NRRD File Format", teem.sourceforge.net/nrrd/format.html. There is no maintained
//! crate for this format.

mod axes;
mod data;
mod geometry;
mod header;
mod segments;

use crate::error::VolumeError;
use crate::options::ReadOptions;
use crate::volume::{VolumeInfo, placed};
use axes::Axes;
use header::Header;
use std::path::Path;
use voxel_grid::Volume;

/// The encoding of voxels in the header's own file; `None` if they are in other files.
pub(crate) fn attached_encoding(path: &Path, options: &ReadOptions) -> Result<Option<String>, VolumeError> {
    let header = Header::read(path, options.data_files)?;
    let encoding = header.get("encoding").unwrap_or_default().to_lowercase();
    Ok(header.get("data file").is_none().then_some(encoding))
}

/// Reads the volume whose header is at `path`.
pub(crate) fn read(path: &Path, options: &ReadOptions) -> Result<(Volume, VolumeInfo), VolumeError> {
    let header = Header::read(path, options.data_files)?;
    let axes = Axes::of(&header)?;
    let count = axes.number_count(path)?;
    let mut notes = Vec::new();
    let wanted = segments::wanted(&header, &axes, options.label.as_ref(), &mut notes)?;
    let (unit_m, unit_name) = header.unit(&axes)?;
    let geometry = header.geometry(&axes, unit_m, &mut notes)?;
    let mut sink = options.sink(path)?;
    let stored = header.read_data(count, &mut sink, &mut notes)?;
    let mut hu = sink.finish(&mut notes);
    if let Some(other) = axes.other {
        hu = other.part(&hu, wanted.as_ref().map_or(0, |wanted| wanted.layer));
    }
    if let Some(wanted) = wanted {
        crate::mask::keep_label(path, &mut hu, wanted.value)?;
    }
    let volume = placed(path, axes.dims, geometry, hu)?;
    let kind = if header.get("data file").is_some() { ", detached" } else { "" };
    let format = format!("NRRD ({}{kind})", stored.encoding);
    let info = VolumeInfo::new(&volume, format, stored.voxels, unit_name, notes);
    Ok((volume, info))
}
