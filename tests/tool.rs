//! One description of the tool: a change in the scene changes physics, X-ray, viewer and controllers alike.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::path::Path;

use ipc_types::scene::{STANDARD_RADII, Scene};
use simulation::Simulation;
use simulation::manipulator_parameters;
use trabecula::tool::{dimensions, reference};
use xray::ToolPart;
use xray::tool_model::tool_of;

fn scene(burr: &str) -> Scene {
    let text = format!(
        "name = \"tool\"\n[run]\nmode = \"lockstep\"\nduration_s = 0.1\n{burr}[tool]\nburr_start_mm = [0.0, 0.0, 0.0]\n\
         direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n"
    );
    Scene::parse(&text, Path::new("tool.toml")).unwrap()
}

/// Returns the radii used by the physics (burr, tube, contact spheres) and by the X-ray (burr, tube).
fn radii_m(scene: &Scene) -> [Vec<f64>; 2] {
    let parameters = manipulator_parameters(scene).unwrap();
    let physics = [
        parameters.cutter.widest_radius_m(),
        parameters.tube_radii_m[0],
        parameters.tube_radii_m[1],
        parameters.shaft_sphere_radius_m,
        parameters.segment_sphere_radius_m,
    ];
    let simulation = Simulation::new(scene, None).unwrap();
    let mut seen = [0.0; 3];
    for part in tool_of(simulation.state(), &scene.manipulator.radii(), &scene.arm.holder(), None).parts {
        match part {
            ToolPart::Sphere { radius_m, .. } => seen[0] = radius_m,
            ToolPart::Tube { outer_radius_m, inner_radius_m, .. } if inner_radius_m > 0.0 => {
                (seen[1], seen[2]) = (outer_radius_m, inner_radius_m);
            }
            _ => {}
        }
    }
    [physics.to_vec(), seen.to_vec()]
}

#[test]
fn physics_and_x_ray_take_the_tools_radii_from_one_place() {
    for (burr, burr_m) in
        [("", STANDARD_RADII.cutter.widest_radius_m()), ("[manipulator]\nburr_diameter_mm = 5.0\n", 2.5e-3)]
    {
        let (tube, lumen) = (STANDARD_RADII.tube_outer_m, STANDARD_RADII.tube_inner_m);
        let [physics, seen] = radii_m(&scene(burr));
        assert_eq!(physics, [burr_m, tube, lumen, tube, tube]);
        assert_eq!(seen, [burr_m, tube, lumen]);
    }
}

/// Returns a scene with the tool of a file, with one line of it changed.
fn with_tool(file: &str, from: &str, to: &str) -> Scene {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/tools");
    let read = |file: &Path| {
        let text = std::fs::read_to_string(file)?;
        assert!(text.contains(from), "{from}");
        Ok(text.replacen(from, to, 1))
    };
    let text = format!(
        "name = \"tool\"\nrun = {{ mode = \"lockstep\", duration_s = 0.1 }}\nmanipulator = {{ file = {file:?} }}\n\
        tool = {{ burr_start_mm = [0.0, 0.0, 0.0], direction = [0.0, 0.0, 1.0], bend_toward = [1.0, 0.0, 0.0] }}\n"
    );
    Scene::parse_with(&text, &folder.join("scene.toml"), &read).unwrap()
}

/// Everything that depends on one line of a tool file: physics, X-ray, viewer, exported surface, robot
/// description.
#[test]
fn a_changed_radius_in_a_tool_file_changes_physics_x_ray_and_viewer() {
    let seen = |scene: &Scene| {
        let [physics, x_ray] = radii_m(scene);
        let shape = trabecula::commands::view::tool_shape(scene);
        let simulation = Simulation::new(scene, None).unwrap();
        let surface = trabecula::geometry::tool::surface(simulation.state(), &scene.manipulator.radii());
        let stiffness = manipulator_parameters(scene).unwrap().joint_stiffness_nm_per_rad[5];
        (
            physics,
            x_ray,
            [shape.outer_radius_m, shape.cutter.widest_radius_m()],
            surface.volume_mm3(),
            stiffness,
        )
    };
    let (line, burr) = ("outer_diameter_mm = 6.0", "diameter_mm = 6.5");
    let before = seen(&with_tool("two_segments.toml", line, line));
    assert_eq!(before.0, [3.25e-3, 3e-3, 2e-3, 3e-3, 3e-3]);
    let thin = seen(&with_tool("two_segments.toml", line, "outer_diameter_mm = 5.6"));
    assert_eq!(thin.0, [3.25e-3, 2.8e-3, 2e-3, 2.8e-3, 2.8e-3]);
    assert_eq!((thin.1.clone(), thin.2), (vec![3.25e-3, 2.8e-3, 2e-3], [2.8e-3, 3.25e-3]));
    assert!(thin.3 < before.3 - 100.0 && thin.4 < 0.9 * before.4, "{thin:?} {before:?}");
    let small = seen(&with_tool("two_segments.toml", burr, "diameter_mm = 6.0"));
    assert_eq!((small.0[0], small.1[0], small.2[1]), (3e-3, 3e-3, 3e-3));
    assert!(small.3 < before.3 - 10.0);
}

