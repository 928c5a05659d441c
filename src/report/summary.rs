//! Summary of a run.

use std::collections::BTreeMap;

use run_log::misses::{Cause, Misses};
use run_log::{RunMode, hash_text};
use serde::{Deserialize, Serialize};

use super::RunFacts;
use super::cautions::cautions;
use super::distribution::Quantiles;
use super::outcome::{PlanSummary, StructureSummary, is_out_of_tolerance};
use super::run_lane::RunLane;
use super::timing_lane::TimingLane;
use crate::fmu_controller::replay_note;
use crate::plan::ModelError;

/// The results of a run, the content of `summary.json`. Values missing from the logs are null.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Name of the scene.
    pub scene: Option<String>,
    /// `lockstep` or `realtime`.
    pub mode: Option<String>,
    /// How the run ended.
    pub outcome: String,
    /// Number of ticks run.
    pub ticks: u64,
    /// Simulated time.
    pub simulated_s: f64,
    /// Wall time of the ticks.
    pub wall_s: f64,
    /// Wall time from the start to the first tick.
    pub startup_s: f64,
    /// Wall time of each phase of the run: volume, session and connecting before the first tick, ticks, end
    /// of the parts.
    #[serde(default)]
    pub phases_s: BTreeMap<String, f64>,
    /// Simulated over wall time.
    pub real_time_factor: Option<f64>,
    /// `State.hash` of the last state, 32 hexadecimal digits, high word first.
    pub final_hash: Option<String>,
    /// The tool; `None` without a state.
    pub tool: Option<ToolSummary>,
    /// Known error of the model; `None` for a model that does not bend in one plane, without bone, or without
    /// a measurement.
    #[serde(default)]
    pub model_error: Option<ModelError>,
    /// The run compared with its plan; `None` without a state.
    #[serde(default)]
    pub plan: Option<PlanSummary>,
    /// Number of breaches of the bone.
    #[serde(default)]
    pub breaches: u64,
    /// Clearance of each critical structure.
    #[serde(default)]
    pub structures: Vec<StructureSummary>,
    /// Likely problems of the run.
    #[serde(default)]
    pub cautions: Vec<String>,
    /// Drilling and contact; `None` without a state.
    pub drilling: Option<DrillingSummary>,
    /// X-ray frames; `None` without a frame.
    pub drr: Option<DrrSummary>,
    /// Real-time behaviour.
    pub timing: TimingSummary,
    /// Number of events by kind.
    pub events: BTreeMap<String, u64>,
    /// The last warnings and errors.
    pub warnings: Vec<String>,
    /// The logs.
    pub logs: LogSummary,
    /// Peak memory (VmHWM) of each process, bytes.
    pub peak_memory_bytes: BTreeMap<String, u64>,
    /// Processor time of each process, from its start.
    #[serde(default)]
    pub processor_s: BTreeMap<String, f64>,
    /// Command that replays the run.
    pub replay_command: String,
}

/// The tool at the start and end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ToolSummary {
    /// Front of the burr at the start, world frame.
    pub tip_start_mm: [f64; 3],
    /// Front of the burr at the deepest insertion, world frame.
    pub tip_deepest_mm: [f64; 3],
    /// Front of the burr at the end, world frame.
    pub tip_end_mm: [f64; 3],
    /// Distance of the burr centre from the controller's target at the deepest insertion; `None` without a
    /// target.
    pub target_error_mm: Option<f64>,
    /// Bend at the deepest insertion.
    pub bend_deg: f64,
    /// Maximum tension of any tendon.
    pub max_tension_n: f64,
}

/// Drilling and contact.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct DrillingSummary {
    /// Voxels removed since the start or the last reset.
    pub removed_voxels: u64,
    /// Volume of the removed voxels; `None` without a volume.
    pub removed_volume_mm3: Option<f64>,
    /// Volume of the removed bone outside of all targets; `None` without a `[[structure]]` of this role.
    #[serde(default)]
    pub healthy_removed_mm3: Option<f64>,
    /// Area of the bone's outer surface that was removed other than at the entry; `None` without a volume.
    #[serde(default)]
    pub breach_area_mm2: Option<f64>,
    /// Energy spent on cutting since the start or the last reset.
    pub cutting_energy_j: f64,
    /// Energy absorbed by bone that the tool crushed, since the start or the last reset.
    #[serde(default)]
    pub crushing_energy_j: f64,
    /// Maximum normal force of the burr.
    pub max_burr_force_n: f64,
    /// Maximum normal force of any contact.
    pub max_contact_force_n: f64,
    /// Maximum sum of the normal forces on the tool, without the burr's.
    #[serde(default)]
    pub max_wall_force_n: f64,
    /// Maximum force of the tool on the flange.
    #[serde(default)]
    pub max_flange_force_n: f64,
    /// Maximum angle of a flexure past its stop.
    #[serde(default)]
    pub max_stop_excess_deg: f64,
    /// Maximum number of contacts in one tick.
    pub max_contacts: u32,
    /// Share of the ticks with at least one contact.
    pub contact_share: f64,
}

