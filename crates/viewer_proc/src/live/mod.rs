//! Watches and controls a running session.

mod bone;
mod control;
mod drive;
mod followed_log;
mod frame_requests;
mod parts;
mod subscriptions;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use ipc_types::messages::Part;
use ipc_types::process::{EndRequest, session_scene};
use ipc_types::scene::Scene;
use ipc_types::session::{SegmentSweeper, Session};
use run_log::EndReason;

use crate::board::Board;
use crate::calls::{Call, CallSender, Calls, call_queue};
use crate::channels::{Channels, INFO};
use crate::error::ViewerError;
use crate::info::{ArmMeshes, Origin, ToolShape, info};
use crate::left::IdleTimer;
use crate::server::{ListeningPort, Server};
use crate::services::Request;
use crate::slice::NO_VOLUME;
use crate::structure_meshes;
use crate::surface::bone::volume_box;
use crate::threads;
use bone::BoneThread;
use control::Control;
use drive::Driver;
use followed_log::FollowedLog;
pub(crate) use followed_log::recorded_in;
use subscriptions::Subscriptions;

/// Time between two polls of the queues, which hold half a second.
const POLL_PERIOD: Duration = Duration::from_millis(4);
/// Maximum number of queued calls.
pub(crate) const CALL_QUEUE: usize = 64;
const ALIVE_LOOK: Duration = Duration::from_millis(200);
/// Timeout for completing a log: as long as the launcher gives the recorder.
const LOG_LIMIT: Duration = Duration::from_secs(130);
/// The page recognizes a regular end by this string.
const RUN_ENDED: &str = "the run has ended";
const HUB_DIED: &str = "the hub has died: its launcher and the run are gone";

/// Watches the session in a folder until it ends or the process is asked to end. Calls `shapes` to get the
/// shapes of tool and arm, and `ready` when pages can be opened. Returns the run's complete log if the run
/// ended regularly, was recorded, and a client is still connected.
///
/// # Errors
/// The session cannot be joined, or a thread cannot be started.
pub fn view(
    folder: &Path,
    door: &ListeningPort,
    shapes: impl FnOnce(&Scene) -> (ToolShape, ArmMeshes),
    ready: impl FnOnce(),
    end: &EndRequest,
) -> Result<Option<PathBuf>, ViewerError> {
    // The viewer must end even if the host was killed while it was creating a segment.
    let _sweeper = SegmentSweeper::after_host(folder);
    let session = Session::join(folder)?;
    let mut log = FollowedLog::of(folder);
    // A short run may be over, and its folder deleted, before the next poll.
    log.look();
    let scene = session_scene(folder)?;
    let board = Arc::new(Board::new(Channels::new(&scene.controller_names(), scene.has_readings())));
    let (calls, called) = call_queue(CALL_QUEUE);
    let over = Arc::new(AtomicBool::new(false));
    let name = folder.display().to_string();
    let server = Server::behind(door, &name, Arc::clone(&board), calls, Arc::clone(&over))?;
    let (tool, looks) = shapes(&scene);
    let origin = Origin::Live(name);
    board.publish_json(INFO, &info(&scene, &origin, &tool, None));
    looks.publish(&board);
    structure_meshes::publish(&scene, &board);
    let subscriptions = Subscriptions::open(&session, &scene, &tool)?;
    let slices = if let Some(volume) = &scene.volume {
        let (slices, asked) = call_queue(CALL_QUEUE);
        let thread = BoneThread {
            session: folder.to_owned(),
            threshold_hu: volume.bone_threshold_hu,
            board: Arc::clone(&board),
            over: Arc::clone(&over),
            asked,
        };
        let (board, scene) = (Arc::clone(&board), scene.clone());
        thread.start(move |grid| {
            board.publish_json(INFO, &info(&scene, &origin, &tool, Some(&volume_box(grid))));
        })?;
        Some(slices)
    } else {
        None
    };
    let control = Control::open(&session)?;
    let driver = Driver::start(folder, &scene, Arc::clone(&over), Arc::clone(&board))?;
    let serving = threads::start("server", move || server.serve())?;
    ready();
    let mut live = Live { board, subscriptions, control, driver, slices, called, log, dt_ns: scene.dt_ns() };
    let watched = live.watch(&session, end).map(|ended| live.whole_log(ended, end));
    // Leaves time for the last messages to reach the clients.
    std::thread::sleep(Duration::from_millis(200));
    over.store(true, Ordering::Relaxed);
    let served = serving.join().unwrap_or(Ok(()));
    served.and(watched)
}

struct Live {
    board: Arc<Board>,
    subscriptions: Subscriptions,
    control: Control,
    driver: Driver,
    /// Sends to the thread that reads the volume; `None` if the scene has no volume.
    slices: Option<CallSender>,
    called: Calls,
    log: FollowedLog,
    dt_ns: u64,
}

