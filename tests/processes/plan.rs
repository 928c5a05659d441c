//! A scene's tolerance: the choice, a run with it, and the actual error of the run.

use std::process::Stdio;

use recorder_proc::log_file::LogFile;
use run_log::LogReader;
use test_support::limited::limited_output_of;

use crate::common::logs::{assert_replays, rewrite_as};
use crate::common::program::{LIMIT, Place, succeed, trabecula};
use crate::common::scenes;

fn with_tolerance(scene: &str, tolerance: &str) -> String {
    scene.replacen("seed = 7\n", &format!("seed = 7\n[tolerance]\n{tolerance}\n"), 1)
}

#[test]
fn a_run_within_a_tolerance_is_recorded_as_resolved_and_its_error_is_checked() {
    let place = Place::new();
    let scene = with_tolerance(&scenes::hold("lockstep", 0.5), "tip_mm = 0.5\npath_mm = 2.5");
    let planned = succeed(&[&"plan", &place.scene(&scene)]);
    assert!(planned.out.contains("tip error") && planned.out.contains("cost"), "{}", planned.out);
    let run = place.complete(&scene);
    let recorded =
        LogReader::open(&LogFile::at(run.folder.join("run.mcap"))).unwrap().header().scene_toml.clone();
    for key in ["model = ", "integrator = ", "dt_ms = ", "tip_mm = 0.5"] {
        assert!(recorded.contains(key), "{key} is not in {recorded}");
    }
    assert_replays(&run.folder);
    let checked = trabecula(&[&"plan", &"--check", &run.folder]);
    assert_eq!(checked.code, Some(0), "{}{}", checked.out, checked.err);
    assert!(checked.out.contains("path error") && checked.out.contains(": met"), "{}", checked.out);
}

/// Regression: the choice was printed before the first line of JSON.
#[test]
fn scripts_read_json_whatever_was_chosen() {
    let place = Place::new();
    let scene = place.scene(&with_tolerance(&scenes::hold("lockstep", 0.1), "tip_mm = 0.5"));
    let output = place.path("out");
    let done = succeed(&[&"run", &scene, &"--output", &output, &"--json"]);
    assert!(done.out.lines().count() > 0, "nothing was said");
    for line in done.out.lines() {
        serde_json::from_str::<serde_json::Value>(line).unwrap_or_else(|cause| panic!("{line}: {cause}"));
    }
}

#[test]
fn a_path_that_was_off_by_more_than_the_tolerance_fails_its_check() {
    let place = Place::new();
    let named = scenes::hold("lockstep", 0.5) + "[manipulator]\nmodel = \"constant_curvature\"\n";
    let run = place.complete(&with_tolerance(&named, "path_mm = 30.0"));
    let stricter = place.path("stricter.mcap");
    // The arc starts its swing differently from the beam: it deviates by more than a micrometre.
    rewrite_as(
        &run.folder.join("run.mcap"),
        &stricter,
        |header| header.scene_toml = header.scene_toml.replace("path_mm = 30.0", "path_mm = 0.001"),
        |_| {},
        |_| {},
    );
    let checked = trabecula(&[&"plan", &"--check", &stricter]);
    assert_eq!(checked.code, Some(1), "{}{}", checked.out, checked.err);
    assert!(checked.err.contains("`tolerance.path_mm` allows 0.001"), "{}", checked.err);
}

/// The errors of another tool are measured on first use and cached; a damaged table is reported and measured
/// again, and without a cache it is reported that nothing is kept.
#[test]
fn a_tool_of_the_scenes_own_is_measured_once() {
    let place = Place::new();
    std::fs::write(place.path("drill.toml"), include_str!("../../configs/tools/rigid_drill.toml")).unwrap();
    let hold = scenes::hold("lockstep", 0.5) + "[manipulator]\nfile = \"drill.toml\"\n";
    let scene = place.scene(&with_tolerance(&hold, "path_mm = 0.01"));
    let xdg = place.path("xdg");
    let plan = |words: &[&str], cache: Option<&std::path::Path>| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.arg("plan").args(words).arg(&scene).env_remove("XDG_CACHE_HOME").env_remove("HOME");
        command.envs(cache.map(|path| ("XDG_CACHE_HOME", path))).stdin(Stdio::null());
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        let output = limited_output_of(command.spawn().unwrap(), LIMIT, "plan");
        let [out, err] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        assert_eq!(output.status.code(), Some(0), "{out}{err}");
        (out, err)
    };
    let (first, err) = plan(&[], Some(&xdg));
    assert!(err.contains("measuring the errors of tool `rigid_drill` in free space"), "{err}");
    assert!(first.contains("for the scene's own tool, `rigid_drill`"), "{first}");
    assert_eq!(plan(&[], Some(&xdg)), (first.clone(), String::new()));
    let files: Vec<_> =
        std::fs::read_dir(xdg.join("trabecula")).unwrap().map(|it| it.unwrap().path()).collect();
    let [file] = &files[..] else { panic!("{files:?}") };
    std::fs::write(file, "no table").unwrap();
    let (again, err) = plan(&[], Some(&xdg));
    assert!(again == first && err.contains("wrong checksum; measuring it again"), "{err}");
    let (list, err) = plan(&["--list"], Some(&xdg));
    assert!(list.starts_with("rung,links,") && list.contains("\nplanar,8,hybrid,1,planes,,,,,"), "{list}");
    assert_eq!(err, "");
    let (unkept, err) = plan(&[], None);
    assert!(unkept == first && err.contains("cannot be cached: neither XDG_CACHE_HOME nor HOME"), "{err}");
}
