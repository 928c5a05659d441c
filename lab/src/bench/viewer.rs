//! Cost of the viewer for the physics: the same real-time run with and without it, alternating; with it, a
//! client receives every state, tick timing, frame and surface block.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;
use serde_json::json;

use super::failed;
use super::recorder::{Physics, in_turn, one};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::launcher::hub::View;
use trabecula::scenes::SceneSource;

/// Runs the scene in real time for `seconds`, `rounds` times, alternately without and with a viewer.
///
/// # Errors
/// An invalid scene (2); a run that fails.
pub fn run(scene: &SceneSource, seconds: f64, rounds: usize, sheet: &mut Sheet) -> Result<(), Failure> {
    let viewed = |scene: &Scene, end: &EndRequest, with: &mut Physics| {
        // A port that was free a moment ago.
        let port = TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).map_err(failed)?.port();
        let over = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let watching = scope.spawn(|| watch(port, &over));
            let made = one(scene, None, Some(View { port, watch_by_anyone: true }), end, with);
            over.store(true, Ordering::Relaxed);
            let taken = watching.join().map_err(|_| Failure::failed("the viewer's client has panicked"))?;
            made.map(|_| taken)
        })
    };
    let scene = scene.load()?;
    let bytes = in_turn("a viewer", [scene.clone(), scene], seconds, rounds, viewed, sheet)?;
    let text = format!("{:.1} MB per run", bytes * 1e-6);
    sheet.row("received by the viewer's client", &text, "client_bytes", json!(bytes));
    Ok(())
}

/// At least the number of channels; the server refuses subscriptions to nonexistent channels.
const CHANNELS: u32 = 40;

/// Subscribes to every channel and reads everything; returns the number of bytes.
fn watch(port: u16, over: &AtomicBool) -> u64 {
    let mut taken = 0;
    while !over.load(Ordering::Relaxed) {
        match TcpStream::connect(("127.0.0.1", port)).and_then(|stream| take(stream, port, over, &mut taken))
        {
            Ok(()) => break,
            // The viewer is not up yet.
            Err(_) => std::thread::sleep(Duration::from_millis(50)),
        }
    }
    taken
}

fn take(mut stream: TcpStream, port: u16, over: &AtomicBool, taken: &mut u64) -> std::io::Result<()> {
    // The key is any 16 bytes; RFC 6455, section 1.3.
    let request = format!(
        "GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
         Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
    );
    stream.write_all(request.as_bytes())?;
    let wanted: Vec<String> =
        (1..=CHANNELS).map(|id| format!("{{\"id\":{id},\"channelId\":{id}}}")).collect();
    let text = format!("{{\"op\":\"subscribe\",\"subscriptions\":[{}]}}", wanted.join(","));
    // A final text frame with a 16-bit length and a zero mask (RFC 6455, section 5.2).
    let [high, low] = (text.len() as u16).to_be_bytes();
    stream.write_all(&[0x81, 0x80 | 126, high, low, 0, 0, 0, 0])?;
    stream.write_all(text.as_bytes())?;
    stream.set_read_timeout(Some(Duration::from_millis(200)))?;
    let mut buffer = vec![0; 1 << 16];
    while !over.load(Ordering::Relaxed) {
        match stream.read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(count) => *taken += count as u64,
            Err(error)
                if matches!(error.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
