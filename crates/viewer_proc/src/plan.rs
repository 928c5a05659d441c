//! A scene before its run: its first state, its bone with the pilot holes, slices, what was measured of its
//! plan, and its places, which can be moved, saved as another scene, and run.
//!
//! What a moved place means, how a scene is written and how one is run, a [`Planner`] knows. It works on a
//! thread of its own, so that slices come meanwhile.

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
use crate::channels::{Channels, INFO};
use crate::error::ViewerError;
use crate::info::{ArmLooks, Origin, ToolShape, info};
use crate::live::CALL_QUEUE;
use crate::server::{Door, Server};
use crate::services::{Call, Calls, Places, PlanRequest, Reply, Request};
use crate::slice::{NO_VOLUME, Slicer};
use crate::surface::Voxel;
use crate::surface::bone::{Bone, volume_box};

/// Time between two polls.
const POLL_PERIOD: Duration = Duration::from_millis(8);
/// Requests to the planner that may wait.
const PLAN_QUEUE: usize = 8;
/// How often the planner's thread looks for a run that was started.
const RUN_LOOK: Duration = Duration::from_millis(50);

/// A scene as it is shown.
#[derive(Debug, Clone)]
pub struct Planned {
    /// The scene.
    pub scene: Scene,
    /// Its tool's shape.
    pub tool: ToolShape,
    /// Its state before the first tick.
    pub state: State,
    /// Voxels of the pilot holes.
    pub predrilled: Vec<u32>,
    /// What was measured of it, for the page.
    pub plan: Value,
    /// What `scene check` finds.
    pub findings: Vec<String>,
}

/// What came of saving a scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Saved {
    /// It is in this file.
    As(PathBuf),
    /// Nothing was written: there is a file of that name.
    Exists(PathBuf),
}

/// Changes, saves and runs a scene. Errors are texts for the user, the same that the command line prints.
pub trait Planner: Send {
    /// Moves places; what cannot be is refused and changes nothing.
    ///
    /// # Errors
    /// The scene would be refused.
    fn move_places(&mut self, places: &Places) -> Result<Planned, String>;

    /// Takes everything back that was moved.
    ///
    /// # Errors
    /// The file is no scene any more.
    fn restore(&mut self) -> Result<Planned, String>;

    /// Writes the scene beside the one that was opened.
    ///
    /// # Errors
    /// Not a file's name, or not to be written.
    fn save(&mut self, name: &str, replace: bool) -> Result<Saved, String>;

    /// Starts a run of the scene as it was saved last.
    ///
    /// # Errors
    /// It was changed since, a run is under way, or the program cannot be started.
    fn run(&mut self) -> Result<(), String>;

    /// Folder of the session of a run that was started, once it can be joined, or why there is none; `None`:
    /// nothing new.
    fn session(&mut self) -> Option<Result<PathBuf, String>>;
}

/// What the planner's thread tells the one that shows.
enum News {
    Changed(Box<Planned>),
    Session(PathBuf),
    NoRun(String),
}

/// Shows the scene of a file until the process is asked to end, or a run of it has begun: then returns that
/// run's session.
///
/// # Errors
/// The server cannot be started.
pub fn view(
    path: &Path,
    (first, looks, volume): (Planned, ArmLooks, Option<&Volume>),
    mut planner: impl Planner,
    door: &Door,
    ready: impl FnOnce(),
    end: &EndRequest,
) -> Result<Option<PathBuf>, ViewerError> {
    let scene = &first.scene;
    let board = Arc::new(Board::new(Channels::new(&scene.controller_names(), &scene.sensor)));
    let (calls, called) = mpsc::sync_channel(CALL_QUEUE);
    let over = Arc::new(AtomicBool::new(false));
    let name = path.display().to_string();
    let server = Server::behind(door, &name, Arc::clone(&board), calls, Arc::clone(&over))?;
    let threshold_hu = scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu);
    let bone = volume.map(|volume| (Bone::new(volume.grid, threshold_hu), volume.hu.as_slice()));
    let mut shown = Shown { board, origin: Origin::Plan(name), bone, predrilled: HashSet::new() };
    first.findings.iter().for_each(|text| shown.board.notice("warning", text));
    shown.take(&first);
    looks.publish(&shown.board);
    ready();
    let (asked, asking) = mpsc::sync_channel(PLAN_QUEUE);
    let (tell, told) = mpsc::channel();
    let stop = Arc::clone(&over);
    std::thread::scope(|scope| {
        let serving = scope.spawn(|| server.serve());
        scope.spawn(move || plan(&mut planner, &asking, &tell, &stop));
        let session = shown.serve(&called, &asked, &told, end);
        over.store(true, Ordering::Relaxed);
        serving.join().unwrap_or(Ok(())).map(|()| session)
    })
}

/// What is on the board.
struct Shown<'a> {
    board: Arc<Board>,
    origin: Origin,
    bone: Option<(Bone, &'a [i16])>,
    predrilled: HashSet<u32>,
}

impl Shown<'_> {
    fn take(&mut self, planned: &Planned) {
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
        told: &mpsc::Receiver<News>,
        end: &EndRequest,
    ) -> Option<PathBuf> {
        let mut slicer = Slicer::new(now_ns());
        while !end.is_set() {
            called.try_iter().for_each(|call| dispatch(call, &mut slicer, asked));
            for news in told.try_iter() {
                match news {
                    News::Changed(planned) => self.take(&planned),
                    News::NoRun(why) => self.board.notice("error", &why),
                    News::Session(session) => {
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
        _ => call.refuse("nothing runs yet: this is a scene before its run; start it with Run"),
    }
}

/// Answers what is asked of the planner, until the viewer shows something else.
fn plan(
    planner: &mut impl Planner,
    asking: &mpsc::Receiver<Call>,
    tell: &mpsc::Sender<News>,
    over: &AtomicBool,
) {
    while !over.load(Ordering::Relaxed) {
        let news = match planner.session() {
            Some(Ok(session)) => Some(News::Session(session)),
            Some(Err(why)) => Some(News::NoRun(why)),
            None => None,
        };
        // The viewer may be ending.
        news.into_iter().for_each(|news| drop(tell.send(news)));
        let Ok(call) = asking.recv_timeout(RUN_LOOK) else { continue };
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
            drop(tell.send(News::Changed(Box::new(planned))));
            Reply::Done
        });
        // The client may have left.
        drop(call.answer.send(outcome));
    }
}

fn saved_json(saved: &Saved) -> String {
    match saved {
        Saved::As(path) => json!({"ok": true, "path": path}).to_string(),
        Saved::Exists(path) => {
            json!({"ok": false, "exists": true, "error": format!("{} exists", path.display())}).to_string()
        }
    }
}
