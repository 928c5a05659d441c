//! Tests of tool files: where tools are kept, and what is refused.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by it")]

use std::path::Path;

use scene::{Cutter, ManipulatorRung, Scene, SceneError, ToolDescription};

const TOOL: &str = "name = \"drill\"
[tube]
outer_diameter_mm = 6.0
inner_diameter_mm = 4.0
linear_density_kg_per_m = 0.1
[burr]
diameter_mm = 8.0
offset_mm = 4.0
mass_g = 1.0
[[tendon]]
toward_mm = 2.5
[[flexure]]
at_mm = 36.0
stiffness_nm_per_deg = 0.01
[[flexure]]
at_mm = 38.0
length_mm = 1.5
stiffness_nm_per_deg = 0.01
[[flexure]]
at_mm = 40.0
count = 5
pitch_mm = 2.0
stiffness_nm_per_deg = 0.01
";

const SCENE: &str = "name = \"a\"
run = { mode = \"lockstep\", duration_s = 1.0 }
tool = { burr_start_mm = [0.0, 0.0, 0.0], direction = [1.0, 0.0, 0.0], bend_toward = [0.0, 0.0, 1.0] }
[manipulator]
file = \"tools/drill.toml\"
";

fn scene(scene: &str, tool: &str) -> Result<Scene, SceneError> {
    let read = |path: &Path| {
        assert_eq!(path, Path::new("/scenes/tools/drill.toml"), "relative to the scene's file");
        Ok(tool.to_owned())
    };
    Scene::parse_with(scene, Path::new("/scenes/a.toml"), &read)
}

#[test]
fn a_scene_holds_its_tool_and_reads_as_the_same_without_the_file() {
    let first = scene(SCENE, TOOL).unwrap();
    assert_eq!(first.manipulator.file, None, "what a log keeps needs no other file");
    let tool = first.manipulator.tool.as_ref().unwrap();
    assert_eq!(
        tool.flexures().iter().map(|it| it.at_mm).collect::<Vec<_>>(),
        [36.0, 38.0, 40.0, 42.0, 44.0, 46.0, 48.0]
    );
    assert_eq!(
        (first.manipulator.radii().tube_outer_m, first.manipulator.radii().cutter),
        (3e-3, Cutter::ball(4e-3))
    );
    let again = Scene::parse(&toml::to_string(&first).unwrap(), Path::new("log")).unwrap();
    assert_eq!(again, first);
    let overridden = scene(&format!("{SCENE}burr_diameter_mm = 7.0\n"), TOOL).unwrap();
    assert_eq!(overridden.manipulator.radii().cutter, Cutter::ball(3.5e-3));
}

/// The pilot hole of a plan must not be as wide as the standard tool's burr.
#[test]
fn the_pilot_hole_of_a_plan_is_as_wide_as_the_described_burr() {
    let plan = r#"{"markups": [{"type": "Fiducial", "coordinateSystem": "RAS", "controlPoints": [
        {"label": "entry", "position": [10, 0, 0]}, {"label": "target", "position": [10, 0, 55]}]}]}"#;
    let text = "name = \"a\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }\nvolume = { phantom \
                = \"block\" }\n\
                tool = { plan = \"p.json\", bend_toward = [1.0, 0.0, 0.0] }\nmanipulator = { file \
                = \"t.toml\" }\n";
    let read = |path: &Path| Ok(if path.ends_with("p.json") { plan } else { TOOL }.to_owned());
    let scene = Scene::parse_with(text, Path::new("/scenes/a.toml"), &read).unwrap();
    assert!((scene.predrill[0].diameter_mm - 8.5).abs() < 1e-12, "{}", scene.predrill[0].diameter_mm);
}

