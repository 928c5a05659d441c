//! A straight feed into a block of 600 HU at several voxel sizes, coarsest first: final depth, distance of
//! the path from that of the first size, forces, volume, steps per second, memory.
//!
//! `cargo run --release -p physics_lab --example fine_voxels [-- INSERTION_MM VOXEL_MM...]`; 36 mm
//! and 0.25, 0.12, 0.06, 0.03 mm if absent. The finest takes minutes and 2 GB.

use std::time::Instant;

use messages::services::MAX_KEYFRAME_BYTES;
use nalgebra::Vector3;
use simulation::Simulation;

#[path = "../../../crates/simulation/tests/physics/common/feed.rs"]
mod feed;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let given: Vec<f64> = std::env::args().skip(1).map(|text| text.parse()).collect::<Result<_, _>>()?;
    let (insertion_mm, sizes_mm) = match &given[..] {
        [insertion_mm, sizes_mm @ ..] if !sizes_mm.is_empty() => (*insertion_mm, sizes_mm),
        _ => (given.first().copied().unwrap_or(36.0), &[0.25, 0.12, 0.06, 0.03][..]),
    };
    println!(
        "| voxel, mm | depth, mm | path apart, mm | force, N: mean, max | drilled, mm³ | voxels in a tick | \
         steps a second | partly cut, MB | keyframe, kB | process, MB |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    let mut first = None;
    for voxel_mm in sizes_mm {
        let block = feed::Block::new(voxel_mm * 1e-3);
        let mut simulation = Simulation::new(&feed::scene("planar"), Some(block.ct()))?;
        let began = Instant::now();
        let fed = feed::feed(&mut simulation, insertion_mm * 1e-3);
        let steps_per_s = feed::ticks(insertion_mm * 1e-3) as f64 / began.elapsed().as_secs_f64();
        let depth_mm = Vector3::from(fed.end.t_world_tip.position_m).z * 1e3;
        let apart_mm = first.as_ref().map_or(0.0, |first: &feed::FeedResult| fed.apart_m(first) * 1e3);
        let drilled_mm3 = fed.end.removed_total as f64 * block.voxel_mm3();
        let mut buffer = vec![0; 64 * MAX_KEYFRAME_BYTES];
        let keyframe_kb = simulation.write_keyframe(&mut buffer)? as f64 * 1e-3;
        println!(
            "| {voxel_mm} | {depth_mm:.3} | {apart_mm:.3} | {:.2}, {:.2} | {drilled_mm3:.1} | {} | \
             {steps_per_s:.0} | {:.1} | {keyframe_kb:.0} | {:.0} |",
            fed.mean_force_n,
            fed.most_force_n,
            fed.most_removed,
            simulation.bone_bytes() as f64 * 1e-6,
            peak_memory_mb().unwrap_or(f64::NAN),
        );
        first.get_or_insert(fed);
    }
    Ok(())
}

/// Returns the peak memory of this process so far, 10⁶ bytes.
fn peak_memory_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix(" kB")?.parse::<f64>().ok()? * 1024e-6)
}
