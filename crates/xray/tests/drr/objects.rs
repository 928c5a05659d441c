//! Objects beside the tool: their lengths, attenuation, places and labels.

use std::path::Path;

use messages::{Pose, State};
use scene::Scene;
use scene::closed_mesh::ClosedMesh;
use xray::frame::{Cache, Job, label_job, render_job};
use xray::from_scene::{renderer_parameters, scene_c_arm};
use xray::message::projection_message;
use xray::surroundings::Surroundings;
use xray::{
    CArm, Class, DrrParameters, DrrRenderer, FrameSeed, Grid, Material, PlacedObjects, Projector, Spectrum,
    Tool, ToolPart, Visibility, VolumeView,
};

use crate::machine::Desk;
use crate::solids::{any_pose, norm, shown, turned};

const IDENTITY: Pose = Pose { position_m: [0.0; 3], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };

/// A scene with these tables after `[drr]`.
fn scene(more: &str) -> Scene {
    let text = format!(
        "name = \"a\"\nrun = {{ mode = \"lockstep\", duration_s = 1.0 }}\n\
         volume = {{ phantom = \"block\" }}\n\
         tool = {{ burr_start_mm = [10.0, 20.0, 30.0], direction = [0.0, 0.0, 1.0], bend_toward = [1.0, 0.0, \
         0.0] }}\n[drr]\nrate_hz = 0.0\nisocentre_mm = [0.0, 0.0, 0.0]\nprimary_angle_deg = 20.0\n\
         secondary_angle_deg = 10.0\ncolumns = 96\nrows = 80\npixel_pitch_mm = 1.2\n{more}"
    );
    Scene::parse(&text, Path::new("a.toml")).unwrap()
}

fn state() -> Box<State> {
    let mut state = Box::new(State::zeroed());
    for pose in [&mut state.t_world_flange, &mut state.t_world_base, &mut state.t_world_burr] {
        *pose = IDENTITY;
    }
    state.t_world_body.fill(IDENTITY);
    state
}

/// The job of a frame of a scene whose tool is behind the source.
fn job(scene: &Scene, mut state: Box<State>) -> Job {
    let far_m = [0.0, -5.0, 0.0];
    state.t_world_burr.position_m = far_m;
    (state.t_world_base.position_m, state.t_world_flange.position_m) = ([0.0, -5.1, 0.0], [0.0, -5.1, 0.0]);
    let c_arm = scene_c_arm(scene.drr.as_ref().unwrap()).unwrap();
    Job {
        state,
        restores: messages::Restores::Nothing,
        removed: Vec::new(),
        sequence: 1,
        request_id: 0,
        c_arm,
        cache: Cache::Follows,
        isocentre_m: [0.0; 3],
        noise_seed: 1,
        radii: scene::STANDARD_RADII,
        holder: scene.arm.holder(),
        notch: None,
        around: Surroundings::new(scene, None).unwrap().into(),
    }
}

/// Length of a segment inside a convex body, which is where a convex function is negative.
fn chord_m(from: [f64; 3], to: [f64; 3], inside: &dyn Fn([f64; 3]) -> f64) -> f64 {
    let at = |t: f64| inside([0, 1, 2].map(|i| from[i] + t * (to[i] - from[i])));
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..200 {
        let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if at(a) < at(b) { high = b } else { low = a }
    }
    let deepest = 0.5 * (low + high);
    if at(deepest) >= 0.0 {
        return 0.0;
    }
    let edge = |mut outside: f64| {
        let mut within = deepest;
        for _ in 0..80 {
            let middle = 0.5 * (outside + within);
            if at(middle) < 0.0 { within = middle } else { outside = middle }
        }
        within
    };
    (edge(1.0) - edge(0.0)) * norm([0, 1, 2].map(|i| to[i] - from[i]))
}

