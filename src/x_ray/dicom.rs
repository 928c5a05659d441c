//! Writes frames as DICOM X-ray angiography (XA) images that `dciodvfy` (dicom3tools) accepts.
//!
//! Source: DICOM PS3.3 A.14 (the modules of an XA image), C.7 (patient, study, series, equipment, image),
//! C.8.7.1 to C.8.7.5 (X-ray image, acquisition, XA positioner), C.11.1 (modality LUT).

use std::path::Path;

use dicom_core::value::{DataSetSequence, PrimitiveValue, Value};
use dicom_core::{DataElement, Tag, VR};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use xray::WindowLimits;
use xxhash_rust::xxh3::xxh3_128;
use zerocopy::IntoBytes;

use super::files::{Picture, failed};
use super::poses::ResolvedPose;
use crate::failure::Failure;

/// X-Ray Angiographic Image Storage, and Explicit VR Little Endian.
const XA_STORAGE: &str = "1.2.840.10008.5.1.4.1.1.12.1";
const EXPLICIT_LITTLE_ENDIAN: &str = "1.2.840.10008.1.2.1";
/// Type 2 and 2C attributes without a value in a simulation: required, but allowed to be empty.
const EMPTY: [(u16, u16, VR); 14] = [
    (0x0008, 0x0020, VR::DA), // StudyDate
    (0x0008, 0x0023, VR::DA), // ContentDate
    (0x0008, 0x0030, VR::TM), // StudyTime
    (0x0008, 0x0033, VR::TM), // ContentTime
    (0x0008, 0x0050, VR::SH), // AccessionNumber
    (0x0008, 0x0090, VR::PN), // ReferringPhysicianName
    (0x0010, 0x0030, VR::DA), // PatientBirthDate
    (0x0010, 0x0040, VR::CS), // PatientSex
    (0x0018, 0x0060, VR::DS), // KVP: a single photon energy has none
    (0x0018, 0x1150, VR::IS), // ExposureTime
    (0x0018, 0x1151, VR::IS), // XRayTubeCurrent
    (0x0018, 0x1152, VR::IS), // Exposure
    (0x0020, 0x0010, VR::SH), // StudyID
    (0x0020, 0x0060, VR::CS), // Laterality
];

/// Attributes shared by the frames of one call.
#[derive(Debug, Clone, Copy)]
pub struct Series {
    key: u128,
    tube_kv: Option<f64>,
}

impl Series {
    /// Creates the series of these poses of a volume; the same call gives the same identifiers.
    pub fn new(volume_sha256: [u8; 32], poses: &[ResolvedPose], tube_kv: Option<f64>) -> Series {
        let text = format!("{volume_sha256:?} {poses:?} {tube_kv:?}");
        Series { key: xxh3_128(text.as_bytes()), tube_kv }
    }
}

