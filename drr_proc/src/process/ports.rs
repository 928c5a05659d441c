//! Every port of the DRR process.

use ipc_types::identity::Requesters;
use ipc_types::messages::{
    DrrReply, DrrRequest, Frame, FrameTiming, Part, Participant, Progress, Removed, RunStatus, State, Tick,
    Volume,
};
use ipc_types::ports::{Publisher, Received, Subscriber};
use ipc_types::process::{EndRequest, EventSender, VOLUME_LIMIT, await_volume};
use ipc_types::services;
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::{Waiter, Waker};

use super::DrrProcessError;

pub(super) struct Ports {
    volume: Subscriber<Volume>,
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
            volume: session.subscriber(&services::VOLUME)?,
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

    /// Receives the volume in shared memory; it stays mapped for as long as the return value lives.
    pub(super) fn receive_volume(&self, end: &EndRequest) -> Result<Received<Volume>, DrrProcessError> {
        let volume = await_volume(&self.volume, end)?;
        volume.ok_or(DrrProcessError::NoVolume { limit_s: VOLUME_LIMIT.as_secs() })
    }

    /// Tells the physics how far this process has come.
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