/// X-ray frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DrrSummary {
    /// Number of frames in the log.
    pub frames: u64,
    /// Frames traced in full; the others were traced only where something had changed.
    pub full_frames: u64,
    /// Render time.
    pub render_ms: Option<Quantiles>,
    /// Rays traced for all frames.
    pub rays: u64,
    /// Mean number of rays per frame.
    pub rays_per_frame: Option<f64>,
    /// Frames per simulated second.
    pub frames_per_simulated_s: Option<f64>,
    /// Frames per second of wall time.
    pub frames_per_wall_s: Option<f64>,
}

/// Real-time behaviour.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TimingSummary {
    /// Time of the physics step.
    pub step_us: Option<Quantiles>,
    /// How late ticks began (real time).
    pub lateness_us: Option<Quantiles>,
    /// Time from state to command, per controller that replied.
    pub round_trip_us: BTreeMap<String, Quantiles>,
    /// Ticks that began more than a period late.
    pub missed_ticks: u64,
    /// Why ticks began late.
    pub misses: MissSummary,
    /// Page faults of the physics process after its first tick.
    pub page_faults: u64,
}

/// Why ticks began late; see `run_log::misses`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MissSummary {
    /// Misses by their main cause; causes without misses are omitted.
    pub by_cause: BTreeMap<String, u64>,
    /// Time lost to each cause, with the same keys.
    pub lost_ms: BTreeMap<String, f64>,
    /// Misses inside a gap of the log, counted by the physics but of unknown cause.
    #[serde(default)]
    pub not_recorded: u64,
    /// Share of the lost time with an identified cause; `None` without lost time.
    #[serde(default)]
    pub confirmed_share: Option<f64>,
    /// Steal shown by the machine's own counter, `/proc/stat`, for the late ticks, in steps of 10 ms.
    #[serde(default)]
    pub steal_counter_ms: f64,
    /// Ticks with a late command from a controller, for which its last command or the safe one was used.
    pub late_controller_ticks: u64,
}

impl MissSummary {
    /// Summarises the misses of a run.
    pub fn of(misses: &Misses) -> MissSummary {
        let all = || Cause::ALL.into_iter();
        let counts = all().zip(misses.by_cause).filter(|(_, count)| *count > 0);
        let lost = all().map(|cause| (cause, misses.lost.of(cause))).filter(|(_, lost_ns)| *lost_ns > 0);
        MissSummary {
            by_cause: counts.map(|(cause, count)| (cause.name().to_owned(), count)).collect(),
            lost_ms: lost.map(|(cause, lost_ns)| (cause.name().to_owned(), lost_ns as f64 * 1e-6)).collect(),
            not_recorded: misses.not_recorded(),
            confirmed_share: misses.confirmed_share(),
            steal_counter_ms: misses.steal_counter_ns as f64 * 1e-6,
            late_controller_ticks: misses.late_controller_ticks,
        }
    }
}

/// The logs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LogSummary {
    /// Size of `run.mcap`.
    pub run_bytes: u64,
    /// Size of `timing.mcap`.
    pub timing_bytes: u64,
    /// Both logs, 10⁶ bytes per simulated second.
    pub mb_per_simulated_s: Option<f64>,
    /// Messages lost, by topic.
    pub lost_messages: BTreeMap<String, u64>,
    /// Ticks missing from the log: first and last of each gap.
    #[serde(default)]
    pub missing_ticks: Vec<[u64; 2]>,
    /// First tick of `run.mcap`: above 0 if only the end of the run was kept (`recording.ring_s`), of which
    /// all numbers then are except those that are counted from the start.
    #[serde(default)]
    pub first_tick: u64,
    /// Folders of the logs that triggers saved; `saved-N as run.mcap` is the one that the end of the run cut
    /// short.
    #[serde(default)]
    pub saved: Vec<String>,
    /// How the log replays the FMUs of the scene; `None` without an FMU.
    #[serde(default)]
    pub fmus: Option<String>,
    /// Faults of the files: truncated, damaged, missing.
    pub notes: Vec<String>,
}

/// Suffix of a name in [`Summary::peak_memory_bytes`] for a process's memory without shared memory.
pub const NOT_SHARED: &str = ", not shared";

/// Returns the ratio if it is finite.
pub(super) fn ratio(a: f64, b: f64) -> Option<f64> {
    Some(a / b).filter(|ratio| b > 0.0 && ratio.is_finite())
}

