//! The bone's surface of a running session, meshed in a separate thread that borrows the volume in place.

use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ipc_types::clock::now_ns;
use ipc_types::messages::Volume;
use ipc_types::messages::services;
use ipc_types::ports::PortError;
use ipc_types::session::{Session, SessionError};
use voxel_grid::{GridError, VoxelGrid};
use zerocopy::FromBytes;

use crate::board::Board;
use crate::calls::Calls;
use crate::error::ViewerError;
use crate::removals::{RemovalLoss, Removals};
use crate::slice::Slicer;
use crate::surface::bone::Bone;
use crate::threads;

/// Time between two polls of the removals; the queue holds half a second of them at 1 kHz.
const POLL_PERIOD: Duration = Duration::from_millis(4);
/// Time between two meshing passes.
const MESH_PERIOD: Duration = Duration::from_millis(50);

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
            if let Some(loss) = removals.poll()? {
                let text = match loss {
                    RemovalLoss::NotRecorded => {
                        "the start of the run is not recorded: bone drilled before the viewer joined is shown \
                         intact"
                    }
                    RemovalLoss::MissingFromLog => {
                        "removals are missing from the log: their bone is shown intact"
                    }
                };
                self.board.notice("warning", text);
            }
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
