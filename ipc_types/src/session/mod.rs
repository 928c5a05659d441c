//! A session: one hub's services in shared memory, isolated from those of every other hub on the machine.
//!
//! The launcher is the host. It creates every service before it announces the session in
//! `session.json`, because a process killed while creating a service makes the name unusable for good
//! (measured with iceoryx2 0.10). Clients only open services. The host removes the session's folder
//! and shared memory when it ends; if it was killed, the next host to start removes them.

mod announcement;
mod error;
mod folder;
mod host;
mod id;
mod places;

use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

use iceoryx2::config::Config;
use iceoryx2::prelude::{
    FileName, LogLevel, Node, NodeBuilder, SemanticString, SignalHandlingMode, ipc, set_log_level,
};
use iceoryx2::service::port_factory::{event, publish_subscribe};

use crate::messages::services::CONNECTIONS_BYTES;
use crate::messages::{ControllerIndex, MAX_CONTROLLERS, Part};
use crate::own::ProcessOwned;
use crate::shared_memory::{refusal, require_free};
use crate::shared_page::{FLAG_COUNT, SharedPage};

pub use crate::half_made::SegmentSweeper;
pub use announcement::Announcement;
pub(crate) use announcement::{ANNOUNCEMENT_FILE, await_announcement, check_layouts};
pub use error::SessionError;
pub(crate) use error::{file_error, short_memory, transported};
pub(crate) use folder::{
    ClientLeftovers, create_file, is_locked, open as open_folder, read_blame, write_blame,
};
pub use folder::{announced_sessions, host_is_alive, only_session, running_sessions, wipe_dead_sessions};
pub use host::{SessionHost, SessionPlan};
pub use id::SessionId;
pub(crate) use id::prefix_of;
pub use places::{PlaceError, SearchedPlaces, SessionRoot, open_private, passed_over, places};

/// The hub's iceoryx2 version; programs with another version cannot join.
pub const ICEORYX2_VERSION: &str = "0.10.0";
/// Environment variable with the folder of the session to join.
pub const SESSION_VARIABLE: &str = "TRABECULA_SESSION";
/// Environment variable with the name of the controller that a program connects as.
pub const CONTROLLER_VARIABLE: &str = "TRABECULA_CONTROLLER";

/// The file of the shared page in a session's folder.
pub(crate) const PAGE_FILE: &str = "wake.flags";

pub(crate) type ByteService = ProcessOwned<publish_subscribe::PortFactory<ipc::Service, [u8], ()>>;
pub(crate) type EventService = ProcessOwned<event::PortFactory<ipc::Service>>;

/// A session as one process sees it: its node and access to the services.
#[derive(Debug)]
pub struct Session {
    pub(crate) folder: PathBuf,
    /// The open folder: shows whether the host is alive even after the folder's name is gone.
    pub(crate) handle: OwnedFd,
    pub(crate) id: SessionId,
    pub(crate) announcement: Announcement,
    pub(crate) node: ProcessOwned<Node<ipc::Service>>,
    /// Dropped after the node.
    pub(crate) _remains: ProcessOwned<ClientLeftovers>,
    pub(crate) page: SharedPage,
}

/// The readers, each with its own wake-up event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reader {
    /// The physics process.
    Physics,
    /// The DRR process.
    Drr,
    /// The recorder process.
    Recorder,
    /// The scene's controller with this index.
    Controller(ControllerIndex),
}

/// Slot of the first controller.
const CONTROLLER_SLOT: usize = 8;

const _: () = assert!(Part::ALL.len() <= CONTROLLER_SLOT && CONTROLLER_SLOT + MAX_CONTROLLERS <= FLAG_COUNT);

impl Reader {
    pub(crate) fn slot(self) -> usize {
        match self {
            Reader::Physics => 0,
            Reader::Drr => 1,
            Reader::Recorder => 2,
            Reader::Controller(index) => CONTROLLER_SLOT + index.slot(),
        }
    }

    pub(crate) fn event_name(self) -> String {
        match self {
            Reader::Physics => wake_of(Part::Physics),
            Reader::Drr => wake_of(Part::Drr),
            Reader::Recorder => wake_of(Part::Recorder),
            Reader::Controller(index) => format!("wake/controller/{index}"),
        }
    }
}

/// Returns the name of the event service that wakes a part.
fn wake_of(part: Part) -> String {
    format!("wake/{}", part.name())
}

fn transport_config(folder: &Path, id: &SessionId) -> Result<Config, SessionError> {
    let invalid =
        |cause: String| SessionError::Transported { service: "session".into(), action: "configuring", cause };
    let mut config = Config::default();
    let root = iceoryx2::prelude::Path::new(folder.as_os_str().as_encoded_bytes())
        .map_err(|e| invalid(format!("{e:?}")))?;
    config.global.set_root_path(&root);
    config.global.prefix =
        FileName::new(id.shared_memory_prefix().as_bytes()).map_err(|e| invalid(format!("{e:?}")))?;
    Ok(config)
}

pub(crate) fn create_node(folder: &Path, id: &SessionId) -> Result<Node<ipc::Service>, SessionError> {
    let action = "creating a node";
    if let Some(refused) = refusal() {
        let cause = refused.to_string();
        return Err(SessionError::NoSharedMemory { service: "session".to_owned(), action, cause });
    }
    // The node's and the services' own segments are created before any port's.
    require_free(CONNECTIONS_BYTES).map_err(short_memory("session"))?;
    // Every failure is returned as our own error; the transport's log would only repeat it.
    set_log_level(LogLevel::Fatal);
    NodeBuilder::new()
        .config(&transport_config(folder, id)?)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(transported("session", action))
}
