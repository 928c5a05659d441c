//! The viewer next to a run, and on logs.

use std::collections::VecDeque;
use std::io::Write;
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use ipc_types::messages::State;
use rustix::process::Signal;
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};
use zerocopy::FromBytes;

use crate::common::client::Client;
use crate::common::logs::{assert_replays, recorded, rewrite};
use crate::common::program::{
    LIMIT, Place, assert_nothing_left, first_line, signal, succeed, trabecula, wait_for,
};
use crate::common::scenes;

/// A viewer process and a client of it.
pub struct View {
    child: Child,
    pub address: String,
    pub token: String,
    socket: WebSocket<TcpStream>,
    channels: Vec<Value>,
    /// Messages that arrived while another one was awaited, with their subscriptions.
    earlier: VecDeque<(u32, Vec<u8>)>,
}

impl View {
    pub fn start(arguments: &[&Path], session: Option<&Path>) -> View {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.arg("view").args(arguments).args(["--port", "0", "--no-open"]);
        if let Some(session) = session {
            command.arg("--session").arg(session);
        }
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap();
        let line = first_line(&mut child);
        let (address, token) = line.trim().strip_prefix("http://").unwrap().split_once("/#token=").unwrap();
        let (socket, channels) = connect(address, token);
        let (address, token) = (address.to_owned(), token.to_owned());
        View { child, address, token, socket, channels, earlier: VecDeque::new() }
    }

    /// Subscribes with the channel's number as the id.
    pub fn subscribe(&mut self, topic: &str) -> u32 {
        let channel = self.channels.iter().find(|channel| channel["topic"] == topic).unwrap();
        let id = channel["id"].as_u64().unwrap() as u32;
        let text = json!({"op": "subscribe", "subscriptions": [{"id": id, "channelId": id}]});
        self.socket.send(Message::text(text.to_string())).unwrap();
        id
    }

    /// Reads a message; returns it if it answers a call, and keeps those of subscriptions for [`View::next`].
    fn read_answer(&mut self) -> Option<Vec<u8>> {
        let Message::Binary(bytes) = self.socket.read().unwrap() else { return None };
        if bytes[0] == 1 {
            let subscription = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
            self.earlier.push_back((subscription, bytes[13..].to_vec()));
        }
        (bytes[0] == 3).then(|| bytes.to_vec())
    }

    /// Returns the next message of a subscription. None is lost: it may arrive before the answer to the call
    /// that caused it.
    pub fn next(&mut self, subscription: u32) -> Vec<u8> {
        let end = Instant::now() + LIMIT;
        loop {
            let found = self.earlier.iter().position(|(other, _)| *other == subscription);
            if let Some((_, message)) = found.and_then(|index| self.earlier.remove(index)) {
                return message;
            }
            assert!(Instant::now() < end, "no message within {LIMIT:?}");
            self.read_answer();
        }
    }

    /// Returns the next message of a subscription to JSON that satisfies a condition.
    pub fn next_json(&mut self, subscription: u32, wanted: impl Fn(&Value) -> bool) -> Value {
        let end = Instant::now() + LIMIT;
        loop {
            let message: Value = serde_json::from_slice(&self.next(subscription)).unwrap();
            if wanted(&message) {
                return message;
            }
            assert!(Instant::now() < end, "no such message within {LIMIT:?}; the last one: {message}");
        }
    }

    pub fn next_state(&mut self, subscription: u32) -> State {
        State::read_from_bytes(&self.next(subscription)[4..]).unwrap()
    }

    pub fn call(&mut self, service: u32, body: Value) -> Value {
        let (encoding, payload) = self.call_raw(service, body);
        assert_eq!(encoding, "json");
        serde_json::from_slice(&payload).unwrap()
    }

