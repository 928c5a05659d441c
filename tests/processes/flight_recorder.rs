//! The flight recorder: what triggers save, what remains on disk, and that it all replays.

use std::collections::BTreeMap;
use std::path::Path;

use ipc_types::messages::{ARM_HOLD, EventCode, TENDON_SERVO_JF};
use run_log::hash_text;
use rustix::process::Signal;
use trabecula_client::Client;

use crate::common::logs::{assert_replays, events, read};
use crate::common::program::{Ended, LIMIT, Place, Run, call, only_entry, signal, succeed, trabecula};
use crate::common::scenes;
use crate::strays::joined;

/// Ticks of the run, and those of its triggers: a remark, a tension, a request, and a remark too many.
const TICKS: u64 = 8000;
const REMARK: u64 = 2500;
const TENSION: u64 = 4500;
const REQUEST: u64 = 6500;
const TOO_MANY: u64 = 7500;
/// Ticks before and after a trigger.
const BEFORE: u64 = 1000;
const AFTER: u64 = 300;

fn scene(recording: &str) -> String {
    format!(
        "{}[recording]\nkeyframe_interval_s = 0.1\n{recording}",
        scenes::shared("lockstep", TICKS as f64 * 1e-3)
    )
}

fn ring() -> String {
    let triggers = "triggers = [\"controller\", \"tendon_tension_n[0] > 3\"]";
    scene(&format!("ring_s = 1.0\nafter_s = 0.3\nsaved_at_most = 3\n{triggers}\n"))
}

/// Names of the run's folders for logs, by prefix.
fn folders(output: &Path, prefix: &str) -> Vec<String> {
    let names = output.read_dir().unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = names.filter(|name| name.starts_with(prefix)).collect();
    names.sort();
    names
}

/// Drives a run to its end with commands that are a function of the tick.
fn drive(run: Run, mut at: impl FnMut(u64, &mut Client)) -> Ended {
    let mut pilot = joined(&run, "pilot");
    for tick in 0..TICKS {
        assert_eq!(pilot.next_state(LIMIT).unwrap().tick, tick);
        at(tick, &mut pilot);
        let command = pilot.command().unwrap();
        (command.tendon_mode, command.arm_mode) = (TENDON_SERVO_JF, ARM_HOLD);
        command.tendon_force_n[0] = if (TENSION..TENSION + 200).contains(&tick) { 5.0 } else { 1.0 };
        pilot.send().unwrap();
    }
    drop(pilot);
    run.end_well()
}

