//! Options of the sum, and its reports.

use super::instructions::Instructions;
use super::plan::LEAST_OVERSAMPLING;
use crate::error::{DrrError, check_range};

/// Weight of the latest update in the running average of the cost.
const SMOOTHING: f64 = 0.25;

/// Options of the sum over slices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SliceOrderedOptions {
    /// Samples of the intermediate image per voxel of the farthest slice, 0.8 to 4.
    pub oversampling: f64,
    /// Sharpens the image to compensate for the blur of interpolation.
    pub sharpen: bool,
    /// Voxels per axis averaged into one, 1 to 8. Above 1, values are stored as bytes.
    pub reduction: u32,
    /// Instruction set to use.
    pub instructions: Instructions,
}

impl Default for SliceOrderedOptions {
    fn default() -> Self {
        Self { oversampling: 1.0, sharpen: true, reduction: 1, instructions: Instructions::best() }
    }
}

impl SliceOrderedOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// A field is out of range; the error names the first one.
    pub fn validate(&self) -> Result<(), DrrError> {
        check_range("oversampling", self.oversampling, LEAST_OVERSAMPLING, 4.0, "0.8 to 4")?;
        check_range("reduction", f64::from(self.reduction), 1.0, 8.0, "1 to 8")
    }

    /// Strength of the sharpening.
    pub(super) fn alpha(&self) -> f64 {
        if self.sharpen { self.oversampling * self.oversampling / 12.0 } else { 0.0 }
    }
}

/// How a frame was computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Update {
    /// All slices were summed.
    Full,
    /// The cached sums were updated for the changed voxels; this many pixels were written.
    Changed(usize),
    /// Nothing had changed.
    Unchanged,
}

/// The intermediate images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sums<'a> {
    /// Number of images: one, or several if one does not suit all rays.
    pub images: usize,
    /// The sums of all images, one after the other, row-major.
    pub values: &'a [i64],
}

/// Bytes that a [`SliceOrdered`](super::SliceOrdered) holds, by purpose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SliceOrderedMemory {
    /// Copies for slices across x, y and z; 0 if no frame has needed it.
    pub copies: [usize; 3],
    /// Sums of the blocks of a preview.
    pub preview_sums: usize,
    /// Intermediate images, as integers and as floats: one, plus another after the first one-off frame.
    pub image: usize,
}

impl SliceOrderedMemory {
    /// Total.
    pub fn total(&self) -> usize {
        self.copies.iter().sum::<usize>() + self.preview_sums + self.image
    }
}

/// Fractions of the cells of 32 voxels along a row, of a copy.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CellShares {
    /// Cells in which something attenuates. No other is ever read.
    pub occupied: f64,
    /// Cells whose voxels differ. The others are read only next to such a cell, or where a neighbour has a
    /// different value.
    pub mixed: f64,
}

/// Times measured at run time. They decide how changes are applied, never the result.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct UpdateCost {
    /// Duration of the last full sum over slices, ns.
    pub full_ns: f64,
    /// Time to apply one changed voxel, averaged over the last updates, ns; 0 before the first.
    pub voxel_ns: f64,
}

impl UpdateCost {
    /// True if applying this number of changed voxels is expected to take longer than summing all slices.
    pub(super) fn prefers_full(&self, voxels: usize) -> bool {
        voxels as f64 * self.voxel_ns > self.full_ns
    }

    /// Records the duration of an update.
    pub(super) fn note_update(&mut self, elapsed_ns: u64, voxels: usize) {
        let each_ns = elapsed_ns as f64 / voxels as f64;
        let before = self.voxel_ns;
        self.voxel_ns = if before == 0.0 { each_ns } else { before + SMOOTHING * (each_ns - before) };
    }
}
