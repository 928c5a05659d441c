//! Runs with less memory than they need: refused before anything is written, with the size that suffices.
//! Regression: of 68 runs with limits of 60 to 1300 MiB of address space, 36 aborted and 2 hung.

use std::path::Path;
use std::process::{Command, Output};

use ipc_types::messages::services::frame_bytes;
use ipc_types::scene::{Policy, Wait};
use ipc_types::session::SessionPlan;
use rustix::process::Signal;
use test_support::limited::Limited;
use test_support::name_space::NameSpace;

use crate::common::program::{Place, assert_nothing_left, segments_of, signal, wait_for};
use crate::common::scenes;
use crate::held_back::group;

const PROGRAM: &str = env!("CARGO_BIN_EXE_trabecula");

/// Runs a scene by another program, whose words come first.
fn run_by(mut starter: Command, place: &Place, scene: &str) -> (Option<i32>, String) {
    starter.args([PROGRAM, "run"]).arg(place.scene(scene)).arg("--output").arg(place.path("out"));
    let Output { status, stderr, .. } = starter.arg("--quiet").limited_output().unwrap();
    (status.code(), String::from_utf8_lossy(&stderr).into_owned())
}

fn with_limit(limit: &str, place: &Place, scene: &str) -> (Option<i32>, String) {
    let mut prlimit = Command::new("prlimit");
    prlimit.arg(limit);
    run_by(prlimit, place, scene)
}

/// Asserts that a run was refused and wrote nothing.
fn assert_refused((code, said): &(Option<i32>, String), place: &Place, words: &[&str]) {
    assert_eq!(*code, Some(2), "{said}");
    assert!(words.iter().all(|word| said.contains(word)), "{said}\nlacks one of {words:?}");
    assert!(!place.path("out").exists(), "something was written: {said}");
}

/// Returns the number after some words.
fn number_after(said: &str, words: &str) -> u64 {
    let behind = said.split(words).nth(1).unwrap_or_else(|| panic!("no `{words}`: {said}"));
    let digits: String = behind.chars().take_while(char::is_ascii_digit).collect();
    digits.parse().unwrap_or_else(|_| panic!("no number after `{words}`: {said}"))
}

#[test]
fn a_run_with_too_little_address_space_is_refused_with_the_limit_that_suffices() {
    for (option, flag, limits_mib) in
        [("as", "ulimit -v ", &[70, 100, 150, 200][..]), ("data", "ulimit -d ", &[30, 60, 100])]
    {
        let place = Place::new();
        let scene = scenes::drill("lockstep", 0.05);
        let mut suffices = 0;
        for mib in limits_mib {
            let refused = with_limit(&format!("--{option}={}", mib << 20), &place, &scene);
            let limit = format!("the limit is {mib} MiB");
            assert_refused(&refused, &place, &["the largest process of the run needs", flag, &limit]);
            suffices = number_after(&refused.1, flag) * 1024;
        }
        // The number is without the CT, whose size is known when it is loaded; then it is whole.
        let mut refused = with_limit(&format!("--{option}={suffices}"), &place, &scene);
        if refused.0 == Some(2) {
            assert_refused(&refused, &place, &[flag]);
            let whole = number_after(&refused.1, flag) * 1024;
            refused = with_limit(&format!("--{option}={whole}"), &place, &scene);
        }
        assert_eq!(refused.0, Some(0), "{option}: {}", refused.1);
    }
}

#[test]
fn a_run_with_too_little_shared_memory_is_refused_with_the_size_that_suffices() {
    let shared = Path::new("/dev/shm");
    // As much as Docker gives a container.
    let space = match NameSpace::with_tmpfs(shared, 64 << 20) {
        Ok(space) => space,
        Err(cause) => return println!("skipped: {cause}"),
    };
    let (place, scene) = (Place::new(), scenes::drill("lockstep", 0.05));
    let refused = run_by(space.command(), &place, &scene);
    assert_refused(&refused, &place, &["/dev/shm: the run needs ", "64 MiB are free", "--shm-size"]);
    space.resize(shared, number_after(&refused.1, "the run needs ") << 20);
    let (code, said) = run_by(space.command(), &place, &scene);
    assert_eq!(code, Some(0), "{said}");
}