/// How a session ended.
#[derive(Clone, Copy, PartialEq, Eq)]
enum SessionEnd {
    /// The run reported its end.
    Heard,
    /// The host removed the session, or another program cleaned up after a host that died; only the log has
    /// the reason. A short run may end before this viewer receives anything.
    Unheard,
    /// The host died, or the viewer was asked to end.
    Otherwise,
}

impl Live {
    fn watch(&mut self, session: &Session, end: &EndRequest) -> Result<SessionEnd, ViewerError> {
        let mut alive_seen = Instant::now();
        loop {
            self.log.look();
            self.subscriptions.poll(&self.board)?;
            if self.subscriptions.physics_is_heard() {
                self.control.physics_listens()?;
            }
            self.control.poll(&self.board, self.dt_ns)?;
            while let Ok(call) = self.called.try_recv() {
                self.dispatch(call);
            }
            if self.has_said_its_end(session) {
                return Ok(SessionEnd::Heard);
            }
            if end.is_set() {
                self.board.notice("info", "the viewer was stopped");
                return Ok(SessionEnd::Otherwise);
            }
            if alive_seen.elapsed() > ALIVE_LOOK || self.subscriptions.run_has_ended() {
                alive_seen = Instant::now();
                if !session.host_is_alive() {
                    return self.without_host(session);
                }
            }
            std::thread::sleep(POLL_PERIOD);
        }
    }

    /// Determines how a session whose host is gone has ended. A host that ends regularly removes its session
    /// before it releases it.
    fn without_host(&mut self, session: &Session) -> Result<SessionEnd, ViewerError> {
        // Messages sent since the last poll.
        self.subscriptions.poll(&self.board)?;
        if self.has_said_its_end(session) {
            return Ok(SessionEnd::Heard);
        }
        if session.is_announced() {
            self.board.notice("error", HUB_DIED);
            return Ok(SessionEnd::Otherwise);
        }
        if !self.log.is_known() {
            self.board.notice(
                "warning",
                "the session is gone without reporting how its run ended; it was not recorded",
            );
            return Ok(SessionEnd::Otherwise);
        }
        Ok(SessionEnd::Unheard)
    }

    /// Returns whether the run has reported its end. A killed host leaves its announcement behind; the
    /// physics then ends too, and reports it.
    fn has_said_its_end(&mut self, session: &Session) -> bool {
        let said = self.subscriptions.run_has_ended() && (session.host_is_alive() || !session.is_announced());
        if said {
            self.board.notice("info", RUN_ENDED);
        }
        said
    }

    /// Waits for the log of an ended run while a client is connected.
    fn whole_log(&mut self, ended: SessionEnd, end: &EndRequest) -> Option<PathBuf> {
        let began = Instant::now();
        // A page that was showing the plan of a short run may still be reconnecting.
        let mut left = IdleTimer::default();
        while ended != SessionEnd::Otherwise && !end.is_set() && began.elapsed() < LOG_LIMIT {
            if !self.log.is_known() || left.is_over(self.board.client_count()) {
                return None;
            }
            if let Some((log, reason)) = self.log.whole() {
                // Another program may have cleaned up the session of a killed host before this one checked.
                if matches!(&reason, Some(EndReason::PartDied(part)) if part == Part::Host.name()) {
                    self.board.notice("error", HUB_DIED);
                    return None;
                }
                if ended == SessionEnd::Unheard {
                    self.board.notice("info", RUN_ENDED);
                }
                self.board.go_on();
                return Some(log);
            }
            while let Ok(call) = self.called.try_recv() {
                match call.request {
                    Request::Slice(_) => self.slice(call),
                    _ => call.refuse("the run has ended; its log is being completed"),
                }
            }
            std::thread::sleep(ALIVE_LOOK / 4);
        }
        None
    }

    fn dispatch(&mut self, call: Call) {
        match call.request {
            Request::Control(request) => self.control.ask(&request, call.answer),
            Request::Drive(_) | Request::Frame(_) => self.driver.hand_over(call),
            Request::Slice(_) => self.slice(call),
            Request::Playback(_) | Request::Series(_) => call.refuse("a running session has no time line"),
            Request::Plan(_) => call.refuse("the run has started: its plan can no longer be changed"),
        }
    }

    fn slice(&self, call: Call) {
        let Some(slices) = &self.slices else { return call.refuse(NO_VOLUME) };
        match slices.try_send(call) {
            Ok(()) => {}
            Err(mpsc::TrySendError::Full(call)) => call.refuse("the viewer is busy with earlier slices"),
            Err(mpsc::TrySendError::Disconnected(call)) => call.refuse("the volume could not be read"),
        }
    }
}
