//! Options of the sum, and what it reports of itself.

use super::instructions::Instructions;
use super::plan::LEAST_OVERSAMPLING;
use crate::error::{DrrError, check_range};

/// Weight of the newest update in the running average of the cost.
const SMOOTHING: f64 = 0.25;

/// Options of the sum over slices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SliceOrderedOptions {
    /// Samples of the intermediate image for each voxel of the farthest slice, 0.8 to 4.
    pub oversampling: f64,
    /// Whether the image is sharpened against the blur of the interpolation.
    pub sharpen: bool,
    /// Voxels along each axis that are merged into one, 1 to 8. Above 1, values are stored in bytes.
    pub reduction: u32,
    /// Instructions to use.
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
    /// The first field that is out of range, by name.
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
    /// The cached sums were updated for the changed voxels, and this number of pixels was written.
    Changed(usize),
    /// Nothing had changed.
    Unchanged,
}

/// The intermediate image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sums<'a> {
    /// Its width.
    pub columns: usize,
    /// Its height.
    pub rows: usize,
    /// The sums, row by row.
    pub values: &'a [i64],
}

/// Bytes that a [`SliceOrdered`](super::SliceOrdered) holds, and what they are for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SliceOrderedMemory {
    /// Copy with rows along x; 0 if no frame has needed it.
    pub along_x: usize,
    /// Copy with rows along y; 0 if no frame has needed it.
    pub along_y: usize,
    /// Sums of the blocks of a preview.
    pub preview_sums: usize,
    /// Intermediate images, as integers and as floats: one, and another once a frame was rendered aside.
    pub image: usize,
}

impl SliceOrderedMemory {
    /// All of it.
    pub fn total(&self) -> usize {
        self.along_x + self.along_y + self.preview_sums + self.image
    }
}

/// Times measured while running. They decide how changes are worked in, never what comes out.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct UpdateCost {
    /// Nanoseconds of the last full sum over slices.
    pub full_ns: f64,
    /// Nanoseconds of working in one changed voxel, averaged over the last updates; 0 before the first.
    pub voxel_ns: f64,
}

impl UpdateCost {
    /// Whether working in this number of changed voxels is expected to take longer than summing all slices.
    pub(super) fn prefers_full(&self, voxels: usize) -> bool {
        voxels as f64 * self.voxel_ns > self.full_ns
    }

    /// Takes in the time of an update.
    pub(super) fn note_update(&mut self, elapsed_ns: u64, voxels: usize) {
        let each_ns = elapsed_ns as f64 / voxels as f64;
        let before = self.voxel_ns;
        self.voxel_ns = if before == 0.0 { each_ns } else { before + SMOOTHING * (each_ns - before) };
    }
}
