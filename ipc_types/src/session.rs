//! A session: one hub's services in shared memory, apart from those of every other hub on the machine.
//!
//! The launcher is the host: it creates every service before it announces the session in `session.json`, because a
//! process killed while it creates a service poisons the name for good (measured with iceoryx2 0.10). Clients only
//! open. The session's folder and shared memory go when the host ends; a session whose host was killed is wiped by the
//! next host that starts.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

use iceoryx2::config::Config;
use iceoryx2::prelude::{
    FileName, LogLevel, Node, NodeBuilder, SemanticString, SignalHandlingMode, ipc, set_log_level,
};
use iceoryx2::service::attribute::AttributeSpecifier;
use iceoryx2::service::port_factory::{event, publish_subscribe};
use rustix::fs::FlockOperation;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::client::require_free_memory;
use crate::scene::{Policy, Wait};
use crate::services::{self, SAMPLES_HELD, Service};
use crate::wake::WakeFlags;

/// The iceoryx2 version that the hub speaks; another version does not join.
pub const ICEORYX2_VERSION: &str = "0.10.0";
/// Environment variable that holds the folder of the session to join.
pub const SESSION_VARIABLE: &str = "TRABECULA_SESSION";
/// Environment variable that holds the name of the controller that a program is.
pub const CONTROLLER_VARIABLE: &str = "TRABECULA_CONTROLLER";

/// iceoryx2 puts sockets below the root path, whose names must fit into 108 bytes.
const MAX_ROOT_PATH: usize = 60;
const MAX_NODES: usize = 64;
/// The file of wake flags in a session's folder.
pub(crate) const FLAGS_FILE: &str = "wake.flags";

pub(crate) type ByteService = publish_subscribe::PortFactory<ipc::Service, [u8], ()>;
pub(crate) type EventService = event::PortFactory<ipc::Service>;

/// Why a session could not be made or joined.
#[derive(Debug, Error)]
pub enum SessionError {
    /// A file or folder of the session could not be used.
    #[error("{path}: {cause}")]
    File {
        /// The path.
        path: PathBuf,
        /// The system's reason.
        cause: io::Error,
    },
    /// No session is at this place.
    #[error("{path}: no running session here; start one with `trabecula run SCENE`")]
    NoSession {
        /// Folder that was looked into.
        path: PathBuf,
    },
    /// The folder's path is too long for the sockets in it.
    #[error(
        "the session folder {path} is longer than {MAX_ROOT_PATH} bytes; set XDG_RUNTIME_DIR or TMPDIR to a shorter path"
    )]
    PathTooLong {
        /// The path.
        path: PathBuf,
    },
    /// Somebody else could read or change the sessions of this user.
    #[error(
        "{path} is not a folder that only this user may enter; remove it, or set XDG_RUNTIME_DIR to one that is"
    )]
    NotPrivate {
        /// Folder of all sessions.
        path: PathBuf,
    },
    /// The hub speaks another version of the transport.
    #[error(
        "the hub of {path} uses iceoryx2 {theirs}, this program {ICEORYX2_VERSION}; build both from one version"
    )]
    Transport {
        /// Session folder.
        path: PathBuf,
        /// The hub's version.
        theirs: String,
    },
    /// The hub is of another version.
    #[error(
        "the hub of {path} is Trabecula {theirs}, this program is {}; build both from one version",
        env!("CARGO_PKG_VERSION")
    )]
    Version {
        /// Session folder.
        path: PathBuf,
        /// The hub's version.
        theirs: String,
    },
    /// A service has another layout than this program was built with.
    #[error(
        "service `{service}`: the hub's {message} has layout {theirs}, this program was built with {ours}; build both from one version"
    )]
    Layout {
        /// Service name.
        service: String,
        /// Message name.
        message: &'static str,
        /// Layout hash of the hub.
        theirs: String,
        /// Layout hash of this program.
        ours: String,
    },
    /// The scene names no such controller.
    #[error("the scene has no controller `{name}`; it has: {known}")]
    UnknownController {
        /// Name asked for.
        name: String,
        /// Names of the scene.
        known: String,
    },
    /// Another controller already writes this service.
    #[error(
        "a controller named `{name}` is already connected to this session; a name drives one controller at a time"
    )]
    ControllerTaken {
        /// Its name.
        name: String,
    },
    /// No more programs can be connected to a service.
    #[error("service `{service}`: {limit} programs {what} it already, which is the most; end one of them")]
    Crowded {
        /// Service name.
        service: String,
        /// Whether they read or write.
        what: &'static str,
        /// How many there may be.
        limit: usize,
    },
    /// Shared memory is short.
    #[error(
        "/dev/shm: {bytes} bytes of shared memory for service `{service}` cannot be reserved ({cause}); free some or enlarge it"
    )]
    SharedMemory {
        /// Service name.
        service: String,
        /// Bytes asked for.
        bytes: u64,
        /// The system's reason.
        cause: io::Error,
    },
    /// iceoryx2 refused something else.
    #[error("service `{service}`: {action} failed ({cause})")]
    Transported {
        /// Service name.
        service: String,
        /// What was tried.
        action: &'static str,
        /// iceoryx2's reason.
        cause: String,
    },
}

