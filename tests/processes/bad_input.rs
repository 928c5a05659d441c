//! Bad input: one clear error with file, key and allowed range, exit code 2, and nothing written.

use std::fs;

use crate::common::program::{Place, trabecula};
use crate::common::scenes;

/// Runs a scene that must be refused with all these words, and looks that nothing has been written.
fn assert_refused_in(place: &Place, words: &[&str]) {
    let before = place.entries();
    let done = trabecula(&[&"run", &place.path("scene.toml"), &"--output", &place.path("out"), &"--quiet"]);
    assert_eq!(done.code, Some(2), "{}{}", done.out, done.err);
    assert!(words.iter().all(|word| done.err.contains(word)), "{words:?} in: {}", done.err);
    assert_eq!(done.err.matches("trabecula: ").count(), 1, "one error: {}", done.err);
    assert_eq!(done.out, "");
    assert_eq!(place.entries(), before, "something was written");
}

fn assert_refused(change: impl FnOnce(String) -> String, words: &[&str]) {
    let place = Place::new();
    let (scene, changed) = (scenes::drill("lockstep", 1.0), change(scenes::drill("lockstep", 1.0)));
    assert_ne!(scene, changed, "the scene is as it was");
    place.scene(&changed);
    assert_refused_in(&place, words);
    let check = trabecula(&[&"scene", &"check", &place.path("scene.toml")]);
    assert_eq!(check.code, Some(2), "{}", check.out);
    assert!(words.iter().all(|word| check.err.contains(word)), "{words:?} in: {}", check.err);
}

#[test]
fn an_unknown_key_is_named_with_its_line() {
    assert_refused(
        |scene| scene.replace("seed = 7", "sead = 7"),
        &["scene.toml, line 5", "`sead`", "expected", "`seed`"],
    );
}

#[test]
fn a_key_in_another_unit_is_named() {
    assert_refused(
        |scene| scene.replace("feed_mm_per_s = 8.0", "feed_m_per_s = 0.008"),
        &["scene.toml, line", "`feed_m_per_s`", "`feed_mm_per_s`"],
    );
}

#[test]
fn a_value_out_of_range_is_named_with_the_range() {
    assert_refused(
        |scene| scene.replace("feed_mm_per_s = 8.0", "feed_mm_per_s = 2000.0"),
        &["scene.toml", "`controller.curved_drilling.feed_mm_per_s` is 2000", "allowed is 0.01 to 20"],
    );
    assert_refused(
        |scene| scene.replace("duration_s = 1.0", "duration_s = nan"),
        &["scene.toml", "`run.duration_s` is NaN", "allowed is 0.001 to 86400"],
    );
}

/// A tool that cannot stand: one error with file, key, value and range, and nothing starts. Every rule: `crates/scene/tests/scenes/tools.rs`.
#[test]
fn a_tool_that_cannot_stand_is_named_with_its_file() {
    let shipped =
        fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/configs/tools/two_segments.toml")).unwrap();
    for (from, to, words) in [
        (
            "pitch_mm = 1.3",
            "pitch_mm = 1.3\nstiffness_nm_per_deg = -1.0",
            ["`flexure.stiffness_nm_per_deg` is -1", "allowed is"],
        ),
        (
            "pitch_mm = 1.3",
            "pitch_mm = 1.3\nlength_mm = 2.0",
            ["`flexure[0].at_mm` puts a flexure at 37.3", "overlap"],
        ),
        ("to_flexure = 12", "to_flexure = 25", ["`tendon[2].to_flexure` is 25", "allowed is 1 to 24"]),
        ("offset_mm = 4.0", "offset_mm = 0.3", ["`burr.offset_mm` is 0.3", "inside the tube"]),
        (
            "density_kg_per_m = 0.101",
            "density_kg_per_m = nan",
            ["`tube.linear_density_kg_per_m` is NaN", "allowed is"],
        ),
    ] {
        let place = Place::new();
        assert!(shipped.contains(from), "{from}");
        fs::write(place.path("tool.toml"), shipped.replacen(from, to, 1)).unwrap();
        place.scene(&format!("{}[manipulator]\nfile = \"tool.toml\"\n", scenes::drill("lockstep", 1.0)));
        assert_refused_in(&place, &["tool.toml", words[0], words[1]]);
        let shown = trabecula(&[&"tool", &"show", &place.path("tool.toml")]);
        assert_eq!(shown.code, Some(2), "{}", shown.out);
        assert!(words.iter().all(|word| shown.err.contains(word)), "{words:?} in: {}", shown.err);
    }
    let place = Place::new();
    place.scene(&format!("{}[manipulator]\nfile = \"none.toml\"\n", scenes::drill("lockstep", 1.0)));
    assert_refused_in(&place, &["scene.toml: `manipulator.file` names ", "none.toml, which cannot be read"]);
}

