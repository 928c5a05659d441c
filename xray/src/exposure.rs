//! From line integrals to pixels: tool and arm, Beer-Lambert, noise, blur, readout and display, in two passes over the image.
//!
//! Pass 1, row by row: tool and arm over anatomy, transmission, noise, blur along the row. Pass 2: blur along columns, readout, display.
//! Disabled stages cost nothing; without noise and blur the second pass does everything. The loops ([`crate::lane_math`]) compile to the
//! CPU's vector instructions, with the same bits on every CPU.

use pulp::Arch;
use rayon::prelude::*;

use crate::attenuation::Material;
use crate::detector::{
    DetectorParameters, EXACT_POISSON_BELOW, FrameSeed, Readout, add_scaled_row, blur_row, gaussian_weights,
    photon_number,
};
use crate::display::{DisplayMode, DisplayParameters, Scale, WindowLimits};
use crate::lane_math;
use crate::lanes::lanes;
use crate::solids::SolidLayer;
use crate::spectrum::SpectrumTable;
use crate::tool_layer::{PlacedTool, ToolCell, ToolMaterials};
use counter_random::Key;

/// Pixels processed at once; several such buffers fit into the L1 cache.
const CHUNK: usize = 64;

/// Destination of the pixels.
#[derive(Debug)]
pub enum Output<'a> {
    /// Grey levels, 0 to 65535.
    Mono16(&'a mut [u16]),
    /// No window and no rounding: the readout in linear mode, its negative logarithm in the other modes.
    Float32(&'a mut [f32]),
}

impl Output<'_> {
    /// Number of pixels.
    pub fn len(&self) -> usize {
        match self {
            Self::Mono16(pixels) => pixels.len(),
            Self::Float32(pixels) => pixels.len(),
        }
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The anatomy of a frame.
#[derive(Debug, Clone, Copy)]
pub struct Anatomy<'a> {
    /// Line integrals of attenuation, row-major; metres of tissue if a spectrum is used.
    pub total: &'a [f64],
    /// Metres of cortical bone, row-major, if a spectrum is used; otherwise empty.
    pub bone_m: &'a [f64],
}

/// What a frame shows beside the anatomy.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Metal<'a> {
    pub(crate) tool: &'a PlacedTool,
    pub(crate) arm: &'a SolidLayer,
    /// Attenuation of aluminium at the frame's energy.
    pub(crate) aluminium_per_m: f64,
}

/// Detector, display and their workspace.
#[derive(Debug)]
pub struct Exposure {
    detector: DetectorParameters,
    display: DisplayParameters,
    weights: Vec<f32>,
    spectrum: Option<SpectrumTable>,
    arch: Arch,
    detected: Vec<f32>,
    blurred: Vec<f32>,
    metal: Vec<f32>,
    metal_blurred: Vec<f32>,
}

/// The passes' inputs other than the workspace.
#[derive(Clone, Copy)]
struct Frame<'a> {
    anatomy: Anatomy<'a>,
    metal: Metal<'a>,
    width: usize,
    scale: Scale,
    key: Key,
}

impl Exposure {
    /// A stage with an empty workspace.
    pub fn new(
        detector: DetectorParameters,
        display: DisplayParameters,
        spectrum: Option<SpectrumTable>,
    ) -> Self {
        let weights = gaussian_weights(detector.blur_sigma_px).into_iter().map(|w| w as f32).collect();
        Self {
            detector,
            display,
            weights,
            spectrum,
            arch: Arch::new(),
            detected: Vec::new(),
            blurred: Vec::new(),
            metal: Vec::new(),
            metal_blurred: Vec::new(),
        }
    }

    /// The spectrum's table, if one is used.
    pub fn spectrum(&self) -> Option<&SpectrumTable> {
        self.spectrum.as_ref()
    }

