//! Which controller a message comes from, as the transport knows it and not as the message says.

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::prelude::{CallbackProgression, PortFactory};
use iceoryx2::service::dynamic_config::publish_subscribe::PublisherDetails;

use crate::layout::Message;
use crate::messages::{Command, DrrRequest};
use crate::ports::Received;
use crate::services;
use crate::session::{ByteService, Session, SessionError};

/// Who may ask the DRR process for frames, by the ports that are connected.
///
/// A program has one node in a session, and all its ports belong to it: who holds the command port of a controller is
/// this controller, and no request can claim to be another's.
#[derive(Debug)]
pub struct Requesters {
    requests: ByteService,
    commands: Vec<ByteService>,
}

impl Session {
    /// A view of who is connected.
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
    /// Index of the controller that has sent a request; none if it came from an observer, or from a program that has
    /// gone meanwhile.
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

/// One connection of a program that sends: another one each time that it connects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sender(UniquePublisherId);

impl Sender {
    /// A number that no other connection has.
    pub fn number(self) -> u128 {
        self.0.value()
    }
}

impl<M: Message> Received<M> {
    /// Which connection this message came over.
    pub fn sender(&self) -> Sender {
        Sender(self.sample.header().publisher_id())
    }
}