/// Flags that had no effect, and a tool that only some models can represent, which the table of the models was to show.
#[test]
fn flags_without_effect_are_refused_and_a_winding_tool_is_shown() {
    for words in [
        &["run", "--no-record", "--output", "o"][..],
        &["run", "--no-record", "--images", "full"],
        &["plan", "--list", "--samples", "3"],
        &["plan", "--to", "3"],
        &["plan", "--allow-mismatch"],
        &["log", "export", "--frames", "--topic", "/state", "l", "-o", "o"],
        &["log", "export", "--volume", "v", "l", "-o", "o.csv"],
        &["log", "export", "--from", "10", "--to", "5", "l", "-o", "o.csv"],
        &["log", "cat", "l", "--from", "10", "--to", "5"],
    ] {
        let place = Place::new();
        let words: Vec<&dyn AsRef<std::ffi::OsStr>> =
            words.iter().map(|word| word as &dyn AsRef<std::ffi::OsStr>).collect();
        let done = trabecula(&words);
        assert_eq!(done.code, Some(2), "{}", done.out);
        let flag =
            words.iter().map(|word| word.as_ref().to_str().unwrap()).find(|word| word.starts_with("--"));
        assert!(done.err.contains(flag.unwrap()), "{}", done.err);
        assert!(place.entries().is_empty());
    }
    let place = Place::new();
    let text = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/configs/tools/jhu_27.toml")).unwrap();
    let winding = text.replacen("toward_mm = 2.5", "toward_mm = 2.5\ntwist_deg_per_mm = 4.0", 1);
    fs::write(place.path("tool.toml"), winding).unwrap();
    let shown = trabecula(&[&"tool", &"show", &place.path("tool.toml")]);
    assert_eq!(shown.code, Some(0), "{}", shown.err);
    assert!(shown.out.contains("planar              refused"), "{}", shown.out);
}

/// Meshes of an arm that are missing or hostile: one error with file, link or joint, and mesh. Every rule: `crates/scene/tests/scenes/meshes.rs`.
#[test]
fn a_mesh_of_an_arm_that_cannot_be_drawn_is_named() {
    let arms = concat!(env!("CARGO_MANIFEST_DIR"), "/configs/arms/puma560");
    let stl = |count: u32, corner: f32, floats: usize| {
        let mut bytes = vec![0; 80];
        bytes.extend_from_slice(&count.to_le_bytes());
        // Three zeros of the normal's and the corners' floats, so that the triangle has an area.
        let float = |index: usize| if [0, 3, 7].contains(&index) { 0.0 } else { corner };
        (0..floats).for_each(|index| bytes.extend_from_slice(&float(index).to_le_bytes()));
        bytes.extend_from_slice(&[0, 0]);
        bytes
    };
    for (content, words) in [
        (
            None,
            [
                "puma.urdf: link `base_link` has the mesh package://puma560/meshes/cube.stl, which is not there",
                "folder above it",
            ],
        ),
        (
            Some(stl(1, 0.5, 11)),
            ["`arm.mesh.file` of the arm's base is ", "meshes/cube.stl, which is no STL: its 130 bytes"],
        ),
        (Some(stl(u32::MAX, 0.5, 12)), ["cube.stl, which is no STL", "announces 4294967295"]),
        (
            Some(stl(1, f32::NAN, 12)),
            ["cube.stl, which has a corner of triangle 1 that is infinite or no number", "finite"],
        ),
        (Some(stl(1, 1e9, 12)), ["cube.stl, which reaches 300000000.0 m", "expected 10 m at most"]),
        (Some(Vec::new()), ["cube.stl, which is no STL: its 0 bytes", "solid"]),
    ] {
        let place = Place::new();
        fs::copy(format!("{arms}/puma560.urdf"), place.path("puma.urdf")).unwrap();
        fs::create_dir_all(place.path("puma560/meshes")).unwrap();
        fs::copy(format!("{arms}/meshes/prism.obj"), place.path("puma560/meshes/prism.obj")).unwrap();
        if let Some(content) = content {
            fs::write(place.path("puma560/meshes/cube.stl"), content).unwrap();
        }
        let arm = "[arm]\nurdf = \"puma.urdf\"\ninitial_joints_deg = [5.0, 45.0, 20.0, 10.0, 50.0, 5.0]\n";
        place.scene(&format!("{}{arm}", scenes::drill("lockstep", 1.0)));
        assert_refused_in(&place, &words);
        let check = trabecula(&[&"scene", &"check", &place.path("scene.toml")]);
        assert!(check.code == Some(2) && check.err.contains(words[0]), "{}", check.err);
    }
}

