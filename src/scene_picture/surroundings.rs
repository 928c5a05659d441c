//! The outside of the bone in a volume, and distances to it.

use nalgebra::Vector3;
use voxel_grid::Volume;

use super::metres;
use super::scale::Scale;

/// Maximum number of cells of the map; a larger volume is mapped with every second or third voxel.
const MOST_CELLS: usize = 16 << 20;

/// The outside of the bone: cells below the threshold that are connected to the volume's border by such
/// cells. Marrow and pores of cancellous bone, enclosed by the cortex, are inside.
pub struct Surroundings<'a> {
    volume: &'a Volume,
    /// Voxels per cell and axis.
    stride: usize,
    cells: [usize; 3],
    is_outside: Vec<bool>,
}

impl<'a> Surroundings<'a> {
    /// Maps a volume.
    pub fn of(volume: &'a Volume, threshold_hu: i16) -> Surroundings<'a> {
        let cells_at = |stride: usize| volume.grid.dims().map(|count| count.div_ceil(stride));
        let fits = |stride: &usize| cells_at(*stride).iter().product::<usize>() <= MOST_CELLS;
        let stride = (1..).find(fits).unwrap_or(1);
        let cells = cells_at(stride);
        let mut map = Surroundings { volume, stride, cells, is_outside: Vec::new() };
        map.is_outside = vec![false; cells.iter().product()];
        map.flood(threshold_hu);
        map
    }

    fn index(&self, [i, j, k]: [usize; 3]) -> usize {
        i + self.cells[0] * (j + self.cells[1] * k)
    }

    fn is_open(&self, cell: [usize; 3], threshold_hu: i16) -> bool {
        self.volume.at(cell.map(|index| index * self.stride)).is_some_and(|hu| hu < threshold_hu)
    }

    fn flood(&mut self, threshold_hu: i16) {
        let [ni, nj, nk] = self.cells;
        let mut waiting = Vec::new();
        let faces = |at: [usize; 3]| (0..3).any(|axis| at[axis] == 0 || at[axis] + 1 == [ni, nj, nk][axis]);
        for k in 0..nk {
            for j in 0..nj {
                // Inner rows have only two cells at the border.
                let step = if k == 0 || k + 1 == nk || j == 0 || j + 1 == nj { 1 } else { (ni - 1).max(1) };
                for i in (0..ni).step_by(step).filter(|i| faces([*i, j, k])) {
                    self.enter([i, j, k], threshold_hu, &mut waiting);
                }
            }
        }
        while let Some(at) = waiting.pop() {
            for axis in 0..3 {
                let mut beside = at;
                if at[axis] > 0 {
                    beside[axis] = at[axis] - 1;
                    self.enter(beside, threshold_hu, &mut waiting);
                }
                if at[axis] + 1 < self.cells[axis] {
                    beside[axis] = at[axis] + 1;
                    self.enter(beside, threshold_hu, &mut waiting);
                }
            }
        }
    }

    fn enter(&mut self, cell: [usize; 3], threshold_hu: i16, waiting: &mut Vec<[usize; 3]>) {
        let index = self.index(cell);
        if !self.is_outside[index] && self.is_open(cell, threshold_hu) {
            self.is_outside[index] = true;
            waiting.push(cell);
        }
    }

    /// Returns whether the nearest cell of a point is outside the bone; true outside the volume.
    pub fn is_outside(&self, point_mm: &Vector3<f64>) -> bool {
        let voxel = self.volume.grid.voxel_at(metres((*point_mm).into()));
        let cell = [0, 1, 2].map(|axis| (voxel[axis] / self.stride as f64).round());
        if (0..3).any(|axis| cell[axis] < 0.0 || cell[axis] >= self.cells[axis] as f64) {
            return true;
        }
        self.is_outside[self.index(cell.map(|index| index as usize))]
    }

    /// Returns the distance of a point to the outside of the bone, mm, accurate to a voxel; 0 outside.
    pub fn depth_mm(&self, point_mm: &Vector3<f64>) -> f64 {
        if self.is_outside(point_mm) {
            return 0.0;
        }
        let voxel = self.volume.grid.voxel_at(metres((*point_mm).into()));
        let place = voxel.map(|index| index / self.stride as f64);
        let size_mm = self.volume.grid.spacing_m().map(|spacing_m| 1e3 * spacing_m * self.stride as f64);
        let least_mm = size_mm.iter().copied().fold(f64::INFINITY, f64::min);
        let mut half = 4;
        loop {
            let (found, is_all) = self.nearest_mm(place, size_mm, half);
            // Anything beyond the searched box is at least this far away.
            if found <= half as f64 * least_mm || is_all {
                return found;
            }
            half *= 2;
        }
    }

    /// Returns the distance to the nearest outside cell in a box of `half` cells to each side, and whether
    /// the box covers the whole map.
    fn nearest_mm(&self, place: [f64; 3], size_mm: [f64; 3], half: usize) -> (f64, bool) {
        let middle =
            [0, 1, 2].map(|axis| place[axis].round().clamp(0.0, (self.cells[axis] - 1) as f64) as usize);
        let low = middle.map(|index| index.saturating_sub(half));
        let high = [0, 1, 2].map(|axis| (middle[axis] + half).min(self.cells[axis] - 1));
        let mut best = f64::INFINITY;
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                for i in low[0]..=high[0] {
                    if self.is_outside[self.index([i, j, k])] {
                        let off = |axis: usize, index: usize| (index as f64 - place[axis]) * size_mm[axis];
                        let (x, y, z) = (off(0, i), off(1, j), off(2, k));
                        best = best.min(x * x + y * y + z * z);
                    }
                }
            }
        }
        let is_all = low == [0; 3] && (0..3).all(|axis| high[axis] + 1 == self.cells[axis]);
        (best.sqrt(), is_all)
    }

    /// Returns how far bone extends from a point in a direction, mm.
    pub fn ahead_mm(&self, from_mm: &Vector3<f64>, direction: &Vector3<f64>) -> f64 {
        let step_mm = Scale::of(&self.volume.grid).step_mm;
        let places = (0..).map(|step| f64::from(step) * step_mm);
        let mut places = places.skip_while(|far_mm| !self.is_outside(&(from_mm + direction * *far_mm)));
        places.next().unwrap_or(0.0)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use voxel_grid::VoxelGrid;

    /// A cube with this many voxels of 0.5 mm per side, with Hounsfield units by distance from its centre,
    /// mm.
    pub fn ball(count: usize, hu_at: impl Fn(f64) -> i16) -> Volume {
        let half_mm = 0.25 * (count - 1) as f64;
        let far = |index: usize| 0.5 * index as f64 - half_mm;
        let voxel = |index: usize| [index % count, index / count % count, index / count / count].map(far);
        let radius_mm = |index: usize| Vector3::from(voxel(index)).norm();
        let grid = VoxelGrid::axis_aligned([count; 3], [0.5e-3; 3], [-1e-3 * half_mm; 3]).unwrap();
        Volume { grid, hu: (0..count * count * count).map(|index| hu_at(radius_mm(index))).collect() }
    }

    /// A ball of bone of 10 mm with 4 mm of marrow inside.
    #[test]
    fn marrow_is_inside_and_distances_are_those_of_the_ball_to_a_voxel() {
        let volume = ball(61, |radius_mm| match radius_mm {
            ..=4.0 => -50,
            ..=10.0 => 900,
            _ => -1000,
        });
        let map = Surroundings::of(&volume, 150);
        assert!(!map.is_outside(&Vector3::zeros()) && map.is_outside(&Vector3::new(12.0, 0.0, 0.0)));
        for (point, depth_mm) in
            [([0.0; 3], 10.0), ([6.0, 0.0, 0.0], 4.0), ([3.0, 4.0, 0.0], 5.0), ([0.0, 0.0, 12.0], 0.0)]
        {
            let found = map.depth_mm(&Vector3::from(point));
            assert!((found - depth_mm).abs() <= 0.5, "{point:?}: {found}, expected {depth_mm}");
        }
        let ahead = map.ahead_mm(&Vector3::new(2.0, 0.0, 0.0), &Vector3::x());
        assert!((ahead - 8.0).abs() <= 0.5, "{ahead}");
    }
}