    /// Returns the encoding and bytes of an answer.
    pub fn call_raw(&mut self, service: u32, mut body: Value) -> (String, Vec<u8>) {
        body["token"] = json!(self.token);
        let mut bytes = vec![2];
        [service, 1, 4].iter().for_each(|word: &u32| bytes.extend_from_slice(&word.to_le_bytes()));
        bytes.extend_from_slice(b"json");
        bytes.extend_from_slice(body.to_string().as_bytes());
        self.socket.send(Message::binary(bytes)).unwrap();
        let end = Instant::now() + LIMIT;
        let bytes = loop {
            assert!(Instant::now() < end, "no answer within {LIMIT:?}");
            if let Some(bytes) = self.read_answer() {
                break bytes;
            }
        };
        let end = 13 + u32::from_le_bytes(bytes[9..13].try_into().unwrap()) as usize;
        (String::from_utf8(bytes[13..end].to_vec()).unwrap(), bytes[end..].to_vec())
    }

    /// Ends a viewer of a log.
    pub fn stop(self) {
        signal(self.child.id(), Signal::TERM);
        assert_eq!(self.end(), Some(0));
    }

    fn end(mut self) -> Option<i32> {
        wait_for("the end of the viewer", || self.child.try_wait().unwrap()).code()
    }
}