    /// Fills the output on the threads of the current pool.
    pub(crate) fn expose(
        &mut self,
        anatomy: Anatomy<'_>,
        metal: Metal<'_>,
        width: usize,
        window: WindowLimits,
        seed: FrameSeed,
        output: &mut Output<'_>,
    ) {
        let scale = Scale::new(self.display.mode, window);
        let frame = Frame { anatomy, metal, width, scale, key: seed.key() };
        let passes = self.detector.quantum_noise || self.weights.len() > 1;
        if passes {
            self.first_pass(&frame);
        }
        let overlay = self.display.mode == DisplayMode::BoneBrightToolBlack && metal.tool.covers_any();
        if overlay {
            self.metal_pass(&frame);
        }
        let this: &Self = self;
        let second = |row: usize, attenuation: &mut [f64; CHUNK], from: usize, count: usize| {
            if passes {
                this.read_out(row, width, from, count, attenuation);
            } else {
                this.directly(&frame, row, from, count, attenuation);
            }
        };
        match output {
            Output::Mono16(pixels) => pixels.par_chunks_mut(width).enumerate().for_each(|(row, line)| {
                for (i, out) in line.chunks_mut(CHUNK).enumerate() {
                    let mut values = [0.0; CHUNK];
                    second(row, &mut values, i * CHUNK, out.len());
                    if overlay {
                        this.overlay(&frame, row, i * CHUNK, &values, out);
                    } else {
                        this.arch.dispatch(ToGreys { scale: frame.scale, values: &values, out });
                    }
                }
            }),
            Output::Float32(pixels) => pixels.par_chunks_mut(width).enumerate().for_each(|(row, line)| {
                for (i, out) in line.chunks_mut(CHUNK).enumerate() {
                    let mut values = [0.0; CHUNK];
                    second(row, &mut values, i * CHUNK, out.len());
                    out.iter_mut().zip(&values).for_each(|(o, v)| *o = *v as f32);
                }
            }),
        }
    }

    /// -ln of the transmission through anatomy, tool and arm, row-major.
    pub(crate) fn attenuations(&self, anatomy: Anatomy<'_>, metal: Metal<'_>, width: usize) -> Vec<f64> {
        let scale = Scale::new(DisplayMode::Linear, WindowLimits { low: 0.0, high: 1.0 });
        let frame = Frame { anatomy, metal, width, scale, key: FrameSeed::default().key() };
        let mut image = vec![0.0; anatomy.total.len()];
        for (row, line) in image.chunks_mut(width).enumerate() {
            for (i, out) in line.chunks_mut(CHUNK).enumerate() {
                let mut values = [0.0; CHUNK];
                self.attenuation(&frame, row, i * CHUNK, out.len(), &mut values);
                out.copy_from_slice(&values[..out.len()]);
            }
        }
        image
    }

    /// Calls `f` with the attenuation of the anatomy alone.
    pub(crate) fn with_anatomy<T>(&self, anatomy: Anatomy<'_>, f: impl FnOnce(&[f64]) -> T) -> T {
        match &self.spectrum {
            None => f(anatomy.total),
            Some(table) => {
                let pairs = anatomy.total.iter().zip(anatomy.bone_m);
                let image: Vec<f64> = pairs.map(|(&tissue, &bone)| table.attenuation(tissue, bone)).collect();
                f(&image)
            }
        }
    }

    /// Tool, transmission, noise and blur along rows, into `blurred` (into `detected` without blur).
    fn first_pass(&mut self, frame: &Frame<'_>) {
        let (width, pixels) = (frame.width, frame.anatomy.total.len());
        let with_blur = self.weights.len() > 1;
        self.detected.resize(pixels, 0.0);
        self.blurred.resize(if with_blur { pixels } else { 0 }, 0.0);
        let mut detected = core::mem::take(&mut self.detected);
        let mut blurred = core::mem::take(&mut self.blurred);
        let this: &Self = self;
        let expose_row = |row: usize, line: &mut [f32]| {
            for (i, out) in line.chunks_mut(CHUNK).enumerate() {
                this.expose_chunk(frame, row, i * CHUNK, out);
            }
        };
        let rows = detected.par_chunks_mut(width).enumerate();
        if with_blur {
            rows.zip(blurred.par_chunks_mut(width)).for_each(|((row, line), out)| {
                expose_row(row, line);
                this.arch.dispatch(BlurRow { line, weights: &this.weights, out });
            });
        } else {
            rows.for_each(|(row, line)| expose_row(row, line));
        }
        self.detected = detected;
        self.blurred = blurred;
    }