/// Each inconsistent tool: what is changed, and the resulting message.
#[test]
fn a_tool_that_cannot_stand_is_refused_with_file_key_value_and_range() {
    for (from, to, said) in [
        (
            "stiffness_nm_per_deg = 0.01",
            "stiffness_nm_per_deg = -0.01",
            "`flexure.stiffness_nm_per_deg` is -0.01; allowed: 0.000001 to 10000",
        ),
        (
            "linear_density_kg_per_m = 0.1",
            "linear_density_kg_per_m = nan",
            "`tube.linear_density_kg_per_m` is NaN; allowed: 0.0001 to 10",
        ),
        (
            "at_mm = 38.0",
            "at_mm = 36.5",
            "`flexure[1].at_mm` puts a flexure at 36.5; allowed: 36.75 or more, so that it does not overlap \
             the one before",
        ),
        ("at_mm = 38.0", "at_mm = 39.5", "`flexure[2].at_mm` puts a flexure at 40; allowed: 40.25 or more"),
        ("at_mm = 38.0", "at_mm = 20.0", "`flexure[1].at_mm` puts a flexure at 20; allowed: 36.75 or more"),
        (
            "toward_mm = 2.5",
            "toward_mm = 2.5\nto_flexure = 8",
            "`tendon[0].to_flexure` is 8; allowed: 1 to 7",
        ),
        (
            "toward_mm = 2.5",
            "toward_mm = 2.5\nfrom_flexure = 5\nto_flexure = 4",
            "`tendon[0].to_flexure` is 4; allowed: 5 to 7",
        ),
        (
            "toward_mm = 2.5",
            "toward_mm = 2.5\ntwist_deg_per_mm = -30.0",
            "`tendon[0].twist_deg_per_mm` is -30; allowed: -22.5 to 22.5",
        ),
        (
            "offset_mm = 4.0",
            "offset_mm = 0.9",
            "`burr.offset_mm` is 0.9; allowed: 1 to 500, so that the cutter lies outside the tube",
        ),
        (
            "inner_diameter_mm = 4.0",
            "inner_diameter_mm = 6.5",
            "`tube.inner_diameter_mm` is 6.5; allowed: 0 to 5.98",
        ),
        (
            "inner_diameter_mm = 4.0",
            "inner_diameter_mm = 4.0\ndrive_cable_diameter_mm = 5.0",
            "`tube.drive_cable_diameter_mm` is 5; allowed: 0 to 4",
        ),
        ("pitch_mm = 2.0\n", "", "`flexure[2].pitch_mm` is missing; `count` is 5"),
        ("count = 5", "count = 31", "`flexure (count)` is 33; allowed: 1 to 32"),
        (
            "pitch_mm = 2.0\nstiffness_nm_per_deg = 0.01\n",
            "pitch_mm = 2.0\n",
            "`flexure[2].stiffness_nm_per_deg` is missing; set it, or `tube.youngs_modulus_gpa`",
        ),
        ("count = 5", "count = 5\nnotch_width_mm = 0.7", "`flexure[2].notch_past_axis_mm` is missing"),
        (
            "count = 5",
            "count = 5\nnotch_width_mm = 2.5\nnotch_past_axis_mm = 1.3",
            "`flexure[2].notch_width_mm` is 2.5; allowed: 0.05 to 1.9",
        ),
        (
            "count = 5",
            "count = 5\nnotch_width_mm = 0.7\nnotch_past_axis_mm = 0.9",
            "`flexure[2].notch_past_axis_mm` is 0.9; allowed: 0.35 to 0.85",
        ),
        ("[burr]", "[shaft]\ncontact_to_mm = 37.0\n[burr]", "`shaft.contact_to_mm` is 37; allowed: 0 to 36"),
        (
            "diameter_mm = 8.0",
            "shape = \"cylinder\"\ndiameter_mm = 8.0",
            "`burr.length_mm` is missing; required for shapes other than a ball",
        ),
        (
            "diameter_mm = 8.0",
            "length_mm = 9.0\ndiameter_mm = 8.0",
            "`burr.length_mm` applies only to shapes other than a ball; `burr.shape` is different",
        ),
        (
            "diameter_mm = 8.0",
            "shape = \"cylinder\"\npoint_deg = 118.0\nlength_mm = 9.0\ndiameter_mm = 8.0",
            "`burr.point_deg` applies only to a bit; `burr.shape` is different",
        ),
        (
            "diameter_mm = 8.0",
            "rake_deg = 20.0\ndiameter_mm = 8.0",
            "`burr.rake_deg` applies only to a bit; `burr.shape` is different",
        ),
        (
            "diameter_mm = 8.0",
            "scallop_mm = 0.1\ndiameter_mm = 8.0",
            "`burr.scallop_mm` applies only to shapes other than a ball; `burr.shape` is different",
        ),
        (
            "diameter_mm = 8.0",
            "shape = \"cylinder\"\nlength_mm = 8.05\ndiameter_mm = 8.0",
            "`burr.length_mm` is 8.05; allowed: 8.1 to 60",
        ),
        (
            "diameter_mm = 8.0",
            "shape = \"cone\"\nlength_mm = 8.0\ntip_diameter_mm = 2.0\ndiameter_mm = 8.0",
            "`burr.length_mm` is 8; allowed: 8.4 to 60",
        ),
        (
            "diameter_mm = 8.0",
            "shape = \"cone\"\nlength_mm = 12.0\ntip_diameter_mm = 8.0\ndiameter_mm = 8.0",
            "`burr.tip_diameter_mm` is 8; allowed: 0.1 to 7.95",
        ),
        (
            "diameter_mm = 8.0",
            "shape = \"bit\"\nlength_mm = 5.0\ntip_diameter_mm = 2.0\npoint_deg = 90.0\ndiameter_mm = 8.0",
            "`burr.length_mm` is 5; allowed: 9.34",
        ),
        (
            "diameter_mm = 8.0",
            "shape = \"cylinder\"\nlength_mm = 50.0\nscallop_mm = 0.01\ndiameter_mm = 8.0",
            "`burr.scallop_mm` is 0.01, which takes 76 balls; allowed: 16",
        ),
        (
            "diameter_mm = 8.0\noffset_mm = 4.0",
            "shape = \"cylinder\"\nlength_mm = 13.0\ndiameter_mm = 8.0\noffset_mm = 5.0",
            "`burr.offset_mm` is 5; allowed: 6 to 500, so that the cutter lies outside the tube",
        ),
        (
            "[burr]",
            "[outer_tube]\nend_mm = 40\nouter_diameter_mm = 7\ninner_diameter_mm = 6\ntravel_mm = 9\n[burr]",
            "`tendon` and `outer_tube` are mutually exclusive",
        ),
        (
            "[burr]",
            "[outer_tube]\nend_mm = 35\nouter_diameter_mm = 7\ninner_diameter_mm = 6\ntravel_mm = 9\n[burr]",
            "`outer_tube.end_mm` is 35; allowed: 36 to 52",
        ),
        (
            "[burr]",
            "[outer_tube]\nend_mm = 40\nouter_diameter_mm = 6\ninner_diameter_mm = 6\ntravel_mm = 9\n[burr]",
            "`outer_tube.outer_diameter_mm` is 6; allowed: 6.02 to 30",
        ),
        (
            "[burr]",
            "[outer_tube]\nend_mm = 40\nouter_diameter_mm = 7\ninner_diameter_mm = 5.9\ntravel_mm = \
             9\n[burr]",
            "`outer_tube.inner_diameter_mm` is 5.9; allowed: 6 to 6.98",
        ),
        (
            "[burr]",
            "[outer_tube]\nend_mm = 40\nouter_diameter_mm = 7\ninner_diameter_mm = 6\ntravel_mm = \
             900\n[burr]",
            "`outer_tube.travel_mm` is 900; allowed: 0.1 to 500",
        ),
        ("[burr]", "[ball]", "line 6: `ball`: unknown field `ball`"),
        ("name = \"drill\"", "name = \"a b\"", "`name` is \"a b\"; expected 1 to 64 letters"),
        (
            "diameter_mm = 8.0",
            "diameter_mm = \"8\"",
            "`burr.diameter_mm`: invalid type: string \"8\", expected a number",
        ),
    ] {
        assert!(TOOL.contains(from), "{from}");
        // For keys that occur several times, the last flexures.
        let changed = match from.starts_with("pitch_mm") || from.starts_with("count") {
            true => TOOL.replace(from, to),
            false => TOOL.replacen(from, to, 1),
        };
        let refused = scene(SCENE, &changed).unwrap_err().to_string();
        assert!(
            refused.starts_with("/scenes/tools/drill.toml") && refused.contains(said),
            "{refused}\nis not\n{said}"
        );
        if refused.contains("line ") {
            continue;
        }
        // The same inside the scene itself.
        let tool: toml::Value = toml::from_str(&changed).unwrap();
        let mut inline: toml::Table =
            toml::from_str(&SCENE.replace("file = \"tools/drill.toml\"", "")).unwrap();
        inline["manipulator"].as_table_mut().unwrap().insert("tool".to_owned(), tool);
        let refused =
            Scene::parse(&toml::to_string(&inline).unwrap(), Path::new("a.toml")).unwrap_err().to_string();
        let said = said.replacen('`', "`manipulator.tool.", 1);
        assert!(refused.starts_with("a.toml: ") && refused.contains(&said), "{refused}\nis not\n{said}");
    }
}

