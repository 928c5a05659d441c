//! The tip's Jacobian beside the states of a run.

use ipc_types::messages::{ARM_HOLD, State, TENDON_SERVO_JF, TipJacobian};
use sim::{Drive, Sim};
use trabecula_client::{Client, Connection};
use zerocopy::IntoBytes;

use crate::common::logs::{assert_replays, read};
use crate::common::program::{LIMIT, Place};
use crate::common::scenes;

/// Drives a run of 200 ticks with a tension that rises; returns states and Jacobians that the client saw.
fn driven(place: &Place, scene: &str) -> (Vec<(State, Option<TipJacobian>)>, std::path::PathBuf) {
    let run = place.start(scene);
    let (session, controller) = (run.session().display().to_string(), Some("pilot".to_owned()));
    let connection = Connection { session: Some(session), controller, ..Connection::default() };
    let mut client = Client::connect(&connection).unwrap();
    let mut seen = Vec::new();
    for _ in 0..200 {
        let state = *client.wait_state(LIMIT).unwrap();
        // In lockstep nothing newer exists before the answer.
        seen.push((state, client.tip_jacobian().unwrap().copied()));
        let command = client.command().unwrap();
        (command.tendon_mode, command.arm_mode) = (TENDON_SERVO_JF, ARM_HOLD);
        command.tendon_force_n[0] = 0.02 * state.tick as f64;
        client.send().unwrap();
    }
    drop(client);
    (seen, run.end_well().folder)
}

#[test]
fn a_client_sees_the_tip_jacobian_of_each_state_and_a_replay_computes_it() {
    let scene = scenes::shared("lockstep", 0.2);
    let (with, without) = (Place::new(), Place::new());
    let asked = format!("{scene}\n[manipulator]\ntip_jacobian = true\n{}", scenes::keyframes(0.1));
    let (seen, folder) = driven(&with, &asked);
    for (state, jacobian) in &seen {
        let jacobian = jacobian.as_ref().unwrap();
        assert_eq!(jacobian.tick, state.tick);
        assert!(jacobian.compliance[0] > 0.0 && jacobian.per_tension.iter().any(|entry| *entry != 0.0));
    }
    let log = folder.join("run.mcap");
    assert_replays(&log);
    for tick in [0, 1, 57, 150, 199] {
        let replayed = Sim::from_log(&log, Some(tick), &Drive::Nothing).unwrap().tip_jacobian();
        let (_, jacobian) = seen.iter().find(|(state, _)| state.tick == tick).unwrap();
        assert_eq!(jacobian.as_ref().unwrap().as_bytes(), replayed.as_bytes(), "tick {tick}");
    }
    // It changes no tick, and needs the key.
    let (unseen, bare) = driven(&without, &format!("{scene}{}", scenes::keyframes(0.1)));
    assert!(unseen.iter().all(|(_, jacobian)| jacobian.is_none()));
    assert_eq!(read(&folder).marker.unwrap().hash, read(&bare).marker.unwrap().hash);
}
