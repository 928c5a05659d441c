//! NIfTI-1 and NIfTI-2 files: .nii, .hdr/.img, each plain or gzip.

use crate::error::{Field, VolumeError};
use crate::input::{self, Codec, DataFiles};
use crate::nifti_header::{NIFTI2_SIZE, parse};
use crate::options::{ReadOptions, SliceHandling};
use crate::rectify;
use crate::volume::{
    GeometryFields, StatedGeometry, VolumeInfo, columns, norm, placed, placement, voxel_count,
};
use std::path::{Path, PathBuf};
use voxel_grid::Volume;

/// Reads the volume whose header is at `path`.
pub(crate) fn read(path: &Path, options: &ReadOptions) -> Result<(Volume, VolumeInfo), VolumeError> {
    let codec = codec_of(path)?;
    let bytes = input::head(path, 0, codec, NIFTI2_SIZE)?;
    let header = parse(path, &bytes)?;
    let count = voxel_count(path, "dim", header.dims)?;
    let mut notes = header.notes;
    let stated = stated(path, &header.affine, header.unit_m)?;
    let placed_as = match placement(path, NAMES, stated, &mut notes) {
        Err(VolumeError::Sheared(..))
            if options.slices == SliceHandling::Rectify && rectify::is_askew_stack(&stated, header.dims) =>
        {
            None
        }
        placement => Some(placement?),
    };

    let (data_path, data_codec) = if header.single_file {
        (path.to_path_buf(), codec)
    } else {
        let image = image_of(path, options.data_files)?;
        let codec = codec_of(&image)?;
        (image, codec)
    };
    let mut sink = options.sink(path)?;
    let data = (data_path.as_path(), 0, data_codec);
    header.layout.read_file(data, header.data_offset, ("dim", count), &mut sink, &mut notes)?;
    if header.layout.scale != crate::scalar::Scale::IDENTITY {
        let scale = header.layout.scale;
        notes.push(format!("values are {} x stored + {}", scale.slope, scale.intercept));
    }
    let mut hu = sink.finish(&mut notes);
    options.keep_label(path, &mut hu)?;
    let volume = match placed_as {
        Some(placement) => placed(path, header.dims, placement, hu)?,
        None => rectify::askew_stack(path, NAMES, &stated, header.dims, &hu, &mut notes)?,
    };
    let pair = if header.single_file { "" } else { ", .hdr/.img" };
    let format = format!("NIfTI-{} ({}{pair})", header.version, data_codec.name());
    let stored_as = header.layout.scalar.describe(header.endian);
    let info = VolumeInfo::new(&volume, format, stored_as, header.unit_name.into(), notes);
    Ok((volume, info))
}

/// gzip or raw, by the first two bytes rather than by name.
fn codec_of(path: &Path) -> Result<Codec, VolumeError> {
    let magic = input::head(path, 0, Codec::Raw, 2)?;
    Ok(if magic == [0x1f, 0x8b] { Codec::Gzip } else { Codec::Raw })
}

const NAMES: GeometryFields =
    GeometryFields { spacing: "pixdim or srow", direction: "srow or quatern", origin: "srow or qoffset" };

/// Converts the RAS affine to LPS geometry in metres: x and y change sign.
fn stated(path: &Path, affine: &[[f64; 4]; 3], unit_m: f64) -> Result<StatedGeometry, VolumeError> {
    let [x, y, z] = *affine;
    let lps = [x.map(|v| -v), y.map(|v| -v), z];
    let axes = columns(lps.map(|row| [row[0], row[1], row[2]]));
    // A zero column is reported as a direction error: that is the actual fault, not the size.
    let singular = axes.iter().any(|axis| {
        let length = norm(*axis);
        !(length.is_finite() && length > 0.0)
    });
    if singular {
        return Err(VolumeError::SingularDirection(Field::new(path, NAMES.direction, format!("{affine:?}"))));
    }
    let spacing_m = axes.map(|axis| norm(axis) * unit_m);
    Ok(StatedGeometry { spacing_m, origin_m: lps.map(|row| row[3] * unit_m), axes })
}

/// The .img file of a .hdr file (plain or gzip).
fn image_of(header: &Path, files: DataFiles) -> Result<PathBuf, VolumeError> {
    let image = partner(header, ".hdr", ".img").ok_or_else(|| {
        VolumeError::header(
            header,
            "magic",
            "ni1 or ni2: the voxels are in a separate file",
            "an .img or .img.gz file beside a header named .hdr or .hdr.gz",
        )
    })?;
    // The name derives from the header's, but the file may be a link.
    let name = image.file_name().unwrap_or_default().to_string_lossy().into_owned();
    input::data_file(header, "magic", &name, files)
}

/// The .hdr file of an .img file (plain or gzip), if there is one.
pub(crate) fn header_of(image: &Path) -> Option<PathBuf> {
    partner(image, ".img", ".hdr")
}

fn partner(path: &Path, from: &str, to: &str) -> Option<PathBuf> {
    let name = path.file_name()?.to_str()?;
    let bare = name.strip_suffix(".gz").unwrap_or(name);
    let stem_length = bare.to_lowercase().strip_suffix(from)?.len();
    let stem = bare.get(..stem_length)?;
    [to.to_string(), format!("{to}.gz")]
        .iter()
        .map(|suffix| path.with_file_name(format!("{stem}{suffix}")))
        .find(|candidate| candidate.is_file())
}
