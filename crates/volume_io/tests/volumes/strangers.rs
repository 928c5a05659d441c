//! Tests of untrusted volumes: which files they may name, what they may cost, and how their texts are shown.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used, clippy::panic)]

use std::fs;
use std::io::Write;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use crate::common::dicom_bytes::{DicomSlice, LOSSLESS_JPEG, write_series};
use crate::common::nifti_bytes::NiftiBytes;
use volume_io::{DataFiles, ReadOptions, VolumeError, read, read_as, read_with_info};

const GEOMETRY: &str = "type: short\ndimension: 3\nsizes: 2 3 4\nspace: LPS\nspace directions: (1,0,0) \
                        (0,1,0) (0,0,1)\nendian: little\n";

fn nhdr(data_file: &str) -> String {
    format!("NRRD0005\n{GEOMETRY}encoding: raw\ndata file: {data_file}\n")
}

fn mhd(data_file: &str) -> String {
    format!(
        "ObjectType = Image\nNDims = 3\nDimSize = 2 3 4\nElementSpacing = 1 1 1\nElementType = \
         MET_SHORT\nElementDataFile = {data_file}\n"
    )
}

/// A folder with an untrusted header, next to a private file that could serve as voxels.
struct Place {
    folder: tempfile::TempDir,
}

impl Place {
    fn new() -> Place {
        let place = Place { folder: tempfile::tempdir().unwrap() };
        fs::create_dir_all(place.path("private")).unwrap();
        fs::create_dir_all(place.path("theirs/sub")).unwrap();
        fs::write(place.path("private/diary"), [7_u8; 48]).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn theirs(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path("theirs").join(name);
        fs::write(&path, content).unwrap();
        path
    }
}

fn assert_elsewhere(path: &Path, what: &str) {
    match read(path) {
        Err(error @ VolumeError::Elsewhere { .. }) => {
            assert!(error.to_string().contains("--allow-elsewhere"), "{what}: {error}");
        }
        other => panic!("{what}: {:?}", other.map(|volume| volume.hu)),
    }
    let anywhere = ReadOptions { data_files: DataFiles::Anywhere, ..ReadOptions::default() };
    assert!(read_as(path, &anywhere).is_ok(), "{what}, allowed");
}

#[test]
fn no_header_makes_a_picture_of_a_file_elsewhere() {
    let place = Place::new();
    let diary = place.path("private/diary");
    symlink(&diary, place.path("theirs/link.raw")).unwrap();
    symlink("../../private", place.path("theirs/sub/out")).unwrap();
    let absolute = diary.to_str().unwrap();
    for name in [absolute, "../private/diary", "sub/../../private/diary", "link.raw", "sub/out/diary"] {
        assert_elsewhere(&place.theirs("v.nhdr", nhdr(name)), &format!("NRRD {name}"));
        assert_elsewhere(&place.theirs("v.mhd", mhd(name)), &format!("MetaImage {name}"));
    }
    // Files in the folder are read, also through links that stay inside it.
    place.theirs("sub/v.raw", [7_u8; 48]);
    symlink("sub/v.raw", place.path("theirs/inner.raw")).unwrap();
    let own = place.path("theirs/sub/v.raw").canonicalize().unwrap();
    for name in ["sub/v.raw", "./sub/../sub/v.raw", "inner.raw", own.to_str().unwrap()] {
        assert!(read(place.theirs("v.nhdr", nhdr(name))).is_ok(), "NRRD {name}");
        assert!(read(place.theirs("v.mhd", mhd(name))).is_ok(), "MetaImage {name}");
    }
    // A folder that is itself a link, and a header in the folder where the program runs.
    symlink(place.path("theirs"), place.path("by_link")).unwrap();
    assert!(read(place.path("by_link/v.nhdr")).is_ok());
    // Lists and patterns name files just as a single name does.
    fs::copy(&diary, place.path("private/diary1")).unwrap();
    for name in [
        "LIST\n../private/diary",
        "LIST\nsub/out/diary",
        "../private/diary%d 1 1 1",
        "sub/out/diary%01d 1 1 1",
    ] {
        assert_elsewhere(&place.theirs("v.nhdr", nhdr(name)), &format!("NRRD {name}"));
        assert_elsewhere(&place.theirs("v.mhd", mhd(name)), &format!("MetaImage {name}"));
    }
    for name in ["LIST", "%02d.raw 1 4", "%s 1 4 1"] {
        for path in [place.theirs("v.nhdr", nhdr(name)), place.theirs("v.mhd", mhd(name))] {
            assert!(matches!(read(&path), Err(VolumeError::Header { .. })), "{name}");
        }
    }
}

#[test]
fn no_link_beside_a_header_or_in_a_series_leads_elsewhere() {
    let place = Place::new();
    let identity = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let mut header = NiftiBytes::new([2, 3, 4], identity, &[]);
    header.put(344, b"ni1\0");
    header.put(108, &0.0_f32.to_le_bytes());
    let header = place.theirs("v.hdr", &header.0[..348]);
    symlink(place.path("private/diary"), place.path("theirs/v.img")).unwrap();
    assert_elsewhere(&header, "the voxels of a NIfTI pair");

    fs::create_dir(place.path("series")).unwrap();
    let slice = |z: f64| DicomSlice { position_mm: [0.0, 0.0, z], ..DicomSlice::default() };
    write_series(&place.path("series"), &[slice(0.0), slice(1.0)]);
    fs::write(place.path("private/scan.dcm"), slice(2.0).bytes()).unwrap();
    // A link to a file without an image is skipped like any other file.
    symlink("../private/diary", place.path("series/README")).unwrap();
    assert!(read(place.path("series")).is_ok());
    symlink("../private/scan.dcm", place.path("series/002.dcm")).unwrap();
    assert_elsewhere(&place.path("series"), "a folder with a link to an image");
    assert_elsewhere(&place.path("series/000.dcm"), "a series with a link to an image");
}

/// Regression: 4 kB of bzip2 were decoded for 23 s.
#[test]
fn bzip2_that_grows_without_end_is_refused_before_it_is_decoded() {
    let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::best());
    encoder.write_all(&vec![0; 30 << 20]).unwrap();
    let stream = encoder.finish().unwrap();
    let data = stream.repeat(35);
    assert!(data.len() < 8000, "{}", data.len());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.nrrd");
    for more in ["", "byte skip: -1\n"] {
        let sizes = GEOMETRY.replace("2 3 4", "800 800 800");
        let header = format!("NRRD0005\n{sizes}{more}encoding: bzip2\n\n");
        fs::write(&path, [header.as_bytes(), &data].concat()).unwrap();
        let error = read(&path).unwrap_err();
        assert!(
            matches!(error, VolumeError::Unsupported { .. } | VolumeError::TooLarge { .. }),
            "{more:?}: {error}"
        );
    }
    // A small volume of nothing but air is compressed as densely, and is read.
    let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::best());
    encoder.write_all(&vec![0; 128 * 128 * 128 * 2]).unwrap();
    let header = format!("NRRD0005\n{}encoding: bzip2\n\n", GEOMETRY.replace("2 3 4", "128 128 128"));
    fs::write(&path, [header.as_bytes(), &encoder.finish().unwrap()].concat()).unwrap();
    assert_eq!(read(&path).unwrap().hu.len(), 128 * 128 * 128);
}

