//! `trabecula.sim` as Python programs use it, against runs and replays of the program: the cases of `clients/python/tests/sim.py`.

use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;

use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};
use test_support::python::or_skip;

use crate::common::program::Place;
use crate::languages::{built, clients, install_package, library, output_of, output_within_limit};

/// An environment with NumPy, Gymnasium and the package, made once a test run.
fn python() -> Option<PathBuf> {
    static PYTHON: OnceLock<Option<PathBuf>> = OnceLock::new();
    PYTHON.get_or_init(make_python).clone()
}

/// The native half of `trabecula.sim`, which cargo builds with the workspace.
pub fn native() -> PathBuf {
    let native = built().join("deps/libtrabecula_sim.so");
    let hint = "`cargo build --release --workspace` builds it";
    assert!(native.exists(), "{}: not built; {hint}", native.display());
    native
}

fn make_python() -> Option<PathBuf> {
    let native = native();
    let python = or_skip("sim-1", &["numpy==2.3.5", "gymnasium==1.4.0"], "numpy, gymnasium")?;
    install_package(&python, &[("TRABECULA_CLIENT_LIBRARY", &library()), ("TRABECULA_SIM_LIBRARY", &native)]);
    Some(python)
}

/// Runs a check by SciPy to its end, in the environment of the sweeps' test of SALib, which holds it.
fn by_scipy(file: &str) {
    let native = native();
    let packages = ["SALib==1.5.2", "numpy==2.4.6", "scipy==1.17.1"];
    let Some(python) = or_skip("salib", &packages, "SALib, numpy, scipy.signal, scipy.stats") else { return };
    install_package(&python, &[("TRABECULA_CLIENT_LIBRARY", &library()), ("TRABECULA_SIM_LIBRARY", &native)]);
    let mut command = Command::new(python);
    command.arg(clients().join("python/tests").join(file));
    command.env_remove(SESSION_VARIABLE).env_remove(CONTROLLER_VARIABLE);
    let said = output_within_limit(&mut command);
    println!("{said}");
    assert!(said.ends_with("done\n"), "{said}");
}

#[test]
fn noise_drift_delay_rate_jitter_and_drop_outs_of_sensors_are_those_declared_by_scipy() {
    by_scipy("sensor_statistics.py");
}

#[test]
fn helical_tendons_bend_the_tool_as_rucker_and_websters_equations_solved_in_scipy() {
    by_scipy("helical_tendons.py");
}

/// Runs a case in an empty folder.
fn case(name: &str) {
    let Some(python) = python() else { return };
    let place = Place::new();
    let mut command = Command::new(python);
    command.arg(clients().join("python/tests/sim.py")).arg(name).arg(place.path(""));
    command.env("TRABECULA_PROGRAM", env!("CARGO_BIN_EXE_trabecula"));
    command.env_remove(SESSION_VARIABLE).env_remove(CONTROLLER_VARIABLE);
    assert_eq!(output_of(&mut command), "done\n");
}

#[test]
fn the_commands_of_a_run_lead_to_the_hash_of_the_run_at_every_tick() {
    case("follows");
}

#[test]
fn a_scene_with_its_own_controllers_leads_to_the_hashes_and_frames_of_its_run() {
    case("runs");
}

/// Bug: a step of a million ticks could not be ended but by killing Python.
#[test]
fn ctrl_c_ends_a_long_step_at_a_tick() {
    case("interrupted");
}

#[test]
fn what_a_simulation_records_replays_identically() {
    case("records");
}

#[test]
fn no_number_of_threads_changes_the_hash_of_a_simulation() {
    case("batches");
}

#[test]
fn a_bad_scene_is_refused_in_the_words_of_the_command_that_checks_it() {
    case("errors");
}

#[test]
fn what_a_simulation_returns_stays_and_threads_and_a_forked_child_may_use_it() {
    case("memory");
}

#[test]
fn labels_agree_with_siddon_and_the_tools_geometry_in_numpy() {
    case("labels");
}

#[test]
fn gymnasium_accepts_the_environment_and_an_episode_repeats() {
    case("gymnasium");
}

#[test]
fn a_skiving_episode_leaves_its_line_in_unequal_bone_and_is_held_by_a_pull() {
    case("skiving");
}

#[test]
fn an_agent_of_x_rays_sees_the_target_where_the_c_arm_projects_it() {
    case("x_ray_steering");
}
