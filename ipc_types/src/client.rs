//! Joins a session and opens ports in it.

use std::cell::Cell;
use std::path::Path;
use std::time::{Duration, Instant};

use foreign_text::foreign_path;
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::prelude::{AllocationStrategy, Node, ipc};
use iceoryx2::service::attribute::AttributeVerifier;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;

use rustix::fs::{Access, AtFlags};

use crate::identity::Guard;
use crate::messages::layout::{Description, Message};
use crate::messages::services::{self, CONNECTIONS_BYTES, Service};
use crate::messages::{Blame, Command, ControllerIndex, Part};
use crate::own::ProcessOwned;
use crate::ports::{ByteReceiver, ByteSender, Publisher, Subscriber};
use crate::session::{
    ANNOUNCEMENT_FILE, Announcement, ByteService, CONTROLLER_VARIABLE, ClientLeftovers, PAGE_FILE, Reader,
    SESSION_VARIABLE, Session, SessionError, SessionId, await_announcement, check_layouts, create_node,
    file_error, is_locked, open_folder, read_blame, short_memory, transported, write_blame,
};
use crate::shared_memory::{SharedMemory, require_free};
use crate::shared_page::SharedPage;
use crate::wake::{WaitStrategy, Waiter, Waker, YieldBackoff, allowed_cores};

/// How long a client waits for a session's announcement, or for a service.
const JOIN_TIME: Duration = Duration::from_secs(10);
/// How long a client retries to open an announced service.
const OPEN_TIME: Duration = Duration::from_secs(2);
const RETRY_TIME: Duration = Duration::from_millis(5);

impl Session {
    /// Joins the session in a folder; waits up to ten seconds for its announcement.
    ///
    /// # Errors
    /// [`SessionError::NotASession`], at once; [`SessionError::NoSession`]; [`SessionError::Version`],
    /// [`SessionError::Transport`] or [`SessionError::Layout`] for a hub of another version; a transport
    /// failure.
    pub fn join(folder: &Path) -> Result<Session, SessionError> {
        Session::join_within(folder, JOIN_TIME)
    }

    /// As [`join`](Session::join), with a time limit.
    ///
    /// # Errors
    /// As [`Session::join`].
    pub fn join_within(folder: &Path, limit: Duration) -> Result<Session, SessionError> {
        SessionId::can_be(folder)?;
        let handle = open_folder(folder)?;
        let announcement = await_announcement(&handle, folder, limit)?;
        check_layouts(&announcement)?;
        let none = || SessionError::NotASession { given: foreign_path(folder) };
        let id = SessionId::of(folder).ok_or_else(none)?;
        // Before the node, so that it is dropped after it.
        let remains =
            ProcessOwned::new(ClientLeftovers::of(folder, &id, &handle).map_err(file_error(folder))?);
        let node = ProcessOwned::new(create_node(folder, &id)?);
        let page = SharedPage::open(&handle).map_err(file_error(&folder.join(PAGE_FILE)))?;
        Ok(Session { folder: folder.to_owned(), handle, id, announcement, node, _remains: remains, page })
    }

    /// Returns whether the session's host is running; works even if its folder has been removed.
    pub fn host_is_alive(&self) -> bool {
        is_locked(&self.handle)
    }

    /// Returns whether the announcement is still in the session's folder. A host removes it when it ends; a
    /// killed host leaves it behind.
    pub fn is_announced(&self) -> bool {
        rustix::fs::accessat(&self.handle, ANNOUNCEMENT_FILE, Access::EXISTS, AtFlags::empty()).is_ok()
    }

    /// Stores why the physics ends the run early, for [`Session::blame`].
    ///
    /// # Errors
    /// Any system error.
    pub fn leave_blame(&self, blame: &Blame) -> std::io::Result<()> {
        write_blame(&self.handle, blame)
    }

    /// Returns why the physics ended the run early; `None` if it did not.
    pub fn blame(&self) -> Option<Blame> {
        read_blame(&self.handle)
    }

    /// Returns the session's name, which is also its folder's.
    pub fn name(&self) -> String {
        self.id.to_string()
    }

    /// Returns the session's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns the environment variables with which a program connects as this controller.
    pub fn how_to_connect(&self, controller: &str) -> String {
        format!("{SESSION_VARIABLE}={} {CONTROLLER_VARIABLE}={controller}", self.folder.display())
    }

    /// Returns the transport's node, for measurements outside the session's services.
    pub fn node(&self) -> &Node<ipc::Service> {
        &self.node
    }

    /// Returns the host's announcement.
    pub fn announcement(&self) -> &Announcement {
        &self.announcement
    }

    /// Returns a controller's index in the scene.
    ///
    /// # Errors
    /// [`SessionError::UnknownController`].
    pub fn controller_index(&self, name: &str) -> Result<ControllerIndex, SessionError> {
        let controllers = &self.announcement.controllers;
        let index = ControllerIndex::first(controllers.len()).find(|index| controllers[index.slot()] == name);
        index.ok_or_else(|| SessionError::UnknownController {
            name: name.to_owned(),
            known: if controllers.is_empty() { "none".to_owned() } else { controllers.join(", ") },
        })
    }