    /// Fraction of photons detected in a chunk of a row.
    fn expose_chunk(&self, frame: &Frame<'_>, row: usize, from: usize, out: &mut [f32]) {
        let mut values = [0.0; CHUNK];
        let first_pixel = (row * frame.width + from) as u64;
        self.attenuation(frame, row, from, out.len(), &mut values);
        let photons = self.detector.photons_per_pixel;
        if !self.detector.quantum_noise {
            self.arch.dispatch(Transmit { values: &values, out });
            return;
        }
        let detect = Detect { photons, key: frame.key, first_pixel, values: &mut values, out: &mut *out };
        let least = self.arch.dispatch(detect);
        if least < EXACT_POISSON_BELOW {
            for ((o, &mean), i) in out.iter_mut().zip(&values).zip(0_u64..) {
                if mean < EXACT_POISSON_BELOW {
                    *o = (photon_number(mean, frame.key.word(first_pixel + i)) / photons) as f32;
                }
            }
        }
    }

    /// -ln of the transmission through anatomy, tool and arm.
    fn attenuation(
        &self,
        frame: &Frame<'_>,
        row: usize,
        from: usize,
        count: usize,
        values: &mut [f64; CHUNK],
    ) {
        let start = row * frame.width + from;
        values[..count].copy_from_slice(&frame.anatomy.total[start..start + count]);
        if let Some(table) = &self.spectrum {
            let bone = &frame.anatomy.bone_m[start..start + count];
            self.arch.dispatch(Tabulate { table, tissue_m: &mut values[..count], bone_m: bone });
            let mut arm_m = [0.0; CHUNK];
            if let Some(lengths_m) = frame.metal.arm.row(row, from, count) {
                arm_m[..count].copy_from_slice(lengths_m);
            }
            let (total, aluminium) = (&frame.anatomy.total[start..], Material::Aluminium.index());
            frame.metal.tool.over_row(row, from, count, |i, cell, materials| {
                let Some(mut materials) = materials.copied() else { return };
                materials.lengths_m[aluminium] += core::mem::take(&mut arm_m[i]);
                values[i] = table.attenuation_with_tool(total[i], bone[i], cell, &materials);
            });
            // Beside the tool.
            for i in (0..count).filter(|i| arm_m[*i] > 0.0) {
                let mut materials = ToolMaterials::default();
                materials.lengths_m[aluminium] = arm_m[i];
                values[i] = table.attenuation_with_tool(total[i], bone[i], &ToolCell::default(), &materials);
            }
        } else {
            frame.metal.tool.over_row(row, from, count, |i, cell, _| values[i] = cell.over(values[i]));
            if let Some(lengths_m) = frame.metal.arm.row(row, from, count) {
                let arm = lengths_m.iter().map(|length_m| length_m * frame.metal.aluminium_per_m);
                values.iter_mut().zip(arm).for_each(|(value, arm)| *value += arm);
            }
        }
    }

    /// The second pass without noise and blur: passes the attenuation on, unless the readout changes it.
    fn directly(&self, frame: &Frame<'_>, row: usize, from: usize, count: usize, values: &mut [f64; CHUNK]) {
        self.attenuation(frame, row, from, count, values);
        let (readout, mode) = (self.detector.readout(), self.display.mode);
        if mode == DisplayMode::Linear || !readout.is_plain() {
            self.arch.dispatch(ReadThrough { readout, mode, values });
        }
    }

    /// The blur along columns, and the readout.
    fn read_out(&self, row: usize, width: usize, from: usize, count: usize, values: &mut [f64; CHUNK]) {
        let (readout, mode) = (self.detector.readout(), self.display.mode);
        let source = if self.weights.len() > 1 { &self.blurred } else { &self.detected };
        let weights = &self.weights[..];
        self.arch.dispatch(ReadBlurred { readout, mode, source, weights, width, row, from, count, values });
    }

    /// Blurred transmission of the metal alone.
    fn metal_pass(&mut self, frame: &Frame<'_>) {
        let (width, pixels) = (frame.width, frame.anatomy.total.len());
        self.metal.resize(pixels, 1.0);
        self.metal_blurred.resize(pixels, 1.0);
        let (weights, tool) = (&self.weights, frame.metal.tool);
        let rows = self.metal.par_chunks_mut(width).zip(self.metal_blurred.par_chunks_mut(width));
        rows.enumerate().for_each(|(row, (line, out))| {
            line.fill(1.0);
            tool.over_row(row, 0, width, |i, cell, _| line[i] = lane_math::exp(-cell.metal) as f32);
            blur_row(line, weights, out);
        });
    }

