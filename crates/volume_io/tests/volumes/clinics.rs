//! Tests of clinical data: selecting series and labels, and compressed frames with false headers.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use crate::common::dicom_bytes::{DicomSlice, write_series};
use std::path::{Path, PathBuf};
use volume_io::{Label, ReadOptions, SliceHandling, VolumeError, read, read_as};

fn refuse(bytes: &[u8]) -> VolumeError {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.dcm");
    std::fs::write(&path, bytes).unwrap();
    let error = read(&path).unwrap_err();
    println!("{error}");
    error
}

fn stack(z_mm: &[f64]) -> Vec<DicomSlice> {
    z_mm.iter().map(|z| DicomSlice { position_mm: [0.0, 0.0, *z], ..DicomSlice::default() }).collect()
}

/// Regression: a study folder was refused without listing its series.
#[test]
fn a_folder_of_several_series_lists_them_and_takes_the_one_named() {
    let folder = tempfile::tempdir().unwrap();
    let below = folder.path().join("below");
    std::fs::create_dir(&below).unwrap();
    let slices = |uid, stored| -> Vec<DicomSlice> {
        stack(&[0.0, 2.0]).into_iter().map(|s| DicomSlice { series_uid: uid, stored, ..s }).collect()
    };
    write_series(folder.path(), &slices("1.2.3", 1024));
    write_series(&below, &slices("1.2.4", 1030));
    let error = read(folder.path()).unwrap_err();
    let said = error.to_string();
    assert!(matches!(error, VolumeError::SeveralSeries { .. }));
    assert!(
        said.contains("1.2.3 (2 slices, CT") && said.contains("1.2.4 (2 slices") && said.contains("--series"),
        "{said}"
    );
    let of = |uid: &str| ReadOptions { series: Some(uid.to_owned()), ..ReadOptions::default() };
    let (volume, info) = read_as(folder.path(), &of("1.2.4")).unwrap();
    assert!(volume.hu.iter().all(|hu| *hu == 6), "{:?}", info.notes);
    assert!(info.notes.iter().any(|note| note == "1 other series in the folder ignored"));
    let said = read_as(folder.path(), &of("9.9")).unwrap_err().to_string();
    assert!(said.contains("series 9.9") && said.contains("1.2.3"), "{said}");
}

#[test]
fn a_label_that_is_not_there_is_refused_with_those_that_are() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.seg.nrrd");
    let header = "NRRD0005\ntype: uchar\ndimension: 3\nsizes: 2 2 1\nspace: LPS\nspace directions: (1,0,0) \
                  (0,1,0) (0,0,1)\n\
                  encoding: raw\nSegment0_Name:=femur\nSegment0_LabelValue:=2\nSegment0_Layer:=0\n\n";
    std::fs::write(&path, [header.as_bytes(), &[0, 2, 2, 0]].concat()).unwrap();
    let read = |label| read_as(&path, &ReadOptions { label: Some(label), ..ReadOptions::default() });
    assert_eq!(read(Label::Name("femur".into())).unwrap().0.hu, [0, 1, 1, 0]);
    assert_eq!(read(Label::Value(2)).unwrap().0.hu, [0, 1, 1, 0]);
    let said = read(Label::Name("tibia".into())).unwrap_err().to_string();
    assert!(said.contains("tibia") && said.contains("\"femur\" (2)"), "{said}");
    let said = read(Label::Value(7)).unwrap_err().to_string();
    assert!(said.contains("label 7") && said.contains("[0, 2]"), "{said}");
}

/// Two voxels of a CT, -1000 and 300 HU.
fn two_voxels(folder: &Path) -> PathBuf {
    let path = folder.join("ct.nrrd");
    let header = "NRRD0005\ntype: short\ndimension: 3\nsizes: 2 1 1\nspace: LPS\nspace directions: (1,0,0) \
                  (0,1,0) (0,0,1)\n\
                  encoding: raw\nendian: little\n\n";
    let voxels = [-1000_i16, 300].map(i16::to_le_bytes).concat();
    std::fs::write(&path, [header.as_bytes(), &voxels].concat()).unwrap();
    path
}

/// Regression: selecting a series or resampling slices was silently ignored for other formats.
#[test]
fn choices_for_dicom_are_said_to_have_no_effect_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let path = two_voxels(folder.path());
    let noted = |options: &ReadOptions| read_as(&path, options).unwrap().1.notes.join("\n");
    let series = noted(&ReadOptions { series: Some("1.2.3".to_owned()), ..ReadOptions::default() });
    assert!(series.contains("`volume.series`") && !series.contains("rectify"), "{series}");
    let slices = noted(&ReadOptions { slices: SliceHandling::Rectify, ..ReadOptions::default() });
    assert!(slices.contains("`volume.resample`") && !slices.contains("series`"), "{slices}");
    let neither = noted(&ReadOptions::default());
    assert!(!neither.contains("no effect"), "{neither}");
    write_series(folder.path(), &stack(&[0.0, 2.0]));
    std::fs::remove_file(path).unwrap();
    let of_dicom = ReadOptions { slices: SliceHandling::Rectify, ..ReadOptions::default() };
    let info = read_as(folder.path(), &of_dicom).unwrap().1.to_string();
    assert!(!info.contains("no effect"), "{info}");
}

