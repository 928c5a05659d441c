//! Regression: the planes of a tick were those within reach at its initial speed, so a suddenly pulled tool
//! passed through bone. Regression: a burr that jumped met only the planes of its last position and
//! oscillated between two positions; one of 60 pulls ended 1.9 mm inside the wall.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built is a failed test")]

use messages::{Command, CommandSource, Latched, TendonMode};
use simulation::{CtView, Simulation};

use crate::common::{Draw, bone, scene};

#[test]
fn a_suddenly_pulled_tool_stays_in_its_hole() {
    let (geometry, hu) = bone();
    let mut draw = Draw(26);
    let (mut out, mut farthest) = (0, 0.0f64);
    const PULLS: usize = 300;
    for pull in 0..PULLS {
        let dt_ms = [0.2, 1.0, 2.0, 5.0, 10.0][pull % 5];
        let hole_mm = 8.0 + 4.0 * draw.next();
        let tension_n = 8.0 + 22.0 * draw.next();
        let scene = scene(&format!(
            "name = \"pull\"\nrun = {{ mode = \"lockstep\", dt_ms = {dt_ms:?}, duration_s = 1.0 }}\n\
             volume = {{ phantom = \"block\" }}\n[[predrill]]\nfrom_mm = [0.0, 0.0, -110.0]\n\
             to_mm = [0.0, 0.0, 0.0]\ndiameter_mm = {hole_mm:?}\n"
        ));
        let mut simulation = Simulation::new(&scene, Some(CtView { geometry, hu: &hu })).unwrap();
        let command = Command {
            sequence: 1,
            tendon_mode: TendonMode::ServoJf.code(),
            tendon_force_n: [tension_n, 0.0, 0.0, 0.0],
            ..Command::zeroed()
        };
        for tick in 0..(150.0 / dt_ms) as u64 {
            let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
            let source = if tick == 0 { CommandSource::Fresh } else { CommandSource::Held };
            (latched.commands[0].source, latched.commands[0].command) = (source.code(), command);
            simulation.step(&latched).unwrap();
        }
        let [x, y, _] = simulation.state().t_world_burr.position_m;
        let beyond_mm = x.hypot(y) * 1e3 - (0.5 * hole_mm - 3.25);
        // A wall's position is uncertain by half a voxel on each side of its staircase.
        if beyond_mm > 0.5 {
            out += 1;
            println!(
                "{tension_n:.1} N, {dt_ms} ms, hole of {hole_mm:.1} mm: {beyond_mm:.2} mm into the wall"
            );
        }
        farthest = farthest.max(beyond_mm);
    }
    println!("{out} of {PULLS} pulls end outside the hole; {farthest:.2} mm into the wall at most");
    assert_eq!(out, 0);
}
