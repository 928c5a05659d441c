//! `trabecula bridge igtl`, with peers that are not ours.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Stdio};

use openigtlink::{Body, HeaderVersion, Message};
use serde_json::Value;
use test_support::limited::{COMMAND_LIMIT, Watchdog};
use test_support::python::or_skip;

use crate::common::logs::{assert_replays, counts, read};
use crate::common::program::{Guarded, LIMIT, Place, assert_nothing_left, trabecula, wait_for};
use crate::common::scenes;
use crate::languages::output_within_limit;

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

/// A bridge that has said where it listens.
struct Bridge {
    process: Guarded,
    port: u16,
}

impl Bridge {
    fn start(session: &Path, more: &[&str]) -> Bridge {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.args(["bridge", "igtl", "--port", "0", "--session"]).arg(session).args(more);
        let mut process = Guarded(command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap());
        let watchdog = Watchdog::over(&process.0, COMMAND_LIMIT);
        let mut line = String::new();
        BufReader::new(process.0.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
        drop(watchdog);
        let port =
            line.trim().strip_prefix("OpenIGTLink at 127.0.0.1:").unwrap_or_else(|| panic!("{line:?}"));
        Bridge { port: port.parse().unwrap(), process }
    }

    fn peer(&self) -> TcpStream {
        let stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream.set_read_timeout(Some(LIMIT)).unwrap();
        stream
    }

    /// Its exit code, once its session is over.
    fn end(mut self) -> Option<i32> {
        wait_for("the bridge's end", || self.process.0.try_wait().unwrap()).code()
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
    // The tip starts at (0, 0, -30.75) mm, bone begins at z = -27.5 mm; RAS differs from LPS in the signs of x and y.
    let target_mm = ["0", "0", "-25"];
    let mut peer = Command::new(python);
    peer.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/processes/openigtlink.py"));
    peer.args([bridge.port.to_string().as_str(), TOKEN]).args(target_mm);
    let seen: Value = serde_json::from_str(&output_within_limit(&mut peer)).unwrap();
    assert_eq!(bridge.end(), Some(0));
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
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

#[test]
fn what_a_peer_must_not_do_is_refused_and_the_run_goes_on() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 6.0));
    let bridge = Bridge::start(&run.session(), &[]);

    let mut garbage = bridge.peer();
    garbage.write_all(&[0xff; 4096]).unwrap();
    let mut rest = Vec::new();
    // Closed by the bridge; a reset is an end too.
    let _ = garbage.read_to_end(&mut rest);

    let mut huge = bridge.peer();
    let mut bytes =
        Message::new("Command", Body::Text("stop".into())).unwrap().encode(HeaderVersion::V1).unwrap();
    bytes[42..50].copy_from_slice(&(1_u64 << 40).to_be_bytes());
    huge.write_all(&bytes).unwrap();
    let _ = huge.read_to_end(&mut rest);

    // Never reads: its messages are replaced, and nobody waits for it.
    let deaf = bridge.peer();
    let mut watcher = bridge.peer();
    say(&mut watcher, "Command", "stop");
    say(&mut watcher, "Token", "guessed!");

    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_eq!(read(&ended.folder).ticks.len(), 6000, "a peer without permission stopped the run");
    assert_eq!(bridge.end(), Some(0));
    drop(deaf);
    let mut heard = Vec::new();
    let _ = watcher.read_to_end(&mut heard);
    let told = String::from_utf8_lossy(&heard);
    assert!(told.contains("this bridge only shows the run"), "the refusal was not said");
    assert_nothing_left(ended.pid);
}

#[test]
fn a_killed_bridge_leaves_the_run_and_its_name_can_be_taken_again() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("realtime", 4.0, "hold_ticks = 20"));
    let mut killed = Bridge::start(&run.session(), &["--controller", "pilot"]);
    killed.process.0.kill().unwrap();
    killed.end();
    let again = Bridge::start(&run.session(), &["--controller", "pilot"]);
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_eq!(again.end(), Some(0));
    assert_nothing_left(ended.pid);
}

#[test]
fn a_bridge_without_session_or_with_a_bad_flag_says_so_and_ends_with_2() {
    let place = Place::new();
    let nowhere = place.path("nowhere");
    let done = trabecula(&[&"bridge", &"igtl", &"--session", &nowhere]);
    assert_eq!(done.code, Some(2), "{}", done.err);
    let done = trabecula(&[&"bridge", &"igtl", &"--rate", &"nan"]);
    assert_eq!(
        (done.code, done.err.contains("--rate: NaN, expected 0.1 to 1000")),
        (Some(2), true),
        "{}",
        done.err
    );
    let short = place.path("short");
    std::fs::write(&short, "abc\n").unwrap();
    let done = trabecula(&[&"bridge", &"igtl", &"--control-token-file", &short]);
    assert_eq!((done.code, done.err.contains("at least 8 characters")), (Some(2), true), "{}", done.err);
}