/// Regression: a header of 23000 x 23000 pixels in 9 kB took 3.1 GB and returned invented voxels.
#[test]
fn a_jpeg_that_cannot_hold_its_pixels_is_refused_before_they_take_memory() {
    let folder = tempfile::tempdir().unwrap();
    let series = |rows: u16, columns: u16, data: Vec<u8>| {
        let slice = DicomSlice {
            transfer_syntax: "1.2.840.10008.1.2.4.70",
            rows,
            columns,
            fragment: Some(data),
            ..DicomSlice::default()
        };
        write_series(folder.path(), &[slice]);
        read(folder.path())
    };
    assert!(series(4, 5, LOSSLESS_JPEG.to_vec()).is_ok());
    let mut huge = LOSSLESS_JPEG.to_vec();
    huge[7..11].copy_from_slice(&[0x59, 0xd8, 0x59, 0xd8]);
    // Scan data of a few thousand pixels.
    huge.splice(49..50, vec![0; 9000]);
    let error = series(23000, 23000, huge).unwrap_err();
    assert!(matches!(&error, VolumeError::Corrupt { codec: "JPEG", .. }), "{error}");
    assert!(error.to_string().contains("cannot hold 529000000 pixels"), "{error}");
    // Truncated in the middle: missing pixels are not invented.
    let error = series(4, 5, LOSSLESS_JPEG[..50].to_vec()).unwrap_err();
    assert!(matches!(&error, VolumeError::Corrupt { codec: "JPEG", .. }), "{error}");
}

