//! The volume cache, through the program: in every environment, used by two runs at once, and killed while it
//! is written.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use test_support::limited::limited_output_of;

use crate::common::program::{LIMIT, Place, wait_for};

/// A coarse femur, which is quick to build but still worth caching.
const FEMUR: &str = "name = \"kept\"\n[run]\nmode = \"lockstep\"\nduration_s = 0.01\n[volume]\nphantom = \"femur\"\nspacing_mm = 0.6\n\
                     bone_threshold_hu = 150\n[tool]\nburr_start_mm = [-160.0, 18.2, -49.3]\ndirection = [0.792, -0.212, 0.573]\n\
                     bend_toward = [0.0, 0.0, 1.0]\n[[controller]]\nname = \"holder\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n\
                     hold = { tension_n = 1.0 }\n";

/// Runs `trabecula` with these environment variables and no others that affect the cache's location.
fn start(words: &[&dyn AsRef<std::ffi::OsStr>], environment: &[(&str, &Path)]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.args(words).env_remove("XDG_CACHE_HOME").env_remove("HOME");
    command.envs(environment.iter().copied()).stdin(Stdio::null());
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

fn check(scene: &Path, environment: &[(&str, &Path)]) -> Output {
    let output = limited_output_of(start(&[&"scene", &"check", &scene], environment), LIMIT, "scene check");
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    output
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn files(folder: &Path) -> Vec<PathBuf> {
    fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect()
}

#[test]
fn a_volume_is_kept_used_shown_and_cleared_and_a_damaged_one_is_said_and_made_anew() {
    let place = Place::new();
    let (scene, xdg) = (place.scene(FEMUR), place.path("xdg"));
    let environment = [("XDG_CACHE_HOME", xdg.as_path())];
    let first = check(&scene, &environment);
    let folder = xdg.join("trabecula");
    let [file] = &files(&folder)[..] else { panic!("{:?}", files(&folder)) };
    assert_eq!(fs::metadata(&folder).unwrap().permissions().mode() & 0o777, 0o700);
    let whole = fs::read(file).unwrap();
    assert_eq!(check(&scene, &environment).stdout, first.stdout);
    let mut damaged = whole.clone();
    let last = damaged.len() - 1;
    damaged[last] ^= 1;
    fs::write(file, damaged).unwrap();
    let output = check(&scene, &environment);
    assert!(said(&output).contains("wrong voxel checksum; rebuilding it"), "{}", said(&output));
    assert_eq!(output.stdout, first.stdout);
    assert!(fs::read(file).unwrap() == whole);
    let run = |words: &[&dyn AsRef<std::ffi::OsStr>]| {
        limited_output_of(start(words, &environment), LIMIT, "cache").stdout
    };
    let info: serde_json::Value = serde_json::from_slice(&run(&[&"cache", &"info", &"--json"])).unwrap();
    assert_eq!((&info["bytes"], info["volumes"].as_array().unwrap().len()), (&whole.len().into(), 1));
    assert!(String::from_utf8(run(&[&"cache", &"clear"])).unwrap().contains("removed      1 volumes"));
    assert!(files(&folder).is_empty());
}

#[test]
fn without_a_home_in_a_folder_of_others_or_in_a_file_everything_works_and_nothing_is_kept() {
    let place = Place::new();
    let scene = place.scene(FEMUR);
    let plain = check(&scene, &[]);
    assert_eq!(said(&plain), "");
    let open = place.path("open");
    fs::create_dir_all(open.join("trabecula")).unwrap();
    fs::set_permissions(open.join("trabecula"), Permissions::from_mode(0o777)).unwrap();
    let output = check(&scene, &[("XDG_CACHE_HOME", &open)]);
    assert_eq!(
        said(&output).matches("unusable as a cache folder: its mode is 777").count(),
        1,
        "{}",
        said(&output)
    );
    let file = place.path("file");
    fs::write(&file, "mine").unwrap();
    for (name, value) in [("XDG_CACHE_HOME", file.as_path()), ("HOME", &file), ("HOME", Path::new("/proc"))] {
        assert_eq!(check(&scene, &[(name, value)]).stdout, plain.stdout, "{name}");
    }
    // A relative path must be ignored.
    check(&scene, &[("XDG_CACHE_HOME", Path::new("relative"))]);
    assert!(files(&open.join("trabecula")).is_empty() && !Path::new("relative").exists());
    assert_eq!(fs::read(&file).unwrap(), b"mine");
}

#[test]
fn two_at_once_agree_and_one_that_is_killed_leaves_no_half_a_volume() {
    let place = Place::new();
    let (scene, xdg) = (place.scene(FEMUR), place.path("xdg"));
    let environment = [("XDG_CACHE_HOME", xdg.as_path())];
    let words: [&dyn AsRef<std::ffi::OsStr>; 3] = [&"scene", &"check", &scene];
    for wait_ms in [100, 200, 300, 400, 500, 700] {
        let mut killed = start(&words, &environment);
        std::thread::sleep(std::time::Duration::from_millis(wait_ms));
        let _ = killed.kill();
        wait_for("the killed command", || killed.try_wait().unwrap());
    }
    let both = [start(&words, &environment), start(&words, &environment)];
    let outputs = both.map(|child| limited_output_of(child, LIMIT, "scene check"));
    assert!(outputs.iter().all(|output| output.status.success() && said(output).is_empty()), "{outputs:?}");
    assert_eq!(outputs[0].stdout, outputs[1].stdout);
    assert_eq!(files(&xdg.join("trabecula")).len(), 1);
}
