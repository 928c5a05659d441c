//! Origin of messages: programs of the same user that impersonate a part of the hub, or keep writing to what
//! they have sent.

use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use ipc_types::messages::{
    ARM_HOLD, Command, EVENT_REQUEST_REFUSED, Progress, SENDER_RECORDER, SOURCE_FRESH, TENDON_SERVO_JF,
};
use ipc_types::messages::{Part, services};
use ipc_types::session::{Reader, Session, SessionError, SessionId};
use rustix::process::Signal;
use test_support::limited::SetAtEnd;
use zerocopy::IntoBytes;

use crate::common::client::{Client, Pilot, bare_port, send_bare};
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left, signal, wait_for};
use crate::common::scenes;
use crate::strays::{await_event, joined, stopped};

fn progress(tick: u64) -> Progress {
    Progress { tick, lost_messages: 0, consumer: SENDER_RECORDER, reserved: 0 }
}

/// Regression: every client could report progress for the recorder: that it had received messages that it had
/// not, so that the ticks ran ahead of it; or that it was stuck, so that they stopped.
#[test]
fn progress_from_a_foreign_program_neither_lifts_nor_stalls_lockstep() {
    let place = Place::new();
    let run = place.start(&scenes::hold("lockstep", 600.0));
    let mut observer = joined(&run, "");
    observer.next_event().unwrap();
    let watcher = Client::join(&run.session());
    let stranger = Session::join(&run.session()).unwrap();
    let physics = stranger.waker(Reader::Physics).unwrap();
    let refusal = stranger.publisher::<Progress>(&services::PROGRESS).unwrap_err();
    assert!(matches!(refusal, SessionError::Reserved { .. }), "{refusal}");
    let port = bare_port(&stranger, "progress", size_of::<Progress>());
    // A recorder that has not connected yet has not claimed its part, and would be waited for in another way.
    let mut last = watcher.wait_for_state(|state| state.tick > 0).tick;
    let taken = stranger.claim(Part::Recorder).unwrap_err();
    assert!(matches!(taken, SessionError::PartTaken { .. }), "{taken}");
    let recorder = run.part("recorder");
    signal(recorder, Signal::STOP);
    let newest = || {
        let mut newest = None;
        while let Some(state) = watcher.states.receive().unwrap() {
            newest = Some(state.message().tick);
        }
        newest
    };
    // It runs ahead of the stopped recorder for a while, and then waits for it: quiet for longer than a busy
    // machine explains.
    let mut quiet_looks = 0;
    wait_for("the wait for the recorder", || {
        std::thread::sleep(Duration::from_millis(200));
        match newest() {
            Some(tick) => (last, quiet_looks) = (tick, 0),
            None => quiet_looks += 1,
        }
        (quiet_looks == 10).then_some(())
    });
    for _ in 0..100 {
        send_bare(&port, progress(u64::MAX / 2).as_bytes());
        physics.wake();
        std::thread::sleep(Duration::from_millis(2));
    }
    assert_eq!(newest(), None, "nobody else lifts the wait at tick {last}");
    signal(recorder, Signal::CONT);
    // The physics reports this as soon as it continues.
    await_event(&mut observer, EVENT_REQUEST_REFUSED, "neither the DRR process nor the recorder");
    // Reports that would block it forever have no effect.
    wait_for("3000 ticks beside the stranger's reports", || {
        send_bare(&port, progress(0).as_bytes());
        newest().filter(|tick| *tick >= last + 3000)
    });
    let ended = stopped(run, observer, (port, physics, stranger, watcher));
    assert_nothing_left(ended.pid);
    assert!(read(&ended.folder).marker.unwrap().lost.is_empty());
    assert_replays(&ended.folder);
}

