//! Programs that flood: other programs are not delayed, and their requests are answered.

use std::sync::atomic::{AtomicBool, Ordering};

use ipc_types::messages::{CONTROL_STOP, Command, TENDON_SERVO_JF};
use test_support::limited::SetAtEnd;
use trabecula_client::ClientError;

use crate::common::client::Pilot;
use crate::common::program::{LIMIT, Place, wait_for};
use crate::common::scenes;
use crate::languages::clients;
use crate::strays::{answer_here, joined, stopped};

/// Regression: while messages arrived, neither a controller's time limit nor run control was checked: a flood
/// of rejected commands blocked a lockstep run forever.
#[test]
fn a_stop_is_heard_while_a_controller_floods_in_lockstep() {
    let place = Place::new();
    let scene =
        scenes::shared("lockstep", 600.0).replace("seed = 7", "seed = 7\ncontroller_limit_ms = 60000.0");
    let run = place.start(&scene);
    let (session, over) = (run.session(), AtomicBool::new(false));
    let ended = std::thread::scope(|scope| {
        let _over = SetAtEnd(&over);
        scope.spawn(|| {
            let mut pilot = Pilot::join(&session, "pilot");
            let state = pilot.next_state();
            // The first one is accepted, so that the run begins.
            pilot.answer(&state, Command::zeroed());
            pilot.client.wait_for_state(|state| state.tick > 0);
            let mut refused = Command { tendon_mode: TENDON_SERVO_JF, ..Command::zeroed() };
            refused.tendon_force_n[0] = f64::NAN;
            for sequence in (2..).take_while(|_| !over.load(Ordering::Relaxed)) {
                // The hub may have ended.
                let _ = pilot.commands.send(&Command { sequence, ..refused });
            }
        });
        let mut observer = joined(&run, "");
        wait_for("1000 refused commands", || {
            observer.status().unwrap().filter(|status| status.refused_commands >= 1000)
        });
        observer.run_control(CONTROL_STOP, 0, LIMIT).unwrap();
        drop(observer);
        run.end()
    });
    assert_eq!(ended.code, Some(0), "{}", ended.err);
}

/// A scene with X-ray frames in lockstep, of which `mine` and `other` may request frames.
fn with_frames() -> String {
    let text = std::fs::read_to_string(clients().join("scenes/image_guided.toml")).unwrap();
    format!("{text}\n[[controller]]\nname = \"other\"\ndrives = []\nexternal = true\noptional = true\n")
}

/// Regression: two clients of one process used the same numbers, and each received the other's frame.
#[test]
fn two_clients_of_one_process_have_requests_of_their_own() {
    let place = Place::new();
    let run = place.start(&with_frames());
    let (mut mine, mut other) = (joined(&run, "mine"), joined(&run, "other"));
    let tick = mine.wait_state(LIMIT).unwrap().tick;
    let requests = [mine.request_frame(None, tick).unwrap(), other.request_frame(None, tick).unwrap()];
    assert_ne!(requests[0], requests[1]);
    for (client, request) in [&mut mine, &mut other].into_iter().zip(requests) {
        assert_eq!(client.wait_frame(request, LIMIT).unwrap().frame.request_id, request);
    }
    answer_here(&mut mine);
    stopped(run, other, mine);
}

/// Regression: waiting for a frame, for the volume or for run control continued after the run's end until the
/// caller's own limit.
#[test]
fn the_end_of_the_run_ends_the_wait_for_a_frame_of_a_future_tick() {
    let place = Place::new();
    let run = place.start(&with_frames());
    let mut mine = joined(&run, "mine");
    mine.wait_state(LIMIT).unwrap();
    let request = mine.request_frame(None, 900).unwrap();
    answer_here(&mut mine);
    mine.run_control(CONTROL_STOP, 0, LIMIT).unwrap();
    let outcome = mine.wait_frame(request, LIMIT).map(|view| *view.frame);
    assert!(matches!(outcome, Err(ClientError::Ended)), "{outcome:?}");
    let outcome = mine.run_control(CONTROL_STOP, 0, LIMIT);
    assert!(matches!(outcome, Err(ClientError::Ended)), "{outcome:?}");
    drop(mine);
    assert_eq!(run.end().code, Some(0));
}