impl Summary {
    /// Combines the logs' data with the launcher's. Sizes in bytes: run log, timing log.
    pub fn new(
        run: &RunLane,
        timing: &TimingLane,
        facts: &RunFacts,
        (bytes, saved): ([u64; 2], Vec<String>),
    ) -> Summary {
        let header = run.header.as_ref().or(timing.header.as_ref());
        let simulated_s = run.end_ns as f64 * 1e-9;
        Summary {
            scene: header.map(|header| header.scene_name.clone()),
            mode: header.map(|header| header.mode.name().to_string()),
            outcome: outcome(run, facts),
            ticks: run.course.ticks,
            simulated_s,
            wall_s: facts.wall_s,
            startup_s: facts.startup_s,
            phases_s: facts.phases_s.clone(),
            real_time_factor: ratio(simulated_s, facts.wall_s),
            final_hash: run.course.last.as_ref().map(|state| hash_text(state.hash)),
            tool: run.course.tool(),
            model_error: run.scene.as_ref().and_then(ModelError::of),
            plan: run.course.first.as_ref().map(|_| run.course.plan()),
            breaches: run.course.breach_count,
            structures: run.course.clearances.summaries().to_vec(),
            cautions: cautions(run, timing),
            drilling: run.course.drilling(),
            drr: DrrSummary::of(run, timing, facts),
            timing: TimingSummary::of(timing),
            events: timing.events.clone(),
            warnings: timing.warnings.iter().cloned().collect(),
            logs: LogSummary::of(run, timing, bytes, saved),
            peak_memory_bytes: facts.peak_memory_bytes.clone(),
            processor_s: facts.processor_s.clone(),
            replay_command: facts.replay_command.clone(),
        }
    }
}

/// Returns how the run ended, and whether it exceeded a tolerance of its scene.
fn outcome(run: &RunLane, facts: &RunFacts) -> String {
    let is_out = run.scene.as_ref().is_some_and(|scene| is_out_of_tolerance(scene, &run.course));
    facts.outcome.clone() + if is_out { ", out of tolerance" } else { "" }
}

impl Summary {
    /// Returns the number of cautions, without the one about the model, which every run with it has.
    pub fn problems(&self) -> usize {
        let model = self.model_error.as_ref().map(ToString::to_string);
        self.cautions.iter().filter(|caution| Some(*caution) != model.as_ref()).count()
    }
}

impl DrillingSummary {
    /// Returns the breach area as text, if there is any.
    pub fn breach_area_text(&self) -> Option<String> {
        let area_mm2 = self.breach_area_mm2.filter(|mm2| *mm2 > 0.0)?;
        Some(format!("{area_mm2:.1} mm2 of the bone's surface away from the entry"))
    }
}

impl DrrSummary {
    fn of(run: &RunLane, timing: &TimingLane, facts: &RunFacts) -> Option<DrrSummary> {
        let frames = run.frames.count;
        (frames > 0).then(|| DrrSummary {
            frames,
            full_frames: timing.full_frames,
            render_ms: timing.render.quantiles(1e6),
            rays: timing.rays,
            rays_per_frame: ratio(timing.rays as f64, timing.render.count() as f64),
            frames_per_simulated_s: ratio(frames as f64, run.kept_s()),
            frames_per_wall_s: ratio(frames as f64, facts.wall_s),
        })
    }
}

impl TimingSummary {
    fn of(timing: &TimingLane) -> TimingSummary {
        let controllers = timing.header.as_ref().map(|h| h.controllers.as_slice()).unwrap_or_default();
        let trips = controllers.iter().zip(&timing.round_trips);
        let realtime = timing.header.as_ref().is_some_and(|h| h.mode == RunMode::RealTime);
        TimingSummary {
            step_us: timing.step.quantiles(1e3),
            lateness_us: timing.lateness.quantiles(1e3).filter(|_| realtime),
            round_trip_us: trips.filter_map(|(name, d)| Some((name.clone(), d.quantiles(1e3)?))).collect(),
            missed_ticks: timing.misses.missed(),
            misses: MissSummary::of(&timing.misses),
            page_faults: timing.page_faults,
        }
    }
}

impl LogSummary {
    fn of(
        run: &RunLane,
        timing: &TimingLane,
        [run_bytes, timing_bytes]: [u64; 2],
        saved: Vec<String>,
    ) -> LogSummary {
        let mut lost_messages = timing.lost.clone();
        lost_messages.extend(run.lost.clone());
        let megabytes = (run_bytes + timing_bytes) as f64 * 1e-6;
        LogSummary {
            run_bytes,
            timing_bytes,
            mb_per_simulated_s: ratio(megabytes, run.kept_s()),
            lost_messages,
            missing_ticks: run.missing_ticks.clone(),
            first_tick: run.header.as_ref().map_or(0, |header| header.first_tick.0),
            saved,
            fmus: run.scene.as_ref().and_then(replay_note),
            notes: run.notes.iter().chain(&timing.notes).cloned().collect(),
        }
    }
}
