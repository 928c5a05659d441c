//! Measures time (ms) and error of the exact projectors on a thigh of 240 x 200 x 320 voxels of 1 mm, 384 x
//! 384 pixels.
//!
//! `cargo run --release -p drr_proc --example render_time -- [threads]`

use std::error::Error;
use std::time::Instant;

use drr_proc::ThisMachine;
use xray::ray::RayFan;
use xray::{
    CArm, DetectorFormat, DrrError, DrrParameters, DrrRenderer, FrameSeed, Grid, Material, PositionerAngles,
    Projector, Tool, VolumeView, reference,
};

const SIDE: u32 = 384;
const ROUNDS: usize = 7;

fn main() -> Result<(), Box<dyn Error>> {
    let threads = std::env::args().nth(1).map_or(Ok(2), |a| a.parse())?;
    let grid = Grid::centred([240, 200, 320], [1e-3; 3])?;
    let shapes = reference::thigh(1.0);
    let hu = reference::voxelise(&grid, &shapes, 2);
    let view = VolumeView::new(grid, &hu)?;
    let mu_water = Material::Water.mu_per_m(60.0)?;
    for (name, primary, secondary) in [("ap", 0.0, 0.0), ("oblique", 37.0, 18.0), ("lateral", 90.0, 5.0)] {
        let (c_arm, away) = (pose(primary, secondary)?, pose(primary + 1.0, secondary)?);
        let fan = RayFan::new(&grid, &c_arm);
        let pixel = |i: u32| fan.world_ray(i % SIDE, i / SIDE);
        let truth: Vec<f64> =
            (0..SIDE * SIDE).map(|i| reference::line_integral(&shapes, &pixel(i), mu_water)).collect();
        let mut exact = Vec::new();
        for projector in [Projector::Siddon, Projector::Joseph] {
            let parameters = DrrParameters { projector, threads, ..DrrParameters::default() };
            let mut renderer = DrrRenderer::new(&view, parameters, &ThisMachine)?;
            let mut image = vec![0_u16; c_arm.pixels()];
            let mut least_ms = f64::INFINITY;
            for _ in 0..ROUNDS {
                // A frame of another C-arm in between, so that none is cached.
                for c_arm in [&away, &c_arm] {
                    let started = Instant::now();
                    renderer.render(&view, c_arm, &Tool::default(), FrameSeed::default(), &mut image)?;
                    least_ms = least_ms.min(started.elapsed().as_secs_f64() * 1e3);
                }
            }
            if exact.is_empty() {
                exact = renderer.anatomy().to_vec();
            }
            println!(
                "{name:8} {projector:?}: full frame {least_ms:.1} ms, relative rms error {:.2e} (closed \
                 form), {:.2e} (Siddon)",
                reference::relative_rms(renderer.anatomy(), &truth),
                reference::relative_rms(renderer.anatomy(), &exact)
            );
        }
    }
    Ok(())
}

fn pose(primary_deg: f64, secondary_deg: f64) -> Result<CArm, DrrError> {
    let format = DetectorFormat { columns: SIDE, rows: SIDE, pixel_pitch_m: [0.3 / f64::from(SIDE); 2] };
    let angles = PositionerAngles::from_degrees(primary_deg, secondary_deg);
    CArm::from_positioner_angles([0.0; 3], angles, 0.7, 1.0, format)
}
