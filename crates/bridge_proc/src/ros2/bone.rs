//! The bone: removed voxels and its surface, prepared in a thread of their own, because neither the reading
//! of a log nor a mesh may delay a command.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ipc_types::messages::Removed;
use ipc_types::scene::Scene;
use ros_interface::bone::{POINTS_PER_CLOUD, SURFACE_TRIANGLES, of_grid, of_removed, of_surface};
use ros_interface::msg::Time;
use ros_interface::outgoing::Outgoing;
use viewer_proc::removals::{RemovalLoss, SessionBone, SessionBoneError};
use viewer_proc::surface::{BlockMesh, CoarseBone, Field, Voxel};
use voxel_grid::VoxelGrid;

/// Time between two polls, and between two clouds; the queue holds half a second of removals at 1 kHz.
const POLL_PERIOD: Duration = Duration::from_millis(5);
/// Shortest time between two surfaces.
const SURFACE_PERIOD: Duration = Duration::from_secs(1);
/// Cells of the first attempt at a surface.
const FIRST_CELLS: usize = 100_000;
/// How long the thread waits for removals that the log still lacks at the end of the run.
const END_LIMIT: Duration = Duration::from_secs(3);

/// What the node tells the thread.
#[derive(Debug, Default)]
struct Wishes {
    /// A subscriber of the clouds has joined: it needs everything so far.
    all_voxels: AtomicBool,
    /// Somebody subscribes to the surface.
    surface: AtomicBool,
    /// The session is over: send what is left, and end.
    end: AtomicBool,
}

/// The thread, as the node sees it.
#[derive(Debug)]
pub(super) struct Bone {
    wishes: Arc<Wishes>,
    made: Receiver<Result<Vec<Outgoing>, String>>,
    thread: Option<JoinHandle<()>>,
}

impl Bone {
    /// Starts the thread for a session with a volume.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub(super) fn start(session: &Path, scene: &Scene, threshold_hu: i16) -> std::io::Result<Bone> {
        let wishes = Arc::new(Wishes::default());
        // One message waits while the next is made: a slow subscriber makes the clouds larger, not the queue.
        let (made, receiver) = sync_channel(1);
        let work = Work { session: session.to_owned(), threshold_hu, dt_s: scene.dt_s() };
        let told = wishes.clone();
        let thread = std::thread::Builder::new().name("bone".to_owned()).spawn(move || {
            if let Err(error) = work.run(&told, &made) {
                let _ = made.send(Err(format!("the bone is not published: {error}")));
            }
        })?;
        Ok(Bone { wishes, made: receiver, thread: Some(thread) })
    }

    /// Asks for everything removed so far, for a new subscriber.
    pub(super) fn send_all(&self) {
        self.wishes.all_voxels.store(true, Ordering::Relaxed);
    }

    /// Sets whether somebody subscribes to the surface.
    pub(super) fn set_surface_wanted(&self, is_wanted: bool) {
        self.wishes.surface.store(is_wanted, Ordering::Relaxed);
    }

    /// Returns the next messages, or a line about what is missing, if there are any.
    pub(super) fn next(&self) -> Option<Result<Vec<Outgoing>, String>> {
        self.made.try_recv().ok()
    }

    /// Tells the thread that the session is over, and returns what is left, one after the other.
    pub(super) fn rest(&mut self) -> impl Iterator<Item = Result<Vec<Outgoing>, String>> + '_ {
        self.wishes.end.store(true, Ordering::Relaxed);
        self.made.iter()
    }
}