/// What `session.json` says.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Announcement {
    /// Process of the host.
    pub pid: u32,
    /// Version of the transport.
    pub iceoryx2: String,
    /// Version of the hub.
    pub trabecula: String,
    /// Layout hash by service.
    pub layouts: BTreeMap<String, String>,
    /// Controllers in the scene's order.
    pub controllers: Vec<String>,
    /// Bytes of the volume message; 0 without a volume.
    pub volume_bytes: usize,
    /// Bytes of a frame message; 0 without DRR.
    pub frame_bytes: usize,
    /// Whether a recorder takes part; the physics then waits for it.
    pub recorder: bool,
    /// How physics and controllers wait for each other.
    pub wait: Wait,
    /// How the scheduler treats them.
    pub policy: Policy,
}

/// A session seen by one process: its node and the way to its services.
#[derive(Debug)]
pub struct Session {
    pub(crate) folder: PathBuf,
    pub(crate) announcement: Announcement,
    pub(crate) node: Node<ipc::Service>,
    pub(crate) flags: WakeFlags,
}

/// The host's side: it owns the services and removes them at its end.
#[derive(Debug)]
pub struct SessionHost {
    /// The session as its own first client.
    pub session: Session,
    _byte_services: Vec<ByteService>,
    _event_services: Vec<EventService>,
    _cleanup: Cleanup,
    /// Locked while the host lives; the kernel frees it however the host ends.
    _alive: fs::File,
}

#[derive(Debug)]
struct Cleanup {
    folder: PathBuf,
    prefix: String,
}

impl Drop for Cleanup {
    fn drop(&mut self) {
        wipe(&self.folder, &self.prefix);
    }
}

/// Who waits on an event of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reader {
    /// The physics process.
    Physics,
    /// The DRR process.
    Drr,
    /// The recorder process.
    Recorder,
    /// The scene's controller of this index.
    Controller(usize),
}

impl Reader {
    pub(crate) fn slot(self) -> usize {
        match self {
            Reader::Physics => 0,
            Reader::Drr => 1,
            Reader::Recorder => 2,
            Reader::Controller(index) => 8 + index,
        }
    }

    pub(crate) fn event_name(self) -> String {
        match self {
            Reader::Physics => "wake/physics".to_owned(),
            Reader::Drr => "wake/drr".to_owned(),
            Reader::Recorder => "wake/recorder".to_owned(),
            Reader::Controller(index) => format!("wake/controller/{index}"),
        }
    }
}

pub(crate) fn file_error(path: &Path) -> impl FnOnce(io::Error) -> SessionError + '_ {
    move |cause| SessionError::File { path: path.to_owned(), cause }
}

