//! Features common to the commands: JSON, completions and man pages, helpful errors, a scene that runs
//! without a CT.

use std::ffi::OsStr;
use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;
use test_support::limited::Limited;

use crate::common::program::{Place, Run, call, trabecula};
use crate::common::scenes;

#[test]
fn every_command_with_figures_prints_them_as_one_json_object() {
    let place = Place::new();
    let folder = place.complete(&scenes::drill("lockstep", 0.3)).folder;
    fs::rename(folder, place.path("log")).unwrap();
    for (line, path) in [
        ("log info @log --json", "/run/topics/~1state/messages"),
        ("log diff @log @log --json", "/identical_ticks"),
        ("log export @log -o @t.csv --json", "/verdict/intact"),
        ("log compress @log -o @c.mcap --json", "/after_bytes"),
        ("log repair @log -o @r.mcap --json", "/was_whole"),
        ("replay @log --verify --json", "/hash"),
        ("replay @log --output @again --json", "/sha256/0"),
        ("volume drilled @log -o @d.nrrd --json", "/removed_voxels"),
        ("volume info @d.nrrd --json", "/max_hu"),
        ("log export @log -o @view.mcap --foxglove --json", "/verdict/intact"),
        ("log export @log -o @set --dataset npz --json", "/frames"),
        ("phantom sphere -o @s.nrrd --spacing-mm 2 --json", "/dimensions/2"),
        ("volume probe @s.nrrd --at 0,0,0 --json", "/places/0/hu"),
        ("scene show @scene.toml -o @show.png --json", "/target_depth_mm"),
        ("drr @s.nrrd -o @x.png --json", "/frames_per_s"),
        ("scene check @scene.toml --json", "/ticks"),
        ("plan @scene.toml --json", "/scene"),
        ("plan --list --json", "/table_csv"),
        ("doctor --json --seconds 0", "/cores"),
    ] {
        let done = call(&place.words(line));
        assert_eq!(done.code, Some(0), "{line}: {}", done.err);
        let answer: Value =
            serde_json::from_str(&done.out).unwrap_or_else(|cause| panic!("{line}: {cause}: {}", done.out));
        assert!(answer.pointer(path).is_some_and(|value| !value.is_null()), "{line}: {path}: {answer}");
    }
    let states = |line: &str| serde_json::from_str::<Value>(&call(&place.words(line)).out).unwrap();
    assert_eq!(states("log info @log --json")["run"]["topics"]["/state"]["messages"], 301);
    assert_eq!(states("replay @log --verify --json")["ticks"], 300);
}

#[test]
fn completions_and_man_pages_are_written_where_a_system_looks_for_them() {
    let place = Place::new();
    let done = call(&place.words("docs install -o @usr"));
    assert_eq!(done.code, Some(0), "{}", done.err);
    let bash = place.path("usr/share/bash-completion/completions/trabecula");
    let script = format!("source {}; complete -p trabecula", bash.display());
    let output = Command::new("bash").args(["--norc", "-c", &script]).limited_output().unwrap();
    assert!(String::from_utf8_lossy(&output.stdout).contains("-F _trabecula"), "{output:?}");
    for name in ["trabecula", "trabecula-run", "trabecula-log-export", "trabecula-docs-install"] {
        let page = fs::read_to_string(place.path(&format!("usr/share/man/man1/{name}.1"))).unwrap();
        assert!(page.contains(&format!(".TH {name}")) && page.contains("Exit codes"), "{name}: {page:.300}");
    }
    assert!(place.path("usr/share/zsh/site-functions/_trabecula").exists());
    assert!(place.path("usr/share/fish/vendor_completions.d/trabecula.fish").exists());
    assert!(!place.path("usr/share/man/man1/trabecula-proc.1").exists());
}

/// Regression: the scene named a file that is not publicly available, and the error did not say where to get
/// one.
#[test]
fn a_scene_whose_ct_is_not_there_says_where_one_is_to_be_had_and_runs_on_the_synthetic_pelvis() {
    let place = Place::new();
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/pelvis_ct.toml");
    let nowhere = "volume.path=\"/nowhere/ct.nii.gz\"";
    let words: [&dyn AsRef<OsStr>; 6] = [&"run", &scene, &"--set", &nowhere, &"--output", &place.path("out")];
    let done = trabecula(&words);
    assert_eq!(done.code, Some(2), "{}", done.err);
    for said in
        ["`volume.path` is /nowhere/ct.nii.gz", "trabecula phantom pelvis -o", "docs/volumes.md", "--set"]
    {
        assert!(done.err.contains(said), "{}", done.err);
    }
    assert!(!place.path("out").exists());

    let pelvis = place.path("pelvis.nrrd");
    let made = call(&place.words("phantom pelvis -o @pelvis.nrrd --spacing-mm 2"));
    assert_eq!(made.code, Some(0), "{}", made.err);
    let path = format!("volume.path={:?}", pelvis.to_str().unwrap());
    // In such coarse voxels the tool sticks in its hole at first.
    let settings = ["--set", &path, "--set", "volume.resample_mm=1.5", "--set", "run.duration_s=3.0"];
    let ended = Run::start(&scene, place.path("out"), &settings).end_well();
    let summary = ended.summary();
    assert!(summary["drilling"]["removed_voxels"].as_u64().unwrap() > 0, "{summary}");
    let page = fs::read_to_string(ended.folder.join("report.html")).unwrap();
    assert!(page.contains("pelvis_ct") && page.matches("src=\"data:image/").count() == 5, "{page:.600}");
    assert!(page.contains("replay") && page.contains("bone_threshold_hu"));
}
