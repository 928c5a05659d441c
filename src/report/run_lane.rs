//! Extracts the report's data from a `run.mcap`.

use std::collections::BTreeMap;
use std::path::Path;

use ipc_types::messages::{Frame, ImagePrefix, MAX_TENDONS, Pose, Removed, SensorReading, State, Tick};
use ipc_types::scene::Scene;
use recorder_proc::log_file::LogFile;
use run_log::{LogError, LogHeader, LogMessage, MessageStream, ReadOptions, Topic, voxel_indices};
use zerocopy::FromBytes;

use super::course::{Course, Plane};
use super::timeline::{Extremes, Timeline};
use figures::picture::GreyImage;

/// Number of time bins for the curves.
const TIME_BINS: usize = 1200;

/// The curves of a run over simulated time.
pub struct Curves {
    /// Bending plane of the first state.
    pub plane: Plane,
    /// Position of the burr's centre along the bend and insertion axes, mm.
    pub burr_mm: Timeline<Option<[f64; 2]>>,
    /// Tension of each tendon, N.
    pub tension_n: [Timeline<Extremes>; MAX_TENDONS],
    /// Bend, degrees.
    pub bend_deg: Timeline<Extremes>,
    /// Normal force of the burr, N.
    pub burr_force_n: Timeline<Extremes>,
}

impl Curves {
    fn new(first: &State, dt_ns: u64) -> Curves {
        let line = Timeline::new(TIME_BINS, dt_ns, Extremes::EMPTY);
        Curves {
            plane: Plane::of(first),
            burr_mm: Timeline::new(TIME_BINS, dt_ns, None),
            tension_n: std::array::from_fn(|_| line.clone()),
            bend_deg: line.clone(),
            burr_force_n: line,
        }
    }

    fn add(&mut self, state: &State, time_ns: u64) {
        *self.burr_mm.bin(time_ns) = Some(self.plane.project_mm(state.t_world_burr.position_m));
        for (line, &tension_n) in self.tension_n.iter_mut().zip(&state.tendon_tension_n) {
            line.bin(time_ns).add(tension_n);
        }
        self.bend_deg.bin(time_ns).add(state.bend_rad.to_degrees());
        self.burr_force_n.bin(time_ns).add(state.burr_force_n);
    }
}

/// First, middle and last frame.
#[derive(Debug, Default)]
pub struct Frames {
    /// Number of frames in the log, with or without pixels.
    pub count: u64,
    /// The first image.
    pub before: Option<GreyImage>,
    /// The image nearest the middle of the run.
    pub half: Option<GreyImage>,
    /// The last image.
    pub after: Option<GreyImage>,
    half_distance_ns: u64,
}

impl Frames {
    fn add(&mut self, image: GreyImage, time_ns: u64, middle_ns: u64) {
        let distance_ns = time_ns.abs_diff(middle_ns);
        if self.before.is_none() {
            self.before = Some(image.clone());
        }
        if self.half.is_none() || distance_ns < self.half_distance_ns {
            self.half = Some(image.clone());
            self.half_distance_ns = distance_ns;
        }
        self.after = Some(image);
    }
}

/// Summary of a run's deterministic lane.
#[derive(Default)]
pub struct RunLane {
    /// Header of the file; `None` if it could not be opened.
    pub header: Option<LogHeader>,
    /// The scene, if it can be read from the header.
    pub scene: Option<Scene>,
    /// Simulated time of the last state, counting time before resets.
    pub end_ns: u64,
    /// Reduced states.
    pub course: Course,
    /// Voxels drilled since the start or the last reset, for a scene with bone.
    pub drilled: Vec<u32>,
    /// Curves for the figures; `None` without a state.
    pub curves: Option<Curves>,
    /// Frames.
    pub frames: Frames,
    /// Ticks with missing states: first and last of each gap, at most [`MAX_GAPS`] gaps.
    pub missing_ticks: Vec<[u64; 2]>,
    /// Number of further gaps.
    further_gaps: u64,
    /// Messages lost, by topic, according to the end marker.
    pub lost: BTreeMap<String, u64>,
    /// Faults of the file, and how it ends unless it ends cleanly.
    pub notes: Vec<String>,
}

/// Maximum number of gaps listed.
const MAX_GAPS: usize = 100;

