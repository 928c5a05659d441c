//! Text files: scenes, calibrations, a session's announcement.

use std::path::Path;

use controllers::Calibration;
use ipc_types::scene::Scene;
use ipc_types::session::Announcement;
use simulation::Simulation;
use xray::from_scene::{scene_c_arm, scene_isocentre_m};
use xray::message::{c_arm_message, c_arm_of, projection_message};

/// Reads a scene's text. An accepted scene has a C-arm and a simulation, or an error explains why not.
pub fn scene(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let Ok(scene) = Scene::parse(text, Path::new("/scene.toml")) else { return };
    if let Some(drr) = &scene.drr
        && let Ok(c_arm) = scene_c_arm(drr)
    {
        let projection = projection_message(&c_arm, scene_isocentre_m(&scene));
        assert!(projection.intrinsics.iter().all(|number| number.is_finite()));
        assert_eq!(c_arm_of(&c_arm_message(&c_arm)).unwrap(), c_arm);
    }
    if scene.volume.is_none()
        && let Ok(mut simulation) = Simulation::new(&scene, None)
    {
        let latched = ipc_types::messages::Latched::zeroed();
        simulation.step(&latched).unwrap();
    }
}

/// Reads a calibration and an announcement.
pub fn settings(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    if let Ok(calibration) = Calibration::parse(text) {
        for bend_deg in [-1.0, 0.0, 1.0, 30.0, f64::MAX] {
            if let Ok(tension_n) = calibration.tension_for_bend_n(bend_deg) {
                assert!(tension_n.is_finite());
            }
        }
        let again = Calibration::parse(&calibration.to_csv());
        assert!(again.is_ok(), "{again:?}");
    }
    if let Ok(announcement) = serde_json::from_str::<Announcement>(text) {
        let again = serde_json::to_string(&announcement).unwrap();
        assert!(serde_json::from_str::<Announcement>(&again).is_ok());
    }
}
