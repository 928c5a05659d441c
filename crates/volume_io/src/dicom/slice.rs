//! The slices of a DICOM file: the required header fields of a single image, or of each frame of an enhanced
//! one.
//!
//! Source: DICOM PS3.3 section C.7.6.2 (image plane), C.7.6.16 (multi-frame functional groups), C.8.15
//! (enhanced CT).

use super::elements::Tag;
use super::fields::Fields;
use super::file::DicomFile;
use super::pixels::Bits;
use super::scan::Transfer;
use crate::error::VolumeError;
use crate::scalar::Scale;
use std::path::{Path, PathBuf};
use voxel_grid::MAX_VOXELS_ALONG_AXIS;

const SHARED_GROUPS: Tag = Tag(0x5200, 0x9229);
const FRAME_GROUPS: Tag = Tag(0x5200, 0x9230);
const PLANE_POSITION: Tag = Tag(0x0020, 0x9113);
const PLANE_ORIENTATION: Tag = Tag(0x0020, 0x9116);
const SPACING_BETWEEN_SLICES: Tag = Tag(0x0018, 0x0088);
const PIXEL_MEASURES: Tag = Tag(0x0028, 0x9110);
const VALUE_TRANSFORMATION: Tag = Tag(0x0028, 0x9145);

/// A slice's header, not yet checked against other slices. Lengths in millimetres, as in DICOM.
#[derive(Clone, Debug)]
pub(super) struct Slice {
    pub path: PathBuf,
    /// Frame index, and number of frames in the file.
    pub frame: usize,
    pub frames: usize,
    pub transfer: Transfer,
    pub modality: String,
    pub rows: usize,
    pub columns: usize,
    pub position_mm: [f64; 3],
    /// Whether the file states its position, instead of that of the first frame.
    pub has_own_position: bool,
    /// Direction of increasing column index, then of increasing row index, LPS.
    pub orientation: [f64; 6],
    /// Distance between rows, then between columns.
    pub pixel_spacing_mm: [f64; 2],
    pub slice_thickness_mm: Option<f64>,
    pub gantry_tilt_deg: Option<f64>,
    pub scale: Scale,
    /// Whether RescaleIntercept is present: without it the stored values are the slice's own.
    pub has_intercept: bool,
    /// RescaleType: unit of the scaled values.
    pub rescale_type: Option<String>,
    pub bits: Bits,
    /// PixelPaddingValue to PixelPaddingRangeLimit: stored values outside the reconstructed field.
    pub padding: Option<[f64; 2]>,
    pub sop_instance_uid: Option<String>,
    /// What tells the phases of a series apart: TemporalPositionIdentifier, AcquisitionNumber, TriggerTime.
    pub phase: [Option<String>; 3],
}

/// Kind of a file, and its slices.
pub(super) struct Identity {
    pub series_uid: String,
    pub modality: String,
    pub description: String,
    pub images: Images,
    /// The headers of its slices, or why they cannot be used.
    pub slices: Result<Vec<Slice>, VolumeError>,
    /// Why the file cannot be read beyond this.
    pub problem: Option<VolumeError>,
}

/// Image content of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Images {
    /// No image: a report, a structure set.
    None,
    /// The scout view used to plan the slices, which lies in another plane.
    Localizer,
    /// Number of frames.
    Frames(usize),
}

/// Identifies a file.
///
/// # Errors
/// As [`DicomFile::scan`].
pub(super) fn identify(path: &Path) -> Result<Identity, VolumeError> {
    let (file, problem) = DicomFile::scan(path)?;
    let fields = file.fields(path);
    let text = |tag| fields.text(tag).map(Option::unwrap_or_default);
    let kind = text(Tag(0x0008, 0x0008))?;
    let has_size = fields.text(Tag(0x0028, 0x0010))?.is_some() && fields.text(Tag(0x0028, 0x0011))?.is_some();
    let images = if !has_size {
        Images::None
    } else if kind.split('\\').nth(2).is_some_and(|value| value.trim() == "LOCALIZER") {
        Images::Localizer
    } else {
        Images::Frames(frame_count(fields)?)
    };
    Ok(Identity {
        series_uid: text(Tag(0x0020, 0x000e))?,
        modality: text(Tag(0x0008, 0x0060))?,
        description: text(Tag(0x0008, 0x103e))?,
        images,
        slices: read_headers(&file, fields),
        problem,
    })
}

fn frame_count(fields: Fields<'_>) -> Result<usize, VolumeError> {
    let tag = Tag(0x0028, 0x0008);
    let count = fields.optional(tag, "NumberOfFrames")?.unwrap_or(1.0);
    let valid = (1.0..=MAX_VOXELS_ALONG_AXIS as f64).contains(&count) && count.fract() == 0.0;
    let expected = format!("1 to {MAX_VOXELS_ALONG_AXIS}");
    valid
        .then_some(count as usize)
        .ok_or_else(|| fields.wrong(tag, "NumberOfFrames", count.to_string(), &expected))
}

