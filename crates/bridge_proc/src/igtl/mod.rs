//! The OpenIGTLink bridge: sends poses, tool, X-rays and figures; receives plans, pauses and C-arm poses.

mod connection;
mod error;
mod incoming;
mod outbox;
mod outgoing;
mod peer;
mod peers;
mod plan;
mod session;

use std::net::SocketAddr;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ipc_types::process::EndRequest;
use openigtlink::Timestamp;

pub use error::IgtlError;
pub use incoming::UNDERSTOOD;
pub use outgoing::SENT;

use peers::Peers;
use plan::Speeds;
use session::IgtlSession;

/// Which peers the bridge talks to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PeerEndpoint {
    /// Peers connect here; port 0 picks a free one.
    Listen(SocketAddr),
    /// The bridge connects to this address, and retries until a peer listens.
    Connect(SocketAddr),
}

/// Who may pause, stop, take X-rays and drive the arm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Permission {
    /// Nobody.
    WatchOnly,
    /// A peer that has sent this as a STRING named `Token`.
    Token(String),
    /// Everybody who is connected.
    Anyone,
}

/// Options of the bridge.
#[derive(Debug, Clone)]
pub struct IgtlOptions {
    /// The session's folder or name; `None`: discovered as by any client.
    pub session: Option<String>,
    /// The scene's controller that the bridge acts as; `None`: it only observes the run.
    pub controller: Option<String>,
    /// The peers to talk to.
    pub peers: PeerEndpoint,
    /// Who may control.
    pub permission: Permission,
    /// Whether peers receive nothing of the run before they have sent the token.
    pub watch_with_token: bool,
    /// Poses per second, 0.1 to 1000.
    pub rate_hz: f64,
    /// Speed of the arm on the way to a plan's entry.
    pub approach_m_per_s: f64,
    /// Feed rate from a plan's entry to its target.
    pub feed_m_per_s: f64,
    /// Burr speed on the way to a plan's target.
    pub burr_rad_per_s: f64,
}

/// Statistics of a bridge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Summary {
    /// Number of peers that connected.
    pub peers: u64,
    /// Messages replaced by a newer one of the same name before the peer read them.
    pub replaced: u64,
    /// Messages of peers that were rejected.
    pub refused: u64,
}

/// Runs the bridge until the session ends or an end is requested. `ready` is called with the address of the
/// open port.
///
/// # Errors
/// No session; a port in use; the session was lost.
pub fn serve(
    options: &IgtlOptions,
    end: &EndRequest,
    ready: impl FnOnce(Option<SocketAddr>),
) -> Result<Summary, IgtlError> {
    let speeds = Speeds {
        approach_m_per_s: options.approach_m_per_s,
        feed_m_per_s: options.feed_m_per_s,
        burr_rad_per_s: options.burr_rad_per_s,
    };
    let mut joined = IgtlSession::connect(options, speeds)?;
    let mut peers = Peers::open(options)?;
    ready(peers.address());
    let period = Duration::from_secs_f64(1.0 / options.rate_hz);
    let mut due = Instant::now();
    while !end.is_set() && joined.advance()? {
        peers.requests().iter().for_each(|asked| joined.obey(asked));
        peers.admit();
        for new in peers.newcomers() {
            joined.introduction(now()).into_iter().for_each(|message| new.outbox.put(message));
        }
        if Instant::now() >= due {
            // A late turn is not made up for: peers want the newest state.
            due = Instant::now() + period;
            joined.outgoing(now()).into_iter().for_each(|message| peers.send(&message));
        }
    }
    joined.last_words(now()).into_iter().for_each(|message| peers.send(&message));
    Ok(peers.close())
}

fn now() -> Timestamp {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Timestamp::from_ns(u64::try_from(since.as_nanos()).unwrap_or(u64::MAX))
}
