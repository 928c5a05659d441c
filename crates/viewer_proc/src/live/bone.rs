//! The bone's surface of a running session, meshed in a separate thread that borrows the volume in place.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ipc_types::clock::now_ns;
use voxel_grid::VoxelGrid;

use crate::board::Board;
use crate::calls::Calls;
use crate::error::ViewerError;
use crate::removals::{RemovalLoss, SessionBone, SessionBoneError};
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

    fn run(&self, known: impl FnOnce(&VoxelGrid)) -> Result<(), SessionBoneError> {
        let Some(mut session) = SessionBone::join(&self.session, &self.over)? else { return Ok(()) };
        known(&session.grid);
        let mut bone = Bone::new(session.grid, self.threshold_hu);
        let (hu, removals) = session.parts()?;
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
