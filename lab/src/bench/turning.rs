//! A program that turns the C-arm of a run: it requests one frame after the other, each from a different
//! angle.

use std::path::PathBuf;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use ipc_types::messages::Pose;
use trabecula_client::{Client, ClientError, Connection};
use xray::from_scene::scene_isocentre_m;

use super::failed;
use super::samples::Samples;
use trabecula::failure::Failure;

/// Timeout for the run, and for a frame.
const LIMIT: Duration = Duration::from_secs(20);
/// Rotation of the C-arm between frames: at 60 Hz, 6 s per revolution around the patient.
const STEP_DEG: f64 = 1.0;

/// Requests frames at this rate from the run of the first session received, until it ends; returns the time
/// from request to frame for each frame.
///
/// # Errors
/// The run refuses a frame, or none arrives.
pub(super) fn turn(sessions: &Receiver<PathBuf>, rate_hz: f64) -> Result<Samples, Failure> {
    let mut samples = Samples::default();
    // Without a session the run has not started, which its own error reports.
    let Ok(folder) = sessions.recv_timeout(LIMIT) else { return Ok(samples) };
    let session = Some(folder.to_string_lossy().into_owned());
    let mut client = Client::connect(&Connection { session, controller: Some(String::new()), limit: LIMIT })
        .map_err(failed)?;
    let isocentre_m = scene_isocentre_m(client.scene());
    let period = Duration::from_secs_f64(1.0 / rate_hz);
    let mut due = Instant::now();
    for number in 0_u32.. {
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        // A late frame delays the following ones.
        due = due.max(Instant::now() - period) + period;
        let began = Instant::now();
        let asked = client.request_frame(Some(&turned(isocentre_m, f64::from(number) * STEP_DEG)), 0);
        match asked.and_then(|request| client.wait_frame(request, LIMIT).map(drop)) {
            Ok(()) => samples.add(began.elapsed().as_nanos() as u64),
            Err(ClientError::Ended) => break,
            Err(cause) => return Err(failed(cause)),
        }
    }
    Ok(samples)
}

/// Returns a C-arm at this primary angle: +x along the rows, +y down the columns, toward the feet, +z to the
/// source.
fn turned(isocentre_m: [f64; 3], primary_deg: f64) -> Pose {
    let (s, c) = (0.5 * primary_deg.to_radians()).sin_cos();
    let half = std::f64::consts::FRAC_1_SQRT_2;
    // A quarter turn about x makes the rows horizontal; then the angle about the patient's long axis.
    Pose { position_m: isocentre_m, orientation_xyzw: [-c * half, -s * half, s * half, c * half] }
}
