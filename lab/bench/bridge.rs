//! What a bridge costs the physics: the same real-time run with and without it, alternating; with it, a peer takes all that it sends.

use std::io::{BufRead, BufReader, Read};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::thread::JoinHandle;

use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;
use serde_json::json;

use super::failed;
use super::recorder::{Physics, in_turn, one_seen};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::scenes::SceneSource;

/// A bridge that can be measured.
#[derive(Debug)]
struct Kind {
    /// Name of its command below `trabecula bridge`.
    name: &'static str,
    /// Its arguments besides `--session`.
    arguments: &'static [&'static str],
    /// Takes what it sends until it has ended, and returns the number of bytes; gets what the bridge prints.
    peer: fn(ChildStdout) -> std::io::Result<u64>,
}

/// One line for each.
const KINDS: [Kind; 1] = [Kind { name: "igtl", arguments: &["--port", "0"], peer: take_from_port }];

/// The names of [`KINDS`].
pub fn names() -> [&'static str; KINDS.len()] {
    KINDS.map(|kind| kind.name)
}

/// Runs the scene in real time for `seconds`, `rounds` times, alternately without and with a bridge.
///
/// # Errors
/// An invalid scene, no such bridge (2); a run or a bridge that fails.
pub fn run(
    name: &str,
    scene: &SceneSource,
    seconds: f64,
    rounds: usize,
    sheet: &mut Sheet,
) -> Result<(), Failure> {
    let kind = KINDS.into_iter().find(|kind| kind.name == name);
    let kind = kind.ok_or_else(|| Failure::bad_input(format!("no bridge is called {name}")))?;
    let bridged = |scene: &Scene, end: &EndRequest, with: &mut Physics| {
        let mut bridge: Option<Result<Bridge, Failure>> = None;
        one_seen(scene, None, None, end, with, |snapshot| {
            if bridge.is_none() && snapshot.state.is_some() {
                bridge = Some(Bridge::start(&kind, snapshot.session));
            }
        })?;
        bridge.ok_or_else(|| Failure::failed("the run ended before a state was seen"))??.end()
    };
    let scene = scene.load()?;
    let what = format!("`trabecula bridge {name}`");
    let bytes = in_turn(&what, [scene.clone(), scene], seconds, rounds, bridged, sheet)?;
    let text = format!("{:.2} MB a run, {:.2} MB/s", bytes * 1e-6, bytes * 1e-6 / seconds);
    sheet.row("taken by the bridge's peer", &text, "peer_bytes", json!(bytes));
    Ok(())
}

/// A bridge in a process of its own and its peer in a thread.
#[derive(Debug)]
struct Bridge {
    process: Child,
    peer: JoinHandle<std::io::Result<u64>>,
}

impl Bridge {
    fn start(kind: &Kind, session: &Path) -> Result<Bridge, Failure> {
        let mut command = Command::new(std::env::current_exe().map_err(failed)?);
        command.args(["bridge", kind.name]).args(kind.arguments).arg("--session").arg(session);
        let mut process = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().map_err(failed)?;
        let said = process.stdout.take().ok_or_else(|| Failure::failed("the bridge has no output"))?;
        let peer = kind.peer;
        let peer = std::thread::spawn(move || peer(said));
        Ok(Bridge { process, peer })
    }

    /// Waits for both. The bridge ends with its session, and its peer with the bridge.
    fn end(mut self) -> Result<u64, Failure> {
        let status = self.process.wait().map_err(failed)?;
        let taken = self.peer.join().map_err(|_| Failure::failed("the bridge's peer has panicked"))?;
        if !status.success() {
            return Err(Failure::failed(format!("the bridge failed: {status}")));
        }
        taken.map_err(|cause| Failure::failed(format!("the bridge's peer: {cause}")))
    }
}

/// A peer of a bridge that listens: its first line ends with its address.
fn take_from_port(said: ChildStdout) -> std::io::Result<u64> {
    let mut said = BufReader::new(said);
    let mut line = String::new();
    said.read_line(&mut line)?;
    let address = line.split_whitespace().last().unwrap_or_default();
    let mut stream = TcpStream::connect(address)?;
    let (mut taken, mut buffer) = (0, vec![0; 1 << 16]);
    loop {
        match stream.read(&mut buffer)? {
            0 => break,
            count => taken += count as u64,
        }
    }
    // So that its last line does not block it.
    said.read_to_string(&mut line)?;
    Ok(taken)
}
