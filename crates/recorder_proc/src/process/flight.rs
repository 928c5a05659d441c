//! The flight recorder: keeps the last seconds in overlapping logs ([`Ring`]) and saves those that a trigger
//! chooses.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use hub::rate_limit::WarningLimit;
use ipc_types::clock::now_ns;
use ipc_types::messages::{
    ControlAction, ControlStatus, EventCode, RunControl, RunControlReply, Severity, Tick,
};
use ipc_types::process::EventSender;
use ipc_types::scene::{Images, Mode, Scene};
use run_log::ring::{Fate, Ring, Save, Triggered};
use run_log::triggers::Triggers;
use run_log::{EndMarker, EndReason, LogError, LogHeader, RunLog, TimingLog, frame_lag_ticks};

use super::RecorderError;
use super::recorder::LATE_TICKS;
use crate::background::BackgroundFile;
use crate::log_file::index_beside;
use crate::ring_files::{Disposal, LANES, LogFiles, RingFiles};

/// The two lanes being written.
pub(super) struct Lanes {
    pub run: RunLog<BackgroundFile>,
    pub timing: TimingLog<BackgroundFile>,
}

/// Something that saves the log.
pub(super) struct TriggerEvent {
    pub tick: Tick,
    pub cause: String,
    /// Ticks to record after it; `None`: as many as the scene says.
    pub after_ticks: Option<u64>,
}

impl TriggerEvent {
    /// Returns a trigger of the scene.
    pub fn of(tick: Tick, cause: &str) -> TriggerEvent {
        TriggerEvent { tick, cause: cause.to_owned(), after_ticks: None }
    }
}

/// The flight recorder of a run.
pub(super) struct Flight {
    pub triggers: Triggers,
    ring: Ring,
    files: RingFiles,
    /// Folders of the open logs, oldest first.
    folders: Vec<PathBuf>,
    /// Number of logs asked for so far, and whether the last one is still to come.
    asked: u64,
    is_asked: bool,
    /// Folder and timing lane of the log that begins at the next keyframe.
    next: Option<(PathBuf, BackgroundFile)>,
    mode: Mode,
    period_ticks: u64,
    after_ticks: u64,
    /// How much later than the tick that it shows a frame is written.
    frame_lag_ticks: u64,
    /// Requests to save: id and ticks after it.
    requests: BTreeMap<u64, u64>,
    /// Replies whose requests may still be in the queue.
    replies: Vec<RunControlReply>,
    warnings: WarningLimit,
    /// Messages that saved logs lack, by topic.
    lost: BTreeMap<String, u64>,
}

/// Number of requests remembered until their replies.
const REQUESTS_REMEMBERED: usize = 64;

impl Flight {
    /// Starts the flight recorder of a scene, whose first log is in `folder`; `None` if it keeps everything.
    ///
    /// # Errors
    /// A malformed trigger; the system refuses a thread.
    pub fn of(
        scene: &Scene,
        header: &LogHeader,
        output: &Path,
        folder: &Path,
    ) -> Result<Option<Flight>, RecorderError> {
        let recording = &scene.recording;
        if recording.ring_s == 0.0 {
            return Ok(None);
        }
        let triggers = Triggers::parse(&recording.triggers).map_err(RecorderError::Trigger)?;
        let files = RingFiles::start(output, recording.saved_at_most)
            .map_err(|source| LogError::Create { path: folder.to_owned(), source })?;
        let ticks = |seconds: f64| (seconds / scene.dt_s()).ceil() as u64;
        let has_frames = scene.drr.is_some() && recording.images != Images::None;
        let period_ticks = ticks(recording.ring_s);
        Ok(Some(Flight {
            triggers,
            ring: Ring::new(period_ticks, LATE_TICKS, recording.saved_at_most),
            files,
            folders: vec![folder.to_owned()],
            asked: 1,
            is_asked: false,
            next: None,
            mode: scene.run.mode,
            period_ticks,
            after_ticks: ticks(recording.after_s),
            frame_lag_ticks: if has_frames { frame_lag_ticks(header) } else { 0 },
            requests: BTreeMap::new(),
            replies: Vec::new(),
            warnings: WarningLimit::default(),
            lost: BTreeMap::new(),
        }))
    }

