//! Infeasible scenes, each with the exact list of expected findings.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

mod plans;
mod ranges;
mod scene_text;
mod starts;

use std::path::Path;

use nalgebra::Vector3;
use scene::Scene;
use scene_text::{Case, SENSIBLE, driven_by};
use simulation::bone::GridGeometry;
use simulation::{CtView, Verdict, findings};
use test_support::scenes::TOOL;

/// A block of bone, 34 x 34 x 54 mm: its lower face is at z = -27 mm, and it is centred at y = 0 and the
/// case's x. Voxels of 1 mm, some air around it.
const DIMS: [usize; 3] = [40, 40, 60];

fn found(text: &str, centre_x_mm: Option<f64>) -> Vec<String> {
    let scene = Scene::parse(text, Path::new("a.toml")).unwrap();
    let first_x_m = 1e-3 * (centre_x_mm.unwrap_or_default() - 19.5);
    let geometry = GridGeometry::axis_aligned(DIMS, [1e-3; 3], Vector3::new(first_x_m, -19.5e-3, -29.5e-3));
    let is_bone = |index: usize| {
        let [i, j, k] = [index % 40, index / 40 % 40, index / 1600];
        (3..37).contains(&i) && (3..37).contains(&j) && (3..57).contains(&k)
    };
    let hu: Vec<i16> =
        (0..geometry.voxel_count()).map(|index| if is_bone(index) { 300 } else { -1000 }).collect();
    let ct = centre_x_mm.map(|_| CtView { geometry, hu: &hu });
    let found = findings(&scene, ct, &|program| program == "python3").unwrap();
    let verdict = |verdict| if verdict == Verdict::Impossible { "impossible" } else { "unlikely" };
    found.iter().map(|finding| format!("{}: {finding}", verdict(finding.verdict))).collect()
}

#[test]
fn a_scene_that_makes_sense_is_accepted_in_silence() {
    assert_eq!(found(SENSIBLE, Some(100.0)), Vec::<String>::new());
    assert_eq!(found(&driven_by("command = [\"python3\", \"pilot.py\"]"), Some(100.0)), Vec::<String>::new());
}

/// Before these checks, every one of these scenes ran to "completed" with exit code 0; those just inside a
/// bound still do.
#[test]
fn every_scene_that_makes_no_sense_is_told_so_exactly_and_none_inside_the_bounds() {
    let cases: Vec<Case> = starts::cases().into_iter().chain(plans::cases()).collect();
    let wrong = cases.iter().filter_map(|Case { what, text, centre_x_mm, expected }| {
        let said = found(text, Some(*centre_x_mm));
        (said != *expected).then(|| format!("{what}: {said:#?}, expected {expected:#?}"))
    });
    let wrong: Vec<String> = wrong.collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    let mut names: Vec<&str> = cases.iter().map(|case| case.what).collect();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), cases.len(), "duplicate case name");
}

/// `trabecula plan` reads no volume; checks that do not depend on bone still apply.
#[test]
fn without_a_volume_the_rules_that_need_none_hold() {
    let text =
        SENSIBLE.replace("diameter_mm = 7.0", "diameter_mm = 5.0").replace("rate_hz = 5.0", "rate_hz = 7.0");
    assert_eq!(
        found(&text, None),
        ["unlikely: `drr.rate_hz` is 7, but a frame every 143 ticks of 1 ms is 6.993 Hz"]
    );
}

/// From the tools' stability map: only the hybrid integrator with a pre-curved tool, above 2 ms.
#[test]
fn a_long_step_is_told_of_a_pre_curved_tool_alone_and_not_of_the_other_integrator() {
    let said = |file: &str, keys: &str, dt_ms: f64| {
        let text = format!(
            "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\ndt_ms = {dt_ms:?}\n[manipulator]\n\
             file = \"{file}.toml\"\n{keys}\n{TOOL}"
        );
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/tools/scene.toml");
        let scene = Scene::parse_with(&text, &path, &|file| std::fs::read_to_string(file)).unwrap();
        findings(&scene, None, &|_| true).unwrap()
    };
    let found = said("steerable_drill", "", 5.0);
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!((found[0].verdict, found[0].key), (Verdict::Unlikely, "manipulator.integrator"));
    assert!(found[0].problem.contains("`run.dt_ms` = 5, expected at most 2 ms"), "{}", found[0]);
    for (file, keys, dt_ms) in [
        ("steerable_drill", "", 2.0),
        ("steerable_drill", "integrator = \"linearly_implicit_euler\"", 5.0),
        ("two_segments", "", 5.0),
    ] {
        assert_eq!(said(file, keys, dt_ms), [], "{file}, {keys}, {dt_ms} ms");
    }
}

/// Regression: a misplaced decimal point pulled on a lever three times as long, without a warning.
#[test]
fn a_tendon_outside_of_the_tube_is_told_and_one_in_its_wall_is_not() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/tools");
    let said = |toward_mm: &str| {
        let text = format!(
            "name = \"a\"\nrun = {{ mode = \"lockstep\", duration_s = 1.0 }}\n[manipulator]\n\
             file = \"jhu_27.toml\"\nmodel = \"spatial\"\n{TOOL}"
        );
        let read = |file: &Path| Ok(std::fs::read_to_string(file)?.replace("toward_mm = -2.5", toward_mm));
        let scene = Scene::parse_with(&text, &folder.join("scene.toml"), &read).unwrap();
        findings(&scene, None, &|_| true).unwrap()
    };
    assert_eq!(said("toward_mm = -2.5"), []);
    assert_eq!(said("toward_mm = -1.8\nacross_mm = 2.4"), []);
    for toward in ["toward_mm = -8.5", "toward_mm = -2.5\nacross_mm = 2.5"] {
        let found = said(toward);
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!((found[0].verdict, found[0].key), (Verdict::Unlikely, "manipulator.tool.tendon"));
        assert!(
            found[0].problem.starts_with("2 is ") && found[0].problem.contains("3.00 mm"),
            "{}",
            found[0]
        );
    }
}

/// Moment modes cannot represent flexures on their stops; the softest flexure of the standard tool reaches
/// its stop at 10.7 N.
#[test]
fn modes_are_told_of_stops_that_the_controllers_may_reach() {
    let said = |keys: &str, pull: &str| {
        let tool = TOOL.replace("external = true", pull);
        let text = format!(
            "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[manipulator]\n{keys}\n{tool}"
        );
        let scene = Scene::parse(&text, Path::new("a.toml")).unwrap();
        findings(&scene, None, &|_| true).unwrap()
    };
    for (pull, asked) in [("hold = { tension_n = 11.0 }", "up to 11 N"), ("external = true", "any tension")] {
        let found = said("model = \"modal\"", pull);
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!((found[0].verdict, found[0].key), (Verdict::Unlikely, "manipulator.model"));
        assert!(
            found[0].problem.contains("above 10.7 N") && found[0].problem.contains(asked),
            "{}",
            found[0]
        );
    }
    for (keys, pull) in
        [("model = \"modal\"", "hold = { tension_n = 10.5 }"), ("model = \"planar\"", "external = true")]
    {
        assert_eq!(said(keys, pull), [], "{keys}, {pull}");
    }
}
