//! Recording a replay: the same `run.mcap` once more.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use ipc_types::layout::{Message, hex};
use ipc_types::messages::{DrrReply, Frame, ImagePrefix, Keyframe, Latched, Removed, State};
use ipc_types::services::{KEYFRAME_PART_BYTES, MAX_REMOVED_PER_TICK};
use recorder_proc::verify::compare_state;
use recorder_proc::{
    EndReason, FrameRecord, LogMessage, MessageStream, NewFile, Resumable, RunLog, Simulation, topics,
};
use sha2::{Digest, Sha256};
use zerocopy::{FromBytes, IntoBytes};

use super::frames::{FrameReplay, compare};
use super::{OpenedLog, World};
use crate::failure::Failure;
use crate::output::refuse_existing;

/// What recording a replay found.
pub struct Recorded {
    /// The new `run.mcap`.
    pub path: PathBuf,
    /// Ticks stepped.
    pub ticks: u64,
    /// Frames written.
    pub frames: u64,
    /// SHA-256 of the log and of the new file.
    pub sha256: [String; 2],
    /// How the log ends, if it does not end as it should.
    pub remark: Option<String>,
}

/// Replays a log and writes what comes out into `run.mcap` of `folder`: commands and replies from the log, states, removed
/// voxels and keyframes from the physics, frames rendered again on `frame_threads` threads or, without, from the log.
///
/// Every message takes the place that it has in the log: in real time, when a frame was ready is no function of the run.
///
/// # Errors
/// The first difference; a log that cannot be read to its end; a folder that cannot be written. Then there is no file.
pub fn record(log: &OpenedLog, folder: &Path, frame_threads: Option<usize>) -> Result<Recorded, Failure> {
    let path = folder.join("run.mcap");
    refuse_existing(&[&path])?;
    let mut stream = MessageStream::open(&log.path, log.options()).map_err(Failure::bad_input)?;
    let frames = match frame_threads {
        Some(threads) => FrameReplay::new(log, threads)?,
        None => None,
    };
    let world = log.world().map_err(Failure::failed)?;
    output_file::create_folder(folder)
        .map_err(|cause| Failure::bad_input(format!("--record {}: {cause}", folder.display())))?;
    let (file, made) = NewFile::create(&path).map_err(Failure::bad_input)?;
    let file = BufWriter::with_capacity(1 << 16, file);
    let mut out = RunLog::create_named(file, &path, stream.header()).map_err(failed)?;
    out.keep_places();
    let mut copy = Copy {
        log,
        out,
        world,
        frames,
        removals: 0,
        keyframe_parts: 0,
        ticks: 0,
        frame_count: 0,
        latched: None,
        frame: None,
        // The first one is open from the start.
        chunk: 1,
    };
    while let Some(message) = stream.next_message().map_err(failed)? {
        copy.take(&message)?;
    }
    copy.put_frame(None)?;
    let (ticks, frames) = (copy.ticks, copy.frame_count);
    let marker = stream.ending().marker.as_ref();
    // A log without a marker was left by a recorder that died.
    let reason = marker.map_or(EndReason::PartDied("recorder".to_owned()), |marker| marker.reason.clone());
    let lost = marker.map(|marker| marker.lost.clone()).unwrap_or_default();
    let (_, mut file) = copy.out.finish(reason, &lost).map_err(failed)?;
    // What a buffer could not write is an error, not a file without its end.
    std::io::Write::flush(&mut file)
        .map_err(|cause| Failure::failed(format!("{}: cannot be written: {cause}", path.display())))?;
    let remark = (!stream.ending().is_complete()).then(|| stream.ending().describe());
    let sha256 = [sha256(&log.path)?, sha256(&path)?];
    made.keep().map_err(failed)?;
    Ok(Recorded { path, ticks, frames, sha256, remark })
}

/// The replay being written.
struct Copy<'l> {
    log: &'l OpenedLog,
    out: RunLog<BufWriter<File>>,
    world: World<'l>,
    frames: Option<FrameReplay<'l>>,
    removals: u64,
    keyframe_parts: u64,
    ticks: u64,
    frame_count: u64,
    latched: Option<Box<Latched>>,
    /// A frame whose image may follow.
    frame: Option<Frame>,
    /// Chunk of the last message.
    chunk: u64,
}

