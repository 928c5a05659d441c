//! Cost of X-ray frames for the physics: the same real-time run with and without them, alternating.

use std::sync::mpsc::channel;

use ipc_types::process::EndRequest;
use ipc_types::scene::{Feedback, Scene};
use serde_json::json;

use super::failed;
use super::recorder::{Physics, in_turn, one, one_seen};
use super::samples::Samples;
use super::turning::turn;
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::scenes::SceneSource;

/// Motion of the C-arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CArmMoves {
    /// Stationary: after the first frame, updates are incremental.
    Stands,
    /// Turning: every frame has a different angle and is computed in full.
    Turns,
}

/// Runs the scene in real time for `seconds`, `rounds` times, alternately without and with its X-ray, at
/// `rate_hz` frames per second if given. A controller that steers by frames uses the measured shape in all
/// runs, because it could not steer without frames.
///
/// # Errors
/// An invalid scene, or one without X-ray (2); a run that fails.
pub fn run(
    scene: &SceneSource,
    seconds: f64,
    rounds: usize,
    rate_hz: Option<f64>,
    c_arm: CArmMoves,
    sheet: &mut Sheet,
) -> Result<(), Failure> {
    let mut with = scene.load()?;
    for drilling in with.controller.iter_mut().filter_map(|controller| controller.curved_drilling.as_mut()) {
        if drilling.feedback == Feedback::Image {
            drilling.feedback = Feedback::Shape;
        }
    }
    let mut without = with.clone();
    without.drr = None;
    let Some(drr) = &mut with.drr else {
        return Err(Failure::bad_input("the scene has no `[drr]`: there is no X-ray to leave out"));
    };
    drr.rate_hz = rate_hz.unwrap_or(drr.rate_hz);
    let wanted_hz = drr.rate_hz;
    let mut waits = Samples::default();
    let frames = match c_arm {
        CArmMoves::Stands => {
            let x_rayed =
                |scene: &Scene, end: &EndRequest, with: &mut Physics| one(scene, None, None, end, with);
            in_turn("X-ray", [without, with], seconds, rounds, x_rayed, sheet)?
        }
        CArmMoves::Turns => {
            // Frames are rendered only on request.
            drr.rate_hz = 0.0;
            let turned = |scene: &Scene, end: &EndRequest, with: &mut Physics| {
                let (frames, taken) = one_turned(scene, wanted_hz, end, with)?;
                waits.append(&taken);
                Ok(frames)
            };
            in_turn("X-ray of a turning C-arm", [without, with], seconds, rounds, turned, sheet)?
        }
    };
    if waits.count() > 0 {
        sheet.samples("request to frame", "request_to_frame", &waits);
    }
    let rate_hz = frames / seconds;
    let figures = json!({"frames_per_s": rate_hz, "wanted_hz": wanted_hz});
    sheet.row("frames per second", &format!("{rate_hz:.1} of {wanted_hz} wanted"), "frames", figures);
    Ok(())
}

/// Performs one run in which a program turns the C-arm; returns the number of frames, and the time from
/// request to frame for each.
fn one_turned(
    scene: &Scene,
    rate_hz: f64,
    end: &EndRequest,
    with: &mut Physics,
) -> Result<(u64, Samples), Failure> {
    let (found, sessions) = channel();
    std::thread::scope(|scope| {
        let turning = scope.spawn(move || turn(&sessions, rate_hz));
        let mut found = Some(found);
        let made = one_seen(scene, None, None, end, with, |snapshot| {
            // The first state means that all parts have started.
            if snapshot.state.is_some()
                && let Some(found) = found.take()
            {
                // It fails on its own if the receiver is gone.
                let _ = found.send(snapshot.session.to_owned());
            }
        });
        drop(found);
        let taken = turning.join().map_err(|_| failed("the program that turns the C-arm has panicked"))?;
        Ok((made?, taken?))
    })
}
