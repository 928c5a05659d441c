//! Joining a session, and making ports in it.

use std::fs;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::prelude::{AllocationStrategy, Node, ipc};
use iceoryx2::service::attribute::AttributeVerifier;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use rustix::fs::FallocateFlags;

use crate::layout::Message;
use crate::messages::Command;
use crate::ports::{Publisher, Subscriber};
use crate::services::{self, Service};
use crate::session::{
    Announcement, ByteService, CONTROLLER_VARIABLE, FLAGS_FILE, ICEORYX2_VERSION, Reader, SESSION_VARIABLE,
    Session, SessionError, create_node, file_error, session_id, shared_memory_prefix, transported,
};
use crate::wake::{Crowd, Waiter, WakeFlags, Waker, Way, allowed_cores};

/// How long a client waits for a session to be announced, or for a service to be there.
const JOIN_TIME: Duration = Duration::from_secs(10);
/// How long a service that has been announced is looked for again.
const OPEN_TIME: Duration = Duration::from_secs(2);
const RETRY_TIME: Duration = Duration::from_millis(5);
/// Where shared memory lies.
const SHARED_MEMORY: &str = "/dev/shm";

impl Session {
    /// Joins the session in a folder; waits up to ten seconds for its announcement.
    ///
    /// # Errors
    /// [`SessionError::NoSession`]; [`SessionError::Version`], [`SessionError::Transport`] or [`SessionError::Layout`] for
    /// a hub of another version; a transport failure.
    pub fn join(folder: &Path) -> Result<Session, SessionError> {
        Session::join_within(folder, JOIN_TIME)
    }

    /// The same with a limit of its own.
    ///
    /// # Errors
    /// As [`Session::join`].
    pub fn join_within(folder: &Path, limit: Duration) -> Result<Session, SessionError> {
        let announcement = read_announcement(folder, limit)?;
        check_layouts(&announcement)?;
        let node = create_node(folder, &session_id(folder))?;
        let flags_path = folder.join(FLAGS_FILE);
        let flags = WakeFlags::open(&flags_path, false).map_err(file_error(&flags_path))?;
        Ok(Session { folder: folder.to_owned(), announcement, node, flags })
    }

    /// The session's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// What a program's environment must say for it to be this controller.
    pub fn how_to_connect(&self, controller: &str) -> String {
        format!("{SESSION_VARIABLE}={} {CONTROLLER_VARIABLE}={controller}", self.folder.display())
    }

    /// The transport itself, for measurements beside the session's services.
    pub fn node(&self) -> &Node<ipc::Service> {
        &self.node
    }

    /// What the host announced.
    pub fn announcement(&self) -> &Announcement {
        &self.announcement
    }

    /// Index of a controller in the scene.
    ///
    /// # Errors
    /// [`SessionError::UnknownController`].
    pub fn controller_index(&self, name: &str) -> Result<usize, SessionError> {
        let controllers = &self.announcement.controllers;
        controllers.iter().position(|known| known == name).ok_or_else(|| SessionError::UnknownController {
            name: name.to_owned(),
            known: if controllers.is_empty() { "none".to_owned() } else { controllers.join(", ") },
        })
    }

    /// A publisher of a service; its whole shared memory is reserved.
    ///
    /// # Errors
    /// [`SessionError::Layout`], [`SessionError::SharedMemory`], or a transport failure.
    pub fn publisher<M: Message>(&self, service: &Service) -> Result<Publisher<M>, SessionError> {
        self.named_publisher(service.name, service)
    }

    /// The publisher of a controller's commands: one at a time.
    ///
    /// # Errors
    /// [`SessionError::ControllerTaken`], and those of [`Session::publisher`].
    pub fn command_publisher(&self, controller: &str) -> Result<Publisher<Command>, SessionError> {
        self.controller_index(controller)?;
        self.named_publisher(&services::command_name(controller), &services::COMMAND)
    }

    /// A subscriber of a service.
    ///
    /// # Errors
    /// [`SessionError::Layout`] or a transport failure.
    pub fn subscriber<M: Message>(&self, service: &Service) -> Result<Subscriber<M>, SessionError> {
        self.named_subscriber(service.name, service)
    }

    /// A subscriber that keeps only the newest message, so that the writer goes round a few samples that stay in its
    /// cache instead of filling a long queue for a reader that looks seldom.
    ///
    /// # Errors
    /// As [`Session::subscriber`].
    pub fn newest_subscriber<M: Message>(&self, service: &Service) -> Result<Subscriber<M>, SessionError> {
        self.named_subscriber(service.name, &Service { queue_length: 1, ..*service })
    }

    /// A subscriber with the longest queue, for whoever must not lose a message when it stands still for seconds.
    ///
    /// # Errors
    /// As [`Session::subscriber`].
    pub fn lossless_subscriber<M: Message>(&self, service: &Service) -> Result<Subscriber<M>, SessionError> {
        self.named_subscriber(service.name, &lossless(service))
    }

