//! Every port of the physics process.

use std::time::Duration;

use ipc_types::identity::{Part, Sender};
use ipc_types::messages::{
    Command, Latched, Progress, Removed, RunControl, RunControlReply, RunStatus, SENDER_PHYSICS, State,
    TickTiming,
};
use ipc_types::ports::{PortError, Publisher, Subscriber};
use ipc_types::process::EventSender;
use ipc_types::ration::Remarks;
use ipc_types::scene::Scene;
use ipc_types::services::{self, MAX_REMOVED_PER_TICK};
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::{Waiter, Waker};
use zerocopy::IntoBytes;

use super::keyframes::Keyframes;
use crate::simulation::Simulation;

/// Reports of consumers that are taken in one look.
const REPORTS_PER_LOOK: usize = 64;

pub(super) struct Ports {
    pub(super) state: Publisher<State>,
    pub(super) latched: Publisher<Latched>,
    pub(super) removed: Publisher<Removed>,
    pub(super) status: Publisher<RunStatus>,
    pub(super) timing: Publisher<TickTiming>,
    pub(super) control: Subscriber<RunControl>,
    pub(super) control_reply: Publisher<RunControlReply>,
    pub(super) events: EventSender,
    pub(super) waiter: Waiter,
    pub(super) controllers: Vec<ControllerPort>,
    pub(super) consumers: Consumers,
    removed_messages: u64,
    /// None without a recorder.
    pub(super) keyframes: Option<Keyframes>,
}

/// A controller's side.
pub(super) struct ControllerPort {
    pub(super) name: String,
    pub(super) commands: Subscriber<Command>,
    pub(super) waker: Waker,
    /// Whether a command that answers the newest state has been timed.
    pub(super) round_trip_ns: u64,
    /// Whether the run may begin without it.
    pub(super) optional: bool,
    /// How long the start waits for it.
    pub(super) connect_limit: Duration,
    /// How it is to connect, for the message that it has not.
    pub(super) how_to_connect: String,
    /// Sequence of the newest command that was taken off the queue.
    pub(super) seen_sequence: u64,
    /// Commands that never came and of which nothing has been said.
    pub(super) lost: u64,
    pub(super) remarks: Remarks,
    /// The connection that the newest command came over.
    pub(super) sender: Option<Sender>,
}

impl Ports {
    pub(super) fn open(session: &Session, scene: &Scene) -> Result<Ports, SessionError> {
        let controllers = scene.controller.iter().enumerate().map(|(index, controller)| {
            Ok(ControllerPort {
                commands: session.command_subscriber(&controller.name)?,
                waker: session.waker(Reader::Controller(index))?,
                name: controller.name.clone(),
                round_trip_ns: 0,
                optional: controller.optional,
                connect_limit: Duration::from_secs_f64(controller.connect_limit_s),
                how_to_connect: if controller.external {
                    format!("; it is external: start it with {}", session.how_to_connect(&controller.name))
                } else {
                    String::new()
                },
                seen_sequence: 0,
                lost: 0,
                remarks: Remarks::default(),
                sender: None,
            })
        });
        Ok(Ports {
            state: session.publisher(&services::STATE)?,
            latched: session.publisher(&services::LATCHED)?,
            removed: session.publisher(&services::REMOVED)?,
            status: session.publisher(&services::RUN_STATUS)?,
            timing: session.publisher(&services::TICK_TIMING)?,
            control: session.subscriber(&services::RUN_CONTROL)?,
            control_reply: session.publisher(&services::RUN_CONTROL_REPLY)?,
            events: EventSender::new(session, SENDER_PHYSICS)?,
            waiter: session.waiter(Reader::Physics)?,
            controllers: controllers.collect::<Result<_, SessionError>>()?,
            consumers: Consumers::open(session)?,
            keyframes: match scene.keyframe_period_ticks().filter(|_| session.announcement().recorder) {
                Some(period) => Some(Keyframes::new(session.publisher(&services::KEYFRAME)?, period)),
                None => None,
            },
            removed_messages: 0,
        })
    }

