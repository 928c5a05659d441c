//! The bone of a running session: its CT, and the removed voxels from its start, whenever the reader joins.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ipc_types::messages::services;
use ipc_types::messages::{Removed, RunStatus, Volume};
use ipc_types::ports::{PortError, ReceivedMessage, Subscriber};
use ipc_types::process::session_scene;
use ipc_types::session::{Session, SessionError};
use recorder_proc::log_file::LogFile;
use run_log::{MessageStream, ReadOptions, Topic, voxel_indices};
use voxel_grid::{GridError, VoxelGrid};
use zerocopy::FromBytes;

use crate::live::recorded_in;

/// Maximum number of removals received at a time.
const ROUND: usize = 4096;
/// Time between two searches of the log for missing removals.
const LOG_PERIOD: Duration = Duration::from_millis(500);

/// Time between two polls for the volume.
const VOLUME_PERIOD: Duration = Duration::from_millis(4);

/// The bone of a running session.
#[derive(Debug)]
pub struct SessionBone {
    /// The CT's grid.
    pub grid: VoxelGrid,
    volume: ReceivedMessage<Volume>,
    removals: Removals,
    _session: Session,
}

/// Why the bone cannot be followed.
#[derive(Debug, thiserror::Error)]
pub enum SessionBoneError {
    /// The session cannot be joined.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A message cannot be received.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The CT's grid is invalid.
    #[error("volume: {0}")]
    Grid(#[from] GridError),
    /// The voxels are malformed.
    #[error("volume: the voxels do not match the header")]
    Voxels,
}

impl SessionBone {
    /// Joins a session, whose folder this is, and waits for its CT; `None` if it is over first.
    ///
    /// # Errors
    /// Any [`SessionBoneError`] but the last.
    pub fn join(folder: &Path, is_over: &AtomicBool) -> Result<Option<SessionBone>, SessionBoneError> {
        let session = Session::join(folder)?;
        let removals = Removals::open(&session, folder)?;
        let volumes = session.subscriber::<Volume>(&services::VOLUME)?;
        while !is_over.load(Ordering::Relaxed) {
            if let Some(volume) = volumes.receive()? {
                let grid = volume.message().grid()?;
                return Ok(Some(SessionBone { grid, volume, removals, _session: session }));
            }
            std::thread::sleep(VOLUME_PERIOD);
        }
        Ok(None)
    }

    /// Returns the CT in Hounsfield units, in place, and the removals.
    ///
    /// # Errors
    /// [`SessionBoneError::Voxels`].
    pub fn parts(&mut self) -> Result<(&[i16], &mut Removals), SessionBoneError> {
        let hu = <[i16]>::ref_from_bytes(self.volume.tail()).map_err(|_| SessionBoneError::Voxels)?;
        Ok((hu, &mut self.removals))
    }
}

/// Removals in sequence order. Those from before the reader joined are read from the log being recorded.
#[derive(Debug)]
pub struct Removals {
    messages: Subscriber<Removed>,
    status: Subscriber<RunStatus>,
    queue: RemovalQueue,
    /// The log being recorded from the run's start, if any.
    log: Option<PathBuf>,
    looked: Option<Instant>,
    is_incomplete: bool,
}

/// Why some removals are unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RemovalLoss {
    /// The start of the run is not recorded, and voxels were removed before the reader joined.
    NotRecorded,
    /// The recorder lost them too.
    MissingFromLog,
}

impl Removals {
    /// Follows a session, whose folder this is.
    ///
    /// # Errors
    /// The session's services cannot be opened.
    fn open(session: &Session, folder: &Path) -> Result<Removals, SessionError> {
        Ok(Removals {
            messages: session.subscriber(&services::REMOVED)?,
            status: session.subscriber(&services::RUN_STATUS)?,
            queue: RemovalQueue::default(),
            log: recorded_in(folder).filter(|_| is_kept(folder)).map(|output| output.join("run.mcap")),
            looked: None,
            is_incomplete: false,
        })
    }

    /// Receives what has arrived, and reads the log for what is missing, at most twice a second. Returns the
    /// first loss, once.
    ///
    /// # Errors
    /// A transport error.
    pub fn poll(&mut self) -> Result<Option<RemovalLoss>, PortError> {
        for _ in 0..ROUND {
            let Some(received) = self.messages.receive_valid(|_| {})? else { break };
            self.queue.keep(*received.message(), received.tail());
        }
        if let Some(status) = self.status.receive_newest()? {
            self.queue.sent = self.queue.sent.max(status.message().removed_messages);
        }
        if self.queue.lacks_next() && self.looked.is_none_or(|looked| looked.elapsed() >= LOG_PERIOD) {
            self.looked = Some(Instant::now());
            let loss = self.read_log();
            return Ok(loss.filter(|_| !std::mem::replace(&mut self.is_incomplete, true)));
        }
        Ok(None)
    }

    /// Reads missing removals from the log. The newest may not be on disk yet; they are read in the next
    /// pass.
    fn read_log(&mut self) -> Option<RemovalLoss> {
        let Some(path) = &self.log else {
            // Without a log, earlier removals are unknown: continue from the first one received.
            self.queue.go_on();
            return Some(RemovalLoss::NotRecorded);
        };
        let Ok(mut stream) = MessageStream::open_topics(
            &LogFile::at(path),
            &[Topic::Removed.name().to_owned()],
            ReadOptions::default(),
        ) else {
            return None;
        };
        let mut logged = 0;
        while let Ok(Some(message)) = stream.next_message() {
            if let Ok((removed, tail)) = Removed::read_from_prefix(message.body) {
                logged = removed.sequence;
                self.queue.keep(removed, tail);
            }
        }
        self.queue.step_over_lost(logged).then_some(RemovalLoss::MissingFromLog)
    }

    /// Returns the next removal, with its voxels.
    #[expect(clippy::should_implement_trait, reason = "not an iterator: more can follow after `None`")]
    pub fn next(&mut self) -> Option<(Removed, Vec<u32>)> {
        self.queue.next()
    }

    /// Whether a removal has been sent that this reader does not have yet.
    pub fn lacks_next(&self) -> bool {
        self.queue.lacks_next()
    }
}

/// Returns whether a session that is recorded is recorded from its start.
fn is_kept(folder: &Path) -> bool {
    session_scene(folder).is_ok_and(|scene| scene.recording.ring_s == 0.0)
}

/// Removals waiting for their predecessors.
#[derive(Debug, Default)]
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
