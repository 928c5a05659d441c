//! Pause, step, resume, reset, stop: ticks advance exactly as requested.

use std::time::Duration;

use ipc_types::messages::Tick;
use ipc_types::messages::{
    ARM_HOLD, ARM_MOVE_CP, BURR_SPEED, CONTROL_DONE, CONTROL_PAUSE, CONTROL_REFUSED, CONTROL_RESET,
    CONTROL_RESUME, CONTROL_STEP, CONTROL_STOP, Command, EVENT_RESET, PHASE_CONNECTING, PHASE_PAUSED, State,
    TENDON_SERVO_JF,
};
use run_log::EndReason;

use crate::common::client::Pilot;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Ended, Place, Run, assert_nothing_left, wait_for};
use crate::common::scenes;

/// How long nothing may happen. If it is too short on a slow machine, it can only hide a fault, not report
/// one.
const SILENCE: Duration = Duration::from_millis(150);

fn rest(_: &State) -> Command {
    let mut command = Command {
        tendon_mode: TENDON_SERVO_JF,
        arm_mode: ARM_HOLD,
        burr_mode: BURR_SPEED,
        ..Command::zeroed()
    };
    command.tendon_force_n[0] = 1.0;
    command
}

/// Into the bone, straight ahead, burr on.
fn drilling(start: &State) -> Command {
    let mut command = rest(start);
    command.arm_mode = ARM_MOVE_CP;
    command.arm_speed_m_per_s = 0.02;
    command.t_world_base = start.t_world_base;
    command.t_world_base.position_m[2] += 0.02;
    command.burr_speed_rad_per_s = 800.0;
    command
}

/// Stops a run, releases it, and waits for its end.
fn stopped(run: Run, pilot: Pilot) -> Ended {
    assert_eq!(pilot.client.ask(CONTROL_STOP, 0).status, CONTROL_DONE);
    drop(pilot);
    run.end_well()
}

/// Asserts silence at this tick.
fn assert_stands(pilot: &Pilot, tick: u64) {
    assert!(pilot.client.next_state_within(SILENCE).is_none(), "a tick was made while paused");
    wait_for("a status that says so", || {
        let status = pilot.client.status.receive_newest().unwrap()?;
        let status = status.message();
        assert!(status.tick <= tick);
        (status.tick == tick && status.phase == PHASE_PAUSED).then_some(())
    });
}

#[test]
fn ticks_advance_exactly_as_run_control_asks() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("lockstep", 100.0, ""));
    let mut pilot = Pilot::join(&run.session(), "pilot");
    let initial = pilot.next_state();
    let reply = pilot.client.ask(CONTROL_PAUSE, 0);
    assert_eq!((reply.status, reply.tick), (CONTROL_DONE, 0));
    pilot.answer(&initial, rest(&initial));
    assert_stands(&pilot, 0);

    for (count, last) in [(5, 5), (1, 6), (14, 20)] {
        assert_eq!(pilot.client.ask(CONTROL_STEP, count).status, CONTROL_DONE);
        let state = pilot.drive_to(last, rest);
        pilot.answer(&state, rest(&state));
        assert_stands(&pilot, last);
    }
    let unknown = pilot.client.ask(77, 0);
    assert_eq!((unknown.status, unknown.action, unknown.tick), (CONTROL_REFUSED, 77, 20));

    assert_eq!(pilot.client.ask(CONTROL_RESUME, 0).status, CONTROL_DONE);
    let state = pilot.drive_to(60, rest);
    let running = pilot.client.ask(CONTROL_STEP, 3);
    assert_eq!((running.status, running.tick), (CONTROL_REFUSED, 60));
    pilot.answer(&state, rest(&state));
    pilot.drive_to(80, rest);
    let stop = pilot.client.ask(CONTROL_STOP, 0);
    assert_eq!((stop.status, stop.tick), (CONTROL_DONE, 80));
    drop(pilot);
    let ended = run.end_well();
    assert_nothing_left(ended.pid);
    // Regression: it was reported as complete.
    assert!(ended.out.contains("piloted (lockstep), stopped\n"), "{}", ended.out);
    let marker = read(&ended.folder).marker.unwrap();
    assert_eq!((marker.last_tick, marker.reason), (Some(Tick(80)), EndReason::Stopped));
    assert_replays(&ended.folder);
}

