//! The meshes of an arm, read from files.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use std::path::PathBuf;

use ipc_types::arm_meshes::{load, note_content, solids, undrawn};
use ipc_types::scene::{Arm, ArmMesh};

fn mesh(joint: Option<&str>, file: PathBuf, scale: f64) -> ArmMesh {
    let joint = joint.map(str::to_owned);
    ArmMesh {
        joint,
        file,
        position_mm: [0.0; 3],
        roll_pitch_yaw_deg: [0.0; 3],
        scale: [scale; 3],
        file_xxh3: None,
    }
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
        (
            mesh(None, file("cut.stl", &[0; 100]), 1.0),
            ["of the arm's base", "cut.stl, which is not an STL file"],
        ),
        (mesh(Some("j2"), good.clone(), 1.0), ["`j2`", "extends 300.0 m from its frame's origin"]),
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

#[test]
fn frames_need_closed_meshes_and_the_files_of_their_time() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.obj");
    let corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n";
    let closed = format!("{corners}f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n");
    std::fs::write(&file, &closed).unwrap();
    let arm = |density| Arm {
        mesh: Some(vec![mesh(Some("j1"), file.clone(), 0.1)]),
        xray_density_g_per_cm3: density,
        ..Arm::default()
    };
    assert!((solids(&arm(Some(1.0))).unwrap()[0].1.volume() - 1.0 / 6.0).abs() < 1e-15);
    let mut noted = arm(Some(1.0));
    note_content(&mut noted);
    assert_eq!(noted.mesh.as_ref().unwrap()[0].file_xxh3.as_ref().map(String::len), Some(32));
    assert_eq!(solids(&noted).unwrap()[0].1, solids(&arm(Some(1.0))).unwrap()[0].1);
    let mut looks = arm(None);
    note_content(&mut looks);
    assert_eq!((looks, solids(&arm(None)).unwrap().len()), (arm(None), 0), "no frame shows it");

    // A face is missing; the 3D view still draws it.
    std::fs::write(&file, closed.trim_end().rsplit_once('\n').unwrap().0).unwrap();
    assert_eq!(load(&arm(None)).unwrap()[0].triangles.len(), 3);
    let said = |arm: &Arm, words: &[&str]| {
        let error = solids(arm).unwrap_err().to_string();
        assert!(words.iter().all(|word| error.contains(word)), "{words:?} in: {error}");
    };
    let name = file.to_str().unwrap();
    said(&arm(Some(1.0)), &["of joint `j1`", name, "not closed: 3 edges", "`arm.xray_density_g_per_cm3`"]);
    said(&noted, &["of joint `j1`", name, "`arm.mesh.file_xxh3`"]);
    std::fs::remove_file(&file).unwrap();
    said(&noted, &["of joint `j1`", name, "cannot be read"]);

    let mut other = arm(Some(1.0));
    other.mesh = Some(vec![mesh(None, PathBuf::from("/b.dae"), 1.0)]);
    assert!(undrawn(&other)[0].ends_with("drawn as a tube and is missing from X-ray frames"));
}
