//! Writes frames as PNG (16 bits, or animated) and NRRD.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use output_file::OutputFile;
use xray::WindowLimits;
use zerocopy::IntoBytes;

use super::poses::ResolvedPose;
use super::series::RenderStyle;
use crate::failure::Failure;

/// Display time of each frame of an animation, in milliseconds.
const FRAME_MS: u16 = 66;

/// A rendered frame.
#[derive(Debug, Clone)]
pub struct Picture {
    pub placed: ResolvedPose,
    pub look: RenderStyle,
    /// Attenuations (-ln of the fraction of photons) at the ends of the grey scale; unused if linear.
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

pub(super) fn failed<C: std::fmt::Display>(path: &Path) -> impl FnOnce(C) -> Failure {
    move |cause| Failure::failed(format!("{}: cannot be written ({cause})", path.display()))
}

/// Writes one 16-bit PNG.
pub fn write_png(path: &Path, picture: &Picture) -> Result<(), Failure> {
    let mut animation = Animation::create(path, picture.size(), 1)?;
    animation.add(0, picture)?;
    animation.finish()
}

/// Writer of a 16-bit PNG, animated if it has several frames. Buffers a frame only until its predecessors
/// arrive.
pub struct Animation {
    path: PathBuf,
    file: OutputFile,
    writer: png::Writer<BufWriter<File>>,
    next: usize,
    early: BTreeMap<usize, Vec<u8>>,
}

impl Animation {
    /// Starts the file; all frames have these columns and rows.
    pub fn create(path: &Path, (columns, rows): (u32, u32), frames: usize) -> Result<Animation, Failure> {
        let file = OutputFile::create(path)?;
        let mut encoder = png::Encoder::new(BufWriter::new(file.handle()?), columns, rows);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Sixteen);
        if frames > 1 {
            encoder.set_animated(frames as u32, 0).map_err(failed(path))?;
            encoder.set_frame_delay(FRAME_MS, 1000).map_err(failed(path))?;
        }
        let writer = encoder.write_header().map_err(failed(path))?;
        Ok(Animation { path: path.to_owned(), file, writer, next: 0, early: BTreeMap::new() })
    }

    /// Adds a frame, in any order.
    pub fn add(&mut self, number: usize, picture: &Picture) -> Result<(), Failure> {
        self.early.insert(number, picture.greys.iter().flat_map(|v| v.to_be_bytes()).collect());
        while let Some(bytes) = self.early.remove(&self.next) {
            self.writer.write_image_data(&bytes).map_err(failed(&self.path))?;
            self.next += 1;
        }
        Ok(())
    }

    /// Finishes the file under its final name.
    pub fn finish(self) -> Result<(), Failure> {
        self.writer.finish().map_err(failed(&self.path))?;
        Ok(self.file.keep()?)
    }
}

/// Writes a 32-bit NRRD of one frame: -ln of the readout, or the readout in linear mode; pixels in
/// millimetres in the world frame.
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
