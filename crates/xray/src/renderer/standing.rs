//! The cached anatomy of one C-arm, and the pixels that removed voxels affect.

use super::Projector;
use crate::carm::{CArm, Pinhole};
use crate::display::WindowLimits;
use crate::exposure::Anatomy;
use crate::grid::Grid;
use crate::ray::RayFan;
use crate::scatter::ScatterImage;
use crate::vector::scale;

/// Maximum distance from a voxel's centre at which it still affects a ray, in voxels, with a margin for
/// rounding.
const REACH_JOSEPH: f64 = 1.0 + 1e-3;
const REACH_SIDDON: f64 = 0.5 + 1e-3;

/// The cached anatomy of one C-arm.
pub(super) struct CachedView {
    pub c_arm: CArm,
    pub fan: RayFan,
    /// True if rays are traced individually; only then is `dirty` used.
    pub traced: bool,
    /// Line integrals of the anatomy (with a spectrum, metres of tissue), row-major.
    pub anatomy: Vec<f64>,
    /// Metres of cortical bone, with a spectrum.
    pub bone_m: Vec<f64>,
    /// Scatter of this anatomy, if it is modelled.
    pub scatter: Option<ScatterImage>,
    /// True for pixels in `dirty_list`.
    pub dirty: Vec<bool>,
    pub dirty_list: Vec<u32>,
    pub window: WindowLimits,
}

impl CachedView {
    pub fn images(&self) -> Anatomy<'_> {
        Anatomy { total: &self.anatomy, bone_m: &self.bone_m, scatter: self.scatter.as_ref() }
    }

    pub fn new(grid: &Grid, c_arm: &CArm) -> Self {
        let pixels = c_arm.pixels();
        Self {
            c_arm: *c_arm,
            fan: RayFan::new(grid, c_arm),
            traced: true,
            anatomy: Vec::new(),
            bone_m: Vec::new(),
            scatter: None,
            dirty: vec![false; pixels],
            dirty_list: Vec::new(),
            window: WindowLimits { low: 0.0, high: 1.0 },
        }
    }

    /// Reuses the memory for another C-arm.
    pub fn of_another(mut self, grid: &Grid, c_arm: &CArm) -> Self {
        self.anatomy.clear();
        self.bone_m.clear();
        self.dirty.clear();
        self.dirty_list.clear();
        self.dirty.resize(c_arm.pixels(), false);
        Self { c_arm: *c_arm, fan: RayFan::new(grid, c_arm), traced: true, scatter: None, ..self }
    }

    /// Creates an empty cache whose memory has already been touched.
    pub fn written_to(grid: &Grid, c_arm: &CArm, with_bone: bool) -> Self {
        let mut standing = Self::new(grid, c_arm);
        let pixels = c_arm.pixels();
        standing.dirty.fill(true);
        standing.dirty.fill(false);
        standing.anatomy.resize(pixels, 1.0);
        standing.bone_m.resize(if with_bone { pixels } else { 0 }, 1.0);
        standing.anatomy.clear();
        standing.bone_m.clear();
        standing
    }
}

/// Marks the pixels that removed voxels affect.
pub(super) struct DirtyMarker<'a> {
    dirty: &'a mut [bool],
    list: &'a mut Vec<u32>,
    pinhole: Pinhole,
    columns: u32,
    rows: u32,
    half_m: [[f64; 3]; 3],
}

impl<'a> DirtyMarker<'a> {
    pub fn new(standing: &'a mut CachedView, grid: &Grid, projector: Projector) -> Self {
        Self::of(&mut standing.dirty, &mut standing.dirty_list, &standing.c_arm, grid, projector)
    }

    /// Marks in `dirty` and `list`, which belong to the image of this C-arm.
    pub fn of(
        dirty: &'a mut [bool],
        list: &'a mut Vec<u32>,
        c_arm: &CArm,
        grid: &Grid,
        projector: Projector,
    ) -> Self {
        let reach = match projector {
            Projector::Siddon => REACH_SIDDON,
            _ => REACH_JOSEPH,
        };
        Self {
            dirty,
            list,
            pinhole: c_arm.pinhole(),
            columns: c_arm.columns,
            rows: c_arm.rows,
            half_m: grid.axis_steps_m().map(|s| scale(s, reach)),
        }
    }

    pub fn mark(&mut self, centre_m: [f64; 3]) {
        let Some(bounds) = self.pinhole.bounds(centre_m, &self.half_m, self.columns, self.rows) else {
            return;
        };
        for row in bounds.rows.0..bounds.rows.1 {
            for pixel in row * self.columns + bounds.columns.0..row * self.columns + bounds.columns.1 {
                let flag = &mut self.dirty[pixel as usize];
                if !*flag {
                    *flag = true;
                    self.list.push(pixel);
                }
            }
        }
    }
}