#[test]
fn what_a_scene_says_beside_a_tool_file_must_go_with_it() {
    for (more, said) in [
        ("notch_width_mm = 0.7\n", "a.toml: `manipulator.notch_width_mm` applies only to the standard tool"),
        ("[[tendon]]\ntoward_mm = 2.0\n", "a.toml: `tendon` applies only to the standard tool"),
        (
            "[manipulator.tool]\nname = \"b\"\n",
            "a.toml: `manipulator.file` and `manipulator.tool` are mutually exclusive; set only one",
        ),
    ] {
        let refused = scene(&format!("{SCENE}{more}"), TOOL).unwrap_err().to_string();
        assert!(refused.contains(said), "{refused}\nis not\n{said}");
    }
    let cylinder = TOOL.replace(
        "diameter_mm = 8.0\noffset_mm = 4.0",
        "shape = \"cylinder\"\nlength_mm = 9.0\ndiameter_mm = 8.0\noffset_mm = 4.0",
    );
    let refused = scene(&format!("{SCENE}burr_diameter_mm = 7.0\n"), &cylinder).unwrap_err().to_string();
    assert!(
        refused.contains("a.toml: `manipulator.burr_diameter_mm` applies only to a ball burr"),
        "{refused}"
    );
    let bit = TOOL.replace(
        "diameter_mm = 8.0\noffset_mm = 4.0",
        "shape = \"bit\"\nlength_mm = 12.0\ntip_diameter_mm = 2.0\npoint_deg = 118.0\ndiameter_mm = \
         8.0\noffset_mm = 20.0",
    );
    let law = format!("{SCENE}[drilling]\nlaw = \"twist_drill\"\n");
    assert!(scene(&law, &bit).is_ok());
    let refused = scene(&law, &cylinder).unwrap_err().to_string();
    assert!(refused.contains("`drilling.law` is `twist_drill`, which needs a tool"), "{refused}");
    let refused = scene(&SCENE.replace("\"tools/drill.toml\"", "7"), TOOL).unwrap_err().to_string();
    assert!(refused.contains("`manipulator.file` is 7, expected a path as a string"), "{refused}");
    let unreadable = |_: &Path| Err(std::io::Error::other("no such file"));
    let refused = Scene::parse_with(SCENE, Path::new("/scenes/a.toml"), &unreadable).unwrap_err().to_string();
    assert_eq!(
        refused,
        "/scenes/a.toml: `manipulator.file` names /scenes/tools/drill.toml, which cannot be read (no such \
         file)"
    );
    assert!(Scene::parse(SCENE, Path::new("a.toml")).is_err(), "a log names no file");
}

