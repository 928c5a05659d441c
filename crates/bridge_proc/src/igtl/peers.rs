//! The connected peers: accepts or connects to them, sends to them, and closes them.

use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use openigtlink::{Message, StatusCode};

use super::connection::Connection;
use super::incoming::Request;
use super::peer::{Gate, Peer};
use super::{IgtlError, IgtlOptions, PeerEndpoint, Summary};

/// Maximum number of peers at a time that only watch. At the limit a new one replaces the oldest of the
/// address that has the most, so that idle connections keep no other peer out; owners are never replaced.
const MOST_WATCHERS: usize = 16;
/// How often the shutdown checks whether everything has been sent.
const SENT_PERIOD: Duration = Duration::from_millis(5);
/// Maximum number of requests executed in one turn, of all peers.
const MOST_A_TURN: usize = 64;
/// How often the bridge tries to connect to a peer, and the timeout of each try.
const SEEK_PERIOD: Duration = Duration::from_secs(1);
const SEEK_LIMIT: Duration = Duration::from_millis(200);

/// A request and the peer that sent it.
#[derive(Debug)]
pub(crate) struct PeerRequest {
    pub(crate) peer: Arc<Peer>,
    pub(crate) request: Request,
}

#[derive(Debug)]
enum Source {
    Listener(TcpListener),
    Sought { address: SocketAddr, next: Instant },
}

#[derive(Debug)]
pub(crate) struct Peers {
    source: Source,
    connections: Vec<Connection>,
    gate: Arc<Gate>,
    watch_with_token: bool,
    summary: Summary,
}

impl Peers {
    pub(crate) fn open(options: &IgtlOptions) -> Result<Peers, IgtlError> {
        let source = match options.peers {
            PeerEndpoint::Listen(address) => {
                let fail = |cause| IgtlError::Listen { address, cause };
                let listener = TcpListener::bind(address).map_err(fail)?;
                listener.set_nonblocking(true).map_err(fail)?;
                Source::Listener(listener)
            }
            PeerEndpoint::Connect(address) => Source::Sought { address, next: Instant::now() },
        };
        Ok(Peers {
            source,
            connections: Vec::new(),
            gate: Gate::new(options.permission.clone()),
            watch_with_token: options.watch_with_token,
            summary: Summary::default(),
        })
    }

    /// Returns the address it listens on.
    pub(crate) fn address(&self) -> Option<SocketAddr> {
        match &self.source {
            Source::Listener(listener) => listener.local_addr().ok(),
            Source::Sought { .. } => None,
        }
    }

    /// Drops peers that have disconnected, and accepts new ones.
    pub(crate) fn admit(&mut self) {
        // What a peer requested before it disconnected is still executed.
        let is_done = |connection: &Connection| connection.is_over() && !connection.peer.has_requests();
        let (over, here) = std::mem::take(&mut self.connections).into_iter().partition(is_done);
        self.connections = here;
        self.let_go(over);
        for _ in 0..MOST_WATCHERS {
            let Some(stream) = self.next_stream() else { return };
            self.make_room();
            // A stream that has already been closed fails here; nothing is lost.
            let Ok(connection) = Connection::start(stream, Arc::clone(&self.gate)) else { continue };
            connection.peer.answer("Trabecula", StatusCode::Ok, "connected");
            self.summary.peers += 1;
            self.connections.push(connection);
        }
    }

    /// Closes a watcher if there are as many as allowed.
    fn make_room(&self) {
        let watchers: Vec<&Connection> = self
            .connections
            .iter()
            .filter(|connection| !connection.peer.is_owner() && !connection.peer.outbox.is_closed())
            .collect();
        if watchers.len() >= MOST_WATCHERS {
            let count = |address| watchers.iter().filter(|other| other.address == address).count();
            // The oldest is first, and must be found first among equals.
            let busiest = watchers.iter().rev().max_by_key(|watcher| count(watcher.address));
            busiest.iter().for_each(|watcher| watcher.cut());
        }
    }

    /// Returns the peers that are allowed to watch since the last call.
    pub(crate) fn newcomers(&mut self) -> Vec<Arc<Peer>> {
        let may_watch = !self.watch_with_token;
        let is_new = |new: &&mut Connection| !new.is_introduced && (may_watch || new.peer.is_owner());
        let new = self.connections.iter_mut().filter(is_new);
        new.map(|connection| {
            connection.is_introduced = true;
            Arc::clone(&connection.peer)
        })
        .collect()
    }

    fn next_stream(&mut self) -> Option<TcpStream> {
        match &mut self.source {
            Source::Listener(listener) => {
                let (stream, _) = listener.accept().ok()?;
                stream.set_nonblocking(false).ok()?;
                Some(stream)
            }
            Source::Sought { address, next } => {
                if !self.connections.is_empty() || Instant::now() < *next {
                    return None;
                }
                *next = Instant::now() + SEEK_PERIOD;
                TcpStream::connect_timeout(address, SEEK_LIMIT).ok()
            }
        }
    }

    /// Removes requests and returns them: one of each peer in turn, so that a peer that sends many does not
    /// delay the others'.
    pub(crate) fn requests(&self) -> Vec<PeerRequest> {
        let mut all = Vec::new();
        loop {
            let before = all.len();
            for peer in self.connections.iter().map(|connection| &connection.peer) {
                if all.len() >= MOST_A_TURN {
                    return all;
                }
                let request = peer.next_request();
                all.extend(request.map(|request| PeerRequest { peer: Arc::clone(peer), request }));
            }
            if all.len() == before {
                return all;
            }
        }
    }

