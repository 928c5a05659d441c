//! `trabecula bridge igtl`, with independent peers.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use openigtlink::{Body, HeaderVersion, Message};
use recorder_proc::log_file::LogFile;
use run_log::{FrameRecord, ReadOptions, frames};
use serde_json::Value;
use test_support::debian::library_or_skip;
use test_support::python::or_skip;

use crate::common::logs::{assert_replays, counts, read};
use crate::common::program::{Guarded, LIMIT, Place, assert_nothing_left, first_line, wait_for};
use crate::common::scenes;
use crate::languages::{output_of, output_within_limit};
use crate::strays::{joined, stopped};

const TOKEN: &str = "0f1e2d3c4b5a";
const DRR: &str = "
[drr]
rate_hz = 10.0
isocentre_mm = [0.0, 0.0, -20.0]
columns = 64
rows = 48
pixel_pitch_mm = 1.5
threads = 1
";

/// A bridge that has announced its port.
struct Bridge {
    process: Guarded,
    port: u16,
}

impl Bridge {
    fn start(session: &Path, more: &[&str]) -> Bridge {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.args(["bridge", "igtl", "--port", "0", "--session"]).arg(session).args(more);
        let mut process = Guarded(command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap());
        let line = first_line(&mut process.0);
        let port =
            line.trim().strip_prefix("OpenIGTLink at 127.0.0.1:").unwrap_or_else(|| panic!("{line:?}"));
        Bridge { port: port.parse().unwrap(), process }
    }

    fn peer(&self) -> TcpStream {
        let stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream.set_read_timeout(Some(LIMIT)).unwrap();
        stream
    }

    /// Returns its exit code, once its session is over.
    fn end(self) -> Option<i32> {
        self.end_and_words().0
    }

    /// The same, with its last output.
    fn end_and_words(mut self) -> (Option<i32>, String) {
        let code = wait_for("the bridge's end", || self.process.0.try_wait().unwrap()).code();
        let mut said = String::new();
        self.process.0.stdout.take().unwrap().read_to_string(&mut said).unwrap();
        (code, said)
    }
}

fn say(stream: &mut TcpStream, device: &str, text: &str) {
    let message = Message::new(device, Body::Text(text.into())).unwrap();
    stream.write_all(&message.encode(HeaderVersion::V1).unwrap()).unwrap();
}

#[test]
fn a_slicer_program_plans_drills_looks_pauses_and_stops_and_the_log_replays() {
    let Some(python) = or_skip("pyigtl-0.3.4", &["pyigtl==0.3.4", "numpy==2.3.5"], "pyigtl, numpy") else {
        return;
    };
    let place = Place::new();
    let run = place.start(&format!("{}{DRR}", scenes::piloted("lockstep", 600.0, "")));
    let token = place.path("token");
    std::fs::write(&token, format!("{TOKEN}\n")).unwrap();
    let file = token.to_str().unwrap();
    let drive = ["--controller", "pilot", "--control-token-file", file, "--feed", "5", "--burr", "8000"];
    let bridge = Bridge::start(&run.session(), &drive);
    // The tip starts at (0, 0, -30.75) mm, bone begins at z = -27.5 mm; RAS differs from LPS in the signs of
    // x and y.
    let target_mm = ["0", "0", "-25"];
    let mut peer = Command::new(python);
    peer.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/processes/openigtlink.py"));
    peer.args([bridge.port.to_string().as_str(), TOKEN]).args(target_mm);
    let seen: Value = serde_json::from_str(&output_within_limit(&mut peer)).unwrap();
    assert_eq!(bridge.end(), Some(0));
    let ended = run.end_well();
    assert_nothing_left(ended.pid);

    assert_eq!(seen["points"][0], "BurrStart");
    assert_eq!(seen["image"]["shape"], serde_json::json!([1, 48, 64]));
    assert_eq!(seen["image"]["type"], "uint16");
    assert!(seen["image"]["range"][1].as_u64() > seen["image"]["range"][0].as_u64(), "{seen}");
    let log = read(&ended.folder);
    let tip_m = log.ticks.last().unwrap().state.t_world_tip.position_m;
    assert!((tip_m[2] + 0.025).abs() < 0.3e-3, "the tip ended at {tip_m:?} m");
    assert!(log.ticks.last().unwrap().state.removed_total > 0, "nothing was drilled on the way");
    assert!(counts(&ended.folder.join("run.mcap"))["/drr/frame"] > 0);
    assert_replays(&ended.folder);
}

