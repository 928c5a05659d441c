//! The session a client joins, its role, and its knowledge of the run.

use ipc_types::messages::ControllerIndex;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ipc_types::scene::Scene;
use ipc_types::session::{
    CONTROLLER_VARIABLE, SESSION_VARIABLE, SearchedPlaces, Session, SessionId, host_is_alive, only_session,
    running_sessions,
};

use crate::error::ClientError;

const RETRY_TIME: Duration = Duration::from_millis(10);

/// The session to join, and the controller to join as.
#[derive(Debug, Clone)]
pub struct Connection {
    /// Folder or name of the session. `None` uses the folder in `TRABECULA_SESSION`, or else this user's only
    /// running session.
    pub session: Option<String>,
    /// Name of the controller in the scene, or empty for an observer, which sends no commands. `None` uses
    /// the name in `TRABECULA_CONTROLLER`, or else the scene's only external controller.
    pub controller: Option<String>,
    /// Time to wait for the session.
    pub limit: Duration,
}

impl Default for Connection {
    fn default() -> Self {
        Connection { session: None, controller: None, limit: Duration::from_secs(10) }
    }
}

impl Connection {
    /// Returns a connection to the same session as an observer.
    pub fn observer() -> Connection {
        Connection { controller: Some(String::new()), ..Connection::default() }
    }
}

/// Constant properties of a session.
#[derive(Debug, Clone, PartialEq)]
pub struct Info {
    /// Folder of the session.
    pub folder: PathBuf,
    /// Name and index of this client's controller; `None` for an observer.
    pub controller: Option<(String, ControllerIndex)>,
    /// Number of controllers in the scene.
    pub controller_count: usize,
    /// Whether a tick waits for every controller.
    pub lockstep: bool,
    /// Simulated time of a tick.
    pub dt_s: f64,
    /// Number of ticks of the complete run.
    pub tick_count: u64,
    /// Ticks between two scheduled frames; 0 if there are none.
    pub frame_period_ticks: u64,
    /// Pixel columns of a frame; 0 without X-ray.
    pub frame_columns: u32,
    /// Pixel rows of a frame.
    pub frame_rows: u32,
    /// Whether there is a CT volume.
    pub has_volume: bool,
}

pub(super) fn await_folder(connection: &Connection) -> Result<PathBuf, ClientError> {
    let given = connection.session.clone().filter(|text| !text.is_empty());
    let from_environment = || std::env::var(SESSION_VARIABLE).ok().filter(|text| !text.is_empty());
    let named = given.or_else(from_environment);
    if let Some(given) = &named {
        SessionId::can_be(Path::new(given))?;
    }
    // A path is a single folder; a name can be in any of this user's session locations.
    let look = || match &named {
        Some(path) if path.contains('/') => {
            Ok(Some(PathBuf::from(path)).filter(|folder| host_is_alive(folder)))
        }
        Some(name) => Ok(running_sessions(Some(name)).pop()),
        None => only_session(),
    };
    let end = Instant::now() + connection.limit;
    loop {
        if let Some(folder) = look()? {
            return Ok(folder);
        }
        if Instant::now() >= end {
            let searched = match &named {
                Some(path) if path.contains('/') => SearchedPlaces::folder(Path::new(path)),
                named => SearchedPlaces::places(named.as_deref()),
            };
            return Err(ClientError::NoSession { searched });
        }
        std::thread::sleep(RETRY_TIME);
    }
}

pub(super) fn controller_of(
    connection: &Connection,
    session: &Session,
    scene: &Scene,
) -> Result<Option<(String, ControllerIndex)>, ClientError> {
    let from_environment = || std::env::var(CONTROLLER_VARIABLE).ok();
    let name = match connection.controller.clone().or_else(from_environment) {
        Some(name) if name.is_empty() => return Ok(None),
        Some(name) => name,
        None => {
            let mut external = scene.controller.iter().filter(|controller| controller.external);
            match (external.next(), external.count()) {
                (Some(only), 0) => only.name.clone(),
                (first, more) => {
                    let external = usize::from(first.is_some()) + more;
                    let known = scene.controller_names().join(", ");
                    return Err(ClientError::WhichController { external, known });
                }
            }
        }
    };
    let index = session.controller_index(&name)?;
    Ok(Some((name, index)))
}