    /// Opens a publisher for a service, with all its shared memory reserved.
    ///
    /// # Errors
    /// [`SessionError::Layout`], [`SessionError::SharedMemory`], [`SessionError::Reserved`] if the service
    /// belongs to a part that this program has not claimed ([`Session::claim`]), or a transport failure.
    pub fn publisher<M: Message>(&self, service: &Service) -> Result<Publisher<M>, SessionError> {
        self.named_publisher(service.name, service, M::DESCRIPTION).map(Publisher::new)
    }

    /// Opens the publisher of a controller's commands; only one can exist at a time.
    ///
    /// # Errors
    /// [`SessionError::ControllerTaken`], and those of [`Session::publisher`].
    pub fn command_publisher(&self, controller: &str) -> Result<Publisher<Command>, SessionError> {
        self.controller_index(controller)?;
        let name = services::command_name(controller);
        self.named_publisher(&name, &services::COMMAND, Command::DESCRIPTION).map(Publisher::new)
    }

    /// Opens a subscriber to a service.
    ///
    /// # Errors
    /// [`SessionError::Layout`] or a transport failure.
    pub fn subscriber<M: Message>(&self, service: &Service) -> Result<Subscriber<M>, SessionError> {
        self.named_subscriber(service.name, service, M::DESCRIPTION).map(Subscriber::new)
    }

    /// Opens a subscriber that keeps only the newest message. The writer then cycles through a few cached
    /// samples instead of filling a long queue for a reader that rarely polls.
    ///
    /// # Errors
    /// As [`Session::subscriber`].
    pub fn newest_subscriber<M: Message>(&self, service: &Service) -> Result<Subscriber<M>, SessionError> {
        let service = Service { queue_length: 1, ..*service };
        self.named_subscriber(service.name, &service, M::DESCRIPTION).map(Subscriber::new)
    }

    /// Opens a subscriber with the longest queue, for readers that must not lose a message even if they stall
    /// for seconds.
    ///
    /// # Errors
    /// As [`Session::subscriber`].
    pub fn lossless_subscriber<M: Message>(&self, service: &Service) -> Result<Subscriber<M>, SessionError> {
        self.named_subscriber(service.name, &lossless(service), M::DESCRIPTION).map(Subscriber::new)
    }

    /// Opens the subscriber of a controller's commands.
    ///
    /// # Errors
    /// [`SessionError::UnknownController`], and those of [`Session::subscriber`].
    pub fn command_subscriber(&self, controller: &str) -> Result<Subscriber<Command>, SessionError> {
        self.controller_index(controller)?;
        let name = services::command_name(controller);
        self.named_subscriber(&name, &services::COMMAND, Command::DESCRIPTION).map(Subscriber::new)
    }

    /// As [`command_subscriber`](Session::command_subscriber), with the longest queue.
    ///
    /// # Errors
    /// As [`Session::command_subscriber`].
    pub fn lossless_command_subscriber(&self, controller: &str) -> Result<Subscriber<Command>, SessionError> {
        self.controller_index(controller)?;
        let name = services::command_name(controller);
        self.named_subscriber(&name, &lossless(&services::COMMAND), Command::DESCRIPTION).map(Subscriber::new)
    }

    /// Creates the waiter with which this process sleeps until another wakes it.
    ///
    /// # Errors
    /// A transport failure.
    pub fn waiter(&self, reader: Reader) -> Result<Waiter, SessionError> {
        let name = reader.event_name();
        let service_name = name.as_str().try_into().map_err(transported(&name, "naming"))?;
        let service =
            self.node.service_builder(&service_name).event().open().map_err(transported(&name, "opening"))?;
        let listener = service.listener_builder().create().map_err(transported(&name, "listening"))?;
        self.page.raise_for_new_reader(reader.slot());
        let way = match reader {
            // They poll at intervals; no other process waits for them.
            Reader::Recorder | Reader::Drr => WaitStrategy::Hybrid,
            Reader::Physics | Reader::Controller(_) => {
                let spinning = 1 + self.announcement.controllers.len();
                WaitStrategy::of(self.announcement.wait, self.announcement.policy, spinning, allowed_cores())
            }
        };
        Ok(Waiter {
            listener: ProcessOwned::new(listener),
            page: self.page.clone(),
            reader: reader.slot(),
            way,
            yield_backoff: YieldBackoff::default(),
        })
    }

    /// Creates the waker that wakes another process.
    ///
    /// # Errors
    /// A transport failure.
    pub fn waker(&self, reader: Reader) -> Result<Waker, SessionError> {
        let name = reader.event_name();
        let service_name = name.as_str().try_into().map_err(transported(&name, "naming"))?;
        let service =
            self.node.service_builder(&service_name).event().open().map_err(transported(&name, "opening"))?;
        let notifier = service.notifier_builder().create().map_err(transported(&name, "notifying"))?;
        let (spared, listeners) = (Cell::new(0), Cell::new(0));
        let (notifier, service) = (ProcessOwned::new(notifier), ProcessOwned::new(service));
        Ok(Waker { notifier, page: self.page.clone(), reader: reader.slot(), service, spared, listeners })
    }

