//! The connection to one peer: a reader thread and a writer thread.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::Duration;

use openigtlink::{Body, Decoder, HeaderVersion, Message, Status, StatusCode};

use super::incoming::{self, Request};
use super::outbox::Outbox;

/// Largest message body accepted from a peer, in bytes: plans and poses are below 100 kB.
const MOST_BODY_BYTES: usize = 1 << 20;
/// How long a peer may stop reading before it is disconnected.
const WRITE_LIMIT: Duration = Duration::from_secs(5);
/// How often the threads check whether to end.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// Number of a peer's invalid messages that are answered; later ones are only counted.
const MOST_COMPLAINTS: u64 = 100;

/// A request and the peer that sent it.
#[derive(Debug)]
pub(crate) struct PeerRequest {
    pub(crate) peer: Arc<Peer>,
    pub(crate) request: Request,
}

/// A connected peer.
#[derive(Debug)]
pub(crate) struct Peer {
    pub(crate) outbox: Outbox,
    /// Set once the peer has proved that it may control.
    pub(crate) may_control: OnceLock<()>,
    refused: AtomicU64,
    /// Header version of the peer's messages; until one arrives 1, which every receiver understands.
    version: AtomicU8,
}

impl Peer {
    /// Answers with a STATUS.
    pub(crate) fn answer(&self, device: &str, code: StatusCode, text: &str) {
        let ascii: String =
            text.chars().map(|c| if c.is_ascii() && !c.is_ascii_control() { c } else { '?' }).collect();
        let status =
            Status { code, subcode: 0, error: String::new(), message: ascii.chars().take(500).collect() };
        if let Ok(message) = Message::new(device, Body::Status(status)) {
            self.outbox.put(message);
        }
    }

    /// Rejects a message. The number of answers is limited, in case of a flood.
    pub(crate) fn refuse(&self, code: StatusCode, text: &str) {
        if self.refused.fetch_add(1, Ordering::Relaxed) < MOST_COMPLAINTS {
            self.answer("Trabecula", code, text);
        }
    }

    /// Returns the number of messages rejected.
    pub(crate) fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }
}

/// A peer with its threads.
#[derive(Debug)]
pub(crate) struct Connection {
    pub(crate) peer: Arc<Peer>,
    stream: TcpStream,
    threads: Vec<JoinHandle<()>>,
}

impl Connection {
    /// Starts the threads of a peer.
    ///
    /// # Errors
    /// The operating system's error: no thread, no second handle.
    pub(crate) fn start(stream: TcpStream, requests: SyncSender<PeerRequest>) -> std::io::Result<Connection> {
        stream.set_read_timeout(Some(LOOK_PERIOD))?;
        stream.set_write_timeout(Some(WRITE_LIMIT))?;
        stream.set_nodelay(true)?;
        let peer = Arc::new(Peer {
            outbox: Outbox::default(),
            may_control: OnceLock::new(),
            refused: AtomicU64::new(0),
            version: AtomicU8::new(1),
        });
        let mut connection =
            Connection { peer: Arc::clone(&peer), stream: stream.try_clone()?, threads: Vec::new() };
        let (reader, writer) = (stream.try_clone()?, stream);
        let reading = Arc::clone(&peer);
        connection.spawn("igtl-read", move || read(reader, &reading, &requests))?;
        connection.spawn("igtl-write", move || write(writer, &peer))?;
        Ok(connection)
    }

    fn spawn(&mut self, name: &str, work: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
        self.threads.push(std::thread::Builder::new().name(name.into()).spawn(work)?);
        Ok(())
    }

    /// Returns whether nothing more is sent to the peer: its threads have ended, or the write limit has
    /// passed since it was disconnected. Dropping the connection then does not block.
    pub(crate) fn is_over(&self) -> bool {
        self.threads.iter().all(JoinHandle::is_finished)
            || self.peer.outbox.closed().is_some_and(|closed| closed.elapsed() >= WRITE_LIMIT)
    }
}

impl Drop for Connection {
    /// Closes immediately: queued messages are not sent.
    fn drop(&mut self) {
        self.peer.outbox.close();
        let _ = self.stream.shutdown(Shutdown::Both);
        self.threads.drain(..).for_each(|thread| {
            let _ = thread.join();
        });
    }
}

