//! From line integrals to pixels: tool, arm and objects, Beer-Lambert, noise, blur, readout and display,
//! in two passes over the image.
//!
//! Pass 1, row by row: tool, arm and objects over anatomy, transmission, noise, blur along the row.
//! Pass 2: blur along columns, readout, display. Disabled stages cost nothing; without blur the second pass
//! does everything. The loops ([`crate::lane_math`]) compile to the CPU's vector instructions, with the same
//! bits on every CPU.

use std::sync::Arc;

use pulp::Arch;
use rayon::prelude::*;
use scene::Display;
use smallvec::SmallVec;

use crate::carm::CArm;
use crate::detector::{DetectorParameters, EXACT_POISSON_BELOW, FrameSeed, gaussian_weights, photon_number};
use crate::display::{DisplayParameters, Scale, WindowLimits};
use crate::error::DrrError;
use crate::exposure_loops::{
    BlurColumns, BlurRow, Detect, ReadOut, ReadThrough, Tabulate, ToGreys, Transmit,
};
use crate::lane_math;
use crate::scatter::ScatterImage;
use crate::solids::{SolidRow, Solids};
use crate::spectrum::SpectrumTable;
use crate::tool_layer::{PlacedTool, ToolCell, ToolMaterials};
use counter_random::Key;

/// Pixels processed at once: a bit each in a `u64`. Several such buffers fit into the L1 cache.
pub(crate) const CHUNK: usize = 64;

/// Every how many pixels the window of a frame with scatter is sampled, along each axis.
const SCATTER_STRIDE: usize = 4;

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

    /// Checks the C-arm, and that the output has as many pixels as its detector.
    pub(crate) fn check(&self, c_arm: &CArm) -> Result<(), DrrError> {
        c_arm.validate()?;
        let (given, expected) = (self.len(), c_arm.pixels());
        if given == expected { Ok(()) } else { Err(DrrError::Length { field: "image", given, expected }) }
    }
}

/// The anatomy of a frame.
#[derive(Debug, Clone, Copy)]
pub struct Anatomy<'a> {
    /// Line integrals of attenuation, row-major; metres of tissue if a spectrum is used.
    pub total: &'a [f64],
    /// Metres of cortical bone, row-major, if a spectrum is used; otherwise empty.
    pub bone_m: &'a [f64],
    /// Scattered signal, if it is modelled.
    pub(crate) scatter: Option<&'a ScatterImage>,
}

/// The tool, the arm and the objects of a frame: everything but the anatomy.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Metal<'a> {
    pub(crate) tool: &'a PlacedTool,
    pub(crate) solids: &'a Solids,
}

/// Detector, display and their workspace.
#[derive(Debug)]
pub struct Exposure {
    detector: DetectorParameters,
    display: DisplayParameters,
    weights: Vec<f32>,
    spectrum: Option<Arc<SpectrumTable>>,
    arch: Arch,
    detected: Vec<f32>,
    blurred: Vec<f32>,
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

impl Frame<'_> {
    /// Scattered signal of a chunk of a row; 0 without scatter.
    fn scattered(&self, row: usize, from: usize, count: usize) -> [f64; CHUNK] {
        let mut values = [0.0; CHUNK];
        if let Some(scatter) = self.anatomy.scatter {
            scatter.read(row, from, &mut values[..count]);
        }
        values
    }
}

impl Exposure {
    /// Creates a stage with an empty workspace.
    pub fn new(
        detector: DetectorParameters,
        display: DisplayParameters,
        spectrum: Option<SpectrumTable>,
    ) -> Self {
        Self::of(detector, display, spectrum.map(Arc::new))
    }

    /// Returns the same stage with its own, empty workspace.
    pub(crate) fn anew(&self) -> Self {
        Self::of(self.detector, self.display, self.spectrum.clone())
    }

