//! Writes frames as PNG (16 bits, or animated), NRRD and DICOM.

use std::path::Path;

use dicom_core::value::PrimitiveValue;
use dicom_core::{DataElement, Tag, VR};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use xxhash_rust::xxh3::xxh3_128;
use zerocopy::IntoBytes;

use super::poses::Placed;
use crate::failure::Failure;

/// Display time of each frame of an animation, in milliseconds.
const FRAME_MS: u16 = 66;
/// X-Ray Angiographic Image Storage, and Explicit VR Little Endian.
const XA_STORAGE: &str = "1.2.840.10008.5.1.4.1.1.12.1";
const EXPLICIT_LITTLE_ENDIAN: &str = "1.2.840.10008.1.2.1";

/// A rendered frame.
#[derive(Debug, Clone)]
pub struct Picture {
    /// C-arm and isocentre.
    pub placed: Placed,
    /// Whether greys are proportional to the detector's readout; otherwise to its logarithm.
    pub linear: bool,
    /// Row by row, one per detector pixel.
    pub greys: Vec<u16>,
    /// Values before windowing and rounding; only for files that need them.
    pub values: Vec<f32>,
}

impl Picture {
    fn size(&self) -> (u32, u32) {
        (self.placed.c_arm.columns, self.placed.c_arm.rows)
    }
}

fn failed(path: &Path) -> impl Fn(String) -> Failure {
    move |cause| Failure::failed(format!("{}: cannot be written ({cause})", path.display()))
}

/// One 16-bit PNG, animated if there are several frames.
pub fn write_png(path: &Path, pictures: &[Picture]) -> Result<(), Failure> {
    let fail = failed(path);
    let Some(first) = pictures.first() else { return Ok(()) };
    let (columns, rows) = first.size();
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, columns, rows);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    if pictures.len() > 1 {
        encoder.set_animated(pictures.len() as u32, 0).map_err(|e| fail(e.to_string()))?;
        encoder.set_frame_delay(FRAME_MS, 1000).map_err(|e| fail(e.to_string()))?;
    }
    let mut writer = encoder.write_header().map_err(|e| fail(e.to_string()))?;
    for picture in pictures {
        let bytes: Vec<u8> = picture.greys.iter().flat_map(|v| v.to_be_bytes()).collect();
        writer.write_image_data(&bytes).map_err(|e| fail(e.to_string()))?;
    }
    writer.finish().map_err(|e| fail(e.to_string()))?;
    Ok(output_file::write(path, bytes)?)
}

/// Writes a 32-bit NRRD of one frame: -ln of the readout, or the readout in linear mode; pixels in millimetres in the
/// world frame.
pub fn write_nrrd(path: &Path, picture: &Picture) -> Result<(), Failure> {
    let c_arm = &picture.placed.c_arm;
    let vector = |v: [f64; 3]| format!("({:?},{:?},{:?})", v[0] * 1e3, v[1] * 1e3, v[2] * 1e3);
    let step = |axis: [f64; 3], pitch_m: f64| vector(axis.map(|x| x * pitch_m));
    let normal = c_arm.camera(xray::PixelCentre::Whole).rotation[2];
    let header = format!(
        "NRRD0005\n# X-ray frame, written by Trabecula\ntype: float\ndimension: 3\n\
         space: left-posterior-superior\nsizes: {} {} 1\nspace directions: {} {} {}\n\
         kinds: domain domain domain\nendian: little\nencoding: raw\nspace units: \"mm\" \"mm\" \"mm\"\n\
         space origin: {}\nsource_mm:={}\n\n",
        c_arm.columns,
        c_arm.rows,
        step(c_arm.row_axis, c_arm.pixel_pitch_m[0]),
        step(c_arm.column_axis, c_arm.pixel_pitch_m[1]),
        step(normal, 1e-3),
        vector(c_arm.pixel_m(0.0, 0.0)),
        vector(c_arm.source_m),
    );
    let bytes = [header.as_bytes(), picture.values.as_bytes()].concat();
    Ok(output_file::write(path, bytes)?)
}

