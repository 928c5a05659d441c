//! The arm as drawn by the viewer's page: meshes and parts where the kinematics place them.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by it")]

use ipc_types::messages::Pose;
use ipc_types::scene::Scene;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use simulation::arm::{ArmParameters, six_joints};
use trabecula::commands::view_arm::{arm_looks, arm_parts};

/// Two joints about z, 0.4 m and 0.3 m long, then four about x and y at one point; a cube of 2 cm on the
/// second link.
const SCENE: &str = "name = \"a\"
run = { mode = \"lockstep\", duration_s = 1.0 }
tool = { burr_start_mm = [0.0, 0.0, 0.0], direction = [1.0, 0.0, 0.0], bend_toward = [0.0, 0.0, 1.0] }
[arm]
urdf = \"two.urdf\"
initial_joints_deg = [0.0, 0.0, 10.0, 20.0, 30.0, 40.0]
";

fn two_joints(look: &str) -> String {
    let joint = |i: usize, x_m: f64, axis: &str| {
        let above = i - 1;
        format!(
            "<link name=\"l{i}\">{}</link><joint name=\"j{i}\" type=\"revolute\"><parent link=\"l{above}\"/><child link=\"l{i}\"/>\
                 <origin xyz=\"{x_m} 0 0\"/><axis xyz=\"{axis}\"/><limit lower=\"-3\" upper=\"3\" velocity=\"1\"/></joint>",
            if i == 2 { look } else { "" }
        )
    };
    let z = "0 0 1";
    let joints: String = [(0.0, z), (0.4, z), (0.3, "1 0 0"), (0.0, "0 1 0"), (0.0, "1 0 0"), (0.1, "0 1 0")]
        .into_iter()
        .zip(1..)
        .map(|((x_m, axis), i)| joint(i, x_m, axis))
        .collect();
    format!("<robot name=\"two\"><link name=\"l0\"/>{joints}</robot>")
}

/// Returns a cube from corner to corner in text STL.
fn cube(low: f64, high: f64) -> String {
    let mut text = "solid cube\n".to_owned();
    for axis in 0..3 {
        for (side, order) in [(low, [0, 2, 1, 0, 3, 2]), (high, [0, 1, 2, 0, 2, 3])] {
            let corner = |k: usize| {
                let (u, v) = [(low, low), (high, low), (high, high), (low, high)][k];
                let mut at = [side; 3];
                (at[(axis + 1) % 3], at[(axis + 2) % 3]) = (u, v);
                format!("vertex {} {} {}\n", at[0], at[1], at[2])
            };
            for facet in order.chunks(3) {
                let corners: String = facet.iter().map(|k| corner(*k)).collect();
                text += &format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n");
            }
        }
    }
    text + "endsolid cube\n"
}

/// Computes a part's frame like the page (`arm.js`), starting from the base.
fn frame(parts: &[Pose], q_rad: &[f64], index: usize) -> Isometry3<f64> {
    let turned = |frame: Isometry3<f64>, (part, q_rad): (&Pose, &f64)| {
        let [x, y, z, w] = part.orientation_xyzw;
        let rotation = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z));
        let part = Isometry3::from_parts(Translation3::from(Vector3::from(part.position_m)), rotation);
        frame * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), *q_rad) * part
    };
    parts.iter().zip(q_rad).take(index).fold(Isometry3::identity(), turned)
}

#[test]
fn a_cube_on_the_second_link_moves_as_two_joints_in_a_plane_say() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("cube.stl"), cube(-10.0, 10.0)).unwrap();
    for mirrored in [1.0, -1.0] {
        // Half a turn about the link's x flips the signs of y and z; the cube's centre is 0.3 m along the
        // link and 0.05 m above it.
        let look = format!(
            "<visual><origin xyz=\"0.3 0 0.05\" rpy=\"3.141592653589793 0 0\"/>\
                 <geometry><mesh filename=\"cube.stl\" scale=\"0.001 0.001 {}\"/></geometry></visual>",
            0.001 * mirrored
        );
        std::fs::write(folder.path().join("two.urdf"), two_joints(&look)).unwrap();
        let scene =
            Scene::parse_with(SCENE, &folder.path().join("a.toml"), &ipc_types::text_file::read).unwrap();
        let (parts, looks) = (arm_parts(&scene).unwrap(), arm_looks(&scene).unwrap());
        let [mesh] = looks.meshes.as_slice() else { panic!("{} meshes", looks.meshes.len()) };
        assert_eq!((mesh.block, mesh.indices.len()), (2, 36));
        for [q1, q2] in [[0.0, 0.0], [0.7, -1.1], [-2.0, 0.4]] {
            let t_base_frame = frame(&parts, &[q1, q2, 0.0, 0.0, 0.0, 0.0], 2);
            let mut corners = std::collections::BTreeSet::new();
            for index in 0..mesh.positions.len() as u32 {
                let found = t_base_frame * Point3::from(mesh.vertex_m(index));
                // The centre by hand: 0.4 m along the first link, 0.3 m along the second.
                let turn = q1 + q2;
                let centre = [0.4 * q1.cos() + 0.3 * turn.cos(), 0.4 * q1.sin() + 0.3 * turn.sin(), 0.05];
                let away = found - Point3::from(centre);
                let along = turn.cos() * away.x + turn.sin() * away.y;
                let across = turn.cos() * away.y - turn.sin() * away.x;
                for x in [along, across, away.z] {
                    assert!((x.abs() - 0.01).abs() < 1e-6, "{x} m from the centre of a cube of 2 cm");
                }
                corners.insert([along > 0.0, across > 0.0, away.z > 0.0]);
            }
            assert_eq!(corners.len(), 8);
        }
        // Facets face outward, mirrored or not: away from the cube's centre.
        let middle: Vector3<f64> = (0..mesh.positions.len() as u32)
            .map(|index| Vector3::from(mesh.vertex_m(index)))
            .sum::<Vector3<f64>>()
            / mesh.positions.len() as f64;
        for (index, normal) in mesh.normals.iter().enumerate() {
            let away = Vector3::from(mesh.vertex_m(index as u32)) - middle;
            assert!(away.dot(&Vector3::from(normal.map(f64::from))) > 0.0, "{normal:?} looks inward");
        }
    }
}

/// For every arm: from the base through all parts to the flange.
#[test]
fn the_parts_of_every_arm_lead_to_its_flange() {
    let q_rad = six_joints([0.3, -1.2, 0.9, -0.4, 1.7, -2.2]);
    for model in ["ur3", "ur5", "ur10e", "ur20"] {
        let text = SCENE.split("urdf").next().unwrap().to_owned() + &format!("model = \"{model}\"\n");
        let scene = Scene::parse(&text, std::path::Path::new("a.toml")).unwrap();
        let geometry = ArmParameters::of(&scene.arm, scene.dt_s()).geometry;
        let found = frame(&arm_parts(&scene).unwrap(), &q_rad, 6);
        let off = (found.inverse() * geometry.forward(&q_rad)).translation.vector.norm();
        assert!(off < 1e-12, "{model}: {off} m");
    }
    let fixed = SCENE.split("urdf").next().unwrap().to_owned() + "model = \"fixed\"\n";
    assert!(arm_parts(&Scene::parse(&fixed, std::path::Path::new("a.toml")).unwrap()).is_none());
}