#[test]
fn a_value_of_a_wrong_type_is_named_with_its_line() {
    assert_refused(
        |scene| scene.replace("duration_s = 1.0", "duration_s = \"long\""),
        &["scene.toml, line 4", "invalid type: string \"long\", expected"],
    );
    assert_refused(
        |scene| scene.replace("mode = \"lockstep\"", "mode = \"fast\""),
        &["line 3", "`fast`", "`lockstep`"],
    );
    assert_refused(|scene| scene.replace("burr_start_mm", "[burr_start_mm"), &["scene.toml, line"]);
}

#[test]
fn a_missing_key_is_named() {
    assert_refused(|scene| scene.replace("insertion_mm = 20.0", ""), &["scene.toml, line", "insertion_mm"]);
}

#[test]
fn two_controllers_with_one_name_are_refused() {
    let second = "\n[[controller]]\nname = \"reference\"\ndrives = []\nexternal = true\n";
    assert_refused(|scene| scene + second, &["scene.toml", "`controller.name`", "`reference` stands twice"]);
}

#[test]
fn two_controllers_that_drive_one_part_are_refused() {
    let second = "\n[[controller]]\nname = \"other\"\ndrives = [\"burr\"]\nexternal = true\n";
    assert_refused(
        |scene| scene + second,
        &["scene.toml", "`controller.drives`", "Burr", "`reference`", "`other`", "expected one"],
    );
}

/// With bright bone the darkest end is air: the controller steered by a burr that it had not seen.
#[test]
fn image_feedback_on_bright_frames_is_refused() {
    assert_refused(
        |scene| scene.replace("[drr]\n", "[drr]\ndisplay = \"bone_bright\"\n"),
        &["scene.toml", "`controller.curved_drilling.feedback`", "`drr.display = \"bone_dark\"`"],
    );
}

/// Bug: `run` began, made its folder, and a part died with 1.
#[test]
fn a_c_arm_that_cannot_be_is_refused_before_anything_starts() {
    let source = "\n[drr.carm]\nsource_mm = [0.0, -700.0, 0.0]\ndetector_centre_mm = [0.0, 300.0, 0.0]\n";
    let axes = [
        ("[0.0, 0.0, 0.0]", "perpendicular"),
        ("[0.0, 0.0, 1.0]", "perpendicular"),
        ("[nan, 0.0, 0.0]", "row_axis"),
    ];
    for (row_axis, word) in axes {
        assert_refused(
            |scene| scene + source + &format!("row_axis = {row_axis}\ncolumn_axis = [0.0, 0.0, 1.0]\n"),
            &["scene.toml", "`drr.carm`", word],
        );
    }
}

/// Bug: `scene check` refused it, and `run` began.
#[test]
fn a_calibration_that_is_none_is_refused_before_anything_starts() {
    for text in [None, Some("milk, bread\n")] {
        let place = Place::new();
        let scene = scenes::drill("lockstep", 1.0);
        let named =
            scene.replace("tension_n = 6.0", "calibration = \"tension.csv\"\ntarget_mm = [-98.6, 2.3, 8.4]");
        assert_ne!(scene, named);
        place.scene(&named);
        text.iter().for_each(|text| fs::write(place.path("tension.csv"), text).unwrap());
        assert_refused_in(&place, &["scene.toml", "tension.csv"]);
    }
}

#[test]
fn a_missing_scene_file_is_named() {
    let place = Place::new();
    assert_refused_in(&place, &["scene.toml: cannot be read", "No such file"]);
}

fn with_volume(text: impl FnOnce(&Place)) -> Place {
    let place = Place::new();
    place.scene(&scenes::drill_in_file("lockstep", 1.0, "ct.nrrd"));
    text(&place);
    place
}

#[test]
fn a_missing_volume_is_named() {
    let place = with_volume(|_| {});
    assert_refused_in(&place, &["ct.nrrd", "which does not exist", "trabecula phantom pelvis"]);
    let check = trabecula(&[&"scene", &"check", &place.path("scene.toml")]);
    assert_eq!(check.code, Some(2));
    assert!(check.err.contains("`volume.path`") && check.err.contains("ct.nrrd"), "{}", check.err);
}

