//! Cost of a bridge for the physics: the same real-time run without and with it, alternating; with it, a peer
//! receives everything it sends.

use std::io::{self, BufRead, BufReader, Read};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bridge_proc::ros2::Listener;
use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;
use ros_interface::topics::Names;
use serde_json::json;

use super::failed;
use super::recorder::{Physics, in_turn, one_seen};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::scenes::SceneSource;

/// Timeout for a bridge to be ready, and to end after its session.
const LIMIT: Duration = Duration::from_secs(60);
/// DDS domain of the measurement, rarely used by other programs.
const DOMAIN_ID: &str = "231";
/// Default rate of states in `bridge ros2`.
const ROS2_RATE_HZ: f64 = 100.0;
/// Poll interval of a peer.
const LOOK_PERIOD: Duration = Duration::from_millis(2);

/// A bridge that can be measured.
#[derive(Debug)]
struct Kind {
    /// Name of its command under `trabecula bridge`.
    name: &'static str,
    /// Its arguments besides `--session`.
    arguments: &'static [&'static str],
    /// Receives what the bridge sends until the flag is set, and returns the number of bytes; gets the
    /// bridge's first output line.
    peer: fn(&str, &AtomicBool) -> io::Result<u64>,
}

/// The bridges that can be measured.
const KINDS: [Kind; 2] = [
    Kind { name: "igtl", arguments: &["--port", "0"], peer: take_from_port },
    Kind {
        name: "ros2",
        arguments: &["--domain-id", DOMAIN_ID, "--discovery-range", "LOCALHOST"],
        peer: take_from_domain,
    },
];

/// The names of [`KINDS`].
pub fn names() -> [&'static str; KINDS.len()] {
    KINDS.map(|kind| kind.name)
}

/// Runs the scene in real time for `seconds`, `rounds` times, alternately without and with a bridge.
///
/// # Errors
/// An invalid scene, or an unknown bridge (2); a run or a bridge that fails.
pub fn run(
    name: &str,
    scene: &SceneSource,
    seconds: f64,
    rounds: usize,
    sheet: &mut Sheet,
) -> Result<(), Failure> {
    let kind = KINDS.into_iter().find(|kind| kind.name == name);
    let kind = kind.ok_or_else(|| Failure::bad_input(format!("unknown bridge {name}")))?;
    let bridged = |scene: &Scene, end: &EndRequest, with: &mut Physics| {
        let mut bridge: Option<Result<Bridge, Failure>> = None;
        one_seen(scene, None, None, end, with, |snapshot| {
            if bridge.is_none() && snapshot.state.is_some() {
                bridge = Some(Bridge::start(&kind, snapshot.session));
            }
        })?;
        bridge.ok_or_else(|| Failure::failed("the run ended before its first state"))??.end()
    };
    let scene = scene.load()?;
    let what = format!("`trabecula bridge {name}`");
    let bytes = in_turn(&what, [scene.clone(), scene], seconds, rounds, bridged, sheet)?;
    let text = format!("{:.2} MB per run, {:.2} MB/s", bytes * 1e-6, bytes * 1e-6 / seconds);
    sheet.row("received by the bridge's peer", &text, "peer_bytes", json!(bytes));
    Ok(())
}

/// A bridge in a separate process, and its peer in a thread.
#[derive(Debug)]
struct Bridge {
    process: Child,
    /// Set when the bridge has ended.
    over: Arc<AtomicBool>,
    peer: JoinHandle<io::Result<u64>>,
}

impl Bridge {
    fn start(kind: &Kind, session: &Path) -> Result<Bridge, Failure> {
        let mut command = Command::new(std::env::current_exe().map_err(failed)?);
        command.args(["bridge", kind.name]).args(kind.arguments).arg("--session").arg(session);
        let mut process = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().map_err(failed)?;
        let said = process.stdout.take().ok_or_else(|| Failure::failed("the bridge has no output"))?;
        let over = Arc::new(AtomicBool::new(false));
        let (take, is_over) = (kind.peer, Arc::clone(&over));
        let peer = std::thread::spawn(move || {
            let mut said = BufReader::new(said);
            let mut line = String::new();
            said.read_line(&mut line)?;
            let taken = take(&line, &is_over);
            // Drained, so that its last line does not block the bridge.
            said.read_to_string(&mut line)?;
            taken
        });
        Ok(Bridge { process, over, peer })
    }

    /// Waits for both. The bridge ends with its session, and its peer with the bridge; a bridge that does not
    /// end is killed.
    fn end(mut self) -> Result<u64, Failure> {
        let begin = Instant::now();
        let status = loop {
            if let Some(status) = self.process.try_wait().map_err(failed)? {
                break status;
            }
            if begin.elapsed() > LIMIT {
                self.process.kill().map_err(failed)?;
            }
            std::thread::sleep(LOOK_PERIOD);
        };
        self.over.store(true, Ordering::Relaxed);
        let taken = self.peer.join().map_err(|_| Failure::failed("the bridge's peer has panicked"))?;
        if !status.success() {
            return Err(Failure::failed(format!("the bridge failed: {status}")));
        }
        taken.map_err(|cause| Failure::failed(format!("the bridge's peer: {cause}")))
    }
}

/// Peer of a bridge that listens; the bridge's first line ends with its address.
fn take_from_port(line: &str, over: &AtomicBool) -> io::Result<u64> {
    let address = line.split_whitespace().last().unwrap_or_default();
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(LIMIT))?;
    let (mut taken, mut buffer) = (0, vec![0; 1 << 16]);
    while !over.load(Ordering::Relaxed) {
        match stream.read(&mut buffer)? {
            0 => break,
            count => taken += count as u64,
        }
    }
    Ok(taken)
}

/// Peer that subscribes to every topic.
fn take_from_domain(_: &str, over: &AtomicBool) -> io::Result<u64> {
    let domain_id = DOMAIN_ID.parse().map_err(io::Error::other)?;
    let mut listener =
        Listener::open(domain_id, &Names::default(), ROS2_RATE_HZ).map_err(io::Error::other)?;
    let mut taken = 0;
    while !over.load(Ordering::Relaxed) {
        taken += listener.take();
        std::thread::sleep(LOOK_PERIOD);
    }
    Ok(taken)
}
