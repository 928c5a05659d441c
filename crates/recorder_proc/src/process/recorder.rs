//! Drains the queues, and finishes the logs.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use hub::rate_limit::WarningLimit;
use ipc_types::clock::now_ns;
use ipc_types::messages::layout::Message;
use ipc_types::messages::services::RECORDER_QUEUE_TICKS;
use ipc_types::messages::{EventCode, Part, Participant, Phase, Progress, RunControl, RunControlReply, Tick};
use ipc_types::ports::Subscriber;
use ipc_types::process::EndRequest;
use ipc_types::scene::{Images, Recording};
use ipc_types::session::host_is_alive;
use run_log::gaps::Gaps;
use run_log::{EndMarker, EndReason, LogError, Topic};
use zerocopy::FromBytes;

use super::flight::{Flight, Lanes, TriggerEvent};
use super::ports::Ports;
use super::{RecorderError, sync_folder};
use crate::background::BackgroundFile;
use crate::reason_file;

/// Longest time between polls: a small fraction of the queues' length.
const POLL_PERIOD: Duration = Duration::from_millis(2);
/// Number of states after which progress is reported within a round.
const PROGRESS_TICKS: u64 = 64;
/// Number of states to read before the other queues are polled again.
pub(super) const TICKS_PER_ROUND: usize = 16;
/// Number of messages to read from a client service before the other queues are polled again, so that a
/// flooding client cannot keep the recorder from the ticks.
const CLIENT_MESSAGES_PER_ROUND: usize = 256;
/// Rounds after the run's end, enough to drain the longest client queue (2048 events).
const LAST_ROUNDS: usize = 8;
/// How much later than its tick a trigger may be read. A round reads its states before the events, an event
/// may arrive just after its round has read the events, and a full queue of events takes [`LAST_ROUNDS`]
/// rounds.
pub(super) const LATE_TICKS: u64 = ((LAST_ROUNDS + 2) * TICKS_PER_ROUND) as u64;
/// Time limit for an orphaned physics, whose launcher was killed, to end.
const ORPHANED_LIMIT: Duration = Duration::from_secs(5);
/// Time without a state after which the timing lane is flushed to its file.
const QUIET_TIME: Duration = Duration::from_millis(100);

/// How much of the run was recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RecordingExtent {
    /// Everything until the recorder was asked to end.
    UpToTheEnd,
    /// Everything before an error of the recorder.
    UpToAnError,
}

/// State of the recorder while it records.
pub(super) struct Recorder {
    /// Number of messages from non-owners reported so far.
    pub foreign_messages: u64,
    pub foreign_warnings: WarningLimit,
    pub lanes: Lanes,
    /// Keeps only the last seconds; `None` if everything is kept.
    pub flight: Option<Flight>,
    /// Folder of the run.
    pub output: PathBuf,
    pub recording: Recording,
    pub newest_tick: u64,
    pub reported_tick: u64,
    /// Gaps in the timing lane.
    pub gaps: Gaps,
    /// Whether the physics has announced the end of the run.
    pub run_has_ended: bool,
    pub session_folder: PathBuf,
    pub gap_warnings: WarningLimit,
    pub ports: Ports,
}

impl Recorder {
    /// Receives messages until the recorder is asked to end, then drains the queues.
    pub fn record(&mut self, end: &EndRequest) -> Result<(), RecorderError> {
        self.report_progress(0)?;
        let mut quiet_since = Instant::now();
        while !end.is_set() {
            self.ports.waiter.wait_until(Instant::now() + POLL_PERIOD, || self.ports.states.has_message());
            // A physics process that joins later must see this recorder.
            self.ports.progress.deliver_history()?;
            if self.take_round()? {
                quiet_since = Instant::now();
            } else if quiet_since.elapsed() >= QUIET_TIME {
                // During a pause no tick closes a chunk, but user actions in the meantime must reach the
                // file.
                self.lanes.timing.flush()?;
                quiet_since = Instant::now();
            }
            self.report_foreign_messages()?;
        }
        // The launcher writes the end reason before it requests the end. Its lock may briefly outlive it.
        if self.reason_path().is_none() || !host_is_alive(&self.session_folder) {
            self.wait_for_physics()?;
        }
        for _ in 0..LAST_ROUNDS {
            self.take_round()?;
        }
        while self.ports.states.has_message() {
            self.take_round()?;
        }
        Ok(())
    }