/// The outer tube's radius, in contact spheres, X-ray, viewer and exported surface.
#[test]
fn a_changed_radius_of_an_outer_tube_changes_physics_x_ray_and_viewer() {
    let seen = |diameter_mm: f64| {
        let changed = format!("outer_diameter_mm = {diameter_mm:?}");
        let scene = with_tool("tube_in_tube.toml", "outer_diameter_mm = 5.0", &changed);
        let radii = scene.manipulator.radii();
        let parameters = manipulator_parameters(&scene).unwrap();
        let simulation = Simulation::new(&scene, None).unwrap();
        let shape = trabecula::commands::view::tool_shape(&scene);
        let parts = tool_of(simulation.state(), &radii, &scene.arm.holder(), None).parts;
        let outer_m = diameter_mm / 2e3;
        let x_ray = parts
            .iter()
            .any(|part| matches!(part, ToolPart::Tube { outer_radius_m, .. } if *outer_radius_m == outer_m));
        (
            parameters.outer_tube.unwrap().outer_radius_m,
            parameters.bending_spring(3, 0.0).bend_nm_per_rad,
            x_ray,
            shape.outer_tube.unwrap().outer_m,
            trabecula::geometry::tool::surface(simulation.state(), &radii).volume_mm3(),
        )
    };
    let (before, after) = (seen(5.0), seen(5.4));
    assert_eq!((before.0, after.0, after.3), (2.5e-3, 2.7e-3, 2.7e-3));
    assert!(after.1 > 1.3 * before.1, "stiffness {} {}", before.1, after.1);
    assert!(before.2 && after.2, "the X-ray");
    let steel_mm3 = core::f64::consts::PI * (2.7 * 2.7 - 2.5 * 2.5) * 80.0;
    assert!((after.4 - before.4 - steel_mm3).abs() < 0.02 * steel_mm3, "{} {}", before.4, after.4);
}

/// A log stores the tool itself, so it reads as the same tool without the file.
#[test]
fn what_a_log_keeps_of_a_described_tool_is_the_tool() {
    let scene = with_tool("two_segments.toml", "pitch_mm", "pitch_mm");
    let kept = Scene::parse(&toml::to_string(&scene).unwrap(), Path::new("log")).unwrap();
    assert_eq!(kept, scene);
    assert_eq!(manipulator_parameters(&kept).unwrap(), manipulator_parameters(&scene).unwrap());
}

fn dimension_mm(scene: &Scene, name: &str) -> f64 {
    dimensions(scene).unwrap().into_iter().find(|dimension| dimension.name == name).unwrap().value
}

/// Regression: the figures were in no document, and users measured them in X-ray frames.
#[test]
fn the_dimensions_shown_are_those_of_the_simulated_tool() {
    for change in ["", "[manipulator]\nburr_diameter_mm = 5.0\n", "[manipulator]\nlinks = 9\n"] {
        let scene = scene(change);
        let simulation = Simulation::new(&scene, None).unwrap();
        let state = simulation.state();
        let from_base_mm = |at: [f64; 3]| {
            let base = state.t_world_base.position_m;
            1e3 * (0..3).map(|i| (at[i] - base[i]).powi(2)).sum::<f64>().sqrt()
        };
        for (name, at) in [
            ("burr_centre_mm", state.t_world_burr.position_m),
            ("length_mm", state.t_world_tip.position_m),
            ("rigid_shaft_mm", state.t_world_link[0].position_m),
        ] {
            let (shown, simulated) = (dimension_mm(&scene, name), from_base_mm(at));
            assert!((shown - simulated).abs() < 1e-6, "{change:?}, {name}: {shown}, simulated {simulated}");
        }
        assert_eq!(dimension_mm(&scene, "flexures"), f64::from(state.joint_count), "{change:?}");
    }
}

#[test]
fn the_scene_reference_ends_with_the_tools_dimensions() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/scene.md");
    let written = std::fs::read_to_string(file).unwrap();
    let standard = reference(&scene("")).unwrap();
    assert!(written.ends_with(&standard), "write it anew: cargo run --release -- docs scene > docs/scene.md");
}
