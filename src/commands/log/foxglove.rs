//! `trabecula log export --foxglove`: exports a log for the 3D, image and plot panels of Lichtblick and
//! Foxglove.

use std::io::BufWriter;

use ipc_types::messages::{Pose, State, Tick};
use ipc_types::scene::{Scene, planned_path_in_bone_mm};
use output_file::OutputFile;
use recorder_proc::log_file::{LogFile, log_path};
use run_log::foxglove::ViewerLog;
use run_log::{LogError, MessageStream, ReadOptions, Topic, Verdict};
use serde_json::json;
use viewer_proc::channels::SCENE;
use viewer_proc::scene_update::{Drawer, curve};
use zerocopy::FromBytes;

use super::export::{ExportArguments, ending_of, unwritten};
use super::judged;
use crate::commands::view::tool_shape;
use crate::failure::Failure;
use crate::geometry::path::PathRecorder;
use crate::output::refuse_existing;

/// Distance between points of the burr's path, mm.
const PATH_STEP_MM: f64 = 0.25;
/// Number of tool drawings per drawing of the burr's path, which is written whole each time.
const PATH_EVERY: u64 = 15;
/// Blue and orange of Okabe and Ito (2008).
const PLANNED: [f64; 3] = [0.0, 0.45, 0.7];
const DRILLED: [f64; 3] = [0.84, 0.37, 0.0];

/// Exports the log.
///
/// # Errors
/// Not a log, an output that exists or does not end in `.mcap`, a rate out of range (2); a damaged log, a
/// full disk (1); a log that has a gap, is truncated or was not ended (3).
pub fn export(arguments: &ExportArguments) -> Result<(), Failure> {
    let output = &arguments.output;
    if ending_of(output) != "mcap" {
        return Err(Failure::bad_input(format!("--output is {}, expected a .mcap file", output.display())));
    }
    let rate_hz = arguments.rate.unwrap_or(30.0);
    if !(1.0..=1000.0).contains(&rate_hz) {
        return Err(Failure::bad_input(format!("--rate is {rate_hz}; allowed: 1 to 1000")));
    }
    refuse_existing(&[output])?;
    let log = log_path(arguments.log());
    let stream = MessageStream::open(&LogFile::at(&log), ReadOptions::default())?;
    let scene = Scene::parse(&stream.header().scene_toml, &log).map_err(Failure::bad_input)?;
    let file = OutputFile::create(output)?;
    let failure = unwritten(output);
    let writer = ViewerLog::create(BufWriter::new(file.handle()?), output).map_err(&failure)?;
    let mut made = FoxgloveExport::new(writer, &scene, arguments, (rate_hz, stream.header().dt_ns));
    let verdict = made.take(stream).map_err(&failure)?;
    let (drawings, frames) = (made.drawings, made.frames);
    made.log.finish().map_err(&failure)?;
    file.keep()?;
    let said = format!("{drawings} states with /tf and {SCENE}, {frames} X-ray frames");
    arguments.say(&said, json!({"states": drawings, "frames": frames}), &verdict);
    judged(&log, &verdict)
}

/// The file being written.
struct FoxgloveExport<'a, W: std::io::Write> {
    log: ViewerLog<W>,
    arguments: &'a ExportArguments,
    drawer: Drawer,
    planned_m: Option<Vec<[f64; 3]>>,
    travelled: PathRecorder,
    /// Ticks between drawings.
    every: u64,
    drawings: u64,
    frames: u64,
}

impl<'a, W: std::io::Write> FoxgloveExport<'a, W> {
    fn new(
        log: ViewerLog<W>,
        scene: &Scene,
        arguments: &'a ExportArguments,
        (rate_hz, dt_ns): (f64, u64),
    ) -> FoxgloveExport<'a, W> {
        let every = (1e9 / (rate_hz * dt_ns.max(1) as f64)).round().max(1.0) as u64;
        let metres = |path: Vec<[f64; 3]>| path.into_iter().map(|point| point.map(|x| x * 1e-3)).collect();
        FoxgloveExport {
            log,
            arguments,
            drawer: Drawer::new(&tool_shape(scene)),
            planned_m: planned_path_in_bone_mm(scene).map(metres),
            travelled: PathRecorder::new(PATH_STEP_MM),
            every,
            drawings: 0,
            frames: 0,
        }
    }

    /// Converts a log to its end.
    fn take(&mut self, mut stream: MessageStream) -> Result<Verdict, LogError> {
        let dt_ns = stream.header().dt_ns.max(1);
        loop {
            let Some(message) = stream.next_message()? else { return Ok(stream.verdict()) };
            let tick = Tick(message.log_time_ns / dt_ns);
            if !self.arguments.ticks().contains(tick) {
                continue;
            }
            match message.known {
                Some(Topic::State) => {
                    let Ok(state) = State::read_from_bytes(message.body) else { continue };
                    self.travelled.see(&state);
                    if tick.0.is_multiple_of(self.every) {
                        self.draw(&state, message.log_time_ns)?;
                        let (topic, time_ns) = (message.topic, message.log_time_ns);
                        self.log.message(topic, message.description, time_ns, message.body)?;
                    }
                }
                Some(Topic::Latched) if !tick.0.is_multiple_of(self.every) => {}
                // Physics-internal format, and voxel indices of a CT that the file does not contain.
                Some(Topic::Keyframe | Topic::Removed) => {}
                known => {
                    self.frames += u64::from(known == Some(Topic::DrrImage));
                    let (topic, time_ns) = (message.topic, message.log_time_ns);
                    self.log.message(topic, message.description, time_ns, message.body)?;
                }
            }
        }
    }

    fn draw(&mut self, state: &State, time_ns: u64) -> Result<(), LogError> {
        self.log.transforms(time_ns, &poses(state))?;
        self.log.scene(SCENE, time_ns, &self.drawer.update(state, time_ns))?;
        if let Some(planned_m) = self.planned_m.take() {
            self.log.scene(SCENE, time_ns, &curve("planned path", time_ns, &planned_m, PLANNED))?;
        }
        if self.drawings.is_multiple_of(PATH_EVERY) {
            let places = self.travelled.so_far().iter().map(|place| place.burr_mm.map(|x| x * 1e-3));
            let path_m: Vec<[f64; 3]> = places.collect();
            if path_m.len() > 1 {
                self.log.scene(SCENE, time_ns, &curve("burr path", time_ns, &path_m, DRILLED))?;
            }
        }
        self.drawings += 1;
        Ok(())
    }
}

/// Returns the poses of a state in the world frame.
fn poses(state: &State) -> Vec<(&'static str, &'static str, &Pose)> {
    vec![
        ("world", "flange", &state.t_world_flange),
        ("world", "base", &state.t_world_base),
        ("world", "burr", &state.t_world_burr),
        ("world", "tip", &state.t_world_tip),
    ]
}
