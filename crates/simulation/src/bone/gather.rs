//! Finds the voxels that can be nearest to a sphere: those within reach with no whole voxel next to them on
//! the side of the centre. A partly cut voxel hides nothing, because its remaining bone may lie behind its
//! neighbour's surface.

use nalgebra::Vector3;

use super::grid::floor_to_i64;
use super::occupancy::{VoxelBox, WINDOW_VOXELS};
use super::voxels::Voxels;

/// Voxels of a row examined at once: one window, minus one voxel at each end for the neighbours along x.
const COLUMNS: i64 = WINDOW_VOXELS - 2;
/// Margin on the reach when selecting rows and columns, in voxels. It far exceeds coordinate rounding, so
/// that only the caller's distance decides which voxels count.
const ROUNDING_VOXELS: f64 = 1e-6;

/// Returns [`ROUNDING_VOXELS`] in metres.
pub(super) fn widening([hx, hy, hz]: [f64; 3]) -> f64 {
    ROUNDING_VOXELS * hx.max(hy).max(hz)
}

/// A sphere in the grid's metric frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sphere {
    /// Index of the sphere on the tool.
    pub index: usize,
    pub centre: Vector3<f64>,
    pub radius_m: f64,
    /// The voxel that contains the centre, possibly outside the grid.
    pub voxel: [i64; 3],
    /// Radius plus margin in metres.
    pub reach: f64,
}

/// The columns of voxels in a window. Bit 0 of the window is the voxel before the first requested one.
struct Columns {
    /// The requested voxels before the centre's column; their neighbour toward the centre is the next one.
    before: u64,
    /// The centre's own column.
    own: u64,
    /// The requested voxels after it.
    behind: u64,
}

impl Columns {
    fn new(start: i64, count: i64, centre: i64) -> Self {
        let wanted = ((1u64 << count) - 1) << 1;
        let column = centre - (start - 1);
        let below = |bit: i64| if bit <= 0 { 0 } else { u64::MAX >> (64 - bit.min(64)) };
        Self {
            before: wanted & below(column),
            own: wanted & below(column + 1) & !below(column),
            behind: wanted & !below(column + 1),
        }
    }

    /// Returns the requested voxels of bone with no whole voxel next to them on the side of the centre.
    #[inline]
    fn exposed(&self, row: u64, whole: u64) -> u64 {
        row & ((self.before & !(whole >> 1)) | self.own | (self.behind & !(whole << 1)))
    }
}

impl Voxels {
    /// Calls `visit` with every voxel whose box is within `sphere.reach` and that has no whole neighbour
    /// between itself and the centre; rounding may add a few slightly farther ones. Slices are outermost, x
    /// is fastest. Returns the voxels that the result depends on, or `None` if none is in the grid.
    #[inline]
    pub(super) fn gather(&self, sphere: &Sphere, mut visit: impl FnMut([i64; 3])) -> Option<VoxelBox> {
        let (occupancy, whole, geometry) = (self.occupancy(), self.whole(), self.geometry());
        let [hx, hy, hz] = geometry.spacing_m;
        let reach = sphere.reach + widening(geometry.spacing_m);
        let voxels = occupancy.voxels_around(sphere.centre.into(), reach, geometry.spacing_m)?;
        if !occupancy.any_in(&voxels) {
            return Some(voxels);
        }
        let [_, ny, nz] = geometry.dims;
        let (row_stride, slice_stride) = (occupancy.row_stride(), occupancy.slice_stride());
        let per_hy = 1.0 / hy;
        let reach2 = reach * reach;
        for start in (voxels.low[0]..=voxels.high[0]).step_by(COLUMNS as usize) {
            let count = (voxels.high[0] - start + 1).min(COLUMNS);
            let columns = Columns::new(start, count, sphere.voxel[0]);
            let place = occupancy.window_place(start - 1);
            for k in voxels.low[2]..=voxels.high[2] {
                let to_z = outside(sphere.centre.z - k as f64 * hz, hz);
                let room_z = reach2 - to_z * to_z;
                if room_z < 0.0 {
                    continue;
                }
                let half = room_z.sqrt();
                let low = floor_to_i64((sphere.centre.y - half) * per_hy + 0.5).max(voxels.low[1]);
                let high = floor_to_i64((sphere.centre.y + half) * per_hy + 0.5).min(voxels.high[1]);
                let (next_k, mask_z) = towards(k, sphere.voxel[2], nz);
                let (slice, next_slice) = (k as usize * slice_stride, next_k * slice_stride);
                for j in low..high + 1 {
                    let row = j as usize * row_stride;
                    let bone = occupancy.window_at(place, slice + row);
                    let exposed = columns.exposed(bone, whole.window_at(place, slice + row));
                    if exposed == 0 {
                        continue;
                    }
                    let (next_j, mask_y) = towards(j, sphere.voxel[1], ny);
                    let above = whole.window_at(place, next_slice + row);
                    let beside = whole.window_at(place, slice + next_j * row_stride);
                    let mut bits = exposed & !(above & mask_z) & !(beside & mask_y);
                    while bits != 0 {
                        let i = start - 1 + i64::from(bits.trailing_zeros());
                        bits &= bits - 1;
                        let to_x = outside(sphere.centre.x - i as f64 * hx, hx);
                        let to_y = outside(sphere.centre.y - j as f64 * hy, hy);
                        if to_x * to_x + to_y * to_y < room_z {
                            visit([i, j, k]);
                        }
                    }
                }
            }
        }
        Some(voxels)
    }
}

/// Returns the signed distance along one axis from a voxel's slab to a point at `offset` from the slab's
/// middle; 0 inside.
#[inline]
pub(super) fn outside(offset: f64, width: f64) -> f64 {
    let half = 0.5 * width;
    // Branch-free, because the side is unpredictable.
    let above = if offset > -half { offset } else { -half };
    offset - if above < half { above } else { half }
}

/// Returns the index next to `from`, which is in `0..count`, toward `to`, with an all-ones mask; or `from`
/// and 0 if there is none.
#[inline]
fn towards(from: i64, to: i64, count: usize) -> (usize, u64) {
    let next = (from + i64::from(to > from) - i64::from(to < from)).clamp(0, count as i64 - 1);
    (next as usize, if next == from { 0 } else { u64::MAX })
}
