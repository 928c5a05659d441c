//! Shows a log at the position of its time line.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use ipc_types::clock::now_ns;
use ipc_types::messages::{Frame, State};
use ipc_types::process::EndRequest;
use run_log::Topic;
use serde_json::{Value, json};
use voxel_grid::Volume;
use zerocopy::FromBytes;

use super::background::BackgroundResult;
use super::bone::LogBone;
use super::compare::{comparison, first_difference};
use super::file::{LogFile, Logged, PlayError, Reading};
use super::marks::{Mark, Outline};
use super::player::Player;
use super::series::{Lane, LogSeries, SeriesRequest};
use crate::board::Board;
use crate::calls::{Call, CallSender, Calls, call_queue};
use crate::channels::{COMPARE, FRAME_STATE, INFO, PLAYBACK, SECOND, SECOND_TOPICS, VIEW_SENSOR, VIEW_STATE};
use crate::error::ViewerError;
use crate::info::VolumeBox;
use crate::left::IdleTimer;
use crate::scene_update::Drawer;
use crate::services::{Reply, Request};
use crate::slice::{NO_VOLUME, Slicer};
use crate::surface::bone::volume_box;
use crate::threads;

/// Time between two polls.
const POLL_PERIOD: Duration = Duration::from_millis(8);
/// Minimum time between two playback messages.
const PLAYBACK_PERIOD: Duration = Duration::from_millis(33);
/// Longer jumps show only their destination, not everything in between.
const LONGEST_STRIDE_NS: u64 = 500_000_000;
/// Slots of the playback topic: a new client gets first the marks, then the position.
const MARKS_SLOT: u32 = 0;
const POSITION_SLOT: u32 = 1;
/// How much history other viewers get after a jump, and when. The delay is there because dragging the slider
/// causes many jumps.
const HISTORY_NS: u64 = 10_000_000_000;
const HISTORY_STATES: u64 = 400;
const HISTORY_DELAY: Duration = Duration::from_millis(150);
/// Topics whose newest message is shown at the current time.
const SHOWN: [Topic; 5] = [Topic::Latched, Topic::State, Topic::DrrReply, Topic::DrrFrame, Topic::DrrImage];
/// Replies to a slice request while the drilled voxels are unknown, or if there is no volume to show.
const READING: &str = "the log is being read";
const OTHER_VOLUME: &str = "the run's volume is not available; see the messages";
/// Maximum number of waiting field requests of owners, and of watchers.
const SERIES_QUEUE: usize = 16;
/// Interval at which the thread that answers them looks for the next one and for the end.
const ANSWER_LOOK: Duration = Duration::from_millis(5);

/// A log being shown.
pub(super) struct ShownLog {
    pub(super) run: LogFile,
    pub(super) timing: Option<LogFile>,
    pub(super) series: Arc<LogSeries>,
}

/// Both logs, for the thread that answers field requests.
pub(super) type Logs = Arc<(ShownLog, Option<ShownLog>)>;

pub(super) struct LogPlayback {
    board: Arc<Board>,
    logs: Logs,
    player: Player,
    /// Receives the background results. A result waits here until the other one that it needs has arrived.
    found: Receiver<BackgroundResult>,
    outline: Option<Outline>,
    volume: Option<Volume>,
    threshold_hu: i16,
    bone: Option<LogBone>,
    slicer: Slicer,
    /// Reply to slice requests while there is no bone.
    no_slices: &'static str,
    /// Builds the scene message with the volume's box.
    info: Box<dyn Fn(&VolumeBox) -> Value>,
    /// Time up to which messages have been published; `None` before the first.
    shown_ns: Option<u64>,
    /// Cursors through the logs; empty after a jump until the time moves on.
    streams: Vec<Stream>,
    drawer: Drawer,
    /// Whether the current position is yet to be drawn for other viewers.
    undrawn: bool,
    /// Time of the last jump, until its history has been sent.
    jumped: Option<Instant>,
    told: Option<(Instant, PlaybackStatus)>,
    /// Whether the marks have changed since they were last published.
    new_marks: bool,
}

/// The playback status last published.
#[derive(Clone, PartialEq)]
struct PlaybackStatus {
    time_ns: u64,
    playing: bool,
    speed: f64,
    reading: Option<f64>,
}

/// A cursor through a log, with the next message past the current position.
struct Stream {
    /// Prefix of its topics.
    prefix: &'static str,
    reading: Reading,
    ahead: Option<Logged>,
}

/// The scene's settings for the displayed objects.
pub(super) struct Scenery {
    pub(super) threshold_hu: i16,
    pub(super) drawer: Drawer,
    pub(super) info: Box<dyn Fn(&VolumeBox) -> Value>,
}

