//! Scenes whose tool and arm stand in files of their own.

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left};
use crate::common::scenes;

/// Place of each joint in the one before it, mm, and its turn there about x, degrees: the PUMA 560 of `configs/examples/arm_joints.toml`.
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
        // A turn as Universal Robots' files round it: a little more than 360 degrees.
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
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
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