    /// Waits for the physics to end. A launcher stops the recorder only when no part publishes any more, but
    /// if the launcher was killed, all parts are asked to end at once. Everything that the physics publishes
    /// until its end must reach the log.
    fn wait_for_physics(&mut self) -> Result<(), RecorderError> {
        let limit = Instant::now() + ORPHANED_LIMIT;
        while !self.run_has_ended && Instant::now() < limit {
            self.ports.waiter.wait_until(Instant::now() + POLL_PERIOD, || self.ports.states.has_message());
            self.take_round()?;
        }
        Ok(())
    }

    /// Reads some ticks, and everything else that is queued. In lockstep the physics runs as fast as states
    /// are read: a recorder that kept reading states would starve the other queues until they overflow.
    /// Returns whether a state arrived.
    pub fn take_round(&mut self) -> Result<bool, RecorderError> {
        let came = self.take_ticks()?;
        self.take_frames()?;
        self.take_timing()?;
        if let Some(flight) = &mut self.flight {
            flight.end_due(&mut self.lanes, self.gaps.lost())?;
        }
        Ok(came)
    }

    fn take_ticks(&mut self) -> Result<bool, RecorderError> {
        let mut came = false;
        for _ in 0..TICKS_PER_ROUND {
            let Some(state) = self.ports.states.receive()? else { break };
            came = true;
            // A tick's `Latched`, `Removed` and readings are published before its state.
            self.take_inputs()?;
            self.lanes.run.state(state.message())?;
            let tick = state.message().tick;
            if let Some(flight) = &mut self.flight {
                for cause in flight.triggers.state(state.message()) {
                    let event = TriggerEvent { tick: Tick(tick), cause, after_ticks: None };
                    flight.trigger(event, &mut self.ports.events_sent)?;
                }
                flight.begin(&mut self.lanes, self.gaps.lost())?;
            }
            drop(state);
            let missing = self.newest_tick + 1..tick;
            self.newest_tick = tick;
            if !missing.is_empty() {
                self.report_gap(&missing)?;
            }
            if self.newest_tick >= self.reported_tick + PROGRESS_TICKS {
                self.report_progress(self.newest_tick)?;
            }
        }
        self.take_inputs()?;
        if let Some(more) = self.gap_warnings.take_suppressed(now_ns) {
            let text = format!("{more} more gaps in the log");
            self.ports.events_sent.warn(Tick(self.newest_tick), EventCode::MessagesLost, &text)?;
        }
        if self.newest_tick > self.reported_tick {
            self.report_progress(self.newest_tick)?;
        }
        Ok(came)
    }

    fn take_inputs(&mut self) -> Result<(), RecorderError> {
        while let Some(latched) = self.ports.latched.receive()? {
            self.lanes.run.latched(latched.message())?;
        }
        if let Some(readings) = &self.ports.readings {
            while let Some(reading) = readings.receive()? {
                self.lanes.run.reading(reading.message())?;
            }
        }
        while let Some(keyframe) = self.ports.keyframes.receive()? {
            self.lanes.run.keyframe(keyframe.bytes())?;
        }
        while let Some(removed) = self.ports.removed.receive()? {
            self.lanes.run.removed(removed.bytes())?;
        }
        Ok(())
    }

    fn take_frames(&mut self) -> Result<(), RecorderError> {
        while let Some(reply) = self.ports.replies.receive()? {
            self.lanes.run.drr_reply(reply.message())?;
        }
        let Some(frames) = &self.ports.frames else { return Ok(()) };
        while let Some(frame) = frames.receive()? {
            let sequence = frame.message().sequence;
            match self.recording.images {
                Images::Full if self.recording.keeps_image(sequence) => {
                    self.lanes.run.frame(frame.bytes())?
                }
                Images::Full | Images::HashOnly => self.lanes.run.frame_without_image(frame.message())?,
                Images::None => self.gaps.see(Topic::DrrFrame, 0, sequence),
            }
        }
        Ok(())
    }

