//! Frame requests of a page that is not a controller of the C-arm. Any observer may send them.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use ipc_types::messages::Pose;
use ipc_types::scene::{Drives, Drr, Scene};
use trabecula_client::{Client, ClientError, Connection};

use super::drive::c_arm_pose;
use crate::calls::Call;
use crate::error::ViewerError;
use crate::info::CONTROLLER;
use crate::services::{CArm, Reply, Request};
use crate::threads;

/// Timeout for joining the session.
const JOIN_LIMIT: Duration = Duration::from_secs(2);
/// Interval at which the thread checks for the end.
const LOOK_PERIOD: Duration = Duration::from_millis(100);

/// Whether the viewer is a controller that drives the C-arm; if not, it requests frames as an observer.
pub(super) fn turns_the_c_arm(scene: &Scene) -> bool {
    let own = scene.controller.iter().find(|controller| controller.name == CONTROLLER);
    own.is_some_and(|controller| controller.external && controller.drives.contains(&Drives::CArm))
}

/// Requests a frame from a pose of the C-arm.
///
/// # Errors
/// No X-ray in the scene, an angle out of range, or an error of the session.
pub(super) fn ask_frame(client: &mut Client, c_arm: &CArm, drr: Option<&Drr>) -> Result<(), String> {
    let drr = drr.ok_or("the scene has no X-ray ([drr])")?;
    let pose = match c_arm.pose {
        Some(pose) => Pose { position_m: pose.position_m, orientation_xyzw: pose.orientation_xyzw },
        None => c_arm_pose(c_arm, drr)?,
    };
    client.request_frame(Some(&pose), 0).map(drop).map_err(|error| error.to_string())
}

/// Handle to the requesting thread, which joins the session at the first request.
pub(super) struct FrameRequests(mpsc::Sender<Call>);

impl FrameRequests {
    /// Starts the thread, which ends when the viewer does.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub(super) fn start(
        session: &Path,
        scene: &Scene,
        over: Arc<AtomicBool>,
    ) -> Result<FrameRequests, ViewerError> {
        let (calls, called) = mpsc::channel();
        let connection = Connection {
            session: Some(session.display().to_string()),
            limit: JOIN_LIMIT,
            ..Connection::observer()
        };
        let drr = scene.drr.clone();
        threads::start("frame requests", move || serve(&connection, drr.as_ref(), &called, &over))?;
        Ok(FrameRequests(calls))
    }

    /// Forwards a `/frame` call.
    pub(super) fn hand_over(&self, call: Call) {
        if let Err(mpsc::SendError(call)) = self.0.send(call) {
            // The client may have disconnected.
            let _ = call.answer.send(Err("the run has ended".to_owned()));
        }
    }
}

fn serve(connection: &Connection, drr: Option<&Drr>, called: &mpsc::Receiver<Call>, over: &AtomicBool) {
    let mut client: Option<Client> = None;
    while !over.load(Ordering::Relaxed) {
        let call = match called.recv_timeout(LOOK_PERIOD) {
            Ok(call) => call,
            Err(mpsc::RecvTimeoutError::Timeout) => continue,
            Err(mpsc::RecvTimeoutError::Disconnected) => return,
        };
        let Request::Frame(c_arm) = &call.request else { continue };
        let joined = match client.take() {
            Some(joined) => Ok(joined),
            None => Client::connect(connection).map_err(|error: ClientError| error.to_string()),
        };
        let outcome = joined.and_then(|mut joined| {
            let asked = ask_frame(&mut joined, c_arm, drr);
            client = Some(joined);
            asked.map(|()| Reply::Done)
        });
        // The client may have disconnected.
        let _ = call.answer.send(outcome);
    }
}
