//! Identifies a message's sender by the transport, not by what the message claims: which controller sent it,
//! and whether a part's message really comes from that part.

use std::cell::{Cell, RefCell};

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::prelude::{CallbackProgression, PortFactory};
use iceoryx2::service::dynamic_config::publish_subscribe::PublisherDetails;

use crate::messages::layout::Message;
use crate::messages::services;
use crate::messages::{Command, ControllerIndex, DrrRequest, Part};
use crate::ports::ReceivedMessage;
use crate::session::{ByteService, Session, SessionError};
use crate::shared_page::SharedPage;

/// Process number contained in one of the transport's unique numbers: bits 64 to 95 (iceoryx2-bb-posix 0.10,
/// `UniqueSystemId`).
pub(crate) fn process_of(number: u128) -> u32 {
    (number >> 64) as u32
}

impl Session {
    /// Claims a part for this program; call it before opening the part's ports. Each part exists once.
    ///
    /// # Errors
    /// [`SessionError::PartTaken`].
    pub fn claim(&self, part: Part) -> Result<(), SessionError> {
        match self.page.claim(part, self.node.id().value()) {
            true => Ok(()),
            false => Err(SessionError::PartTaken { part }),
        }
    }

    /// Returns whether this program has claimed one of these parts; true if any program may write.
    pub(crate) fn is_one_of(&self, writers: &[Part]) -> bool {
        let node = self.node.id().value();
        writers.is_empty() || writers.iter().any(|part| self.page.node_of(*part) == Some(node))
    }
}

/// Connections that a reader caches; one that was evicted is looked up again.
const KNOWN_CONNECTIONS: usize = 32;

/// Filters out messages of programs that took a free port of a part's service.
#[derive(Debug)]
pub(crate) struct Guard {
    service: ByteService,
    page: SharedPage,
    writers: &'static [Part],
    /// Connections already identified.
    known: RefCell<Vec<(UniquePublisherId, Option<Part>)>>,
    foreign_messages: Cell<u64>,
}

impl Guard {
    /// Creates the guard; `None` for a service that every client may write to.
    pub(crate) fn of(session: &Session, service: ByteService, writers: &'static [Part]) -> Option<Guard> {
        let (known, foreign_messages) = (RefCell::default(), Cell::new(0));
        let page = session.page.clone();
        (!writers.is_empty()).then_some(Guard { service, page, writers, known, foreign_messages })
    }

    /// Returns the part at the other end of a connection. Counts messages of other programs.
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
            self.foreign_messages.set(self.foreign_messages.get() + 1);
        }
        part
    }

    /// Identifies a connection's part. Once a part has ended, its port is gone, but its last messages may
    /// still be queued; it is then identified by its process number, which both the port's and the node's
    /// number contain.
    fn look_for(&self, sender: UniquePublisherId) -> Option<Part> {
        let node = publishers(&self.service).find(|details| details.publisher_id == sender);
        let node = node.map(|details| details.node_id.value());
        let is_it = |part: &Part| {
            let claimant = self.page.node_of(*part);
            claimant.is_some_and(|claimant| match node {
                Some(node) => claimant == node,
                None => process_of(claimant) == process_of(sender.value()),
            })
        };
        self.writers.iter().copied().find(is_it)
    }

    /// Messages from other programs so far.
    pub(crate) fn foreign_messages(&self) -> u64 {
        self.foreign_messages.get()
    }
}

/// Identifies the sender of a frame request to the DRR process from the connected ports.
///
/// A program has one node in a session, and all its ports belong to it. The program that holds a controller's
/// command port is that controller, so no request can impersonate another's.
#[derive(Debug)]
pub struct Requesters {
    requests: ByteService,
    commands: Vec<ByteService>,
}

impl Session {
    /// Opens the view of the connected programs.
    ///
    /// # Errors
    /// As [`Session::subscriber`].
    pub fn requesters(&self) -> Result<Requesters, SessionError> {
        let controllers = &self.announcement().controllers;
        let command = |name: &String| self.open(&services::command_name(name), Command::DESCRIPTION);
        Ok(Requesters {
            requests: self.open(services::DRR_REQUEST.name, DrrRequest::DESCRIPTION)?,
            commands: controllers.iter().map(command).collect::<Result<_, _>>()?,
        })
    }
}

impl Requesters {
    /// Returns the controller that sent a request; `None` if it came from an observer or from a program that
    /// has since ended.
    pub fn controller_of(&self, request: &ReceivedMessage<DrrRequest>) -> Option<ControllerIndex> {
        let Sender(sender) = request.sender();
        let node = publishers(&self.requests).find(|details| details.publisher_id == sender)?.node_id;
        let mut all = ControllerIndex::first(self.commands.len()).zip(&self.commands);
        all.find(|(_, service)| publishers(service).any(|details| details.node_id == node))
            .map(|(index, _)| index)
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
    /// Returns a number unique to this connection.
    pub fn number(self) -> u128 {
        self.0.value()
    }
}

impl<M: Message> ReceivedMessage<M> {
    /// Returns the connection that this message arrived over.
    pub fn sender(&self) -> Sender {
        Sender(self.sample.publisher_id())
    }
}