impl LogPlayback {
    pub(super) fn new(
        board: Arc<Board>,
        logs: Logs,
        dt_ns: u64,
        scenery: Scenery,
        found: Receiver<BackgroundResult>,
    ) -> LogPlayback {
        let (begin_ns, end_ns) = logs.0.run.bounds_ns();
        // The longer of two logs sets the length.
        let end_ns = logs.1.as_ref().map_or(end_ns, |second| end_ns.max(second.run.bounds_ns().1));
        LogPlayback {
            board,
            logs,
            player: Player::new(begin_ns, end_ns, dt_ns, Vec::new()),
            found,
            outline: None,
            volume: None,
            threshold_hu: scenery.threshold_hu,
            bone: None,
            slicer: Slicer::new(now_ns()),
            no_slices: READING,
            info: scenery.info,
            shown_ns: None,
            streams: Vec::new(),
            drawer: scenery.drawer,
            undrawn: true,
            jumped: None,
            told: None,
            new_marks: true,
        }
    }

    pub(super) fn run(
        &mut self,
        called: &Calls,
        end: &EndRequest,
        over: &AtomicBool,
        left: Option<IdleTimer>,
    ) -> Result<(), ViewerError> {
        let (asked, asking) = call_queue(SERIES_QUEUE);
        let logs = Arc::clone(&self.logs);
        std::thread::scope(|scope| {
            threads::start_in(scope, "series", move || answer_series(&logs, &asking, over))?;
            let shown = self.play(called, &asked, end, left);
            over.store(true, Ordering::Relaxed);
            Ok(shown?)
        })
    }

    fn play(
        &mut self,
        called: &Calls,
        asked: &CallSender,
        end: &EndRequest,
        mut left: Option<IdleTimer>,
    ) -> Result<(), PlayError> {
        let mut last = Instant::now();
        let board = Arc::clone(&self.board);
        let mut has_been_left = || left.as_mut().is_some_and(|left| left.is_over(board.client_count()));
        while !end.is_set() && !has_been_left() {
            while let Ok(call) = called.try_recv() {
                self.dispatch(call, asked);
            }
            while let Ok(found) = self.found.try_recv() {
                self.take(found)?;
            }
            self.player.advance(last.elapsed());
            last = Instant::now();
            self.show()?;
            self.send_history()?;
            let more = self.bone.as_mut().is_some_and(|bone| bone.publish(&self.board));
            self.tell()?;
            match &self.bone {
                Some(bone) => bone.answer(&mut self.slicer),
                None => self.slicer.refuse(self.no_slices),
            }
            if !more {
                std::thread::sleep(POLL_PERIOD);
            }
        }
        Ok(())
    }

    fn dispatch(&mut self, call: Call, asked: &CallSender) {
        let outcome = match &call.request {
            Request::Playback(request) => self.player.apply(request).map(|()| Reply::Done),
            Request::Series(_) => {
                if let Err(full) = asked.try_send(call) {
                    let (mpsc::TrySendError::Full(call) | mpsc::TrySendError::Disconnected(call)) = full;
                    let _ = call.answer.send(Err("busy with earlier field requests".to_owned()));
                }
                return;
            }
            Request::Slice(_) => return self.slicer.add(call),
            _ => Err("this is a log: a recorded run cannot be controlled".to_owned()),
        };
        // The client may have disconnected.
        let _ = call.answer.send(outcome);
    }

    fn take(&mut self, found: BackgroundResult) -> Result<(), PlayError> {
        match found {
            BackgroundResult::Outline(outline) => {
                outline.notices.iter().for_each(|text| self.board.notice("warning", text));
                self.add_marks(outline.marks.clone());
                self.outline = Some(*outline);
            }
            BackgroundResult::Marks(marks) => self.add_marks(marks),
            BackgroundResult::Divergence(mut mark) => {
                if let Some(second) = &self.logs.1 {
                    mark.text += &first_difference(&self.logs.0.run, &second.run, mark.time_ns)?;
                }
                self.add_marks(vec![mark]);
            }
            BackgroundResult::Volume(volume) => {
                self.board.publish_json(INFO, &(self.info)(&volume_box(&volume.grid)));
                self.volume = Some(*volume);
            }
            BackgroundResult::NoVolume(refusal) => match refusal {
                Some(text) => {
                    self.no_slices = OTHER_VOLUME;
                    self.board.notice("warning", &format!("the bone is not shown: {text}"));
                }
                None => self.no_slices = NO_VOLUME,
            },
            BackgroundResult::Notice(text) => self.board.notice("warning", &text),
        }
        // The bone needs both its voxels and the times at which they were drilled.
        if self.volume.is_some()
            && let Some(outline) = &mut self.outline
        {
            let removals = core::mem::take(&mut outline.removals);
            let mut bone = self.volume.take().map(|volume| LogBone::new(volume, self.threshold_hu, removals));
            if let (Some(bone), Some(now)) = (&mut bone, self.shown_ns) {
                bone.go_to(now);
            }
            self.bone = bone;
        }
        Ok(())
    }

