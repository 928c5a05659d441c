//! Programs that flood: nobody is held up, and what others ask for is heard.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use ipc_types::messages::{
    ARM_SERVO_CP, CONTROL_DONE, CONTROL_STOP, Command, DrrRequest, EVENT_COMMAND_REFUSED,
    EVENT_REQUEST_REFUSED, RunControl, State, TENDON_SERVO_JF,
};
use ipc_types::services;
use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE, Session};
use trabecula_client::ClientError;

use crate::common::client::Pilot;
use crate::common::logs::assert_replays;
use crate::common::program::{LIMIT, Place, Run, assert_nothing_left, wait_for};
use crate::common::scenes;
use crate::languages::{clients, output_of, python, skip};
use crate::strays::{answer_here, await_event, joined, stopped};

/// A thread that does something again and again until dropped, with a connection of its own.
struct Flood(Arc<AtomicBool>, Option<JoinHandle<()>>);

impl Flood {
    fn start<P>(
        run: &Run,
        port: impl FnOnce(&Session) -> P + Send + 'static,
        send: impl Fn(&P, u64) + Send + 'static,
    ) -> Flood {
        let (folder, over) = (run.session(), Arc::new(AtomicBool::new(false)));
        let told = Arc::clone(&over);
        let thread = std::thread::spawn(move || {
            let session = Session::join(&folder).unwrap();
            let port = port(&session);
            (1..).take_while(|_| !told.load(Ordering::Relaxed)).for_each(|count| send(&port, count));
        });
        Flood(over, Some(thread))
    }

    /// A `pilot` whose commands are all refused.
    fn of_refused_commands(run: &Run) -> Flood {
        Flood::start(
            run,
            |session| {
                let states = session.subscriber::<State>(&services::STATE).unwrap();
                let commands = session.command_publisher("pilot").unwrap();
                wait_for("the first state", || states.receive().unwrap().map(|_| ()));
                // The first one is taken, so that the run begins.
                let command = Command { sequence: 1, ..Command::zeroed() };
                commands.send(&command).unwrap();
                wait_for("the first tick", || {
                    let state = states.receive().unwrap()?;
                    (state.message().tick > 0).then_some(())
                });
                commands
            },
            |commands, count| {
                let mut command =
                    Command { sequence: 1 + count, tendon_mode: TENDON_SERVO_JF, ..Command::zeroed() };
                command.tendon_force_n[0] = f64::NAN;
                // The hub may have ended.
                let _ = commands.send(&command);
            },
        )
    }
}

impl Drop for Flood {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
        let ended = self.1.take().unwrap().join();
        assert!(ended.is_ok() || std::thread::panicking());
    }
}

/// While messages came, the limit of a controller and run control were not looked at: a flood of refused commands held a
/// lockstep run for ever.
#[test]
fn a_controller_that_floods_with_refused_commands_is_silent_in_lockstep() {
    let place = Place::new();
    let scene =
        scenes::shared("lockstep", 600.0).replace("seed = 7", "seed = 7\ncontroller_limit_ms = 700.0");
    let run = place.start(&scene);
    let flood = Flood::of_refused_commands(&run);
    let ended = run.end();
    drop(flood);
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    assert!(ended.err.contains("controller `pilot` did not answer tick"), "{}", ended.err);
    assert_replays(&ended.folder);
}

#[test]
fn a_stop_is_heard_while_a_controller_floods_in_lockstep() {
    let place = Place::new();
    let scene =
        scenes::shared("lockstep", 600.0).replace("seed = 7", "seed = 7\ncontroller_limit_ms = 60000.0");
    let run = place.start(&scene);
    let flood = Flood::of_refused_commands(&run);
    let mut observer = joined(&run, "");
    while observer.status().unwrap().is_none_or(|status| status.refused_commands < 1000) {
        std::thread::yield_now();
    }
    let ended = stopped(run, observer, flood);
    assert_nothing_left(ended.pid);
}

/// The queue of run control was emptied without a bound: who filled it as fast stopped the ticks, and nobody else's
/// request was read.
#[test]
fn a_flood_of_run_control_stops_no_tick_and_no_other_request() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 120.0));
    let mut observer = joined(&run, "");
    let tick = observer.wait_state(LIMIT).unwrap().tick;
    let flood = Flood::start(
        &run,
        |session| session.publisher::<RunControl>(&services::RUN_CONTROL).unwrap(),
        |requests, request_id| {
            let request = RunControl { request_id, ticks: 0, action: 77, reserved: 0 };
            let _ = requests.send(&request);
        },
    );
    while observer.wait_state(LIMIT).unwrap().tick < tick + 500 {}
    let ended = stopped(run, observer, flood);
    assert_replays(&ended.folder);
}