#[test]
fn a_run_in_a_control_group_with_too_little_memory_is_refused() {
    let Some((group, file)) =
        ["memory.max", "memory.limit_in_bytes"].into_iter().find_map(|file| Some((group(file)?, file)))
    else {
        return;
    };
    group.write(file, &(150 << 20).to_string());
    let place = Place::new();
    let scene = place.scene(&scenes::drill("lockstep", 0.05));
    let mut command = group.command(PROGRAM);
    command.arg("run").arg(scene).arg("--output").arg(place.path("out")).arg("--quiet");
    let output = command.limited_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let path = group.0.join(file);
    let words = ["the control group leaves 14", path.to_str().unwrap(), "MiB of memory"];
    assert_refused(&(output.status.code(), said), &place, &words);
}

/// With MCL_FUTURE and little room below the limit, every further allocation of the physics would fail. The
/// limit holds only without the privilege.
#[test]
fn a_run_with_little_memory_to_lock_completes() {
    let words = ["--bounding-set=-ipc_lock", "--inh-caps=-ipc_lock"];
    let is_root = rustix::process::geteuid().is_root();
    for mib in [1, 150, 190, 220, 300] {
        let limited = || {
            let mut command = Command::new(if is_root { "setpriv" } else { "env" });
            command.args(if is_root { &words[..] } else { &[] });
            command.args(["prlimit", &format!("--memlock={0}:{0}", mib << 20)]);
            command
        };
        if !limited().arg("true").limited_output().unwrap().status.success() {
            println!("skipped from {mib} MiB: no right to raise the limit");
            break;
        }
        let place = Place::new();
        let (code, said) = run_by(limited(), &place, &scenes::drill("realtime", 0.3));
        assert_eq!(code, Some(0), "{mib} MiB: {said}");
    }
}

#[test]
fn a_command_that_runs_out_of_memory_says_so_and_has_an_exit_code() {
    let place = Place::new();
    let mut command = Command::new("prlimit");
    command.args(["--as=73400320", PROGRAM, "phantom", "pelvis", "-o"]).arg(place.path("p.nrrd"));
    let output = command.limited_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{:?}: {said}", output.status);
    assert!(said.contains("memory allocation of ") && !said.contains("panicked"), "{said}");
    assert_eq!(place.entries(), Vec::<String>::new());
}

#[test]
fn doctor_compares_the_limits_with_what_a_run_needs() {
    let mut command = Command::new("prlimit");
    command.args(["--as=157286400", PROGRAM, "doctor", "--seconds", "0", "--json"]);
    let output = command.limited_output().unwrap();
    let facts: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let finding = |name: &str| {
        let all = facts["findings"].as_array().unwrap();
        all.iter().find(|finding| finding["name"] == name).cloned().unwrap_or_else(|| panic!("no `{name}`"))
    };
    let space = finding("address space");
    assert_eq!(space["grade"], "missing", "{space}");
    let found = space["found"].as_str().unwrap();
    assert!(found.contains("150 MiB") && found.contains("the built-in scene needs "), "{found}");
    for name in ["/dev/shm", "memory"] {
        assert!(finding(name)["found"].as_str().unwrap().contains("the built-in scene needs "), "{name}");
    }
}

/// The size of a session is computed before it exists; its ports reserve it one by one.
#[test]
fn a_session_takes_the_shared_memory_that_was_computed() {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    let session = run.session();
    let taken = || -> u64 {
        let bytes =
            |name: &String| Path::new("/dev/shm").join(name).metadata().map_or(0, |found| found.len());
        segments_of(&session).iter().map(bytes).sum()
    };
    // The ports are open when the sum no longer changes; a little less is no error.
    let mut last = [0; 20];
    let taken = wait_for("a constant size", || {
        last.rotate_left(1);
        last[19] = taken();
        last.iter().all(|bytes| *bytes == last[0] && *bytes > 100 << 20).then_some(last[0])
    });
    signal(run.pid(), Signal::TERM);
    assert_nothing_left(run.end().pid);
    let plan = SessionPlan {
        controllers: vec!["reference".to_owned()],
        volume_bytes: 2 * 40 * 40 * 60,
        frame_bytes: frame_bytes(64, 64),
        sensors: false,
        tip_jacobian: false,
        recorder: true,
        wait: Wait::Event,
        policy: Policy::Other,
    };
    let computed = plan.shared_bytes();
    assert!((taken..taken + (8 << 20)).contains(&computed), "computed {computed}, took {taken}");
}
