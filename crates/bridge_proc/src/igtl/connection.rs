//! The connection to one peer: a reader thread and a writer thread.

use std::io::{ErrorKind, Read, Write};
use std::net::{IpAddr, Shutdown, TcpStream};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use openigtlink::{Decoder, Error, StatusCode};

use super::incoming;
use super::peer::{Gate, Peer};

/// Largest message body accepted from a peer, in bytes: plans and poses are below 100 kB.
const MOST_BODY_BYTES: usize = 1 << 20;
/// How long a peer may stop reading before it is disconnected.
const WRITE_LIMIT: Duration = Duration::from_secs(5);
/// How often the threads check whether to end.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// Number of a peer's invalid messages that are answered; later ones are only counted.
pub(crate) const MOST_COMPLAINTS: u64 = 100;
/// Pause after each message of a watcher: reading a flood must not take the processor from the bridge.
const WATCHER_PAUSE: Duration = Duration::from_millis(1);

/// A peer with its threads.
#[derive(Debug)]
pub(crate) struct Connection {
    pub(crate) peer: Arc<Peer>,
    /// The address that it connected from.
    pub(crate) address: Option<IpAddr>,
    /// Set once the peer has got what every peer gets first.
    pub(crate) is_introduced: bool,
    stream: TcpStream,
    threads: Vec<JoinHandle<()>>,
}

impl Connection {
    /// Starts the threads of a peer.
    ///
    /// # Errors
    /// The operating system's error: no thread, no second handle.
    pub(crate) fn start(stream: TcpStream, gate: Arc<Gate>) -> std::io::Result<Connection> {
        stream.set_read_timeout(Some(LOOK_PERIOD))?;
        stream.set_write_timeout(Some(WRITE_LIMIT))?;
        stream.set_nodelay(true)?;
        let peer = Arc::new(Peer::new(gate));
        let mut connection = Connection {
            peer: Arc::clone(&peer),
            address: stream.peer_addr().ok().map(|address| address.ip()),
            is_introduced: false,
            stream: stream.try_clone()?,
            threads: Vec::new(),
        };
        let (reader, writer) = (stream.try_clone()?, stream);
        let reading = Arc::clone(&peer);
        connection.spawn("igtl-read", move || read(reader, &reading))?;
        connection.spawn("igtl-write", move || write(writer, &peer))?;
        Ok(connection)
    }

    fn spawn(&mut self, name: &str, work: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
        self.threads.push(std::thread::Builder::new().name(name.into()).spawn(work)?);
        Ok(())
    }

    /// Closes the connection without waiting for its threads; queued messages are not sent.
    pub(crate) fn cut(&self) {
        self.peer.outbox.close();
        let _ = self.stream.shutdown(Shutdown::Both);
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
        self.cut();
        self.threads.drain(..).for_each(|thread| {
            let _ = thread.join();
        });
    }
}

fn read(mut stream: TcpStream, peer: &Peer) {
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
        if !take_all(&mut decoder, peer) {
            break;
        }
    }
    peer.outbox.close();
}

/// Reads all complete messages; returns whether the stream can be read further.
fn take_all(decoder: &mut Decoder, peer: &Peer) -> bool {
    loop {
        let had_checksums = !decoder.lacks_checksums();
        let decoded = decoder.next();
        decoder.version().into_iter().for_each(|version| peer.speaks(version));
        if had_checksums && decoder.lacks_checksums() {
            let note = "messages without a checksum (CRC 0) are accepted unverified";
            peer.answer("Trabecula", StatusCode::Ok, note);
        }
        let request = match decoded {
            Ok(Some(message)) => incoming::request(&message),
            Ok(None) => return true,
            Err(error @ (Error::HeaderVersion(_) | Error::TooLarge { .. })) => {
                peer.refuse(StatusCode::Unknown, &error.to_string());
                return false;
            }
            Err(error) => Err(error.to_string()),
        };
        match request {
            Ok(None) => {}
            Ok(Some(request)) => peer.submit(request),
            Err(problem) => peer.refuse(StatusCode::Unknown, &problem),
        }
        if !peer.is_owner() {
            std::thread::sleep(WATCHER_PAUSE);
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
        let sent = message.encode(peer.version()).is_ok_and(|bytes| stream.write_all(&bytes).is_ok());
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
    use std::time::Instant;

    use openigtlink::{Body, HEADER_BYTES, HeaderVersion, Message};

    use super::super::Permission;
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
        let gate = Gate::new(Permission::WatchOnly);
        let connection = Connection::start(listener.accept().unwrap().0, gate).unwrap();
        for part in 0..250 {
            let text = Body::Text("x".repeat(60_000));
            connection.peer.outbox.put(Message::new(&format!("Part{part}"), text).unwrap());
        }
        peer.write_all(&[0xff; 4096]).unwrap();
        wait_for("the peer is given up", || connection.peer.outbox.is_closed());
        (connection, peer)
    }

    /// Regression: an unverified message that was refused used up the note.
    #[test]
    fn a_peer_without_checksums_is_told_even_if_its_first_message_is_refused() {
        let message = Message::new("Command", Body::Text("halt".into())).unwrap();
        let mut bytes = message.encode(HeaderVersion::V1).unwrap();
        // No checksum, and a text longer than the body.
        bytes[HEADER_BYTES - 8..HEADER_BYTES].fill(0);
        bytes[HEADER_BYTES + 2..HEADER_BYTES + 4].fill(0xff);
        let peer = Peer::new(Gate::new(Permission::WatchOnly));
        let mut decoder = Decoder::new(MOST_BODY_BYTES);
        decoder.push(&bytes);
        assert!(take_all(&mut decoder, &peer));
        let note = peer.outbox.take(LIMIT).unwrap().body;
        assert!(matches!(&note, Body::Status(note) if note.message.contains("CRC 0")), "{note:?}");
        assert_eq!(peer.refused(), 1);
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
