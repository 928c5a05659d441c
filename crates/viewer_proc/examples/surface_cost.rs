//! What the surface costs: a whole femur-sized block of bone, then one tick of drilling after the other.
//!
//! `cargo run --release -p viewer_proc --example surface_cost`

use std::time::Instant;

use viewer_proc::surface::{Blocks, Field, Voxel};
use voxel_grid::{GridError, VoxelGrid};

fn main() -> Result<(), GridError> {
    // 120 × 120 × 120 mm at 0.5 mm, a cylinder of bone 40 mm thick in it.
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let grid = VoxelGrid::new([240; 3], [0.5e-3; 3], [0.0; 3], axes)?;
    let place =
        |index: usize| [index % 240, index / 240 % 240, index / (240 * 240)].map(|x| x as f64 - 120.0);
    let hu: Vec<i16> = (0..grid.voxel_count())
        .map(|index| {
            let [x, y, _] = place(index);
            (150.0 + 200.0 * (40.0 - x.hypot(y))).clamp(-1000.0, 1500.0) as i16
        })
        .collect();
    let mut field = Field::new(grid, 150);
    let mut blocks = Blocks::new(&grid);
    let began = Instant::now();
    let meshes = blocks.mesh_changed(&field, &hu, usize::MAX);
    let triangles: usize = meshes.iter().map(|mesh| mesh.indices.len() / 3).sum();
    println!(
        "whole: {} blocks with a surface, {triangles} triangles, {:.0} ms",
        meshes.len(),
        began.elapsed().as_secs_f64() * 1e3
    );
    // A burr of 6.5 mm goes in sideways, 0.5 mm a step.
    let mut times_ms = Vec::new();
    for step in 0..60 {
        let x = 40.0 - f64::from(step);
        for index in 0..grid.voxel_count() as u32 {
            let [a, b, c] = place(index as usize);
            if (a - x).powi(2) + b * b + c * c < 6.5 * 6.5
                && field.set(index, Voxel::Removed)
                && let Some(voxel) = grid.voxel(index as usize)
            {
                blocks.touch(voxel);
            }
        }
        let waiting = blocks.changed_count();
        let began = Instant::now();
        let meshes = blocks.mesh_changed(&field, &hu, usize::MAX);
        let bytes: usize = meshes.iter().map(|mesh| mesh.bytes().len()).sum();
        times_ms.push((began.elapsed().as_secs_f64() * 1e3, waiting, bytes));
    }
    times_ms.sort_by(|a, b| a.0.total_cmp(&b.0));
    let at = |share: f64| times_ms[(share * (times_ms.len() - 1) as f64) as usize];
    for (name, (milliseconds, blocks, bytes)) in [("median", at(0.5)), ("p95", at(0.95)), ("max", at(1.0))] {
        println!("drill step of 0.5 mm, {name}: {milliseconds:.2} ms, {blocks} blocks, {} kB", bytes / 1000);
    }
    Ok(())
}
