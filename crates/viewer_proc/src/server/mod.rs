//! The server: the page over HTTP, and one WebSocket per client. Asynchronous, on one thread.

mod connection;
pub mod http;
mod pending;

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

use crate::board::Board;
use crate::calls::CallSender;
use crate::error::ViewerError;
use http::{AllowedHost, Origins, Reach};
use pending::{PendingConnection, PendingConnections};

/// Maximum number of WebSocket clients with the token, and of those without it; further ones are refused.
pub const MAX_CLIENTS: usize = 32;
/// Timeout from accepting a connection to its complete request.
const HEAD_LIMIT: Duration = Duration::from_secs(5);
const END_CHECK_PERIOD: Duration = Duration::from_millis(50);

/// Server options.
#[derive(Debug, Clone)]
pub struct ServerOptions {
    /// Address to listen on.
    pub bind: IpAddr,
    /// Port; 0 picks a free one.
    pub port: u16,
    /// Origins in addition to the page's own that may connect.
    pub allow_origin: Vec<String>,
    /// Hosts in addition to the server's own address that requests may name.
    pub allow_host: Vec<AllowedHost>,
    /// Whether clients without a token may watch.
    pub watch_by_anyone: bool,
    /// Folder to read the page from, instead of the copy in the program.
    pub page_folder: Option<PathBuf>,
}

/// State shared by all connections.
#[derive(Debug)]
pub(crate) struct Shared {
    pub board: Arc<Board>,
    pub calls: CallSender,
    pub token: String,
    pub watch_by_anyone: bool,
    pub name: String,
    pub origins: Origins,
    pub own: SocketAddr,
    /// Free slots of clients with the token.
    pub room: Arc<Semaphore>,
    /// Free slots of clients without the token, if they may watch.
    pub watchers_room: Arc<Semaphore>,
    pub reach: Reach,
    pub page_folder: Option<PathBuf>,
    pub end: Arc<AtomicBool>,
}

/// An open port and its token. What is shown there can change (a scene, its run, the run's log); page and
/// address stay the same.
#[derive(Debug)]
pub struct ListeningPort {
    listener: std::net::TcpListener,
    address: SocketAddr,
    token: String,
    options: ServerOptions,
}

impl ListeningPort {
    /// Opens the port.
    ///
    /// # Errors
    /// [`ViewerError::Port`], [`ViewerError::Token`].
    pub fn open(options: &ServerOptions) -> Result<ListeningPort, ViewerError> {
        let wanted = SocketAddr::new(options.bind, options.port);
        let port_error = |cause: std::io::Error| ViewerError::Port { address: wanted, cause };
        let listener = std::net::TcpListener::bind(wanted).map_err(port_error)?;
        listener.set_nonblocking(true).map_err(port_error)?;
        let address = listener.local_addr().map_err(port_error)?;
        Ok(ListeningPort { listener, address, token: random_token()?, options: options.clone() })
    }

    /// Returns the page's URL, with the token that permits watching and control.
    pub fn url(&self) -> String {
        format!("http://{}/#token={}", self.address, self.token)
    }

    /// The page's URLs at the allowed hosts, as through a tunnel.
    pub fn other_urls(&self) -> impl Iterator<Item = String> + '_ {
        self.options.allow_host.iter().map(|host| format!("http://{host}/#token={}", self.token))
    }

    /// The address the server listens on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The token.
    pub fn token(&self) -> &str {
        &self.token
    }
}

/// A server on an open port, not serving yet.
#[derive(Debug)]
pub struct Server {
    listener: std::net::TcpListener,
    shared: Arc<Shared>,
}

impl Server {
    /// Creates a server that shows one thing; clients that connect before it serves have to wait.
    ///
    /// # Errors
    /// [`ViewerError::Port`]: the system is out of file handles.
    pub fn behind(
        door: &ListeningPort,
        name: &str,
        board: Arc<Board>,
        calls: CallSender,
        end: Arc<AtomicBool>,
    ) -> Result<Server, ViewerError> {
        let port_error = |cause: std::io::Error| ViewerError::Port { address: door.address, cause };
        let options = &door.options;
        let shared = Arc::new(Shared {
            board,
            calls,
            token: door.token.clone(),
            watch_by_anyone: options.watch_by_anyone,
            name: name.to_owned(),
            origins: Origins { allowed: options.allow_origin.clone(), hosts: options.allow_host.clone() },
            own: door.address,
            room: Arc::new(Semaphore::new(MAX_CLIENTS)),
            watchers_room: Arc::new(Semaphore::new(MAX_CLIENTS)),
            reach: if options.bind.is_loopback() { Reach::Loopback } else { Reach::Network },
            page_folder: options.page_folder.clone(),
            end,
        });
        Ok(Server { listener: door.listener.try_clone().map_err(port_error)?, shared })
    }

    /// Serves until the process is asked to end, then flushes the clients' queues.
    ///
    /// # Errors
    /// [`ViewerError::Runtime`].
    pub fn serve(self) -> Result<(), ViewerError> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(ViewerError::Runtime)?;
        let local = tokio::task::LocalSet::new();
        local.block_on(&runtime, async {
            let listener = TcpListener::from_std(self.listener).map_err(ViewerError::Runtime)?;
            let pending = PendingConnections::default();
            while !self.shared.end.load(Ordering::Relaxed) {
                // A failed accept, or reaching the limit of open files, must not stop the other clients.
                let Ok(Ok((stream, peer))) = tokio::time::timeout(END_CHECK_PERIOD, listener.accept()).await
                else {
                    continue;
                };
                let pending_connection = pending.admit(peer.ip());
                let (number, shared) = (pending_connection.number(), Arc::clone(&self.shared));
                let task = tokio::task::spawn_local(async move {
                    serve_connection(stream, &shared, pending_connection).await
                });
                pending.is_served_by(number, task.abort_handle());
            }
            // Each client connection checks for the end itself.
            let all_have_left = async {
                let _owners = self.shared.room.acquire_many(MAX_CLIENTS as u32).await;
                let _watchers = self.shared.watchers_room.acquire_many(MAX_CLIENTS as u32).await;
            };
            let _ = tokio::time::timeout(Duration::from_secs(1), all_have_left).await;
            Ok(())
        })
    }
}

async fn serve_connection(mut stream: TcpStream, shared: &Shared, pending_connection: PendingConnection) {
    // Disables Nagle's algorithm.
    let _ = stream.set_nodelay(true);
    let Ok(head) = tokio::time::timeout(HEAD_LIMIT, http::read_head(&mut stream)).await else { return };
    connection::answer(stream, head, shared, pending_connection).await;
}

/// Returns 128 random bits from the kernel, in hexadecimal.
fn random_token() -> Result<String, ViewerError> {
    use std::io::Read;
    let mut bytes = [0; 16];
    let mut source = std::fs::File::open("/dev/urandom").map_err(ViewerError::Token)?;
    source.read_exact(&mut bytes).map_err(ViewerError::Token)?;
    Ok(ipc_types::messages::layout::hex(&bytes))
}
