//! Logs on a time line: play, seek, step, and compare two of them.

mod bone;
pub mod file;
pub mod marks;
pub mod player;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use ipc_types::clock::now_ns;
use ipc_types::layout::Message;
use ipc_types::messages::{Latched, State, Tick};
use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;
use recorder_proc::log_file::log_path;
use run_log::fields::Scalar;
use run_log::{Topic, difference};
use serde_json::{Value, json};
use zerocopy::FromBytes;

use crate::board::Board;
use crate::channels::{COMPARE, Channels, INFO, PLAYBACK, SECOND, SECOND_TOPICS};
use crate::error::ViewerError;
use crate::info::{Origin, ToolShape, info};
use crate::live::CALL_QUEUE;
use crate::scene_update::Drawer;
use crate::server::{Server, ServerOptions};
use crate::services::{Call, Calls, Reply, Request};
use crate::slice::Slicer;
use crate::surface::bone::volume_box;
use bone::LogBone;
use file::{LogFile, Logged, PlayError, Reading};
use marks::{Mark, Outline, outline, timing_marks};
use player::Player;

pub use bone::LogVolume;

/// Time between two polls.
const POLL_PERIOD: Duration = Duration::from_millis(8);
/// Minimum time between two playback messages.
const PLAYBACK_PERIOD: Duration = Duration::from_millis(33);
/// A longer jump shows only its destination, not everything in between.
const LONGEST_STRIDE_NS: u64 = 500_000_000;
/// Slots of the playback topic: a new client gets the marks first, then the position.
const MARKS_SLOT: u32 = 0;
const POSITION_SLOT: u32 = 1;
/// How much history to send after a jump, and how long after it. The delay, because dragging the slider makes many jumps.
const HISTORY_NS: u64 = 10_000_000_000;
const HISTORY_STATES: u64 = 400;
const HISTORY_DELAY: Duration = Duration::from_millis(150);
/// Most rows in a comparison.
const MOST_ROWS: usize = 40;
/// Topics whose newest message is shown at the current time.
const SHOWN: [Topic; 5] = [Topic::Latched, Topic::State, Topic::DrrReply, Topic::DrrFrame, Topic::DrrImage];

/// The logs to view.
#[derive(Debug, Clone)]
pub struct LogOptions {
    /// `run.mcap`, or its folder.
    pub log: PathBuf,
    /// A second log to compare with.
    pub second: Option<PathBuf>,
    /// Server options.
    pub server: ServerOptions,
}

/// What only the command line program knows about a scene.
pub struct SceneHelp<'a> {
    /// The tool's shape.
    pub tool: &'a dyn Fn(&Scene) -> ToolShape,
    /// The volume, or why there is none to show.
    pub volume: &'a dyn Fn(&Scene) -> Result<Option<LogVolume>, String>,
}

/// Shows logs until the process is asked to end.
///
/// # Errors
/// A log cannot be played, or the port cannot be opened.
pub fn view(
    options: &LogOptions,
    help: &SceneHelp<'_>,
    ready: impl FnOnce(&Server),
    end: &EndRequest,
) -> Result<(), ViewerError> {
    let path = log_path(&options.log);
    let first = outline(&path)?;
    let second = options.second.as_deref().map(|path| SecondLog::open(&log_path(path))).transpose()?;
    let scene = Scene::parse(&first.header.scene_toml, &path)?;
    let mut channels = Channels::new(&first.header.controllers);
    if second.is_some() {
        channels.add_second();
    }
    let board = Arc::new(Board::new(channels));
    let (calls, called) = mpsc::sync_channel(CALL_QUEUE);
    let over = Arc::new(AtomicBool::new(false));
    let server = Server::bind(
        &options.server,
        &path.display().to_string(),
        Arc::clone(&board),
        calls,
        Arc::clone(&over),
    )?;
    let volume = scene_volume(&scene, &first, help, &board);
    let grid = volume.as_ref().map(|volume| volume_box(&volume.grid));
    let origin = Origin::Log(path.display().to_string());
    let tool = (help.tool)(&scene);
    board.publish_json(INFO, &info(&scene, &origin, &tool, grid.as_ref()));
    first.notices.iter().for_each(|text| board.notice("warning", text));
    let mut playback = LogPlayback::open(
        board,
        &path,
        first,
        second,
        volume,
        Shown { tool: &tool, threshold_hu: scene.volume.map_or(0, |v| v.bone_threshold_hu) },
    )?;
    ready(&server);
    let serving = std::thread::spawn(move || server.serve());
    let shown = playback.run(&called, end);
    over.store(true, Ordering::Relaxed);
    let served = serving.join().unwrap_or(Ok(()));
    shown.and(served)
}

