//! Loads of a scene on its tool, as far as the measured errors depend on them.

use ipc_types::scene::{Contact, Controller, Drives, Feedback, Manipulator, Scene, Tendon, ToolDescription};
use simulation::manipulator::{ManipulatorParameters, TendonRoute};
use simulation::manipulator_parameters;

/// Loads of a scene on its tool, as far as errors depend on them.
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
    /// At most [`GENTLE_N`] as a step, or [`RAMPED_N`] on the ramp of a feed: no flexure is thrown against
    /// its stop.
    Gentle,
    /// Up to the 60 N that a built-in controller can command, as a step, or unknown.
    Hard,
}

/// Largest tension of a gentle pull, N. The tool swings to twice its bend, and reaches its stops at 15.6 N.
pub const GENTLE_N: f64 = 6.0;
/// Largest tension of a gentle pull on the ramp of a feed, N.
pub const RAMPED_N: f64 = 15.0;
/// Largest tendon friction for which errors were measured.
pub const MOST_TENDON_FRICTION: f64 = 0.3;

impl Load {
    /// Determines the loads of a scene.
    pub fn of(scene: &Scene) -> Load {
        let drivers = scene.controller.iter().filter(|entry| entry.drives.contains(&Drives::Tendon));
        let is_gentle = !has_tendons(scene) || drivers.map(share_of_gentle).all(|share| share <= 1.0);
        let pull = if is_gentle { Pull::Gentle } else { Pull::Hard };
        Load { bone: scene.volume.is_some(), pull }
    }
}

fn has_tendons(scene: &Scene) -> bool {
    !scene.tendon.is_empty() || scene.manipulator.tool.as_ref().is_none_or(|tool| !tool.tendon.is_empty())
}

/// Whether a tendon lies outside the bending plane or is helical.
pub(super) fn tendons_leave_the_plane(tendons: &[Tendon], tool: Option<&ToolDescription>) -> bool {
    let leaves =
        |across_mm: f64, twist: Option<f64>| across_mm != 0.0 || twist.is_some_and(|twist| twist != 0.0);
    let of_tool = tool.filter(|_| tendons.is_empty()).map_or(&[][..], |tool| &tool.tendon);
    tendons.iter().any(|it| leaves(it.across_mm, it.twist_deg_per_mm))
        || of_tool.iter().any(|it| leaves(it.across_mm, it.twist_deg_per_mm))
}

/// Largest tension that a controller can command, relative to a gentle pull; infinite if unknown.
fn share_of_gentle(entry: &Controller) -> f64 {
    let drilling = entry.curved_drilling.as_ref().filter(|drilling| drilling.feedback == Feedback::None);
    let ramped = drilling.and_then(|drilling| drilling.tension_n).map(|most_n| most_n / RAMPED_N);
    let held_n = entry.hold.as_ref().map(|hold| hold.tension_n);
    let stiffened_n = entry.skiving.as_ref().map(|skiving| skiving.tension_n);
    let swept_n = entry.tension_sweep.as_ref().and_then(|sweep| sweep.most_n);
    let at_once = held_n.or(stiffened_n).or(swept_n).map(|most_n| most_n / GENTLE_N);
    ramped.or(at_once).unwrap_or(f64::INFINITY)
}

/// Whether a scene's tool is bitwise the one whose errors the built-in table holds; tendon friction up to
/// [`MOST_TENDON_FRICTION`] is allowed.
pub fn is_standard_tool(scene: &Scene) -> bool {
    let mut own = scene.as_it_is();
    own.gravity_m_per_s2 = [0.0; 3];
    own.contact = Contact::default();
    own.manipulator.links = None;
    own.manipulator.integrator = None;
    if own.manipulator.tendon_friction.is_some_and(|friction| friction <= MOST_TENDON_FRICTION) {
        own.manipulator.tendon_friction = None;
    }
    let acts_its_own_way = |tool: &ToolDescription| {
        tool.drive_shaft.is_some() || tool.burr.cutting_coefficient.is_some() || tool.outer_tube.is_some()
    };
    if own.manipulator.tool.as_ref().is_some_and(acts_its_own_way) {
        return false;
    }
    let mut standard = own.clone();
    standard.manipulator = Manipulator::default();
    standard.tendon.clear();
    match (manipulator_parameters(&own), manipulator_parameters(&standard)) {
        (Ok(own), Ok(standard)) => with_its_pair(own) == standard,
        _ => false,
    }
}

/// Two opposite tendons equal the standard tool's antagonistic pair.
fn with_its_pair(mut tool: ManipulatorParameters) -> ManipulatorParameters {
    let offset_m = tool.tendon_routes.as_deref().and_then(|routes| match routes {
        [one, other] => {
            let offset_m = one.channel_m[0];
            let alike = [offset_m, -offset_m].map(|x| TendonRoute::from([x, 0.0]));
            (alike == [one.clone(), other.clone()]).then_some(offset_m)
        }
        _ => None,
    });
    if let Some(offset_m) = offset_m {
        tool.tendon.offset_m = offset_m;
        tool.tendon_routes = None;
    }
    tool
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use std::path::Path;

    use super::*;

    fn scene(tool: &str, controller: &str) -> Scene {
        let text = format!(
            "name = \"load\"\n[run]\nmode = \"lockstep\"\nduration_s = \
             1.0\n[manipulator]\n{tool}\n[tool]\nburr_start_mm = [0.0, 0.0, 0.0]\n\
             direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n[[controller]]\nname \
             = \"a\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n{controller}"
        );
        Scene::parse(&text, Path::new("load.toml")).unwrap()
    }

    #[test]
    fn a_pull_is_gentle_if_no_controller_may_throw_a_flexure_against_its_stop() {
        let feed = |tension_n: f64| {
            format!(
                "[controller.curved_drilling]\nfeed_mm_per_s = 1.0\ninsertion_mm = 5.0\ntension_n = \
                 {tension_n:?}\nramp_end_mm = 3.0\nburr_speed_rpm = 0.0\nfeedback = \"none\"\n"
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
    fn a_tool_is_the_standard_one_by_what_it_is_and_not_by_what_it_is_called() {
        let hold = "hold = { tension_n = 6.0 }";
        for changed in [
            "stiffness_scale = 2.0",
            "mass_scale = 0.5",
            "damping_ratio = 0.01",
            "tendon_friction = 0.4",
            "mount_stiffness_n_per_m = 1e5",
            "notch_width_mm = 0.7",
            "lateral_stiffness_ratio = 2.0",
            "burr_diameter_mm = 6.0",
        ] {
            assert!(!is_standard_tool(&scene(changed, hold)), "{changed}");
        }
        let mut same = scene("tendon_friction = 0.3\nstiffness_scale = 1.0\nlinks = 9", hold);
        same.gravity_m_per_s2 = [0.0, 0.0, -9.81];
        assert!(is_standard_tool(&same));
        let file = |text: &str| ToolDescription::parse(text, Path::new("tool.toml")).unwrap();
        same.manipulator.tool = Some(file(include_str!("../../../../configs/tools/jhu_27.toml")));
        assert!(is_standard_tool(&same));
        same.manipulator.tool = Some(file(include_str!("../../../../configs/tools/two_segments.toml")));
        assert!(!is_standard_tool(&same));
        let mut stiffer = scene("", hold);
        stiffer.truth = Some(toml::from_str("manipulator = { stiffness_scale = 1.1 }").unwrap());
        assert!(!is_standard_tool(&stiffer), "the tool as it is counts");
    }
}
