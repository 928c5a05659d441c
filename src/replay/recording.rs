//! Records a replay as a new `run.mcap`.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use hub::Outputs;
use hub::run_lane::{LaneError, RunLane};
use ipc_types::messages::layout::{Message, hex};
use ipc_types::messages::{
    DrrReply, Frame, ImagePrefix, Keyframe, Latched, Part, Removed, SensorReading, State, Tick,
};
use output_file::{OutputError, OutputFile};
use recorder_proc::log_file::{LogFile, index_beside};
use run_log::verify::compare_state;
use run_log::{EndReason, FrameRecord, LogError, LogMessage, MessageStream, RunLog, Topic};
use sha2::{Digest, Sha256};
use simulation::Simulation;
use zerocopy::{FromBytes, IntoBytes};

use super::OpenedLog;
use super::frames::{FrameReplay, compare};
use crate::failure::Failure;
use crate::output::refuse_existing;

/// The result of recording a replay.
pub struct ReplayRecording {
    /// The new `run.mcap`.
    pub path: PathBuf,
    /// Number of ticks stepped.
    pub ticks: u64,
    /// Number of frames written.
    pub frames: u64,
    /// SHA-256 of the original log and of the new file.
    pub sha256: [String; 2],
    /// How the log ends, if it does not end cleanly.
    pub remark: Option<String>,
}

/// Replays a log and writes the result to `run.mcap` in `folder`: commands and replies from the log; states,
/// removed voxels and keyframes from the physics; frames re-rendered on `frame_threads` threads or, if
/// `None`, copied from the log.
///
/// Every message keeps its position in the log, because in real time the arrival of a frame is not
/// deterministic.
///
/// # Errors
/// The first difference; a log that cannot be read to its end; a folder that cannot be written. On error no
/// file remains.
pub fn record(
    log: &OpenedLog,
    folder: &Path,
    frame_threads: Option<usize>,
) -> Result<ReplayRecording, Failure> {
    let path = folder.join("run.mcap");
    refuse_existing(&[&path])?;
    let mut stream = MessageStream::open(&LogFile::at(&log.path), log.options())?;
    let first = stream.header().first_tick;
    if first > Tick::START {
        return Err(Failure::bad_input(format!(
            "{}: begins at tick {first}; only a log from the start of its run can be recorded again",
            log.path.display()
        )));
    }
    let frames = match frame_threads {
        Some(threads) => FrameReplay::new(log, threads)?,
        None => None,
    };
    let simulation = log.simulation().map_err(Failure::failed)?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    let file = OutputFile::create(&path)?;
    let written = BufWriter::with_capacity(1 << 16, file.handle()?);
    let mut out = RunLog::create_named(written, &path, index_beside(&path), stream.header())
        .map_err(Failure::failed)?;
    out.keep_places();
    let mut copy = ReplayCopy {
        log,
        out: Out(out),
        simulation,
        frames,
        lane: RunLane::with_keyframes_on_demand(),
        ticks: 0,
        frame_count: 0,
        latched: None,
        frame: None,
        // The first chunk is open from the start.
        chunk: 1,
    };
    while let Some(message) = stream.next_message().map_err(Failure::failed)? {
        copy.handle(&message)?;
    }
    copy.put_frame(None)?;
    let (ticks, frames) = (copy.ticks, copy.frame_count);
    let marker = stream.ending().marker.as_ref();
    // A log without an end marker is from a recorder that died.
    let reason =
        marker.map_or(EndReason::PartDied(Part::Recorder.name().to_owned()), |marker| marker.reason.clone());
    if let EndReason::SimulationFailed(text) = &reason {
        copy.fail(text)?;
    }
    let lost = marker.map(|marker| marker.lost.clone()).unwrap_or_default();
    let (_, mut written) = copy.out.0.finish(reason, &lost).map_err(Failure::failed)?;
    // A failed flush must be an error, or the file would silently lack its end.
    std::io::Write::flush(&mut written).map_err(OutputError::write(&path))?;
    let recorded = file.finish()?;
    let remark = (!stream.ending().is_complete()).then(|| stream.ending().describe());
    let sha256 = [sha256(&log.path)?, sha256(&recorded.draft())?];
    recorded.keep()?;
    Ok(ReplayRecording { path, ticks, frames, sha256, remark })
}

/// The replay being written.
struct ReplayCopy<'l> {
    log: &'l OpenedLog,
    out: Out,
    simulation: Simulation<'l>,
    frames: Option<FrameReplay<'l>>,
    lane: RunLane,
    ticks: u64,
    frame_count: u64,
    latched: Option<Box<Latched>>,
    /// A frame whose image may follow.
    frame: Option<Frame>,
    /// Chunk of the last message.
    chunk: u64,
}

