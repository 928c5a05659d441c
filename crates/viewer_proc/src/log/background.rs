//! Reads a log from end to end, beside the one that shows it: what a log of an hour takes minutes for.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::time::Duration;

use ipc_types::messages::State;
use recorder_proc::log_file::LogFile as LogSource;
use run_log::{LogError, LogHeader, MessageStream, ReadOptions, Topic};
use voxel_grid::Volume;
use zerocopy::FromBytes;

use super::marks::{Events, Mark, Outline, part};
use super::series::{Lane, LogSeries};

/// How often a reader that has nothing to read looks for new work.
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// Messages between two notes of how far it has come.
const NOTE_EVERY: u64 = 4096;

/// What the background has found.
pub(super) enum Found {
    /// Of the run lane, read whole.
    Outline(Box<Outline>),
    /// Marks of the timing lane.
    Marks(Vec<Mark>),
    /// Where the two logs part.
    Divergence(Mark),
    /// The volume that the run drilled.
    Volume(Box<Volume>),
    /// There is none: why it is not shown; nothing if the scene has none.
    NoVolume(Option<String>),
    /// Something for the user to know.
    Notice(String),
}

/// Reads one log, and again for fields that are asked for later.
pub(super) struct Reader {
    pub(super) header: LogHeader,
    pub(super) run: PathBuf,
    pub(super) timing: PathBuf,
    pub(super) series: Arc<LogSeries>,
    /// Whether the viewer ends.
    pub(super) over: Arc<AtomicBool>,
    /// Where marks go; none for a second log, of which only fields are shown.
    pub(super) found: Option<Sender<Found>>,
}

impl Reader {
    /// Reads until the viewer ends.
    pub(super) fn run(&self) {
        let mut is_first = true;
        while !self.is_over() {
            let wanted = [Lane::Run, Lane::Timing].map(|lane| (lane, self.series.begin(lane)));
            for (lane, topics) in wanted {
                let is_outline = is_first && self.found.is_some();
                if !topics.is_empty() || is_outline {
                    self.series.set_reading(Some(0.0));
                    let mut topics: Vec<String> = topics.into_iter().collect();
                    // A log without an end, or damaged, is read as far as it goes, and its outline says so.
                    let _ = match (lane, is_outline) {
                        (Lane::Run, true) => self.outline(&mut topics),
                        (Lane::Timing, true) => self.events(&mut topics),
                        (Lane::Run, false) => self.pass(&self.run, &topics, |_, _, _| {}).map(drop),
                        (Lane::Timing, false) => self.pass(&self.timing, &topics, |_, _, _| {}).map(drop),
                    };
                    self.series.end(lane);
                    self.series.set_reading(None);
                }
            }
            is_first = false;
            std::thread::sleep(LOOK_PERIOD);
        }
    }

    fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }

    fn tell(&self, found: Found) {
        if let Some(sender) = &self.found {
            // The viewer may be ending.
            let _ = sender.send(found);
        }
    }

    /// One pass over a file for the fields of some topics; `each` gets every message too. Returns the stream
    /// at its end.
    fn pass(
        &self,
        path: &Path,
        topics: &[String],
        mut each: impl FnMut(Option<Topic>, u64, &[u8]),
    ) -> Result<MessageStream, LogError> {
        let mut stream = MessageStream::open_topics(&LogSource::at(path), topics, ReadOptions::default())?;
        let (begin_ns, end_ns) = self.series.bounds_ns();
        let span = (end_ns - begin_ns).max(1) as f64;
        let mut count = 0u64;
        // A read error is among the faults of the stream's verdict.
        while let Ok(Some(message)) = stream.next_message() {
            self.series.add(message.topic, message.log_time_ns, message.body);
            each(message.known, message.log_time_ns, message.body);
            count += 1;
            if count.is_multiple_of(NOTE_EVERY) {
                let share = message.log_time_ns.saturating_sub(begin_ns) as f64 / span;
                self.series.set_reading(Some(share.min(1.0)));
                if self.is_over() {
                    break;
                }
            }
        }
        Ok(stream)
    }

    fn outline(&self, topics: &mut Vec<String>) -> Result<(), LogError> {
        topics.extend([Topic::State, Topic::Removed, Topic::DrrFrame].map(|topic| topic.name().to_owned()));
        let mut outline = Outline::new(self.header.clone());
        let stream =
            self.pass(&self.run, topics, |topic, time_ns, body| outline.add(topic, time_ns, body))?;
        outline.end(&stream.verdict());
        self.tell(Found::Outline(Box::new(outline)));
        Ok(())
    }

    fn events(&self, topics: &mut Vec<String>) -> Result<(), LogError> {
        topics.extend([Topic::Event, Topic::TickTiming].map(|topic| topic.name().to_owned()));
        let mut events = Events::new(self.header.dt_ns);
        self.pass(&self.timing, topics, |topic, _, body| {
            if let Some((time_ns, letter)) = events.add(topic, body) {
                self.series.add_miss(time_ns, letter);
            }
        })?;
        self.tell(Found::Marks(events.marks()));
        Ok(())
    }
}

/// Where two logs part: reads both side by side, up to there.
///
/// # Errors
/// One of them cannot be read.
pub(super) fn divergence(first: &Path, second: &Path, over: &AtomicBool) -> Result<Option<Mark>, LogError> {
    let open = |path: &Path| {
        let topics = [Topic::State.name().to_owned()];
        MessageStream::open_topics(&LogSource::at(path), &topics, ReadOptions::default())
    };
    let (mut first, mut second) = (open(first)?, open(second)?);
    let dt_ns = first.header().dt_ns;
    let states = |stream: &mut MessageStream| {
        let message = stream.next_message().ok().flatten().filter(|_| !over.load(Ordering::Relaxed))?;
        let state = State::read_from_bytes(message.body).ok()?;
        Some((state.tick, state.hash))
    };
    let found = part(core::iter::from_fn(|| states(&mut first)), core::iter::from_fn(|| states(&mut second)));
    Ok(found.filter(|_| !over.load(Ordering::Relaxed)).map(|(tick, how)| Mark {
        time_ns: tick.saturating_mul(dt_ns),
        kind: "divergence",
        text: format!("the two runs {how} tick {tick}"),
    }))
}
