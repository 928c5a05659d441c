//! The connected peers: accepts or connects to them, sends to them, and closes them.

use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use openigtlink::{Message, StatusCode};

use super::connection::{Connection, Peer, PeerRequest};
use super::{IgtlError, PeerEndpoint, Permission, Summary};

/// Maximum number of peers at a time; further ones are closed immediately.
const MOST_PEERS: usize = 16;
/// How often the shutdown checks whether everything has been sent.
const SENT_PERIOD: Duration = Duration::from_millis(5);
/// Capacity of the request queue.
const MOST_REQUESTS: usize = 64;
/// How often the bridge tries to connect to a peer, and the timeout of each try.
const SEEK_PERIOD: Duration = Duration::from_secs(1);
const SEEK_LIMIT: Duration = Duration::from_millis(200);

#[derive(Debug)]
enum Source {
    Listener(TcpListener),
    Sought { address: SocketAddr, next: Instant },
}

#[derive(Debug)]
pub(crate) struct Peers {
    source: Source,
    connections: Vec<Connection>,
    sender: SyncSender<PeerRequest>,
    requests: Receiver<PeerRequest>,
    open_to_all: bool,
    summary: Summary,
}

impl Peers {
    pub(crate) fn open(place: PeerEndpoint, permission: &Permission) -> Result<Peers, IgtlError> {
        let source = match place {
            PeerEndpoint::Listen(address) => {
                let fail = |cause| IgtlError::Listen { address, cause };
                let listener = TcpListener::bind(address).map_err(fail)?;
                listener.set_nonblocking(true).map_err(fail)?;
                Source::Listener(listener)
            }
            PeerEndpoint::Connect(address) => Source::Sought { address, next: Instant::now() },
        };
        let (sender, requests) = sync_channel(MOST_REQUESTS);
        let open_to_all = *permission == Permission::Anyone;
        Ok(Peers {
            source,
            connections: Vec::new(),
            sender,
            requests,
            open_to_all,
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
    pub(crate) fn admit(&mut self) -> Vec<Arc<Peer>> {
        let (over, here) = std::mem::take(&mut self.connections).into_iter().partition(Connection::is_over);
        self.connections = here;
        self.let_go(over);
        let mut came = Vec::new();
        while let Some(stream) = self.next_stream() {
            if self.connections.len() >= MOST_PEERS {
                continue;
            }
            // A stream that has already been closed fails here; nothing is lost.
            let Ok(connection) = Connection::start(stream, self.sender.clone()) else { continue };
            if self.open_to_all {
                let _ = connection.peer.may_control.set(());
            }
            connection.peer.answer("Trabecula", StatusCode::Ok, "connected");
            came.push(Arc::clone(&connection.peer));
            self.summary.peers += 1;
            self.connections.push(connection);
        }
        came
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

    /// Returns the requests of all peers in order of arrival.
    pub(crate) fn requests(&self) -> Vec<PeerRequest> {
        self.requests.try_iter().take(MOST_REQUESTS).collect()
    }

    /// Queues a message for every peer.
    pub(crate) fn send(&self, message: &Message) {
        self.connections.iter().for_each(|connection| connection.peer.outbox.put(message.clone()));
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
