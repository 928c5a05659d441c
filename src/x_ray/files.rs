//! Writes frames as PNG (16 bits, or animated) and NRRD.

use std::path::Path;

use xray::display::WindowLimits;
use zerocopy::IntoBytes;

use super::poses::Placed;
use crate::failure::Failure;

/// Display time of each frame of an animation, in milliseconds.
const FRAME_MS: u16 = 66;

/// A rendered frame.
#[derive(Debug, Clone)]
pub struct Picture {
    /// C-arm and isocentre.
    pub placed: Placed,
    /// Whether greys are proportional to the detector's readout; otherwise to its logarithm.
    pub linear: bool,
    /// Whether more attenuation is darker; of no meaning if linear.
    pub dense_is_dark: bool,
    /// The attenuations (-ln of the fraction of photons) at the ends of the grey scale; of no meaning if linear.
    pub window: WindowLimits,
    /// Row by row, one per detector pixel.
    pub greys: Vec<u16>,
    /// Values before windowing and rounding; only for files that need them.
    pub values: Vec<f32>,
}

impl Picture {
    pub(super) fn size(&self) -> (u32, u32) {
        (self.placed.c_arm.columns, self.placed.c_arm.rows)
    }
}

pub(super) fn failed(path: &Path) -> impl Fn(String) -> Failure {
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
