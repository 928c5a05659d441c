//! Regression: a tool pulled into thin bone crushed it with the least force that any bone supports, because
//! no bone was left at its final depth: 884 mJ of bone where the tendon had done 103 mJ of work.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built is a failed test")]

use messages::{Command, CommandSource, Latched, TendonMode};
use nalgebra::Vector3;
use simulation::bone::{GridGeometry, MaterialLaw};
use simulation::{CtView, Simulation};

use crate::common::arm::Uniform;
use crate::common::scene;

/// Corner of the volume and its size, mm.
const CORNER_MM: [f64; 3] = [-6.0, -8.0, -40.0];
const SIZE_MM: [f64; 3] = [36.0, 16.0, 52.0];
/// Error of the tendon's work, whose tension is constant: rounding.
const ROUNDING_J: f64 = 1e-6;

/// A pull on the standard tool, which starts along z beside the bone.
struct Pull {
    dt_ms: f64,
    voxel_mm: f64,
    tension_n: f64,
    mass_scale: f64,
    model: &'static str,
}

impl Pull {
    /// Returns the work of the tendon and the energy that the bone absorbed, J, after a pull of 60 ms.
    /// `density` is that of a point, mm, in kg/m3; `None` is air.
    fn run(&self, density: impl Fn(Vector3<f64>) -> Option<f64>) -> [f64; 2] {
        let Pull { dt_ms, voxel_mm, tension_n, mass_scale, model } = self;
        let dims = SIZE_MM.map(|size| (size / voxel_mm) as usize);
        let first_mm = Vector3::from(CORNER_MM).add_scalar(0.5 * voxel_mm);
        let geometry = GridGeometry::axis_aligned(dims, [voxel_mm * 1e-3; 3], first_mm * 1e-3);
        let law = MaterialLaw::default();
        let hu_of = |density: f64| (density - law.density_offset_kg_m3) / law.density_slope_kg_m3_hu;
        let hu: Vec<i16> = (0..geometry.voxel_count())
            .map(|index| {
                let voxel = [index % dims[0], index / dims[0] % dims[1], index / (dims[0] * dims[1])];
                let centre_mm = first_mm + Vector3::from(voxel.map(|i| i as f64 * voxel_mm));
                density(centre_mm).map_or(-1000, |density| hu_of(density) as i16)
            })
            .collect();
        let scene = scene(&format!(
            "name = \"pull\"\nrun = {{ mode = \"lockstep\", dt_ms = {dt_ms:?}, duration_s = 1.0 }}\n\
             volume = {{ phantom = \"block\", bone_threshold_hu = 100 }}\narm = {{ model = \"fixed\" }}\n\
             manipulator = {{ model = \"{model}\", mass_scale = {mass_scale:?} }}\n"
        ));
        let mut simulation = Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
        let command = Command {
            sequence: 1,
            tendon_mode: TendonMode::ServoJf.code(),
            tendon_force_n: [*tension_n, 0.0, 0.0, 0.0],
            ..Command::zeroed()
        };
        let mut work_j = 0.0;
        for tick in 0..(60.0 / dt_ms) as u64 {
            let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
            let source = if tick == 0 { CommandSource::Fresh } else { CommandSource::Held };
            (latched.commands[0].source, latched.commands[0].command) = (source.code(), command);
            let before_m = simulation.state().tendon_displacement_m[0];
            simulation.step(&latched).unwrap();
            let state = simulation.state();
            work_j += state.tendon_tension_n[0] * (state.tendon_displacement_m[0] - before_m);
        }
        [work_j, simulation.state().crushing_energy_j]
    }
}

#[test]
fn crushing_a_thin_plate_takes_its_energy() {
    let pull = Pull { dt_ms: 2.0, voxel_mm: 0.5, tension_n: 30.0, mass_scale: 1.0, model: "planar" };
    let [work_j, crushed_j] = pull.run(|p| (6.0..6.8).contains(&p.x).then_some(1900.0));
    println!("work of the tendon {:.1} mJ, crushed {:.1} mJ", work_j * 1e3, crushed_j * 1e3);
    assert!(work_j > 0.05 && crushed_j <= work_j + ROUNDING_J);
}

/// Plates, shells, slivers, edges and corners.
#[test]
fn crushing_takes_its_energy_from_the_tendon() {
    let mut draw = Uniform(46);
    let (mut crushing, mut creating) = (0, 0);
    const PULLS: usize = 120;
    for number in 0..PULLS {
        let pull = Pull {
            dt_ms: [0.1, 1.0, 2.0, 5.0][number % 4],
            voxel_mm: draw.between(0.3, 0.8),
            tension_n: draw.between(5.0, 60.0),
            mass_scale: [1.0, 0.1][number / 7 % 2],
            model: ["planar", "spatial"][number / 3 % 2],
        };
        let (thickness, density) = (draw.between(0.3, 1.5), draw.between(150.0, 1900.0));
        // Beside the tool, whose burr has a radius of 3.25 mm.
        let corner = Vector3::new(draw.between(4.5, 9.0), draw.between(-2.0, 2.0), draw.between(-10.0, 0.0));
        let shape = |p: Vector3<f64>| {
            let from = p - corner;
            let within = |depth: f64| (0.0..thickness).contains(&depth);
            match number / 4 % 5 {
                0 => within(from.x),
                1 => within(8.0 - (from - Vector3::new(8.0, 0.0, 0.0)).norm()),
                2 => within(from.x) && from.y.abs() < thickness,
                3 => from.x > 0.0 && from.z > 0.0,
                _ => from.iter().all(|along| *along > 0.0),
            }
        };
        let [work_j, crushed_j] = pull.run(|p| shape(p).then_some(density));
        crushing += usize::from(crushed_j > 1e-4);
        if crushed_j > work_j + ROUNDING_J {
            creating += 1;
            println!("pull {number}: {:.1} mJ crushed by {:.1} mJ", crushed_j * 1e3, work_j * 1e3);
        }
    }
    println!("{crushing} of {PULLS} pulls crush bone, {creating} with more energy than the tendon's work");
    assert!(crushing > 10, "the pulls crush bone");
    assert_eq!(creating, 0);
}