fn scene_volume(scene: &Scene, log: &Outline, help: &SceneHelp<'_>, board: &Board) -> Option<LogVolume> {
    let refuse = |text: String| {
        board.notice("warning", &format!("the bone is not shown: {text}"));
        None
    };
    match (help.volume)(scene) {
        Ok(Some(volume)) if log.header.volume_sha256.is_none_or(|sha256| sha256 == volume.sha256) => {
            Some(volume)
        }
        Ok(Some(_)) => refuse("the scene's volume is not the one of the run; its SHA-256 differs".to_owned()),
        Ok(None) => None,
        Err(text) => refuse(text),
    }
}

struct SecondLog {
    path: PathBuf,
    outline: Outline,
    log: LogFile,
}

impl SecondLog {
    fn open(path: &Path) -> Result<SecondLog, ViewerError> {
        Ok(SecondLog { path: path.to_owned(), outline: outline(path)?, log: LogFile::open(path)? })
    }
}

struct LogPlayback {
    board: Arc<Board>,
    run: LogFile,
    timing: Option<LogFile>,
    second: Option<SecondLog>,
    player: Player,
    bone: Option<LogBone>,
    slicer: Slicer,
    /// Time up to which messages are on the board; `None` before the first.
    shown_ns: Option<u64>,
    streams: Vec<Stream>,
    drawer: Drawer,
    /// Whether the current position still has to be drawn for other viewers.
    undrawn: bool,
    /// Time of the last jump, until its history has been sent.
    jumped: Option<Instant>,
    told: Option<(Instant, Player)>,
}

/// A cursor through a log, with the next message past the current position.
struct Stream {
    /// Prefix of its topics.
    prefix: &'static str,
    reading: Reading,
    ahead: Option<Logged>,
}

/// What the scene says of the objects that the page shows.
struct Shown<'a> {
    tool: &'a ToolShape,
    /// Above it a voxel is bone; 0 without a volume.
    threshold_hu: i16,
}

impl LogPlayback {
    fn open(
        board: Arc<Board>,
        path: &Path,
        first: Outline,
        second: Option<SecondLog>,
        volume: Option<LogVolume>,
        shown: Shown<'_>,
    ) -> Result<LogPlayback, ViewerError> {
        let run = LogFile::open(path)?;
        let timing_path = path.with_file_name("timing.mcap");
        let timing = timing_path.exists().then(|| LogFile::open(&timing_path)).and_then(Result::ok);
        let mut marks: Vec<Mark> = first.marks.clone();
        marks.extend(timing_marks(&timing_path, first.header.dt_ns));
        if let Some(second) = &second
            && let Some(mut mark) = first.divergence(&second.outline)
        {
            mark.text += &first_difference(&run, &second.log, mark.time_ns)?;
            marks.push(mark);
        }
        let (begin_ns, end_ns) = run.bounds_ns();
        let player = Player::new(begin_ns, end_ns, first.header.dt_ns, marks);
        let bone = volume.map(|volume| LogBone::new(volume, shown.threshold_hu, first.removals));
        Ok(LogPlayback {
            board,
            run,
            timing,
            second,
            player,
            bone,
            slicer: Slicer::new(now_ns()),
            shown_ns: None,
            streams: Vec::new(),
            drawer: Drawer::new(shown.tool),
            undrawn: true,
            jumped: None,
            told: None,
        })
    }

    fn run(&mut self, called: &Calls, end: &EndRequest) -> Result<(), ViewerError> {
        let mut last = Instant::now();
        while !end.is_set() {
            while let Ok(call) = called.try_recv() {
                self.dispatch(call);
            }
            self.player.advance(last.elapsed());
            last = Instant::now();
            self.show()?;
            self.send_history()?;
            let more = self.bone.as_mut().is_some_and(|bone| bone.publish(&self.board));
            self.tell();
            match &self.bone {
                Some(bone) => bone.answer(&mut self.slicer),
                None => self.slicer.refuse("the run's volume is not here; the messages say why"),
            }
            if !more {
                std::thread::sleep(POLL_PERIOD);
            }
        }
        Ok(())
    }