/// A scene with X-ray frames in lockstep, of which `mine` and `other` may ask for frames.
fn with_frames() -> String {
    let text = std::fs::read_to_string(clients().join("scenes/image_guided.toml")).unwrap();
    format!("{text}\n[[controller]]\nname = \"other\"\ndrives = []\nexternal = true\noptional = true\n")
}

/// All programs shared 16 waiting places, and a request for a tick beyond the run's end kept its place for ever.
#[test]
fn a_flood_of_requests_takes_no_frame_from_another_program() {
    let place = Place::new();
    let run = place.start(&with_frames());
    let mut mine = joined(&run, "mine");
    mine.next_event().unwrap();
    mine.wait_state(LIMIT).unwrap();
    let flood = Flood::start(
        &run,
        |session| session.publisher::<DrrRequest>(&services::DRR_REQUEST).unwrap(),
        |requests, request_id| {
            // Beyond the end of the run, and far ahead within it.
            let tick = if request_id % 2 == 0 { 1_000_000_000 } else { 999 };
            let request = DrrRequest { request_id, tick, requester: u32::MAX, ..DrrRequest::zeroed() };
            let _ = requests.send(&request);
        },
    );
    await_event(&mut mine, EVENT_REQUEST_REFUSED, "`tick` is 1000000000, the run ends at 1000");
    await_event(&mut mine, EVENT_REQUEST_REFUSED, "more frame requests refused");
    for tick in 0..40 {
        if tick % 20 == 0 {
            let request = mine.request_frame(None, tick).unwrap();
            let frame = mine.wait_frame(request, LIMIT).unwrap().frame;
            assert_eq!((frame.request_id, frame.tick), (request, tick));
        }
        answer_here(&mut mine);
        mine.wait_state(LIMIT).unwrap();
    }
    let ended = stopped(run, mine, flood);
    assert_replays(&ended.folder);
}

/// Two clients of one process counted from the same number: each took the other's frame for its own.
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

/// Waiting for a frame, for the volume or for run control went on after the run's end until the caller's own limit.
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

#[test]
fn floods_of_a_python_client_hold_nobody_up() {
    let python = match python() {
        Ok(python) => python,
        Err(reason) => return skip(&reason),
    };
    let place = Place::new();
    let run = place.start(&with_frames());
    let mut command = std::process::Command::new(python);
    command.arg(clients().join("python/tests/floods.py"));
    command.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "mine");
    assert_eq!(output_of(&mut command), "ended\n");
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_nothing_left(ended.pid);
    assert_replays(&ended.folder);
}

/// Each was an event of its own, a thousand a second, which pushed everybody else's out of the queue.
#[test]
fn refusals_of_unreachable_goals_are_rationed() {
    let place = Place::new();
    let scene = scenes::shared("lockstep", 600.0);
    let run = place.start(&scene);
    let mut pilot = Pilot::join(&run.session(), "pilot");
    let mut events = pilot.client.events();
    let far_away = |state: &State| {
        let mut command = Command { arm_mode: ARM_SERVO_CP, ..Command::zeroed() };
        command.t_world_base = state.t_world_base;
        command.t_world_base.position_m[0] += 10.0;
        command
    };
    let ticks = 5000;
    for tick in (0..=ticks).step_by(100) {
        let state = pilot.drive_to(tick, far_away);
        pilot.answer(&state, far_away(&state));
        events.extend(pilot.client.events());
    }
    pilot.drive_to(ticks + 1, far_away);
    assert_eq!(pilot.client.ask(CONTROL_STOP, 0).status, CONTROL_DONE);
    drop(pilot);
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    let of_refusals = events.iter().filter(|(code, _)| *code == EVENT_COMMAND_REFUSED);
    let (more, each): (Vec<_>, Vec<_>) =
        of_refusals.partition(|(_, text)| text.contains("more commands refused"));
    assert!(!each.is_empty() && each.len() as u64 * 2 < ticks, "{} events of {ticks}", each.len());
    assert!(!more.is_empty(), "what was not said is said together");
    assert_replays(&ended.folder);
}
