//! Time of the largest slices through a volume of 256³ voxels, along its axes and across them.

use std::time::Instant;

use viewer_proc::slice::{MOST_PIXELS, Slice};
use viewer_proc::surface::Field;
use voxel_grid::VoxelGrid;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    const VOXELS: usize = 256;
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let grid = VoxelGrid::new([VOXELS; 3], [0.5e-3; 3], [0.0; 3], axes)?;
    let hu: Vec<i16> = (0..grid.voxel_count()).map(|index| (index % 2500) as i16).collect();
    let field = Field::new(grid, 150);
    for (name, right, down) in [
        ("axial", [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
        ("sagittal", [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]),
        ("oblique", [0.6, 0.8, 0.0], [0.0, 0.0, -1.0]),
    ] {
        let asked = serde_json::json!({"centre_m": [0.064, 0.064, 0.064], "right": right, "down": down, "side_m": [0.12, 0.12],
            "columns": MOST_PIXELS, "rows": MOST_PIXELS});
        let slice: Slice = serde_json::from_value(asked)?;
        let mut times_ms = Vec::new();
        for _ in 0..50 {
            let began = Instant::now();
            std::hint::black_box(slice.bytes(&field, &hu));
            times_ms.push(began.elapsed().as_secs_f64() * 1e3);
        }
        times_ms.sort_by(f64::total_cmp);
        println!("{name}: median {:.1} ms, longest {:.1} ms", times_ms[25], times_ms[49]);
    }
    Ok(())
}