    /// The subscriber of a controller's commands.
    ///
    /// # Errors
    /// [`SessionError::UnknownController`], and those of [`Session::subscriber`].
    pub fn command_subscriber(&self, controller: &str) -> Result<Subscriber<Command>, SessionError> {
        self.controller_index(controller)?;
        self.named_subscriber(&services::command_name(controller), &services::COMMAND)
    }

    /// The same with the longest queue.
    ///
    /// # Errors
    /// As [`Session::command_subscriber`].
    pub fn lossless_command_subscriber(&self, controller: &str) -> Result<Subscriber<Command>, SessionError> {
        self.controller_index(controller)?;
        self.named_subscriber(&services::command_name(controller), &lossless(&services::COMMAND))
    }

    /// Lets this process sleep until somebody wakes it.
    ///
    /// # Errors
    /// A transport failure.
    pub fn waiter(&self, reader: Reader) -> Result<Waiter, SessionError> {
        let name = reader.event_name();
        let service_name = name.as_str().try_into().map_err(transported(&name, "naming"))?;
        let service =
            self.node.service_builder(&service_name).event().open().map_err(transported(&name, "opening"))?;
        let listener = service.listener_builder().create().map_err(transported(&name, "listening"))?;
        let way = match reader {
            // They look at their queues in intervals: nobody waits for them.
            Reader::Recorder | Reader::Drr => Way::Hybrid,
            Reader::Physics | Reader::Controller(_) => {
                let spinning = 1 + self.announcement.controllers.len();
                Way::of(self.announcement.wait, self.announcement.policy, spinning, allowed_cores())
            }
        };
        Ok(Waiter {
            listener,
            flags: self.flags.clone(),
            reader: reader.slot(),
            way,
            crowd: Crowd::default(),
        })
    }

    /// Wakes another process.
    ///
    /// # Errors
    /// A transport failure.
    pub fn waker(&self, reader: Reader) -> Result<Waker, SessionError> {
        let name = reader.event_name();
        let service_name = name.as_str().try_into().map_err(transported(&name, "naming"))?;
        let service =
            self.node.service_builder(&service_name).event().open().map_err(transported(&name, "opening"))?;
        let notifier = service.notifier_builder().create().map_err(transported(&name, "notifying"))?;
        Ok(Waker { notifier, flags: self.flags.clone(), reader: reader.slot() })
    }

