//! The side of a replay visible to live controllers: the physics' ports and the log's frames.

use ipc_types::messages::services;
use ipc_types::messages::{
    Command, ControllerIndex, DrrReply, Frame, Latched, Part as HubPart, Phase, RunStatus, State, Tick,
};
use ipc_types::ports::{PortError, Publisher, Subscriber};
use ipc_types::scene::Scene;
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::{Waiter, Waker};
use run_log::FrameRecord;

use crate::failure::Failure;
use crate::replay::frames::{FrameReplay, compare};

/// The physics' ports that a controller sees.
pub(super) struct Stage {
    pub(super) states: Publisher<State>,
    pub(super) latched: Publisher<Latched>,
    pub(super) status: Publisher<RunStatus>,
    pub(super) replies: Publisher<DrrReply>,
    pub(super) frames: Option<Publisher<Frame>>,
    pub(super) live: Vec<Live>,
    pub(super) waiter: Waiter,
}

/// A live controller.
pub(super) struct Live {
    pub(super) name: String,
    pub(super) index: ControllerIndex,
    pub(super) commands: Subscriber<Command>,
    waker: Waker,
}

impl Stage {
    pub(super) fn open(
        session: &Session,
        controllers: &[(String, Vec<String>)],
        indices: &[ControllerIndex],
        scene: &Scene,
    ) -> Result<Stage, Failure> {
        let live = |((name, _), index): (&(String, Vec<String>), &ControllerIndex)| {
            Ok(Live {
                name: name.clone(),
                index: *index,
                commands: session.command_subscriber(name)?,
                waker: session.waker(Reader::Controller(*index))?,
            })
        };
        let open = || -> Result<Stage, SessionError> {
            session.claim(HubPart::Physics)?;
            session.claim(HubPart::Drr)?;
            Ok(Stage {
                states: session.publisher(&services::STATE)?,
                latched: session.publisher(&services::LATCHED)?,
                status: session.publisher(&services::RUN_STATUS)?,
                replies: session.publisher(&services::DRR_REPLY)?,
                frames: scene.drr.as_ref().map(|_| session.publisher(&services::FRAME)).transpose()?,
                live: controllers.iter().zip(indices).map(live).collect::<Result<_, SessionError>>()?,
                waiter: session.waiter(Reader::Physics)?,
            })
        };
        open().map_err(Failure::failed)
    }

    pub(super) fn say(&self, tick: Tick, phase: Phase) -> Result<(), PortError> {
        self.status.send(&RunStatus { tick: tick.0, phase: phase.code(), ..RunStatus::zeroed() })?;
        self.live.iter().for_each(|live| live.waker.wake());
        Ok(())
    }

    pub(super) fn show(&self, state: &State) -> Result<(), PortError> {
        self.states.send(state)?;
        self.live.iter().for_each(|live| live.waker.wake());
        Ok(())
    }
}

/// The log's frames, to be sent to the controllers.
pub(super) struct Frames<'l> {
    pub(super) replay: Option<FrameReplay<'l>>,
    pub(super) next: Option<FrameRecord>,
    /// Whether to re-render frames even if the log contains the image.
    pub(super) rendered: bool,
}

impl Frames<'_> {
    /// Returns the next frame with a tick up to this one.
    pub(super) fn due(&mut self, tick: u64) -> Result<Option<FrameRecord>, Failure> {
        let Some(replay) = &mut self.replay else { return Ok(None) };
        if self.next.is_none() {
            self.next = replay.next_recorded()?;
        }
        let Some(recorded) = self.next.take_if(|record| record.frame.tick <= tick) else { return Ok(None) };
        if recorded.image.is_some() && !self.rendered {
            return Ok(Some(recorded));
        }
        let Some(rendered) = replay.render(&recorded.frame)? else { return Ok(None) };
        match compare(&recorded, &rendered) {
            None => Ok(Some(rendered)),
            Some(difference) => {
                Err(Failure::failed(format!("frame {}: {difference}", recorded.frame.sequence)))
            }
        }
    }
}