/// A model that is invalid for a tool is refused by name.
#[test]
fn a_rung_whose_assumptions_a_tool_breaks_is_refused() {
    let arc = format!("{SCENE}model = \"constant_curvature\"\n");
    assert_eq!(scene(&arc, TOOL).unwrap().manipulator.model, Some(ManipulatorRung::ConstantCurvature));
    let half = TOOL.replace("toward_mm = 2.5", "toward_mm = 2.5\nto_flexure = 3");
    let refused = scene(&arc, &half).unwrap_err().to_string();
    assert!(
        refused.contains(
            "`manipulator.model` is constant_curvature, a single arc; tendon 1 of `drill` bends only part"
        ),
        "{refused}"
    );
    let bent = TOOL.replacen("stiffness_nm_per_deg", "rest_deg = 2.0\nstiffness_nm_per_deg", 1);
    let refused = scene(&arc, &bent).unwrap_err().to_string();
    assert!(refused.contains("`drill` is not pre-curved to one radius"), "{refused}");
    assert!(
        scene(&arc, &TOOL.replace("stiffness_nm_per_deg", "rest_deg = 2.0\nstiffness_nm_per_deg")).is_ok()
    );
    let wound = TOOL.replace("toward_mm = 2.5", "toward_mm = 2.5\ntwist_deg_per_mm = 3.0");
    for model in ["planar", "constant_curvature"] {
        let refused = scene(&format!("{SCENE}model = \"{model}\"\n"), &wound).unwrap_err().to_string();
        let said = "`manipulator.tool.tendon.twist_deg_per_mm` bends the tool out of the plane; set \
                    `manipulator.model` to spatial or full";
        assert!(refused.contains(said), "{refused}");
    }
    assert!(scene(&format!("{SCENE}model = \"spatial\"\n"), &wound).is_ok());
    let across = TOOL.replace("toward_mm = 2.5", "toward_mm = 2.5\nacross_mm = 1.0");
    for flat in ["", "model = \"planar\"\n", "model = \"constant_curvature\"\n"] {
        let refused = scene(&format!("{SCENE}{flat}"), &across).unwrap_err().to_string();
        assert!(
            refused.contains("`manipulator.tool.tendon.across_mm` bends the tool out of the plane"),
            "{refused}"
        );
    }
    assert!(scene(&format!("{SCENE}model = \"spatial\"\n"), &across).is_ok());
}