impl ReplayCopy<'_> {
    /// Handles the log's next message, whose size the stream has checked.
    fn handle(&mut self, message: &LogMessage<'_>) -> Result<(), Failure> {
        let chunk_ended = std::mem::replace(&mut self.chunk, message.chunk) != message.chunk;
        if message.known == Some(Topic::DrrImage) {
            return self.put_frame(Some(message.body));
        }
        self.put_frame(None)?;
        if chunk_ended {
            self.out.0.close_chunk().map_err(Failure::failed)?;
        }
        match message.known {
            Some(Topic::Latched) => self.latched = Latched::read_from_bytes(message.body).ok().map(Box::new),
            Some(Topic::State) => {
                if let Ok(state) = State::read_from_bytes(message.body) {
                    self.tick(&state)?;
                }
            }
            Some(Topic::Keyframe) => {
                if let Ok((head, _)) = Keyframe::read_from_prefix(message.body)
                    && head.offset_bytes == 0
                {
                    self.keyframe()?;
                }
            }
            Some(Topic::DrrReply) => {
                if let Ok(reply) = DrrReply::read_from_bytes(message.body) {
                    self.out.0.drr_reply(&reply).map_err(Failure::failed)?;
                }
            }
            Some(Topic::DrrFrame) => self.frame = Frame::read_from_bytes(message.body).ok(),
            // Removed voxels and readings come from the physics.
            _ => {}
        }
        Ok(())
    }

    /// Steps a tick or reads the initial state, compares the result with the log and writes it.
    fn tick(&mut self, recorded: &State) -> Result<(), Failure> {
        let expected = self.simulation.state().tick + u64::from(self.latched.is_some());
        if recorded.tick != expected {
            return Err(Failure::failed(self.gap(expected)));
        }
        let plant = &mut self.simulation;
        match self.latched.take() {
            Some(latched) => {
                let marks = self.lane.tick(plant, &latched, &mut self.out, |_| 0);
                marks.map_err(Failure::failed)?;
                self.ticks += 1;
            }
            None => self.lane.begin(plant, &mut self.out).map_err(Failure::failed)?,
        }
        match compare_state(recorded, self.simulation.state()) {
            None => Ok(()),
            Some(divergence) => Err(Failure::failed(format!("{divergence}{}", self.log.label()))),
        }
    }

    /// Repeats the tick that the simulation could not compute; writes its commands, as in the run.
    fn fail(&mut self, text: &str) -> Result<(), Failure> {
        let Some(latched) = self.latched.take() else { return Ok(()) };
        let told = match self.lane.tick(&mut self.simulation, &latched, &mut self.out, |_| 0) {
            Ok(_) => "the simulation does not fail here".to_owned(),
            Err(LaneError::Output(cause)) => return Err(Failure::failed(cause)),
            Err(LaneError::Plant(cause)) => format!("tick {}: {cause}", latched.tick),
        };
        let differs = || Failure::failed(format!("{told}; in the log: {text}"));
        if told == text { Ok(()) } else { Err(differs()) }
    }

    /// Message for a log with a gap, which cannot be reproduced as the same file.
    fn gap(&self, tick: u64) -> String {
        format!("{}: gap at tick {tick}; --output needs every tick", self.log.path.display())
    }

    fn keyframe(&mut self) -> Result<(), Failure> {
        let written = self.lane.keyframe(&self.simulation, &mut self.out);
        written.map_err(Failure::failed)
    }

    /// Writes the pending frame, with its image if it is next in the log.
    fn put_frame(&mut self, image: Option<&[u8]>) -> Result<(), Failure> {
        let Some(frame) = self.frame.take() else { return Ok(()) };
        self.frame_count += 1;
        let (prefix, pixels) = match image.map(ImagePrefix::read_from_prefix) {
            Some(Ok((prefix, pixels))) => (Some(prefix), pixels.to_vec()),
            _ => (None, Vec::new()),
        };
        let mut record = FrameRecord { frame, image: prefix, pixels };
        if let Some(frames) = &mut self.frames {
            let rendered = frames.render(&frame)?;
            let Some(rendered) = rendered else { return Err(Failure::failed(self.gap(frame.tick))) };
            if let Some(difference) = compare(&record, &rendered) {
                return Err(Failure::failed(format!(
                    "frame {}: {difference}{}",
                    frame.sequence,
                    self.log.label()
                )));
            }
            record.frame = rendered.frame;
            if record.image.is_some() {
                (record.image, record.pixels) = (rendered.image, rendered.pixels);
            }
        }
        match &record.image {
            None => self.out.0.frame_without_image(&record.frame).map_err(Failure::failed),
            Some(prefix) => {
                let bytes = [record.frame.as_bytes(), prefix.as_bytes(), &record.pixels].concat();
                debug_assert!(bytes.len() > Frame::DESCRIPTION.size);
                self.out.0.frame(&bytes).map_err(Failure::failed)
            }
        }
    }
}

/// Writes the physics' output to the run lane.
struct Out(RunLog<BufWriter<File>>);

impl Outputs for Out {
    type Error = LogError;

    fn send_latched(&mut self, latched: &Latched) -> Result<(), LogError> {
        self.0.latched(latched)
    }

    fn send_removed(&mut self, removed: &Removed, voxels: &[u32]) -> Result<(), LogError> {
        self.0.removed(&[removed.as_bytes(), voxels.as_bytes()].concat())
    }

    fn send_reading(&mut self, reading: &SensorReading) -> Result<(), LogError> {
        self.0.reading(reading)
    }

    fn send_state(&mut self, state: &State) -> Result<(), LogError> {
        self.0.state(state)
    }

    fn send_keyframe(&mut self, keyframe: &Keyframe, part: &[u8]) -> Result<(), LogError> {
        self.0.keyframe(&[keyframe.as_bytes(), part].concat())
    }
}

fn sha256(path: &Path) -> Result<String, Failure> {
    let failed = |cause: std::io::Error| Failure::failed(format!("{}: {cause}", path.display()));
    let (mut hasher, mut file) = (Sha256::new(), File::open(path).map_err(failed)?);
    let mut buffer = vec![0; 1 << 20];
    loop {
        match std::io::Read::read(&mut file, &mut buffer).map_err(failed)? {
            0 => return Ok(hex(&hasher.finalize())),
            read => hasher.update(&buffer[..read]),
        }
    }
}
