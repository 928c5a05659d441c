//! A DICOM file in memory, with or without preamble: its data set is decompressed, and its used elements are
//! found.
//!
//! Source: DICOM PS3.10 section 7 (preamble, file meta group), PS3.5 annex A.5 (deflate).

use super::elements::Elements;
use super::fields::Fields;
use super::scan::{self, Meta, Pixels, Transfer};
use crate::error::VolumeError;
use crate::input;
use dicom_core::VR;
use std::io::Read;
use std::path::Path;

/// Largest accepted DICOM file: the largest volume in 16-bit pixels, plus its headers.
const MAX_FILE_BYTES: u64 = 2 * voxel_grid::MAX_VOXELS as u64 + (64 << 20);
/// Deflate cannot exceed 1032:1 (zlib technical notes).
const MOST_DEFLATE: u64 = 1032;
/// Leading bytes needed to recognize a DICOM file.
pub(super) const HEAD_BYTES: usize = 136;

/// A file whose used elements have been found.
pub(super) struct DicomFile {
    pub bytes: Vec<u8>,
    pub transfer: Transfer,
    pub pixels: Option<Pixels>,
    elements: Elements,
}

/// How a file begins.
enum Start {
    /// With a file meta group at this byte.
    Meta(usize),
    /// Directly with the data set, as in files from older programs.
    DataSet(Transfer),
}

fn start(head: &[u8]) -> Option<Start> {
    if is_part10(head) {
        return Some(Start::Meta(132));
    }
    if head.starts_with(b"DICM") {
        return Some(Start::Meta(4));
    }
    let [g0, g1, e0, e1, v0, v1, l0, l1] = *head.first_chunk::<8>()?;
    let (group, element) = (u16::from_le_bytes([g0, g1]), u16::from_le_bytes([e0, e1]));
    if group == 0x0002 && element <= 0x0010 && matches!([v0, v1], [b'U', b'L'] | [b'O', b'B'] | [b'U', b'I'])
    {
        return Some(Start::Meta(0));
    }
    // Group 8 comes first in every image; these elements, all short, can lead it.
    if group != 0x0008 || ![0x0000, 0x0001, 0x0005, 0x0008, 0x0012, 0x0013, 0x0016, 0x0018].contains(&element)
    {
        return None;
    }
    // A VR after the first tag means explicit VRs (PS3.5 section 7.1).
    if VR::from_binary([v0, v1]).is_some() {
        return Some(Start::DataSet(scan::EXPLICIT));
    }
    let length = u32::from_le_bytes([v0, v1, l0, l1]);
    ((2..=256).contains(&length) && length.is_multiple_of(2)).then_some(Start::DataSet(scan::IMPLICIT))
}

/// Whether a file that begins with these bytes has DICOM's preamble (PS3.10 section 7.1).
pub(crate) fn is_part10(head: &[u8]) -> bool {
    head.get(128..132) == Some(b"DICM".as_slice())
}

/// Whether a file that begins with these bytes is DICOM.
pub(crate) fn is_dicom(head: &[u8]) -> bool {
    start(head).is_some()
}

impl DicomFile {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// `NotAVolume` if the beginning is not recognized; `Truncated`, `Header`, `Unsupported` or `Corrupt`
    /// from [`scan`].
    pub fn open(path: &Path) -> Result<DicomFile, VolumeError> {
        match DicomFile::scan(path)? {
            (file, None) => Ok(file),
            (_, Some(problem)) => Err(problem),
        }
    }

    /// Reads a file as far as possible, with the problem that ended it or makes its pixels unreadable.
    ///
    /// # Errors
    /// As [`DicomFile::open`], if not even the beginning of the data set can be read.
    pub fn scan(path: &Path) -> Result<(DicomFile, Option<VolumeError>), VolumeError> {
        let bytes = read_bytes(path)?;
        let Meta { transfer, end, refused } = match start(&bytes) {
            Some(Start::Meta(at)) => scan::meta_group(path, &bytes, at)?,
            Some(Start::DataSet(transfer)) => Meta { transfer, end: 0, refused: None },
            None => {
                return Err(VolumeError::not_a_volume(
                    path,
                    "not a DICOM file: no `DICM` after 128 bytes, and no data set at the start",
                ));
            }
        };
        let (bytes, begin) =
            if transfer.deflated { (inflate(path, &bytes[end..])?, 0) } else { (bytes, end) };
        let mut elements = Elements::default();
        let (pixels, problem) = match scan::data_set(path, &bytes, begin, transfer, &mut elements) {
            Ok(pixels) => (pixels, None),
            Err(problem) => (None, Some(problem)),
        };
        Ok((DicomFile { bytes, transfer, pixels, elements }, refused.or(problem)))
    }

    /// The elements before the pixels.
    pub fn fields<'a>(&'a self, path: &'a Path) -> Fields<'a> {
        Fields { path, bytes: &self.bytes, elements: &self.elements }
    }
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, VolumeError> {
    let (file, length) = input::open(path)?;
    if length > MAX_FILE_BYTES {
        return Err(too_long(path, format!("{length} bytes")));
    }
    let mut bytes = Vec::with_capacity(length as usize);
    file.take(length).read_to_end(&mut bytes).map_err(input::io_error(path, "read"))?;
    Ok(bytes)
}

fn too_long(path: &Path, given: String) -> VolumeError {
    VolumeError::unsupported(path, "file size", given, format!("at most {MAX_FILE_BYTES} bytes per file"))
}

/// Inflates a data set; memory grows with the decoded data, up to the largest file.
fn inflate(path: &Path, packed: &[u8]) -> Result<Vec<u8>, VolumeError> {
    let most = MAX_FILE_BYTES.min(packed.len() as u64 * MOST_DEFLATE);
    let mut bytes = Vec::new();
    let corrupt = |error: std::io::Error| VolumeError::Corrupt {
        path: path.into(),
        codec: "deflate",
        reason: error.to_string(),
    };
    flate2::read::DeflateDecoder::new(packed).take(most + 1).read_to_end(&mut bytes).map_err(corrupt)?;
    if bytes.len() as u64 > most {
        return Err(too_long(path, format!("deflated data of more than {most} bytes")));
    }
    Ok(bytes)
}