impl Drop for Bone {
    fn drop(&mut self) {
        self.wishes.end.store(true, Ordering::Relaxed);
        // Ends the thread's sending.
        let (_, closed) = sync_channel(1);
        self.made = closed;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Inputs of the thread.
struct Work {
    session: PathBuf,
    threshold_hu: i16,
    dt_s: f64,
}

impl Work {
    fn run(
        &self,
        wishes: &Wishes,
        made: &SyncSender<Result<Vec<Outgoing>, String>>,
    ) -> Result<(), SessionBoneError> {
        let Some(mut session) = SessionBone::join(&self.session, &wishes.end)? else { return Ok(()) };
        let grid = session.grid;
        let (hu, removals) = session.parts()?;
        if made.send(Ok(of_grid(&grid))).is_err() {
            return Ok(());
        }
        let mut voxels = Voxels::new(grid, self.threshold_hu);
        let mut surface = Surface::new(grid, self.threshold_hu);
        let mut stamp = Time::default();
        let mut ending: Option<Instant> = None;
        loop {
            if let Some(loss) = removals.poll()? {
                let why = match loss {
                    RemovalLoss::NotRecorded => "the start of the run is not recorded",
                    RemovalLoss::MissingFromLog => "the log lacks them",
                };
                let line = format!("/removed_voxels/points: removals from before now are unknown: {why}");
                if made.send(Err(line)).is_err() {
                    return Ok(());
                }
            }
            while let Some((removed, indices)) = removals.next() {
                voxels.apply(&removed, &indices, &mut surface);
                stamp = Time::of_simulated(removed.tick as f64 * self.dt_s);
            }
            if wishes.all_voxels.swap(false, Ordering::Relaxed) {
                voxels.repeat_all();
            }
            let is_over = wishes.end.load(Ordering::Relaxed);
            if is_over && ending.is_none() {
                ending = Some(Instant::now());
            }
            match voxels.cloud(stamp) {
                Some(cloud) => match made.try_send(Ok(cloud)) {
                    Ok(()) => voxels.sent(),
                    Err(TrySendError::Full(_)) => {}
                    Err(TrySendError::Disconnected(_)) => return Ok(()),
                },
                None if ending.is_some_and(|begin| !removals.lacks_next() || begin.elapsed() > END_LIMIT) => {
                    return Ok(());
                }
                None => {}
            }
            if !is_over
                && wishes.surface.load(Ordering::Relaxed)
                && let Some(messages) = surface.messages(&voxels.field, hu, stamp)
            {
                match made.try_send(Ok(messages)) {
                    Ok(()) => surface.sent(),
                    Err(TrySendError::Full(_)) => {}
                    Err(TrySendError::Disconnected(_)) => return Ok(()),
                }
            }
            std::thread::sleep(POLL_PERIOD);
        }
    }
}

/// Which voxels are removed, and which of them subscribers have yet to be told.
struct Voxels {
    field: Field,
    predrilled: Vec<u32>,
    /// Not yet sent.
    pending: Vec<u32>,
    /// Whether subscribers have to forget everything first.
    is_reset: bool,
}

impl Voxels {
    fn new(grid: VoxelGrid, threshold_hu: i16) -> Voxels {
        let field = Field::new(grid, threshold_hu);
        Voxels { field, predrilled: Vec::new(), pending: Vec::new(), is_reset: false }
    }

    fn apply(&mut self, removed: &Removed, indices: &[u32], surface: &mut Surface) {
        if removed.tick == 0 {
            self.predrilled.extend_from_slice(indices);
        }
        if removed.restore_first != 0 {
            for index in self.field.removed() {
                self.set(index, Voxel::Present, surface);
            }
            self.is_reset = true;
            self.pending.clear();
            for index in self.predrilled.clone() {
                self.remove(index, surface);
            }
        }
        indices.iter().for_each(|index| self.remove(*index, surface));
    }

    fn remove(&mut self, index: u32, surface: &mut Surface) {
        if self.set(index, Voxel::Removed, surface) {
            self.pending.push(index);
        }
    }

    fn set(&mut self, index: u32, voxel: Voxel, surface: &mut Surface) -> bool {
        let has_changed = self.field.set(index, voxel);
        if has_changed && let Some(voxel) = self.field.grid().voxel(index as usize) {
            surface.touch(voxel);
        }
        has_changed
    }

    /// Sends everything again: what subscribers know already changes nothing for them.
    fn repeat_all(&mut self) {
        self.pending = self.field.removed();
    }

    /// Returns the next cloud, if there is something to tell.
    fn cloud(&self, stamp: Time) -> Option<Vec<Outgoing>> {
        let first = if self.is_reset { &[][..] } else { &self.pending };
        (self.is_reset || !first.is_empty()).then(|| of_removed(self.field.grid(), first, stamp))
    }

    /// Takes note that the cloud is on its way.
    fn sent(&mut self) {
        if !std::mem::replace(&mut self.is_reset, false) {
            self.pending.drain(..self.pending.len().min(POINTS_PER_CLOUD));
        }
    }
}

/// The surface of the bone, in as many triangles as a message may have.
struct Surface {
    grid: VoxelGrid,
    threshold_hu: i16,
    /// `None` until somebody wants it.
    bone: Option<CoarseBone>,
    blocks: BTreeMap<u32, BlockMesh>,
    has_changed: bool,
    made: Option<Instant>,
}

impl Surface {
    fn new(grid: VoxelGrid, threshold_hu: i16) -> Surface {
        Surface { grid, threshold_hu, bone: None, blocks: BTreeMap::new(), has_changed: true, made: None }
    }

    fn touch(&mut self, voxel: [usize; 3]) {
        self.has_changed = true;
        self.bone.iter_mut().for_each(|bone| bone.touch(voxel));
    }

    /// Returns the surface, if it has changed and the last one is a second old.
    fn messages(&mut self, voxels: &Field, hu: &[i16], stamp: Time) -> Option<Vec<Outgoing>> {
        if !self.has_changed || self.made.is_some_and(|made| made.elapsed() < SURFACE_PERIOD) {
            return None;
        }
        self.made = Some(Instant::now());
        let mut most_cells = FIRST_CELLS;
        loop {
            if self.bone.is_none() {
                self.blocks.clear();
                self.bone = CoarseBone::with_cells(&self.grid, self.threshold_hu, most_cells).ok();
            }
            let bone = self.bone.as_mut()?;
            bone.update(voxels, hu);
            self.blocks.extend(bone.mesh_changed().into_iter().map(|mesh| (mesh.block, mesh)));
            let triangles = self.blocks.values().map(|mesh| mesh.indices.len() / 3).sum::<usize>();
            if triangles <= SURFACE_TRIANGLES {
                break;
            }
            // A surface has as many triangles as cells to the power of two thirds; a margin, because it grows
            // while it is drilled.
            let share = 0.9 * SURFACE_TRIANGLES as f64 / triangles as f64;
            most_cells = ((bone.cell_count() as f64 * share.powf(1.5)) as usize).max(1);
            self.bone = None;
        }
        let corners = self.blocks.values().flat_map(|mesh| mesh.indices.iter().map(|at| mesh.vertex_m(*at)));
        Some(of_surface(corners, stamp))
    }

    fn sent(&mut self) {
        self.has_changed = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> VoxelGrid {
        VoxelGrid::axis_aligned([60; 3], [1e-3; 3], [0.0; 3]).unwrap()
    }

    fn removed(tick: u64, restore_first: u32) -> Removed {
        Removed { tick, restore_first, ..Removed::zeroed() }
    }

    /// Returns the voxels of each cloud, as a subscriber reads them.
    fn clouds(voxels: &mut Voxels) -> Vec<Vec<u32>> {
        let mut all = Vec::new();
        while let Some(mut cloud) = voxels.cloud(Time::default()) {
            voxels.sent();
            let cdr = cloud.remove(0).cdr;
            // The width follows stamp, frame and height; `is_dense` follows the points.
            let count = u32::from_le_bytes(cdr[24..28].try_into().unwrap()) as usize;
            let (points, first) = (&cdr[..cdr.len() - 1], cdr.len() - 1 - 16 * count);
            let index = |point: &[u8]| u32::from_le_bytes(point[12..].try_into().unwrap());
            all.push(points[first..].chunks_exact(16).map(index).collect());
        }
        all
    }

    #[test]
    fn clouds_hold_each_removal_once_a_late_subscriber_gets_all_and_a_reset_is_an_empty_cloud() {
        let (mut voxels, mut surface) = (Voxels::new(grid(), 150), Surface::new(grid(), 150));
        voxels.apply(&removed(0, 0), &[7, 8], &mut surface);
        voxels.apply(&removed(5, 0), &[100, 101], &mut surface);
        assert_eq!(clouds(&mut voxels), [[7, 8, 100, 101]]);
        voxels.apply(&removed(6, 0), &[101, 102], &mut surface);
        assert_eq!(clouds(&mut voxels), [[102]]);
        voxels.repeat_all();
        assert_eq!(clouds(&mut voxels), [[7, 8, 100, 101, 102]]);
        voxels.apply(&removed(7, 0), &[103], &mut surface);
        voxels.apply(&removed(8, 1), &[200], &mut surface);
        assert_eq!(clouds(&mut voxels), [vec![], vec![7, 8, 200]], "103 is restored before it is sent");
        let many: Vec<u32> = (1000..1000 + POINTS_PER_CLOUD as u32 + 5).collect();
        voxels.apply(&removed(9, 0), &many, &mut surface);
        let sizes: Vec<usize> = clouds(&mut voxels).iter().map(Vec::len).collect();
        assert_eq!(sizes, [POINTS_PER_CLOUD, 5]);
    }

    #[test]
    fn the_surface_fits_a_message_encloses_the_bone_and_follows_the_drill() {
        let hu = vec![1000; grid().voxel_count()];
        let (mut voxels, mut surface) = (Voxels::new(grid(), 150), Surface::new(grid(), 150));
        let volume_mm3 = |surface: &Surface| {
            let mut six_times = 0.0;
            for mesh in surface.blocks.values() {
                for corners in mesh.indices.chunks_exact(3) {
                    let [a, b, c] =
                        core::array::from_fn(|at| nalgebra::Vector3::from(mesh.vertex_m(corners[at])));
                    six_times += a.cross(&b).dot(&c) * 1e9;
                }
            }
            six_times / 6.0
        };
        let messages = surface.messages(&voxels.field, &hu, Time::default()).unwrap();
        assert!(
            messages[0].cdr.len() < 180_000 && messages[0].cdr.len() > 60_000,
            "{}",
            messages[0].cdr.len()
        );
        let whole_mm3 = volume_mm3(&surface);
        assert!((whole_mm3 / 60_f64.powi(3) - 1.0).abs() < 0.1, "{whole_mm3}");
        surface.sent();
        surface.made = None;
        assert!(surface.messages(&voxels.field, &hu, Time::default()).is_none(), "nothing has changed");
        // Half of the block is drilled away.
        let half: Vec<u32> = (0..30 * 60 * 60).collect();
        voxels.apply(&removed(1, 0), &half, &mut surface);
        assert!(surface.messages(&voxels.field, &hu, Time::default()).is_some());
        let drilled_mm3 = volume_mm3(&surface);
        assert!((drilled_mm3 / whole_mm3 - 0.5).abs() < 0.1, "{drilled_mm3} of {whole_mm3}");
        surface.sent();
        voxels.apply(&removed(2, 0), &[half.len() as u32], &mut surface);
        assert!(surface.messages(&voxels.field, &hu, Time::default()).is_none(), "at most once a second");
    }
}