/// Writes a DICOM X-ray angiography image of one frame, with the positioner's angles and distances.
pub fn write_dicom(path: &Path, picture: &Picture) -> Result<(), Failure> {
    let fail = failed(path);
    let (columns, rows) = picture.size();
    let (columns, rows) = match (u16::try_from(columns), u16::try_from(rows)) {
        (Ok(columns), Ok(rows)) => (columns, rows),
        _ => return Err(Failure::bad_input("DICOM holds at most 65535 pixels a side")),
    };
    // UIDs derived from the image content (PS3.5 B.2: 2.25 and a 128-bit number), so that the same frame gives the
    // same file.
    let content = xxh3_128(picture.greys.as_bytes());
    let uid = |kind: u128| format!("2.25.{}", (content ^ kind) >> 1);
    let mut object = InMemDicomObject::new_empty();
    let mut text = |group, element, vr, value: String| {
        object.put(DataElement::new(Tag(group, element), vr, PrimitiveValue::from(value)));
    };
    let positioner = picture.placed.c_arm.positioner(picture.placed.isocentre_m);
    // A DS value has at most 16 characters.
    let decimal = |x: f64| format!("{x:.8}").chars().take(16).collect::<String>();
    let mm = |x: f64| decimal(x * 1e3);
    let pitch = picture.placed.c_arm.pixel_pitch_m;
    text(0x0008, 0x0008, VR::CS, "DERIVED\\SECONDARY\\SINGLE PLANE".to_owned());
    text(0x0008, 0x0016, VR::UI, XA_STORAGE.to_owned());
    text(0x0008, 0x0018, VR::UI, uid(1));
    text(0x0008, 0x0060, VR::CS, "XA".to_owned());
    text(0x0008, 0x0070, VR::LO, "Trabecula".to_owned());
    text(0x0010, 0x0010, VR::PN, "SIMULATED".to_owned());
    text(0x0010, 0x0020, VR::LO, "SIMULATED".to_owned());
    text(0x0018, 0x1110, VR::DS, mm(positioner.source_detector_m));
    text(0x0018, 0x1111, VR::DS, mm(positioner.source_isocentre_m));
    text(0x0018, 0x1114, VR::DS, decimal(positioner.source_detector_m / positioner.source_isocentre_m));
    // Row spacing comes first.
    text(0x0018, 0x1164, VR::DS, format!("{}\\{}", mm(pitch[1]), mm(pitch[0])));
    text(0x0018, 0x1508, VR::CS, "CARM".to_owned());
    text(0x0018, 0x1510, VR::DS, decimal(positioner.primary_rad.to_degrees()));
    text(0x0018, 0x1511, VR::DS, decimal(positioner.secondary_rad.to_degrees()));
    text(0x0020, 0x000D, VR::UI, uid(2));
    text(0x0020, 0x000E, VR::UI, uid(4));
    text(0x0028, 0x0004, VR::CS, "MONOCHROME2".to_owned());
    // Pixel Intensity Relationship (PS3.3 C.8.7.1.1.3).
    text(0x0028, 0x1040, VR::CS, if picture.linear { "LIN" } else { "LOG" }.to_owned());
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
    let pixels = PrimitiveValue::U16(picture.greys.iter().copied().collect());
    object.put(DataElement::new(Tag(0x7FE0, 0x0010), VR::OW, pixels));
    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(EXPLICIT_LITTLE_ENDIAN)
        .media_storage_sop_class_uid(XA_STORAGE)
        .media_storage_sop_instance_uid(uid(1));
    let file = object.with_meta(meta).map_err(|e| fail(e.to_string()))?;
    let mut bytes = Vec::new();
    file.write_all(&mut bytes).map_err(|e| fail(e.to_string()))?;
    Ok(output_file::write(path, bytes)?)
}
