//! The viewer beside a run, and on logs.

use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use ipc_types::messages::State;
use rustix::process::Signal;
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};
use zerocopy::FromBytes;

use crate::common::logs::assert_replays;
use crate::common::program::{LIMIT, Place, assert_nothing_left, signal, trabecula, wait_for};
use crate::common::scenes;

/// A viewer process and a client of it.
struct View {
    child: Child,
    token: String,
    socket: WebSocket<TcpStream>,
    channels: Vec<Value>,
}

impl View {
    fn start(arguments: &[&Path], session: Option<&Path>) -> View {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.arg("view").args(arguments).args(["--port", "0", "--no-open"]);
        if let Some(session) = session {
            command.arg("--session").arg(session);
        }
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let (address, token) = line.trim().strip_prefix("http://").unwrap().split_once("/#token=").unwrap();
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(LIMIT)).unwrap();
        let mut request = format!("ws://{address}/ws").into_client_request().unwrap();
        request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().unwrap());
        let (mut socket, _) = tungstenite::client(request, stream).unwrap();
        let channels = loop {
            let message = next_text(&mut socket);
            if message["op"] == "advertise" {
                break message["channels"].as_array().unwrap().clone();
            }
        };
        View { child, token: token.to_owned(), socket, channels }
    }

    /// Subscribes under the channel's own number.
    fn subscribe(&mut self, topic: &str) -> u32 {
        let channel = self.channels.iter().find(|channel| channel["topic"] == topic).unwrap();
        let id = channel["id"].as_u64().unwrap() as u32;
        let text = json!({"op": "subscribe", "subscriptions": [{"id": id, "channelId": id}]});
        self.socket.send(Message::text(text.to_string())).unwrap();
        id
    }

    fn next(&mut self, subscription: u32) -> Vec<u8> {
        loop {
            if let Message::Binary(bytes) = self.socket.read().unwrap()
                && bytes[0] == 1
                && bytes[1..5] == subscription.to_le_bytes()
            {
                return bytes[13..].to_vec();
            }
        }
    }

    fn next_state(&mut self, subscription: u32) -> State {
        State::read_from_bytes(&self.next(subscription)[4..]).unwrap()
    }

    fn call(&mut self, service: u32, mut body: Value) -> Value {
        body["token"] = json!(self.token);
        let mut bytes = vec![2];
        [service, 1, 4].iter().for_each(|word: &u32| bytes.extend_from_slice(&word.to_le_bytes()));
        bytes.extend_from_slice(b"json");
        bytes.extend_from_slice(body.to_string().as_bytes());
        self.socket.send(Message::binary(bytes)).unwrap();
        loop {
            if let Message::Binary(bytes) = self.socket.read().unwrap()
                && bytes[0] == 3
            {
                return serde_json::from_slice(&bytes[17..]).unwrap();
            }
        }
    }

    fn end(mut self) -> Option<i32> {
        wait_for("the end of the viewer", || self.child.try_wait().unwrap()).code()
    }
}

fn next_text(socket: &mut WebSocket<TcpStream>) -> Value {
    loop {
        if let Message::Text(text) = socket.read().unwrap() {
            return serde_json::from_str(&text).unwrap();
        }
    }
}

