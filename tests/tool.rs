//! One description of the tool: a change in the scene changes physics, X-ray, viewer and controllers alike.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::path::Path;

use ipc_types::scene::{STANDARD_RADII, Scene};
use simulation::Simulation;
use simulation::manipulator_parameters;
use xray::ToolPart;
use xray::tool_model::tool_of;

fn scene(burr: &str) -> Scene {
    let text = format!(
        "name = \"tool\"\n[run]\nmode = \"lockstep\"\nduration_s = 0.1\n{burr}[tool]\nburr_start_mm = [0.0, 0.0, 0.0]\n\
         direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n"
    );
    Scene::parse(&text, Path::new("tool.toml")).unwrap()
}

/// The radii that each of them has: the physics (burr, tube, contact spheres), the X-ray (burr, tube).
fn radii_m(scene: &Scene) -> [Vec<f64>; 2] {
    let parameters = manipulator_parameters(scene).unwrap();
    let physics = [
        parameters.burr_radius_m,
        parameters.tube_radii_m[0],
        parameters.tube_radii_m[1],
        parameters.shaft_sphere_radius_m,
        parameters.segment_sphere_radius_m,
    ];
    let simulation = Simulation::new(scene, None).unwrap();
    let mut seen = [0.0; 3];
    for part in tool_of(simulation.state(), &scene.manipulator.radii(), None).parts {
        match part {
            ToolPart::Sphere { radius_m, .. } => seen[0] = radius_m,
            ToolPart::HollowCylinder { outer_radius_m, inner_radius_m, .. } => {
                (seen[1], seen[2]) = (outer_radius_m, inner_radius_m);
            }
            _ => {}
        }
    }
    [physics.to_vec(), seen.to_vec()]
}

#[test]
fn physics_and_x_ray_take_the_tools_radii_from_one_place() {
    for (burr, burr_m) in [("", STANDARD_RADII.burr_m), ("[manipulator]\nburr_diameter_mm = 5.0\n", 2.5e-3)] {
        let (tube, lumen) = (STANDARD_RADII.tube_outer_m, STANDARD_RADII.tube_inner_m);
        let [physics, seen] = radii_m(&scene(burr));
        assert_eq!(physics, [burr_m, tube, lumen, tube, tube]);
        assert_eq!(seen, [burr_m, tube, lumen]);
    }
}