/// Writes one image with the positioner's angles and distances; `number` counts from 1 within the series.
///
/// # Errors
/// More pixels than DICOM supports (2); a file that cannot be written.
pub fn write_dicom(path: &Path, picture: &Picture, series: &Series, number: usize) -> Result<(), Failure> {
    let (columns, rows) = picture.size();
    let (columns, rows) = match (u16::try_from(columns), u16::try_from(rows)) {
        (Ok(columns), Ok(rows)) => (columns, rows),
        _ => return Err(Failure::bad_input("DICOM images have at most 65535 rows and columns")),
    };
    // UIDs derived from the content (PS3.5 B.2: 2.25 and a 128-bit number), so that the same call gives the
    // same files.
    let uid = |content: u128, kind: u128| format!("2.25.{}", (content ^ kind) >> 1);
    let content = xxh3_128(picture.greys.as_bytes()) ^ series.key.rotate_left(number as u32 % 128);
    let mut object = InMemDicomObject::new_empty();
    for (group, element, vr) in EMPTY {
        object.put(DataElement::new(Tag(group, element), vr, PrimitiveValue::Empty));
    }
    for (group, element, vr, value) in texts(picture, series, number) {
        object.put(DataElement::new(Tag(group, element), vr, PrimitiveValue::from(value)));
    }
    for (group, element, value) in [
        (0x0008, 0x0016, XA_STORAGE.to_owned()),
        (0x0008, 0x0018, uid(content, 1)),
        (0x0020, 0x000d, uid(series.key, 2)),
        (0x0020, 0x000e, uid(series.key, 4)),
    ] {
        object.put(DataElement::new(Tag(group, element), VR::UI, PrimitiveValue::from(value)));
    }
    for (element, value) in [
        (0x0002, 1),
        (0x0010, rows),
        (0x0011, columns),
        (0x0100, 16),
        (0x0101, 16),
        (0x0102, 15),
        (0x0103, 0),
    ] {
        object.put(DataElement::new(Tag(0x0028, element), VR::US, PrimitiveValue::from(value)));
    }
    // Pixel Intensity Relationship Sign: 1 if more intensity is a larger value.
    let sign: i16 = if picture.look.linear || picture.look.dense_is_dark { 1 } else { -1 };
    object.put(DataElement::new(Tag(0x0028, 0x1041), VR::SS, PrimitiveValue::from(sign)));
    if !picture.look.linear {
        object.put(intensity_table(picture));
    }
    let pixels = PrimitiveValue::U16(picture.greys.iter().copied().collect());
    object.put(DataElement::new(Tag(0x7fe0, 0x0010), VR::OW, pixels));
    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(EXPLICIT_LITTLE_ENDIAN)
        .media_storage_sop_class_uid(XA_STORAGE)
        .media_storage_sop_instance_uid(uid(content, 1));
    let file = object.with_meta(meta).map_err(failed(path))?;
    let mut bytes = Vec::new();
    file.write_all(&mut bytes).map_err(failed(path))?;
    Ok(output_file::write(path, bytes)?)
}

/// Returns the text attributes: tag, value representation, value.
fn texts(picture: &Picture, series: &Series, number: usize) -> Vec<(u16, u16, VR, String)> {
    let c_arm = &picture.placed.c_arm;
    let positioner = c_arm.positioner(picture.placed.isocentre_m);
    let mm = |x: f64| decimal(x * 1e3);
    let [across_m, down_m] = c_arm.pixel_pitch_m;
    let orientation =
        format!("{}\\{}", patient_direction(c_arm.row_axis), patient_direction(c_arm.column_axis));
    let mut out = vec![
        (0x0008, 0x0008, VR::CS, "DERIVED\\SECONDARY\\SINGLE PLANE".to_owned()),
        (0x0008, 0x0060, VR::CS, "XA".to_owned()),
        (0x0008, 0x0070, VR::LO, "Trabecula".to_owned()),
        (0x0008, 0x2111, VR::ST, "Rendered from a CT volume".to_owned()),
        (0x0010, 0x0010, VR::PN, "SIMULATED^XRAY".to_owned()),
        (0x0010, 0x0020, VR::LO, "SIMULATED".to_owned()),
        (0x0018, 0x1110, VR::DS, mm(positioner.source_detector_m)),
        (0x0018, 0x1111, VR::DS, mm(positioner.source_isocentre_m)),
        (0x0018, 0x1114, VR::DS, decimal(positioner.source_detector_m / positioner.source_isocentre_m)),
        (0x0018, 0x1155, VR::CS, "GR".to_owned()),
        // Row spacing comes first.
        (0x0018, 0x1164, VR::DS, format!("{}\\{}", mm(down_m), mm(across_m))),
        (0x0018, 0x1510, VR::DS, decimal(positioner.primary_rad.to_degrees())),
        (0x0018, 0x1511, VR::DS, decimal(positioner.secondary_rad.to_degrees())),
        (0x0020, 0x0011, VR::IS, "1".to_owned()),
        (0x0020, 0x0013, VR::IS, number.to_string()),
        (0x0020, 0x0020, VR::CS, orientation),
        (0x0028, 0x0004, VR::CS, "MONOCHROME2".to_owned()),
        // Pixel Intensity Relationship (PS3.3 C.8.7.1.1.2).
        (0x0028, 0x1040, VR::CS, if picture.look.linear { "LIN" } else { "LOG" }.to_owned()),
        // Window over all greys.
        (0x0028, 0x1050, VR::DS, "32768".to_owned()),
        (0x0028, 0x1051, VR::DS, "65536".to_owned()),
    ];
    if let Some(tube_kv) = series.tube_kv {
        out.push((0x0018, 0x0060, VR::DS, decimal(tube_kv)));
    }
    out
}

