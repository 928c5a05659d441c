//! The host's side of a session: creates every service before announcing the session, and removes everything
//! at the end.

use std::collections::BTreeMap;
use std::path::Path;

use iceoryx2::prelude::{Node, ipc};
use iceoryx2::service::attribute::AttributeSpecifier;

use super::announcement::ANNOUNCEMENT_FILE;
use super::folder::{self, HostFolder, wipe_dead_sessions};
use super::places::{SearchedPlaces, choose, places};
use super::{
    Announcement, ByteService, ClientLeftovers, EventService, ICEORYX2_VERSION, PAGE_FILE, Reader, Session,
    SessionError, create_node, file_error, transported,
};
use crate::half_made::SegmentSweeper;
use crate::messages::services::{self, CONNECTIONS_BYTES, SAMPLES_HELD, Service};
use crate::messages::{ControllerIndex, Part};
use crate::own::ProcessOwned;
use crate::scene::{Policy, Wait};
use crate::shared_memory::SharedMemory;
use crate::shared_page::SharedPage;

const MAX_NODES: usize = 64;

/// The host's side: owns the services and removes them at the end.
#[derive(Debug)]
pub struct SessionHost {
    /// The host as a client of its own session.
    pub session: Session,
    _byte_services: Vec<ByteService>,
    _event_services: Vec<EventService>,
    /// Dropped after everything above, because dropping those opens segments, which may be incomplete.
    _sweeper: SegmentSweeper,
    /// Removed last.
    folder: HostFolder,
}

/// Settings with which the host creates a scene's services.
#[derive(Debug, Clone)]
pub struct SessionPlan {
    /// Controllers in the scene's order.
    pub controllers: Vec<String>,
    /// Size of the volume message, bytes; 0 without a volume.
    pub volume_bytes: usize,
    /// Size of a frame message, bytes; 0 without DRR.
    pub frame_bytes: usize,
    /// Whether the scene has sensors.
    pub sensors: bool,
    /// Whether the scene asks for the tip's Jacobian.
    pub tip_jacobian: bool,
    /// Whether a recorder takes part; if so, the physics waits for it.
    pub recorder: bool,
    /// How physics and controllers wait for each other.
    pub wait: Wait,
    /// How physics and controllers are scheduled.
    pub policy: Policy,
}

impl SessionHost {
    /// Creates a session with all its services. An unusable place is reported before any dead host's session
    /// is removed.
    ///
    /// # Errors
    /// Any [`SessionError`] except those of joining.
    pub fn create(plan: &SessionPlan) -> Result<SessionHost, SessionError> {
        let all = places();
        let nowhere = || SessionError::NoSession { searched: SearchedPlaces::places(None) };
        let (place, _) = choose(&all).ok_or_else(nowhere)?;
        let folder = HostFolder::create(place)?;
        wipe_dead_sessions();
        let sweeper = SegmentSweeper::start(folder.id.shared_memory_prefix())
            .map_err(file_error(Path::new("/dev/shm")))?;
        let with_reason = |error| folder.reason_of(error);
        let node = create_node(&folder.path, &folder.id).map_err(with_reason)?;
        let memory = SharedMemory::open().map_err(file_error(Path::new("/dev/shm")))?;
        memory
            .close_to_others(&folder.id.shared_memory_prefix())
            .map_err(file_error(Path::new("/dev/shm")))?;
        let page_path = folder.path.join(PAGE_FILE);
        let page = SharedPage::create(folder.handle()).map_err(file_error(&page_path))?;
        let mut layouts = BTreeMap::new();
        let mut byte_services = Vec::new();
        for (name, service) in plan.services() {
            layouts.insert(name.clone(), service.description.layout_hash());
            byte_services.push(create_byte_service(&node, &name, &service).map_err(with_reason)?);
        }
        let controllers = ControllerIndex::first(plan.controllers.len()).map(Reader::Controller);
        let readers = [Reader::Physics, Reader::Drr, Reader::Recorder].into_iter().chain(controllers);
        let event_services = readers
            .map(|reader| create_event_service(&node, &reader.event_name()))
            .collect::<Result<_, _>>()
            .map_err(with_reason)?;
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
        // A new handle: testing the lock through the handle that holds it would release it.
        let handle = folder::open(&folder.path)?;
        let remains =
            ClientLeftovers::of(&folder.path, &folder.id, &handle).map_err(file_error(&folder.path))?;
        let session = Session {
            handle,
            folder: folder.path.clone(),
            id: folder.id.clone(),
            announcement,
            node: ProcessOwned::new(node),
            _remains: ProcessOwned::new(remains),
            page,
        };
        session.claim(Part::Host)?;
        Ok(SessionHost {
            session,
            _byte_services: byte_services,
            _event_services: event_services,
            _sweeper: sweeper,
            folder,
        })
    }

    /// Writes `session.json` atomically; clients can join from then on.
    pub fn announce(&self) -> Result<(), SessionError> {
        let text = serde_json::to_string_pretty(&self.session.announcement).map_err(|cause| {
            file_error(&self.session.folder.join(ANNOUNCEMENT_FILE))(std::io::Error::other(cause))
        })?;
        self.write(ANNOUNCEMENT_FILE, text.as_bytes())
    }

    /// Writes a file of the session's folder atomically: a reader sees no file, the previous one, or the
    /// complete new one.
    ///
    /// # Errors
    /// If the folder has been removed or the disk is full.
    pub fn write(&self, name: &str, content: &[u8]) -> Result<(), SessionError> {
        self.folder.write(name, content)
    }
}

impl SessionPlan {
    /// Returns an upper bound of the shared memory that the session's own programs need, bytes: the launcher,
    /// the parts and the controllers. Clients that only watch need a little more.
    pub fn shared_bytes(&self) -> u64 {
        let takes_part = |part: &Part| match part {
            Part::Host | Part::Physics => true,
            Part::Drr => self.frame_bytes > 0,
            Part::Recorder => self.recorder,
        };
        let writers = |service: &Service| match service.name {
            name if name == services::KEYFRAME.name => usize::from(self.recorder),
            // Each part, the launcher and each controller reports events; requests come from clients.
            name if name == services::EVENT.name => {
                Part::ALL.iter().filter(|part| takes_part(part)).count() + self.controllers.len()
            }
            name if name == services::COMMAND.name => 1,
            _ => service.writers.iter().filter(|part| takes_part(part)).count(),
        };
        let ports = self
            .services()
            .into_iter()
            .map(|(_, service)| writers(&service) as u64 * service.reserved_bytes());
        // The second one is what the last port still finds free when it is opened.
        ports.sum::<u64>() + 2 * CONNECTIONS_BYTES
    }

    fn services(&self) -> Vec<(String, Service)> {
        let mut all = Vec::new();
        for service in services::ALL {
            let max_bytes = match service.name {
                name if name == services::VOLUME.name => self.volume_bytes,
                name if name == services::FRAME.name => self.frame_bytes,
                name if name == services::SENSOR.name && !self.sensors => 0,
                name if name == services::TIP_JACOBIAN.name && !self.tip_jacobian => 0,
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
        .map(ProcessOwned::new)
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
        .map(ProcessOwned::new)
        .map_err(transported(name, "creating"))
}
