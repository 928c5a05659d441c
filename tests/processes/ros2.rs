//! `trabecula bridge ros2`, with independent peers: `rclpy` over Fast DDS, and Cyclone DDS.
//!
//! Every test has its own DDS domain, locked on this machine, so that concurrent tests do not receive each
//! other's messages.

use std::fs::File;
use std::io::Read;
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use ipc_types::messages::{ControlAction, MAX_TENDONS, State};
use serde_json::Value;
use sim::{Drive, Sim};
use test_support::python::or_skip;

use crate::common::client::Client;
use crate::common::logs::{assert_replays, counts, read};
use crate::common::program::{
    Guarded, LIMIT, Place, assert_nothing_left, first_line, succeed, trabecula, wait_for,
};
use crate::common::scenes;
use crate::languages::output_within_limit;
use crate::strays::{joined, stopped};

/// A complete ROS 2 Jazzy as Python packages.
const ROS: [&str; 7] = [
    "ros-jazzy-rclpy[fastrtps]==7.1.6",
    "ros-jazzy-sensor-msgs==5.3.6",
    "ros-jazzy-geometry-msgs==5.3.6",
    "ros-jazzy-std-msgs==5.3.6",
    "ros-jazzy-visualization-msgs==5.3.6",
    "cyclonedds==11.0.1",
    "numpy==2.3.5",
];
const PROBE: &str = "rclpy, sensor_msgs.msg, geometry_msgs.msg, std_msgs.msg, visualization_msgs.msg, cyclonedds.domain, numpy";
/// Restricts Cyclone DDS to loopback.
const CYCLONE: &str = "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name=\"lo\" multicast=\"true\"/></Interfaces></General></Domain></CycloneDDS>";
/// Simulated time sufficient for any peer, however slowly it starts under load; the test ends the run when
/// the peer is done.
const LONG_S: f64 = 600.0;

fn python() -> Option<PathBuf> {
    or_skip("ros-jazzy-7.1.6", &ROS, PROBE)
}

/// A DDS domain that no other test on this machine uses, until it is dropped.
struct Domain {
    number: String,
    _lock: File,
}

impl Domain {
    fn new() -> Domain {
        let lock = |number: &u8| {
            let file = File::create(std::env::temp_dir().join(format!("trabecula-test-domain-{number}")));
            file.ok().filter(|file| file.try_lock().is_ok())
        };
        let (number, _lock) = (100..=200).find_map(|number| Some((number, lock(&number)?))).unwrap();
        Domain { number: number.to_string(), _lock }
    }
}

/// A peer's program in the bridge's domain, on loopback.
fn peer(python: &Path, script: &str, domain: &str) -> Command {
    let mut command = Command::new(python);
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/processes/ros2").join(script));
    command.env("ROS_DOMAIN_ID", domain).env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
    command.env("CYCLONEDDS_URI", CYCLONE);
    command
}

/// A bridge that is ready.
struct Bridge {
    process: Guarded,
    said: String,
}

impl Bridge {
    fn start(session: &Path, domain: &str, more: &[&str]) -> Bridge {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.args(["bridge", "ros2", "--domain-id", domain, "--session"]).arg(session).args(more);
        let mut process = Guarded(command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap());
        let said = first_line(&mut process.0);
        assert!(said.starts_with(&format!("ROS 2 domain {domain}, ")), "{said:?}");
        Bridge { process, said }
    }

    /// Returns the rest of its output, once its session is over.
    fn last(&mut self) -> String {
        let mut text = String::new();
        self.process.0.stdout.take().unwrap().read_to_string(&mut text).unwrap();
        text
    }

    /// Returns its exit code, once its session is over.
    fn end(mut self) -> Option<i32> {
        wait_for("the bridge's end", || self.process.0.try_wait().unwrap()).code()
    }
}