    fn dispatch(&mut self, call: Call) {
        match &call.request {
            Request::Playback(request) => {
                let outcome = self.player.apply(request);
                // The client may have left.
                let _ = call.answer.send(outcome.map(|()| Reply::Done));
            }
            Request::Slice(_) => self.slicer.add(call),
            _ => call.refuse("this is a log: what has happened cannot be steered"),
        }
    }

    /// Updates the board to the current position.
    fn show(&mut self) -> Result<(), PlayError> {
        let now = self.player.time_ns();
        if self.shown_ns == Some(now) {
            return if self.undrawn { self.draw(now) } else { Ok(()) };
        }
        self.board.set_time_ns(now);
        let stride = self.shown_ns.and_then(|shown| now.checked_sub(shown));
        match stride {
            Some(stride) if stride <= LONGEST_STRIDE_NS => self.stream_to(now)?,
            _ => self.jump_to(now)?,
        }
        self.shown_ns = Some(now);
        if let Some(bone) = &mut self.bone {
            bone.go_to(now);
        }
        self.draw(now)?;
        self.compare(now)
    }

    /// Draws the tool for other viewers: at once if one is subscribed, otherwise when one subscribes.
    fn draw(&mut self, now: u64) -> Result<(), PlayError> {
        self.undrawn = !self.drawer.is_due(&self.board);
        if !self.undrawn
            && let Some(message) = self.run.newest(Topic::State, now)?
            && let Ok(state) = State::read_from_bytes(message.body())
        {
            self.drawer.draw(&state, message.time_ns, &self.board);
        }
        Ok(())
    }

    fn stream_to(&mut self, now: u64) -> Result<(), PlayError> {
        for stream in &mut self.streams {
            while let Some(message) = stream.ahead.take_if(|message| message.time_ns <= now) {
                let topic = format!("{}{}", stream.prefix, message.topic);
                self.board.publish(&topic, message.time_ns, 0, message.payload);
                stream.ahead = stream.reading.next_message()?;
            }
        }
        Ok(())
    }

    fn jump_to(&mut self, now: u64) -> Result<(), PlayError> {
        self.jumped = Some(Instant::now());
        self.show_newest(now)?;
        self.streams.clear();
        let second = self.second.as_ref().map(|second| (SECOND, &second.log, SECOND_TOPICS.as_slice()));
        let own = core::iter::once(&self.run).chain(&self.timing).map(|log| ("", log, [].as_slice()));
        for (prefix, log, topics) in own.chain(second) {
            let mut reading = log.after(Some(now), topics)?;
            let ahead = reading.next_message()?;
            self.streams.push(Stream { prefix, reading, ahead });
        }
        Ok(())
    }

    fn show_newest(&self, now: u64) -> Result<(), PlayError> {
        for topic in SHOWN {
            if let Some(message) = self.run.newest(topic, now)? {
                self.board.publish(topic.name(), message.time_ns, 0, message.payload);
            }
        }
        let Some(second) = &self.second else { return Ok(()) };
        for topic in SECOND_TOPICS {
            if let Some(message) = second.log.newest(topic, now)? {
                self.board.publish(&format!("{SECOND}{topic}"), message.time_ns, 0, message.payload);
            }
        }
        Ok(())
    }

