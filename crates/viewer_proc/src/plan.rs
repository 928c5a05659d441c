//! A scene before its run: its initial state, bone with pilot holes, slices, measurements, and points that
//! can be moved. The edited scene can be saved under another name and run.
//!
//! A [`Planner`] implements moving, saving and running. It runs on its own thread, so that slices are served
//! meanwhile.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use ipc_types::clock::now_ns;
use ipc_types::messages::State;
use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;
use run_log::Topic;
use serde_json::{Value, json};
use voxel_grid::Volume;
use zerocopy::IntoBytes;

use crate::board::Board;
use crate::calls::{Call, Calls, call_queue};
use crate::channels::{Channels, INFO};
use crate::error::ViewerError;
use crate::info::{ArmMeshes, Origin, ToolShape, info};
use crate::live::CALL_QUEUE;
use crate::server::{ListeningPort, Server};
use crate::services::{Places, PlanRequest, Reply, Request};
use crate::slice::{NO_VOLUME, Slicer};
use crate::structure_meshes;
use crate::surface::Voxel;
use crate::surface::bone::{Bone, volume_box};
use crate::threads;

/// Time between two polls.
const POLL_PERIOD: Duration = Duration::from_millis(8);
/// Maximum number of waiting planner requests.
const PLAN_QUEUE: usize = 8;
/// Interval at which the planner's thread checks for a started run.
const RUN_LOOK: Duration = Duration::from_millis(50);

/// A scene ready for display.
#[derive(Debug, Clone)]
pub struct ScenePreview {
    /// The scene.
    pub scene: Scene,
    /// Its tool's shape.
    pub tool: ToolShape,
    /// Its state before the first tick.
    pub state: State,
    /// Voxels of the pilot holes.
    pub predrilled: Vec<u32>,
    /// Its measurements, for the page.
    pub plan: Value,
    /// Findings of `scene check`.
    pub findings: Vec<String>,
}

/// Result of saving a scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SaveOutcome {
    /// Saved to this file.
    As(PathBuf),
    /// Not saved: a file of that name exists.
    Exists(PathBuf),
}

/// Changes, saves and runs a scene. Errors are texts for the user, identical to those of the command line.
pub trait Planner: Send {
    /// Moves points. An invalid move is refused and changes nothing.
    ///
    /// # Errors
    /// The moved scene would be invalid.
    fn move_places(&mut self, places: &Places) -> Result<ScenePreview, String>;

    /// Undoes all moves.
    ///
    /// # Errors
    /// The file is no longer a valid scene.
    fn restore(&mut self) -> Result<ScenePreview, String>;

    /// Predicts the run of the shown scene, unless that has been done; returns the scene with its prediction.
    /// Gives up and returns `None` once `is_to_end` returns true.
    fn predict(&mut self, is_to_end: &mut dyn FnMut() -> bool) -> Option<ScenePreview>;

    /// Writes the scene to the folder of the original file.
    ///
    /// # Errors
    /// Invalid file name, or the file cannot be written.
    fn save(&mut self, name: &str, replace: bool) -> Result<SaveOutcome, String>;

    /// Starts a run of the scene as last saved.
    ///
    /// # Errors
    /// The scene has unsaved changes, a run is in progress, or the program cannot be started.
    fn run(&mut self) -> Result<(), String>;

    /// Returns the session folder of a started run once it can be joined, or an error text if it failed to
    /// start; `None` if there is no news.
    fn session(&mut self) -> Option<Result<PathBuf, String>>;
}

/// Messages from the planner's thread to the display.
enum PlannerMessage {
    Changed(Box<ScenePreview>),
    Session(PathBuf),
    NoRun(String),
}

/// Shows a scene file until the process is asked to end or a run of it has started; in the latter case,
/// returns that run's session.
///
/// # Errors
/// The server or a thread cannot be started.
pub fn view(
    path: &Path,
    (first, looks, volume): (ScenePreview, ArmMeshes, Option<&Volume>),
    mut planner: impl Planner,
    door: &ListeningPort,
    ready: impl FnOnce(),
    end: &EndRequest,
) -> Result<Option<PathBuf>, ViewerError> {
    let scene = &first.scene;
    let board = Arc::new(Board::new(Channels::new(&scene.controller_names(), scene.has_readings())));
    let (calls, called) = call_queue(CALL_QUEUE);
    let over = Arc::new(AtomicBool::new(false));
    let name = path.display().to_string();
    let server = Server::behind(door, &name, Arc::clone(&board), calls, Arc::clone(&over))?;
    let threshold_hu = scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu);
    let bone = volume.map(|volume| (Bone::new(volume.grid, threshold_hu), volume.hu.as_slice()));
    let mut shown = Shown { board, origin: Origin::Plan(name), bone, predrilled: HashSet::new() };
    first.findings.iter().for_each(|text| shown.board.notice("warning", text));
    shown.take(&first);
    looks.publish(&shown.board);
    structure_meshes::publish(scene, &shown.board);
    let (asked, asking) = mpsc::sync_channel(PLAN_QUEUE);
    let (tell, told) = mpsc::channel();
    let stop = Arc::clone(&over);
    std::thread::scope(|scope| {
        let serving = threads::start_in(scope, "server", || server.serve())?;
        let planning = threads::start_in(scope, "plan", move || plan(&mut planner, &asking, &tell, &stop));
        let session = planning.map(|_| {
            ready();
            shown.serve(&called, &asked, &told, end)
        });
        over.store(true, Ordering::Relaxed);
        serving.join().unwrap_or(Ok(())).and(session)
    })
}