/// Smooth moments cannot jump where a tendon ends; `modes` applies only to the modal model.
#[test]
fn moment_modes_are_refused_where_a_tool_bends_in_parts() {
    let modal = format!("{SCENE}model = \"modal\"\nmodes = 4\n");
    assert_eq!(scene(&modal, TOOL).unwrap().manipulator.modes, Some(4));
    let half = TOOL.replace("toward_mm = 2.5", "toward_mm = 2.5\nto_flexure = 3");
    let refused = scene(&modal, &half).unwrap_err().to_string();
    let said = "`manipulator.model` is modal, which needs smooth bending moments; tendon 1 of `drill` bends \
                only part";
    assert!(refused.contains(said), "{refused}");
    let refused = scene(&format!("{SCENE}modes = 4\n"), TOOL).unwrap_err().to_string();
    assert!(refused.contains("`manipulator.modes` applies only to the modal model"), "{refused}");
    let refused = scene(&modal.replace("modes = 4", "modes = 9"), TOOL).unwrap_err().to_string();
    assert!(refused.contains("`manipulator.modes` is 9; allowed: 2 to 8"), "{refused}");
    let across = TOOL.replace("toward_mm = 2.5", "toward_mm = 2.5\nacross_mm = 1.0");
    let refused = scene(&modal, &across).unwrap_err().to_string();
    assert!(refused.contains("bends the tool out of the plane"), "{refused}");
}

#[test]
fn a_tool_file_alone_is_read_by_the_same_rules() {
    assert_eq!(ToolDescription::parse(TOOL, Path::new("t.toml")).unwrap().name, "drill");
    let refused = ToolDescription::parse("name = \"a\"", Path::new("t.toml")).unwrap_err().to_string();
    assert!(refused.contains("t.toml") && refused.contains("missing field `tube`"), "{refused}");
}
