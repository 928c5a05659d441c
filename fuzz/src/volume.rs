//! The volume readers. They read files, so each input is written to a folder in memory.

use std::cell::OnceCell;
use std::io::Write;
use std::path::{Path, PathBuf};

use flate2::Compression;
use voxel_grid::Volume;

use crate::seeds::{DEFLATED_SYNTAX, DicomSlice, JPEG_SYNTAXES, LATER_SYNTAXES, RLE_SYNTAX};

/// A folder that is removed with the process, with the files that accompany the input.
struct Folder(tempfile::TempDir);

thread_local! {
    static FOLDER: OnceCell<Folder> = const { OnceCell::new() };
}

impl Folder {
    fn new() -> Folder {
        let memory = Path::new("/dev/shm");
        let parent = if memory.is_dir() { memory.to_path_buf() } else { std::env::temp_dir() };
        let folder = tempfile::Builder::new().prefix("trabecula_fuzz_").tempdir_in(parent).unwrap();
        let voxels: Vec<u8> = (0..4096_u32).map(|n| n as u8).collect();
        // Data files of detached headers.
        std::fs::write(folder.path().join("v.raw"), &voxels).unwrap();
        std::fs::write(folder.path().join("v.img"), &voxels).unwrap();
        // A neighbour in the series of the slice that is read.
        let series = folder.path().join("series");
        std::fs::create_dir(&series).unwrap();
        let neighbour = DicomSlice { position_mm: [0.0, 0.0, 5.0], ..DicomSlice::default() };
        std::fs::write(series.join("000.dcm"), neighbour.bytes()).unwrap();
        Folder(folder)
    }
}

/// Writes a file of these bytes.
pub(crate) fn in_memory(name: &str, bytes: &[u8]) -> PathBuf {
    let path = FOLDER.with(|folder| folder.get_or_init(Folder::new).0.path().join(name));
    std::fs::write(&path, bytes).unwrap();
    path
}

fn read(name: &str, bytes: &[u8]) -> Option<Volume> {
    let path = in_memory(name, bytes);
    match volume_io::read(&path) {
        Ok(volume) => {
            assert_eq!(volume.hu.len(), volume.grid.voxel_count());
            Some(volume)
        }
        Err(error) => {
            assert!(!error.to_string().is_empty());
            None
        }
    }
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut out = flate2::write::GzEncoder::new(Vec::new(), Compression::none());
    out.write_all(bytes).unwrap();
    out.finish().unwrap()
}

fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut out = flate2::write::ZlibEncoder::new(Vec::new(), Compression::none());
    out.write_all(bytes).unwrap();
    out.finish().unwrap()
}

fn bzip2(bytes: &[u8]) -> Vec<u8> {
    let mut out = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::fast());
    out.write_all(bytes).unwrap();
    out.finish().unwrap()
}

/// NIfTI: plain, compressed as given, and compressed here, so that the checksum of gzip rejects nothing.
pub fn nifti(data: &[u8]) {
    if data.starts_with(&[0x1f, 0x8b]) {
        read("v.nii.gz", data);
        return;
    }
    let pair = data.get(344..347) == Some(b"ni1") || data.get(4..7) == Some(b"ni2");
    if pair {
        read("v.hdr", data);
        return;
    }
    let plain = read("v.nii", data);
    let packed = read("v.nii.gz", &gzip(data));
    if let (Some(plain), Some(packed)) = (plain, packed) {
        assert!(
            plain.hu == packed.hu && plain.grid.dims() == packed.grid.dims(),
            "packing changes the volume"
        );
    }
}

/// NRRD: as given, and with the data after its header compressed here, as the header states.
pub fn nrrd(data: &[u8]) {
    read("v.nrrd", data);
    let end = data.windows(2).position(|pair| pair == b"\n\n").map(|at| at + 2);
    let Some((header, voxels)) = end.map(|end| data.split_at(end)) else { return };
    let says = |text: &[u8]| header.windows(text.len()).any(|part| part.eq_ignore_ascii_case(text));
    if says(b"encoding: gz") {
        read("v.nrrd", &[header, &gzip(voxels)].concat());
    } else if says(b"encoding: bz") {
        read("v.nrrd", &[header, &bzip2(voxels)].concat());
    }
}

/// MetaImage: as given, and with the data after its header compressed here.
pub fn metaimage(data: &[u8]) {
    read("v.mha", data);
    let key = b"ElementDataFile";
    let at = data.windows(key.len()).position(|part| part == key);
    let end = at.and_then(|at| data[at..].iter().position(|byte| *byte == b'\n').map(|line| at + line + 1));
    if let Some((header, voxels)) = end.map(|end| data.split_at(end)) {
        let packed = b"CompressedData = True";
        if header.windows(packed.len()).any(|part| part == packed) {
            read("v.mha", &[header, &zlib(voxels)].concat());
        }
    }
}

/// DICOM: a file, read with its neighbour in the series, and its data set deflated here; or, if it is not
/// DICOM, a data set without a preamble, and compressed pixels of an otherwise valid slice. Their first bytes
/// are transfer syntax, rows and columns.
pub fn dicom(data: &[u8]) {
    if data.get(128..132) == Some(b"DICM") {
        read("series/001.dcm", data);
        read("v.dcm", &deflated(data));
        return;
    }
    if data.first() == Some(&8) {
        read("v.dcm", data);
    }
    let [syntax, rows, columns, fragment @ ..] = data else { return };
    let syntaxes = [JPEG_SYNTAXES.as_slice(), &[RLE_SYNTAX], &LATER_SYNTAXES].concat();
    let slice = DicomSlice {
        transfer_syntax: syntaxes[usize::from(*syntax) % syntaxes.len()],
        rows: u16::from(*rows),
        columns: u16::from(*columns),
        fragment: Some(fragment.to_vec()),
        ..DicomSlice::default()
    };
    read("v.dcm", &slice.bytes());
}

/// Builds a slice whose meta group says "deflated", followed by the deflated bytes after the preamble and the
/// first 200 bytes.
fn deflated(data: &[u8]) -> Vec<u8> {
    let slice = DicomSlice { transfer_syntax: DEFLATED_SYNTAX, ..DicomSlice::default() }.bytes();
    let told = slice.get(140..144).and_then(|bytes| bytes.try_into().ok()).map_or(0, u32::from_le_bytes);
    let begin = 144 + told as usize;
    let mut out = flate2::write::DeflateEncoder::new(Vec::new(), Compression::none());
    out.write_all(data.get(begin..).unwrap_or_default()).unwrap();
    [&slice[..begin.min(slice.len())], &out.finish().unwrap()].concat()
}
