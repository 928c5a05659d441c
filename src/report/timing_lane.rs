//! Extracts the report's data from a `timing.mcap`.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;

use ipc_types::messages::layout::Message;
use ipc_types::messages::{
    Command, Event, EventCode, FrameTiming, Part, Participant, RunStatus, Severity, Tick, TickTiming,
};
use ipc_types::process::FIFO_REFUSED;
use recorder_proc::log_file::LogFile;
use recorder_proc::ring_files::SAVED_PREFIX;
use run_log::misses::Misses;
use run_log::{LogError, LogHeader, LogMessage, MessageStream, ReadOptions, Topic};
use zerocopy::FromBytes;

use super::ReportError;
use super::distribution::Distribution;
use super::timeline::Timeline;

/// Maximum number of bins for the step time over the run.
const TIME_BINS: usize = 240;
/// Minimum number of ticks per bin: a p99 needs about a hundred.
const BIN_TICKS: u64 = 100;
/// Number of latest warnings and errors whose text is kept.
const KEPT_WARNINGS: usize = 5;

/// Wall-clock data of a run. Durations in nanoseconds.
pub struct TimingLane {
    /// Header of the file; `None` if it could not be opened.
    pub header: Option<LogHeader>,
    /// Simulated time of the last message.
    pub end_ns: u64,
    /// Time of the physics step.
    pub step: Distribution,
    /// Step time over simulated time, two digits.
    pub step_over_time: Timeline<Distribution>,
    /// How late ticks began.
    pub lateness: Distribution,
    /// Time from state to command, per controller in the header's order.
    pub round_trips: Vec<Distribution>,
    /// Ticks that began more than a period late, and why.
    pub misses: Misses,
    /// Missed ticks over simulated time.
    pub missed_over_time: Timeline<u64>,
    /// Page faults of the physics process after its first tick.
    pub page_faults: u64,
    /// Render times of frames.
    pub render: Distribution,
    /// Rays traced for all frames.
    pub rays: u64,
    /// Frames traced in full.
    pub full_frames: u64,
    /// Commands as sent, of all controllers.
    pub commands: u64,
    /// Commands rejected, completely or in part.
    pub refused_commands: u64,
    /// The physics' count of rejected commands when the log began; `None` before it is known.
    refused_before: Option<u64>,
    /// Number of events by kind.
    pub events: BTreeMap<String, u64>,
    /// The physics' report that it runs without the `SCHED_FIFO` that was asked for.
    pub fifo_refused: Option<String>,
    /// The physics' reports that the tool has left the bone, with their ticks.
    pub breaches: Vec<(u64, String)>,
    /// Names of the logs that the recorder announced to save.
    pub announced: BTreeSet<String>,
    /// The last warnings and errors, one line each.
    pub warnings: VecDeque<String>,
    /// Messages lost, by topic, according to the end marker.
    pub lost: BTreeMap<String, u64>,
    /// Faults of the file, and how it ends unless it ends cleanly.
    pub notes: Vec<String>,
}

impl TimingLane {
    /// Reads the file once. Faults become notes.
    pub fn read(path: &Path) -> Result<TimingLane, ReportError> {
        let stream = match MessageStream::open(&LogFile::at(path), ReadOptions::default()) {
            Ok(stream) => stream,
            Err(error) => {
                let mut lane = TimingLane::empty(0, 1)?;
                lane.notes.push(error.to_string());
                return Ok(lane);
            }
        };
        let header = stream.header().clone();
        let mut lane = TimingLane::empty(header.controllers.len(), header.dt_ns)?;
        if header.first_tick > Tick::START {
            (lane.misses, lane.refused_before) = (Misses::from_tick(header.first_tick), None);
        }
        lane.header = Some(header);
        if let Err(error) = lane.read_messages(stream) {
            lane.notes.push(error.to_string());
        }
        Ok(lane)
    }

    fn empty(controllers: usize, dt_ns: u64) -> Result<TimingLane, ReportError> {
        let duration = Distribution::new(3)?;
        Ok(TimingLane {
            header: None,
            end_ns: 0,
            step: duration.clone(),
            step_over_time: Timeline::new(TIME_BINS, BIN_TICKS.saturating_mul(dt_ns), Distribution::new(2)?),
            lateness: duration.clone(),
            round_trips: vec![duration.clone(); controllers],
            misses: Misses::default(),
            missed_over_time: Timeline::new(2 * TIME_BINS, dt_ns, 0),
            page_faults: 0,
            render: duration,
            rays: 0,
            full_frames: 0,
            commands: 0,
            refused_commands: 0,
            refused_before: Some(0),
            events: BTreeMap::new(),
            fifo_refused: None,
            breaches: Vec::new(),
            announced: BTreeSet::new(),
            warnings: VecDeque::new(),
            lost: BTreeMap::new(),
            notes: Vec::new(),
        })
    }