/// Returns the message that a new client receives on a channel.
fn kept(view: &View, topic: &str) -> Value {
    let (mut socket, channels) = connect(&view.address, &view.token);
    let id = &channels.iter().find(|channel| channel["topic"] == topic).unwrap()["id"];
    let text = json!({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": id}]});
    socket.send(Message::text(text.to_string())).unwrap();
    loop {
        if let Message::Binary(bytes) = socket.read().unwrap()
            && bytes[0] == 1
        {
            return serde_json::from_slice(&bytes[13..]).unwrap();
        }
    }
}

/// Connects a client to a viewer; also returns the advertised channels.
fn connect(address: &str, token: &str) -> (WebSocket<TcpStream>, Vec<Value>) {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    let mut request = format!("ws://{address}/ws?token={token}").into_client_request().unwrap();
    request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().unwrap());
    let (mut socket, _) = tungstenite::client(request, stream).unwrap();
    loop {
        let message = next_text(&mut socket);
        if message["op"] == "advertise" {
            return (socket, message["channels"].as_array().unwrap().clone());
        }
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
    // The driven motion is in the log, and replays without the viewer.
    assert_replays(&ended.folder);
}

/// A speed below the run's own is held, in particular not exceeded, and released again.
#[test]
fn a_run_is_held_to_a_speed() {
    let place = Place::new();
    let run = place.start(&scenes::drill("lockstep", 600.0));
    let mut view = View::start(&[], Some(&run.session()));
    assert_eq!(view.call(1, json!({"action": "speed", "speed": 0.25})), json!({"ok": true}));
    assert_eq!(kept(&view, "/view/pace"), json!({"speed": 0.25}));
    // Before the client joins: ticks that wait in its queue while this thread is delayed took time, too.
    let began = Instant::now();
    let client = Client::join(&run.session());
    let first = client.wait_for_state(|_| true).tick;
    let last = client.wait_for_state(|state| state.tick > first + 150).tick;
    let wall_ms = began.elapsed().as_millis() as u64;
    // A slow machine computes fewer ticks, never more; a step of 20 ms may be in progress at either end, and
    // one of them may be late.
    let most = wall_ms / 4 + 60;
    assert!(last - first <= most, "{} ticks in {wall_ms} ms at a quarter of real time", last - first);
    let refused = view.call(1, json!({"action": "speed", "speed": -1.0}));
    assert!(refused["error"].as_str().unwrap().contains("`speed` is -1"), "{refused}");
    assert_eq!(view.call(1, json!({"action": "speed", "speed": 0.0})), json!({"ok": true}));
    assert_eq!(kept(&view, "/view/pace"), json!({"speed": null}));
    let states = view.subscribe("/state");
    let now = view.next_state(states).tick;
    while view.next_state(states).tick < now + 500 {}
    assert_eq!(view.call(1, json!({"action": "stop"})), json!({"ok": true}));
    drop(client);
    let ended = run.end();
    assert_eq!((ended.code, view.end()), (Some(0), Some(0)), "{}", ended.err);
    assert_replays(&ended.folder);
}

/// Regression: with four controllers, X-ray and a viewer the ninth subscriber of the run's status was
/// rejected.
#[test]
fn two_viewers_and_other_clients_watch_one_run() {
    let place = Place::new();
    let run = place.start(&scenes::drill("lockstep", 600.0));
    let session = run.session();
    let mut views = [View::start(&[], Some(&session)), View::start(&[], Some(&session))];
    let clients: Vec<Client> = (0..5).map(|_| Client::join(&session)).collect();
    for client in &clients {
        client.wait_for_state(|state| state.tick > 0);
    }
    for view in &mut views {
        let states = view.subscribe("/state");
        while view.next_state(states).tick == 0 {}
    }
    let [mut first, second] = views;
    assert_eq!(first.call(1, json!({"action": "stop"})), json!({"ok": true}));
    drop(clients);
    assert_eq!((run.end().code, first.end(), second.end()), (Some(0), Some(0), Some(0)));
}

#[test]
fn hostile_clients_and_a_viewer_that_dies_leave_the_run_alone() {
    let place = Place::new();
    let run = place.start(&scenes::drill("lockstep", 2.0));
    let view = View::start(&[], Some(&run.session()));
    // One subscribes to everything and never reads, one floods, one is too large, one violates the protocol.
    let (mut lazy, channels) = connect(&view.address, &view.token);
    let all: Vec<Value> = channels.iter().map(|c| json!({"id": c["id"], "channelId": c["id"]})).collect();
    lazy.send(Message::text(json!({"op": "subscribe", "subscriptions": all}).to_string())).unwrap();
    let (mut flooding, _) = connect(&view.address, &view.token);
    while flooding.send(Message::text("{}")).is_ok() {}
    let (mut large, _) = connect(&view.address, &view.token);
    while large.send(Message::text("x".repeat(100_000))).is_ok() {}
    TcpStream::connect(&view.address).unwrap().write_all(b"\xff\0 nonsense\r\n\r\n").unwrap();
    signal(view.child.id(), Signal::KILL);
    let ended = run.end_well();
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
    let unseen =
        trabecula(&[&"run", &place.scene(&scenes::drill("lockstep", 0.1)), &format!("--view={port}")]);
    assert_eq!(unseen.code, Some(2), "{}", unseen.err);
    assert!(unseen.err.contains(&format!("--view={port}: cannot listen on the port")), "{}", unseen.err);
    let missing = trabecula(&[&"view", &place.path("none.mcap"), &"--no-open", &"--port", &"0"]);
    assert_eq!(missing.code, Some(2), "{}", missing.err);
    let lone = trabecula(&[&"view", &"--session", &place.path("none"), &"--no-open", &"--port", &"0"]);
    assert_eq!(lone.code, Some(2), "{}", lone.err);
}

/// Returns the texts of the first notices that a log's viewer shows.
pub fn notices(view: &mut View, count: usize) -> Vec<String> {
    let channel = view.subscribe("/view/notice");
    let text = |bytes: Vec<u8>| serde_json::from_slice::<Value>(&bytes).unwrap()["text"].to_string();
    (0..count).map(|_| text(view.next(channel))).collect()
}

/// Returns the texts of the time line's marks of a kind. A log is read while it is shown, so they arrive some
/// time after it.
fn marks(view: &mut View, kind: &str) -> Vec<String> {
    let playback = view.subscribe("/view/playback");
    let texts = |told: &Value| -> Vec<String> {
        let marks = told["events"].as_array().into_iter().flatten().filter(|mark| mark["kind"] == kind);
        marks.map(|mark| mark["text"].as_str().unwrap().to_owned()).collect()
    };
    texts(&view.next_json(playback, |told| !texts(told).is_empty()))
}

#[test]
fn a_log_without_frames_or_with_a_gap_is_shown_and_says_so() {
    let place = Place::new();
    let whole = place.complete(&scenes::drill("lockstep", 0.3)).folder.join("run.mcap");
    let bare = place.path("bare.mcap");
    rewrite(&whole, &bare, |_| {}, |_| {});
    let mut view = View::start(&[&bare], None);
    let states = view.subscribe("/state");
    let said = notices(&mut view, 1);
    assert!(said[0].contains("no X-ray frames"), "{said:?}");
    assert_eq!(view.call(4, json!({"action": "seek", "time_ns": 200_000_000})), json!({"ok": true}));
    while view.next_state(states).tick != 200 {}
    view.stop();

    // Missing ticks: the log of 300 ticks jumps to 500 after the 150th.
    let gap = place.path("gap.mcap");
    rewrite(
        &whole,
        &gap,
        |latched| latched.tick += if latched.tick >= 150 { 350 } else { 0 },
        |state| state.tick += if state.tick > 150 { 350 } else { 0 },
    );
    let mut view = View::start(&[&gap], None);
    assert_eq!(marks(&mut view, "gap"), ["ticks 151 to 500 are missing"]);
    let states = view.subscribe("/state");
    assert_eq!(view.call(4, json!({"action": "next", "kind": "gap"})), json!({"ok": true}));
    while view.next_state(states).tick != 501 {}
    view.stop();

    // A truncated log has no index.
    let cut = place.path("cut.mcap");
    let bytes = std::fs::read(&whole).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    let done = trabecula(&[&"view", &cut, &"--no-open", &"--port", &"0"]);
    assert_eq!(done.code, Some(2), "{}", done.err);
    assert!(done.err.contains("trabecula log repair"), "{}", done.err);
}

/// Two logs diverge at the first differing state that `trabecula log diff` finds; the first differing field
/// is shown.
#[test]
fn two_logs_part_where_log_diff_says() {
    let place = Place::new();
    let first = place.complete(&scenes::drill("lockstep", 0.4)).folder;
    let scene = scenes::drill("lockstep", 0.4).replace("tension_n = 6.0", "tension_n = 4.0");
    let other = Place::new();
    let second = other.complete(&scene).folder;
    let differ = trabecula(&[&"log", &"diff", &first, &second]).out;
    let words = "first divergence: tick ";
    let at = differ.find(words).unwrap() + words.len();
    let command_tick: u64 = differ[at..].split(',').next().unwrap().parse().unwrap();
    assert!(command_tick > 20 && differ[at..].contains("/latched"), "{differ}");

    let mut view = View::start(&[&first, &second], None);
    let found = marks(&mut view, "divergence");
    let text = found.first().unwrap();
    let states = view.subscribe("/state");
    // The command of tick k leads to the state of tick k + 1.
    assert!(text.starts_with(&format!("the two runs diverge at tick {};", command_tick + 1)), "{text}");
    assert!(text.contains("/latched: commands[0]") && text.contains("tendon_force_n[0]"), "{text}");
    assert_eq!(view.call(4, json!({"action": "next", "kind": "divergence"})), json!({"ok": true}));
    while view.next_state(states).tick != command_tick + 1 {}
    let no = view.call(4, json!({"action": "next", "kind": "divergence"}));
    assert!(no["error"].as_str().unwrap().contains("no divergence after"), "{no}");
    view.stop();
}

#[test]
fn fields_are_plotted_and_completions_and_the_man_page_are_made() {
    let place = Place::new();
    let run = recorded(&place, &scenes::hold("lockstep", 0.2));
    let figure = place.path("figure");
    let fields = ["tendon_tension_n[0]", "t_world_tip.position_m"];
    succeed(&[&"plot", &run, &fields[0], &fields[1], &"--output", &figure]);
    // No figure is overwritten, not even partly.
    std::fs::remove_file(figure.with_extension("png")).unwrap();
    let before = std::fs::read(figure.with_extension("svg")).unwrap();
    let again = trabecula(&[&"plot", &run, &fields[0], &"--output", &figure]);
    assert!(again.code == Some(2) && again.err.contains("already exists"), "{}", again.err);
    assert!(!figure.with_extension("png").exists());
    assert!(std::fs::read(figure.with_extension("svg")).unwrap() == before);
    std::fs::remove_file(figure.with_extension("svg")).unwrap();
    succeed(&[&"plot", &run, &fields[0], &fields[1], &"--output", &figure]);
    let png = std::fs::read(figure.with_extension("png")).unwrap();
    assert!(png.starts_with(b"\x89PNG"));
    let svg = std::fs::read_to_string(figure.with_extension("svg")).unwrap();
    assert!(fields.iter().all(|field| svg.contains(field)));
    // Regression: it was `named.svg.svg`.
    succeed(&[&"plot", &run, &fields[0], &"--output", &place.path("named.svg")]);
    assert!(place.path("named.svg").exists() && place.path("named.png").exists());
    let none = trabecula(&[&"plot", &run, &"no_such_field", &"--output", &place.path("none")]);
    assert_eq!(none.code, Some(2), "{}", none.err);
    assert!(!place.path("none.png").exists());
    for shell in ["bash", "zsh", "fish"] {
        let done = trabecula(&[&"docs", &"completions", &shell]);
        assert!(done.code == Some(0) && done.out.contains("view"), "{shell}: {}", done.err);
    }
    let man = trabecula(&[&"docs", &"man"]).out;
    assert!(man.contains(".TH") && man.contains("bind"), "{man}");
}

/// Regression: the address with the token was visible in the process list to every user, and the program that
/// opens browsers was never waited for.
#[test]
fn the_token_is_in_no_process_list_and_the_opener_is_reaped() {
    use std::os::unix::fs::{MetadataExt, PermissionsExt};
    let place = Place::new();
    let run = recorded(&place, &scenes::hold("lockstep", 0.1));
    let tools = place.path("tools");
    let runtime = place.path("runtime");
    [&tools, &runtime].into_iter().for_each(|folder| std::fs::create_dir(folder).unwrap());
    // Replaces the desktop's opener, and records its argument.
    let opener = tools.join("xdg-open");
    let script = format!(
        "#!/bin/sh\nprintf '%s\\n' \"$@\" >{0}/new && mv {0}/new {0}/given\n",
        place.path("").display()
    );
    std::fs::write(&opener, script).unwrap();
    std::fs::set_permissions(&opener, std::fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", tools.display(), std::env::var("PATH").unwrap());
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("view").arg(&run).args(["--port", "0"]).env("PATH", path).env("DISPLAY", ":99");
    command.env("XDG_RUNTIME_DIR", &runtime).stdin(Stdio::null()).stdout(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let line = first_line(&mut child);
    let url = line.trim();
    let token = url.split_once("#token=").unwrap().1;
    let given = wait_for("the opener's note", || std::fs::read_to_string(place.path("given")).ok());
    assert!(!given.contains(token), "{given}");
    let file = Path::new(given.trim());
    assert!(file.starts_with(&runtime), "{given}");
    assert_eq!(std::fs::metadata(file).unwrap().mode() & 0o777, 0o600);
    let text = std::fs::read_to_string(file).unwrap();
    assert!(text.contains(&format!("url={url}\"")), "{text}");
    // The opener has ended, and no child is left of it.
    let children = format!("/proc/{0}/task/{0}/children", child.id());
    let is_alone = || {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", child.id())).unwrap().flatten();
        let children =
            tasks.map(|task| std::fs::read_to_string(task.path().join("children")).unwrap_or_default());
        children.collect::<String>().trim().is_empty().then_some(())
    };
    if Path::new(&children).exists() {
        wait_for("the end of the opener", is_alone);
    }
    signal(child.id(), Signal::TERM);
    let code = wait_for("the end of the viewer", || child.try_wait().unwrap()).code();
    assert_eq!(code, Some(0));
    assert!(!file.exists(), "{given} is left");
}