/// Formats a DS value: at most 16 characters, without negative zero.
fn decimal(value: f64) -> String {
    let text: String = format!("{value:.8}").chars().take(16).collect();
    let zero = text.chars().all(|c| matches!(c, '-' | '0' | '.'));
    if zero { "0".to_owned() } else { text }
}

/// Minimum component of a unit vector that gets a letter, 3 degrees.
const LEAST_PART: f64 = 0.05;

/// Returns a direction in patient letters, largest component first (PS3.3 C.7.6.1.1.1): left or right,
/// posterior or anterior, head or foot.
fn patient_direction(axis: [f64; 3]) -> String {
    let letters = [('L', 'R'), ('P', 'A'), ('H', 'F')];
    let mut parts: Vec<(f64, char)> = axis
        .iter()
        .zip(letters)
        .map(|(x, (plus, minus))| (x.abs(), if *x > 0.0 { plus } else { minus }))
        .collect();
    parts.sort_by(|a, b| b.0.total_cmp(&a.0));
    parts.into_iter().filter(|(size, _)| *size >= LEAST_PART).map(|(_, letter)| letter).collect()
}

/// Builds the table of logarithmic images from greys to values linear in the detected X-ray intensity (PS3.3
/// C.8.7.1.1.2): 65535 at the low end of the window, decreasing by exp(-attenuation).
fn intensity_table(picture: &Picture) -> DataElement<InMemDicomObject> {
    let WindowLimits { low, high } = picture.window;
    let intensity = |grey: u16| {
        let share = f64::from(grey) / 65535.0;
        let above_low = (high - low) * if picture.look.dense_is_dark { 1.0 - share } else { share };
        (65535.0 * (-above_low).exp() + 0.5) as u16
    };
    let table: Vec<u16> = (0..=u16::MAX).map(intensity).collect();
    let mut item = InMemDicomObject::new_empty();
    // 0 means 65536 entries; the first grey; bits per entry.
    let descriptor = PrimitiveValue::U16([0, 0, 16].into_iter().collect());
    item.put(DataElement::new(Tag(0x0028, 0x3002), VR::US, descriptor));
    let explanation = format!("65535 at -ln(I/I0) = {low:.6}");
    item.put(DataElement::new(Tag(0x0028, 0x3003), VR::LO, PrimitiveValue::from(explanation)));
    item.put(DataElement::new(Tag(0x0028, 0x3004), VR::LO, PrimitiveValue::from("US")));
    let entries = PrimitiveValue::U16(table.into_iter().collect());
    item.put(DataElement::new(Tag(0x0028, 0x3006), VR::OW, entries));
    DataElement::new(Tag(0x0028, 0x3000), VR::SQ, Value::Sequence(DataSetSequence::from(vec![item])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_angle_is_minus_zero() {
        assert_eq!([decimal(-0.0), decimal(-1e-12), decimal(0.0)], ["0", "0", "0"]);
        assert_eq!(decimal(-30.0), "-30.00000000");
        assert!(decimal(-123_456_789.123).len() <= 16);
    }

    #[test]
    fn directions_have_the_patients_letters_largest_first() {
        assert_eq!(patient_direction([1.0, 0.0, 0.0]), "L");
        assert_eq!(patient_direction([0.0, 0.0, -1.0]), "F");
        assert_eq!(patient_direction([-0.8, 0.6, 0.01]), "RP");
    }
}
