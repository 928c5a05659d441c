//! Watches and controls a running session.

mod bone;
mod control;
mod drive;
mod frame_requests;
mod parts;
mod subscriptions;

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use ipc_types::process::{EndRequest, session_scene};
use ipc_types::scene::Scene;
use ipc_types::session::{HalfMadeSweeper, Session};

use crate::board::Board;
use crate::channels::{Channels, INFO};
use crate::error::ViewerError;
use crate::info::{Origin, ToolShape, info};
use crate::server::{Server, ServerOptions};
use crate::services::{Call, Calls, Request};
use crate::slice::NO_VOLUME;
use crate::surface::bone::volume_box;
use bone::BoneThread;
use control::Control;
use drive::Driver;
use subscriptions::Subscriptions;

/// Time between two polls of the queues, which hold half a second.
const POLL_PERIOD: Duration = Duration::from_millis(4);
/// Most calls queued.
pub(crate) const CALL_QUEUE: usize = 64;
const ALIVE_LOOK: Duration = Duration::from_millis(200);

/// A session to watch.
#[derive(Debug, Clone)]
pub struct LiveOptions {
    /// Folder of the session.
    pub session: PathBuf,
    /// Server options.
    pub server: ServerOptions,
}

/// Watches a session until it ends or the process is asked to end. Calls `tool` for the tool's shape, and `ready` with the page's address.
///
/// # Errors
/// The session cannot be joined, or the port cannot be opened.
pub fn view(
    options: &LiveOptions,
    tool: impl FnOnce(&Scene) -> ToolShape,
    ready: impl FnOnce(&Server),
    end: &EndRequest,
) -> Result<(), ViewerError> {
    // The viewer must come to its end even if the host was killed while it made a segment.
    let _sweeper = HalfMadeSweeper::after_host(&options.session);
    let session = Session::join(&options.session)?;
    let scene = session_scene(&options.session)?;
    let board = Arc::new(Board::new(Channels::new(&scene.controller_names(), &scene.sensor)));
    let (calls, called) = mpsc::sync_channel(CALL_QUEUE);
    let over = Arc::new(AtomicBool::new(false));
    let name = options.session.display().to_string();
    let server = Server::bind(&options.server, &name, Arc::clone(&board), calls, Arc::clone(&over))?;
    let tool = tool(&scene);
    let origin = Origin::Live(name);
    board.publish_json(INFO, &info(&scene, &origin, &tool, None));
    let subscriptions = Subscriptions::open(&session, &scene, &tool)?;
    let slices = if let Some(volume) = &scene.volume {
        let (slices, asked) = mpsc::sync_channel(CALL_QUEUE);
        let thread = BoneThread {
            session: options.session.clone(),
            threshold_hu: volume.bone_threshold_hu,
            board: Arc::clone(&board),
            over: Arc::clone(&over),
            asked,
        };
        let (board, scene) = (Arc::clone(&board), scene.clone());
        thread.start(move |grid| {
            board.publish_json(INFO, &info(&scene, &origin, &tool, Some(&volume_box(grid))));
        });
        Some(slices)
    } else {
        None
    };
    let control = Control::open(&session)?;
    let driver = Driver::start(&options.session, &scene, Arc::clone(&over), Arc::clone(&board));
    ready(&server);
    let serving = std::thread::spawn(move || server.serve());
    let mut live = Live { board, subscriptions, control, driver, slices, called, dt_ns: scene.dt_ns() };
    let watched = live.watch(&session, end);
    // The last messages are still on their way to the clients.
    std::thread::sleep(Duration::from_millis(200));
    over.store(true, Ordering::Relaxed);
    let served = serving.join().unwrap_or(Ok(()));
    watched.and(served)
}

struct Live {
    board: Arc<Board>,
    subscriptions: Subscriptions,
    control: Control,
    driver: Driver,
    /// To the thread that reads the volume; none: the scene has no volume.
    slices: Option<mpsc::SyncSender<Call>>,
    called: Calls,
    dt_ns: u64,
}

impl Live {
    fn watch(&mut self, session: &Session, end: &EndRequest) -> Result<(), ViewerError> {
        let mut alive_seen = Instant::now();
        loop {
            self.subscriptions.poll(&self.board)?;
            if self.subscriptions.physics_is_heard() {
                self.control.physics_listens()?;
            }
            self.control.poll(&self.board, self.dt_ns)?;
            while let Ok(call) = self.called.try_recv() {
                self.dispatch(call);
            }
            // A killed host leaves its announcement behind; the physics then ends too, and reports it.
            if self.subscriptions.run_has_ended() && (session.host_is_alive() || !session.is_announced()) {
                self.board.notice("info", "the run has ended");
                return Ok(());
            }
            if end.is_set() {
                self.board.notice("info", "the viewer has been ended");
                return Ok(());
            }
            if alive_seen.elapsed() > ALIVE_LOOK || self.subscriptions.run_has_ended() {
                alive_seen = Instant::now();
                if !session.host_is_alive() {
                    self.board.notice("error", "the hub has died: its launcher is gone, and the run with it");
                    return Ok(());
                }
            }
            std::thread::sleep(POLL_PERIOD);
        }
    }

    fn dispatch(&mut self, call: Call) {
        match call.request {
            Request::Control(request) => self.control.ask(&request, call.answer),
            Request::Drive(_) | Request::Frame(_) => self.driver.hand_over(call),
            Request::Slice(_) => self.slice(call),
            Request::Playback(_) | Request::Series(_) => call.refuse("a running session has no time line"),
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