    fn read_messages(&mut self, mut stream: MessageStream) -> Result<(), LogError> {
        while let Some(message) = stream.next_message()? {
            self.end_ns = self.end_ns.max(message.log_time_ns);
            self.add(&message);
        }
        let ending = stream.ending();
        if !ending.is_complete() {
            self.notes.push(format!("timing.mcap: {}", ending.describe()));
        }
        self.lost = ending.marker.as_ref().map(|marker| marker.lost.clone()).unwrap_or_default();
        Ok(())
    }

    fn add(&mut self, message: &LogMessage<'_>) {
        self.misses.take(message.known, message.body);
        match message.known {
            Some(Topic::TickTiming) => {
                if let Ok(timing) = TickTiming::read_from_bytes(message.body) {
                    self.tick(&timing, message.log_time_ns);
                }
            }
            Some(Topic::FrameTiming) => {
                if let Ok(timing) = FrameTiming::read_from_bytes(message.body) {
                    self.render.add(timing.render_ns);
                    self.rays = self.rays.saturating_add(timing.rays);
                    self.full_frames += u64::from(timing.full != 0);
                }
            }
            Some(Topic::RunStatus) => {
                if let Ok(status) = RunStatus::read_from_bytes(message.body) {
                    let before = *self.refused_before.get_or_insert(status.refused_commands);
                    let refused = status.refused_commands.saturating_sub(before);
                    self.refused_commands = self.refused_commands.max(refused);
                }
            }
            None if message.description.name == Command::DESCRIPTION.name => self.commands += 1,
            Some(Topic::Event) => {
                if let Ok((event, text)) = Event::read_from_prefix(message.body) {
                    self.event(&event, text);
                }
            }
            _ => (),
        }
    }

    fn tick(&mut self, timing: &TickTiming, time_ns: u64) {
        self.step.add(timing.step_ns);
        self.step_over_time.bin(time_ns).add(timing.step_ns);
        self.lateness.add(timing.wake_lateness_ns.max(0) as u64);
        for (distribution, &round_trip_ns) in self.round_trips.iter_mut().zip(&timing.round_trip_ns) {
            // 0: no command for this tick.
            if round_trip_ns > 0 {
                distribution.add(round_trip_ns);
            }
        }
        if timing.missed != 0 {
            *self.missed_over_time.bin(time_ns) += 1;
        }
        if self.step.count() > 1 {
            self.page_faults += u64::from(timing.page_faults);
        }
    }

    fn event(&mut self, event: &Event, text: &[u8]) {
        *self.events.entry(event_name(event)).or_default() += 1;
        let text = String::from_utf8_lossy(text);
        let text = text.trim_end_matches('\0').replace(char::is_control, " ");
        if text.starts_with(FIFO_REFUSED) && event.sender() == Some(Participant::Part(Part::Physics)) {
            self.fifo_refused = Some(text.clone());
        }
        let is_breach =
            event.code() == Ok(EventCode::Breach) && event.sender() == Some(Participant::Part(Part::Physics));
        if is_breach {
            self.breaches.push((event.tick, text.clone()));
        }
        let is_saved = event.code() == Ok(EventCode::LogSaved)
            && event.sender() == Some(Participant::Part(Part::Recorder));
        if let Some((name, _)) = text.split_once(':').filter(|_| is_saved)
            && name.starts_with(SAVED_PREFIX)
        {
            self.announced.insert(name.to_owned());
        }
        if event.severity >= Severity::Warning.code() {
            if self.warnings.len() == KEPT_WARNINGS {
                self.warnings.pop_front();
            }
            self.warnings.push_back(format!("tick {}, {}: {text}", event.tick, self.sender(event)));
        }
    }

    fn sender(&self, event: &Event) -> String {
        let controllers =
            self.header.as_ref().map(|header| header.controllers.as_slice()).unwrap_or_default();
        match event.sender() {
            Some(Participant::Part(Part::Drr)) => "DRR".to_string(),
            Some(Participant::Part(part)) => part.name().to_string(),
            Some(Participant::Controller(index)) => {
                let name = controllers.get(index.slot()).cloned();
                name.unwrap_or_else(|| format!("sender {}", event.sender))
            }
            None => format!("sender {}", event.sender),
        }
    }
}

/// Returns the name of the kind of event in the report.
fn event_name(event: &Event) -> String {
    event.code().map_or_else(|unknown| format!("code_{}", unknown.number), |code| code.word().to_string())
}
