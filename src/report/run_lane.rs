//! Extracts the report's data from a `run.mcap`.

use std::collections::BTreeMap;
use std::path::Path;

use ipc_types::messages::{Frame, ImagePrefix, MAX_TENDONS, Pose, State};
use ipc_types::scene::Scene;
use recorder_proc::log_file::LogFile;
use run_log::{LogError, LogHeader, LogMessage, MessageStream, ReadOptions, Topic};
use simulation::manipulator_parameters;
use zerocopy::FromBytes;

use super::grey::GreyImage;
use super::timeline::{Extremes, Timeline};

/// Number of time bins for the curves.
const TIME_BINS: usize = 1200;

/// The plane in which the tool bends, at the start of the run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    origin_m: [f64; 3],
    bend_axis: [f64; 3],
    insertion_axis: [f64; 3],
}

impl Plane {
    /// The plane through the first state's tip, spanned by its base's +x (toward tendon 0) and +z (insertion).
    pub fn of(state: &State) -> Plane {
        let q = state.t_world_base.orientation_xyzw;
        let (bend_axis, insertion_axis) = (rotate(q, [1.0, 0.0, 0.0]), rotate(q, [0.0, 0.0, 1.0]));
        Plane { origin_m: state.t_world_tip.position_m, bend_axis, insertion_axis }
    }

    /// Coordinates of a world point along the bend and insertion axes, mm.
    pub fn project_mm(&self, point_m: [f64; 3]) -> [f64; 2] {
        let d = [0, 1, 2].map(|i| point_m[i] - self.origin_m[i]);
        [self.bend_axis, self.insertion_axis].map(|axis| (0..3).map(|i| axis[i] * d[i]).sum::<f64>() * 1e3)
    }
}

/// Rotates a vector by a quaternion x y z w: v + 2w (u × v) + 2 u × (u × v).
fn rotate(q: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let u = [q[0], q[1], q[2]];
    let uv = cross(u, v);
    let uuv = cross(u, uv);
    [0, 1, 2].map(|i| v[i] + 2.0 * (q[3] * uv[i] + uuv[i]))
}

/// Distance of two points, m.
pub fn distance_m(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum::<f64>().sqrt()
}

/// The curves of a run over simulated time.
pub struct Curves {
    /// Bending plane of the first state.
    pub plane: Plane,
    /// Tip position along the bend and insertion axes, mm.
    pub tip_mm: Timeline<Option<[f64; 2]>>,
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
            tip_mm: Timeline::new(TIME_BINS, dt_ns, None),
            tension_n: std::array::from_fn(|_| line.clone()),
            bend_deg: line.clone(),
            burr_force_n: line,
        }
    }

    fn add(&mut self, state: &State, time_ns: u64) {
        *self.tip_mm.bin(time_ns) = Some(self.plane.project_mm(state.t_world_tip.position_m));
        for (line, &tension_n) in self.tension_n.iter_mut().zip(&state.tendon_tension_n) {
            line.bin(time_ns).add(tension_n);
        }
        self.bend_deg.bin(time_ns).add(state.bend_rad.to_degrees());
        self.burr_force_n.bin(time_ns).add(state.burr_force_n);
    }
}

/// Maximum values over a run.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Peaks {
    /// Tension of any tendon.
    pub tension_n: f64,
    /// Normal force of the burr.
    pub burr_force_n: f64,
    /// Normal force of any contact.
    pub contact_force_n: f64,
    /// Sum of the walls' forces in one tick.
    pub wall_force_n: f64,
    /// Force of the tool on the flange.
    pub flange_force_n: f64,
    /// How far a flexure was past its stop.
    pub stop_excess_rad: f64,
    /// Maximum number of contacts in one tick.
    pub contacts: u32,
    /// Ticks with at least one contact.
    pub ticks_in_contact: u64,
    /// Farthest place of the tip from where it was at the start.
    pub tip_travel_m: f64,
    /// Ticks with at least one flexure at its stop.
    pub ticks_on_stops: u64,
}

