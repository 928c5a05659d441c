//! Scenes that make no sense, each with what is said of it: exactly that, and nothing else.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use std::path::Path;

use nalgebra::Vector3;
use scene::Scene;
use simulation::bone::GridGeometry;
use simulation::{CtView, Verdict, findings};

/// A block of bone, 34 x 34 x 54 mm, centred at x = 100 mm: its lower face is at z = -27 mm. Voxels of 1 mm, some air around it.
const DIMS: [usize; 3] = [40, 40, 60];

/// A hole leads the whole tool to its start, 12 mm below the lower face.
const SENSIBLE: &str = r#"
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

const HOLE: &str =
    "[[predrill]]\nfrom_mm = [100.0, 0.0, -60.0]\nto_mm = [100.0, 0.0, -15.0]\ndiameter_mm = 7.0\n";

/// In place of the built-in controller.
fn driven_by(kind: &str) -> String {
    let at = SENSIBLE.find("[controller.curved_drilling]").unwrap();
    format!("{}{kind}\n", &SENSIBLE[..at])
}

fn found(text: &str, with_ct: bool) -> Vec<String> {
    let scene = Scene::parse(text, Path::new("a.toml")).unwrap();
    let geometry = GridGeometry::axis_aligned(DIMS, [1e-3; 3], Vector3::new(80.5e-3, -19.5e-3, -29.5e-3));
    let is_bone = |index: usize| {
        let [i, j, k] = [index % 40, index / 40 % 40, index / 1600];
        (3..37).contains(&i) && (3..37).contains(&j) && (3..57).contains(&k)
    };
    let hu: Vec<i16> =
        (0..geometry.voxel_count()).map(|index| if is_bone(index) { 300 } else { -1000 }).collect();
    let ct = with_ct.then_some(CtView { geometry, hu: &hu });
    let found = findings(&scene, ct, &|program| program == "python3").unwrap();
    let verdict = |verdict| if verdict == Verdict::Impossible { "impossible" } else { "unlikely" };
    found.iter().map(|finding| format!("{}: {finding}", verdict(finding.verdict))).collect()
}

#[test]
fn a_scene_that_makes_sense_is_accepted_in_silence() {
    assert_eq!(found(SENSIBLE, true), Vec::<String>::new());
    assert_eq!(found(&driven_by("command = [\"python3\", \"pilot.py\"]"), true), Vec::<String>::new());
}

