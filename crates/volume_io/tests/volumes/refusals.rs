//! Every refused input gives its own error, which names the file, the field, the value found and what was
//! expected.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use crate::common::dicom_bytes::{DicomSlice, LOSSLESS_JPEG};
use crate::common::nifti_bytes::NiftiBytes;
use crate::common::{self, gzip, read_bytes, store};
use volume_io::{VolumeError, read};
use voxel_grid::MAX_VOXELS;

const IDENTITY_MM: [[f32; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

fn refuse(name: &str, bytes: &[u8]) -> VolumeError {
    let error = read_bytes(name, bytes).unwrap_err();
    println!("{error}");
    assert!(error.to_string().contains(name), "the message names the file: {error}");
    error
}

/// The error of a NIfTI file after `change`.
fn nifti(change: impl Fn(&mut NiftiBytes)) -> VolumeError {
    let mut file = NiftiBytes::new([2, 3, 4], IDENTITY_MM, &[7; 24]);
    change(&mut file);
    refuse("v.nii", &file.0)
}

fn nifti_affine(affine: [[f32; 4]; 3]) -> VolumeError {
    refuse("v.nii", &NiftiBytes::new([2, 3, 4], affine, &[7; 24]).0)
}

fn nrrd(fields: &str) -> VolumeError {
    let text = format!("NRRD0005\n{fields}\nencoding: raw\nendian: little\n\n");
    refuse("v.nrrd", &[text.as_bytes(), &[0; 48]].concat())
}

fn metaimage(fields: &str) -> VolumeError {
    let text = format!("ObjectType = Image\n{fields}\nElementType = MET_SHORT\nElementDataFile = LOCAL\n");
    refuse("v.mha", &[text.as_bytes(), &[0; 48]].concat())
}

fn series(slices: &[DicomSlice]) -> VolumeError {
    let error = read(common::series(slices).path()).unwrap_err();
    println!("{error}");
    error
}

fn at(position_mm: [f64; 3]) -> DicomSlice {
    DicomSlice { position_mm, ..DicomSlice::default() }
}

fn stack(z_mm: &[f64]) -> Vec<DicomSlice> {
    z_mm.iter().map(|z| at([0.0, 0.0, *z])).collect()
}

#[test]
fn nifti_geometry() {
    let sheared = nifti_affine([[1.0, 0.0, 0.1, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    assert!(matches!(sheared, VolumeError::Sheared { .. }));
    let flat = nifti_affine([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]);
    assert!(matches!(flat, VolumeError::SingularDirection { .. }));
    let zero = nifti_affine([[0.0; 4]; 3]);
    assert!(matches!(zero, VolumeError::SingularDirection { .. }));
    let nan = nifti_affine([[f32::NAN, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    assert!(matches!(nan, VolumeError::SingularDirection { .. }));
    let far = nifti_affine([[1.0, 0.0, 0.0, f32::INFINITY], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    assert!(matches!(far, VolumeError::Header { field, .. } if field.name.contains("qoffset")));
    let huge = nifti_affine([[1e9, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    assert!(matches!(huge, VolumeError::Spacing { .. }));
}

#[test]
fn nifti_header() {
    let field = |error: VolumeError| match error {
        VolumeError::Header { field, .. } => field.name,
        other => panic!("{other}"),
    };
    assert_eq!(field(nifti(|f| f.put(344, b"n+9\0"))), "magic");
    assert_eq!(field(nifti(|f| f.put(344, &[0; 4]))), "magic");
    assert_eq!(field(nifti(|f| f.put(72, &8_i16.to_le_bytes()))), "bitpix");
    assert_eq!(field(nifti(|f| f.put(40, &9_i16.to_le_bytes()))), "dim[0]");
    assert_eq!(field(nifti(|f| f.put(44, &(-3_i16).to_le_bytes()))), "dim");
    assert_eq!(field(nifti(|f| f.put(108, &(-1.0_f32).to_le_bytes()))), "vox_offset");
    assert_eq!(field(nifti(|f| f.put(108, &f32::NAN.to_le_bytes()))), "vox_offset");
    assert_eq!(field(nifti(|f| f.put(123, &[5]))), "xyzt_units");
    assert_eq!(field(nifti(|f| f.put(112, &f32::INFINITY.to_le_bytes()))), "scl_slope, scl_inter");
    assert!(matches!(nifti(|f| f.put(70, &128_i16.to_le_bytes())), VolumeError::NotScalar { .. }));
    assert!(matches!(nifti(|f| f.put(70, &32_i16.to_le_bytes())), VolumeError::NotScalar { .. }));
    assert!(matches!(nifti(|f| f.put(70, &1536_i16.to_le_bytes())), VolumeError::Unsupported { .. }));
    let four = nifti(|f| {
        f.put(40, &4_i16.to_le_bytes());
        f.put(48, &2_i16.to_le_bytes());
    });
    assert!(matches!(four, VolumeError::NotThreeDimensional { .. }));
}

#[test]
fn more_promised_than_there_is() {
    let short = nifti(|f| f.0.truncate(352 + 47));
    assert!(matches!(short, VolumeError::Truncated { given_bytes: 399, expected_bytes: 400, .. }));
    assert!(matches!(nifti(|f| f.0.truncate(200)), VolumeError::Truncated { .. }));
    // 1.6e9 voxels within the limit of int16 sizes, in a file of 400 bytes.
    let promised = nifti(|f| {
        for at in [42, 44, 46] {
            f.put(at, &800_i16.to_le_bytes());
        }
    });
    assert!(matches!(promised, VolumeError::Truncated { .. }));
    let large = nifti(|f| {
        for at in [42, 44, 46] {
            f.put(at, &i16::MAX.to_le_bytes());
        }
    });
    assert!(
        matches!(large, VolumeError::TooLarge { .. }) && large.to_string().contains(&MAX_VOXELS.to_string())
    );
    let lps = "type: short\ndimension: 3\nspace: LPS\nspace directions: (1,0,0) (0,1,0) (0,0,1)";
    assert!(matches!(nrrd(&format!("{lps}\nsizes: 800 800 800")), VolumeError::Truncated { .. }));
    let overflow = format!("{lps}\nsizes: 9999999999 9999999999 9999999999");
    assert!(matches!(nrrd(&overflow), VolumeError::TooLarge { .. }));
    assert!(matches!(
        nrrd(&format!("{lps}\nsizes: 2 3 4\nbyte skip: 9999999999")),
        VolumeError::Truncated { .. }
    ));
    let meta = "NDims = 3\nElementSpacing = 1 1 1\n";
    assert!(matches!(metaimage(&format!("{meta}DimSize = 800 800 800")), VolumeError::Truncated { .. }));
    // A gzip stream of a few bytes cannot hold 512 million voxels: refused before anything is decoded.
    let mut file = NiftiBytes::new([800, 800, 800], IDENTITY_MM, &[]);
    file.put(112, &1.0_f32.to_le_bytes());
    assert!(matches!(refuse("v.nii.gz", &gzip(&file.0)), VolumeError::Truncated { .. }));
}

/// After raw voxels, ITK and nibabel ignore trailing data; for other encodings, extra data mean a wrong
/// header.
#[test]
fn more_data_than_the_header_says_is_refused_or_noted() {
    let header = |error: VolumeError| assert!(matches!(error, VolumeError::Header { .. }), "{error}");
    let noted = |name: &str, bytes: &[u8]| {
        let (_folder, path) = store(name, bytes);
        let (volume, info) = volume_io::read_with_info(&path).unwrap();
        assert_eq!(volume.hu.len(), 24, "{name}");
        assert!(
            info.notes.iter().any(|note| note == "ignored 6 bytes after the voxel data"),
            "{:?}",
            info.notes
        );
    };
    let nifti = |count: usize| NiftiBytes::new([2, 3, 4], IDENTITY_MM, &vec![7; count]).0;
    noted("v.nii", &nifti(27));
    header(refuse("v.nii.gz", &gzip(&nifti(27))));
    let geometry = "type: short\ndimension: 3\nsizes: 2 3 4\nspace: LPS\n\
                    space directions: (1,0,0) (0,1,0) (0,0,1)\nendian: little\n";
    let nrrd = |encoding: &str, data: &[u8]| {
        [format!("NRRD0005\n{geometry}encoding: {encoding}\n\n").as_bytes(), data].concat()
    };
    noted("v.nrrd", &nrrd("raw", &[0; 54]));
    header(refuse("v.nrrd", &nrrd("gzip", &gzip(&[0; 54]))));
    header(refuse("v.nrrd", &nrrd("ascii", "5 ".repeat(25).as_bytes())));
    let mha = |fields: &str, data: &[u8]| {
        let text = format!(
            "ObjectType = Image\nNDims = 3\nDimSize = 2 3 4\nElementSpacing = 1 1 1\n{fields}\n\
             ElementType = MET_SHORT\nElementDataFile = LOCAL\n"
        );
        [text.as_bytes(), data].concat()
    };
    noted("v.mha", &mha("BinaryData = True", &[0; 54]));
    header(refuse("v.mha", &mha("CompressedData = True", &gzip(&[0; 54]))));
    header(refuse("v.mha", &mha("BinaryData = False", "5 ".repeat(25).as_bytes())));
}

#[test]
fn nrrd_header() {
    let lps = "type: short\ndimension: 3\nsizes: 2 3 4\nspace: LPS\n";
    let header = |error: VolumeError, name: &str| {
        assert!(matches!(&error, VolumeError::Header { field, .. } if field.name == name), "{name}: {error}");
    };
    header(nrrd(&format!("{lps}space directions: (1,0,0) (0,1,0)")), "space directions");
    header(nrrd(&format!("{lps}space directions: (1,0,0) (0,1,0) none")), "space directions");
    header(nrrd("type: short\ndimension: 3\nsizes: 2 -3 4\nspacings: 1 1 1"), "sizes");
    header(nrrd("type: short\ndimension: 3\nsizes: 2 3\nspacings: 1 1 1"), "sizes");
    header(nrrd("dimension: 3\nsizes: 2 3 4\nspacings: 1 1 1"), "type");
    header(nrrd("type: short\ntype: int\ndimension: 3\nsizes: 2 3 4\nspacings: 1 1 1"), "type");
    let spacing = |text: &str| nrrd(&format!("type: short\ndimension: 3\nsizes: 2 3 4\nspacings: {text}"));
    for text in ["1 0 1", "1 -1 1", "1 nan 1", "inf 1 1"] {
        assert!(matches!(spacing(text), VolumeError::Spacing { .. }), "{text}");
    }
    let directions = |text: &str| nrrd(&format!("{lps}space directions: {text}"));
    assert!(matches!(directions("(1,0,0) (0,1,0) (0,0.2,1)"), VolumeError::Sheared { .. }));
    assert!(matches!(directions("(1,0,0) (0,1,0) (1,1,0)"), VolumeError::SingularDirection { .. }));
    assert!(matches!(directions("(1,0,0) (0,1,0) (0,0,0)"), VolumeError::SingularDirection { .. }));
    let kinds =
        nrrd("type: short\ndimension: 3\nsizes: 3 3 4\nkinds: RGB-color domain domain\nspacings: 1 1 1");
    assert!(matches!(kinds, VolumeError::NotScalar { .. }));
    let block = nrrd("type: block\ndimension: 3\nsizes: 2 3 4\nspacings: 1 1 1");
    assert!(matches!(block, VolumeError::Unsupported { .. }));
    let mirrored = nrrd("type: short\ndimension: 3\nsizes: 2 3 4\nspace: 3D-left-handed\nspacings: 1 1 1");
    assert!(matches!(mirrored, VolumeError::Unsupported { .. }));
    let units =
        nrrd(&format!("{lps}space directions: (1,0,0) (0,1,0) (0,0,1)\nspace units: \"mm\" \"mm\" \"s\""));
    assert!(matches!(units, VolumeError::Unsupported { .. }));
}

#[test]
fn metaimage_header() {
    let base = "NDims = 3\nDimSize = 2 3 4\nElementSpacing = 1 1 1\n";
    let matrix = |m: &str| metaimage(&format!("{base}TransformMatrix = {m}"));
    assert!(matches!(matrix("1 0 0 0 1 0 0.1 0 1"), VolumeError::Sheared { .. }));
    assert!(matches!(matrix("1 0 0 1 0 0 0 0 1"), VolumeError::SingularDirection { .. }));
    assert!(matches!(matrix("1 0 0 0 1 0 0 0"), VolumeError::Header { .. }));
    let zero = metaimage("NDims = 3\nDimSize = 2 3 4\nElementSpacing = 1 0 1");
    assert!(matches!(zero, VolumeError::Spacing { .. }));
    let flat = metaimage("NDims = 2\nDimSize = 2 3\nElementSpacing = 1 1");
    assert!(matches!(flat, VolumeError::NotThreeDimensional { .. }));
    let colour = metaimage(&format!("{base}ElementNumberOfChannels = 3"));
    assert!(matches!(colour, VolumeError::NotScalar { .. }));
    let scaled = metaimage(&format!("{base}ElementToIntensityFunctionSlope = 2"));
    assert!(matches!(scaled, VolumeError::Unsupported { .. }));
    let twice = metaimage(&format!("{base}Offset = 1 2 3\nOffset = 1 2 4"));
    assert!(matches!(twice, VolumeError::Header { field, .. } if field.name == "Offset"));
}

#[test]
fn dicom_stacks() {
    assert!(matches!(series(&stack(&[0.0, 1.0, 3.0, 4.0])), VolumeError::MissingSlices { .. }));
    assert!(matches!(series(&stack(&[0.0, 1.0, 2.4, 3.4])), VolumeError::VariableSpacing { .. }));
    assert!(matches!(series(&stack(&[0.0, 1.0, 1.0, 2.0])), VolumeError::DuplicateSlices { .. }));
    // A gantry tilted by 5.7 degrees: each slice is shifted by 0.1 mm per millimetre.
    let tilted: Vec<DicomSlice> = [0.0, 1.0, 2.0].map(|z| at([0.0, 0.1 * z, z])).to_vec();
    assert!(matches!(series(&tilted), VolumeError::Sheared { .. }));
    let change = |change: fn(&mut DicomSlice)| {
        let mut slices = stack(&[0.0, 1.0, 2.0]);
        change(&mut slices[1]);
        series(&slices)
    };
    let mixed = [
        change(|s| s.orientation = "0\\1\\0\\0\\0\\-1"),
        change(|s| s.pixel_spacing = "2\\2"),
        change(|s| s.rows = 3),
    ];
    assert!(mixed.iter().all(|error| matches!(error, VolumeError::MixedSeries { .. })));
    assert!(matches!(change(|s| s.series_uid = "1.2.4"), VolumeError::SeveralSeries { .. }));
    assert!(matches!(change(|s| s.samples_per_pixel = 3), VolumeError::NotScalar { .. }));
    let all = |change: fn(&mut DicomSlice)| {
        let mut slices = stack(&[0.0, 1.0]);
        slices.iter_mut().for_each(change);
        series(&slices)
    };
    assert!(matches!(all(|s| s.orientation = "1\\0\\0\\0.1\\0.995\\0"), VolumeError::Sheared { .. }));
    assert!(matches!(all(|s| s.orientation = "1\\0\\0\\0\\0\\0"), VolumeError::SingularDirection { .. }));
    assert!(matches!(all(|s| s.orientation = "1\\0\\0\\0\\1"), VolumeError::Header { .. }));
    assert!(matches!(all(|s| s.pixel_spacing = "0\\1"), VolumeError::Spacing { .. }));
    assert!(matches!(all(|s| s.pixel_spacing = "nan\\1"), VolumeError::Header { .. }));
    assert!(matches!(all(|s| s.position_mm[2] = f64::NAN), VolumeError::Header { .. }));
    assert!(matches!(
        all(|s| s.transfer_syntax = "1.2.840.10008.1.2.4.201"),
        VolumeError::Unsupported { .. }
    ));
    let rle = |slice: &mut DicomSlice| {
        slice.transfer_syntax = "1.2.840.10008.1.2.5";
        slice.fragment = Some(vec![0xff; 70]);
    };
    assert!(matches!(all(rle), VolumeError::Corrupt { .. }));
    let jpeg = |slice: &mut DicomSlice| {
        slice.transfer_syntax = "1.2.840.10008.1.2.4.70";
        slice.fragment = Some(LOSSLESS_JPEG[..40].to_vec());
    };
    assert!(matches!(all(jpeg), VolumeError::Corrupt { .. }));
}

#[test]
fn dicom_files() {
    let whole = DicomSlice::default().bytes();
    assert!(matches!(refuse("v.dcm", &whole[..whole.len() - 2]), VolumeError::Truncated { .. }));
    // The pixels are a complete element, but shorter than rows × columns.
    let mut taller = whole.clone();
    let rows = taller.windows(6).position(|w| w == b"\x28\0\x10\0US").unwrap() + 8;
    taller[rows] = 5;
    assert!(matches!(
        refuse("v.dcm", &taller),
        VolumeError::Truncated { given_bytes: 40, expected_bytes: 50, .. }
    ));
    // An element that promises 4 GB in a file of one kilobyte.
    let mut promised = whole.clone();
    let pixels = promised.windows(6).position(|w| w == b"\xe0\x7f\x10\0OW").unwrap() + 8;
    promised[pixels..pixels + 4].copy_from_slice(&0xffff_fffe_u32.to_le_bytes());
    assert!(matches!(refuse("v.dcm", &promised), VolumeError::Truncated { .. }));
    // Neither a preamble nor a data set at the start.
    assert!(matches!(refuse("v.dcm", &whole[130..]), VolumeError::NotAVolume { .. }));
    // Endlessly nested sequences.
    let mut nested = whole[..whole.len() - 52].to_vec();
    for _ in 0..5000 {
        nested.extend(b"\x40\0\x75\x02SQ\0\0\xff\xff\xff\xff\xfe\xff\0\xe0\xff\xff\xff\xff");
    }
    assert!(
        matches!(refuse("v.dcm", &nested), VolumeError::Header { field, .. } if field.name == "sequence")
    );
}

/// A used element with a part of a number. What is not used may have any length.
#[test]
fn a_dicom_value_with_a_part_of_a_number_is_refused() {
    let mut explicit = DicomSlice::default().bytes();
    let samples = explicit.windows(6).position(|w| w == b"\x28\0\x02\0US").unwrap();
    explicit[samples + 4..samples + 6].copy_from_slice(b"SL");
    let field = |error| match error {
        VolumeError::Header { field, expected, .. } => (field.name, expected),
        other => panic!("{other}"),
    };
    let refused = field(refuse("v.dcm", &explicit));
    assert_eq!(refused, ("(0028,0002)".to_owned(), "a multiple of 4 bytes".to_owned()));
    // Without VRs in the file the dictionary knows them: 2 bytes of (0008,1160), an IS, and 3 of (0028,0010),
    // an US.
    let mut implicit = DicomSlice { transfer_syntax: "1.2.840.10008.1.2", ..DicomSlice::default() }.bytes();
    let data_set = implicit.windows(6).position(|w| w == b"\x08\0\x60\0CS").unwrap();
    implicit.truncate(data_set);
    implicit.extend(b"\x08\0\x60\x11\x02\0\0\x001 \x28\0\x10\0\x03\0\0\0\x04\0\0");
    let refused = field(refuse("v.dcm", &implicit));
    assert_eq!(refused, ("(0028,0010)".to_owned(), "a multiple of 2 bytes".to_owned()));
}

#[test]
fn files_that_are_not_volumes_are_refused() {
    for (name, bytes) in [
        ("empty", b"".as_slice()),
        ("v.nii", b""),
        ("v.nii.gz", b"\x1f\x8b"),
        ("v.nrrd", b""),
        ("v.mha", b""),
        ("notes.txt", b"hello, this is not a volume"),
        ("photo.jpg", b"\xff\xd8\xff\xe0"),
        ("v.nrrd", b"NRRD"),
        ("v.mhd", b"\xff\xfe\0\0"),
    ] {
        refuse(name, bytes);
    }
    let folder = tempfile::tempdir().unwrap();
    assert!(matches!(read(folder.path()), Err(VolumeError::NotAVolume { .. })));
    assert!(matches!(read(folder.path().join("absent.nii")), Err(VolumeError::Io { .. })));
    let detached = "NRRD0005\ntype: short\ndimension: 3\nsizes: 2 3 4\nspacings: 1 1 1\nendian: \
                    little\nencoding: raw\ndata file: gone.raw\n";
    // The message names the missing file instead of the header.
    assert!(matches!(read_bytes("v.nhdr", detached.as_bytes()), Err(VolumeError::Io { .. })));
    assert!(matches!(read("/dev/null"), Err(VolumeError::NotAVolume { .. })));
}
