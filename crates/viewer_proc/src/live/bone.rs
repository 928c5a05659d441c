//! The bone's surface of a running session, meshed in a separate thread that borrows the volume in place.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ipc_types::clock::now_ns;
use ipc_types::messages::services;
use ipc_types::messages::{Removed, RunStatus, Volume};
use ipc_types::ports::{PortError, Subscriber};
use ipc_types::process::session_scene;
use ipc_types::session::{Session, SessionError};
use recorder_proc::log_file::LogFile;
use run_log::{MessageStream, ReadOptions, Topic, voxel_indices};
use voxel_grid::{GridError, VoxelGrid};
use zerocopy::FromBytes;

use super::followed_log::recorded_in;
use crate::board::Board;
use crate::calls::Calls;
use crate::error::ViewerError;
use crate::slice::Slicer;
use crate::surface::bone::Bone;
use crate::threads;

/// Time between two polls of the removals; the queue holds half a second of them at 1 kHz.
const POLL_PERIOD: Duration = Duration::from_millis(4);
/// Maximum number of removals applied before the bone is meshed.
const ROUND: usize = 4096;
/// Time between two meshing passes.
const MESH_PERIOD: Duration = Duration::from_millis(50);
/// Time between two searches of the log for removals from before the viewer joined.
const LOG_PERIOD: Duration = Duration::from_millis(500);

/// Inputs of the thread.
pub(super) struct BoneThread {
    pub session: PathBuf,
    pub threshold_hu: i16,
    pub board: Arc<Board>,
    pub over: Arc<AtomicBool>,
    /// Requests for slices.
    pub asked: Calls,
}

impl BoneThread {
    /// Starts the thread and calls `known` with the volume's grid once it has arrived.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub(super) fn start(self, known: impl FnOnce(&VoxelGrid) + Send + 'static) -> Result<(), ViewerError> {
        threads::start("bone", move || {
            if let Err(error) = self.run(known) {
                self.board.notice("warning", &format!("the bone is not shown: {error}"));
            }
        })
        .map(drop)
    }

    fn run(&self, known: impl FnOnce(&VoxelGrid)) -> Result<(), BoneError> {
        let session = Session::join(&self.session)?;
        let removals = Removals::open(&session, &self.session)?;
        let volumes = session.subscriber::<Volume>(&services::VOLUME)?;
        let volume = loop {
            if self.over.load(Ordering::Relaxed) {
                return Ok(());
            }
            match volumes.receive()? {
                Some(volume) => break volume,
                None => std::thread::sleep(POLL_PERIOD),
            }
        };
        let grid = volume.message().grid()?;
        known(&grid);
        let hu = voxels(volume.tail());
        let bone = Bone::new(grid, self.threshold_hu);
        self.follow(bone, &hu, removals)
    }

    fn follow(&self, mut bone: Bone, hu: &[i16], mut removals: Removals) -> Result<(), BoneError> {
        let mut meshed: Option<Instant> = None;
        let mut slicer = Slicer::new(now_ns());
        while !self.over.load(Ordering::Relaxed) {
            removals.poll(&self.board)?;
            while let Some((removed, voxels)) = removals.next() {
                bone.apply(&removed, &voxels);
            }
            if meshed.is_none_or(|meshed| meshed.elapsed() >= MESH_PERIOD) {
                bone.publish(hu, &self.board);
                meshed = Some(Instant::now());
            }
            self.asked.try_iter().for_each(|call| slicer.add(call));
            slicer.answer(bone.field(), hu, now_ns());
            std::thread::sleep(POLL_PERIOD);
        }
        Ok(())
    }
}