impl RunLane {
    /// Reads the file once. Faults become notes. The middle frame is chosen by the simulated length of the
    /// run, `end_ns`, or if unknown by the scene's length. `spacing_m` is that of the run's volume.
    pub fn read(path: &Path, end_ns: Option<u64>, spacing_m: Option<[f64; 3]>) -> RunLane {
        let mut lane = RunLane::default();
        let stream = match MessageStream::open(&LogFile::at(path), ReadOptions::default()) {
            Ok(stream) => stream,
            Err(error) => {
                lane.notes.push(error.to_string());
                return lane;
            }
        };
        let header = stream.header().clone();
        lane.scene = Scene::parse(&header.scene_toml, Path::new("scene.toml")).ok();
        lane.course = lane.scene.as_ref().map_or_else(Course::default, |scene| Course::of(scene, spacing_m));
        let scene_end_ns = lane.scene.as_ref().map_or(0, |scene| (scene.run.duration_s * 1e9) as u64);
        let middle_ns = end_ns.unwrap_or(scene_end_ns) / 2;
        if header.first_tick > Tick::START {
            lane.course.begin_late();
        }
        let dt_ns = header.dt_ns;
        lane.header = Some(header);
        if let Err(error) = lane.read_messages(stream, dt_ns, middle_ns) {
            lane.notes.push(error.to_string());
        }
        lane
    }

    fn read_messages(
        &mut self,
        mut stream: MessageStream,
        dt_ns: u64,
        middle_ns: u64,
    ) -> Result<(), LogError> {
        while let Some(message) = stream.next_message()? {
            self.add(&message, dt_ns, middle_ns);
        }
        if self.further_gaps > 0 {
            self.notes.push(format!("run.mcap: {} more gaps than the {MAX_GAPS} listed", self.further_gaps));
        }
        let ending = stream.ending();
        if !ending.is_complete() {
            self.notes.push(format!("run.mcap: {}", ending.describe()));
        }
        self.lost = ending.marker.as_ref().map(|marker| marker.lost.clone()).unwrap_or_default();
        Ok(())
    }

    fn add(&mut self, message: &LogMessage<'_>, dt_ns: u64, middle_ns: u64) {
        match message.known {
            Some(Topic::State) => {
                if let Ok(state) = State::read_from_bytes(message.body) {
                    self.state(state, message.log_time_ns, dt_ns);
                }
            }
            Some(Topic::Sensor) => {
                if let Ok(reading) = SensorReading::read_from_bytes(message.body) {
                    self.course.clearances.add(&reading);
                }
            }
            Some(Topic::Removed) if self.has_bone() => self.removed(message.body),
            Some(Topic::DrrFrame) => {
                self.frames.count += u64::from(Frame::read_from_bytes(message.body).is_ok())
            }
            Some(Topic::DrrImage) => {
                let parts = ImagePrefix::read_from_prefix(message.body).ok();
                let image = parts.and_then(|(p, pixels)| GreyImage::from_mono16(p.width, p.height, pixels));
                if let Some(image) = image {
                    self.frames.add(image, message.log_time_ns, middle_ns);
                }
            }
            _ => (),
        }
    }

    /// Simulated time that the log covers, s.
    pub fn kept_s(&self) -> f64 {
        let first_ns = |header: &LogHeader| header.first_tick.0.saturating_mul(header.dt_ns);
        self.end_ns.saturating_sub(self.header.as_ref().map_or(0, first_ns)) as f64 * 1e-9
    }

    fn has_bone(&self) -> bool {
        self.scene.as_ref().is_some_and(|scene| scene.volume.is_some())
    }

    /// Adds the voxels that a tick removed; those of tick 0 are the pilot holes.
    fn removed(&mut self, body: &[u8]) {
        let Ok((removed, voxels)) = Removed::read_from_prefix(body) else { return };
        if removed.restore_first != 0 {
            self.drilled.clear();
        }
        if removed.tick > 0 {
            self.drilled.extend(voxel_indices(voxels));
        }
    }

    fn state(&mut self, state: State, time_ns: u64, dt_ns: u64) {
        self.end_ns = self.end_ns.max(time_ns);
        self.curves.get_or_insert_with(|| Curves::new(&state, dt_ns)).add(&state, time_ns);
        let last_tick = self.course.last.as_ref().map_or(state.tick, |last| last.tick);
        if state.tick > last_tick.saturating_add(1) {
            if self.missing_ticks.len() < MAX_GAPS {
                self.missing_ticks.push([last_tick + 1, state.tick - 1]);
            } else {
                self.further_gaps += 1;
            }
        }
        self.course.add(&state);
    }
}

/// Origins of the tool's active links, base to tip.
pub fn links(state: &State) -> &[Pose] {
    &state.t_world_link[..(state.joint_count as usize).min(state.t_world_link.len())]
}
