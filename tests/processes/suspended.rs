//! A run that is suspended as a whole (Ctrl-Z and `fg`, a frozen container) continues when it is resumed.

use std::time::Duration;

use rustix::process::Signal;

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Ended, Place, Run, assert_nothing_left, parts_of, signal};
use crate::common::scenes;

/// Longer than the controllers' limit below.
const STOPPED: Duration = Duration::from_millis(2500);

/// Interval between two stops.
const BETWEEN: Duration = Duration::from_millis(30);

/// Stops processes in the middle of a run, resumes them, and waits for the run's end.
fn suspended(place: &Place, scene: &str, how: Signal) -> Ended {
    let run: Run = place.start(scene);
    let client = Client::at(&run, 100);
    let mut all: Vec<u32> = parts_of(&run.session()).into_iter().map(|(_, pid)| pid).collect();
    all.insert(0, run.pid());
    // The controller, which was started last, is stopped first and resumed last, so that the physics waits
    // for its answer.
    for pid in all.iter().rev() {
        signal(*pid, how);
        std::thread::sleep(BETWEEN);
    }
    std::thread::sleep(STOPPED);
    let stood = client.wait_for_state(|_| true).tick;
    for pid in &all {
        signal(*pid, Signal::CONT);
        std::thread::sleep(BETWEEN);
    }
    client.wait_for_state(|state| state.tick >= stood + 200);
    drop(client);
    let ended = run.end_well();
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    assert!(log.marker.unwrap().lost.is_empty());
    assert_replays(&ended.folder);
    ended
}

fn missed(ended: &Ended) -> u64 {
    ended.summary()["timing"]["missed_ticks"].as_u64().unwrap()
}

#[test]
fn a_suspended_real_time_run_goes_on_and_counts_its_miss() {
    let place = Place::new();
    let ended = suspended(&place, &scenes::hold("realtime", 3.0), Signal::STOP);
    assert!(missed(&ended) >= 1);
    assert_eq!(read(&ended.folder).ticks.len(), 3000);
}

/// Ctrl-Z stops the launcher; its parts, in their own sessions, continue, and the run is complete when it is
/// resumed.
#[test]
fn a_launcher_stopped_by_ctrl_z_costs_no_tick() {
    let place = Place::new();
    let ended = suspended(&place, &scenes::hold("realtime", 4.0), Signal::TSTP);
    assert_eq!(read(&ended.folder).ticks.len(), 4000);
}

/// Regression: the physics attributed the time of its own suspension to its controller.
#[test]
fn a_suspended_lockstep_run_goes_on() {
    let place = Place::new();
    let scene = scenes::drill("lockstep", 20.0).replace("seed = 7", "seed = 7\ncontroller_limit_ms = 1500.0");
    suspended(&place, &scene, Signal::STOP);
}
