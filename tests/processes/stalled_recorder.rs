//! A recorder that is stopped for longer than its queues can bridge: the log has a gap and every command
//! reports it, or the physics waits.

use std::time::Duration;

use ipc_types::messages::services::RECORDER_QUEUE_TICKS;
use ipc_types::messages::{CONTROL_STOP, EVENT_MESSAGES_LOST};
use ipc_types::process::EXIT_GAP;
use rustix::process::Signal;
use serde_json::Value;

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Ended, Place, assert_nothing_left, signal, wait_for};
use crate::common::scenes;

/// Stops the recorder of a running run, does something, lets it continue until it has reported this number of
/// losses and for 300 more ticks, and ends the run. Returns the reports.
fn with_a_stopped_recorder(
    place: &Place,
    scene: &str,
    losses: usize,
    meanwhile: impl FnOnce(&Client, u64),
) -> (Ended, Vec<String>) {
    let run = place.start(scene);
    let client = Client::at(&run, 100);
    let recorder = run.part("recorder");
    signal(recorder, Signal::STOP);
    let stopped_at = client.wait_for_state(|_| true).tick;
    meanwhile(&client, stopped_at);
    signal(recorder, Signal::CONT);
    let mut told = Vec::new();
    wait_for("the recorder's word", || {
        let events = client.events().into_iter().filter(|(code, _)| *code == EVENT_MESSAGES_LOST);
        told.extend(events.map(|(_, text)| text));
        (told.len() >= losses).then_some(())
    });
    let now = client.wait_for_state(|_| true).tick;
    client.wait_for_state(|state| state.tick >= now + 300);
    client.ask(CONTROL_STOP, 0);
    drop(client);
    (run.end(), told)
}

/// Regression: a stop of 5.5 s cost the rest of the log, with exit code 0 and "completed".
#[test]
fn a_recorder_held_up_beyond_its_queue_says_which_ticks_are_missing_and_ends_with_3() {
    let place = Place::new();
    let mut stopped_at = 0;
    let (ended, told) =
        with_a_stopped_recorder(&place, &scenes::hold("realtime", 3600.0), 1, |client, tick| {
            stopped_at = tick;
            client.wait_for_state(|state| state.tick >= tick + RECORDER_QUEUE_TICKS + 1000);
        });
    assert_eq!(ended.code, Some(i32::from(EXIT_GAP)), "{}{}", ended.out, ended.err);
    assert!(
        ended.err.contains("its log has a gap") && ended.err.contains("recording.on_full"),
        "{}",
        ended.err
    );
    let summary = ended.summary();
    assert_eq!(summary["outcome"], "stopped, with a gap in the log");
    let gap = &summary["logs"]["missing_ticks"][0];
    let (first, last) = (gap[0].as_u64().unwrap(), gap[1].as_u64().unwrap());
    assert!(first + 200 > stopped_at && last >= first + 500, "{first} to {last}, stopped at {stopped_at}");
    assert!(ended.out.contains(&format!("ticks {first} to {last}")), "{}", ended.out);
    // Also reported immediately, as an event.
    let at_once = format!("ticks {first} to {last} are missing from the log");
    assert!(told.iter().any(|text| text.contains(&at_once)), "{told:?}");
    assert_nothing_left(ended.pid);
}

/// Waits until the physics has computed no tick for a while; returns the last one.
fn stalled(client: &Client) -> u64 {
    let (mut last, mut quiet_looks) = (0, 0);
    wait_for("the physics to wait", || {
        match client.next_state_within(Duration::from_millis(500)) {
            Some(state) => (last, quiet_looks) = (state.tick, 0),
            None => quiet_looks += 1,
        }
        // Longer than a busy machine delays it.
        (quiet_looks == 3).then_some(last)
    })
}

#[test]
fn a_physics_that_may_wait_for_the_recorder_loses_nothing() {
    let scene = format!("{}\n[recording]\non_full = \"wait\"\n", scenes::hold("realtime", 3600.0));
    let place = Place::new();
    let (ended, told) = with_a_stopped_recorder(&place, &scene, 0, |client, tick| {
        let last = stalled(client);
        // The recorder received some more ticks before it stopped.
        assert!(last > tick && last < tick + RECORDER_QUEUE_TICKS / 2, "{tick} to {last}");
    });
    assert!(told.is_empty(), "{told:?}");
    assert_eq!(ended.code, Some(0), "{}{}", ended.out, ended.err);
    assert!(read(&ended.folder).marker.unwrap().lost.is_empty());
    assert_replays(&ended.folder);
    let summary = ended.summary();
    assert_eq!(summary["logs"]["missing_ticks"], Value::Array(Vec::new()));
    // The wait is a miss with its cause.
    assert!(summary["timing"]["misses"]["by_cause"]["recorder"].as_u64() >= Some(1), "{summary:#}");
    assert!(summary["timing"]["misses"]["lost_ms"]["recorder"].as_f64() > Some(400.0), "{summary:#}");
}