    fn take_timing(&mut self) -> Result<(), RecorderError> {
        let (ports, timing, tick) = (&self.ports, &mut self.lanes.timing, Tick(self.newest_tick));
        let mut flight = self.flight.as_mut();
        let mut met = flight.as_mut().map_or_else(Vec::new, |flight| flight.granted());
        while let Some(message) = ports.tick_timing.receive()? {
            let of_tick = message.message().tick;
            self.gaps.see(Topic::TickTiming, 0, of_tick + 1);
            timing.message(Topic::TickTiming, Tick(of_tick), message.bytes())?;
            let cause = flight.as_ref().and_then(|flight| flight.triggers.timing(message.message()));
            met.extend(cause.map(|cause| TriggerEvent::of(Tick(of_tick), cause)));
        }
        for (topic, commands) in &ports.commands {
            copy_all(commands, |message| timing.command(topic, tick, message))?;
        }
        while let Some(message) = ports.frame_timing.receive()? {
            self.gaps.see(Topic::FrameTiming, 0, message.message().frame_sequence);
            timing.message(Topic::FrameTiming, tick, message.bytes())?;
        }
        for _ in 0..CLIENT_MESSAGES_PER_ROUND {
            let Some(message) = ports.events.receive_valid(|_| {})? else { break };
            self.gaps.see(Topic::Event, message.message().sender, message.message().sequence);
            timing.message(Topic::Event, tick, message.bytes())?;
            let cause = flight.as_ref().and_then(|flight| flight.triggers.event(message.message()));
            // Its sender may be ahead of the states read, but not further than they can be queued.
            let of_tick = Tick(message.message().tick).min(tick.saturating_add(RECORDER_QUEUE_TICKS));
            met.extend(cause.map(|cause| TriggerEvent::of(of_tick, cause)));
        }
        copy_all(&ports.controls, |message| {
            if let (Some(flight), Ok(request)) = (&mut flight, RunControl::read_from_bytes(message)) {
                flight.request(&request);
            }
            timing.message(Topic::RunControl, tick, message)
        })?;
        copy_all(&ports.control_replies, |message| {
            if let (Some(flight), Ok(reply)) = (&mut flight, RunControlReply::read_from_bytes(message)) {
                flight.reply(&reply);
            }
            timing.message(Topic::RunControlReply, tick, message)
        })?;
        while let Some(status) = ports.status.receive()? {
            self.run_has_ended |= status.message().phase() == Ok(Phase::Ended);
            timing.message(Topic::RunStatus, tick, status.bytes())?;
        }
        copy_all(&ports.requests, |message| timing.message(Topic::DrrRequest, tick, message))?;
        let Some(flight) = flight else { return Ok(()) };
        met.into_iter().try_for_each(|event| flight.trigger(event, &mut self.ports.events_sent))
    }

    /// Reports a gap at once, because the recording may no longer serve the run's purpose.
    fn report_gap(&mut self, missing: &Range<u64>) -> Result<(), RecorderError> {
        if !self.gap_warnings.allows(now_ns()) {
            return Ok(());
        }
        let text = format!(
            "ticks {} to {} are missing from the log: the recorder stalled for longer than its queues can \
             bridge",
            missing.start,
            missing.end - 1
        );
        Ok(self.ports.events_sent.warn(Tick(self.newest_tick), EventCode::MessagesLost, &text)?)
    }

    /// Reports messages that programs have sent on services that they do not own; the log does not record
    /// these.
    fn report_foreign_messages(&mut self) -> Result<(), RecorderError> {
        let foreign_messages = self.ports.foreign_messages();
        let new = foreign_messages - self.foreign_messages;
        if new > 0 && self.foreign_warnings.allows(now_ns()) {
            self.foreign_messages = foreign_messages;
            let text = format!(
                "{new} messages from other programs on services reserved for parts of the hub; not recorded"
            );
            self.ports.events_sent.warn(Tick(self.newest_tick), EventCode::RequestRefused, &text)?;
        }
        // The next report will include these.
        self.foreign_warnings.take_suppressed(now_ns);
        Ok(())
    }