fn read(mut stream: TcpStream, peer: &Arc<Peer>, requests: &SyncSender<PeerRequest>) {
    let mut decoder = Decoder::new(MOST_BODY_BYTES);
    let mut piece = [0; 16 * 1024];
    while !peer.outbox.is_closed() {
        match stream.read(&mut piece) {
            Ok(0) => break,
            Ok(bytes) => decoder.push(&piece[..bytes]),
            Err(error)
                if matches!(
                    error.kind(),
                    ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
                ) =>
            {
                continue;
            }
            Err(_) => break,
        }
        if !take_all(&mut decoder, peer, requests) {
            break;
        }
    }
    peer.outbox.close();
}

/// Reads all complete messages; returns whether the stream can be read further.
fn take_all(decoder: &mut Decoder, peer: &Arc<Peer>, requests: &SyncSender<PeerRequest>) -> bool {
    loop {
        let message = match decoder.next() {
            Ok(Some(message)) => message,
            Ok(None) => return true,
            Err(error) => {
                peer.refuse(StatusCode::Unknown, &error.to_string());
                let out_of_step = matches!(
                    error,
                    openigtlink::Error::HeaderVersion(_) | openigtlink::Error::TooLarge { .. }
                );
                if out_of_step {
                    return false;
                }
                continue;
            }
        };
        if decoder.version() == Some(HeaderVersion::V2) {
            peer.version.store(2, Ordering::Relaxed);
        }
        match incoming::request(&message) {
            Ok(None) => {}
            Ok(Some(request)) => match requests.try_send(PeerRequest { peer: Arc::clone(peer), request }) {
                Ok(()) => {}
                Err(TrySendError::Full(_)) => peer.refuse(StatusCode::NotReady, "too many pending requests"),
                Err(TrySendError::Disconnected(_)) => return false,
            },
            Err(problem) => peer.refuse(StatusCode::Unknown, &problem),
        }
    }
}

fn write(mut stream: TcpStream, peer: &Peer) {
    loop {
        let Some(message) = peer.outbox.take(LOOK_PERIOD) else {
            if peer.outbox.is_closed() {
                return;
            }
            continue;
        };
        let version =
            if peer.version.load(Ordering::Relaxed) == 2 { HeaderVersion::V2 } else { HeaderVersion::V1 };
        let sent = message.encode(version).is_ok_and(|bytes| stream.write_all(&bytes).is_ok());
        if !sent {
            // In the middle of a message nothing else can be sent.
            peer.outbox.close();
            let _ = stream.shutdown(Shutdown::Both);
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by it")]

    use std::net::TcpListener;
    use std::sync::mpsc::sync_channel;
    use std::time::Instant;

    use super::*;

    const LIMIT: Duration = Duration::from_secs(60);

    fn wait_for(what: &str, is_so: impl Fn() -> bool) {
        let begin = Instant::now();
        while !is_so() {
            assert!(begin.elapsed() < LIMIT, "{what}: not within {LIMIT:?}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// A peer that sent garbage while more was queued for it than the buffers of both sockets hold.
    fn given_up() -> (Connection, TcpStream) {
        let listener = TcpListener::bind(("127.0.0.1", 0)).unwrap();
        let mut peer = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (sender, _requests) = sync_channel(1);
        let connection = Connection::start(listener.accept().unwrap().0, sender).unwrap();
        for part in 0..250 {
            let text = Body::Text("x".repeat(60_000));
            connection.peer.outbox.put(Message::new(&format!("Part{part}"), text).unwrap());
        }
        peer.write_all(&[0xff; 4096]).unwrap();
        wait_for("the peer is given up", || connection.peer.outbox.is_closed());
        (connection, peer)
    }

    /// Regression: the bridge's loop, which answers the physics, waited for the writer of a disconnected peer
    /// that read nothing.
    #[test]
    fn a_peer_that_is_given_up_and_does_not_read_is_over_only_when_its_writer_is() {
        let (connection, peer) = given_up();
        assert!(!connection.is_over(), "its writer is still sending");
        wait_for("the writer's end", || connection.is_over());
        drop(peer);
    }

    #[test]
    fn a_peer_that_reads_a_little_now_and_then_is_over_after_the_write_limit() {
        let (connection, mut peer) = given_up();
        peer.set_read_timeout(Some(LIMIT)).unwrap();
        let begin = Instant::now();
        while !connection.is_over() {
            assert!(begin.elapsed() < LIMIT, "still sent to after {LIMIT:?}");
            peer.read_exact(&mut [0; 8192]).unwrap();
            std::thread::sleep(Duration::from_millis(20));
        }
        drop(connection);
    }
}
