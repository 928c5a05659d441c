//! Renders fluoroscopic images of the synthetic femur with a curved drilled path, an empty side branch, and the tool
//! inside.
//!
//! `cargo run --release -p drr_proc --example femur_drr -- <folder> [dark|bright|tool-black] [primary_deg]
//! [secondary_deg]` writes `intact.png`, `drilled.png` and `tool.png`.

mod common;

use std::error::Error;

use drr_proc::ThisMachine;
use volume_io::phantom::{FemurSpec, femur, femur_landmarks};
use xray::{
    CArm, DetectorFormat, DisplayMode, DrrParameters, DrrRenderer, FrameSeed, Grid, PositionerAngles, Tool,
    VolumeView,
};

const SIDE: u32 = 512;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let folder = arguments.first().ok_or("give a folder to write to")?;
    let mode = match arguments.get(1).map_or("dark", String::as_str) {
        "dark" => DisplayMode::BoneDark,
        "bright" => DisplayMode::BoneBright,
        "tool-black" => DisplayMode::BoneBrightToolBlack,
        other => return Err(format!("{other} is no display mode: give dark, bright or tool-black").into()),
    };
    let angle = |i: usize| arguments.get(i).map_or(Ok(0.0), |a| a.parse::<f64>());
    let angles = PositionerAngles::from_degrees(angle(2)?, angle(3)?);

    let spec = FemurSpec::default();
    let (volume, marks) = (femur(&spec)?, femur_landmarks(&spec)?);
    let grid = Grid::new(volume.dims, volume.spacing_m, volume.origin_m, volume.direction)?;
    let view = VolumeView::new(grid, &volume.hu)?;

    // Along the neck axis into the neck, then curving up into the head; the branch continues straight.
    let (entry, ahead) = (marks.entry_point_m, marks.neck_axis);
    let up = perpendicular([0.0, 0.0, 1.0], ahead);
    let along = |s: f64| [0, 1, 2].map(|a| entry[a] + s * ahead[a]);
    let backbone = common::backbone(along(-0.08), ahead, up, 0.08 + 0.035, 0.8);
    let mut removed = capsules(&grid, &backbone, 3.6e-3);
    removed.extend(capsules(&grid, &[along(0.035), along(0.065)], 3.25e-3));
    let tool = common::snake(&backbone[..backbone.len() - 8]);

    let mut parameters = DrrParameters::default();
    parameters.display.mode = mode;
    let mut renderer = DrrRenderer::new(&view, parameters, &ThisMachine)?;
    let centre = grid.index_to_world(volume.dims.map(|n| 0.5 * (n as f64 - 1.0)));
    let format = DetectorFormat { columns: SIDE, rows: SIDE, pixel_pitch_m: [0.4e-3; 2] };
    let c_arm = CArm::from_positioner_angles(centre, angles, 0.7, 1.0, format)?;
    let mut image = vec![0_u16; c_arm.pixels()];
    for (name, batch, tool) in [
        ("intact", Vec::new(), &Tool::default()),
        ("drilled", removed, &Tool::default()),
        ("tool", Vec::new(), &tool),
    ] {
        renderer.remove(&view, &batch)?;
        let report = renderer.render(&view, &c_arm, tool, FrameSeed { seed: 1, frame: 1 }, &mut image)?;
        println!("{name}: {report:?}");
        common::write_png(&format!("{folder}/{name}.png"), SIDE, SIDE, &image)?;
    }
    Ok(())
}

/// The part of `v` perpendicular to the unit vector `axis`, normalised.
fn perpendicular(v: [f64; 3], axis: [f64; 3]) -> [f64; 3] {
    let along: f64 = (0..3).map(|a| v[a] * axis[a]).sum();
    let side = [0, 1, 2].map(|a| v[a] - along * axis[a]);
    let length = side.iter().map(|x| x * x).sum::<f64>().sqrt();
    side.map(|x| x / length)
}

/// Linear indices of the voxels within `radius_m` of a polyline.
fn capsules(grid: &Grid, line_m: &[[f64; 3]], radius_m: f64) -> Vec<u32> {
    let near = |p: [f64; 3]| {
        line_m.windows(2).any(|pair| {
            let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| a[i] * b[i]).sum::<f64>();
            let from = |q: [f64; 3], o: [f64; 3]| [0, 1, 2].map(|i| q[i] - o[i]);
            let (along, to) = (from(pair[1], pair[0]), from(p, pair[0]));
            let t = (dot(along, to) / dot(along, along)).clamp(0.0, 1.0);
            let miss = [0, 1, 2].map(|i| to[i] - t * along[i]);
            dot(miss, miss) < radius_m * radius_m
        })
    };
    (0..grid.voxels() as u32)
        .filter(|&i| near(grid.index_to_world(grid.voxel_of(i as usize).map(|v| v as f64))))
        .collect()
}
