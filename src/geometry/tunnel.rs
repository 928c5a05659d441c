//! The tunnel: the surface around the removed voxels.

use std::collections::HashMap;

use markups::vector::{cross, dot};
use viewer_proc::surface::{Blocks, Field};
use voxel_grid::VoxelGrid;

use super::mesh::Mesh;

/// Mesher value of a removed voxel; the mesher's inside is above its threshold of 0.
const GONE: i16 = 1000;

/// Builds the closed surface around these voxels, half-way to their neighbours, with the viewer's surface
/// nets (`viewer_proc::surface`).
pub fn surface(grid: &VoxelGrid, gone: &[u32]) -> Mesh {
    let mut inside = vec![-GONE; grid.voxel_count()];
    for index in gone {
        if let Some(value) = inside.get_mut(*index as usize) {
            *value = GONE;
        }
    }
    let field = Field::new(*grid, 0);
    let mut blocks = Blocks::new(grid);
    let mut mesh = Mesh::default();
    // Blocks repeat their shared vertices with the same quantization.
    let mut numbers: HashMap<[i64; 3], u32> = HashMap::new();
    for block in blocks.mesh_changed(&field, &inside, usize::MAX) {
        let mut number = |corner: u32| {
            *numbers.entry(block.steps(corner)).or_insert_with(|| {
                mesh.points_mm.push(block.vertex_m(corner).map(|x| 1e3 * x));
                mesh.points_mm.len() as u32 - 1
            })
        };
        let triangles: Vec<[u32; 3]> = block
            .indices
            .chunks_exact(3)
            .map(|corners| [corners[0], corners[1], corners[2]].map(&mut number))
            .collect();
        mesh.triangles.extend(triangles);
    }
    if is_left_handed(grid) {
        mesh.triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
    }
    // Vertices quantized to the same point leave triangles without area.
    mesh.triangles.retain(|[a, b, c]| a != b && b != c && c != a);
    mesh
}

/// Returns whether the voxel axes are left-handed in the patient frame.
fn is_left_handed(grid: &VoxelGrid) -> bool {
    let [i, j, k] = grid.axes();
    dot(cross(i, j), k) < 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::mesh::tests::assert_closed;

    fn grid(k_axis: [f64; 3]) -> VoxelGrid {
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], k_axis];
        VoxelGrid::new([60; 3], [0.5e-3, 0.5e-3, 0.75e-3], [-0.1, 0.05, 0.2], axes).unwrap()
    }

    /// A bore of 7 mm diameter and 25 mm length through the middle of the grid, optionally across its border.
    fn bore(grid: &VoxelGrid, last: usize) -> Vec<u32> {
        let centre_m = grid.world_m([29.5; 3]);
        let is_in = |index: &u32| {
            let voxel = grid.voxel(*index as usize).unwrap();
            let place_m = grid.world_m(voxel.map(|x| x as f64));
            voxel[2] <= last
                && (0..2).map(|axis| (place_m[axis] - centre_m[axis]).powi(2)).sum::<f64>()
                    < 3.5e-3_f64.powi(2)
        };
        (0..grid.voxel_count() as u32).filter(is_in).collect()
    }

    /// Surface nets round off voxel edges: for a bore of 7 mm in voxels of 0.5 mm they lose at most 2 % of
    /// the volume, wherever the bore ends.
    #[test]
    fn the_surface_of_a_bore_is_closed_and_holds_its_voxels() {
        for (k_axis, last) in [([0.0, 0.0, 1.0], 40), ([0.0, 0.0, -1.0], 40), ([0.0, 0.0, 1.0], 59)] {
            let grid = grid(k_axis);
            let gone = bore(&grid, last);
            let mesh = surface(&grid, &gone);
            assert_closed(&mesh);
            let voxels_mm3 = gone.len() as f64 * 0.5 * 0.5 * 0.75;
            let share = mesh.volume_mm3() / voxels_mm3;
            assert!((0.97..=1.0).contains(&share), "{share} of {voxels_mm3} mm³");
        }
    }

    #[test]
    fn nothing_gone_has_no_surface() {
        assert_eq!(surface(&grid([0.0, 0.0, 1.0]), &[]), Mesh::default());
    }
}
