//! Checks the surfaces of critical structures against closed forms and against the exact distance.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::path::Path;

use ipc_types::scene::closed_mesh::ClosedMesh;
use ipc_types::scene::{
    Label, Scene, Structure, StructureLabel, StructureMesh, StructureSurface, StructureVoxels,
};
use nalgebra::{Rotation3, Vector3};
use structures::Shape;
use viewer_proc::surface::{SurfaceError, Triangle, smooth_mesh, structure_surface};

const MOST: usize = 100_000;

/// A scene whose bone is not where it was planned, with one structure.
fn scene(structure: &str) -> Scene {
    let text = format!(
        "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\nphantom = \"block\"\n\
         [tool]\nburr_start_mm = [0.0, 0.0, -40.0]\n\
         direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
         [truth]\nregistration_error_mm = [3.0, -2.0, 1.0]\nregistration_error_deg = [10.0, 20.0, -30.0]\n\
         [[structure]]\nname = \"nerve\"\n{structure}"
    );
    Scene::parse(&text, Path::new("a.toml")).unwrap()
}

fn surface(scene: &Scene) -> Vec<Triangle> {
    structure_surface(scene, &scene.structure[0], MOST).unwrap().unwrap()
}

/// Edges that do not occur as often in one direction as in the other: a closed surface has none.
fn open_edges(triangles: &[Triangle]) -> usize {
    let mut balance: BTreeMap<[[u64; 3]; 2], i64> = BTreeMap::new();
    let bits = |corner: [f64; 3]| corner.map(|x| (x + 0.0).to_bits());
    for triangle in triangles {
        for side in 0..3 {
            let (a, b) = (bits(triangle[side]), bits(triangle[(side + 1) % 3]));
            *balance.entry([a.min(b), a.max(b)]).or_default() += if a < b { 1 } else { -1 };
        }
    }
    balance.values().filter(|count| **count != 0).count()
}

/// Volume by the divergence theorem, mm³: negative for a surface that is inside out.
fn volume_mm3(triangles: &[Triangle]) -> f64 {
    let sixfold = |triangle: &Triangle| {
        let [a, b, c] = triangle.map(|corner| Vector3::from(corner) * 1e3);
        a.dot(&b.cross(&c))
    };
    triangles.iter().map(sixfold).sum::<f64>() / 6.0
}

/// The largest and the least distance of corners from the structure, mm, by its own exact distance.
fn distances_mm(scene: &Scene, triangles: &[Triangle]) -> (f64, f64) {
    let shape = Shape::of(scene, &scene.structure[0], None).unwrap();
    let distances = triangles.iter().flatten().map(|corner| 1e3 * shape.distance_m(&(*corner).into()));
    distances.fold((f64::NEG_INFINITY, f64::INFINITY), |(most, least), x| (most.max(x), least.min(x)))
}

fn is_of_volume(triangles: &[Triangle], expected_mm3: f64) {
    let share = volume_mm3(triangles) / expected_mm3;
    println!("{} triangles with {share:.4} of the volume", triangles.len());
    assert!((share - 1.0).abs() < 0.01, "{share}");
    assert_eq!(open_edges(triangles), 0);
}

#[test]
fn balls_boxes_and_capsules_have_the_volume_and_the_distance_of_their_closed_forms() {
    for (text, expected_mm3) in [
        ("ball = { centre_mm = [5.0, -8.0, 12.0], radius_mm = 4.0 }", 4.0 / 3.0 * PI * 64.0),
        (
            "cuboid = { centre_mm = [5.0, 1.0, 2.0], half_extents_mm = [3.0, 2.0, 0.5], \
             rotation_vector_deg = [20.0, 70.0, -40.0] }",
            24.0,
        ),
        (
            "tube = { points_mm = [[1.0, 2.0, 3.0], [7.0, 4.0, 6.0]], radius_mm = 1.5 }",
            PI * 2.25 * 7.0 + 4.0 / 3.0 * PI * 3.375,
        ),
        // Twice the same point, and one point alone.
        (
            "tube = { points_mm = [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]], radius_mm = 1.5 }",
            4.0 / 3.0 * PI * 3.375,
        ),
    ] {
        let scene = scene(text);
        let triangles = surface(&scene);
        is_of_volume(&triangles, expected_mm3);
        let (most_mm, least_mm) = distances_mm(&scene, &triangles);
        assert!(most_mm < 1e-9 && least_mm > -1e-9, "{text}: {least_mm} to {most_mm} mm");
    }
}