/// Why the bone is not shown.
#[derive(Debug, thiserror::Error)]
enum BoneError {
    #[error(transparent)]
    Session(#[from] SessionError),
    #[error(transparent)]
    Port(#[from] PortError),
    #[error("volume: {0}")]
    Grid(#[from] GridError),
}

/// Returns the voxels in place, or a copy if they are not aligned.
fn voxels(bytes: &[u8]) -> Cow<'_, [i16]> {
    match <[i16]>::ref_from_bytes(bytes) {
        Ok(hu) => Cow::Borrowed(hu),
        Err(_) => bytes
            .chunks_exact(2)
            .map(|pair| i16::from_le_bytes([pair[0], pair[1]]))
            .collect::<Vec<_>>()
            .into(),
    }
}

/// Returns whether a session that is recorded is recorded from its start.
fn is_kept(folder: &Path) -> bool {
    session_scene(folder).is_ok_and(|scene| scene.recording.ring_s == 0.0)
}

/// Removals in sequence order. Those from before the viewer joined are read from the log being recorded.
struct Removals {
    messages: Subscriber<Removed>,
    status: Subscriber<RunStatus>,
    queue: RemovalQueue,
    /// The log being recorded, if any.
    log: Option<PathBuf>,
    looked: Option<Instant>,
    incomplete: bool,
}

impl Removals {
    fn open(session: &Session, folder: &Path) -> Result<Removals, SessionError> {
        Ok(Removals {
            messages: session.subscriber(&services::REMOVED)?,
            status: session.subscriber(&services::RUN_STATUS)?,
            queue: RemovalQueue::default(),
            log: recorded_in(folder).filter(|_| is_kept(folder)).map(|output| output.join("run.mcap")),
            looked: None,
            incomplete: false,
        })
    }

    fn poll(&mut self, board: &Board) -> Result<(), PortError> {
        for _ in 0..ROUND {
            let Some(received) = self.messages.receive_valid(|_| {})? else { break };
            self.queue.keep(*received.message(), received.tail());
        }
        if let Some(status) = self.status.receive_newest()? {
            self.queue.sent = self.queue.sent.max(status.message().removed_messages);
        }
        if self.queue.lacks_next() && self.looked.is_none_or(|looked| looked.elapsed() >= LOG_PERIOD) {
            self.looked = Some(Instant::now());
            self.read_log(board);
        }
        Ok(())
    }

    /// Reads missing removals from the log. The newest may not be on disk yet; they are read in the next
    /// pass.
    fn read_log(&mut self, board: &Board) {
        let Some(path) = &self.log else {
            // Without a log, earlier removals are unknown: continue from the first one received.
            self.queue.go_on();
            let text =
                "the start of the run is not recorded: bone drilled before the viewer joined is shown intact";
            return self.say_incomplete(text, board);
        };
        let Ok(mut stream) = MessageStream::open_topics(
            &LogFile::at(path),
            &[Topic::Removed.name().to_owned()],
            ReadOptions::default(),
        ) else {
            return;
        };
        let mut logged = 0;
        while let Ok(Some(message)) = stream.next_message() {
            if let Ok((removed, tail)) = Removed::read_from_prefix(message.body) {
                logged = removed.sequence;
                self.queue.keep(removed, tail);
            }
        }
        if self.queue.step_over_lost(logged) {
            self.say_incomplete("removals are missing from the log: their bone is shown intact", board);
        }
    }

    fn say_incomplete(&mut self, text: &str, board: &Board) {
        if !std::mem::replace(&mut self.incomplete, true) {
            board.notice("warning", text);
        }
    }

    fn next(&mut self) -> Option<(Removed, Vec<u32>)> {
        self.queue.next()
    }
}

/// Removals waiting for their predecessors.
#[derive(Default)]
struct RemovalQueue {
    waiting: BTreeMap<u64, (Removed, Vec<u32>)>,
    /// Sequence number of the last removal returned.
    last: u64,
    /// Highest sequence number known to have been sent.
    sent: u64,
}

impl RemovalQueue {
    fn keep(&mut self, removed: Removed, tail: &[u8]) {
        if removed.sequence > self.last {
            self.sent = self.sent.max(removed.sequence);
            self.waiting.insert(removed.sequence, (removed, voxel_indices(tail)));
        }
    }

    /// Whether the next removal has been sent but not received.
    fn lacks_next(&self) -> bool {
        self.sent > self.last && !self.waiting.contains_key(&(self.last + 1))
    }

    /// Skips to the first removal received.
    fn go_on(&mut self) {
        if let Some(first) = self.waiting.keys().next() {
            self.last = first - 1;
        }
    }

    /// Skips lost removals. A log holds removals in order, so the next one is lost if the log, read up to
    /// number `logged`, is past it. Returns whether any were skipped.
    fn step_over_lost(&mut self, logged: u64) -> bool {
        let lost = self.lacks_next() && logged > self.last;
        if lost {
            self.go_on();
        }
        lost
    }

    fn next(&mut self) -> Option<(Removed, Vec<u32>)> {
        let next = self.waiting.remove(&(self.last + 1))?;
        self.last += 1;
        Some(next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_removal_that_the_recorder_lost_is_stepped_over() {
        let mut queue = RemovalQueue::default();
        let keep = |queue: &mut RemovalQueue, sequence: u64| {
            queue.keep(Removed { sequence, ..Removed::zeroed() }, &(sequence as u32).to_le_bytes());
        };
        // Received: 5 and 6, from the bus. The log does not contain 2 yet.
        [5, 6].into_iter().for_each(|sequence| keep(&mut queue, sequence));
        keep(&mut queue, 1);
        assert!(!queue.step_over_lost(1) && queue.next().is_some());
        assert!(queue.lacks_next() && !queue.step_over_lost(1) && queue.next().is_none());
        // Continues with 3: 2 is lost, 4 may still arrive.
        [1, 3].into_iter().for_each(|sequence| keep(&mut queue, sequence));
        assert!(queue.step_over_lost(3));
        assert_eq!(queue.next().map(|(removed, voxels)| (removed.sequence, voxels)), Some((3, vec![3])));
        assert!(queue.lacks_next() && !queue.step_over_lost(3));
        keep(&mut queue, 4);
        let rest: Vec<u64> =
            std::iter::from_fn(|| queue.next()).map(|(removed, _)| removed.sequence).collect();
        assert_eq!(rest, [4, 5, 6]);
        assert!(!queue.lacks_next());
    }
}