#[test]
fn a_scene_that_makes_no_sense_is_told_so_exactly() {
    let changed = |from: &str, to: &str| {
        assert_eq!(SENSIBLE.matches(from).count(), 1, "{from}");
        SENSIBLE.replace(from, to)
    };
    let start =
        |place: &str| changed("burr_start_mm = [100.0, 0.0, -15.0]", &format!("burr_start_mm = {place}"));
    let without_target = |text: String| text.replace("target_mm = [103.0, 0.0, 4.0]\n", "");
    let target = |place: &str| changed("target_mm = [103.0, 0.0, 4.0]", &format!("target_mm = {place}"));
    let singular = "[arm]\ninitial_joints_deg = [0.0, -90.0, 0.0, -90.0, -90.0, 0.0]\n";
    let cases: [(&str, String, &[&str]); 22] = [
        (
            "the entry in metres",
            without_target(start("[0.1, 0.0, -0.015]")),
            &[
                "impossible: `tool.burr_start_mm` is [0.1, 0, -0.015], 79.7 mm from the nearest bone; a thousand times as much lies in the volume: expected millimetres, not metres",
                "impossible: `tool.burr_start_mm` puts the burr 79.7 mm from the nearest bone, allowed is at most 55.4: `controller.curved_drilling.insertion_mm` and the tool's flexible length",
            ],
        ),
        (
            "the tool a metre beside the bone",
            without_target(start("[1117.0, 0.0, -15.0]")),
            &[
                "impossible: `tool.burr_start_mm` puts the burr 996.8 mm from the nearest bone, allowed is at most 55.4: `controller.curved_drilling.insertion_mm` and the tool's flexible length",
            ],
        ),
        (
            "a metre beside the bone, driven by a program",
            driven_by("external = true").replace("burr_start_mm = [100.0,", "burr_start_mm = [1117.0,"),
            &["unlikely: `tool.burr_start_mm` puts the burr 996.8 mm from the nearest bone"],
        ),
        // The foremost sphere of the tube lies 3.4 mm behind the burr.
        (
            "no pilot hole",
            changed(HOLE, ""),
            &[
                "unlikely: `tool.burr_start_mm` puts the burr 12.0 mm inside bone; expected in front of it, or in a `[[predrill]]` hole",
                "unlikely: `tool.burr_start_mm` puts the shaft up to 8.6 mm inside bone; expected a `[[predrill]]` hole along it",
            ],
        ),
        (
            "a hole thinner than the tool",
            changed("diameter_mm = 7.0", "diameter_mm = 5.0"),
            &[
                "impossible: `predrill.diameter_mm` is 5, allowed is 6 to 50: the tool, 6.0 mm thick, starts in this hole",
            ],
        ),
        (
            "a hole thinner than the burr",
            changed("diameter_mm = 7.0", "diameter_mm = 6.2"),
            &[
                "unlikely: `predrill.diameter_mm` is 6.2: the burr, 6.5 mm, starts in this hole and touches its wall",
            ],
        ),
        (
            "a thin hole elsewhere",
            changed(
                HOLE,
                &format!(
                    "{HOLE}[[predrill]]\nfrom_mm = [110.0, 0.0, -60.0]\nto_mm = [110.0, 0.0, -15.0]\ndiameter_mm = 2.0\n"
                ),
            ),
            &[],
        ),
        (
            "a burr thinner than the tool",
            changed("[manipulator]\n", "[manipulator]\nburr_diameter_mm = 5.0\n"),
            &[
                "unlikely: `manipulator.burr_diameter_mm` is 5: the shaft, 6.0 mm, does not follow a burr of 5.0",
            ],
        ),
        (
            "a threshold without bone",
            changed("phantom = \"block\"\n", "phantom = \"block\"\nbone_threshold_hu = 1500\n"),
            &[
                "impossible: `volume.bone_threshold_hu` is 1500, allowed is -1000 to 300, the volume's largest value: there is no bone to drill",
            ],
        ),
        (
            "a threshold without bone, and nobody drills",
            driven_by("hold = { tension_n = 1.0 }")
                .replace("phantom = \"block\"\n", "phantom = \"block\"\nbone_threshold_hu = 1500\n"),
            &[
                "unlikely: `volume.bone_threshold_hu` is 1500, and the largest value is 300 HU: there is no bone to drill",
            ],
        ),
        (
            "a singular start",
            changed("[arm]\n", singular),
            &[
                "impossible: `arm.initial_joints_deg` is singular (manipulability 0.0e0 m³, allowed is 1e-4 or more): the arm cannot insert from there",
            ],
        ),
        (
            "a singular start, driven by a program",
            driven_by("external = true").replace("[arm]\n", singular),
            &[
                "unlikely: `arm.initial_joints_deg` is singular (manipulability 0.0e0 m³, a path needs 1e-4): only joint commands work from there",
            ],
        ),
        (
            "a target behind the start",
            target("[100.0, 0.0, -20.0]"),
            &[
                "impossible: `controller.curved_drilling.target_mm` lies 5.0 mm behind the start, allowed is 0 to 20 ahead (`insertion_mm`)",
            ],
        ),
        (
            "a target too far ahead",
            target("[100.0, 0.0, 25.0]"),
            &[
                "impossible: `controller.curved_drilling.target_mm` lies 40.0 mm ahead of the start, allowed is 0 to 20 (`insertion_mm`)",
            ],
        ),
        (
            "a target too far beside",
            target("[140.0, 0.0, 0.0]"),
            &[
                "impossible: `controller.curved_drilling.target_mm` lies 40.0 mm beside the line of the feed, allowed is 0 to 35.4 (the tool's flexible length)",
            ],
        ),
        // Half a circle of radius 10 mm: 15.7 mm for a quarter of it.
        (
            "an arc longer than the insertion",
            target("[115.0, 0.0, 0.0]"),
            &[
                "unlikely: `controller.curved_drilling.insertion_mm` is 20; the arc to `target_mm` is 23.6 mm long",
            ],
        ),
        (
            "an insertion that takes longer than the run",
            changed("duration_s = 4.0", "duration_s = 2.0"),
            &["unlikely: `run.duration_s` is 2; `controller.curved_drilling` needs 2.5 s"],
        ),
        (
            "a sweep that takes longer than the run",
            driven_by("tension_sweep = { most_n = 5.0, step_n = 1.0 }"),
            &["unlikely: `run.duration_s` is 4; `controller.tension_sweep` needs 5.5 s"],
        ),
        (
            "a body inside the tool",
            changed("position_mm = [130.0, 0.0, -60.0]", "position_mm = [104.0, 0.0, -60.0]"),
            &["impossible: `body.position_mm` puts `clamp` 1.0 mm into the tool, allowed is at most 0.1"],
        ),
        (
            "a frame rate that is rounded",
            changed("rate_hz = 5.0", "rate_hz = 7.0"),
            &["unlikely: `drr.rate_hz` is 7; a frame every 143 ticks of 1 ms is 6.993 Hz"],
        ),
        (
            "a frame rate above that of the ticks",
            changed("rate_hz = 5.0", "rate_hz = 100.0")
                .replace("duration_s = 4.0", "duration_s = 4.0\ndt_ms = 10.0")
                .replace("rate_hz = 100.0", "rate_hz = 60.0"),
            &["unlikely: `drr.rate_hz` is 60; a frame every 2 ticks of 10 ms is 50.000 Hz"],
        ),
        (
            "a program that does not exist",
            driven_by("command = [\"pyhton3\", \"pilot.py\"]"),
            &[
                "impossible: `controller.command` of `reference` is `pyhton3`, expected a program: a path to an executable file, or a name found in PATH",
            ],
        ),
    ];
    for (what, text, expected) in cases {
        assert_eq!(found(&text, true), expected, "{what}");
    }
}

/// `trabecula plan` reads no volume: what does not depend on bone is checked all the same.
#[test]
fn without_a_volume_the_rules_that_need_none_hold() {
    let text =
        SENSIBLE.replace("diameter_mm = 7.0", "diameter_mm = 5.0").replace("rate_hz = 5.0", "rate_hz = 7.0");
    assert_eq!(
        found(&text, false),
        ["unlikely: `drr.rate_hz` is 7; a frame every 143 ticks of 1 ms is 6.993 Hz"]
    );
}
