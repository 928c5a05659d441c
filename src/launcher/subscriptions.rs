//! The launcher's subscriptions to its run.

use std::path::Path;
use std::time::{Duration, Instant};

use foreign_text::foreign_line;
use ipc_types::clock::now_ns;
use ipc_types::messages::services;
use ipc_types::messages::{
    Event, EventCode, Frame, Part as HubPart, Participant, Phase, RunStatus, State, TickTiming,
};
use ipc_types::ports::{PortError, Subscriber};
use ipc_types::process::FIFO_REFUSED;
use ipc_types::session::{Session, SessionError};

use super::part::PartProcess;
use super::run::RunSnapshot;

/// Minimum time between two refused commands that are shown; the log has them all.
const REFUSAL_PERIOD: Duration = Duration::from_secs(5);

/// The launcher's subscriptions.
pub(super) struct Subscriptions {
    states: Subscriber<State>,
    statuses: Subscriber<RunStatus>,
    tick_timings: Subscriber<TickTiming>,
    frame_messages: Option<Subscriber<Frame>>,
    events: Subscriber<Event>,
    pub(super) state: Option<Box<State>>,
    pub(super) status: Option<RunStatus>,
    timings: Vec<TickTiming>,
    frames: u64,
    /// What the run has been waiting for, if not yet shown.
    waiting: Option<String>,
    /// Limits of this machine and refused commands that the physics has reported, if not yet shown.
    cautions: Vec<String>,
    /// When a refused command was last shown.
    refusal_shown: Option<Instant>,
}

impl Subscriptions {
    /// Returns whether the physics has announced the end of the run.
    pub(super) fn has_ended(&self) -> bool {
        self.status.is_some_and(|status| status.phase() == Ok(Phase::Ended))
    }

    pub(super) fn open(session: &Session) -> Result<Subscriptions, SessionError> {
        let has_frames = session.announcement().frame_bytes > 0;
        Ok(Subscriptions {
            states: session.newest_subscriber(&services::STATE)?,
            statuses: session.subscriber(&services::RUN_STATUS)?,
            tick_timings: session.subscriber(&services::TICK_TIMING)?,
            frame_messages: has_frames.then(|| session.subscriber(&services::FRAME)).transpose()?,
            state: None,
            status: None,
            events: session.subscriber(&services::EVENT)?,
            timings: Vec::new(),
            frames: 0,
            waiting: None,
            cautions: Vec::new(),
            refusal_shown: None,
        })
    }

    /// When the first tick not yet shown began.
    pub(super) fn first_start(&self) -> Option<Instant> {
        let since_ns = now_ns().checked_sub(self.timings.first()?.start_ns)?;
        Instant::now().checked_sub(Duration::from_nanos(since_ns))
    }

    /// Adds what has arrived to what is not yet shown.
    pub(super) fn poll(&mut self) -> Result<(), PortError> {
        if let Some(state) = self.states.receive_newest()? {
            self.state = Some(Box::new(*state.message()));
        }
        if let Some(status) = self.statuses.receive_newest()? {
            self.status = Some(*status.message());
        }
        while let Some(timing) = self.tick_timings.receive()? {
            self.timings.push(*timing.message());
        }
        while let Some(event) = self.events.receive_valid(|_| {})? {
            let message = event.message();
            if message.sender() != Some(Participant::Part(HubPart::Physics)) {
                continue;
            }
            let text = event.tail();
            let text = String::from_utf8_lossy(text.strip_suffix(&[0]).unwrap_or(text));
            let line = foreign_line(&text).to_string();
            match message.code() {
                Ok(EventCode::Waiting) => self.waiting = Some(line),
                // A run that waits for a valid command says nothing else until its time is up.
                Ok(EventCode::CommandRefused)
                    if self.refusal_shown.is_none_or(|shown| shown.elapsed() >= REFUSAL_PERIOD) =>
                {
                    self.refusal_shown = Some(Instant::now());
                    self.cautions.push(line);
                }
                _ if text.starts_with(FIFO_REFUSED) => self.cautions.push(line),
                _ => {}
            }
        }
        if let Some(frames) = &self.frame_messages {
            while let Some(frame) = frames.receive()? {
                self.frames = frame.message().sequence;
            }
        }
        Ok(())
    }

    /// Forgets what the last snapshot reported once, so that the next one does not repeat it.
    pub(super) fn forget_shown(&mut self) {
        self.timings.clear();
        self.waiting = None;
        self.cautions.clear();
    }

    pub(super) fn snapshot<'a>(
        &'a self,
        session: &'a Path,
        awaited: &'a [String],
        parts: &'a [PartProcess],
    ) -> RunSnapshot<'a> {
        RunSnapshot {
            session,
            awaited,
            state: self.state.as_deref(),
            status: self.status.as_ref(),
            timings: &self.timings,
            frames: self.frames,
            waiting: self.waiting.as_deref(),
            cautions: &self.cautions,
            parts,
        }
    }
}