    pub(crate) fn open(&self, name: &str, message: &Description) -> Result<ByteService, SessionError> {
        let ours = message.layout_hash();
        let theirs = self.announcement.layouts.get(name).cloned().unwrap_or_default();
        let layout = |theirs: String| SessionError::Layout {
            service: name.to_owned(),
            message: message.name,
            theirs,
            ours: ours.clone(),
        };
        if theirs != ours {
            return Err(layout(if theirs.is_empty() { "no such service".to_owned() } else { theirs }));
        }
        let service_name = name.try_into().map_err(transported(name, "naming"))?;
        let key = "layout".try_into().map_err(transported(name, "describing"))?;
        let value = ours.as_str().try_into().map_err(transported(name, "describing"))?;
        let attributes =
            AttributeVerifier::new().require(&key, &value).map_err(transported(name, "describing"))?;
        let builder = || self.node.service_builder(&service_name).publish_subscribe::<[u8]>();
        let end = Instant::now() + OPEN_TIME;
        let mut opened = builder().open_with_attributes(&attributes);
        // The host has announced the service, so it exists, but on a loaded machine opening it can fail
        // briefly.
        while matches!(opened, Err(PublishSubscribeOpenError::DoesNotExist)) && Instant::now() < end {
            std::thread::sleep(RETRY_TIME);
            opened = builder().open_with_attributes(&attributes);
        }
        opened.map(ProcessOwned::new).map_err(|cause| match cause {
            PublishSubscribeOpenError::IncompatibleAttributes => layout("another layout".to_owned()),
            other => transported(name, "opening")(other),
        })
    }

    fn named_publisher(
        &self,
        name: &str,
        service: &Service,
        message: &Description,
    ) -> Result<ByteSender, SessionError> {
        if !self.is_one_of(service.writers) {
            let writers: Vec<String> = service.writers.iter().map(Part::to_string).collect();
            return Err(SessionError::Reserved { service: name.to_owned(), writers: writers.join(" or ") });
        }
        let max_bytes = match service.name {
            announced if announced == services::VOLUME.name => self.announcement.volume_bytes,
            announced if announced == services::FRAME.name => self.announcement.frame_bytes,
            _ => service.max_bytes,
        };
        let service = Service { max_bytes, ..*service };
        require_free(service.reserved_bytes() + CONNECTIONS_BYTES).map_err(short_memory(name))?;
        let mut builder = self.open(name, message)?;
        let mut made = publisher_of(&mut builder, &service);
        if matches!(made, Err(PublisherCreateError::ExceedsMaxSupportedPublishers)) {
            // Killed programs hold their slots until a cleanup.
            self.node.try_cleanup_dead_nodes();
            made = publisher_of(&mut builder, &service);
        }
        let raw = made.map_err(|cause| match cause {
            PublisherCreateError::ExceedsMaxSupportedPublishers if service.name == services::COMMAND.name => {
                let controller = name.rsplit('/').next().unwrap_or(name);
                SessionError::ControllerTaken { name: controller.to_owned() }
            }
            PublisherCreateError::ExceedsMaxSupportedPublishers => SessionError::Crowded {
                service: name.to_owned(),
                what: "write",
                limit: service.max_publishers,
            },
            other => transported(name, "publishing")(other),
        })?;
        SharedMemory::open()
            .map_err(file_error(Path::new("/dev/shm")))?
            .reserve(&self.id.shared_memory_prefix())
            .map_err(short_memory(name))?;
        Ok(ByteSender::new(raw, name.to_owned()))
    }

    fn named_subscriber(
        &self,
        name: &str,
        service: &Service,
        message: &Description,
    ) -> Result<ByteReceiver, SessionError> {
        require_free(CONNECTIONS_BYTES).map_err(short_memory(name))?;
        let factory = self.open(name, message)?;
        let subscriber = || factory.subscriber_builder().buffer_size(service.queue_length).create();
        let mut made = subscriber();
        if matches!(made, Err(SubscriberCreateError::ExceedsMaxSupportedSubscribers)) {
            self.node.try_cleanup_dead_nodes();
            made = subscriber();
        }
        let raw = made.map_err(|cause| match cause {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => SessionError::Crowded {
                service: name.to_owned(),
                what: "read",
                limit: service.max_subscribers,
            },
            other => transported(name, "subscribing")(other),
        })?;
        let guard = Guard::of(self, factory, service.writers);
        Ok(ByteReceiver::new(raw, name.to_owned(), guard))
    }
}

fn lossless(service: &Service) -> Service {
    Service { queue_length: service.lossless_length, ..*service }
}

type RawPublisher = iceoryx2::port::publisher::Publisher<iceoryx2::prelude::ipc::Service, [u8], ()>;

fn publisher_of(factory: &mut ByteService, service: &Service) -> Result<RawPublisher, PublisherCreateError> {
    let samples = service.samples();
    factory
        .publisher_builder()
        .initial_max_slice_len(service.max_bytes)
        .allocation_strategy(AllocationStrategy::Static)
        .max_loaned_samples(1)
        .override_sample_preallocation(move |_| samples)
        .create()
}