/// The C++ program of `openigtlink.cxx`, built with the OpenIGTLink project's own library.
fn reference_peer(place: &Place) -> Option<Command> {
    let probe = "usr/lib/openigtlink/OpenIGTLinkConfig.cmake";
    let root = library_or_skip(&["libopenigtlink-dev", "libopenigtlink1.11"], probe)?;
    let (include, lib) = (root.join("usr/include/openigtlink"), root.join("usr/lib"));
    let program = place.path("peer");
    let mut compiler = Command::new("c++");
    compiler.args(["-std=c++17", "-Wall", "-Wextra", "-Werror", "-isystem"]).arg(include);
    compiler.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/processes/openigtlink.cxx"));
    compiler.arg("-L").arg(&lib).args(["-lOpenIGTLink", "-o"]).arg(&program);
    output_of(&mut compiler);
    let mut peer = Command::new(program);
    peer.env("LD_LIBRARY_PATH", lib);
    Some(peer)
}

/// FNV-1a, as computed by the peer from the bytes of an image.
fn fnv1a(bytes: &[u8]) -> u64 {
    let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3);
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, step)
}

fn floats(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|one| one.as_f64().unwrap()).collect()
}

/// Compares received numbers, in single precision, with the expected ones.
fn assert_close(what: &str, got: &Value, wanted: &[f64]) {
    let got = floats(got);
    let off = |(a, b): (&f64, &f64)| (a - b).abs() > 1e-6 * b.abs().max(1.0);
    assert_eq!(got.len(), wanted.len(), "{what}");
    assert!(!got.iter().zip(wanted).any(off), "{what}: {got:?}, expected {wanted:?}");
}

/// The library takes an image's last column as its centre, in millimetres along the axes named by the
/// message: RAS.
fn assert_image(image: &Value, records: &[FrameRecord]) {
    let wanted = image["fnv1a"].as_str().unwrap();
    let record = records.iter().find(|record| fnv1a(&record.pixels).to_string() == wanted);
    let geometry = &record.expect("no frame of the log has the image's pixels").frame.geometry;
    assert_eq!(image["size"], serde_json::json!([64, 48, 1]));
    assert_eq!((&image["whole"], &image["endian"]), (&Value::Bool(true), &Value::from(2)), "little-endian");
    assert_eq!(image["coordinates"], 1, "RAS");
    let pitch_mm = geometry.pixel_pitch_m.map(|pitch_m| 1000.0 * pitch_m);
    assert_close("spacing", &image["spacing_mm"], &[pitch_mm[0], pitch_mm[1], 1.0]);
    let ras = |[x, y, z]: [f64; 3]| [-x, -y, z];
    let (row, column) = (ras(geometry.row_axis), ras(geometry.column_axis));
    let normal = [
        row[1] * column[2] - row[2] * column[1],
        row[2] * column[0] - row[0] * column[2],
        row[0] * column[1] - row[1] * column[0],
    ];
    let centre_mm = ras(geometry.detector_centre_m).map(|component| 1000.0 * component);
    let rows = (0..3).flat_map(|axis| [row[axis], column[axis], normal[axis], centre_mm[axis]]);
    assert_close("matrix", &image["matrix"], &rows.chain([0.0, 0.0, 0.0, 1.0]).collect::<Vec<f64>>());
}