    /// Sends the history before a jump, for the plots: a sample of the states, all tick timings.
    fn send_history(&mut self) -> Result<(), PlayError> {
        if self.jumped.is_none_or(|jumped| jumped.elapsed() < HISTORY_DELAY) {
            return Ok(());
        }
        self.jumped = None;
        let now = self.player.time_ns();
        let from = now.saturating_sub(HISTORY_NS);
        let every = (HISTORY_NS / self.player.dt_ns / HISTORY_STATES).max(1);
        let timing = self.timing.as_ref().map(|log| (log, Topic::TickTiming, 1));
        for (log, topic, every) in core::iter::once((&self.run, Topic::State, every)).chain(timing) {
            let mut reading = log.after(from.checked_sub(1), &[topic])?;
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

    /// Compares both logs at the same simulated time.
    fn compare(&self, now: u64) -> Result<(), PlayError> {
        let Some(second) = &self.second else { return Ok(()) };
        let recent = self.told.as_ref().is_some_and(|(told, _)| told.elapsed() < PLAYBACK_PERIOD);
        if self.player.playing && recent {
            return Ok(());
        }
        let (a, b) = (self.run.newest(Topic::State, now)?, second.log.newest(Topic::State, now)?);
        if let Some((a, b)) = a.zip(b) {
            let value = json!({"time_ns": now, "fields": differing_fields(a.body(), b.body())});
            self.board.publish_json(COMPARE, &value);
        }
        Ok(())
    }

    /// Publishes the position if it has changed; the marks only the first time.
    fn tell(&mut self) {
        let due = match &self.told {
            None => true,
            Some((told, before)) => {
                let command = before.playing != self.player.playing || before.speed != self.player.speed;
                command || (*before != self.player && told.elapsed() >= PLAYBACK_PERIOD)
            }
        };
        if !due {
            return;
        }
        let player = &self.player;
        let mut value = json!({
            "begin_ns": player.begin_ns, "end_ns": player.end_ns, "time_ns": player.time_ns(),
            "playing": player.playing, "speed": player.speed,
            "second": self.second.as_ref().map(|second| json!({"path": second.path.display().to_string()})),
        });
        self.board.publish(PLAYBACK, player.time_ns(), POSITION_SLOT, value.to_string().into_bytes());
        if self.told.is_none() {
            value["events"] = Value::Array(player.marks.iter().map(Mark::json).collect());
            self.board.publish(PLAYBACK, player.time_ns(), MARKS_SLOT, value.to_string().into_bytes());
        }
        self.told = Some((Instant::now(), player.clone()));
    }
}

/// The first difference where two logs diverge: the previous tick's command, or else the state.
fn first_difference(a: &LogFile, b: &LogFile, time_ns: u64) -> Result<String, PlayError> {
    let looks = [
        (Topic::Latched, Latched::DESCRIPTION, time_ns.saturating_sub(1)),
        (Topic::State, State::DESCRIPTION, time_ns),
    ];
    for (topic, description, time_ns) in looks {
        if let Some((a, b)) = a.newest(topic, time_ns)?.zip(b.newest(topic, time_ns)?)
            && let Some(found) = difference::compare(topic, Tick::START, description, a.body(), b.body())
            && let Some(difference) = found.differences.first()
        {
            return Ok(format!("; {topic}: {difference}"));
        }
    }
    Ok(String::new())
}

/// Fields in which two states differ, at most [`MOST_ROWS`]. The state's own fields come before those of its poses and contacts; within
/// each group the largest relative difference comes first. For an array, its most different element.
fn differing_fields(a: &[u8], b: &[u8]) -> Vec<Value> {
    let number = |scalar: Option<Scalar>| scalar.map(Scalar::nearest_f64);
    let mut rows: Vec<(f64, String, f64, f64)> = difference::all_differences(State::DESCRIPTION, a, b)
        .into_iter()
        .filter(|difference| !difference.path.starts_with("hash["))
        .filter_map(|found| {
            let (a, b) = number(found.recorded).zip(number(found.replayed))?;
            let relative = if a == b { 0.0 } else { (b - a).abs() / a.abs().max(b.abs()) };
            Some((relative, found.path, a, b))
        })
        .collect();
    let nested = |row: &(f64, String, f64, f64)| row.1.contains('.');
    // A stable sort keeps equal rows in field order.
    rows.sort_by(|one, other| nested(one).cmp(&nested(other)).then(other.0.total_cmp(&one.0)));
    let mut seen = BTreeSet::new();
    rows.retain(|row| seen.insert(row.1.replace(|c: char| c.is_ascii_digit(), "")));
    rows.truncate(MOST_ROWS);
    let row =
        |(_, name, a, b): (f64, String, f64, f64)| json!({"name": name, "a": a, "b": b, "difference": b - a});
    rows.into_iter().map(row).collect()
}