/// The default scene with the controller `ros` replacing the built-in one.
fn default_scene(duration_s: f64) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/femur_curved_drilling.toml");
    let text = std::fs::read_to_string(path).unwrap();
    let (scene, _) = text.split_once("[[controller]]").unwrap();
    let scene = scene.replace("duration_s = 24.0", &format!("duration_s = {duration_s:?}"));
    let controller =
        "[[controller]]\nname = \"ros\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n";
    format!("{scene}{controller}connect_limit_s = 120.0\n")
}

/// Hounsfield units of a volume file as bytes, x fastest.
fn raw_bytes(volume: &Path) -> Vec<u8> {
    volume_io::read(volume).unwrap().hu.iter().flat_map(|hu| hu.to_le_bytes()).collect()
}

#[test]
fn a_crtk_program_that_knows_nothing_of_us_drills_the_default_scene_and_the_log_replays() {
    let Some(python) = python() else { return };
    let place = Place::new();
    let run = place.start(&default_scene(LONG_S));
    let domain = Domain::new();
    let mut bridge = Bridge::start(&run.session(), &domain.number, &["--controller", "ros"]);
    assert!(bridge.said.contains("subscribed to 13 topics"), "{}", bridge.said);
    let client = Client::join(&run.session());
    // The program has the CT, as a surgeon does, and rebuilds the drilled one from what it receives.
    let [ct, rebuilt, drilled] = ["ct.nrrd", "rebuilt.raw", "drilled.nrrd"].map(|name| place.path(name));
    succeed(&[&"phantom", &"femur", &"-o", &ct]);
    let raw = place.path("ct.raw");
    std::fs::write(&raw, raw_bytes(&ct)).unwrap();
    let mut drilling = peer(&python, "crtk_drilling.py", &domain.number);
    drilling.args(["0.028", "0.003", "8"]).arg(&raw).arg(&rebuilt);
    let seen: Value = serde_json::from_str(&output_within_limit(&mut drilling)).unwrap();
    let ended = client.stop(run);
    let last = bridge.last();
    assert_eq!(bridge.end(), Some(0));
    assert_nothing_left(ended.pid);

    // Of twenty X-rays asked for, those not shown were rejected.
    let (before, _) = last.split_once(" of them rejected").unwrap();
    let rejected: usize = before.rsplit(' ').next().unwrap().parse().unwrap();
    assert_eq!(seen["places_px"].as_array().unwrap().len() + rejected, 20, "{last} {seen}");
    let names = seen["nodes"].as_array().unwrap();
    assert!(names.contains(&"trabecula_bridge".into()), "{seen}");
    assert_eq!(seen["joints"][0], "shoulder_pan_joint");
    assert!((seen["inserted_m"].as_f64().unwrap() - 0.028).abs() < 0.5e-3, "{seen}");
    assert!((seen["tension_n"][0].as_f64().unwrap() - 8.0).abs() < 0.1, "{seen}");
    // The built-in controller's path is an arc of 63 degrees, with 8 N at its end.
    assert!((45.0..75.0).contains(&seen["bend_deg"].as_f64().unwrap()), "{seen}");
    assert!(seen["removed"].as_u64().unwrap() > 3000, "{seen}");
    assert_eq!(seen["image"], serde_json::json!(["mono8", 384, 384, 147_456]));
    assert!(
        seen["off_centre_px"][0].as_f64().unwrap() > 5.0,
        "the X-ray shows the tip in its middle anyway: {seen}"
    );
    // The pilot hole is in the clouds too; a place is a float32 of a distance of up to 0.3 m.
    assert!(seen["predrilled"].as_u64().unwrap() > 1000 && seen["late_equals"] == true, "{seen}");
    assert!(
        seen["off_m"].as_f64().unwrap() < 5e-8 && seen["largest_cloud"].as_u64().unwrap() < 180_000,
        "{seen}"
    );
    let corners = seen["surface"][1].as_u64().unwrap();
    assert!(
        seen["surface"][0] == 11 && corners > 3000 && corners <= 3 * 2400 && corners.is_multiple_of(3),
        "{seen}"
    );
    succeed(&[&"volume", &"drilled", &ended.folder, &"-o", &drilled]);
    assert_eq!(
        std::fs::read(&rebuilt).unwrap(),
        raw_bytes(&drilled),
        "the rebuilt CT is not the drilled one"
    );
    let log = read(&ended.folder);
    assert!(log.ticks.last().unwrap().state.removed_total >= seen["removed"].as_u64().unwrap());
    assert!(counts(&ended.folder.join("timing.mcap"))["/command/ros"] > 100);
    assert_replays(&ended.folder);
}