#[test]
fn the_projects_own_cpp_library_reads_every_message_and_is_obeyed() {
    let place = Place::new();
    let Some(mut peer) = reference_peer(&place) else { return };
    let run = place.start(&format!("{}{DRR}", scenes::drill_unseen("realtime", 600.0)));
    let token = place.path("token");
    std::fs::write(&token, format!("{TOKEN}\n")).unwrap();
    let bridge = Bridge::start(&run.session(), &["--control-token-file", token.to_str().unwrap()]);
    peer.args([bridge.port.to_string().as_str(), TOKEN]);
    let seen: Value = serde_json::from_str(&output_within_limit(&mut peer)).unwrap();
    let (code, said) = bridge.end_and_words();
    assert_eq!(code, Some(0));
    assert!(said.contains("2 incoming messages rejected"), "one without the token, one unknown: {said}");
    let ended = run.end_well();

    assert!(seen["good"].as_u64() > Some(100) && seen["bad"] == 0 && seen["other"] == 0, "CRCs: {seen}");
    let poses: Vec<&str> = seen["poses"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    assert_eq!(poses.len(), 31, "{poses:?}");
    let points = seen["points"].as_array().unwrap();
    assert_eq!((&points[0][0], &points[0][1]), (&Value::from("BurrStart"), &Value::from("Tool")));
    assert_close("the burr's start", &points[0][2], &[0.0, 0.0, -34.0]);
    // 27 links, base, burr and tip, 12 corners each.
    assert_eq!(
        (&seen["surface"]["points"], &seen["surface"]["polygons"]),
        (&Value::from(360), &Value::from(348))
    );
    assert_eq!(seen["surface"]["valid"], true);
    // 20 mm straight ahead from the start, a point every 0.25 mm, all in one line.
    assert_eq!((&seen["path"]["points"], &seen["path"]["of_line"]), (&Value::from(81), &Value::from(81)));
    assert_close("the planned path's start", &seen["path"]["first_mm"], &[0.0, 0.0, -34.0]);
    assert_close("the planned path's end", &seen["path"]["last_mm"], &[0.0, 0.0, -14.0]);

    let log = read(&ended.folder);
    let text = seen["pair"]["state"].as_str().unwrap();
    let tick: usize = text.strip_prefix("tick=").unwrap().split(' ').next().unwrap().parse().unwrap();
    let state = if tick == 0 { &log.initial } else { &log.ticks[tick - 1].state };
    let [x, y, z] = state.t_world_burr.position_m.map(|component| 1000.0 * component);
    let matrix = floats(&seen["pair"]["burr"]);
    let moved = serde_json::json!([matrix[3], matrix[7], matrix[11]]);
    assert_close(&format!("the burr at tick {tick}"), &moved, &[-x, -y, z]);
    let records = frames(&LogFile::at(ended.folder.join("run.mcap")), ReadOptions::default()).unwrap();
    assert_image(&seen["image"], &records.map(Result::unwrap).collect::<Vec<_>>());
    assert_replays(&ended.folder);
    assert_nothing_left(ended.pid);
}

#[test]
fn what_a_peer_must_not_do_is_refused_and_counted_and_the_run_goes_on() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 8.0));
    let bridge = Bridge::start(&run.session(), &["--rate", "1000"]);
    let stop = || Message::new("Command", Body::Text("stop".into())).unwrap();
    let bytes = || stop().encode(HeaderVersion::V1).unwrap();

    let mut garbage = bridge.peer();
    garbage.write_all(&[0xff; 4096]).unwrap();
    let mut rest = Vec::new();
    // Closed by the bridge; a reset is an end too.
    let _ = garbage.read_to_end(&mut rest);

    let mut huge = bridge.peer();
    let mut announced = bytes();
    announced[42..50].copy_from_slice(&(1_u64 << 40).to_be_bytes());
    huge.write_all(&announced).unwrap();
    let _ = huge.read_to_end(&mut rest);

    // Reads nothing of several MB per second: its messages are replaced, and no other peer waits for it.
    let deaf = bridge.peer();
    // Never completes a message, and costs only its thread.
    let mut dawdler = bridge.peer();
    dawdler.write_all(&bytes()[..60]).unwrap();
    let mut watcher = bridge.peer();
    let mut damaged = bytes();
    *damaged.last_mut().unwrap() ^= 1;
    watcher.write_all(&damaged).unwrap();
    say(&mut watcher, "Command", "stop");
    say(&mut watcher, "Token", "guessed!");
    say(&mut watcher, "Command", "jump");
    let mut heard = Vec::new();
    let _ = watcher.read_to_end(&mut heard);

    let ended = run.end_well();
    assert_eq!(read(&ended.folder).ticks.len(), 8000, "a peer without permission stopped the run");
    let (code, said) = bridge.end_and_words();
    assert_eq!(code, Some(0));
    drop((deaf, dawdler));
    let told = String::from_utf8_lossy(&heard);
    for refusal in ["this bridge is read-only", "CRC-64", "Token: wrong token", "unknown command jump"] {
        assert!(told.contains(refusal), "`{refusal}` was not said");
    }
    // Garbage, a huge body, a wrong CRC, a command and a token without permission, an unknown command.
    assert!(said.contains("5 peers; ") && said.contains(" 6 incoming messages rejected"), "{said}");
    assert!(!said.contains("; 0 outgoing messages superseded"), "{said}");
    assert_nothing_left(ended.pid);
}