/// Regression: a CT opened as a label map had its air turned into bone.
#[test]
fn hounsfield_units_are_no_labels() {
    let folder = tempfile::tempdir().unwrap();
    let path = two_voxels(folder.path());
    for label in [-1000, 300] {
        let options = ReadOptions { label: Some(Label::Value(label)), ..ReadOptions::default() };
        let said = read_as(&path, &options).unwrap_err().to_string();
        assert!(said.contains("which holds -1000") && said.contains("Hounsfield"), "{said}");
    }
}

/// A frame with a header of 20000 x 20000 pixels in a few bytes, whose decoder would invent the missing data.
#[test]
fn packed_frames_that_cannot_hold_their_pixels_are_refused_before_they_take_memory() {
    let jls = [
        0xff, 0xd8, 0xff, 0xf7, 0, 11, 16, 0x4e, 0x20, 0x4e, 0x20, 1, 1, 0x11, 0, 0xff, 0xda, 0, 8, 1, 1, 0,
        0, 0, 0, 0, 0xff, 0xd9,
    ];
    let slice = DicomSlice {
        transfer_syntax: "1.2.840.10008.1.2.4.80",
        rows: 20_000,
        columns: 20_000,
        fragment: Some(jls.to_vec()),
        ..DicomSlice::default()
    };
    let error = refuse(&slice.bytes()).to_string();
    assert!(error.contains("cannot hold 400000000 pixels"), "{error}");
}

#[test]
fn a_deflated_data_set_that_grows_without_end_is_refused() {
    use std::io::Write;
    let slice = DicomSlice { transfer_syntax: "1.2.840.10008.1.2.1.99", ..DicomSlice::default() }.bytes();
    // After the meta group, whose length is in its first element.
    let begin = 132 + 12 + u32::from_le_bytes(slice[140..144].try_into().unwrap()) as usize;
    let deflated = |data: &[u8]| {
        let mut encoder = flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::best());
        encoder.write_all(data).unwrap();
        [&slice[..begin], &encoder.finish().unwrap()].concat()
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.dcm");
    std::fs::write(&path, deflated(&slice[begin..])).unwrap();
    assert!(read(&path).unwrap().hu.iter().all(|hu| *hu == 0));
    // Zeros are no data set; inflating must stop at the largest file size.
    refuse(&deflated(&vec![0; 64 << 20]));
}

/// Regression: MR slices in a CT's series were read as Hounsfield units if the first slice was CT.
#[test]
fn a_series_of_two_modalities_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut slices = stack(&[0.0, 2.0, 4.0]);
    slices[2].modality = "MR";
    write_series(folder.path(), &slices);
    let error = read(folder.path()).unwrap_err();
    let said = error.to_string();
    assert!(matches!(error, VolumeError::MixedSeries { .. }), "{said}");
    assert!(said.contains("Modality") && said.contains("002.dcm"), "{said}");
}

/// Regression: `volume info` reported only the slope of the first slice.
#[test]
fn slices_of_several_slopes_are_each_scaled_by_their_own_and_it_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let mut slices = stack(&[0.0, 2.0]);
    slices[1].slope = "2";
    write_series(folder.path(), &slices);
    let (volume, info) = read_as(folder.path(), &ReadOptions::default()).unwrap();
    assert_eq!((volume.hu[0], volume.hu[20]), (0, 1024));
    assert!(info.to_string().contains("slope and intercept of each slice"), "{info}");
}

/// Regression: stored values of 1024 and more were silently read as bone.
#[test]
fn values_that_need_not_be_hounsfield_units_are_said() {
    let noted = |change: fn(&mut DicomSlice)| {
        let folder = tempfile::tempdir().unwrap();
        let mut slices = stack(&[0.0, 2.0]);
        change(&mut slices[1]);
        write_series(folder.path(), &slices);
        read_as(folder.path(), &ReadOptions::default()).unwrap().1.to_string()
    };
    let without = noted(|slice| slice.intercept = None);
    assert!(without.contains("no RescaleIntercept (0028,1052)"), "{without}");
    let unspecified = noted(|slice| slice.rescale_type = Some("US"));
    assert!(unspecified.contains("RescaleType (0028,1054) is `US`"), "{unspecified}");
    for plain in [noted(|_| ()), noted(|slice| slice.rescale_type = Some("HU"))] {
        assert!(!plain.contains("Rescale"), "{plain}");
    }
}
