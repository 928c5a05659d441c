//! A feasible scene, and changes to it.

/// A hole leads the whole tool to its start, 12 mm inside the block from its lower face.
pub const SENSIBLE: &str = r#"
name = "sensible"
[run]
mode = "lockstep"
duration_s = 4.0
[volume]
phantom = "block"
[[predrill]]
from_mm = [100.0, 0.0, -60.0]
to_mm = [100.0, 0.0, -15.0]
diameter_mm = 7.0
[tool]
burr_start_mm = [100.0, 0.0, -15.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[manipulator]
[arm]
[drr]
rate_hz = 5.0
isocentre_mm = [100.0, 0.0, 0.0]
columns = 16
rows = 16
pixel_pitch_mm = 1.0
[[body]]
name = "clamp"
cuboid = { half_extents_mm = [2.0, 2.0, 2.0] }
motion = "fixed"
position_mm = [130.0, 0.0, -60.0]
[[controller]]
name = "reference"
drives = ["tendon", "arm", "burr"]
[controller.curved_drilling]
feed_mm_per_s = 8.0
insertion_mm = 20.0
tension_n = 6.0
ramp_end_mm = 15.0
burr_speed_rpm = 8000.0
target_mm = [103.0, 0.0, 4.0]
feedback = "none"
"#;

pub const HOLE: &str =
    "[[predrill]]\nfrom_mm = [100.0, 0.0, -60.0]\nto_mm = [100.0, 0.0, -15.0]\ndiameter_mm = 7.0\n";

/// A scene and its expected findings.
pub struct Case {
    pub what: &'static str,
    pub text: String,
    /// Centre of the block along x.
    pub centre_x_mm: f64,
    pub expected: &'static [&'static str],
}

pub fn case(what: &'static str, text: String, expected: &'static [&'static str]) -> Case {
    Case { what, text, centre_x_mm: 100.0, expected }
}

impl Case {
    pub fn with_bone_at(self, centre_x_mm: f64) -> Case {
        Case { centre_x_mm, ..self }
    }
}

/// Replaces text that occurs in a scene exactly once.
pub fn changed_in(text: &str, from: &str, to: &str) -> String {
    assert_eq!(text.matches(from).count(), 1, "{from}");
    text.replace(from, to)
}

pub fn changed(from: &str, to: &str) -> String {
    changed_in(SENSIBLE, from, to)
}

/// Replaces the built-in controller.
pub fn driven_by(kind: &str) -> String {
    let at = SENSIBLE.find("[controller.curved_drilling]").unwrap();
    format!("{}{kind}\n", &SENSIBLE[..at])
}

/// Sets this target, or removes it.
pub fn target(place: Option<&str>) -> String {
    let line = place.map_or_else(String::new, |place| format!("target_mm = {place}\n"));
    changed("target_mm = [103.0, 0.0, 4.0]\n", &line)
}

/// Sets this start, and removes the target and hole that would have to fit it.
pub fn start(place: &str) -> String {
    let bare = changed_in(&target(None), HOLE, "");
    changed_in(&bare, "burr_start_mm = [100.0, 0.0, -15.0]", &format!("burr_start_mm = {place}"))
}

/// Sets this start, driven by another controller.
pub fn start_driven_by(place: &str, kind: &str) -> String {
    let bare = changed_in(&driven_by(kind), HOLE, "");
    changed_in(&bare, "burr_start_mm = [100.0, 0.0, -15.0]", &format!("burr_start_mm = {place}"))
}
