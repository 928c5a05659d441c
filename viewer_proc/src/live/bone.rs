//! The bone's surface of a running session, in a thread of its own that borrows the volume where it lies.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ipc_types::messages::{Removed, RunStatus, Volume};
use ipc_types::ports::{PortError, Subscriber};
use ipc_types::services;
use ipc_types::session::{Session, SessionError};
use recorder_proc::topics;
use recorder_proc::{MessageStream, ReadOptions};
use zerocopy::FromBytes;

use crate::board::Board;
use crate::surface::Geometry;
use crate::surface::bone::Bone;

/// Time between two looks at the removals; the queue holds half a second of them at 1 kHz.
const LOOK_TIME: Duration = Duration::from_millis(4);
/// Time between two meshings.
const MESH_PERIOD: Duration = Duration::from_millis(50);
/// Time between two looks into the log for removals that were before our time.
const LOG_PERIOD: Duration = Duration::from_millis(500);

/// What the thread needs.
pub(super) struct BoneThread {
    pub session: PathBuf,
    pub threshold_hu: i16,
    pub board: Arc<Board>,
    pub over: Arc<AtomicBool>,
}

impl BoneThread {
    /// Starts it; `known` is told the volume's grid as soon as that is here.
    pub(super) fn start(self, known: impl FnOnce(&Geometry) + Send + 'static) {
        std::thread::spawn(move || {
            if let Err(error) = self.run(known) {
                self.board.notice("warning", &format!("the bone is not shown: {error}"));
            }
        });
    }

    fn run(&self, known: impl FnOnce(&Geometry)) -> Result<(), BoneError> {
        let session = Session::join(&self.session)?;
        let removals = Removals::open(&session, &self.session)?;
        let volumes = session.subscriber::<Volume>(&services::VOLUME)?;
        let volume = loop {
            if self.over.load(Ordering::Relaxed) {
                return Ok(());
            }
            match volumes.receive()? {
                Some(volume) => break volume,
                None => std::thread::sleep(LOOK_TIME),
            }
        };
        let geometry = geometry(volume.message());
        known(&geometry);
        let hu = voxels(volume.tail());
        let bone = Bone::new(geometry, self.threshold_hu);
        self.follow(bone, &hu, removals)
    }

    fn follow(&self, mut bone: Bone, hu: &[i16], mut removals: Removals) -> Result<(), BoneError> {
        let mut meshed: Option<Instant> = None;
        while !self.over.load(Ordering::Relaxed) {
            removals.look(&self.board)?;
            while let Some((removed, voxels)) = removals.next() {
                bone.take(&removed, &voxels);
            }
            if meshed.is_none_or(|meshed| meshed.elapsed() >= MESH_PERIOD) {
                bone.publish(hu, &self.board);
                meshed = Some(Instant::now());
            }
            std::thread::sleep(LOOK_TIME);
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
}

/// The grid of a volume message.
pub(super) fn geometry(volume: &Volume) -> Geometry {
    Geometry {
        origin_m: volume.origin_m,
        spacing_m: volume.spacing_m,
        direction: volume.direction,
        dimensions: volume.dimensions.map(|n| n as usize),
    }
}

/// The voxels in place, or a copy where they do not lie aligned.
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

/// Removals in the order of their numbers; those before our time come from the log that is being written.
struct Removals {
    messages: Subscriber<Removed>,
    status: Subscriber<RunStatus>,
    waiting: BTreeMap<u64, (Removed, Vec<u32>)>,
    /// Number of the last one that was handed out.
    last: u64,
    /// Removals that the physics has sent, as far as is known.
    sent: u64,
    /// The log that is being written, if there is one.
    log: Option<PathBuf>,
    looked: Option<Instant>,
    incomplete: bool,
}

impl Removals {
    fn open(session: &Session, folder: &Path) -> Result<Removals, SessionError> {
        let output = std::fs::read_to_string(folder.join(recorder_proc::process::OUTPUT_FILE)).ok();
        Ok(Removals {
            messages: session.subscriber(&services::REMOVED)?,
            status: session.subscriber(&services::RUN_STATUS)?,
            waiting: BTreeMap::new(),
            last: 0,
            sent: 0,
            log: output.map(|output| PathBuf::from(output).join("run.mcap")),
            looked: None,
            incomplete: false,
        })
    }

    fn look(&mut self, board: &Board) -> Result<(), PortError> {
        while let Some(received) = self.messages.receive()? {
            self.keep(*received.message(), received.tail());
        }
        if let Some(status) = self.status.receive_newest()? {
            self.sent = self.sent.max(status.message().removed_messages);
        }
        let missing = !self.waiting.contains_key(&(self.last + 1)) && self.sent > self.last;
        if missing && self.looked.is_none_or(|looked| looked.elapsed() >= LOG_PERIOD) {
            self.looked = Some(Instant::now());
            self.read_log(board);
        }
        Ok(())
    }

    fn keep(&mut self, removed: Removed, tail: &[u8]) {
        if removed.sequence > self.last {
            self.sent = self.sent.max(removed.sequence);
            self.waiting.insert(removed.sequence, (removed, indices(tail)));
        }
    }

    /// Reads what is missing. Its newest part may not be on the disk yet: it is then read again.
    fn read_log(&mut self, board: &Board) {
        let Some(path) = self.log.clone() else {
            // Without a log what was drilled before is not known: it goes on from what is.
            if let Some(first) = self.waiting.keys().next() {
                self.last = first - 1;
            }
            if !self.incomplete {
                self.incomplete = true;
                board.notice(
                    "warning",
                    "nothing is recorded: bone that was drilled before the viewer joined is shown whole",
                );
            }
            return;
        };
        let Ok(mut stream) =
            MessageStream::open_topics(&path, &[topics::REMOVED.to_owned()], ReadOptions::default())
        else {
            return;
        };
        while let Ok(Some(message)) = stream.next_message() {
            if let Ok((removed, tail)) = Removed::read_from_prefix(message.body) {
                self.keep(removed, tail);
            }
        }
    }

    fn next(&mut self) -> Option<(Removed, Vec<u32>)> {
        let next = self.waiting.remove(&(self.last + 1))?;
        self.last += 1;
        Some(next)
    }
}

/// Voxel indices of a removal's tail.
pub(crate) fn indices(tail: &[u8]) -> Vec<u32> {
    tail.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}
