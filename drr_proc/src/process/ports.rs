//! Every port of the DRR process.

use ipc_types::identity::Requesters;
use ipc_types::messages::services;
use ipc_types::messages::{
    DrrReply, DrrRequest, Frame, FrameTiming, Part, Participant, Progress, Removed, RunStatus, State, Tick,
};
use ipc_types::ports::{Publisher, Subscriber};
use ipc_types::process::EventSender;
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::{Waiter, Waker};

use super::DrrProcessError;

pub(super) struct Ports {
    pub(super) states: Subscriber<State>,
    pub(super) removed: Subscriber<Removed>,
    pub(super) requests: Subscriber<DrrRequest>,
    pub(super) requesters: Requesters,
    pub(super) status: Subscriber<RunStatus>,
    pub(super) replies: Publisher<DrrReply>,
    pub(super) frames: Publisher<Frame>,
    pub(super) timing: Publisher<FrameTiming>,
    pub(super) progress: Publisher<Progress>,
    pub(super) events: EventSender,
    pub(super) waiter: Waiter,
    pub(super) physics: Waker,
}

impl Ports {
    pub(super) fn open(session: &Session) -> Result<Ports, SessionError> {
        Ok(Ports {
            states: session.subscriber(&services::STATE)?,
            removed: session.lossless_subscriber(&services::REMOVED)?,
            requests: session.subscriber(&services::DRR_REQUEST)?,
            requesters: session.requesters()?,
            status: session.subscriber(&services::RUN_STATUS)?,
            replies: session.publisher(&services::DRR_REPLY)?,
            frames: session.publisher(&services::FRAME)?,
            timing: session.publisher(&services::FRAME_TIMING)?,
            progress: session.publisher(&services::PROGRESS)?,
            events: EventSender::new(session, Participant::Part(Part::Drr))?,
            waiter: session.waiter(Reader::Drr)?,
            physics: session.waker(Reader::Physics)?,
        })
    }

    /// Reports to the physics how far this process has come.
    pub(super) fn report_progress(&self, tick: Tick) -> Result<(), DrrProcessError> {
        self.progress.send(&Progress {
            tick: tick.0,
            lost_messages: 0,
            consumer: Participant::Part(Part::Drr).code(),
            reserved: 0,
        })?;
        self.physics.wake();
        Ok(())
    }
}