#[test]
fn a_text_file_named_as_a_volume_is_refused() {
    let place =
        with_volume(|place| fs::write(place.path("ct.nrrd"), "a shopping list\nmilk\nbread\n").unwrap());
    assert_refused_in(&place, &["ct.nrrd"]);
}

#[test]
fn a_truncated_volume_is_refused() {
    let place = with_volume(|place| {
        let whole = place.path("ct.nrrd");
        assert_eq!(trabecula(&[&"phantom", &"block", &"-o", &whole, &"--spacing-mm", &"1"]).code, Some(0));
        let bytes = fs::read(&whole).unwrap();
        fs::write(&whole, &bytes[..bytes.len() - bytes.len() / 3]).unwrap();
    });
    assert_refused_in(&place, &["ct.nrrd"]);
    let info = trabecula(&[&"volume", &"info", &place.path("ct.nrrd")]);
    assert_eq!(info.code, Some(2), "{}", info.out);
}

#[test]
fn a_bad_argument_is_refused_with_what_is_allowed() {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 1.0));
    let unknown = trabecula(&[&"drill"]);
    assert_eq!(unknown.code, Some(2));
    assert!(unknown.err.contains("unrecognized subcommand 'drill'"), "{}", unknown.err);
    let mode = trabecula(&[&"run", &scene, &"--mode", &"fast"]);
    assert_eq!(mode.code, Some(2));
    assert!(mode.err.contains("lockstep") && mode.err.contains("realtime"), "{}", mode.err);
    let duration = trabecula(&[&"run", &scene, &"--duration-s", &"0", &"--output", &place.path("out")]);
    assert_eq!(duration.code, Some(2));
    assert!(duration.err.contains("--duration-s is 0, allowed is 0.001 to 86400"), "{}", duration.err);
    let part = trabecula(&[&"proc", &"physics", &"--session", &place.path("nowhere")]);
    assert_ne!(part.code, Some(0));
    assert!(part.err.contains("nowhere"), "{}", part.err);
    assert_eq!(place.entries(), ["scene.toml"]);
}

#[test]
fn an_output_that_cannot_be_made_is_named() {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 1.0));
    let done = trabecula(&[&"run", &scene, &"--output", &scene]);
    assert_eq!(done.code, Some(2), "{}", done.err);
    assert!(
        done.err.contains("--output") && done.err.contains("scene.toml: it is a file; expected a folder"),
        "{}",
        done.err
    );
    let below = trabecula(&[&"run", &scene, &"--output", &scene.join("runs")]);
    assert_eq!(below.code, Some(2), "{}", below.err);
    assert!(below.err.contains("runs: cannot be created"), "{}", below.err);
}

/// A scene may come from a stranger; looking at it must start none of its programs.
#[test]
fn a_scene_check_runs_nothing() {
    let place = Place::new();
    let trace = place.path("trace");
    let program = format!("command = [\"sh\", \"-c\", \"touch {}\"]", trace.display());
    let scene = place.scene(&scenes::hold("lockstep", 0.1).replace("hold = { tension_n = 2.0 }", &program));
    let before = place.entries();
    for arguments in [["scene", "check"], ["plan", "--list"]] {
        trabecula(&[&arguments[0], &arguments[1], &scene]);
        assert_eq!(place.entries(), before, "{arguments:?}");
    }
    let check = trabecula(&[&"scene", &"check", &scene]);
    assert_eq!(check.code, Some(0), "{}", check.err);
    // The same program does leave its trace when the scene is run.
    place.start(&fs::read_to_string(&scene).unwrap()).end();
    assert!(trace.exists());
}

/// Nothing forbade it but the check itself.
#[test]
fn a_run_may_last_a_day() {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 86_400.0).replace("seed = 7", "seed = 7\ndt_ms = 0.1"));
    let check = trabecula(&[&"scene", &"check", &scene]);
    assert_eq!(check.code, Some(0), "{}", check.err);
    let ticks = ipc_types::scene_file::load(&scene).unwrap().tick_count();
    assert_eq!(ticks, 864_000_000);
    // MCAP numbers the messages of a channel so.
    assert!(u32::try_from(ticks).is_ok());
    let scene = place.scene(&scenes::hold("lockstep", 86_401.0));
    let check = trabecula(&[&"scene", &"check", &scene]);
    assert!(check.code == Some(2) && check.err.contains("allowed is 0.001 to 86400"), "{}", check.err);
}