#[test]
fn a_cyclone_dds_program_pulls_the_tendon_pauses_and_resumes_and_what_is_wrong_is_refused() {
    let Some(python) = python() else { return };
    let place = Place::new();
    let run = place.start(&scenes::piloted("realtime", LONG_S, "hold_ticks = 100"));
    let domain = Domain::new();
    let bridge = Bridge::start(&run.session(), &domain.number, &["--controller", "pilot"]);
    let client = Client::join(&run.session());
    // With its default configuration, as ROS 2 uses it in `SUBNET`.
    let mut defaults = peer(&python, "cyclone.py", &domain.number);
    defaults.env_remove("CYCLONEDDS_URI");
    let seen: Value = serde_json::from_str(&output_within_limit(defaults.arg("4"))).unwrap();
    let is_reset = |(_, text): &(u32, String)| text.contains("began from the initial state");
    assert!(client.events().iter().any(is_reset), "no event of a reset");
    let ended = client.stop(run);
    assert_eq!(bridge.end(), Some(0));
    assert_nothing_left(ended.pid);

    let words: Vec<_> = seen["states"].as_array().unwrap().iter().map(|state| state[0].clone()).collect();
    assert!(seen["states"].as_array().unwrap().iter().all(|state| state[1] == true), "{seen}");
    for word in ["DISABLED", "ENABLED", "PAUSED"] {
        assert!(words.contains(&word.into()), "{words:?}");
    }
    assert!((seen["kept_n"].as_f64().unwrap() - 4.0).abs() < 0.05, "a disabled arm obeyed: {seen}");
    assert_eq!(seen["stood"], true, "simulated time went on in a pause");
    let frames = seen["frames"].as_array().unwrap();
    for frame in ["UR5/base", "UR5/link_6", "UR5/flange", "CM/base", "CM/link_26", "CM/burr", "CM/tip"] {
        assert!(frames.contains(&frame.into()), "{frames:?}");
    }
    let log = read(&ended.folder);
    // Along the whole chain of frames, the tip is where the log has it at that time, to a tick: it moves
    // while the tendon slackens.
    let time_s = seen["tip_time_s"].as_f64().unwrap();
    let states = log.ticks.iter().map(|tick| &tick.state);
    let off_s = |state: &State| (state.sim_time_s - time_s).abs();
    let then = states.min_by(|one, other| off_s(one).total_cmp(&off_s(other))).unwrap();
    assert!(off_s(then) < 2e-3, "no state of {time_s} s");
    let tip_m = then.t_world_tip.position_m;
    for (axis, there_m) in tip_m.iter().enumerate() {
        let shown_m = seen["tip_m"][axis].as_f64().unwrap();
        assert!((shown_m - there_m).abs() < 0.5e-3, "{seen} {tip_m:?}");
    }
    assert!(log.ticks.iter().any(|tick| (tick.state.tendon_tension_n[0] - 4.0).abs() < 0.05));
    assert_replays(&ended.folder);
}