    /// Frees what processes that were killed have left in this session.
    pub fn clean_up_dead_nodes(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    pub(crate) fn open<M: Message>(&self, name: &str) -> Result<ByteService, SessionError> {
        let ours = M::DESCRIPTION.layout_hash();
        let theirs = self.announcement.layouts.get(name).cloned().unwrap_or_default();
        let layout = |theirs: String| SessionError::Layout {
            service: name.to_owned(),
            message: M::DESCRIPTION.name,
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
        // The host has announced it, so it is there: on a loaded machine a look at it may still fail for a moment.
        while matches!(opened, Err(PublishSubscribeOpenError::DoesNotExist)) && Instant::now() < end {
            std::thread::sleep(RETRY_TIME);
            opened = builder().open_with_attributes(&attributes);
        }
        opened.map_err(|cause| match cause {
            PublishSubscribeOpenError::IncompatibleAttributes => layout("another layout".to_owned()),
            other => transported(name, "opening")(other),
        })
    }

    fn named_publisher<M: Message>(
        &self,
        name: &str,
        service: &Service,
    ) -> Result<Publisher<M>, SessionError> {
        let max_bytes = match service.name {
            announced if announced == services::VOLUME.name => self.announcement.volume_bytes,
            announced if announced == services::FRAME.name => self.announcement.frame_bytes,
            _ => service.max_bytes,
        };
        require_free_memory(name, (service.samples() * (max_bytes + SAMPLE_HEADER)) as u64)?;
        let mut builder = self.open::<M>(name)?;
        let mut made = publisher_of(&mut builder, max_bytes, service);
        if matches!(made, Err(PublisherCreateError::ExceedsMaxSupportedPublishers)) {
            // Programs that were killed hold their places until somebody cleans up behind them.
            self.node.try_cleanup_dead_nodes();
            made = publisher_of(&mut builder, max_bytes, service);
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
        self.reserve_shared_memory(name)?;
        Ok(Publisher::new(raw, name.to_owned()))
    }

    fn named_subscriber<M: Message>(
        &self,
        name: &str,
        service: &Service,
    ) -> Result<Subscriber<M>, SessionError> {
        require_free_memory(name, 0)?;
        let factory = self.open::<M>(name)?;
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
        Ok(Subscriber::new(raw, name.to_owned()))
    }

    /// Gives every data segment of this session its memory now, so that a full /dev/shm is an error here and not a
    /// SIGBUS in the first write.
    fn reserve_shared_memory(&self, service: &str) -> Result<(), SessionError> {
        let prefix = shared_memory_prefix(&session_id(&self.folder));
        for entry in fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if !(name.starts_with(&prefix) && name.ends_with(".data")) {
                continue;
            }
            // A segment of a process that has ended meanwhile needs no memory any more.
            let Ok(file) = fs::OpenOptions::new().write(true).open(entry.path()) else { continue };
            let bytes = file.metadata().map(|meta| meta.len()).unwrap_or(0);
            if bytes > 0 {
                rustix::fs::fallocate(file.as_fd(), FallocateFlags::empty(), 0, bytes).map_err(|cause| {
                    SessionError::SharedMemory { service: service.to_owned(), bytes, cause: cause.into() }
                })?;
            }
        }
        Ok(())
    }
}

fn lossless(service: &Service) -> Service {
    Service { queue_length: service.lossless_length, ..*service }
}

/// What a sample needs beside its payload, at most.
const SAMPLE_HEADER: usize = 64;
/// What a port needs beside its samples: its connections, and what the others make at the same time.
const CONNECTIONS_BYTES: u64 = 2 << 20;

/// The transport touches memory before it is reserved; where there is none that is a SIGBUS, so a port is made only
/// where there is enough.
pub(crate) fn require_free_memory(service: &str, bytes: u64) -> Result<(), SessionError> {
    let bytes = bytes + CONNECTIONS_BYTES;
    match rustix::fs::statvfs(SHARED_MEMORY) {
        Ok(stat) if stat.f_blocks > 0 && stat.f_bavail * stat.f_frsize < bytes => {
            let cause = rustix::io::Errno::NOSPC.into();
            Err(SessionError::SharedMemory { service: service.to_owned(), bytes, cause })
        }
        // A file system that does not say may have enough.
        _ => Ok(()),
    }
}

type RawPublisher = iceoryx2::port::publisher::Publisher<iceoryx2::prelude::ipc::Service, [u8], ()>;

fn publisher_of(
    factory: &mut ByteService,
    max_bytes: usize,
    service: &Service,
) -> Result<RawPublisher, PublisherCreateError> {
    let builder = factory
        .publisher_builder()
        .initial_max_slice_len(max_bytes)
        .allocation_strategy(AllocationStrategy::Static)
        .max_loaned_samples(1);
    // Published once: room for one volume, not for one per subscriber's queue entry.
    let samples = if service.name == services::VOLUME.name { 1 } else { service.samples() };
    builder.override_sample_preallocation(move |_| samples).create()
}

fn read_announcement(folder: &Path, limit: Duration) -> Result<Announcement, SessionError> {
    let path = folder.join("session.json");
    let end = Instant::now() + limit;
    loop {
        match fs::read_to_string(&path) {
            Ok(text) => return announcement_of(&text, folder, &path),
            Err(_) if folder.is_dir() && Instant::now() < end => std::thread::sleep(RETRY_TIME),
            Err(_) => return Err(SessionError::NoSession { path: PathBuf::from(folder) }),
        }
    }
}

/// The versions come first: what else another version writes is its own affair.
fn announcement_of(text: &str, folder: &Path, path: &Path) -> Result<Announcement, SessionError> {
    let malformed = |cause: serde_json::Error| SessionError::File {
        path: path.to_owned(),
        cause: std::io::Error::other(cause),
    };
    let value: serde_json::Value = serde_json::from_str(text).map_err(malformed)?;
    let theirs = |key: &str| value[key].as_str().unwrap_or("of an unknown version").to_owned();
    let path = folder.to_owned();
    if theirs("iceoryx2") != ICEORYX2_VERSION {
        return Err(SessionError::Transport { path, theirs: theirs("iceoryx2") });
    }
    if theirs("trabecula") != env!("CARGO_PKG_VERSION") {
        return Err(SessionError::Version { path, theirs: theirs("trabecula") });
    }
    serde_json::from_value(value).map_err(malformed)
}

/// Compares the layout of every service that the hub has with this program's.
fn check_layouts(announcement: &Announcement) -> Result<(), SessionError> {
    for (name, theirs) in &announcement.layouts {
        let kind = name.split('/').next().unwrap_or(name);
        let service = services::ALL.iter().chain([&services::COMMAND]).find(|service| service.name == kind);
        let Some(service) = service else { continue };
        let ours = service.description.layout_hash();
        if *theirs != ours {
            let message = service.description.name;
            return Err(SessionError::Layout {
                service: name.clone(),
                message,
                theirs: theirs.clone(),
                ours,
            });
        }
    }
    Ok(())
}
