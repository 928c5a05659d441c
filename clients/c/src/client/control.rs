//! Run control: pause, continue, step, reset, stop.

use std::time::{Duration, Instant};

use ipc_types::messages::services;
use ipc_types::messages::{ControlStatus, RunControl, RunControlReply};
use ipc_types::ports::{Publisher, Subscriber};

use super::{Client, OBSERVER_POLL_PERIOD, new_request_id};
use crate::error::ClientError;

#[derive(Debug)]
pub(super) struct Control {
    publisher: Publisher<RunControl>,
    replies: Subscriber<RunControlReply>,
    /// The newest request: its id and action.
    asked: Option<(u64, u32)>,
    /// A request held back until the physics has sent a message.
    unsent: Option<RunControl>,
}

impl Client {
    /// Sends a run-control request (one of the `CONTROL_` constants; `ticks` applies to a step) and waits for
    /// the reply.
    ///
    /// # Errors
    /// [`ClientError::ControlRefused`], [`ClientError::TimedOut`], [`ClientError::Ended`]; or a transport
    /// error.
    pub fn run_control(
        &mut self,
        action: u32,
        ticks: u64,
        limit: Duration,
    ) -> Result<RunControlReply, ClientError> {
        self.check_process()?;
        let control = match &mut self.control {
            Some(control) => control,
            none => none.insert(Control {
                publisher: self.session.publisher(&services::RUN_CONTROL)?,
                // Replies to other clients must not evict the one to this client.
                replies: self.session.lossless_subscriber(&services::RUN_CONTROL_REPLY)?,
                asked: None,
                unsent: None,
            }),
        };
        let request_id = new_request_id();
        control.unsent = Some(RunControl { request_id, ticks, action, reserved: 0 });
        control.asked = Some((request_id, action));
        self.await_control(limit)
    }

    /// Continues to wait for the reply to the last request after a timeout.
    ///
    /// # Errors
    /// [`ClientError::Misuse`] if no reply is pending; otherwise as [`Client::run_control`].
    pub fn await_control(&mut self, limit: Duration) -> Result<RunControlReply, ClientError> {
        let deadline = Instant::now() + limit;
        loop {
            // The reply is published before the end: if it has not arrived by then, it never will.
            let ended = self.has_ended()?;
            let control =
                self.control.as_mut().and_then(|control| control.asked.map(|asked| (control, asked)));
            let Some((control, (request_id, action))) = control else {
                return Err(ClientError::Misuse("no run-control reply is pending"));
            };
            // The physics announces itself first; a request sent before that is lost.
            if self.newest_status.is_some()
                && let Some(request) = control.unsent.take()
            {
                control.publisher.send(&request)?;
                self.physics.wake();
            }
            while let Some(reply) = control.replies.receive()? {
                let reply = *reply.message();
                if reply.request_id == request_id {
                    control.asked = None;
                    let refused = reply.status() == Ok(ControlStatus::Refused);
                    return if refused { Err(ClientError::ControlRefused { action }) } else { Ok(reply) };
                }
            }
            if ended {
                return Err(ClientError::Ended);
            }
            if Instant::now() >= deadline {
                return Err(ClientError::TimedOut(limit));
            }
            std::thread::sleep(OBSERVER_POLL_PERIOD);
        }
    }
}