    /// Publishes the holes that are there before the run, in as many messages of tick 0 as they need.
    pub(super) fn publish_predrilled(&mut self, voxels: &[u32]) -> Result<(), PortError> {
        voxels.chunks(MAX_REMOVED_PER_TICK).try_for_each(|chunk| self.publish_removed(0, chunk, 0, false))
    }

    /// Publishes the voxels that a tick removed; at most [`MAX_REMOVED_PER_TICK`].
    pub(super) fn publish_removed(
        &mut self,
        tick: u64,
        voxels: &[u32],
        removed_total: u64,
        restore_first: bool,
    ) -> Result<(), PortError> {
        self.removed_messages += 1;
        let message = Removed {
            tick,
            sequence: self.removed_messages,
            removed_total,
            restore_first: u32::from(restore_first),
            voxel_index_length: voxels.len() as u32,
        };
        self.removed.send_with_tail(&message, voxels.as_bytes())
    }

    /// Publishes the keyframe of the present state if one is due and somebody records.
    pub(super) fn publish_keyframe(&mut self, simulation: &Simulation<'_>) -> Result<(), PortError> {
        let due = self.keyframes.as_mut();
        due.map_or(Ok(()), |keyframes| keyframes.publish_due(simulation, &mut self.events))
    }

    pub(super) fn removed_messages(&self) -> u64 {
        self.removed_messages
    }
}

/// Who must take every state, and how far they are.
pub(super) struct Consumers {
    progress: Subscriber<Progress>,
    /// Messages of other programs that have been said.
    strangers: u64,
    list: Vec<Consumer>,
}

pub(super) struct Consumer {
    pub(super) part: &'static str,
    role: Part,
    pub(super) tick: Option<u64>,
    waker: Waker,
}

impl Consumer {
    pub(super) fn is_recorder(&self) -> bool {
        self.role == Part::Recorder
    }
}

impl Consumers {
    fn open(session: &Session) -> Result<Consumers, SessionError> {
        let announcement = session.announcement();
        let mut list = Vec::new();
        let mut add = |part, role, reader| -> Result<(), SessionError> {
            list.push(Consumer { part, role, tick: None, waker: session.waker(reader)? });
            Ok(())
        };
        if announcement.frame_bytes > 0 {
            add("the DRR process", Part::Drr, Reader::Drr)?;
        }
        if announcement.recorder {
            add("the recorder process", Part::Recorder, Reader::Recorder)?;
        }
        Ok(Consumers { progress: session.subscriber(&services::PROGRESS)?, strangers: 0, list })
    }

    /// Takes in what the consumers have reported.
    pub(super) fn update(&mut self) -> Result<(), PortError> {
        for _ in 0..REPORTS_PER_LOOK {
            let Some(report) = self.progress.receive_valid(|_| {})? else { break };
            // Whose it is says the transport, not the report: nobody speaks for another.
            let part = report.part();
            // A copy: its writer is another process.
            let tick = report.message().tick;
            for consumer in self.list.iter_mut().filter(|consumer| Some(consumer.role) == part) {
                consumer.tick = Some(tick);
            }
        }
        Ok(())
    }

    /// Reports of programs that are no consumer, since this was asked last.
    pub(super) fn new_strangers(&mut self) -> u64 {
        let strangers = self.progress.strangers();
        strangers - std::mem::replace(&mut self.strangers, strangers)
    }

    pub(super) fn has_report(&self) -> bool {
        self.progress.has_message()
    }

    /// The first consumer that has not connected.
    pub(super) fn missing(&self) -> Option<&Consumer> {
        self.list.iter().find(|consumer| consumer.tick.is_none())
    }

    /// The first consumer of these that has not taken the state of `tick`.
    pub(super) fn behind(&self, tick: u64, of: fn(&Consumer) -> bool) -> Option<&Consumer> {
        let mut these = self.list.iter().filter(|consumer| of(consumer));
        these.find(|consumer| consumer.tick.is_none_or(|taken| taken < tick))
    }

    pub(super) fn wake(&self) {
        self.list.iter().for_each(|consumer| consumer.waker.wake());
    }
}