/// A bend adds a wedge of a ball outside, and the two cylinders share a wedge inside: with the angle t, the
/// volume changes by 2/3 r³ t − 4/3 r³ tan(t/2).
#[test]
fn a_bent_tube_has_the_volume_and_the_distance_of_its_closed_form() {
    let (leg, radius) = (12.0, 2.0);
    for angle_deg in [0.001, 5.0, 40.0, 90.0, 130.0] {
        let angle = f64::to_radians(angle_deg);
        let (x, y) = (leg + leg * angle.cos(), leg * angle.sin());
        let scene = scene(&format!(
            "tube = {{ points_mm = [[0.0, 0.0, 0.0], [{leg:?}, 0.0, 0.0], [{x:?}, {y:?}, 0.0]], \
             radius_mm = {radius:?} }}"
        ));
        let triangles = surface(&scene);
        let straight = PI * radius * radius * 2.0 * leg + 4.0 / 3.0 * PI * radius.powi(3);
        let bend = radius.powi(3) * (2.0 / 3.0 * angle - 4.0 / 3.0 * (angle / 2.0).tan());
        is_of_volume(&triangles, straight + bend);
        let (most_mm, least_mm) = distances_mm(&scene, &triangles);
        assert!(most_mm < 1e-9 && least_mm > -1e-9, "{angle_deg}°: {least_mm} to {most_mm} mm");
    }
}

/// A helix: many bends, each in another plane.
#[test]
fn a_helix_has_the_distance_of_a_tube() {
    let point = |step: usize| {
        let angle = step as f64 * 0.2;
        format!("[{:?}, {:?}, {:?}]", 10.0 * angle.cos(), 10.0 * angle.sin(), 2.0 * angle)
    };
    let points: Vec<String> = (0..60).map(point).collect();
    let scene = scene(&format!("tube = {{ points_mm = [{}], radius_mm = 1.2 }}", points.join(", ")));
    let triangles = surface(&scene);
    assert_eq!(open_edges(&triangles), 0);
    let (most_mm, least_mm) = distances_mm(&scene, &triangles);
    assert!(most_mm < 1e-9 && least_mm > -1e-9, "{least_mm} to {most_mm} mm");
}

/// Regression: two points without a direction between them made corners that are not numbers, and merging
/// them never ended.
#[test]
fn a_leg_too_short_for_a_direction_is_left_out() {
    let points: Vec<String> =
        (0..90).map(|step| format!("[{}.0, {:?}, 5.0]", step, 3.0 * f64::from(step % 2))).collect();
    let tube = |start: &str| {
        scene(&format!("tube = {{ points_mm = [{start}{}], radius_mm = 1.0 }}", points.join(", ")))
    };
    let [whole, doubled] = ["", "[1e-200, 0.0, 5.0], "].map(|start| {
        let scene = tube(start);
        structure_surface(&scene, &scene.structure[0], 1000).unwrap().unwrap()
    });
    assert!(whole.len() <= 1000 && whole == doubled);
}

/// A line that turns back, and one with legs shorter than its radius: nothing is outside, and all is closed.
#[test]
fn a_crumpled_tube_stays_within_its_surface() {
    for points in [
        "[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [2.0, 0.0, 0.0]",
        "[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.5, 0.0], [0.2, 0.5, 0.3], [0.2, 4.0, 0.3]",
    ] {
        let scene = scene(&format!("tube = {{ points_mm = [{points}], radius_mm = 1.5 }}"));
        let triangles = surface(&scene);
        assert_eq!(open_edges(&triangles), 0);
        let (most_mm, least_mm) = distances_mm(&scene, &triangles);
        assert!(most_mm < 1e-9 && least_mm > -1.5, "{points}: {least_mm} to {most_mm} mm");
    }
}