#[test]
fn three_triggers_save_three_logs_that_replay_and_the_end_is_kept() {
    let place = Place::new();
    let whole = drive(place.start(&scene("")), |_, _| ());
    let whole_log = whole.folder.clone();
    let expected: BTreeMap<u64, [u64; 2]> =
        read(&whole_log).ticks.iter().map(|tick| (tick.state.tick, tick.state.hash)).collect();
    assert_eq!(expected.len() as u64, TICKS);

    let other = Place::new();
    let run = other.start(&ring());
    let session = run.session();
    let output = only_entry(&other.path("out"));
    let mut answer = String::new();
    let ended = drive(run, |tick, pilot| {
        if tick == REMARK || tick == TOO_MANY {
            pilot.remark(0, "look at this").unwrap();
        }
        if tick == REQUEST {
            answer = succeed(&[&"session", &"save", &session, &"--after", &"0.4"]).out;
            let early = trabecula(&[&"log", &"info", &output]);
            assert!(early.code == Some(2) && early.err.contains("last seconds in ring-"), "{}", early.err);
        }
        if tick % 100 == 0 {
            let open = folders(&output, "ring-");
            assert!(open.len() <= 5, "{open:?}");
        }
    });
    assert!(answer.contains(": saved-3: ticks ") && answer.contains("requested by a client"), "{answer}");
    assert_eq!(folders(&output, "ring-"), Vec::<String>::new());
    assert_eq!(folders(&output, "saved-"), ["saved-1", "saved-2", "saved-3"]);
    let triggers = [
        ("saved-1", REMARK, AFTER, "controller"),
        ("saved-2", TENSION, AFTER, "tendon_tension_n[0] > 3 ("),
        ("saved-3", REQUEST, 400, "requested by a client"),
        ("", TICKS, 0, "completed"),
    ];
    for (name, tick, after, cause) in triggers {
        let log = output.join(name);
        let text = assert_replays(&log);
        assert!(!text.contains("not replayed"), "{text}");
        let found = read(&log);
        let (first, last) = (found.initial.tick, found.ticks.last().unwrap().state.tick);
        assert!(first + BEFORE <= tick + 2 && tick + after <= last, "{name}: {first} to {last}");
        assert!(last - first <= 5 * BEFORE, "{name}: {first} to {last}");
        for record in &found.ticks {
            assert_eq!(record.state.hash, expected[&record.state.tick], "{name}, tick {}", record.state.tick);
        }
        let info = succeed(&[&"log", &"info", &log]).out;
        assert!(info.contains("verdict     intact") && info.contains(cause), "{info}");
        assert!(info.contains(&format!("from the keyframe of tick {first}")), "{info}");
        let timing = succeed(&[&"log", &"info", &log.join("timing.mcap")]).out;
        assert!(timing.contains("verdict     intact") && timing.contains(cause), "{timing}");
    }
    let table = other.path("saved-2.csv");
    let field = "tendon_tension_n[0]";
    succeed(&[&"log", &"export", &output.join("saved-2"), &"-o", &table, &"--field", &field]);
    assert!(std::fs::read_to_string(&table).unwrap().lines().count() > 1000);
    let differs = trabecula(&[&"log", &"diff", &output.join("saved-2"), &whole_log]);
    assert!(
        differs.out.contains("ticks are only in") && !differs.out.contains("tick differs"),
        "{}",
        differs.out
    );
    let late = output.join("saved-2");
    let refusals: [(&[&dyn AsRef<std::ffi::OsStr>], &str); 4] = [
        (&[&"plan", &"--check", &late], "only a log from the start of its run can be compared"),
        (&[&"replay", &late, &"--controller", &"true"], "can be replayed with programs"),
        (&[&"replay", &late, &"--to", &"5"], "--to is tick 5, but the log begins at tick"),
        (&[&"replay", &late, &"--from", &"5"], "--from is tick 5, but the log begins at tick"),
    ];
    for (arguments, part) in refusals {
        let done = trabecula(arguments);
        assert!(done.code == Some(2) && done.err.contains(part), "{}{}", done.out, done.err);
    }
    let refused = events(&output, EventCode::LogSaved);
    assert!(refused.iter().any(|(_, text)| text.contains("not saved: controller")), "{refused:?}");
    let logs = &ended.summary()["logs"];
    assert_eq!(logs["saved"], serde_json::json!(["saved-1", "saved-2", "saved-3"]));
    assert_eq!(logs["first_tick"], read(&output).initial.tick);
    assert_eq!(ended.summary()["final_hash"], whole.summary()["final_hash"]);
    assert_eq!(ended.summary()["final_hash"], hash_text(expected[&TICKS]));
    assert!(
        ended.out.contains("\nkept         from tick ") && ended.out.contains("\nsaved        saved-1, "),
        "{}",
        ended.out
    );
}

/// A recorder that is killed leaves its open logs, which replay as far as they were written.
#[test]
fn a_killed_flight_recorder_leaves_logs_that_replay() {
    let place = Place::new();
    let run = place.start(&ring());
    let recorder = run.part("recorder");
    let mut pilot = joined(&run, "pilot");
    let output = only_entry(&place.path("out"));
    for _ in 0..3000 {
        pilot.next_state(LIMIT).unwrap();
        let command = pilot.command().unwrap();
        (command.tendon_mode, command.arm_mode) = (TENDON_SERVO_JF, ARM_HOLD);
        pilot.send().unwrap();
    }
    signal(recorder, Signal::KILL);
    drop(pilot);
    assert_eq!(run.end().code, Some(1));
    let open = folders(&output, "ring-");
    let mut longest = 0;
    for log in open.iter().map(|name| output.join(name)) {
        let done = trabecula(&[&"replay", &log, &"--verify"]);
        // The newest log may not have begun.
        if done.code == Some(3) {
            let parts = ["all identical", "no end marker"];
            assert!(parts.iter().all(|part| done.out.contains(part)), "{}", done.out);
            longest = longest.max(read(&log).ticks.len() as u64);
        }
    }
    assert!(longest >= BEFORE - 100, "{open:?}: {longest} ticks");
}

#[test]
fn a_session_without_a_ring_saves_nothing() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 600.0));
    let session = run.session();
    let done = call(&["session", "save", session.to_str().unwrap()]);
    assert_eq!(done.code, Some(2), "{}", done.err);
    assert!(done.err.contains("has no flight recorder; set `recording.ring_s`"), "{}", done.err);
    signal(run.pid(), Signal::INT);
    assert_eq!(run.end().code, Some(130));
}
