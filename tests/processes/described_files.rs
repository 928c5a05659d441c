//! Scenes with tool and arm in separate files.

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left, trabecula};
use crate::common::scenes;
use crate::frames::frames_of;

/// Position of each joint in the preceding one, mm, and its rotation there about x, degrees: the PUMA 560 of
/// `configs/examples/arm_joints.toml`.
const PUMA: [([f64; 3], f64); 6] = [
    ([0.0, 0.0, 0.0], 0.0),
    ([0.0, 0.0, 0.0], 90.0),
    ([431.8, 0.0, 0.0], 0.0),
    ([20.3, 0.0, 150.05], -90.0),
    ([0.0, 0.0, 431.8], 90.0),
    ([0.0, 0.0, 0.0], -90.0),
];

fn urdf() -> String {
    let look = |link| match link {
        2 => "<visual><geometry><mesh filename=\"upper_arm.obj\"/></geometry></visual>",
        _ => "",
    };
    let links: String =
        (0..=6).map(|link| format!("<link name=\"link_{link}\">{}</link>", look(link))).collect();
    let joints = PUMA.iter().enumerate().map(|(index, ([x, y, z], turn_deg))| {
        let (x, y, z, turn_rad) = (x / 1e3, y / 1e3, z / 1e3, turn_deg.to_radians());
        let below = index + 1;
        // An angle as rounded in Universal Robots' files: slightly more than 360 degrees.
        format!(
            "<joint name=\"joint_{below}\" type=\"revolute\"><parent link=\"link_{index}\"/><child link=\"link_{below}\"/>\
             <origin xyz=\"{x} {y} {z}\" rpy=\"{turn_rad} 0 0\"/><axis xyz=\"0 0 1\"/>\
             <limit lower=\"-6.28318530718\" upper=\"6.28318530718\" velocity=\"2\" effort=\"1\"/></joint>"
        )
    });
    format!("<robot name=\"puma\">{links}{}</robot>", joints.collect::<String>())
}

#[test]
fn the_log_of_a_scene_with_a_tool_file_and_a_urdf_file_replays_without_them() {
    let place = Place::new();
    let files = [
        ("arm.urdf", urdf()),
        ("drill.toml", include_str!("../../configs/tools/rigid_drill.toml").into()),
        ("upper_arm.obj", "v 0 0 0\nv 0.4 0 0\nv 0 0.1 0\nf 1 2 3\n".into()),
    ];
    for (name, text) in &files {
        std::fs::write(place.path(name), text).unwrap();
    }
    let more = "[manipulator]\nfile = \"drill.toml\"\n[arm]\nurdf = \"arm.urdf\"\ninitial_joints_deg = [5.0, 45.0, 20.0, 10.0, 50.0, 5.0]\n";
    let scene = scenes::drill_unseen("lockstep", 0.6).replace("tension_n = 6.0", "tension_n = 0.0");
    let run = place.start(&format!("{scene}{more}"));
    let ended = run.end_well();
    for (name, _) in &files {
        std::fs::remove_file(place.path(name)).unwrap();
    }
    let log = read(&ended.folder);
    assert_eq!(log.ticks.len(), 600);
    let [first, last] = [&log.initial, &log.ticks[599].state].map(|state| state.t_world_base.position_m[2]);
    assert!(last - first > 1e-3, "the arm has not fed: {first} to {last} m");
    assert_eq!(log.ticks[599].state.joint_count, 8, "the flexures of the drill's file");
    assert_replays(&ended.folder);
    assert_nothing_left(ended.pid);
}

/// The PUMA with its meshes in the beam: live, replayed and without them; and a replay that would show
/// another arm reports it.
#[test]
fn x_ray_frames_show_the_arm_of_the_run_or_none() {
    let place = Place::new();
    let arms = concat!(env!("CARGO_MANIFEST_DIR"), "/configs/arms/puma560");
    std::fs::create_dir_all(place.path("puma560/meshes")).unwrap();
    for file in ["puma560.urdf", "meshes/cube.stl", "meshes/prism.obj"] {
        std::fs::copy(format!("{arms}/{file}"), place.path(&format!("puma560/{file}"))).unwrap();
    }
    let example =
        include_str!("../../configs/examples/arm_urdf.toml").replace("../arms/", "").replace("4.0", "0.4");
    // The wrist is above the block.
    let drr = "[drr]\nrate_hz = 10.0\nisocentre_mm = [0.0, 0.0, -120.0]\ncolumns = 96\nrows = 96\npixel_pitch_mm = 2.0\nthreads = 1\n";
    let shown = |density: &str| {
        let scene = example.replace("[arm]\n", &format!("[arm]\n{density}\n")) + drr;
        let ended = place.start(&scene).end_well();
        let frames = frames_of(&ended);
        assert!(frames.len() >= 4, "{} frames", frames.len());
        (frames.iter().map(|frame| frame.frame.pixel_hash).collect::<Vec<_>>(), ended.folder)
    };
    let (with_arm, folder) = shown("xray_density_g_per_cm3 = 1.5");
    let (without, _) = shown("");
    assert!(with_arm.iter().zip(&without).all(|(a, b)| a != b), "the arm is in no frame");
    let replayed = trabecula(&[&"replay", &folder, &"--verify", &"--frames"]);
    assert_eq!(replayed.code, Some(0), "{}{}", replayed.out, replayed.err);
    // Another mesh with the same name.
    let mesh = place.path("puma560/meshes/cube.stl");
    let mut bytes = std::fs::read(&mesh).unwrap();
    bytes[0] ^= 1;
    std::fs::write(&mesh, &bytes).unwrap();
    let refused = trabecula(&[&"replay", &folder, &"--verify", &"--frames"]);
    assert_eq!(refused.code, Some(2), "{}{}", refused.out, refused.err);
    assert!(refused.err.contains("cube.stl") && refused.err.contains("file_xxh3"), "{}", refused.err);
    // An open mesh is rejected before anything starts.
    std::fs::write(&mesh, "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n")
        .unwrap();
    let scene = example.replace("[arm]\n", "[arm]\nxray_density_g_per_cm3 = 1.5\n") + drr;
    let ended = place.start(&scene).end();
    assert_eq!(ended.code, Some(2), "{}", ended.err);
    assert!(ended.err.contains("cube.stl") && ended.err.contains("is not closed"), "{}", ended.err);
}