fn with(structure: impl FnOnce(&mut Structure)) -> Scene {
    let mut scene = scene("ball = { centre_mm = [0.0, 0.0, 0.0], radius_mm = 1.0 }");
    scene.structure[0].ball = None;
    structure(&mut scene.structure[0]);
    scene
}

#[test]
fn a_mesh_is_drawn_as_its_file_has_it() {
    let corners = [[0.0, 0.0, 0.0], [6.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 4.0_f32]];
    let faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
    let triangles: Vec<[[f32; 3]; 3]> = faces.iter().map(|face| face.map(|i: usize| corners[i])).collect();
    let mesh = ClosedMesh::new(&triangles).unwrap();
    let scene = with(|structure| {
        let surface = Some(StructureSurface::pack(&mesh));
        structure.mesh = Some(StructureMesh { file: "nerve.stl".into(), frame: None, surface });
    });
    let triangles = surface(&scene);
    assert_eq!(triangles.len(), 4);
    is_of_volume(&triangles, 20.0);
    let (most_mm, least_mm) = distances_mm(&scene, &triangles);
    assert!(most_mm < 1e-9 && least_mm > -1e-9, "{least_mm} to {most_mm} mm");
}

const DIMS: [usize; 3] = [33, 31, 35];

/// A label on a rotated grid.
fn label(spacing_mm: [f64; 3], is_inside: impl Fn(Vector3<f64>) -> bool) -> (Scene, usize) {
    let rotation = Rotation3::from_scaled_axis(Vector3::new(0.3, -0.5, 0.2));
    let axes = [0, 1, 2].map(|axis| rotation.matrix().column(axis).into_owned().into());
    let at = |index: usize| {
        let voxel = [index % DIMS[0], index / DIMS[0] % DIMS[1], index / (DIMS[0] * DIMS[1])];
        let place = |axis: usize| (voxel[axis] as f64 - 0.5 * (DIMS[axis] - 1) as f64) * spacing_mm[axis];
        Vector3::new(place(0), place(1), place(2))
    };
    let inside: Vec<bool> = (0..DIMS.iter().product()).map(|index| is_inside(at(index))).collect();
    let count = inside.iter().filter(|inside| **inside).count();
    let voxels = StructureVoxels::pack(DIMS, spacing_mm, [4.0, 5.0, 6.0], axes, inside.into_iter());
    let label = StructureLabel { file: "labels.nrrd".into(), label: Label::Value(1), voxels: Some(voxels) };
    (with(|structure| structure.label = Some(label)), count)
}

/// Edges and corners of voxels are cut off, almost as much inside of the surface as outside: the corners are
/// off by less than a fifth of the longest edge, and what is missing of the volume is less than a twentieth
/// of it deep.
#[test]
fn a_label_has_the_volume_of_its_voxels_and_their_distance() {
    for spacing_mm in [[0.5; 3], [0.4, 0.5, 0.8]] {
        let (scene, count) = label(spacing_mm, |at| at.norm() < 5.0);
        let triangles = surface(&scene);
        assert_eq!(open_edges(&triangles), 0);
        let longest_mm = spacing_mm.into_iter().fold(0.0, f64::max);
        let (volume, voxels) = (volume_mm3(&triangles), count as f64 * spacing_mm.iter().product::<f64>());
        let area_mm2 = 4.0 * PI * 25.0;
        let deep_mm = (voxels - volume) / area_mm2;
        let (most_mm, least_mm) = distances_mm(&scene, &triangles);
        println!(
            "{spacing_mm:?}: {:.4} of the volume, {deep_mm:.4} mm; {least_mm:.3} to {most_mm:.3} mm",
            volume / voxels
        );
        assert!(deep_mm.abs() < 0.05 * longest_mm, "{deep_mm}");
        assert!(most_mm < 0.2 * longest_mm && least_mm > -0.2 * longest_mm, "{least_mm} to {most_mm} mm");
    }
}

