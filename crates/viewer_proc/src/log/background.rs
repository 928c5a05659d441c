//! Reads a log from end to end while it is being shown; for a log of an hour this takes minutes.

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

/// Interval at which an idle reader checks for new work.
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// Number of messages between two progress updates.
const NOTE_EVERY: u64 = 4096;

/// A result of the background thread.
pub(super) enum BackgroundResult {
    /// Outline of the complete run lane.
    Outline(Box<Outline>),
    /// Marks of the timing lane.
    Marks(Vec<Mark>),
    /// Where the two logs diverge.
    Divergence(Mark),
    /// The run's volume.
    Volume(Box<Volume>),
    /// The volume is not available, with the reason; `None` if the scene has no volume.
    NoVolume(Option<String>),
    /// A notice for the user.
    Notice(String),
}

/// Reads one log, and again for fields requested later.
pub(super) struct Reader {
    pub(super) header: LogHeader,
    pub(super) run: PathBuf,
    pub(super) timing: PathBuf,
    pub(super) series: Arc<LogSeries>,
    /// Set when the viewer ends.
    pub(super) over: Arc<AtomicBool>,
    /// Receives the results; `None` for a second log, of which only fields are shown.
    pub(super) found: Option<Sender<BackgroundResult>>,
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
                    // A log without an end, or a damaged one, is read as far as possible, and its outline
                    // reports that.
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

    fn tell(&self, found: BackgroundResult) {
        if let Some(sender) = &self.found {
            // The viewer may be ending.
            let _ = sender.send(found);
        }
    }

    /// Makes one pass over a file for the fields of some topics; `each` also gets every message. Returns the
    /// stream at its end.
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
        // Read errors are among the faults in the stream's verdict.
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
        self.tell(BackgroundResult::Outline(Box::new(outline)));
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
        self.tell(BackgroundResult::Marks(events.marks()));
        Ok(())
    }
}

/// Finds where two logs diverge: reads both in step, up to there.
///
/// # Errors
/// One of the logs cannot be read.
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