    fn add_marks(&mut self, marks: Vec<Mark>) {
        self.player.marks.extend(marks);
        self.player.marks.sort_by_key(|mark| mark.time_ns);
        self.new_marks = true;
    }

    /// Updates the board to the current position.
    fn show(&mut self) -> Result<(), PlayError> {
        let now = self.player.time_ns();
        if self.shown_ns == Some(now) {
            return if self.undrawn { self.draw(now) } else { Ok(()) };
        }
        self.board.set_time_ns(now);
        match self.shown_ns.filter(|shown| now.checked_sub(*shown).is_some_and(|it| it <= LONGEST_STRIDE_NS))
        {
            Some(shown) => self.stream_to(shown, now)?,
            None => self.jump_to(now)?,
        }
        self.shown_ns = Some(now);
        if let Some(bone) = &mut self.bone {
            bone.go_to(now);
        }
        self.draw(now)
    }

    /// Draws the tool for other viewers: at once if one is subscribed, otherwise as soon as one subscribes.
    fn draw(&mut self, now: u64) -> Result<(), PlayError> {
        self.undrawn = !self.drawer.is_due(&self.board);
        if !self.undrawn
            && let Some(message) = self.logs.0.run.newest(Topic::State, now)?
            && let Ok(state) = State::read_from_bytes(message.body())
        {
            self.drawer.draw(&state, message.time_ns, &self.board);
        }
        Ok(())
    }

    fn stream_to(&mut self, shown: u64, now: u64) -> Result<(), PlayError> {
        if self.streams.is_empty() {
            self.open_streams(shown)?;
        }
        for stream in &mut self.streams {
            while let Some(message) = stream.ahead.take_if(|message| message.time_ns <= now) {
                let topic = format!("{}{}", stream.prefix, message.topic);
                if topic == Topic::DrrFrame.name() {
                    publish_frame_state(&self.board, &self.logs.0.run, self.player.dt_ns, &message)?;
                }
                self.board.publish(&topic, message.time_ns, 0, message.payload);
                stream.ahead = stream.reading.next_message()?;
            }
        }
        Ok(())
    }

    fn open_streams(&mut self, after_ns: u64) -> Result<(), PlayError> {
        let logs = Arc::clone(&self.logs);
        let second_topics = SECOND_TOPICS.map(Topic::name);
        let second = logs.1.as_ref().map(|second| (SECOND, &second.run, second_topics.as_slice()));
        let own = core::iter::once(&logs.0.run).chain(&logs.0.timing).map(|log| ("", log, [].as_slice()));
        for (prefix, log, topics) in own.chain(second) {
            let mut reading = log.after(Some(after_ns), topics)?;
            let ahead = reading.next_message()?;
            self.streams.push(Stream { prefix, reading, ahead });
        }
        Ok(())
    }

    fn jump_to(&mut self, now: u64) -> Result<(), PlayError> {
        self.jumped = Some(Instant::now());
        self.streams.clear();
        self.show_newest(now)
    }

    fn show_newest(&self, now: u64) -> Result<(), PlayError> {
        let second = self.logs.1.as_ref().map(|second| (SECOND, &second.run, SECOND_TOPICS.as_slice()));
        for (prefix, log, topics) in core::iter::once(("", &self.logs.0.run, SHOWN.as_slice())).chain(second)
        {
            for topic in topics {
                if let Some(message) = log.newest(*topic, now)? {
                    if *topic == Topic::DrrFrame && prefix.is_empty() {
                        publish_frame_state(&self.board, log, self.player.dt_ns, &message)?;
                    }
                    self.board.publish(&format!("{prefix}{topic}"), message.time_ns, 0, message.payload);
                }
            }
        }
        Ok(())
    }

