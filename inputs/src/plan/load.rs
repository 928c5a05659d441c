//! What a scene does to its tool, as far as the measured errors depend on it.

use ipc_types::scene::{Controller, Drives, Feedback, Scene};

use crate::failure::Failure;

/// What a scene does to the tool, as far as errors depend on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Load {
    /// Whether there is bone.
    pub bone: bool,
    /// How hard the tendons may be pulled.
    pub pull: Pull,
}

/// How hard the tendons may be pulled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pull {
    /// At most [`GENTLE_N`] at once, or [`RAMPED_N`] on the ramp of a feed: no flexure is thrown against its stop.
    Gentle,
    /// Up to the 60 N that a built-in controller may ask for, at once, or unknown.
    Hard,
}

/// Most tension of a gentle pull, N. The tool swings to twice its bend, and reaches its stops at 15.6 N.
pub const GENTLE_N: f64 = 6.0;
/// Most tension of a gentle pull on the ramp of a feed, N.
pub const RAMPED_N: f64 = 15.0;
/// Most friction of the tendons for which errors were measured.
pub const MOST_TENDON_FRICTION: f64 = 0.3;

impl Load {
    /// What a scene names.
    pub fn of(scene: &Scene) -> Load {
        let drivers = scene.controller.iter().filter(|entry| entry.drives.contains(&Drives::Tendon));
        let pull =
            if drivers.map(share_of_gentle).all(|share| share <= 1.0) { Pull::Gentle } else { Pull::Hard };
        Load { bone: scene.volume.is_some(), pull }
    }
}

/// The most tension that a controller may ask for, over that of a gentle pull; infinite if the scene does not say.
fn share_of_gentle(entry: &Controller) -> f64 {
    let drilling = entry.curved_drilling.as_ref().filter(|drilling| drilling.feedback == Feedback::None);
    let ramped = drilling.and_then(|drilling| drilling.tension_n).map(|most_n| most_n / RAMPED_N);
    let held_n = entry.hold.as_ref().map(|hold| hold.tension_n);
    let stiffened_n = entry.skiving.as_ref().map(|skiving| skiving.tension_n);
    let swept_n = entry.tension_sweep.as_ref().and_then(|sweep| sweep.most_n);
    let at_once = held_n.or(stiffened_n).or(swept_n).map(|most_n| most_n / GENTLE_N);
    ramped.or(at_once).unwrap_or(f64::INFINITY)
}

/// Refuses a tool other than the one whose errors were measured.
///
/// # Errors
/// Bad input: the scene has another tool, or changes the tool's stiffness, mass, damping or mount, or has more tendon friction.
pub fn check_tool(scene: &Scene) -> Result<(), Failure> {
    let tool = &scene.manipulator;
    let changed = [
        ("stiffness_scale", tool.stiffness_scale, 1.0),
        ("mass_scale", tool.mass_scale, 1.0),
        ("mount_stiffness_n_per_m", tool.mount_stiffness_n_per_m, 2.0e5),
        ("damping_ratio", tool.damping_ratio, 0.05),
        ("notch_width_mm", tool.notch_width_mm, 0.73),
        ("notch_past_axis_mm", tool.notch_past_axis_mm, 0.495),
    ];
    let refuse = |key: &str, given: f64, expected: String| {
        Failure::bad_input(format!(
            "scene `{}`: `manipulator.{key}` is {given}; with a `tolerance` of tip or path, expected {expected}: the errors were measured for the standard tool (leave `tip_mm` and `path_mm` out and name `model`, `links`, `integrator` and `dt_ms` instead)",
            scene.name
        ))
    };
    if let Some(other) = &tool.tool {
        return Err(Failure::bad_input(format!(
            "scene `{}`: `manipulator.tool` is `{}`; with a `tolerance` of tip or path, expected the standard tool, for which the errors were measured (leave `tip_mm` and `path_mm` out and name `model`, `links`, `integrator` and `dt_ms` instead)",
            scene.name, other.name
        )));
    }
    for (key, given, standard) in changed {
        if let Some(given) = given.filter(|given| *given != standard) {
            return Err(refuse(key, given, format!("{standard}")));
        }
    }
    for (key, given) in [
        ("lateral_stiffness_ratio", tool.lateral_stiffness_ratio),
        ("torsion_stiffness_ratio", tool.torsion_stiffness_ratio),
    ] {
        if let Some(given) = given {
            return Err(refuse(key, given, "that of the notches".to_owned()));
        }
    }
    match tool.tendon_friction.filter(|friction| *friction > MOST_TENDON_FRICTION) {
        Some(friction) => Err(refuse("tendon_friction", friction, format!("at most {MOST_TENDON_FRICTION}"))),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use std::path::Path;

    use super::*;

    fn scene(tool: &str, controller: &str) -> Scene {
        let text = format!(
            "name = \"load\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[manipulator]\n{tool}\n[tool]\nburr_start_mm = [0.0, 0.0, 0.0]\n\
             direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n[[controller]]\nname = \"a\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n{controller}"
        );
        Scene::parse(&text, Path::new("load.toml")).unwrap()
    }

    #[test]
    fn a_pull_is_gentle_if_no_controller_may_throw_a_flexure_against_its_stop() {
        let feed = |tension_n: f64| {
            format!(
                "[controller.curved_drilling]\nfeed_mm_per_s = 1.0\ninsertion_mm = 5.0\ntension_n = {tension_n:?}\nramp_end_mm = 3.0\nburr_speed_rpm = 0.0\nfeedback = \"none\"\n"
            )
        };
        for (controller, pull) in [
            ("hold = { tension_n = 6.0 }".to_owned(), Pull::Gentle),
            ("hold = { tension_n = 6.1 }".to_owned(), Pull::Hard),
            (feed(15.0), Pull::Gentle),
            (feed(15.1), Pull::Hard),
            (feed(5.0).replace("none", "image"), Pull::Hard),
            ("external = true".to_owned(), Pull::Hard),
        ] {
            assert_eq!(Load::of(&scene("", &controller)), Load { bone: false, pull }, "{controller}");
        }
    }

    #[test]
    fn a_tool_that_was_not_measured_is_refused_with_its_key() {
        let hold = "hold = { tension_n = 6.0 }";
        for key in
            ["stiffness_scale = 2.0", "mass_scale = 0.5", "damping_ratio = 0.01", "tendon_friction = 0.4"]
        {
            let refused = check_tool(&scene(key, hold)).unwrap_err();
            let name = key.split(' ').next().unwrap();
            assert!(refused.code == 2 && refused.message.contains(name), "{refused}");
        }
        assert!(check_tool(&scene("tendon_friction = 0.3\nstiffness_scale = 1.0", hold)).is_ok());
    }
}