    /// Begins logs, as far as due. `timing_lost` counts what the timing lane lacks.
    pub fn begin(
        &mut self,
        lanes: &mut Lanes,
        timing_lost: &BTreeMap<String, u64>,
    ) -> Result<(), RecorderError> {
        self.note_begun(lanes, timing_lost)?;
        self.provide_next(lanes)
    }

    /// Saves and drops logs, as far as due, once both lanes have what belongs to the last state.
    pub fn end_due(
        &mut self,
        lanes: &mut Lanes,
        timing_lost: &BTreeMap<String, u64>,
    ) -> Result<(), RecorderError> {
        let tick = lanes.run.last_state().map_or(Tick::START, |state| Tick(state.tick));
        for place in self.ring.unneeded(tick) {
            self.remove(lanes, place);
        }
        while let Some((place, save)) = self.ring.complete(tick) {
            self.save(lanes, place, &save, timing_lost)?;
        }
        Ok(())
    }

    /// Begins the timing lane of a log whose run lane has begun.
    fn note_begun(
        &mut self,
        lanes: &mut Lanes,
        timing_lost: &BTreeMap<String, u64>,
    ) -> Result<(), RecorderError> {
        if lanes.run.has_next() {
            return Ok(());
        }
        let Some((folder, timing)) = self.next.take() else { return Ok(()) };
        let Some(first_tick) = lanes.run.first_ticks().last() else { return Ok(()) };
        let path = folder.join(LANES[1]);
        lanes.timing.begin_another(first_tick, timing, &path, index_beside(&path), timing_lost)?;
        self.folders.push(folder);
        self.ring.begun(first_tick);
        Ok(())
    }

    /// Gives the run lane the file of the next log. Lockstep waits for it, so that where logs begin does not
    /// depend on the disk.
    fn provide_next(&mut self, lanes: &mut Lanes) -> Result<(), RecorderError> {
        if self.next.is_some() {
            return Ok(());
        }
        if !std::mem::replace(&mut self.is_asked, true) {
            self.asked += 1;
            self.files.ask(self.asked);
        }
        let created = match self.mode {
            Mode::Lockstep => self.files.wait()?,
            Mode::Realtime => self.files.asked()?,
        };
        let Some(LogFiles { folder, run, timing }) = created else { return Ok(()) };
        self.is_asked = false;
        let path = folder.join(LANES[0]);
        lanes.run.begin_another(self.ring.next_begin(), run, &path, index_beside(&path));
        self.next = Some((folder, timing));
        Ok(())
    }

    /// Saves what is before and after a trigger, and reports it.
    pub fn trigger(&mut self, event: TriggerEvent, events: &mut EventSender) -> Result<(), RecorderError> {
        let TriggerEvent { tick, cause, after_ticks } = event;
        let is_asked = after_ticks.is_some();
        let after_ticks = after_ticks.unwrap_or(self.after_ticks).min(self.period_ticks);
        let triggered = self.ring.trigger(tick, after_ticks.saturating_add(self.frame_lag_ticks), &cause);
        let (severity, text) = match triggered {
            Triggered::Full => (
                Severity::Warning,
                format!("not saved: {cause}; `recording.saved_at_most` logs have been saved"),
            ),
            Triggered::Saving { number, first_tick, until, .. } => {
                (Severity::Info, format!("saved-{number}: ticks {first_tick} to {until} or later: {cause}"))
            }
        };
        let is_first = matches!(triggered, Triggered::Saving { is_extended: false, .. });
        if is_first || is_asked || self.warnings.allows(now_ns()) {
            events.send(tick, severity, EventCode::LogSaved, &text)?;
        }
        Ok(())
    }