/// The bridge's guarantees when the other side dies without notice: velocities time out, the participant's
/// lease too, the tension stays.
#[test]
fn a_killed_commanding_program_leaves_arm_and_burr_standing_and_the_tension_as_it_was() {
    let Some(python) = python() else { return };
    let place = Place::new();
    let run = place.start(&scenes::piloted("realtime", LONG_S, "hold_ticks = 100"));
    let domain = Domain::new();
    let bridge = Bridge::start(&run.session(), &domain.number, &["--controller", "pilot"]);
    let mut peer = peer(&python, "drive_on.py", &domain.number);
    let mut driving = Guarded(peer.arg("4").stdout(Stdio::piped()).spawn().unwrap());
    assert_eq!(first_line(&mut driving.0), "moving\n");
    let client = Client::join(&run.session());
    let moving = client.wait_for_state(|state| state.burr_speed_rad_per_s > 100.0);
    driving.0.kill().unwrap();
    // Velocities time out within half a second, long before Cyclone DDS's lease of 10 s.
    let stopped = client.wait_for_state(|state| state.burr_speed_rad_per_s == 0.0);
    let ticks = stopped.tick - moving.tick;
    assert!(ticks < 5000, "stopped after {ticks} ticks, not before the lease's end");
    wait_for("the lease's end", || {
        let is_it =
            |(_, text): &(u32, String)| text.contains("the last publisher of commands has disconnected");
        client.events().iter().any(is_it).then_some(())
    });
    let held = client.next_state_within(LIMIT).expect("a state");
    assert!((held.tendon_tension_n[0] - 4.0).abs() < 0.05, "{} N", held.tendon_tension_n[0]);
    assert_eq!(held.burr_speed_rad_per_s, 0.0);
    assert!(held.arm_joint_velocity_rad_per_s.iter().all(|rate| rate.abs() < 1e-6), "the arm goes on");
    client.ask(ControlAction::Stop.code(), 0);
    let ended = run.end();
    assert_eq!(bridge.end(), Some(0));
    assert_replays(&ended.folder);
    assert_nothing_left(ended.pid);
}

#[test]
fn a_killed_ros_bridge_leaves_the_run_and_its_name_can_be_taken_again() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("realtime", LONG_S, "hold_ticks = 20"));
    let domain = Domain::new();
    let mut killed = Bridge::start(&run.session(), &domain.number, &["--controller", "pilot"]);
    killed.process.0.kill().unwrap();
    killed.end();
    let again = Bridge::start(&run.session(), &domain.number, &["--controller", "pilot"]);
    let client = joined(&run, "");
    let ended = stopped(run, client, ());
    assert_eq!(again.end(), Some(0));
    assert_nothing_left(ended.pid);
}

#[test]
fn a_ros_bridge_that_only_shows_listens_to_nothing() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", LONG_S));
    let domain = Domain::new();
    let bridge = Bridge::start(&run.session(), &domain.number, &[]);
    assert!(bridge.said.contains("publishes only"), "{}", bridge.said);
    let client = joined(&run, "");
    stopped(run, client, ());
    assert_eq!(bridge.end(), Some(0));
}

/// A DATA_FRAG submessage to the discovery reader that claims a message of 4 GiB (RTPS 2.5, 9.4.5.4).
fn fragment_of_a_huge_message() -> Vec<u8> {
    let mut body = vec![0, 0, 28, 0, 0, 1, 0, 0xc7, 0, 1, 0, 0xc2];
    body.extend([0_u32.to_le_bytes(), 1_u32.to_le_bytes(), 1_u32.to_le_bytes()].as_flattened());
    body.extend([1_u16.to_le_bytes(), 1000_u16.to_le_bytes()].as_flattened());
    body.extend((u32::MAX - 15).to_le_bytes());
    body.resize(body.len() + 1000, 0);
    let mut datagram = b"RTPS\x02\x04\x01\x12strangerhere".to_vec();
    datagram.extend([0x16, 1]);
    datagram.extend(u16::try_from(body.len()).unwrap().to_le_bytes());
    datagram.extend(body);
    datagram
}