/// Regression: without X-ray and keyframes the ports of their services are free; seven bytes over one of them
/// ended the recorder.
#[test]
fn a_foreign_program_on_a_free_port_of_a_part_does_not_end_the_recorder() {
    let place = Place::new();
    let scene = scenes::hold("realtime", 600.0) + "\n[recording]\nkeyframe_interval_s = 0.0\n";
    let run = place.start(&scene);
    let mut observer = joined(&run, "");
    observer.next_event().unwrap();
    let first = observer.wait_state(crate::common::program::LIMIT).unwrap().tick;
    let stranger = Session::join(&run.session()).unwrap();
    let ports = ["keyframe", "drr_reply", "frame_timing"].map(|name| bare_port(&stranger, name, 4096));
    for port in &ports {
        for length in [7, 64, 4096] {
            send_bare(port, &vec![0x5a; length]);
        }
    }
    await_event(&mut observer, EVENT_REQUEST_REFUSED, "reserved for parts of the hub; not recorded");
    while observer.wait_state(crate::common::program::LIMIT).unwrap().tick < first + 500 {}
    let ended = stopped(run, observer, (ports, stranger));
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    assert!(log.marker.unwrap().lost.is_empty() && log.ticks.len() > 500);
    assert_replays(&ended.folder);
}

/// A program keeps writing to a command that it has sent, while the physics decides on it: the latched
/// command is the one that was checked.
#[test]
fn a_writer_that_keeps_writing_changes_no_decision() {
    const HONEST_N: f64 = 2.718_043_917_265;
    /// More than any tendon can bear.
    const FORGED_N: f64 = 9.876_543_21e6;
    let place = Place::new();
    let run = place.start(&scenes::shared("realtime", 600.0));
    let observer = joined(&run, "");
    let mut pilot = Pilot::join(&run.session(), "pilot");
    let mut honest = Command { tendon_mode: TENDON_SERVO_JF, arm_mode: ARM_HOLD, ..Command::zeroed() };
    honest.tendon_force_n[0] = HONEST_N;
    let state = pilot.next_state();
    pilot.answer(&state, honest);
    let over = AtomicBool::new(false);
    let memory = command_memory(&run.session(), HONEST_N);
    std::thread::scope(|scope| {
        let _over = SetAtEnd(&over);
        scope.spawn(|| {
            let file = File::options().read(true).write(true).open(&memory).unwrap();
            let mut bytes = vec![0; file.metadata().unwrap().len() as usize];
            while !over.load(Ordering::Relaxed) {
                file.read_exact_at(&mut bytes, 0).unwrap();
                let places: Vec<u64> =
                    places_of(&bytes, HONEST_N).chain(places_of(&bytes, FORGED_N)).collect();
                for turn in 0..400 {
                    let force = if turn % 2 == 0 { FORGED_N } else { HONEST_N };
                    for place in &places {
                        file.write_all_at(&force.to_le_bytes(), *place).unwrap();
                    }
                }
            }
        });
        let first = state.tick;
        loop {
            let state = pilot.next_state();
            if state.tick > first + 3000 {
                break;
            }
            pilot.answer(&state, honest);
        }
    });
    drop(pilot);
    let ended = stopped(run, observer, ());
    let log = read(&ended.folder);
    let commands = log.ticks.iter().map(|tick| tick.latched.commands[0]);
    let fresh: Vec<f64> = commands
        .filter(|latched| latched.source == SOURCE_FRESH)
        .map(|latched| latched.command.tendon_force_n[0])
        .collect();
    assert!(fresh.len() > 100, "{} fresh commands", fresh.len());
    assert!(fresh.iter().all(|force_n| *force_n == HONEST_N), "{fresh:?}");
    assert_replays(&ended.folder);
}

/// Returns the segment of this process's commands: the one of a session's that contains the force.
fn command_memory(session: &std::path::Path, force_n: f64) -> PathBuf {
    let prefix = SessionId::of(session).unwrap().shared_memory_prefix();
    wait_for("the command in shared memory", || {
        let entries = fs::read_dir("/dev/shm").unwrap().flatten().map(|entry| entry.path());
        let mut ours = entries.filter(|path| {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let number = name.trim_end_matches(".data").rsplit('_').next().unwrap().parse::<u128>();
            name.starts_with(&prefix)
                && number.is_ok_and(|number| (number >> 64) as u32 == std::process::id())
        });
        ours.find(|path| places_of(&fs::read(path).unwrap_or_default(), force_n).next().is_some())
    })
}

/// Returns the offsets of a number in some bytes.
fn places_of(bytes: &[u8], number: f64) -> impl Iterator<Item = u64> + '_ {
    let pattern = number.to_le_bytes();
    bytes.windows(8).enumerate().filter(move |(_, window)| *window == pattern).map(|(place, _)| place as u64)
}
