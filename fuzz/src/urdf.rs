//! Arms in URDF files, read through a scene that names one.

use std::path::Path;

use ipc_types::scene::Scene;
use simulation::arm::{ArmParameters, initial_q_rad};

const SCENE: &str = "name = \"arm\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\nburr_start_mm = [0.0, 0.0, 0.0]\n\
                     direction = [1.0, 0.0, 0.0]\nbend_toward = [0.0, 0.0, 1.0]\n[arm]\nurdf = \"a\"\n\
                     initial_joints_deg = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]\n";

/// Reads a URDF file. An accepted one is an arm of finite poses, and its scene is unchanged when written and
/// read again.
pub fn urdf(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let Ok(scene) = Scene::parse_with(SCENE, Path::new("/s.toml"), &|_| Ok(text.to_owned())) else { return };
    let arm = ArmParameters::of(&scene.arm, scene.dt_s());
    let pose = arm.geometry.forward(&initial_q_rad(&scene.arm));
    assert!(pose.to_homogeneous().iter().all(|x| x.is_finite()), "{pose}");
    assert!(arm.joint_limits.lower_rad.iter().zip(&arm.joint_limits.upper_rad).all(|(a, b)| a < b));
    let again = Scene::parse(&toml::to_string(&scene).unwrap(), Path::new("/s.toml")).unwrap();
    assert_eq!(again.arm, scene.arm);
}

/// Seeds: six joints, and six between a fixed one and a finger.
pub fn seeds() -> Vec<Vec<u8>> {
    let joint = |kind: &str, i: usize| {
        let above = i - 1;
        format!(
            "<joint name=\"j{i}\" type=\"{kind}\"><parent link=\"l{above}\"/><child link=\"l{i}\"/>\
             <origin xyz=\"0 0.1 0.{i}\" rpy=\"1.57 0 -3.1\"/><axis xyz=\"0 0 1\"/>\
             <limit lower=\"-1.5\" upper=\"2.5e0\" velocity=\"3\"/></joint>"
        )
    };
    let robot = |kinds: &[&str]| {
        let links: String = (0..=kinds.len()).map(|i| format!("<link name=\"l{i}\"/>")).collect();
        let joints: String = kinds.iter().enumerate().map(|(i, kind)| joint(kind, i + 1)).collect();
        format!("<?xml version=\"1.0\"?>\n<robot name=\"r\">{links}{joints}</robot>")
    };
    let six = ["revolute"; 6];
    let longer =
        ["fixed", "revolute", "continuous", "revolute", "revolute", "continuous", "revolute", "fixed"];
    vec![robot(&six).into_bytes(), robot(&longer).into_bytes()]
}
