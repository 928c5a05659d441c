//! The server: the page by HTTP, and a WebSocket for each client. One thread, asynchronous.

mod connection;
mod guests;
pub mod http;

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

use crate::board::Board;
use crate::error::ViewerError;
use crate::services::Call;
use guests::{Guest, Guests};
use http::Origins;

/// Most clients of the WebSocket at a time; more are turned away.
pub const MAX_CLIENTS: usize = 32;
/// Longest time from a connection to its request.
const HEAD_LIMIT: Duration = Duration::from_secs(5);
const END_LOOK: Duration = Duration::from_millis(50);

/// How to serve.
#[derive(Debug, Clone)]
pub struct ServerOptions {
    /// Address to listen at.
    pub bind: IpAddr,
    /// Port; 0 takes a free one.
    pub port: u16,
    /// Origins beside the page's own that may connect.
    pub allow_origin: Vec<String>,
    /// Whether who has no token may watch.
    pub watch_by_anyone: bool,
    /// Reads the page from here instead of from the program.
    pub page_folder: Option<PathBuf>,
}

/// What every connection needs.
#[derive(Debug)]
pub(crate) struct Shared {
    pub board: Arc<Board>,
    pub calls: mpsc::SyncSender<Call>,
    pub token: String,
    pub watch_by_anyone: bool,
    pub name: String,
    pub origins: Origins,
    pub own: SocketAddr,
    /// Room for clients.
    pub room: Arc<Semaphore>,
    pub any_name: bool,
    pub page_folder: Option<PathBuf>,
    pub end: Arc<AtomicBool>,
}

/// A server that listens and does not serve yet.
#[derive(Debug)]
pub struct Server {
    listener: std::net::TcpListener,
    address: SocketAddr,
    shared: Arc<Shared>,
}

impl Server {
    /// Takes the port.
    ///
    /// # Errors
    /// [`ViewerError::Port`], [`ViewerError::Token`].
    pub fn bind(
        options: &ServerOptions,
        name: &str,
        board: Arc<Board>,
        calls: mpsc::SyncSender<Call>,
        end: Arc<AtomicBool>,
    ) -> Result<Server, ViewerError> {
        let wanted = SocketAddr::new(options.bind, options.port);
        let port_error = |cause: std::io::Error| ViewerError::Port { address: wanted, cause };
        let listener = std::net::TcpListener::bind(wanted).map_err(port_error)?;
        listener.set_nonblocking(true).map_err(port_error)?;
        let address = listener.local_addr().map_err(port_error)?;
        let shared = Arc::new(Shared {
            board,
            calls,
            token: random_token()?,
            watch_by_anyone: options.watch_by_anyone,
            name: name.to_owned(),
            origins: Origins { allowed: options.allow_origin.clone() },
            own: address,
            room: Arc::new(Semaphore::new(MAX_CLIENTS)),
            any_name: !options.bind.is_loopback(),
            page_folder: options.page_folder.clone(),
            end,
        });
        Ok(Server { listener, address, shared })
    }

    /// The page's address, with the token that allows to watch and to control.
    pub fn url(&self) -> String {
        format!("http://{}/#token={}", self.address, self.shared.token)
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The token.
    pub fn token(&self) -> &str {
        &self.shared.token
    }

    /// Serves until the end is asked for, then lets the clients hear what still waits.
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
            let guests = Guests::default();
            while !self.shared.end.load(Ordering::Relaxed) {
                // A failed accept concerns one client only; so does a limit of open files.
                let Ok(Ok((stream, peer))) = tokio::time::timeout(END_LOOK, listener.accept()).await else {
                    continue;
                };
                let guest = guests.admit(peer.ip());
                let (number, shared) = (guest.number(), Arc::clone(&self.shared));
                let task =
                    tokio::task::spawn_local(async move { serve_connection(stream, &shared, guest).await });
                guests.is_served_by(number, task.abort_handle());
            }
            // The clients see the end by themselves.
            let all_have_left = self.shared.room.acquire_many(MAX_CLIENTS as u32);
            let _ = tokio::time::timeout(Duration::from_secs(1), all_have_left).await;
            Ok(())
        })
    }
}

async fn serve_connection(mut stream: TcpStream, shared: &Shared, guest: Guest) {
    // Messages leave at once.
    let _ = stream.set_nodelay(true);
    let Ok(head) = tokio::time::timeout(HEAD_LIMIT, http::read_head(&mut stream)).await else { return };
    connection::answer(stream, head, shared, guest).await;
}

/// 128 bits from the kernel, in hexadecimal.
fn random_token() -> Result<String, ViewerError> {
    use std::io::Read;
    let mut bytes = [0; 16];
    let mut source = std::fs::File::open("/dev/urandom").map_err(ViewerError::Token)?;
    source.read_exact(&mut bytes).map_err(ViewerError::Token)?;
    Ok(ipc_types::layout::hex(&bytes))
}