/// Regression: steps were added without a bound: at the largest number, further ones wrapped round to zero.
/// And a request during the connection was answered with the phase "running".
#[test]
fn steps_without_end_stay_so_and_a_pause_before_the_start_is_no_start() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("lockstep", 100.0, ""));
    let mut pilot = Pilot::join(&run.session(), "pilot");
    // The physics has started, and waits for the pilot's first command.
    let initial = pilot.next_state();
    assert_eq!(pilot.client.ask(CONTROL_PAUSE, 0).status, CONTROL_DONE);
    let status = wait_for("the status", || pilot.client.status.receive_newest().unwrap());
    assert_eq!(status.message().phase, PHASE_CONNECTING);
    drop(status);
    pilot.answer(&initial, rest(&initial));
    assert_stands(&pilot, 0);
    for _ in 0..2 {
        assert_eq!(pilot.client.ask(CONTROL_STEP, u64::MAX - 1).status, CONTROL_DONE);
    }
    assert_eq!(pilot.client.ask(CONTROL_STEP, 4).status, CONTROL_DONE);
    pilot.drive_to(40, rest);
    stopped(run, pilot);
}

/// Returns a state without the fields that a reset does not restore: tick, time, hash, and the numbers of the
/// commands.
fn without_history(state: &State) -> State {
    let mut state = State { tick: 0, sim_time_s: 0.0, hash: [0; 2], ..*state };
    state.applied.iter_mut().for_each(|applied| applied.sequence = 0);
    state
}

#[test]
fn a_reset_sets_all_back_and_the_run_replays_identically() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("lockstep", 100.0, ""));
    let mut pilot = Pilot::join(&run.session(), "pilot");
    let start = pilot.drive_to(20, rest);
    pilot.answer(&start, rest(&start));
    let deep = pilot.drive_to(700, |_| drilling(&start));
    assert!(deep.removed_total > 0, "the burr has drilled");
    assert!(deep.t_world_base.position_m[2] > start.t_world_base.position_m[2] + 1e-3);
    pilot.answer(&deep, rest(&deep));
    pilot.drive_to(720, rest);
    let reply = pilot.client.ask(CONTROL_RESET, 0);
    assert_eq!((reply.status, reply.tick), (CONTROL_DONE, 720));
    let state = pilot.client.states.receive().unwrap();
    assert!(state.is_none(), "a reset makes no tick of its own");
    drop(state);
    // The state of tick 720 is still to be answered: the reset takes effect before that.
    pilot.sequence += 1;
    pilot.send(&Command { sequence: pilot.sequence, state_tick: 720, ..rest(&start) });
    let again = pilot.drive_to(900, |state| if state.tick < 760 { rest(state) } else { drilling(&start) });
    assert!(again.removed_total < deep.removed_total);
    // Regression: clients had to recognize a reset from the text of a general event.
    let told = pilot.client.events().into_iter().filter(|(code, _)| *code == EVENT_RESET);
    let told: Vec<String> = told.map(|(_, text)| text).collect();
    assert_eq!(told, ["reset: tick 720 began from the initial state"]);
    let ended = stopped(run, pilot);

    let log = read(&ended.folder);
    let resets: Vec<u64> =
        log.ticks.iter().filter(|tick| tick.latched.reset != 0).map(|t| t.latched.tick).collect();
    assert_eq!(resets, [720]);
    // The same command on the initial state gives the same states, bit for bit.
    for k in 0..20 {
        let (first, second) = (&log.ticks[k].state, &log.ticks[720 + k].state);
        assert!(without_history(first) == without_history(second), "tick {k} after the reset differs");
        assert_eq!(second.tick, 721 + k as u64);
    }
    assert_eq!(log.ticks[720].state.removed_total, 0);
    assert_eq!(log.ticks[720].restored.as_deref(), Some(&[][..]), "nothing was predrilled");
    let said = assert_replays(&ended.folder);
    assert!(said.contains("replayed 900 ticks"), "{said}");
}