    /// Queues a message for every peer that is allowed to watch.
    pub(crate) fn send(&self, message: &Message) {
        let watching = self.connections.iter().filter(|connection| connection.is_introduced);
        watching.for_each(|connection| connection.peer.outbox.put(message.clone()));
    }

    /// Sends all queued messages, to all peers at the same time, and closes all connections.
    pub(crate) fn close(mut self) -> Summary {
        let all = std::mem::take(&mut self.connections);
        all.iter().for_each(|connection| connection.peer.outbox.close());
        while !all.iter().all(Connection::is_over) {
            std::thread::sleep(SENT_PERIOD);
        }
        self.let_go(all);
        self.summary
    }

    fn let_go(&mut self, connections: Vec<Connection>) {
        for connection in connections {
            let peer = Arc::clone(&connection.peer);
            drop(connection);
            self.summary.replaced += peer.outbox.replaced();
            self.summary.refused += peer.refused();
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by it")]

    use std::io::{Read, Write};

    use openigtlink::{Body, HeaderVersion};

    use super::super::Permission;
    use super::*;

    const LIMIT: Duration = Duration::from_secs(60);

    fn open(permission: Permission, watch_with_token: bool) -> Peers {
        let options = IgtlOptions {
            session: None,
            controller: None,
            peers: PeerEndpoint::Listen(([127, 0, 0, 1], 0).into()),
            permission,
            watch_with_token,
            rate_hz: 30.0,
            approach_m_per_s: 0.02,
            feed_m_per_s: 0.001,
            burr_rad_per_s: 200.0,
        };
        Peers::open(&options).unwrap()
    }

    fn connect(peers: &mut Peers) -> TcpStream {
        let stream = TcpStream::connect(peers.address().unwrap()).unwrap();
        let before = peers.summary.peers;
        wait_for(peers, "the peer is admitted", |peers| peers.summary.peers > before);
        stream
    }

    /// Lets the peers' threads work until a condition holds.
    fn wait_for(peers: &mut Peers, what: &str, mut is_so: impl FnMut(&mut Peers) -> bool) {
        let begin = Instant::now();
        while !is_so(peers) {
            assert!(begin.elapsed() < LIMIT, "{what}: not within {LIMIT:?}");
            peers.admit();
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn say(mut stream: &TcpStream, device: &str, text: &str) {
        let message = Message::new(device, Body::Text(text.into())).unwrap();
        stream.write_all(&message.encode(HeaderVersion::V1).unwrap()).unwrap();
    }

    fn token() -> Permission {
        Permission::Token("c0ffee00".into())
    }

    /// Regression: 16 idle connections locked everybody else out, the owner included.
    #[test]
    fn idle_watchers_lock_nobody_out_and_replace_no_owner() {
        let mut peers = open(token(), false);
        let mut idle: Vec<TcpStream> = (0..MOST_WATCHERS).map(|_| connect(&mut peers)).collect();
        let owner = connect(&mut peers);
        say(&owner, "Token", "c0ffee00");
        wait_for(&mut peers, "the owner is known", |peers| {
            peers.connections.iter().any(|connection| connection.peer.is_owner())
        });
        idle.extend((0..3 * MOST_WATCHERS).map(|_| connect(&mut peers)));
        wait_for(&mut peers, "the oldest are closed", |peers| peers.connections.len() == MOST_WATCHERS + 1);
        // The oldest idle connection is closed, after what was sent to it.
        idle[0].set_read_timeout(Some(LIMIT)).unwrap();
        let _ = idle[0].read_to_end(&mut Vec::new());
        say(&owner, "Command", "halt");
        let mut requests = Vec::new();
        wait_for(&mut peers, "the owner's request", |peers| {
            requests.extend(peers.requests());
            !requests.is_empty()
        });
        assert_eq!(requests[0].request, Request::Halt);
    }

    /// Regression: the requests of all peers shared a queue, which peers without the token kept full.
    #[test]
    fn a_flood_without_the_token_takes_nothing_from_the_owner() {
        let mut peers = open(token(), false);
        let floods = [connect(&mut peers), connect(&mut peers)];
        let owner = connect(&mut peers);
        say(&owner, "Token", "c0ffee00");
        for _ in 0..200 {
            floods.iter().for_each(|flood| say(flood, "Command", "stop"));
        }
        wait_for(&mut peers, "the floods are read", |peers| {
            peers.connections.iter().filter(|connection| connection.peer.refused() == 200).count() == 2
        });
        say(&owner, "Command", "halt");
        let mut requests = Vec::new();
        wait_for(&mut peers, "the owner's request", |peers| {
            requests.extend(peers.requests());
            !requests.is_empty()
        });
        assert!(requests.iter().all(|asked| asked.request == Request::Halt), "{requests:?}");
    }

    #[test]
    fn peers_get_the_run_only_with_the_token_if_so_configured() {
        let mut peers = open(token(), true);
        let stream = connect(&mut peers);
        assert!(peers.newcomers().is_empty());
        say(&stream, "Token", "c0ffee00");
        wait_for(&mut peers, "the peer may watch", |peers| peers.newcomers().len() == 1);
        assert!(peers.newcomers().is_empty(), "introduced once");
        let mut open_to_all = open(token(), false);
        let _stream = connect(&mut open_to_all);
        assert_eq!(open_to_all.newcomers().len(), 1);
    }
}