/// Reads and checks the headers of a file's slices.
fn read_headers(file: &DicomFile, fields: Fields<'_>) -> Result<Vec<Slice>, VolumeError> {
    fields.refuse_other_layouts()?;
    let frames = frame_count(fields)?;
    let groups = fields.items(FRAME_GROUPS);
    if groups.len() == 0 {
        let first = || slice(file, fields, &Groups::plain(fields), FrameNumber { index: 0, count: frames });
        if frames == 1 {
            return Ok(vec![first()?]);
        }
        if let Some(step_mm) = fields.optional(SPACING_BETWEEN_SLICES, "SpacingBetweenSlices")? {
            return Ok(stacked(&first()?, step_mm));
        }
    }
    if groups.len() != frames {
        return Err(VolumeError::unsupported(
            fields.path,
            "(0028,0008) NumberOfFrames",
            format!("{frames}, with the positions of {} frames", groups.len()),
            "one slice per file, the position of every frame (enhanced CT), or SpacingBetweenSlices \
             (0018,0088)",
        ));
    }
    let shared = fields.item(SHARED_GROUPS);
    let each = groups.enumerate();
    each.map(|(index, own)| {
        let number = FrameNumber { index, count: frames };
        slice(file, fields, &Groups { own, shared, image: fields }, number)
    })
    .collect()
}

/// Returns the frames of a classic image, which gives the position of the first one and the distance of the
/// others along the normal.
fn stacked(first: &Slice, step_mm: f64) -> Vec<Slice> {
    let [a, b, c, d, e, f] = first.orientation;
    let normal = [b * f - c * e, c * d - a * f, a * e - b * d];
    let frame = |index: usize| Slice {
        frame: index,
        position_mm: [0, 1, 2].map(|i| first.position_mm[i] + index as f64 * step_mm * normal[i]),
        has_own_position: index == 0,
        ..first.clone()
    };
    (0..first.frames).map(frame).collect()
}

/// Where the elements of a frame are: in its own functional groups, in the shared ones, or in the classic
/// image itself.
struct Groups<'a> {
    own: Fields<'a>,
    shared: Option<Fields<'a>>,
    image: Fields<'a>,
}

impl<'a> Groups<'a> {
    fn plain(image: Fields<'a>) -> Self {
        Self { own: image, shared: None, image }
    }

    /// The item that holds a group's elements.
    fn get(&self, group: Tag) -> Fields<'a> {
        self.own
            .item(group)
            .or_else(|| self.shared.and_then(|shared| shared.item(group)))
            .unwrap_or(self.image)
    }
}

/// Frame index, and number of frames in the file.
struct FrameNumber {
    index: usize,
    count: usize,
}

fn slice(
    file: &DicomFile,
    fields: Fields<'_>,
    groups: &Groups<'_>,
    number: FrameNumber,
) -> Result<Slice, VolumeError> {
    let size = |tag, name| -> Result<usize, VolumeError> {
        let value = fields.number(tag, name)?;
        let whole = (1.0..=65535.0).contains(&value).then_some(value as usize);
        whole.ok_or_else(|| fields.wrong(tag, name, value.to_string(), "1 to 65535"))
    };
    let values = groups.get(VALUE_TRANSFORMATION);
    let slope = values.optional(Tag(0x0028, 0x1053), "RescaleSlope")?.unwrap_or(1.0);
    let intercept = values.optional(Tag(0x0028, 0x1052), "RescaleIntercept")?;
    let measures = groups.get(PIXEL_MEASURES);
    let bits = Bits::of(fields)?;
    let modality = fields.text(Tag(0x0008, 0x0060))?.unwrap_or_default();
    // Other modalities use a value of the measured range, and have no Hounsfield units of air.
    let padding = if modality == "CT" { bits.padding(fields)? } else { None };
    let scale_name = "(0028,1053) RescaleSlope, (0028,1052) RescaleIntercept";
    Ok(Slice {
        path: fields.path.into(),
        frame: number.index,
        frames: number.count,
        transfer: file.transfer,
        modality,
        rows: size(Tag(0x0028, 0x0010), "Rows")?,
        columns: size(Tag(0x0028, 0x0011), "Columns")?,
        position_mm: groups.get(PLANE_POSITION).numbers(Tag(0x0020, 0x0032), "ImagePositionPatient")?,
        has_own_position: true,
        orientation: groups.get(PLANE_ORIENTATION).numbers(Tag(0x0020, 0x0037), "ImageOrientationPatient")?,
        pixel_spacing_mm: measures.numbers(Tag(0x0028, 0x0030), "PixelSpacing")?,
        slice_thickness_mm: measures.optional(Tag(0x0018, 0x0050), "SliceThickness")?,
        gantry_tilt_deg: fields.optional(Tag(0x0018, 0x1120), "GantryDetectorTilt")?,
        scale: Scale::checked(fields.path, scale_name, slope, intercept.unwrap_or(0.0))?,
        has_intercept: intercept.is_some(),
        rescale_type: values.text(Tag(0x0028, 0x1054))?,
        bits,
        padding,
        sop_instance_uid: fields.text(Tag(0x0008, 0x0018))?,
        phase: [
            fields.text(Tag(0x0020, 0x0100))?,
            fields.text(Tag(0x0020, 0x0012))?,
            fields.text(Tag(0x0018, 0x1060))?,
        ],
    })
}