    /// Notes a client's request, if it is one to save the log.
    pub fn request(&mut self, request: &RunControl) {
        if request.action() == Ok(ControlAction::Save) {
            self.requests.insert(request.request_id, request.ticks);
            if self.requests.len() > REQUESTS_REMEMBERED {
                self.requests.pop_first();
            }
        }
    }

    /// Notes the reply to a request, if it is one to save the log.
    pub fn reply(&mut self, reply: &RunControlReply) {
        if reply.action() == Ok(ControlAction::Save) && reply.status() == Ok(ControlStatus::Done) {
            self.replies.push(*reply);
        }
    }

    /// Returns the saves that were granted before the requests were last read.
    pub fn granted(&mut self) -> Vec<TriggerEvent> {
        let granted = |reply: RunControlReply| {
            let ticks = self.requests.remove(&reply.request_id).filter(|ticks| *ticks > 0);
            let after_ticks = Some(ticks.unwrap_or(self.after_ticks));
            TriggerEvent { tick: Tick(reply.tick), cause: "requested by a client".to_owned(), after_ticks }
        };
        std::mem::take(&mut self.replies).into_iter().map(granted).collect()
    }

    fn save(
        &mut self,
        lanes: &mut Lanes,
        place: usize,
        save: &Save,
        timing_lost: &BTreeMap<String, u64>,
    ) -> Result<(), RecorderError> {
        let reason = EndReason::Saved(save.to_string());
        self.close(lanes, place, &reason, Disposal::Save(save.number), timing_lost).map(drop)
    }

    /// Ends both lanes of an open log and hands them over; returns the end of the run lane.
    fn close(
        &mut self,
        lanes: &mut Lanes,
        place: usize,
        reason: &EndReason,
        disposal: Disposal,
        timing_lost: &BTreeMap<String, u64>,
    ) -> Result<EndMarker, RecorderError> {
        let (marker, run) = lanes.run.end(place, reason.clone())?;
        let (_, timing) = lanes.timing.end(place, reason.clone(), timing_lost)?;
        for (topic, count) in &marker.lost {
            *self.lost.entry(topic.clone()).or_default() += count;
        }
        self.files.dispose(LogFiles { folder: self.folders.remove(place), run, timing }, disposal);
        Ok(marker)
    }

    fn remove(&mut self, lanes: &mut Lanes, place: usize) {
        let (run, timing) = (lanes.run.discard(place), lanes.timing.discard(place));
        self.files.dispose(LogFiles { folder: self.folders.remove(place), run, timing }, Disposal::Remove);
    }

    /// Ends all logs; that of the end of the run moves into the run's folder. Returns the messages that saved
    /// logs lack, by topic.
    pub fn finish(
        mut self,
        mut lanes: Lanes,
        reason: &EndReason,
        timing_lost: &BTreeMap<String, u64>,
    ) -> Result<BTreeMap<String, u64>, RecorderError> {
        self.note_begun(&mut lanes, timing_lost)?;
        lanes.run.drain()?;
        let last = lanes.run.last_state().map(|state| Tick(state.tick));
        // An interrupted run without a state leaves nothing to replay.
        let is_kept = last.is_some() || *reason != EndReason::Interrupted;
        let fates = self.ring.end(last.unwrap_or(Tick::START));
        for (place, fate) in fates.into_iter().enumerate().rev() {
            match fate {
                Fate::Last if is_kept => {
                    self.close(&mut lanes, place, reason, Disposal::MoveUp, timing_lost)?;
                }
                Fate::Saved(save) => self.save(&mut lanes, place, &save, timing_lost)?,
                Fate::Last | Fate::Dropped => self.remove(&mut lanes, place),
            }
        }
        if let Some((folder, timing)) = self.next.take() {
            // Its run lane was dropped with the lanes; the file remains.
            drop(timing);
            std::fs::remove_dir_all(&folder).map_err(|source| LogError::Write { path: folder, source })?;
        }
        self.files.finish()?;
        Ok(self.lost)
    }
}
