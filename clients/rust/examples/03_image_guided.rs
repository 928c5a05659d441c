//! Requests an X-ray frame every 0.1 s, finds the tip in it, and steers the tip sideways to a target.
//!
//! The tip is the end of the tool's metal: the dark pixel farthest along the tool, refined to the mean of the
//! dark pixels of the last 3 mm. Projected back to the plane of the tool, it gives the sideways error, which
//! drives the tension.

use std::time::Duration;

use trabecula_client::{Client, ClientError, Connection, FrameView, State, TENDON_SERVO_JF};

const LIMIT: Duration = Duration::from_secs(30);
const TICKS_BETWEEN_FRAMES: u64 = 100;
/// Pixels darker than this show metal (full scale: 65535).
const DARK: u16 = 8000;
/// Target of the burr: sideways offset from its start (world x).
const TARGET_M: f64 = 0.006;
const GAIN_N_PER_M: f64 = 350.0;
const END_LENGTH_M: f64 = 0.003;

/// Returns column and row of the tool's end, or `None` if there is no metal in the image.
fn find_tip(view: &FrameView) -> Option<(f64, f64)> {
    let geometry = &view.frame.geometry;
    let columns = geometry.columns as usize;
    // +z of the burr in the image: last column of the rotation matrix, projected on rows and columns.
    let [x, y, z, w] = view.frame.t_world_burr.orientation_xyzw;
    let axis = [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)];
    let dot = |a: &[f64; 3]| a[0] * axis[0] + a[1] * axis[1] + a[2] * axis[2];
    let (right, down) = (dot(&geometry.row_axis), dot(&geometry.column_axis));
    let along = |index: usize| (index % columns) as f64 * right + (index / columns) as f64 * down;
    let mut end = -1e9;
    for (index, pixel) in view.pixels.iter().enumerate() {
        if *pixel < DARK && along(index) > end {
            end = along(index);
        }
    }
    let first = end - END_LENGTH_M / geometry.pixel_pitch_m[0];
    let (mut count, mut column, mut row) = (0.0, 0.0, 0.0);
    for (index, pixel) in view.pixels.iter().enumerate() {
        if *pixel < DARK && along(index) >= first {
            count += 1.0;
            column += (index % columns) as f64;
            row += (index / columns) as f64;
        }
    }
    if count > 0.0 { Some((column / count, row / count)) } else { None }
}

/// Returns the world x of a column, in the plane of the isocentre: the image is magnified by the ratio of
/// source-detector to source-isocentre distance, 1000 to 700 mm.
fn sideways_m(view: &FrameView, column: f64) -> f64 {
    let geometry = &view.frame.geometry;
    (column - 0.5 * (f64::from(geometry.columns) - 1.0)) * geometry.pixel_pitch_m[0] * 0.7
}

fn main() -> Result<(), ClientError> {
    match guide() {
        Err(ClientError::Ended) => Ok(()),
        other => other,
    }
}

/// Runs until the run ends, which is reported as an error.
fn guide() -> Result<(), ClientError> {
    let mut client = Client::connect(&Connection::default())?;
    let mut tension_n = 0.0;
    loop {
        let tick = match client.wait_state(LIMIT) {
            Ok(State { tick, .. }) => *tick,
            // A paused run publishes no states.
            Err(ClientError::TimedOut(_)) => continue,
            Err(other) => return Err(other),
        };
        if tick % TICKS_BETWEEN_FRAMES == 0 && tick < client.info().tick_count {
            let request = client.request_frame(None, tick)?;
            let view = client.wait_frame(request, LIMIT)?;
            if let Some((column, row)) = find_tip(&view) {
                let error_m = TARGET_M - sideways_m(&view, column);
                tension_n += GAIN_N_PER_M * error_m;
                if tension_n < 0.0 {
                    tension_n = 0.0;
                }
                let error_mm = error_m * 1e3;
                println!(
                    "tick {tick:4}  tip at column {column:6.2} row {row:6.2}  error {error_mm:6.3} mm  \
                     tension {tension_n:6.3} N"
                );
            }
        }
        let command = client.command()?;
        command.tendon_mode = TENDON_SERVO_JF;
        command.tendon_force_n[0] = tension_n;
        client.send()?;
    }
}
