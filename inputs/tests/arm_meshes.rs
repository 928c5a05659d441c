//! The meshes of an arm, read from files.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use std::path::PathBuf;

use inputs::arm_meshes::{load, undrawn};
use ipc_types::scene::{Arm, ArmMesh};

fn mesh(joint: Option<&str>, file: PathBuf, scale: f64) -> ArmMesh {
    let joint = joint.map(str::to_owned);
    ArmMesh { joint, file, position_mm: [0.0; 3], roll_pitch_yaw_deg: [0.0; 3], scale: [scale; 3] }
}

#[test]
fn broken_files_are_named_with_joint_and_reason_and_other_kinds_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, content: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        path
    };
    let arm = |meshes: Vec<ArmMesh>| Arm { mesh: Some(meshes), ..Arm::default() };
    let triangle = b"v 0 0 0\nv 100 0 0\nv 0 300 0\nf 1 2 3\n";
    let good = file("good.obj", triangle);
    let loaded = arm(vec![mesh(None, good.clone(), 1e-3)]);
    assert_eq!(load(&loaded).unwrap()[0].triangles, [[[0.0; 3], [100.0, 0.0, 0.0], [0.0, 300.0, 0.0]]]);
    for (wrong, words) in [
        (
            mesh(Some("j1"), folder.path().join("none.stl"), 1.0),
            ["of joint `j1`", "none.stl, which cannot be read"],
        ),
        (mesh(None, file("cut.stl", &[0; 100]), 1.0), ["of the arm's base", "cut.stl, which is no STL"]),
        (mesh(Some("j2"), good.clone(), 1.0), ["`j2`", "reaches 300.0 m from its own frame"]),
    ] {
        let arm = arm(vec![mesh(None, good.clone(), 1e-3), wrong]);
        let error = load(&arm).unwrap_err().to_string();
        assert!(words.iter().all(|word| error.contains(word)), "{words:?} in: {error}");
    }
    let arm = arm(vec![
        mesh(Some("j1"), PathBuf::from("/a.dae"), 1.0),
        mesh(None, PathBuf::from("/b.dae"), 1.0),
        mesh(None, good, 1e-3),
    ]);
    let told = undrawn(&arm);
    assert!(told[0].contains("of joint `j1` is /a.dae") && told[0].ends_with("drawn as a tube"), "{told:?}");
    assert!(told[1].contains("/b.dae") && told[1].ends_with("its other meshes"), "{told:?}");
}