/// Regression: one datagram made the bridge allocate 4 GiB, which the run has to share.
#[test]
fn a_datagram_that_claims_gigabytes_ends_the_bridge_at_worst_and_not_the_run() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", LONG_S));
    let domain = Domain::new();
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.args(["bridge", "ros2", "--domain-id", &domain.number, "--session"]).arg(run.session());
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut bridge = Guarded(command.spawn().unwrap());
    let line = first_line(&mut bridge.0);
    assert!(line.contains("ROS 2 domain"), "{line:?}");
    let limits = std::fs::read_to_string(format!("/proc/{}/limits", bridge.0.id())).unwrap();
    let data = limits.lines().find(|line| line.starts_with("Max data size")).unwrap();
    assert!(data.contains(&bridge_proc::ros2::MOST_MEMORY_BYTES.to_string()), "{data}");
    let (socket, number) = (UdpSocket::bind("127.0.0.1:0").unwrap(), domain.number.parse::<u16>().unwrap());
    // RTPS 2.5, 9.6.2: a participant's port for discovery.
    for participant in 0..10 {
        let port = 7400 + 250 * number + 10 + 2 * participant;
        let _ = socket.send_to(&fragment_of_a_huge_message(), ("127.0.0.1", port));
    }
    let status = wait_for("the bridge's end", || bridge.0.try_wait().unwrap());
    let mut said = String::new();
    bridge.0.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert!(!status.success() && said.contains("memory allocation of 4294967280 bytes failed"), "{said}");
    let client = joined(&run, "");
    let ended = stopped(run, client, ());
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_nothing_left(ended.pid);
}

/// The arrays that a program saw of a state are those that a replay computes, clearances included, and the
/// arm's Jacobian has the twist that the same state announces.
fn assert_arrays(folder: &Path, tick: u64, seen: &Value) {
    let replayed = Sim::from_log(&folder.join("run.mcap"), Some(tick), &Drive::Nothing).unwrap();
    let (state, expected) = (replayed.state(), replayed.tip_jacobian());
    let numbers = |topic: &str| -> Vec<f64> {
        seen["data"][topic].as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
    };
    // To the last digit that the test's own JSON reader may change.
    let assert_equal = |found: &[f64], expected: &[f64], what: &str| {
        let is_near = |(one, other): (&f64, &f64)| (one - other).abs() <= 4.0 * f64::EPSILON * other.abs();
        assert_eq!(found.len(), expected.len(), "{what}");
        assert!(found.iter().zip(expected).all(is_near), "{what}: {found:?}, {expected:?}");
    };
    let tendons = state.tendon_count as usize;
    let sizes = &seen["sizes"];
    assert_eq!(sizes["/CM/jacobian"], serde_json::json!([6, tendons + 6]), "{seen}");
    for (row, found) in numbers("/CM/jacobian").chunks_exact(tendons + 6).enumerate() {
        assert_equal(&found[..tendons], &expected.per_tension[row * MAX_TENDONS..][..tendons], "per tension");
        assert_equal(&found[tendons..], &expected.per_base[row * 6..][..6], "per twist of the base");
    }
    assert_equal(&numbers("/CM/compliance"), &expected.compliance, "compliance");
    let [reading] = replayed.readings()[..] else { panic!("{:?}", replayed.readings()) };
    assert_eq!(seen["structures"], serde_json::json!(["nerve", "vessel"]));
    assert_equal(&numbers("/clearance"), &[reading.value[0], reading.value[2]], "clearances");
    assert_eq!(sizes["/UR5/jacobian"], serde_json::json!([6, 6]));
    for (row, found) in numbers("/UR5/jacobian").chunks_exact(6).enumerate() {
        let rates = state.arm_joint_velocity_rad_per_s;
        let twist: f64 = found.iter().zip(rates).map(|(entry, rate)| entry * rate).sum();
        let announced = seen["twist"][row].as_f64().unwrap();
        assert!((twist - announced).abs() < 1e-12, "row {row}: {twist}, {announced}");
    }
    assert!(seen["twist"][0].as_f64().unwrap().abs() > 1e-6, "the arm stands still: {seen}");
}