/// What an object's frame holds, as a scene describes it and as a convex function.
type Body = (&'static str, Box<dyn Fn([f64; 3]) -> f64>);

fn bodies() -> Vec<Body> {
    let largest = |values: [f64; 3]| values.into_iter().fold(f64::MIN, f64::max);
    let radial = |p: [f64; 3]| p[0].hypot(p[1]);
    vec![
        ("balls = { radius_mm = 8.0 }\nmaterial = \"tantalum\"", Box::new(|p| norm(p) - 8e-3)),
        (
            "cylinder = { start_mm = [0.0, 0.0, -30.0], end_mm = [0.0, 0.0, 20.0], radius_mm = 3.0 }\n\
             material = \"titanium\"",
            Box::new(move |p| largest([radial(p) - 3e-3, -0.03 - p[2], p[2] - 0.02])),
        ),
        (
            "cuboid = { half_extents_mm = [4.0, 11.0, 7.0] }\nmaterial = \"lead\"",
            Box::new(move |p| largest([p[0].abs() - 4e-3, p[1].abs() - 11e-3, p[2].abs() - 7e-3])),
        ),
    ]
}

/// Line integrals of a frame with nothing but these objects.
fn integrals(objects: PlacedObjects, c_arm: &CArm, parameters: DrrParameters) -> Vec<f64> {
    shown(c_arm, &Tool { objects, ..Tool::default() }, parameters)
}

/// The placed objects of a scene, as its frames show them.
fn placed(scene: &Scene, state: &State) -> PlacedObjects {
    let mut tool = Tool::default();
    Surroundings::new(scene, None).unwrap().put_around(state, &mut tool);
    tool.objects
}

/// Source and end of each pixel's ray, row-major.
fn rays(c_arm: &CArm) -> Vec<[[f64; 3]; 2]> {
    let pixels = (0..c_arm.rows).flat_map(|row| (0..c_arm.columns).map(move |column| (column, row)));
    pixels.map(|(column, row)| [c_arm.source_m, c_arm.pixel_m(f64::from(column), f64::from(row))]).collect()
}

/// Every shape, carried by the world, the flange, the tool's base and a body: mu times the chord that a
/// bisection of a convex function finds.
#[test]
fn objects_attenuate_by_their_chords_wherever_they_are_attached() {
    let (carriers, energy_kev) = (["world", "flange", "tool"], DrrParameters::default().energy_kev);
    let (mut worst, mut hit) = (0.0_f64, 0);
    for (number, (shape, inside)) in bodies().into_iter().enumerate() {
        for (n, attached) in carriers.into_iter().enumerate() {
            let scene = scene(&format!(
                "[[drr.object]]\nname = \"it\"\n{shape}\nattached = \"{attached}\"\n\
                 position_mm = [3.0, -4.0, 2.0]\nrotation_vector_deg = [0.0, 90.0, 0.0]\n"
            ));
            let carrier = any_pose((10 * number + n) as u64, 0.005);
            let mut state = state();
            match attached {
                "flange" => state.t_world_flange = carrier,
                "tool" => state.t_world_base = carrier,
                _ => {}
            }
            let carrier = if attached == "world" { IDENTITY } else { carrier };
            let [x, y, z, w] = carrier.orientation_xyzw;
            // A quarter turn about y takes the object's z to the carrier's x.
            let local = |p: [f64; 3]| {
                let p = turned([-x, -y, -z, w], [0, 1, 2].map(|i| p[i] - carrier.position_m[i]));
                let p = [p[0] - 0.003, p[1] + 0.004, p[2] - 0.002];
                [-p[2], p[1], p[0]]
            };
            let c_arm = scene_c_arm(scene.drr.as_ref().unwrap()).unwrap();
            let material = [Material::Tantalum, Material::Titanium, Material::Lead][number];
            let mu_per_m = material.mu_per_m(energy_kev).unwrap();
            let found = integrals(placed(&scene, &state), &c_arm, DrrParameters::default());
            for (found, [from, to]) in found.iter().zip(rays(&c_arm)) {
                let expected = mu_per_m * chord_m(local(from), local(to), &inside);
                hit += usize::from(expected > 0.0);
                worst = worst.max((found - expected).abs());
            }
        }
    }
    println!("{hit} rays through objects: worst error of the line integral {worst:.1e}");
    // The bisection's own resolution of a metre-long ray, where it grazes a face.
    assert!(hit > 2_000 && worst < 1e-6, "{worst:e}");
}

#[test]
fn bodies_of_a_material_are_seen_where_the_state_has_them_and_others_are_not() {
    let body = |name: &str, shape: &str| {
        format!("[[body]]\nname = \"{name}\"\nmotion = \"fixed\"\nposition_mm = [0.0, 0.0, 0.0]\n{shape}\n")
    };
    let shapes = body("seen", "capsule = { half_height_mm = 10.0, radius_mm = 4.0 }\nmaterial = \"steel\"")
        + &body("unseen", "ball = { radius_mm = 9.0 }");
    let (scene, mut state) = (scene(&shapes), state());
    let pose = any_pose(3, 0.01);
    state.t_world_body[0] = pose;
    let c_arm = scene_c_arm(scene.drr.as_ref().unwrap()).unwrap();
    let found = integrals(placed(&scene, &state), &c_arm, DrrParameters::default());
    let mu_per_m = Material::Steel316L.mu_per_m(DrrParameters::default().energy_kev).unwrap();
    let [x, y, z, w] = pose.orientation_xyzw;
    let local = |p: [f64; 3]| turned([-x, -y, -z, w], [0, 1, 2].map(|i| p[i] - pose.position_m[i]));
    let inside = |p: [f64; 3]| norm([p[0], p[1], p[2] - p[2].clamp(-0.01, 0.01)]) - 4e-3;
    let mut worst = 0.0_f64;
    for (found, [from, to]) in found.iter().zip(rays(&c_arm)) {
        worst = worst.max((found - mu_per_m * chord_m(local(from), local(to), &inside)).abs());
    }
    println!("capsule: worst error of the line integral {worst:.1e}");
    assert!(found.iter().any(|value| *value > 1.0) && worst < 1e-6, "{worst:e}");
    // Regression: a body that had fallen for five seconds ended the X-ray.
    state.t_world_body[0].position_m[2] = -120.0;
    assert_eq!(placed(&scene, &state).parts, []);
}

/// A mesh of a cuboid, of the scene's text, is the cuboid.
#[test]
fn a_mesh_attenuates_as_the_primitive_of_its_shape() {
    let place =
        "material = \"aluminium\"\nposition_mm = [1.0, 2.0, 3.0]\nrotation_vector_deg = [20.0, 30.0, 0.0]\n";
    let object = |shape: &str| scene(&format!("[[drr.object]]\nname = \"it\"\n{shape}\n{place}"));
    let mesh: ClosedMesh = crate::solids::cuboid([4.0, 11.0, 7.0]);
    let surface = scene::StructureSurface::pack(&mesh);
    let text = format!(
        "[drr.object.mesh]\nfile = \"a.stl\"\nsurface = {{ corners = \"{}\", triangles = \"{}\" }}\n",
        surface.corners, surface.triangles
    );
    let solid = object("cuboid = { half_extents_mm = [4.0, 11.0, 7.0] }");
    let facets = scene(&format!("[[drr.object]]\nname = \"it\"\n{place}{text}"));
    let c_arm = scene_c_arm(solid.drr.as_ref().unwrap()).unwrap();
    for spectrum in [None, Some(Spectrum::default())] {
        let parameters = DrrParameters { spectrum, ..DrrParameters::default() };
        let [a, b] = [&solid, &facets].map(|it| integrals(placed(it, &state()), &c_arm, parameters));
        let worst = a.iter().zip(&b).fold(0.0_f64, |worst, (a, b)| worst.max((a - b).abs()));
        println!("mesh against primitive: {worst:.1e}");
        assert!(a.iter().any(|value| *value > 0.1) && worst < 1e-9, "{worst:e}");
    }
    let missing = scene(&format!("[[drr.object]]\nname = \"it\"\n{place}mesh = {{ file = \"a.stl\" }}\n"));
    let refused = Surroundings::new(&missing, None).unwrap_err().to_string();
    assert!(refused.contains("drr.object `it`") && refused.contains("has not been read"), "{refused}");
}

/// Behind a slab of water, with a spectrum: the integral over 0.02 keV steps of Kramers' spectrum, written
/// out here. The bead takes the water's place.
#[test]
fn a_bead_in_water_hardens_the_beam_as_the_integral_over_energies_says() {
    let grid = Grid::centred([60, 40, 60], [1e-3; 3]).unwrap();
    let hu = vec![0_i16; grid.voxels()];
    let view = VolumeView::new(grid, &hu).unwrap();
    let c_arm = crate::poses::c_arm(0.0, 0.0, 41, 0.05);
    let spectrum = Spectrum { tube_kv: 110.0, aluminium_mm: 4.0, ..Spectrum::default() };
    let mu = |material: Material, energy_kev: f64| material.mu_per_m(energy_kev).unwrap();
    let steps = (0..4000).map(|i| 30.0 + (f64::from(i) + 0.5) * 0.02);
    let weights: Vec<(f64, f64)> =
        steps.map(|e| (e, e * (110.0 / e - 1.0) * (-mu(Material::Aluminium, e) * 4e-3).exp())).collect();
    let open: f64 = weights.iter().map(|(_, weight)| weight).sum();
    for (material, diameter_m) in [
        (Material::Steel316L, 3e-3),
        (Material::Tantalum, 1e-3),
        (Material::Lead, 1e-3),
        (Material::CobaltChromium, 2e-3),
        (Material::Pmma, 2e-2),
    ] {
        let ball = ToolPart::Sphere { centre_m: [0.0; 3], radius_m: 0.5 * diameter_m, material };
        let objects = PlacedObjects { parts: vec![ball], ..PlacedObjects::default() };
        let tool = Tool { objects, ..Tool::default() };
        let parameters = DrrParameters {
            spectrum: Some(spectrum),
            projector: Projector::Siddon,
            ..DrrParameters::default()
        };
        let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
        let mut image = vec![0; c_arm.pixels()];
        renderer.render(&view, &c_arm, &tool, FrameSeed::default(), &mut image).unwrap();
        let found = renderer.line_integrals()[20 * 41 + 20];
        let depth = |e: f64| mu(Material::Water, e) * (0.04 - diameter_m) + mu(material, e) * diameter_m;
        let passed: f64 = weights.iter().map(|(e, weight)| weight * (-depth(*e)).exp()).sum();
        let expected = -(passed / open).ln();
        println!("{material:?}: {found:.5}, the integral {expected:.5}");
        // The frame sums over steps of 2 keV, of which one holds the K edge: 1.4 % of tantalum's attenuation.
        assert!((found / expected - 1.0).abs() < 0.016, "{material:?}: {found} {expected}");
    }
}

/// The markers of a bead phantom on the true bone: names, world positions, K (R X + t), masks and images.
#[test]
fn markers_are_where_the_camera_matrix_puts_their_centres() {
    let scene = scene(
        "[[drr.object]]\nname = \"bead\"\nmaterial = \"tantalum\"\nattached = \"anatomy\"\n\
         position_mm = [1.0, 0.0, 0.0]\n\
         balls = { radius_mm = 2.5, centres_mm = [[0.0, 0.0, 0.0], [15.0, -12.0, \
         8.0], [-20.0, 30.0, -14.0], [500.0, 0.0, 0.0]] }\n\
         [[drr.object]]\nname = \"wire\"\nmaterial = \"steel\"\n\
         cylinder = { start_mm = [-20.0, 0.0, 20.0], end_mm = \
         [20.0, 0.0, 25.0], radius_mm = 0.8 }\n\
         [truth]\nregistration_error_mm = [0.5, -0.25, 0.125]\nregistration_error_deg = [0.0, 0.0, 90.0]\n",
    );
    let job = job(&scene, state());
    let grid = Grid::centred([30; 3], [2e-3; 3]).unwrap();
    let hu = vec![40_i16; grid.voxels()];
    let view = VolumeView::new(grid, &hu).unwrap();
    let parameters = DrrParameters {
        projector: Projector::Siddon,
        ..renderer_parameters(scene.drr.as_ref().unwrap(), None)
    };
    let mut renderer = DrrRenderer::new(&view, parameters, &Desk).unwrap();
    render_job(&mut renderer, &view, &job).unwrap();
    let frame = renderer.line_integrals();
    let labels = label_job(&mut renderer, &view, &job, 100).unwrap();
    let names: Vec<&str> = labels.markers.iter().map(|marker| &marker.name[..]).collect();
    assert_eq!(names, ["bead_1", "bead_2", "bead_3", "bead_4"]);
    let projection = projection_message(&job.c_arm, job.isocentre_m);
    let (k, r, t) = (projection.intrinsics, projection.rotation, projection.translation_m);
    let times = |m: [f64; 9], v: [f64; 3]| {
        [0, 1, 2].map(|i| m[3 * i] * v[0] + m[3 * i + 1] * v[1] + m[3 * i + 2] * v[2])
    };
    let centres_mm = [[0.0, 0.0, 0.0], [15.0, -12.0, 8.0], [-20.0, 30.0, -14.0], [500.0, 0.0, 0.0]];
    for (marker, [x, y, z]) in labels.markers.iter().zip(centres_mm) {
        // The bone is a quarter turn about z through the burr's start from where it was planned.
        let (x, y) = (x + 1.0 - 10.0, y - 20.0);
        let point = [10.0 - y + 0.5, 20.0 + x - 0.25, z + 0.125].map(|mm| mm * 1e-3);
        assert!(norm([0, 1, 2].map(|i| marker.centre_m[i] - point[i])) < 1e-15, "{marker:?}");
        let seen = times(r, point);
        let [u, v, s] = times(k, [0, 1, 2].map(|i| seen[i] + t[i]));
        let off = (marker.point.column - u / s).abs().max((marker.point.row - v / s).abs());
        println!("{}: column {:.3}, row {:.3}, off {off:.1e} pixels", marker.name, u / s, v / s);
        assert!(off < 1e-9 && (marker.point.depth_m - s).abs() < 1e-12);
        let (column, row) = (marker.point.column.round(), marker.point.row.round());
        let is_inside = (0.0..96.0).contains(&column) && (0.0..80.0).contains(&row);
        let wanted = if is_inside { Visibility::Alone } else { Visibility::Outside };
        assert_eq!(marker.point.visibility, wanted, "{marker:?}");
        if is_inside {
            assert_ne!(labels.mask[row as usize * 96 + column as usize] & Class::Object.bit(), 0);
        }
    }
    assert!(labels.markers.iter().filter(|marker| marker.point.visibility == Visibility::Alone).count() == 2);
    let objects = placed(&scene, &job.state);
    let alone = integrals(objects, &job.c_arm, DrrParameters::default());
    for (i, value) in alone.iter().enumerate() {
        assert_eq!(labels.mask[i], if *value > 0.0 { Class::Object.bit() } else { 0 }, "pixel {i}");
        assert!((f64::from(labels.metal[i]) - value).abs() < 1e-6 * (1.0 + value));
        let sum = f64::from(labels.anatomy[i]) + f64::from(labels.metal[i]);
        assert!((frame[i] - sum).abs() < 1e-6 * (1.0 + sum), "pixel {i}: {} {sum}", frame[i]);
        assert!(labels.tool_depth_m[i].is_nan());
    }
}