/// Reads what is sent to a peer until it holds some words, and returns it as text.
fn read_until(stream: &mut TcpStream, words: &str) -> String {
    let (mut told, mut piece) = (Vec::new(), [0; 4096]);
    let end = Instant::now() + LIMIT;
    loop {
        assert!(Instant::now() < end, "`{words}` was not said within {LIMIT:?}");
        let bytes = stream.read(&mut piece).unwrap_or_else(|cause| panic!("{words}: {cause}"));
        assert!(bytes > 0, "closed before `{words}`");
        let searched = told.len().saturating_sub(words.len());
        told.extend_from_slice(&piece[..bytes]);
        if told[searched..].windows(words.len()).any(|window| window == words.as_bytes()) {
            return String::from_utf8_lossy(&told).into_owned();
        }
    }
}

fn plan(stream: &mut TcpStream, target_mm: [f32; 3]) {
    let target = openigtlink::Point {
        name: "Target".into(),
        group: String::new(),
        rgba: [0; 4],
        position_mm: target_mm,
        diameter_mm: 0.0,
        owner: String::new(),
    };
    let message = Message::new("Plan", Body::Points(vec![target])).unwrap();
    stream.write_all(&message.encode(HeaderVersion::V1).unwrap()).unwrap();
}

/// Regression: a plan 1 m away was accepted and ended a lockstep run, and a peer that joined a paused run got
/// no pose.
#[test]
fn values_out_of_range_are_answered_and_a_paused_run_shows_its_pose_to_a_new_peer() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("lockstep", 600.0, ""));
    let token = place.path("token");
    std::fs::write(&token, format!("{TOKEN}\n")).unwrap();
    let drive = ["--controller", "pilot", "--watch-with-token", "--control-token-file"];
    let bridge = Bridge::start(&run.session(), &[&drive[..], &[token.to_str().unwrap()]].concat());
    let mut owner = bridge.peer();
    say(&mut owner, "Token", TOKEN);
    read_until(&mut owner, "control granted");
    read_until(&mut owner, "BurrToRAS");
    plan(&mut owner, [0.0, 0.0, 1000.0]);
    read_until(&mut owner, "allowed: up to 500 mm");
    plan(&mut owner, [0.0, 0.0, f32::MAX]);
    read_until(&mut owner, "allowed: -10000 to 10000 mm");
    say(&mut owner, "Command", "pause");
    read_until(&mut owner, "done");
    let mut watcher = bridge.peer();
    assert!(!read_until(&mut watcher, "connected").contains("BurrToRAS"));
    say(&mut watcher, "Token", TOKEN);
    read_until(&mut watcher, "BurrToRAS");
    say(&mut watcher, "Command", "stop");
    assert_eq!(bridge.end(), Some(0));
    let ended = run.end_well();
    assert_nothing_left(ended.pid);
}

#[test]
fn a_killed_bridge_leaves_the_run_and_its_name_can_be_taken_again() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("realtime", 600.0, "hold_ticks = 20"));
    let mut killed = Bridge::start(&run.session(), &["--controller", "pilot"]);
    killed.process.0.kill().unwrap();
    killed.end();
    let again = Bridge::start(&run.session(), &["--controller", "pilot"]);
    let client = joined(&run, "");
    let ended = stopped(run, client, ());
    assert_eq!(again.end(), Some(0));
    assert_nothing_left(ended.pid);
}