pub(crate) fn transported<E: core::fmt::Debug>(
    service: &str,
    action: &'static str,
) -> impl FnOnce(E) -> SessionError {
    let service = service.to_owned();
    move |cause| SessionError::Transported { service, action, cause: format!("{cause:?}") }
}

/// Folder below which the sessions of this user lie.
pub fn sessions_folder() -> PathBuf {
    let user = fs::metadata("/proc/self").map(|meta| meta.uid()).unwrap_or(0);
    match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(folder) if folder.len() < 30 => PathBuf::from(folder).join("trabecula"),
        _ => PathBuf::from(format!("/tmp/trabecula-{user}")),
    }
}

/// The running session that was announced last, if there is one.
pub fn newest_session() -> Option<PathBuf> {
    let folders = fs::read_dir(sessions_folder()).into_iter().flatten().flatten().map(|entry| entry.path());
    let announced = |folder: PathBuf| {
        let since = fs::metadata(folder.join("session.json")).and_then(|meta| meta.modified()).ok()?;
        (is_private(folder.parent()?) && host_is_alive(&folder)).then_some((since, folder))
    };
    folders.filter_map(announced).max().map(|(_, folder)| folder)
}

/// Whether the host of a session's folder is running: it holds the lock of `wake.flags`. Its process number alone may
/// be another's by now, or mean another process to a container.
pub fn host_is_alive(folder: &Path) -> bool {
    match fs::File::open(folder.join(FLAGS_FILE)) {
        Ok(file) => rustix::fs::flock(&file, FlockOperation::NonBlockingLockShared).is_err(),
        // A session in the making has none yet.
        Err(_) => {
            let host = session_id(folder).split('-').next().and_then(|pid| pid.parse::<u32>().ok());
            host.is_some_and(|pid| Path::new(&format!("/proc/{pid}")).exists())
        }
    }
}

/// Whether this is a folder of this user that nobody else may enter.
fn is_private(folder: &Path) -> bool {
    let user = rustix::process::geteuid().as_raw();
    let meta = fs::symlink_metadata(folder);
    meta.is_ok_and(|meta| meta.is_dir() && meta.uid() == user && meta.mode() & 0o077 == 0)
}

/// Takes everybody else's rights to a session's shared memory. The transport's first node makes one segment that all
/// users may write, for nodes of several users, which a session has none of.
fn close_to_others(prefix: &str) -> Result<(), SessionError> {
    let entries = fs::read_dir("/dev/shm").into_iter().flatten().flatten();
    for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix)) {
        let path = entry.path();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).map_err(file_error(&path))?;
    }
    Ok(())
}

/// Removes a session's folder and its shared memory. What is gone already is no error.
fn wipe(folder: &Path, prefix: &str) {
    let _ = fs::remove_dir_all(folder);
    let entries = fs::read_dir("/dev/shm").into_iter().flatten().flatten();
    for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix)) {
        let _ = fs::remove_file(entry.path());
    }
}

/// Removes the sessions of hosts that are no longer running. Returns how many.
pub fn wipe_dead_sessions() -> usize {
    let mut wiped = 0;
    for entry in fs::read_dir(sessions_folder()).into_iter().flatten().flatten() {
        let Some(id) = entry.file_name().to_str().map(str::to_owned) else { continue };
        if !host_is_alive(&entry.path()) {
            wipe(&entry.path(), &shared_memory_prefix(&id));
            wiped += 1;
        }
    }
    wiped
}

pub(crate) fn shared_memory_prefix(id: &str) -> String {
    format!("trabecula010_{id}_")
}