impl Copy<'_> {
    /// Takes the log's next message. Every body has its message's size: the stream has checked.
    fn take(&mut self, message: &LogMessage<'_>) -> Result<(), Failure> {
        let chunk_ended = std::mem::replace(&mut self.chunk, message.chunk) != message.chunk;
        if message.topic == topics::DRR_IMAGE {
            return self.put_frame(Some(message.body));
        }
        self.put_frame(None)?;
        if chunk_ended {
            self.out.close_chunk().map_err(failed)?;
        }
        match message.topic {
            topics::LATCHED => self.latched = Latched::read_from_bytes(message.body).ok().map(Box::new),
            topics::STATE => {
                if let Ok(state) = State::read_from_bytes(message.body) {
                    self.tick(&state)?;
                }
            }
            topics::KEYFRAME => {
                if let Ok((head, _)) = Keyframe::read_from_prefix(message.body)
                    && head.offset_bytes == 0
                {
                    self.keyframe()?;
                }
            }
            topics::DRR_REPLY => {
                if let Ok(reply) = DrrReply::read_from_bytes(message.body) {
                    self.out.drr_reply(&reply).map_err(failed)?;
                }
            }
            topics::DRR_FRAME => self.frame = Frame::read_from_bytes(message.body).ok(),
            // Removed voxels come from the physics.
            _ => {}
        }
        Ok(())
    }

    /// Makes a tick, or writes the initial state, and compares it with the log's.
    fn tick(&mut self, recorded: &State) -> Result<(), Failure> {
        let mut reset = false;
        let expected = self.world.state().tick + u64::from(self.latched.is_some());
        if recorded.tick != expected {
            return Err(Failure::failed(self.gap(expected)));
        }
        if let Some(latched) = self.latched.take() {
            self.world.step(&latched).map_err(Failure::failed)?;
            self.out.latched(&latched).map_err(failed)?;
            reset = latched.reset != 0;
            self.ticks += 1;
        }
        if let Some(divergence) = compare_state(recorded, self.world.state()) {
            return Err(Failure::failed(format!("{divergence}{}", self.log.label())));
        }
        let (tick, total) = (recorded.tick, recorded.removed_total);
        if tick == 0 {
            let predrilled = self.world.simulation.predrilled().to_vec();
            predrilled
                .chunks(MAX_REMOVED_PER_TICK)
                .try_for_each(|voxels| self.removed(0, voxels, 0, false))?;
        } else if reset || !self.world.removed().is_empty() {
            let removed = self.world.removed().to_vec();
            self.removed(tick, &removed, total, reset)?;
        }
        self.out.state(self.world.simulation.state()).map_err(failed)
    }

    /// A part of a run cannot be the same file.
    fn gap(&self, tick: u64) -> String {
        format!("{}: a gap at tick {tick}: --record needs every tick", self.log.path.display())
    }

    fn removed(&mut self, tick: u64, voxels: &[u32], total: u64, restore_first: bool) -> Result<(), Failure> {
        self.removals += 1;
        let head = Removed {
            tick,
            sequence: self.removals,
            removed_total: total,
            restore_first: u32::from(restore_first),
            voxel_index_length: voxels.len() as u32,
        };
        self.out.removed(&[head.as_bytes(), voxels.as_bytes()].concat()).map_err(failed)
    }

    fn keyframe(&mut self) -> Result<(), Failure> {
        let bytes = self.world.save().map_err(Failure::failed)?;
        let state = *self.world.state();
        for (index, part) in bytes.chunks(KEYFRAME_PART_BYTES).enumerate() {
            self.keyframe_parts += 1;
            let head = Keyframe {
                tick: state.tick,
                hash: state.hash,
                sequence: self.keyframe_parts,
                total_bytes: bytes.len() as u32,
                offset_bytes: (index * KEYFRAME_PART_BYTES) as u32,
                reserved: 0,
                data_length: part.len() as u32,
            };
            self.out.keyframe(&[head.as_bytes(), part].concat()).map_err(failed)?;
        }
        Ok(())
    }

    /// Writes the frame that waits, with its image if that is what follows it in the log.
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
            None => self.out.frame_without_image(&record.frame).map_err(failed),
            Some(prefix) => {
                let bytes = [record.frame.as_bytes(), prefix.as_bytes(), &record.pixels].concat();
                debug_assert!(bytes.len() > Frame::DESCRIPTION.size);
                self.out.frame(&bytes).map_err(failed)
            }
        }
    }
}

fn failed(cause: recorder_proc::LogError) -> Failure {
    Failure::failed(cause.to_string())
}

fn sha256(path: &Path) -> Result<String, Failure> {
    let failed = |cause: std::io::Error| Failure::failed(format!("{}: {cause}", path.display()));
    let mut hasher = Sha256::new();
    let mut file = File::open(path).map_err(failed)?;
    let mut buffer = vec![0; 1 << 20];
    loop {
        match std::io::Read::read(&mut file, &mut buffer).map_err(failed)? {
            0 => return Ok(hex(&hasher.finalize())),
            read => hasher.update(&buffer[..read]),
        }
    }
}