/// Runs a scene in lockstep with a program on ROS 2 that answers each state late; returns the last state's
/// hash, what the program saw, and the bridge's last lines.
fn exact_run(python: &Path, delay_ms: u32, manner: &str) -> ([u64; 2], Value, String) {
    const STATES: u64 = 120;
    let place = Place::new();
    let more = "[manipulator]\ntip_jacobian = true\n[[structure]]\nname = \"nerve\"\n\
                ball = { centre_mm = [0.0, 9.0, -25.0], radius_mm = 1.0 }\n[[structure]]\nname = \"vessel\"\n\
                ball = { centre_mm = [9.0, 0.0, -17.0], radius_mm = 1.0 }\n";
    let run = place.start(&scenes::piloted("lockstep", STATES as f64 * 1e-3, more));
    let domain = Domain::new();
    let mut bridge = Bridge::start(&run.session(), &domain.number, &["--controller", "pilot", "--lockstep"]);
    let mut peer = peer(python, "lockstep.py", &domain.number);
    peer.args([&delay_ms.to_string(), &STATES.to_string(), manner]);
    let seen: Value = serde_json::from_str(&output_within_limit(&mut peer)).unwrap();
    let ended = run.end_well();
    let last = bridge.last();
    assert_eq!(bridge.end(), Some(0));
    let ticks = read(&ended.folder).ticks;
    assert_eq!(ticks.len() as u64, STATES);
    assert_replays(&ended.folder);
    assert_arrays(&ended.folder, STATES - 1, &seen);
    (ticks.last().unwrap().state.hash, seen, last)
}

/// Where a `reset` arrives among the commands for one state makes no difference.
#[test]
fn a_reset_among_the_commands_of_a_lockstep_tick_loses_none_of_them() {
    let Some(python) = python() else { return };
    let [before, between] = ["before", "between"].map(|manner| exact_run(&python, 0, manner));
    assert_eq!(before.0, between.0, "{} {}", before.1, between.1);
    assert!(between.2.contains(" 0 of them rejected"), "{}", between.2);
}

/// A controller anywhere on a network drives exact runs: delay, order, repetitions and losses of messages
/// change no bit. The delays are the program's own, because the kernels of test machines lack netem.
#[test]
fn a_lockstep_run_over_ros_2_has_the_same_hash_at_0_1_and_20_ms_and_with_lost_and_repeated_messages() {
    let Some(python) = python() else { return };
    let (hash, seen, last) = exact_run(&python, 0, "plain");
    assert!(seen["gaps"] == 0 && seen["first"] == serde_json::json!([0, 0]), "{seen}");
    assert!(last.contains("round trip from a state to its command: median "), "{last}");
    assert!(last.contains("(120 answers)") && last.contains("; 0 lost on the network"), "{last}");
    for (delay_ms, manner) in [(1, "plain"), (20, "plain"), (0, "rough")] {
        let (other, seen, last) = exact_run(&python, delay_ms, manner);
        assert_eq!(other, hash, "{delay_ms} ms, {manner}: {seen}");
        assert_eq!(seen["gaps"], 0, "{seen}");
        assert_eq!(!last.contains(" 0 of them rejected"), manner == "rough", "{last}");
    }
}

#[test]
fn lockstep_is_refused_where_it_cannot_work() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("realtime", LONG_S, "hold_ticks = 20"));
    let session = run.session();
    let refused =
        trabecula(&[&"bridge", &"ros2", &"--controller", &"pilot", &"--lockstep", &"--session", &session]);
    assert_eq!(refused.code, Some(2), "{}", refused.err);
    assert!(refused.err.contains("runs in real time; set `run.mode = \"lockstep\"`"), "{}", refused.err);
    let observer = trabecula(&[&"bridge", &"ros2", &"--lockstep", &"--session", &session]);
    assert!(observer.code == Some(2) && observer.err.contains("--controller"), "{}", observer.err);
    let bridge = Bridge::start(&session, &Domain::new().number, &["--controller", "pilot"]);
    let client = joined(&run, "");
    stopped(run, client, ());
    assert_eq!(bridge.end(), Some(0));
}
