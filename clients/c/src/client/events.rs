//! Events, remarks, removed voxels and sensor readings.

use ipc_types::messages::services;
use ipc_types::messages::{
    Event, EventCode, Participant, Removed, SensorReading, Severity, Tick, TipJacobian,
};
use ipc_types::ports::{ReceivedMessage, Subscriber};
use ipc_types::process::EventSender;

use super::{Client, put};
use crate::error::ClientError;

impl Client {
    /// Returns the oldest event not yet taken. Events are queued from this client's first call on. The event
    /// stays in shared memory until the next one is returned.
    ///
    /// # Errors
    /// [`ClientError::Forked`]; or a transport error.
    pub fn next_event(&mut self) -> Result<Option<(&Event, &str)>, ClientError> {
        self.check_process()?;
        if self.events.is_none() {
            self.events = Some(self.session.subscriber(&services::EVENT)?);
        }
        let Some(event) = self.events.as_ref().map_or(Ok(None), |events| events.receive_valid(|_| {}))?
        else {
            return Ok(None);
        };
        let event = &*self.event.insert(event);
        Ok(Some((event.message(), event_text(event))))
    }

    /// Adds a text to the session's events, which are recorded in the log.
    ///
    /// # Errors
    /// [`ClientError::Observer`]; [`ClientError::BadArgument`] for an unknown severity; or a transport error.
    pub fn remark(&mut self, severity: u32, text: &str) -> Result<(), ClientError> {
        self.check_process()?;
        let severity = Severity::try_from(severity).map_err(|unknown| ClientError::BadArgument {
            name: unknown.field,
            value: f64::from(unknown.number),
            expected: "0 information, 1 warning or 2 error",
        })?;
        let (_, index) = self.info.controller.as_ref().ok_or(ClientError::Observer)?;
        if self.remarks.is_none() {
            let sender = Participant::Controller(*index);
            self.remarks = Some(EventSender::new(&self.session, sender)?);
        }
        let tick = Tick(self.newest_tick.unwrap_or(0));
        if let Some(remarks) = &mut self.remarks {
            remarks.send(tick, severity, EventCode::Controller, text)?;
        }
        Ok(())
    }

    /// Returns the oldest message about removed voxels not yet taken, with the voxel indices in place.
    /// Messages are queued from this client's first call on. The message stays in shared memory until the
    /// next one is returned.
    ///
    /// # Errors
    /// [`ClientError::Forked`]; or a transport error.
    pub fn next_removed(&mut self) -> Result<Option<&ReceivedMessage<Removed>>, ClientError> {
        self.check_process()?;
        if self.removed.is_none() {
            self.removed = Some(self.session.subscriber(&services::REMOVED)?);
        }
        while let Some(removal) = self.removed.as_ref().map_or(Ok(None), Subscriber::receive)? {
            if put(&mut self.removal, removal) {
                return Ok(self.removal.as_ref());
            }
        }
        Ok(None)
    }

    /// Returns the oldest reading of any sensor not yet taken, if the scene has sensors. Readings are queued
    /// from the connection on, at most 1024; readings that arrive with a state are available when the state
    /// is. The reading stays in shared memory until the next one is returned.
    ///
    /// # Errors
    /// [`ClientError::Forked`]; or a transport error.
    pub fn next_reading(&mut self) -> Result<Option<&SensorReading>, ClientError> {
        self.check_process()?;
        while let Some(reading) = self.readings.as_ref().map_or(Ok(None), Subscriber::receive)? {
            if put(&mut self.reading, reading) {
                return Ok(self.reading.as_ref().map(ReceivedMessage::message));
            }
        }
        Ok(None)
    }

    /// Returns the newest Jacobian of the tip, if the scene sets `manipulator.tip_jacobian`; that of a state
    /// is available when the state is. It stays in shared memory until a newer one is returned.
    ///
    /// # Errors
    /// [`ClientError::Forked`]; or a transport error.
    pub fn tip_jacobian(&mut self) -> Result<Option<&TipJacobian>, ClientError> {
        self.check_process()?;
        while let Some(jacobian) = self.tip_jacobians.as_ref().map_or(Ok(None), Subscriber::receive)? {
            put(&mut self.tip_jacobian, jacobian);
        }
        Ok(self.tip_jacobian.as_ref().map(ReceivedMessage::message))
    }
}

/// Returns the text of an event, in place; empty if it is not valid UTF-8, because its sender is another
/// process.
pub(crate) fn event_text(event: &ReceivedMessage<Event>) -> &str {
    let bytes = event.tail();
    std::str::from_utf8(bytes.strip_suffix(&[0]).unwrap_or(bytes)).unwrap_or("")
}
