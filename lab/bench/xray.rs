//! What X-ray frames cost the physics: the same real-time run with and without them, alternating.

use ipc_types::process::EndRequest;
use ipc_types::scene::{Feedback, Scene};
use serde_json::json;

use super::recorder::{Physics, in_turn, one};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::scenes::SceneSource;

/// Runs the scene in real time for `seconds`, `rounds` times, alternately without and with its X-ray, at `rate_hz`
/// frames per second if given. A controller that steers by frames steers by the measured shape in all runs, because
/// without frames it could not.
///
/// # Errors
/// An invalid scene, or one without X-ray (2); a run that fails.
pub fn run(
    scene: &SceneSource,
    seconds: f64,
    rounds: usize,
    rate_hz: Option<f64>,
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
    let x_rayed = |scene: &Scene, end: &EndRequest, with: &mut Physics| one(scene, None, None, end, with);
    let frames = in_turn("X-ray", [without, with], seconds, rounds, x_rayed, sheet)?;
    let rate_hz = frames / seconds;
    let figures = json!({"frames_per_s": rate_hz, "wanted_hz": wanted_hz});
    sheet.row("frames a second", &format!("{rate_hz:.1} of {wanted_hz} wanted"), "frames", figures);
    Ok(())
}
