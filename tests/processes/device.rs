//! `trabecula device`, with recorded events and through a pipe: the same records as of a device node.

use std::fs::OpenOptions;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use ipc_types::messages::{ArmMode, BurrMode, CONTROL_RESET, SOURCE_SAFE, State};
use nalgebra::Isometry3;
use ros_interface::robot::isometry;
use rustix::process::Signal;

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Guarded, LIMIT, Place, Run, assert_nothing_left, first_line, signal, wait_for};
use crate::common::scenes;
use crate::strays::{joined, stopped};

const MAPPING: &str = "
frame = \"patient\"
clutch = \"BTN_TL\"
map = [
  { input = \"ABS_X\", output = \"x\", rate = 10.0, range = [-100, 0, 100] },
  { input = \"ABS_RY\", output = \"tendon_0\", rate = 1.0, range = [-100, 0, 100] },
  { input = \"ABS_RZ\", output = \"burr\", rate = 6000.0, range = [0, 0, 100] },
]
";
const CLUTCH: (u16, u16) = (1, 0x136);
const X: (u16, u16) = (3, 0);
const PULL: (u16, u16) = (3, 4);
const BURR: (u16, u16) = (3, 5);

/// A `struct input_event` of a 64-bit kernel, by linux/input.h.
fn record(time_us: i64, (kind, code): (u16, u16), value: i32) -> Vec<u8> {
    let mut bytes = [(time_us / 1_000_000).to_ne_bytes(), (time_us % 1_000_000).to_ne_bytes()].concat();
    bytes.extend([kind.to_ne_bytes(), code.to_ne_bytes()].as_flattened());
    bytes.extend(value.to_ne_bytes());
    bytes
}

fn device(place: &Place, session: &Path, more: &[&str]) -> Command {
    let mapping = place.path("map.toml");
    std::fs::write(&mapping, MAPPING).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.args(["device", "gamepad", "--controller", "pilot", "--session"]).arg(session);
    command.arg("--mapping").arg(mapping).args(more);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Returns exit code, output and errors of a program that ends by itself.
fn ended(mut process: Guarded) -> (Option<i32>, String, String) {
    let code = wait_for("the device's end", || process.0.try_wait().unwrap()).code();
    let (mut out, mut err) = (String::new(), String::new());
    process.0.stdout.take().unwrap().read_to_string(&mut out).unwrap();
    process.0.stderr.take().unwrap().read_to_string(&mut err).unwrap();
    (code, out, err)
}

/// The tool's base without its deflection, of which the initial state has none.
fn base(initial: &State, state: &State) -> Isometry3<f64> {
    let t_flange_base = isometry(&initial.t_world_flange).inverse() * isometry(&initial.t_world_base);
    isometry(&state.t_world_flange) * t_flange_base
}

/// Runs 0.7 s in lockstep, driven by recorded events; returns the folder with the log.
fn recorded_run(place: &Place) -> PathBuf {
    let run = place.start(&scenes::piloted("lockstep", 0.7, ""));
    let events = [
        (0, X, 0),
        (50, CLUTCH, 1),
        (100, X, 50),
        (200, BURR, 50),
        (220, PULL, -100),
        (300, X, 0),
        (350, X, -100),
        (400, CLUTCH, 0),
        (450, CLUTCH, 1),
    ];
    // The kernel's times are of no day in particular.
    let of = |(ms, input, value): &(i64, _, _)| record(1_700_000_000_000_000 + 1000 * ms, *input, *value);
    let file = place.path("events.bin");
    std::fs::write(&file, events.iter().flat_map(of).collect::<Vec<u8>>()).unwrap();
    let more = ["--events", file.to_str().unwrap(), "--json"];
    let process = Guarded(device(place, &run.session(), &more).spawn().unwrap());
    let (code, out, err) = ended(process);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    let figures: serde_json::Value = serde_json::from_str(&out).unwrap();
    let expected = (&9.into(), &701.into());
    assert_eq!(
        (&figures["events"], &figures["commands"]),
        expected,
        "the last state is answered, too: {out}"
    );
    assert!(figures["latency_p50_ms"].is_null(), "a recording has no latency");
    run.end_well().folder
}

#[test]
fn a_recorded_stream_drives_the_arm_exactly_and_its_rates_run_out() {
    let (place, other) = (Place::new(), Place::new());
    let folder = recorded_run(&place);
    let log = read(&folder);
    let initial = &log.initial;
    let latched = |tick: usize| log.ticks[tick].latched.commands[0].command;
    let before = |tick: usize| &log.ticks[tick - 1].state;
    for tick in [0, 49] {
        assert_eq!((latched(tick).arm_mode, latched(tick).burr_mode, latched(tick).tendon_mode), (0, 0, 0));
    }
    assert_eq!(latched(99).arm_mode(), Ok(ArmMode::Hold), "engaged, and nothing is deflected");
    // 5 mm/s from tick 100 to 300; nothing to 350; then -10 mm/s, until the clutch is released at 400.
    let start = base(initial, before(100)).translation.vector;
    for (tick, moved_mm) in [(100, 0.005), (150, 0.255), (299, 1.0), (349, 1.0), (350, 0.99), (399, 0.5)] {
        let goal = isometry(&latched(tick).t_world_base);
        assert_eq!(latched(tick).arm_mode(), Ok(ArmMode::ServoCp), "tick {tick}");
        let moved = goal.translation.vector - start;
        assert!((moved - nalgebra::Vector3::x() * moved_mm * 1e-3).norm() < 1e-12, "tick {tick}: {moved}");
        assert!(goal.rotation.angle_to(&base(initial, initial).rotation) < 1e-7);
    }
    let burr = |tick: usize| latched(tick).burr_speed_rad_per_s;
    let pull = |tick: usize| latched(tick).tendon_velocity_m_per_s[0];
    assert_eq!((burr(199), pull(219)), (0.0, 0.0));
    assert!((burr(200) - 100.0 * core::f64::consts::PI).abs() < 1e-9 && (pull(220) + 1e-3).abs() < 1e-15);
    for tick in [400, 449] {
        assert_eq!((latched(tick).arm_mode(), burr(tick), pull(tick)), (Ok(ArmMode::Hold), 0.0, 0.0));
    }
    // Held over the clutch; from the arm's own place on, not from the old goal.
    let again = base(initial, before(450)).translation.vector.x - 1e-5;
    assert!((latched(450).t_world_base.position_m[0] - again).abs() < 1e-12);
    // The last event was at 450: nothing moves later than 0.1 s after it.
    assert!(burr(549) > 0.0 && latched(549).arm_mode() == Ok(ArmMode::ServoCp));
    for tick in [551, 699] {
        assert_eq!((latched(tick).arm_mode(), burr(tick), pull(tick)), (Ok(ArmMode::Hold), 0.0, 0.0));
    }
    // The arm has followed: the burr's first way is 1 mm, less what the servo lags.
    let way_mm = 1e3 * (before(349).t_world_burr.position_m[0] - initial.t_world_burr.position_m[0]);
    assert!((0.9..1.1).contains(&way_mm), "{way_mm} mm");
    assert_replays(&folder);
    assert_eq!(log.marker.unwrap().hash, read(&recorded_run(&other)).marker.unwrap().hash);
}

fn pipe(place: &Place) -> PathBuf {
    let path = place.path("pipe");
    let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
    rustix::fs::mkfifoat(rustix::fs::CWD, &path, mode).unwrap();
    path
}

fn now_us() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_micros() as i64
}

/// Holds the clutch, moves the stick 50 times, and waits until the burr turns and the arm moves.
fn drive(pipe: &Path, run: &Run) -> std::fs::File {
    let mut observer = joined(run, "");
    // Events before the first tick have no command to measure.
    while observer.wait_state(LIMIT).unwrap().tick < 10 {}
    let mut writer = OpenOptions::new().write(true).open(pipe).unwrap();
    let mut send = |input, value| writer.write_all(&record(now_us(), input, value)).unwrap();
    send(CLUTCH, 1);
    send(BURR, 50);
    for value in 1..=50 {
        send(X, value);
        std::thread::sleep(Duration::from_millis(2));
    }
    await_motion(run);
    writer
}

fn await_motion(run: &Run) {
    let mut observer = joined(run, "");
    wait_for("motion", || {
        let state = observer.wait_state(LIMIT).unwrap();
        (state.burr_speed_rad_per_s > 300.0 && state.arm_mode() == Ok(ArmMode::ServoCp)).then_some(())
    });
}

fn await_rest(run: &Run) {
    let mut observer = joined(run, "");
    wait_for("rest", || {
        let state = observer.wait_state(LIMIT).unwrap();
        (state.burr_speed_rad_per_s == 0.0 && state.arm_mode() == Ok(ArmMode::Hold)).then_some(())
    });
}

#[test]
fn a_device_that_vanishes_or_is_interrupted_stops_what_it_moved() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("realtime", 600.0, "hold_ticks = 20"));
    let path = pipe(&place);
    let more = ["--device", path.to_str().unwrap()];
    let start = || {
        let mut process = Guarded(device(&place, &run.session(), &more).spawn().unwrap());
        let line = first_line(&mut process.0);
        assert!(line.contains("drives controller pilot"), "{line}");
        process
    };

    let vanishing = start();
    let writer = drive(&path, &run);
    let (code, _, err) = ended(Guarded(device(&place, &run.session(), &more).spawn().unwrap()));
    assert_eq!(code, Some(2));
    assert!(err.contains("`pilot` is already connected"), "{err}");
    drop(writer);
    let (code, out, err) = ended(vanishing);
    assert_eq!(code, Some(1));
    assert!(err.contains("closed by its writer; everything that it moved has been stopped"), "{err}");
    assert!(out.starts_with("52 events, ") && out.contains("from an event to its command: median "), "{out}");
    println!("{}", out.trim());
    await_rest(&run);

    let interrupted = start();
    let mut writer = drive(&path, &run);
    // Regression: after a reset the arm went back to where it had been, and the burr turned on.
    joined(&run, "").run_control(CONTROL_RESET, 0, LIMIT).unwrap();
    await_rest(&run);
    for (input, value) in [(CLUTCH, 0), (CLUTCH, 1), (X, 60), (BURR, 60)] {
        writer.write_all(&record(now_us(), input, value)).unwrap();
    }
    await_motion(&run);
    signal(interrupted.0.id(), Signal::INT);
    let (code, out, err) = ended(interrupted);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    println!("{}", out.trim());
    await_rest(&run);
    drop(writer);

    let mut killed = start();
    let writer = drive(&path, &run);
    killed.0.kill().unwrap();
    await_rest(&run);
    drop(writer);
    let observer = joined(&run, "");
    let ended = stopped(run, observer, ());
    // Two clients have stopped the burr themselves, one of them after a reset as well; physics replaced the
    // killed one's last command.
    let log = read(&ended.folder);
    let latched = log.ticks.iter().map(|tick| &tick.latched.commands[0]);
    let own = latched.filter(|it| it.source != SOURCE_SAFE && it.command.burr_mode() == Ok(BurrMode::Speed));
    let turns: Vec<bool> = own.map(|latched| latched.command.burr_speed_rad_per_s > 0.0).collect();
    assert_eq!(turns.windows(2).filter(|pair| pair[0] && !pair[1]).count(), 3);
    assert_eq!(turns.last(), Some(&true));
    assert_replays(&ended.folder);
    assert_nothing_left(ended.pid);
}