    fn of(
        detector: DetectorParameters,
        display: DisplayParameters,
        spectrum: Option<Arc<SpectrumTable>>,
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
        }
    }

    /// Allocates the workspace for this number of pixels and touches every page of it.
    pub(crate) fn prepare(&mut self, pixels: usize) {
        if self.weights.len() > 1 {
            self.detected.resize(pixels, 1.0);
            self.blurred.resize(pixels, 1.0);
        }
    }

    /// The spectrum's table, if one is used.
    pub fn spectrum(&self) -> Option<&SpectrumTable> {
        self.spectrum.as_deref()
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
        let passes = self.weights.len() > 1;
        if passes {
            self.first_pass(&frame);
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
                    this.arch.dispatch(ToGreys { scale: frame.scale, values: &values, out });
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
        let scale = Scale::new(Display::Linear, WindowLimits { low: 0.0, high: 1.0 });
        let anatomy = Anatomy { scatter: None, ..anatomy };
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

    /// Calls `f` with the attenuation of the anatomy alone. With scatter, it is -ln of the signal of every
    /// fourth pixel in both directions.
    pub(crate) fn with_anatomy<T>(
        &self,
        anatomy: Anatomy<'_>,
        width: usize,
        f: impl FnOnce(&[f64]) -> T,
    ) -> T {
        if let Some(scatter) = anatomy.scatter {
            let mut image = Vec::new();
            for (row, line) in anatomy.total.chunks(width).enumerate().step_by(SCATTER_STRIDE) {
                for (column, &total) in line.iter().enumerate().step_by(SCATTER_STRIDE) {
                    let bone = || anatomy.bone_m[row * width + column];
                    let value =
                        self.spectrum.as_ref().map_or(total, |table| table.attenuation(total, bone()));
                    image.push(-lane_math::log(lane_math::exp(-value) + scatter.at(row, column)));
                }
            }
            return f(&image);
        }
        match &self.spectrum {
            None => f(anatomy.total),
            Some(table) => {
                let pairs = anatomy.total.iter().zip(anatomy.bone_m);
                let image: Vec<f64> = pairs.map(|(&tissue, &bone)| table.attenuation(tissue, bone)).collect();
                f(&image)
            }
        }
    }

    /// Tool, transmission, noise and blur along rows, into `blurred`.
    fn first_pass(&mut self, frame: &Frame<'_>) {
        let (width, pixels) = (frame.width, frame.anatomy.total.len());
        self.detected.resize(pixels, 0.0);
        self.blurred.resize(pixels, 0.0);
        let mut detected = core::mem::take(&mut self.detected);
        let mut blurred = core::mem::take(&mut self.blurred);
        let this: &Self = self;
        let rows = detected.par_chunks_mut(width).zip(blurred.par_chunks_mut(width)).enumerate();
        rows.for_each(|(row, (line, out))| {
            for (i, some) in line.chunks_mut(CHUNK).enumerate() {
                this.expose_chunk(frame, row, i * CHUNK, some);
            }
            this.arch.dispatch(BlurRow { line, weights: &this.weights, out });
        });
        self.detected = detected;
        self.blurred = blurred;
    }

    /// Fraction of photons detected in a chunk of a row.
    fn expose_chunk(&self, frame: &Frame<'_>, row: usize, from: usize, out: &mut [f32]) {
        let mut values = [0.0; CHUNK];
        let first_pixel = (row * frame.width + from) as u64;
        self.attenuation(frame, row, from, out.len(), &mut values);
        let scattered = frame.scattered(row, from, out.len());
        let photons = self.detector.photons_per_pixel;
        if !self.detector.quantum_noise {
            self.arch.dispatch(Transmit { values: &values, scattered: &scattered, out });
            return;
        }
        let key = frame.key;
        let detect =
            Detect { photons, key, first_pixel, scattered: &scattered, values: &mut values, out: &mut *out };
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
            let solids: SmallVec<[SolidRow<'_>; 4]> = frame.metal.solids.rows(row, from, count).collect();
            let total = &frame.anatomy.total[start..];
            // A bit for each pixel of the chunk that the tool covers.
            let mut covered = 0_u64;
            frame.metal.tool.over_row(row, from, count, |i, cell, materials| {
                let Some(mut materials) = materials.copied() else { return };
                covered |= 1 << i;
                solids.iter().for_each(|solid| materials.lengths_m[solid.material] += solid.lengths_m[i]);
                values[i] = table.attenuation_with_tool(total[i], bone[i], cell, &materials);
            });
            let is_seen = |i: &usize| solids.iter().any(|solid| solid.lengths_m[*i] > 0.0);
            for i in (0..count).filter(|i| covered >> i & 1 == 0).filter(is_seen) {
                let mut materials = ToolMaterials::default();
                solids.iter().for_each(|solid| materials.lengths_m[solid.material] += solid.lengths_m[i]);
                values[i] = table.attenuation_with_tool(total[i], bone[i], &ToolCell::default(), &materials);
            }
        } else {
            frame.metal.tool.over_row(row, from, count, |i, cell, _| values[i] = cell.over(values[i]));
            for SolidRow { mu_per_m, lengths_m, .. } in frame.metal.solids.rows(row, from, count) {
                values.iter_mut().zip(lengths_m).for_each(|(value, length_m)| *value += length_m * mu_per_m);
            }
        }
    }

    /// Runs the second pass without blur. Without noise, the attenuation passes through unchanged unless the
    /// readout alters it.
    fn directly(&self, frame: &Frame<'_>, row: usize, from: usize, count: usize, values: &mut [f64; CHUNK]) {
        let (readout, mode) = (self.detector.readout(), self.display.mode);
        if self.detector.quantum_noise {
            let mut detected = [0.0; CHUNK];
            self.expose_chunk(frame, row, from, &mut detected[..count]);
            self.arch.dispatch(ReadOut { readout, mode, detected: &detected, values });
            return;
        }
        self.attenuation(frame, row, from, count, values);
        if mode == Display::Linear || !readout.is_plain() || frame.anatomy.scatter.is_some() {
            let scattered = &frame.scattered(row, from, count);
            self.arch.dispatch(ReadThrough { readout, mode, scattered, values });
        }
    }

    /// Applies the blur along columns and the readout.
    fn read_out(&self, row: usize, width: usize, from: usize, count: usize, values: &mut [f64; CHUNK]) {
        let mut detected = [0.0; CHUNK];
        let weights = &self.weights[..];
        let out = &mut detected[..count];
        self.arch.dispatch(BlurColumns { source: &self.blurred, weights, width, row, from, out });
        let (readout, mode) = (self.detector.readout(), self.display.mode);
        self.arch.dispatch(ReadOut { readout, mode, detected: &detected, values });
    }
}