    /// Sends the history before a jump to other viewers, which plot what they receive: a sample of the states
    /// and all tick timings.
    fn send_history(&mut self) -> Result<(), PlayError> {
        if self.jumped.is_none_or(|jumped| jumped.elapsed() < HISTORY_DELAY) {
            return Ok(());
        }
        self.jumped = None;
        let now = self.player.time_ns();
        let from = now.saturating_sub(HISTORY_NS);
        let every = (HISTORY_NS / self.player.dt_ns / HISTORY_STATES).max(1);
        let timing = self.logs.0.timing.as_ref().map(|log| (log, Topic::TickTiming, 1));
        let both = core::iter::once((&self.logs.0.run, Topic::State, every)).chain(timing);
        for (log, topic, every) in both.filter(|(_, topic, _)| self.board.wants(topic.name())) {
            let mut reading = log.after(from.checked_sub(1), &[topic.name()])?;
            let mut number = 0;
            while let Some(message) = reading.next_message()?.filter(|message| message.time_ns <= now) {
                if number % every == 0 {
                    self.board.publish(topic.name(), message.time_ns, 0, message.payload);
                }
                number += 1;
            }
        }
        self.show_newest(now)
    }

    /// Publishes the position if it has changed, with the state and the comparison at that time, so that
    /// slider, readouts and table agree. Publishes the marks only if they have changed.
    fn tell(&mut self) -> Result<(), PlayError> {
        let now = PlaybackStatus {
            time_ns: self.player.time_ns(),
            playing: self.player.playing,
            speed: self.player.speed,
            reading: self.logs.0.series.reading().map(|share| (share * 100.0).floor() / 100.0),
        };
        let due = match &self.told {
            None => true,
            Some((told, before)) => {
                let command = before.playing != now.playing || before.speed != now.speed;
                command || (*before != now || self.new_marks) && told.elapsed() >= PLAYBACK_PERIOD
            }
        };
        if !due {
            return Ok(());
        }
        let moved = self.told.as_ref().is_none_or(|(_, before)| before.time_ns != now.time_ns);
        if moved {
            self.publish_state(now.time_ns)?;
        }
        let (missed, missed_total) = self.logs.0.series.missed(now.time_ns);
        let mut value = json!({
            "begin_ns": self.player.begin_ns, "end_ns": self.player.end_ns, "time_ns": now.time_ns,
            "playing": now.playing, "speed": now.speed, "reading": now.reading,
            "missed": missed, "missed_total": missed_total, "has_timing": self.logs.0.timing.is_some(),
            "second": self.logs.1.is_some(),
        });
        self.board.publish(PLAYBACK, now.time_ns, POSITION_SLOT, value.to_string().into_bytes());
        if self.new_marks {
            self.new_marks = false;
            value["events"] = Value::Array(self.player.marks.iter().map(Mark::json).collect());
            self.board.publish(PLAYBACK, now.time_ns, MARKS_SLOT, value.to_string().into_bytes());
        }
        self.told = Some((Instant::now(), now));
        Ok(())
    }

    fn publish_state(&self, now: u64) -> Result<(), PlayError> {
        // The reading of the clearances is the last one of each tick.
        if let Some(message) = self.logs.0.run.newest(Topic::Sensor, now)? {
            self.board.publish(VIEW_SENSOR, message.time_ns, 0, message.payload);
        }
        let second = self.logs.1.as_ref().map(|second| (SECOND, &second.run));
        for (prefix, log) in core::iter::once(("", &self.logs.0.run)).chain(second) {
            if let Some(message) = log.newest(Topic::State, now)? {
                self.board.publish(&format!("{prefix}{VIEW_STATE}"), message.time_ns, 0, message.payload);
            }
        }
        if let Some(second) = &self.logs.1 {
            self.board.publish_json(COMPARE, &comparison(&self.logs.0.run, &second.run, now)?);
        }
        Ok(())
    }
}

/// Publishes the state of the tick at which a frame was taken; the tool may have moved since.
fn publish_frame_state(board: &Board, log: &LogFile, dt_ns: u64, frame: &Logged) -> Result<(), PlayError> {
    let Ok((frame, _)) = Frame::read_from_prefix(frame.body()) else { return Ok(()) };
    if let Some(state) = log.newest(Topic::State, frame.tick.saturating_mul(dt_ns))? {
        board.publish(FRAME_STATE, state.time_ns, 0, state.payload);
    }
    Ok(())
}

/// Answers field requests until the viewer ends.
fn answer_series(logs: &Logs, asked: &Calls, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let Ok(call) = asked.try_recv() else {
            std::thread::sleep(ANSWER_LOOK);
            continue;
        };
        let Request::Series(request) = &call.request else { continue };
        let _ = call.answer.send(answer(logs, request).map(Reply::Json));
    }
}

fn answer(logs: &Logs, request: &SeriesRequest) -> Result<String, String> {
    let (first, second) = logs.as_ref();
    let shown = if request.second { second.as_ref().ok_or("no second log is open")? } else { first };
    shown.series.answer(request, |lane| match lane {
        Lane::Run => Some(&shown.run),
        Lane::Timing => shown.timing.as_ref(),
    })
}