/// Escape sequences, an old-style line end, a mark that reverses the text, a bell.
const HOSTILE: &str = "x\x1b[2J\x1b]0;owned\x07\rforged\u{202e}\u{9b}31m";

#[test]
fn texts_of_a_volume_hold_nothing_that_a_terminal_obeys() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, content: &[u8]| {
        let path = folder.path().join(name);
        fs::write(&path, content).unwrap();
        path
    };
    let check = |path: &Path| {
        let said = match read_with_info(path) {
            Ok((_, info)) => info.to_string(),
            Err(error) => error.to_string(),
        };
        let bad = |c: char| (c.is_control() && c != '\n') || c == '\u{202e}';
        assert!(!said.contains(bad), "{said:?}");
        assert!(said.contains("\\u001b"), "the text is shown: {said:?}");
    };
    let lps = "sizes: 2 3 4\nspace: LPS\nspace directions: (1,0,0) (0,1,0) (0,0,1)";
    for field in
        ["type", "dimension", "encoding", "endian", "space", "kinds", "space units", "data file", "sizes"]
    {
        let header = format!("NRRD0005\ntype: short\ndimension: 3\n{lps}\nencoding: raw\nendian: little\n");
        let header: String = header
            .lines()
            .filter(|line| !line.starts_with(&format!("{field}:")))
            .map(|l| l.to_owned() + "\n")
            .collect();
        let text = format!("{header}{field}: {HOSTILE}\n\n");
        check(&file("v.nrrd", &[text.as_bytes(), &[0; 48]].concat()));
    }
    for field in
        ["NDims", "DimSize", "ElementType", "ElementSpacing", "ElementDataFile", "ObjectType", "BinaryData"]
    {
        let fields = mhd("LOCAL");
        // In order: everything after `ElementDataFile` is data.
        let text: String = fields
            .lines()
            .map(|line| match line.starts_with(field) {
                true => format!("{field} = {HOSTILE}\n"),
                false => format!("{line}\n"),
            })
            .collect();
        let text = if text.contains(HOSTILE) { text } else { format!("{field} = {HOSTILE}\n{text}") };
        check(&file("v.mha", &[text.as_bytes(), &[0; 48]].concat()));
    }
    for change in [
        |slice: &mut DicomSlice| slice.orientation = HOSTILE,
        |slice: &mut DicomSlice| slice.pixel_spacing = HOSTILE,
        |slice: &mut DicomSlice| slice.transfer_syntax = HOSTILE,
    ] {
        let mut slice = DicomSlice::default();
        change(&mut slice);
        check(&file("v.dcm", &slice.bytes()));
    }
    // A text of a megabyte is not printed in full.
    let text = format!(
        "NRRD0005\ntype: {}\ndimension: 3\n{lps}\nencoding: raw\nendian: little\n\n",
        "x".repeat(1 << 19)
    );
    let error = read(file("v.nrrd", text.as_bytes())).unwrap_err().to_string();
    assert!(error.len() < 2000, "{}", error.len());
}

/// Regression: anything nested deeper than eight folders was silently ignored.
#[test]
fn a_folder_deeper_than_is_looked_into_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let deep = (0..9).fold(folder.path().to_owned(), |path, _| path.join("f"));
    fs::create_dir_all(&deep).unwrap();
    let error = read(folder.path()).unwrap_err();
    assert!(error.to_string().contains("more than 8 deep"), "{error}");
}
