//! Identifies a message's sender by the transport, not by what the message claims: which controller sent it, and whether a part's message
//! really comes from that part.

use std::cell::{Cell, RefCell};
use std::io;
use std::os::fd::OwnedFd;
use std::sync::{Arc, OnceLock};

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::prelude::{CallbackProgression, PortFactory};
use iceoryx2::service::dynamic_config::publish_subscribe::PublisherDetails;

use crate::layout::Message;
use crate::messages::{Command, DrrRequest, Part};
use crate::ports::Received;
use crate::services;
use crate::session::{ByteService, Session, SessionError, create_file, file_error, read_file};

/// File in the session's folder that records a part's node.
fn file(part: Part) -> &'static str {
    match part {
        Part::Host => "part.host",
        Part::Physics => "part.physics",
        Part::Drr => "part.drr",
        Part::Recorder => "part.recorder",
    }
}

impl Session {
    /// Claims a part for this program, before it opens the part's ports. Each part exists once.
    ///
    /// # Errors
    /// [`SessionError::PartTaken`]; a file that cannot be written.
    pub fn claim(&self, part: Part) -> Result<(), SessionError> {
        let node = self.node.id().value();
        match create_file(&self.handle, file(part), node.to_string().as_bytes()) {
            Err(cause) if cause.kind() == io::ErrorKind::AlreadyExists => {
                match self.claims.node_of(&self.handle, part) {
                    Some(other) if other == node => Ok(()),
                    _ => Err(SessionError::PartTaken { part }),
                }
            }
            other => other.map_err(file_error(&self.folder.join(file(part)))),
        }
    }

    /// Whether this program is one of these writers.
    pub(crate) fn is_one_of(&self, writers: &[Part]) -> bool {
        let node = self.node.id().value();
        writers.is_empty()
            || writers.iter().any(|part| self.claims.node_of(&self.handle, *part) == Some(node))
    }
}

/// Node number of each part, once read. Cached, because a claim never changes and the session's folder may be removed before a part sends
/// its first message on some service.
#[derive(Debug, Default)]
pub(crate) struct Claims([OnceLock<u128>; Part::ALL.len()]);

impl Claims {
    /// A part's node number. The first lookup reads all claims: when one part's first message arrives, the others have made theirs.
    fn node_of(&self, folder: &OwnedFd, part: Part) -> Option<u128> {
        let Claims(nodes) = self;
        if nodes[part as usize].get().is_none() {
            for (part, node) in Part::ALL.into_iter().zip(nodes) {
                if let Some(claimant) = read_file(folder, file(part)).ok().and_then(|text| text.parse().ok())
                {
                    node.get_or_init(|| claimant);
                }
            }
        }
        nodes[part as usize].get().copied()
    }
}

/// Connections that a reader remembers; an older one is looked up again.
const KNOWN_CONNECTIONS: usize = 32;

/// Tells a part's messages from those of programs that took a free port of the part's service.
#[derive(Debug)]
pub(crate) struct Guard {
    service: ByteService,
    folder: OwnedFd,
    claims: Arc<Claims>,
    writers: &'static [Part],
    /// Connections already identified.
    known: RefCell<Vec<(UniquePublisherId, Option<Part>)>>,
    strangers: Cell<u64>,
}

impl Guard {
    /// `None` for a service that every client may write.
    pub(crate) fn of(
        session: &Session,
        service: ByteService,
        writers: &'static [Part],
    ) -> io::Result<Option<Guard>> {
        if writers.is_empty() {
            return Ok(None);
        }
        let folder = session.handle.try_clone()?;
        let claims = Arc::clone(&session.claims);
        let (known, strangers) = (RefCell::default(), Cell::new(0));
        Ok(Some(Guard { service, folder, claims, writers, known, strangers }))
    }

    /// The part at the other end of a connection. Counts strangers.
    pub(crate) fn part_of(&self, sender: UniquePublisherId) -> Option<Part> {
        let known = self.known.borrow().iter().find(|(known, _)| *known == sender).map(|(_, part)| *part);
        let part = known.unwrap_or_else(|| {
            let part = self.look_for(sender);
            let mut known = self.known.borrow_mut();
            if known.len() == KNOWN_CONNECTIONS {
                known.remove(0);
            }
            known.push((sender, part));
            part
        });
        if part.is_none() {
            self.strangers.set(self.strangers.get() + 1);
        }
        part
    }

    /// Once a part has ended its port is gone, but its last messages may still be queued. It is then identified by its process number,
    /// which both the port's and the node's number contain.
    fn look_for(&self, sender: UniquePublisherId) -> Option<Part> {
        let process = |number: u128| (number >> 64) as u32;
        let node = publishers(&self.service).find(|details| details.publisher_id == sender);
        let node = node.map(|details| details.node_id.value());
        let is_it = |part: &Part| {
            let claimant = self.claims.node_of(&self.folder, *part);
            claimant.is_some_and(|claimant| match node {
                Some(node) => claimant == node,
                None => process(claimant) == process(sender.value()),
            })
        };
        self.writers.iter().copied().find(is_it)
    }

    /// Messages from strangers so far.
    pub(crate) fn strangers(&self) -> u64 {
        self.strangers.get()
    }
}

/// Tells who may request frames from the DRR process, from the connected ports.
///
/// A program has one node in a session, and all its ports belong to it. The program that holds a controller's command port is that
/// controller, so no request can impersonate another's.
#[derive(Debug)]
pub struct Requesters {
    requests: ByteService,
    commands: Vec<ByteService>,
}

impl Session {
    /// A view of the connected programs.
    ///
    /// # Errors
    /// As [`Session::subscriber`].
    pub fn requesters(&self) -> Result<Requesters, SessionError> {
        let controllers = &self.announcement().controllers;
        let command = |name: &String| self.open::<Command>(&services::command_name(name));
        Ok(Requesters {
            requests: self.open::<DrrRequest>(services::DRR_REQUEST.name)?,
            commands: controllers.iter().map(command).collect::<Result<_, _>>()?,
        })
    }
}

impl Requesters {
    /// Index of the controller that sent a request; `None` if it came from an observer or from a program that has since ended.
    pub fn controller_of(&self, request: &Received<DrrRequest>) -> Option<usize> {
        let Sender(sender) = request.sender();
        let node = publishers(&self.requests).find(|details| details.publisher_id == sender)?.node_id;
        self.commands.iter().position(|service| publishers(service).any(|details| details.node_id == node))
    }
}

fn publishers(service: &ByteService) -> impl Iterator<Item = PublisherDetails> {
    let mut all = Vec::new();
    service.dynamic_config().list_publishers(|details| {
        all.push(*details);
        CallbackProgression::Continue
    });
    all.into_iter()
}

/// One connection of a sender; a sender that reconnects gets a new one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sender(UniquePublisherId);

impl Sender {
    /// A number unique to this connection.
    pub fn number(self) -> u128 {
        self.0.value()
    }
}

impl<M: Message> Received<M> {
    /// The connection this message came over.
    pub fn sender(&self) -> Sender {
        Sender(self.sample.header().publisher_id())
    }
}