const VIEWER: &str = "
[[controller]]
name = \"viewer\"
drives = [\"tendon\", \"arm\", \"burr\"]
external = true
optional = true
";

#[test]
fn a_viewer_shows_a_run_steers_it_and_drives_the_tool() {
    let place = Place::new();
    let scene = scenes::piloted("realtime", 600.0, "");
    let scene = scene.split("[[controller]]").next().unwrap().to_owned() + VIEWER;
    let run = place.start(&scene);
    let mut view = View::start(&[], Some(&run.session()));
    let (info, states, surface) =
        (view.subscribe("/view/info"), view.subscribe("/state"), view.subscribe("/view/surface"));
    let info: Value = serde_json::from_slice(&view.next(info)).unwrap();
    assert_eq!((&info["kind"], &info["scene"]["name"]), (&json!("live"), &json!("piloted")));
    assert_eq!(view.next(surface)[..4], *b"TMSH");
    let first = view.next_state(states);
    let second = view.next_state(states);
    assert!(second.tick > first.tick);

    let driven = json!({"tendon_n": 4.0, "burr_rad_per_s": 500.0});
    assert_eq!(view.call(2, driven), json!({"ok": true}));
    while view.next_state(states).burr_speed_rad_per_s == 0.0 {}
    assert_eq!(view.call(1, json!({"action": "pause"})), json!({"ok": true}));
    assert_eq!(view.call(1, json!({"action": "step", "ticks": 7})), json!({"ok": true}));
    let refused = view.call(4, json!({"action": "play"}));
    assert!(refused["error"].as_str().unwrap().contains("no time line"), "{refused}");
    assert_eq!(view.call(1, json!({"action": "stop"})), json!({"ok": true}));
    let ended = run.end();
    assert_eq!((ended.code, view.end()), (Some(0), Some(0)), "{}", ended.err);
    assert_nothing_left(ended.pid);
    // What was driven is in the log, and replays without the viewer.
    assert_replays(&ended.folder);
}

#[test]
fn a_viewer_that_dies_leaves_the_run_alone() {
    let place = Place::new();
    let run = place.start(&scenes::drill("lockstep", 2.0));
    let view = View::start(&[], Some(&run.session()));
    signal(view.child.id(), Signal::KILL);
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_replays(&ended.folder);
    assert_eq!(view.end(), None);
}

#[test]
fn a_log_is_shown_at_any_time_and_a_port_in_use_is_refused() {
    let place = Place::new();
    let ended = place.complete(&scenes::drill("lockstep", 0.5));
    let mut view = View::start(&[&ended.folder, &ended.folder], None);
    let (states, playback) = (view.subscribe("/state"), view.subscribe("/view/playback"));
    let told: Value = serde_json::from_slice(&view.next(playback)).unwrap();
    assert_eq!((&told["begin_ns"], &told["end_ns"]), (&json!(0), &json!(500_000_000)));
    assert_eq!(view.call(4, json!({"action": "seek", "time_ns": 300_000_000})), json!({"ok": true}));
    while view.next_state(states).tick != 300 {}
    assert_eq!(view.call(4, json!({"action": "step", "ticks": -1})), json!({"ok": true}));
    while view.next_state(states).tick != 299 {}
    assert_eq!(view.call(4, json!({"action": "play", "speed": 4.0})), json!({"ok": true}));
    while view.next_state(states).tick != 500 {}
    let no = view.call(4, json!({"action": "next", "kind": "divergence"}));
    assert!(no["error"].as_str().unwrap().contains("no divergence after"), "{no}");
    let steer = view.call(1, json!({"action": "pause"}));
    assert!(steer["error"].as_str().unwrap().contains("a log"), "{steer}");
    signal(view.child.id(), Signal::TERM);
    assert_eq!(view.end(), Some(0));

    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let done = trabecula(&[&"view", &ended.folder, &"--no-open", &"--port", &port]);
    assert_eq!(done.code, Some(2), "{}", done.err);
    assert!(done.err.contains(&port) && done.err.contains("--port"), "{}", done.err);
    let missing = trabecula(&[&"view", &place.path("none.mcap"), &"--no-open", &"--port", &"0"]);
    assert_eq!(missing.code, Some(2), "{}", missing.err);
    let lone = trabecula(&[&"view", &"--session", &place.path("none"), &"--no-open", &"--port", &"0"]);
    assert_eq!(lone.code, Some(2), "{}", lone.err);
}

#[test]
fn fields_are_plotted_and_completions_and_the_man_page_are_made() {
    let place = Place::new();
    let ended = place.complete(&scenes::hold("lockstep", 0.2));
    let figure = place.path("figure");
    let fields = ["tendon_tension_n[0]", "t_world_tip.position_m"];
    let done = trabecula(&[&"plot", &ended.folder, &fields[0], &fields[1], &"--output", &figure]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    // No figure is written over, not even half of one.
    std::fs::remove_file(figure.with_extension("png")).unwrap();
    let before = std::fs::read(figure.with_extension("svg")).unwrap();
    let again = trabecula(&[&"plot", &ended.folder, &fields[0], &"--output", &figure]);
    assert!(again.code == Some(2) && again.err.contains("is there already"), "{}", again.err);
    assert!(!figure.with_extension("png").exists());
    assert!(std::fs::read(figure.with_extension("svg")).unwrap() == before);
    std::fs::remove_file(figure.with_extension("svg")).unwrap();
    let done = trabecula(&[&"plot", &ended.folder, &fields[0], &fields[1], &"--output", &figure]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let png = std::fs::read(figure.with_extension("png")).unwrap();
    assert!(png.starts_with(b"\x89PNG"));
    let svg = std::fs::read_to_string(figure.with_extension("svg")).unwrap();
    assert!(fields.iter().all(|field| svg.contains(field)));
    let none = trabecula(&[&"plot", &ended.folder, &"no_such_field", &"--output", &place.path("none")]);
    assert_eq!(none.code, Some(2), "{}", none.err);
    assert!(!place.path("none.png").exists());
    for shell in ["bash", "zsh", "fish"] {
        let done = trabecula(&[&"docs", &"completions", &shell]);
        assert!(done.code == Some(0) && done.out.contains("view"), "{shell}: {}", done.err);
    }
    let man = trabecula(&[&"docs", &"man"]).out;
    assert!(man.contains(".TH") && man.contains("bind"), "{man}");
}
