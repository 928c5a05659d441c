//! Time (ms) and error of each projector on a thigh of 240 x 200 x 320 voxels of 1 mm, 384 x 384 pixels.
//!
//! `cargo run --release -p drr_proc --example render_time -- [threads]`

use std::error::Error;
use std::time::Instant;

use drr_proc::ThisMachine;
use xray::ray::RayFan;
use xray::{
    CArm, DetectorFormat, DrrParameters, DrrRenderer, FrameSeed, Grid, Material, PositionerAngles, Projector,
    Tool, ToolPart, VolumeView, reference,
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
    let (right, up) = ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]);
    let tool = snake(&backbone([-0.06, 0.0, 0.05], right, up, 0.04, 0.7));
    for (name, primary, secondary) in [("ap", 0.0, 0.0), ("oblique", 37.0, 18.0), ("lateral", 90.0, 5.0)] {
        let c_arm = pose(primary, secondary)?;
        let fan = RayFan::new(&grid, &c_arm);
        let pixel = |i: u32| fan.world_ray(i % SIDE, i / SIDE);
        let truth: Vec<f64> =
            (0..SIDE * SIDE).map(|i| reference::line_integral(&shapes, &pixel(i), mu_water)).collect();
        let mut exact = Vec::new();
        for projector in [Projector::Siddon, Projector::Joseph] {
            let parameters = DrrParameters { projector, threads, ..DrrParameters::default() };
            let started = Instant::now();
            let mut renderer = DrrRenderer::new(&view, parameters, &ThisMachine)?;
            let built_ms = ms(started);
            let mut image = vec![0_u16; c_arm.pixels()];
            renderer.render(&view, &c_arm, &tool, FrameSeed::default(), &mut image)?;
            if exact.is_empty() {
                exact = renderer.anatomy().to_vec();
            }
            println!(
                "{name:8} {projector:?}: relative rms error {:.2e} (closed form), {:.2e} (Siddon)",
                reference::relative_rms(renderer.anatomy(), &truth),
                reference::relative_rms(renderer.anatomy(), &exact)
            );
            print!("         {threads} threads, least ms of {ROUNDS}: build {built_ms:.1}, ");
            time_frames(&mut renderer, &view, &c_arm, &tool, &pose(primary + 1.0, secondary)?)?;
        }
    }
    Ok(())
}

fn pose(primary_deg: f64, secondary_deg: f64) -> Result<CArm, xray::DrrError> {
    let format = DetectorFormat { columns: SIDE, rows: SIDE, pixel_pitch_m: [0.3 / f64::from(SIDE); 2] };
    let angles = PositionerAngles::from_degrees(primary_deg, secondary_deg);
    CArm::from_positioner_angles([0.0; 3], angles, 0.7, 1.0, format)
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Shortest times of a full frame, a frame without changes, one with the tool, and one after a millimetre of drilling.
fn time_frames(
    renderer: &mut DrrRenderer,
    view: &VolumeView<'_>,
    c_arm: &CArm,
    tool: &Tool,
    away: &CArm,
) -> Result<(), Box<dyn Error>> {
    let (none, seed) = (Tool::default(), FrameSeed::default());
    let mut image = vec![0_u16; c_arm.pixels()];
    let mut least = [f64::INFINITY; 4];
    let (mut removed, mut rays) = (0, 0);
    for round in 0..ROUNDS {
        renderer.render(view, away, &none, seed, &mut image)?;
        for (which, tool) in [(0, &none), (1, &none), (2, tool)] {
            let started = Instant::now();
            renderer.render(view, c_arm, tool, seed, &mut image)?;
            least[which] = least[which].min(ms(started));
        }
        let batch = ball(view.grid(), [0.048 - 0.001 * round as f64, 0.0, 0.08]);
        let started = Instant::now();
        removed = renderer.remove(view, &batch)?;
        rays = renderer.render(view, c_arm, tool, seed, &mut image)?.rays_traced;
        least[3] = least[3].min(ms(started));
    }
    let [full, cached, tooled, drilled] = least;
    println!(
        "full {full:.1}, unchanged {cached:.2}, with tool {tooled:.2}, tool and {removed} voxels removed ({rays} rays) {drilled:.2}"
    );
    Ok(())
}

/// Linear indices of the voxels in a ball of 3.25 mm radius.
fn ball(grid: &Grid, centre_m: [f64; 3]) -> Vec<u32> {
    let inside = |&i: &u32| {
        let p = grid.index_to_world(grid.voxel_of(i as usize).map(|v| v as f64));
        (0..3).map(|a| (p[a] - centre_m[a]) * (p[a] - centre_m[a])).sum::<f64>() < 3.25e-3 * 3.25e-3
    };
    (0..grid.voxels() as u32).filter(inside).collect()
}

/// Positions along a continuum manipulator: `rigid_m` straight along the unit vector `ahead`, then 27 links of 1.2 mm
/// that turn toward the unit vector `side` by `bend_rad` in total.
fn backbone(
    base_m: [f64; 3],
    ahead: [f64; 3],
    side: [f64; 3],
    rigid_m: f64,
    bend_rad: f64,
) -> Vec<[f64; 3]> {
    let go = |p: [f64; 3], angle: f64, s: f64| {
        let (sine, cosine) = libm::sincos(angle);
        [0, 1, 2].map(|a| p[a] + s * (cosine * ahead[a] + sine * side[a]))
    };
    let mut points = vec![base_m, go(base_m, 0.0, rigid_m)];
    for link in 1..=27 {
        points.push(go(points[points.len() - 1], bend_rad * f64::from(link) / 27.0, 1.2e-3));
    }
    points
}

/// Nitinol tubes of 6/4 mm between the points, a steel cable of 2 mm in their lumen, a steel burr of 6.5 mm at the
/// end.
fn snake(points: &[[f64; 3]]) -> Tool {
    let mut parts = Vec::new();
    for pair in points.windows(2) {
        let (start_m, end_m) = (pair[0], pair[1]);
        parts.push(ToolPart::HollowCylinder {
            start_m,
            end_m,
            outer_radius_m: 3e-3,
            inner_radius_m: 2e-3,
            material: Material::Nitinol,
        });
        parts.push(ToolPart::Cylinder { start_m, end_m, radius_m: 1e-3, material: Material::Steel316L });
    }
    if let Some(&centre_m) = points.last() {
        parts.push(ToolPart::Sphere { centre_m, radius_m: 3.25e-3, material: Material::Steel316L });
    }
    Tool { parts, arm: None }
}