    /// Overlays the tool on the anatomy's image in black.
    fn overlay(&self, frame: &Frame<'_>, row: usize, from: usize, values: &[f64; CHUNK], out: &mut [u16]) {
        let mut metal = [0.0_f32; CHUNK];
        column_blur(&self.metal_blurred, frame.width, row, from, &self.weights, &mut metal[..out.len()]);
        for ((o, &v), &m) in out.iter_mut().zip(values).zip(&metal) {
            *o = frame.scale.under_metal(v, f64::from(m));
        }
    }
}

lanes! {
    /// Grey levels of a chunk of a row.
    ToGreys { scale: Scale, values: &'a [f64; CHUNK], out: &'a mut [u16] } -> () {
        scale.to_greys(values, out);
    }
}

lanes! {
    /// Blurs a row along itself.
    BlurRow { line: &'a [f32], weights: &'a [f32], out: &'a mut [f32] } -> () {
        blur_row(line, weights, out);
    }
}

lanes! {
    /// Fraction of photons transmitted.
    Transmit { values: &'a [f64; CHUNK], out: &'a mut [f32] } -> () {
        for (o, v) in out.iter_mut().zip(values) {
            *o = lane_math::exp(-v) as f32;
        }
    }
}

lanes! {
    /// Fraction of photons detected, with noise; `values` become mean photon counts. Returns the smallest of them.
    Detect {
        photons: f64,
        key: Key,
        first_pixel: u64,
        values: &'a mut [f64; CHUNK],
        out: &'a mut [f32],
    } -> f64 {
        for v in values.iter_mut() {
            *v = photons * lane_math::exp(-*v);
        }
        for (i, (o, mean)) in out.iter_mut().zip(values.iter()).enumerate() {
            let normal = lane_math::normal(key.word(first_pixel + i as u64));
            *o = (lane_math::round(mean + mean.sqrt() * normal).max(0.0) / photons) as f32;
        }
        let mut least = [f64::INFINITY; 8];
        for some in values.chunks_exact(8) {
            for (l, v) in least.iter_mut().zip(some) {
                *l = l.min(*v);
            }
        }
        least.into_iter().fold(f64::INFINITY, f64::min)
    }
}

lanes! {
    /// The attenuation of tissue and bone.
    Tabulate { table: &'a SpectrumTable, tissue_m: &'a mut [f64], bone_m: &'a [f64] } -> () {
        table.attenuation_of_row(tissue_m, bone_m);
    }
}

lanes! {
    /// The readout of attenuations without noise and blur.
    ReadThrough { readout: Readout, mode: DisplayMode, values: &'a mut [f64; CHUNK] } -> () {
        for v in values.iter_mut() {
            *v = readout.apply(lane_math::exp(-*v));
        }
        if mode != DisplayMode::Linear {
            to_attenuation(values);
        }
    }
}

lanes! {
    /// The blur along columns, and the readout.
    ReadBlurred {
        readout: Readout,
        mode: DisplayMode,
        source: &'a [f32],
        weights: &'a [f32],
        width: usize,
        row: usize,
        from: usize,
        count: usize,
        values: &'a mut [f64; CHUNK],
    } -> () {
        let mut sums = [0.0_f32; CHUNK];
        column_blur(source, width, row, from, weights, &mut sums[..count]);
        for (v, s) in values.iter_mut().zip(&sums) {
            *v = readout.apply(f64::from(*s));
        }
        if mode != DisplayMode::Linear {
            to_attenuation(values);
        }
    }
}

/// Blurs the pixels `from..` of a row along the columns, with edge rows repeated outside the image.
#[inline(always)]
fn column_blur(image: &[f32], width: usize, row: usize, from: usize, weights: &[f32], out: &mut [f32]) {
    let (reach, last) = (weights.len() / 2, image.len() / width - 1);
    for (i, w) in weights.iter().enumerate() {
        let start = (row + i).saturating_sub(reach).min(last) * width + from;
        add_scaled_row(out, *w, &image[start..]);
    }
}

/// -ln of the readout. The readout is clamped to half a photon in 1e6, so that no signal is black rather than infinite.
#[inline(always)]
fn to_attenuation(values: &mut [f64; CHUNK]) {
    for v in values.iter_mut() {
        *v = -lane_math::log(v.max(5e-7));
    }
}