impl Peaks {
    /// Adds a state of a run that began at this tip, with a tool whose flexures bend up to `stop_rad`.
    fn add(&mut self, state: &State, first_tip_m: [f64; 3], stop_rad: f64) {
        let joints = (state.joint_count as usize).min(state.joint_position_rad.len());
        let on_stop = state.joint_position_rad[..joints].iter().any(|angle| angle.abs() >= stop_rad);
        self.ticks_on_stops += u64::from(on_stop);
        self.tip_travel_m = self.tip_travel_m.max(distance_m(first_tip_m, state.t_world_tip.position_m));
        // f64::max ignores NaN.
        let tendons = (state.tendon_count as usize).min(MAX_TENDONS);
        self.tension_n = state.tendon_tension_n[..tendons].iter().copied().fold(self.tension_n, f64::max);
        self.burr_force_n = self.burr_force_n.max(state.burr_force_n);
        self.wall_force_n = self.wall_force_n.max(state.wall_force_n);
        let [x, y, z] = state.flange_wrench.force_n;
        self.flange_force_n = self.flange_force_n.max((x * x + y * y + z * z).sqrt());
        self.stop_excess_rad = self.stop_excess_rad.max(state.stop_excess_rad);
        let listed = (state.contact_count as usize).min(state.contacts.len());
        let forces = state.contacts[..listed].iter().map(|contact| contact.normal_force_n);
        self.contact_force_n = forces.fold(self.contact_force_n, f64::max);
        self.contacts = self.contacts.max(state.contact_total);
        self.ticks_in_contact += u64::from(state.contact_total > 0);
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
    /// Header of the file; none if it could not be opened.
    pub header: Option<LogHeader>,
    /// The scene, if it can be read from the header.
    pub scene: Option<Scene>,
    /// Number of states after the initial one.
    pub ticks: u64,
    /// Simulated time of the last state, counting time before resets.
    pub end_ns: u64,
    /// The first state.
    pub first: Option<Box<State>>,
    /// The last state.
    pub last: Option<Box<State>>,
    /// The last state at the deepest insertion, that is, before the tool retracts, if it does.
    pub deepest: Option<Box<State>>,
    deepest_mm: f64,
    /// Angle at which a flexure of the scene's tool reaches its stop.
    stop_rad: Option<f64>,
    /// Curves for the figures; none without a state.
    pub curves: Option<Curves>,
    /// Maximum values.
    pub peaks: Peaks,
    /// Frames.
    pub frames: Frames,
    /// Ticks with missing states: first and last of each gap, at most [`MAX_GAPS`] gaps.
    pub missing_ticks: Vec<[u64; 2]>,
    /// Gaps beyond these.
    further_gaps: u64,
    /// Messages lost, by topic, according to the end marker.
    pub lost: BTreeMap<String, u64>,
    /// Faults of the file, and how it ends unless it ends cleanly.
    pub notes: Vec<String>,
}

/// Maximum number of gaps listed.
const MAX_GAPS: usize = 100;
/// The mount deflects by this much under load.
const SAME_DEPTH_MM: f64 = 0.02;

impl RunLane {
    /// Reads the file once. Faults become notes. `end_ns` is the simulated length of the run if known, used to choose
    /// the middle frame; otherwise the scene's length is used.
    pub fn read(path: &Path, end_ns: Option<u64>) -> RunLane {
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
        let tool = lane.scene.as_ref().and_then(|scene| manipulator_parameters(scene).ok());
        lane.stop_rad = tool.map(|tool| tool.joint_limit_rad);
        let scene_end_ns = lane.scene.as_ref().map_or(0, |scene| (scene.run.duration_s * 1e9) as u64);
        let middle_ns = end_ns.unwrap_or(scene_end_ns) / 2;
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

    fn state(&mut self, state: State, time_ns: u64, dt_ns: u64) {
        if self.first.is_some() {
            self.ticks += 1;
        } else {
            self.first = Some(Box::new(state));
        }
        self.end_ns = self.end_ns.max(time_ns);
        let curves = self.curves.get_or_insert_with(|| Curves::new(&state, dt_ns));
        curves.add(&state, time_ns);
        let [_, depth_mm] = curves.plane.project_mm(state.t_world_base.position_m);
        let first_tip_m = self.first.as_ref().map_or([0.0; 3], |first| first.t_world_tip.position_m);
        self.peaks.add(&state, first_tip_m, self.stop_rad.unwrap_or(f64::INFINITY));
        if self.deepest.is_none() || depth_mm >= self.deepest_mm - SAME_DEPTH_MM {
            self.deepest_mm = if self.deepest.is_none() { depth_mm } else { self.deepest_mm.max(depth_mm) };
            self.deepest = Some(Box::new(state));
        }
        match &mut self.last {
            Some(last) => {
                if state.tick > last.tick.saturating_add(1) {
                    if self.missing_ticks.len() < MAX_GAPS {
                        self.missing_ticks.push([last.tick + 1, state.tick - 1]);
                    } else {
                        self.further_gaps += 1;
                    }
                }
                **last = state;
            }
            None => self.last = Some(Box::new(state)),
        }
    }

    /// Target of the burr according to the scene's controller, world frame.
    pub fn target_m(&self) -> Option<[f64; 3]> {
        let controllers = &self.scene.as_ref()?.controller;
        let target_mm = controllers.iter().find_map(|c| c.curved_drilling.as_ref()?.target_mm)?;
        Some(target_mm.map(|x| x * 1e-3))
    }

    /// Volume of a voxel, if the scene states it, as it does for phantoms and for files that are resampled to cubes.
    pub fn voxel_volume_mm3(&self) -> Option<f64> {
        let volume = self.scene.as_ref()?.volume.as_ref()?;
        let edge_mm = volume.phantom.map(|_| volume.spacing_mm).or(volume.resample_mm)?;
        Some(edge_mm * edge_mm * edge_mm)
    }
}

/// Origins of the tool's active links, base to tip.
pub fn links(state: &State) -> &[Pose] {
    &state.t_world_link[..(state.joint_count as usize).min(state.t_world_link.len())]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_plane_follows_the_base() {
        // A half turn about x + z swaps x and z and negates y: insertion along world +x, bend along world +z.
        let h = std::f64::consts::FRAC_1_SQRT_2;
        let mut state = State::zeroed();
        state.t_world_base.orientation_xyzw = [h, 0.0, h, 0.0];
        state.t_world_tip.position_m = [0.1, 0.2, 0.3];
        let [bend_mm, insertion_mm] = Plane::of(&state).project_mm([0.105, 9.0, 0.301]);
        assert!(
            (bend_mm - 1.0).abs() < 1e-9 && (insertion_mm - 5.0).abs() < 1e-9,
            "{bend_mm} {insertion_mm}"
        );
    }
}