/// What reaches the box of the label's voxels is closed there, half a voxel beyond their centres.
#[test]
fn a_label_that_fills_its_box_is_closed_and_as_wide_as_its_voxels() {
    let (scene, count) = label([0.5, 0.5, 1.0], |_| true);
    let triangles = surface(&scene);
    // Of each edge of the box, less than an eighth of a square voxel is cut off.
    is_of_volume(&triangles, count as f64 * 0.25);
}

#[test]
fn few_triangles_are_left_closed_and_on_the_surface() {
    let scene = scene("ball = { centre_mm = [5.0, -8.0, 12.0], radius_mm = 4.0 }");
    let whole = surface(&scene);
    for most in [1000, 300, 60] {
        let few = structure_surface(&scene, &scene.structure[0], most).unwrap().unwrap();
        assert!(few.len() <= most && 3 * few.len() > most, "{} of {most}", few.len());
        assert_eq!(open_edges(&few), 0);
        assert!(few.iter().flatten().all(|corner| whole.iter().flatten().any(|known| known == corner)));
        assert!(volume_mm3(&few) > 0.6 * volume_mm3(&whole), "{most}: {}", volume_mm3(&few));
    }
}

#[test]
fn what_has_no_surface_of_its_own_is_not_drawn_and_what_was_not_read_is_an_error() {
    let built_in = scene("built_in = \"outside_of_bone\"");
    assert!(structure_surface(&built_in, &built_in.structure[0], MOST).unwrap().is_none());
    let unread = with(|structure| {
        structure.label = Some(StructureLabel { file: "a".into(), label: Label::Value(1), voxels: None });
    });
    let error = structure_surface(&unread, &unread.structure[0], MOST).unwrap_err();
    assert!(matches!(error, SurfaceError::Shape(_)) && error.to_string().contains("`nerve`"), "{error}");
    // Every second voxel: six quadrilaterals each.
    let dims = [200, 100, 100];
    let is_inside = (0..2_000_000).map(|index| (index + index / 200 + index / 20_000) % 2 == 0);
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let voxels = StructureVoxels::pack(dims, [0.5; 3], [0.0; 3], axes, is_inside);
    let checkered = with(|structure| {
        structure.label =
            Some(StructureLabel { file: "a".into(), label: Label::Value(1), voxels: Some(voxels) });
    });
    let error = structure_surface(&checkered, &checkered.structure[0], MOST).unwrap_err();
    assert!(matches!(error, SurfaceError::Intricate(_)), "{error}");
}

/// A ball's corners have its own directions as normals, and a box keeps its edges.
#[test]
fn balls_are_round_and_boxes_have_edges() {
    let ball = scene("ball = { centre_mm = [0.0, 0.0, 0.0], radius_mm = 4.0 }");
    let mesh = smooth_mesh(3, &surface(&ball));
    let centre = ball.in_bone_mm([0.0; 3]).map(|x| x * 1e-3);
    assert_eq!(mesh.block, 3);
    // One normal at each corner: 23 rings of 48, and two poles.
    assert_eq!(mesh.positions.len(), 23 * 48 + 2);
    for (number, normal) in mesh.normals.iter().enumerate() {
        let at = mesh.vertex_m(number as u32);
        let out = Vector3::from([0, 1, 2].map(|axis| at[axis] - centre[axis])).normalize();
        let cosine = out.dot(&Vector3::from(normal.map(f64::from)).normalize());
        assert!(cosine > 0.99, "{at:?}: {cosine}");
    }
    let cube = scene("cuboid = { centre_mm = [0.0, 0.0, 0.0], half_extents_mm = [1.0, 1.0, 1.0] }");
    let mesh = smooth_mesh(0, &surface(&cube));
    // Three normals at each corner.
    assert_eq!(mesh.positions.len(), 24);
}