    fn report_progress(&mut self, tick: u64) -> Result<(), RecorderError> {
        self.reported_tick = tick;
        let lost = self.lanes.run.lost().values().chain(self.gaps.lost().values());
        let lost_messages = lost.fold(0, |sum: u64, lost| sum.saturating_add(*lost));
        self.ports.progress.send(&Progress {
            tick,
            lost_messages,
            consumer: Participant::Part(Part::Recorder).code(),
            reserved: 0,
        })?;
        self.ports.physics.wake();
        Ok(())
    }

    /// Returns the path of the end reason, if the launcher has written it.
    fn reason_path(&self) -> Option<PathBuf> {
        reason_file::find(&self.session_folder, &self.output)
    }

    pub fn finish(self, recorded: RecordingExtent) -> Result<(), RecorderError> {
        // Another signal may arrive before the launcher's reason. If the run is over, the launcher is about
        // to write it.
        let limit = Instant::now() + ORPHANED_LIMIT;
        let launcher_lives = || host_is_alive(&self.session_folder);
        while self.run_has_ended && self.reason_path().is_none() && launcher_lives() && Instant::now() < limit
        {
            std::thread::sleep(POLL_PERIOD);
        }
        let reason_path = self.reason_path();
        let reason = match reason_path.as_deref().map(reason_file::read) {
            _ if recorded == RecordingExtent::UpToAnError => {
                EndReason::PartDied(Part::Recorder.name().to_owned())
            }
            Some(Ok(reason)) => reason,
            // No part ended the run, so the recorder itself was stopped.
            _ if launcher_lives() => EndReason::PartDied(Part::Recorder.name().to_owned()),
            // The launcher was killed before it could write a reason.
            _ => EndReason::PartDied(Part::Host.name().to_owned()),
        };
        // The reason file is no longer needed.
        reason_path.iter().for_each(|path| drop(std::fs::remove_file(path)));
        let lost = match self.flight {
            Some(flight) => flight.finish(self.lanes, &reason, self.gaps.lost())?,
            None => finish_lanes(self.lanes, &reason, self.gaps.lost())?,
        };
        sync_folder(&self.output)?;
        if lost.is_empty() {
            return Ok(());
        }
        let each: Vec<String> = lost.iter().map(|(topic, count)| format!("{count} of {topic}")).collect();
        Err(RecorderError::Gap { lost: each.join(", ") })
    }
}

/// Finishes both lanes; returns the messages that the run lane lacks, by topic.
fn finish_lanes(
    lanes: Lanes,
    reason: &EndReason,
    timing_lost: &BTreeMap<String, u64>,
) -> Result<BTreeMap<String, u64>, RecorderError> {
    let Lanes { run, timing } = lanes;
    let paths = [run.path().to_owned(), timing.path().to_owned()];
    let [run_path, timing_path] = paths.clone();
    let run = finish_file(run_path, run.finish(reason.clone(), &BTreeMap::new()));
    let timing = finish_file(timing_path, timing.finish(reason.clone(), timing_lost));
    let run = run.and_then(|run| timing.map(|_| run))?;
    if run.last_tick.is_none() && *reason == EndReason::Interrupted {
        // Nothing was recorded, so there is nothing to replay.
        paths.iter().for_each(|path| drop(std::fs::remove_file(path)));
    }
    Ok(run.lost)
}

/// Waits until the finished log is on disk.
fn finish_file(
    path: PathBuf,
    finished: Result<(EndMarker, BackgroundFile), LogError>,
) -> Result<EndMarker, LogError> {
    let (marker, file) = finished?;
    file.close().map_err(|source| LogError::Write { path, source })?;
    Ok(marker)
}

/// Copies a service's queued messages into the timing lane through `write`. A client message of the wrong
/// size is invalid and is not logged; its recipient has already reported it in an event.
fn copy_all<M: Message>(
    subscriber: &Subscriber<M>,
    mut write: impl FnMut(&[u8]) -> Result<(), LogError>,
) -> Result<(), RecorderError> {
    for _ in 0..CLIENT_MESSAGES_PER_ROUND {
        let Some(message) = subscriber.receive_valid(|_| {})? else { break };
        write(message.bytes())?;
    }
    Ok(())
}