fn transport_config(folder: &Path, id: &str) -> Result<Config, SessionError> {
    let invalid =
        |cause: String| SessionError::Transported { service: "session".into(), action: "configuring", cause };
    let mut config = Config::default();
    let root = iceoryx2::prelude::Path::new(folder.as_os_str().as_encoded_bytes())
        .map_err(|e| invalid(format!("{e:?}")))?;
    config.global.set_root_path(&root);
    config.global.prefix =
        FileName::new(shared_memory_prefix(id).as_bytes()).map_err(|e| invalid(format!("{e:?}")))?;
    Ok(config)
}

pub(crate) fn create_node(folder: &Path, id: &str) -> Result<Node<ipc::Service>, SessionError> {
    // The node's and the services' own segments come before any port's.
    require_free_memory("session", 0)?;
    // Every failure comes back as an error of ours; the transport's own log would only say it twice.
    set_log_level(LogLevel::Fatal);
    NodeBuilder::new()
        .config(&transport_config(folder, id)?)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(transported("session", "creating a node"))
}

pub(crate) fn session_id(folder: &Path) -> String {
    folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// What the host must know to make the services of a scene.
#[derive(Debug, Clone)]
pub struct SessionPlan {
    /// Controllers in the scene's order.
    pub controllers: Vec<String>,
    /// Bytes of the volume message; 0 without a volume.
    pub volume_bytes: usize,
    /// Bytes of a frame message; 0 without DRR.
    pub frame_bytes: usize,
    /// Whether a recorder takes part; the physics then waits for it.
    pub recorder: bool,
    /// How physics and controllers wait for each other.
    pub wait: Wait,
    /// How the scheduler treats them.
    pub policy: Policy,
}

impl SessionHost {
    /// Creates a session with all its services and announces it.
    ///
    /// # Errors
    /// Any [`SessionError`] but those of joining.
    pub fn create(plan: &SessionPlan) -> Result<SessionHost, SessionError> {
        wipe_dead_sessions();
        let (folder, id) = new_session_folder()?;
        let cleanup = Cleanup { folder: folder.clone(), prefix: shared_memory_prefix(&id) };
        let node = create_node(&folder, &id)?;
        close_to_others(&shared_memory_prefix(&id))?;
        let (flags, alive) = locked_flags(&folder)?;
        let mut layouts = BTreeMap::new();
        let mut byte_services = Vec::new();
        for (name, service) in plan.services() {
            layouts.insert(name.clone(), service.description.layout_hash());
            byte_services.push(create_byte_service(&node, &name, &service)?);
        }
        let controllers = (0..plan.controllers.len()).map(Reader::Controller);
        let readers = [Reader::Physics, Reader::Drr, Reader::Recorder].into_iter().chain(controllers);
        let event_services = readers
            .map(|reader| create_event_service(&node, &reader.event_name()))
            .collect::<Result<_, _>>()?;
        let announcement = Announcement {
            pid: std::process::id(),
            iceoryx2: ICEORYX2_VERSION.to_owned(),
            trabecula: env!("CARGO_PKG_VERSION").to_owned(),
            layouts,
            controllers: plan.controllers.clone(),
            volume_bytes: plan.volume_bytes,
            frame_bytes: plan.frame_bytes,
            recorder: plan.recorder,
            wait: plan.wait,
            policy: plan.policy,
        };
        let session = Session { folder, announcement, node, flags };
        Ok(SessionHost {
            session,
            _byte_services: byte_services,
            _event_services: event_services,
            _cleanup: cleanup,
            _alive: alive,
        })
    }

    /// Writes `session.json`, from which on clients may join. The file appears whole.
    pub fn announce(&self) -> Result<(), SessionError> {
        let path = self.session.folder.join("session.json");
        let hidden = self.session.folder.join(".session.json");
        let text = serde_json::to_string_pretty(&self.session.announcement)
            .map_err(|cause| SessionError::File { path: path.clone(), cause: io::Error::other(cause) })?;
        fs::write(&hidden, text).map_err(file_error(&hidden))?;
        fs::rename(&hidden, &path).map_err(file_error(&path))
    }
}

impl SessionPlan {
    fn services(&self) -> Vec<(String, Service)> {
        let mut all = Vec::new();
        for service in services::ALL {
            let max_bytes = match service.name {
                name if name == services::VOLUME.name => self.volume_bytes,
                name if name == services::FRAME.name => self.frame_bytes,
                _ => service.max_bytes,
            };
            if max_bytes > 0 {
                all.push((service.name.to_owned(), Service { max_bytes, ..*service }));
            }
        }
        all.extend(self.controllers.iter().map(|name| (services::command_name(name), services::COMMAND)));
        all
    }
}

/// Makes `wake.flags` with the lock that says that the host is alive. The file appears locked: another host that looked at it
/// before would take this session for a dead one.
fn locked_flags(folder: &Path) -> Result<(WakeFlags, fs::File), SessionError> {
    let (hidden, path) = (folder.join(".wake.flags"), folder.join(FLAGS_FILE));
    let flags = WakeFlags::open(&hidden, true).map_err(file_error(&hidden))?;
    let alive = fs::File::open(&hidden).map_err(file_error(&hidden))?;
    rustix::fs::flock(&alive, FlockOperation::LockExclusive)
        .map_err(|cause| file_error(&hidden)(cause.into()))?;
    fs::rename(&hidden, &path).map_err(file_error(&path))?;
    Ok((flags, alive))
}

static NEXT_SESSION: AtomicU32 = AtomicU32::new(0);

fn new_session_folder() -> Result<(PathBuf, String), SessionError> {
    let parent = sessions_folder();
    fs::DirBuilder::new().recursive(true).mode(0o700).create(&parent).map_err(file_error(&parent))?;
    if !is_private(&parent) {
        return Err(SessionError::NotPrivate { path: parent });
    }
    for _ in 0..1000 {
        // Each name once in a process: whoever has looked at an earlier session's lock must not wipe the next one's folder.
        let number = NEXT_SESSION.fetch_add(1, Ordering::Relaxed);
        let id = format!("{}-{number}", std::process::id());
        let folder = parent.join(&id);
        if folder.as_os_str().len() > MAX_ROOT_PATH {
            return Err(SessionError::PathTooLong { path: folder });
        }
        match fs::DirBuilder::new().mode(0o700).create(&folder) {
            Ok(()) => return Ok((folder, id)),
            Err(cause) if cause.kind() == io::ErrorKind::AlreadyExists => {}
            Err(cause) => return Err(SessionError::File { path: folder, cause }),
        }
    }
    Err(SessionError::NoSession { path: parent })
}

fn create_byte_service(
    node: &Node<ipc::Service>,
    name: &str,
    service: &Service,
) -> Result<ByteService, SessionError> {
    let service_name = name.try_into().map_err(transported(name, "naming"))?;
    let key = "layout".try_into().map_err(transported(name, "describing"))?;
    let value =
        service.description.layout_hash().as_str().try_into().map_err(transported(name, "describing"))?;
    let attributes =
        AttributeSpecifier::new().define(&key, &value).map_err(transported(name, "describing"))?;
    node.service_builder(&service_name)
        .publish_subscribe::<[u8]>()
        .enable_safe_overflow(true)
        .subscriber_max_buffer_size(service.lossless_length)
        .subscriber_max_borrowed_samples(SAMPLES_HELD)
        .history_size(service.history)
        .max_publishers(service.max_publishers)
        .max_subscribers(service.max_subscribers)
        .max_nodes(MAX_NODES)
        .create_with_attributes(&attributes)
        .map_err(transported(name, "creating"))
}

fn create_event_service(node: &Node<ipc::Service>, name: &str) -> Result<EventService, SessionError> {
    let service_name = name.try_into().map_err(transported(name, "naming"))?;
    node.service_builder(&service_name)
        .event()
        .max_notifiers(16)
        .max_listeners(2)
        .max_nodes(MAX_NODES)
        .create()
        .map_err(transported(name, "creating"))
}