/// The state shown on the board.
struct Shown<'a> {
    board: Arc<Board>,
    origin: Origin,
    bone: Option<(Bone, &'a [i16])>,
    predrilled: HashSet<u32>,
}

impl Shown<'_> {
    fn take(&mut self, planned: &ScenePreview) {
        let grid = self.bone.as_ref().map(|(bone, _)| volume_box(bone.field().grid()));
        let mut told = info(&planned.scene, &self.origin, &planned.tool, grid.as_ref());
        told["plan"] = planned.plan.clone();
        let predrilled: HashSet<u32> = planned.predrilled.iter().copied().collect();
        if let Some((bone, _)) = &mut self.bone {
            self.predrilled.difference(&predrilled).for_each(|index| bone.set(*index, Voxel::Present));
            predrilled.difference(&self.predrilled).for_each(|index| bone.set(*index, Voxel::Removed));
        }
        self.predrilled = predrilled;
        self.board.publish_json(INFO, &told);
        self.board.publish_cdr(Topic::State.name(), 0, &[planned.state.as_bytes()]);
    }

    fn serve(
        &mut self,
        called: &Calls,
        asked: &mpsc::SyncSender<Call>,
        told: &mpsc::Receiver<PlannerMessage>,
        end: &EndRequest,
    ) -> Option<PathBuf> {
        let mut slicer = Slicer::new(now_ns());
        while !end.is_set() {
            called.try_iter().for_each(|call| dispatch(call, &mut slicer, asked));
            for news in told.try_iter() {
                match news {
                    PlannerMessage::Changed(planned) => self.take(&planned),
                    PlannerMessage::NoRun(why) => self.board.notice("error", &why),
                    PlannerMessage::Session(session) => {
                        self.board.go_on();
                        return Some(session);
                    }
                }
            }
            let mut is_pending = false;
            match &mut self.bone {
                Some((bone, hu)) => {
                    is_pending = bone.publish(hu, &self.board);
                    slicer.answer(bone.field(), hu, now_ns());
                }
                None => slicer.refuse(NO_VOLUME),
            }
            if !is_pending {
                std::thread::sleep(POLL_PERIOD);
            }
        }
        None
    }
}

fn dispatch(call: Call, slicer: &mut Slicer, asked: &mpsc::SyncSender<Call>) {
    match call.request {
        Request::Slice(_) => slicer.add(call),
        Request::Plan(_) => {
            if let Err(mpsc::TrySendError::Full(call) | mpsc::TrySendError::Disconnected(call)) =
                asked.try_send(call)
            {
                call.refuse("busy with earlier changes of the plan");
            }
        }
        _ => call.refuse("no run in progress: this is a scene before its run; start it with Run"),
    }
}

/// Answers planner requests until the viewer shows something else.
fn plan(
    planner: &mut impl Planner,
    asking: &mpsc::Receiver<Call>,
    tell: &mpsc::Sender<PlannerMessage>,
    over: &AtomicBool,
) {
    let mut next = None;
    while !over.load(Ordering::Relaxed) {
        let news = match planner.session() {
            Some(Ok(session)) => Some(PlannerMessage::Session(session)),
            Some(Err(why)) => Some(PlannerMessage::NoRun(why)),
            None => None,
        };
        // The viewer may be ending.
        news.into_iter().for_each(|news| drop(tell.send(news)));
        let Some(call) = next.take().or_else(|| asking.recv_timeout(RUN_LOOK).ok()) else {
            // Nothing else to do: a prediction, which a request interrupts.
            let predicted = planner.predict(&mut || {
                next = next.take().or_else(|| asking.try_recv().ok());
                next.is_some() || over.load(Ordering::Relaxed)
            });
            predicted.into_iter().for_each(|shown| drop(tell.send(PlannerMessage::Changed(Box::new(shown)))));
            continue;
        };
        let Request::Plan(request) = &call.request else { continue };
        let changed = match request {
            PlanRequest::Move { places } => planner.move_places(places),
            PlanRequest::Restore => planner.restore(),
            PlanRequest::Save { name, replace } => {
                let outcome = planner.save(name, *replace).map(|saved| Reply::Json(saved_json(&saved)));
                drop(call.answer.send(outcome));
                continue;
            }
            PlanRequest::Run => {
                drop(call.answer.send(planner.run().map(|()| Reply::Done)));
                continue;
            }
        };
        let outcome = changed.map(|planned| {
            drop(tell.send(PlannerMessage::Changed(Box::new(planned))));
            Reply::Done
        });
        // The client may have disconnected.
        drop(call.answer.send(outcome));
    }
}

fn saved_json(saved: &SaveOutcome) -> String {
    match saved {
        SaveOutcome::As(path) => json!({"ok": true, "path": path}).to_string(),
        SaveOutcome::Exists(path) => {
            json!({"ok": false, "exists": true, "error": format!("{} exists", path.display())}).to_string()
        }
    }
}
