//! Extracts the timing of a run from its logs.

use std::collections::BTreeMap;
use std::path::Path;

use ipc_types::messages::{FrameTiming, Latched, MAX_CONTROLLERS, TickTiming};
use recorder_proc::log_file::LogFile;
use run_log::misses::{Cause, Misses};
use run_log::{MessageStream, ReadOptions, Topic};
use serde::{Deserialize, Serialize};
use zerocopy::FromBytes;

use crate::failure::Failure;
use crate::replay::timed_verification;
use crate::report::distribution::{Distribution, Quantiles};
use crate::report::timeline::{Extremes, Timeline};
use crate::report::{MissSummary, Summary};

/// Maximum number of bins for the lateness over the run.
const TIME_BINS: usize = 300;
/// Number of misses drawn individually: those with the most lost time.
pub const DRAWN_MISSES: usize = 200;

/// A deadline miss.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Miss {
    pub time_s: f64,
    pub late_us: f64,
    pub cause: Cause,
}

/// Distributions of a run, for figures.
pub struct Curves {
    pub lateness: Distribution,
    pub step: Distribution,
    /// From state to command, over all controllers.
    pub round_trip: Distribution,
    /// Largest lateness in each interval, µs.
    pub latest: Timeline<Extremes>,
    /// The worst misses, in order of time.
    pub misses: Vec<Miss>,
    pub end_s: f64,
    pub period_us: f64,
    latch_age: Distribution,
    frame_age: Distribution,
}

/// Measurements of a run. Times in µs unless the name says otherwise.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RunMeasurements {
    /// Number of ticks in the log.
    pub ticks: u64,
    pub lateness_us: Option<Quantiles>,
    pub step_us: Option<Quantiles>,
    /// Age of the command used in a tick, from the state that it responds to.
    pub latch_age_us: Option<Quantiles>,
    /// From a state's publication to the command that responds to it.
    pub round_trip_us: Option<Quantiles>,
    /// Simulated time elapsed until a frame was published.
    pub frame_age_us: Option<Quantiles>,
    pub frames_per_s: Option<f64>,
    pub real_time_factor: Option<f64>,
    pub dropped: u64,
    /// Ticks that began more than a period late.
    pub missed: u64,
    /// Why ticks were missed.
    pub misses: MissSummary,
    /// Share of on-time ticks among those not delayed by the hypervisor.
    pub on_time_share: f64,
    /// Processor time of each process over the run's wall time, including startup: 1 is a whole core.
    pub processor_share: BTreeMap<String, f64>,
    /// Whether both lanes have their end marker and every tick of the run is present.
    pub log_complete: bool,
    /// Whether every tick replays to the same hash.
    pub replays: bool,
    /// Why a tick does not replay, or why the log is incomplete.
    pub remarks: Vec<String>,
}

/// Reads the folder of a run of `expected_ticks` ticks, and replays it.
///
/// # Errors
/// A histogram cannot be created. Faults of the logs become remarks.
pub fn measure(folder: &Path, expected_ticks: u64) -> Result<(RunMeasurements, Curves), Failure> {
    let duration = Distribution::new(3)?;
    let mut reader = Reader {
        measured: RunMeasurements::default(),
        curves: Curves {
            lateness: duration.clone(),
            step: duration.clone(),
            round_trip: duration.clone(),
            latest: Timeline::new(TIME_BINS, 1_000_000, Extremes::EMPTY),
            misses: Vec::new(),
            end_s: 0.0,
            period_us: 0.0,
            latch_age: duration.clone(),
            frame_age: duration,
        },
        misses: Misses::default(),
        dt_ns: 0,
        all_misses: Vec::new(),
    };
    reader.measured.log_complete = true;
    for lane in ["run.mcap", "timing.mcap"] {
        if let Err(cause) = reader.lane(&folder.join(lane)) {
            reader.remark(format!("{lane}: {cause}"));
        }
    }
    if reader.measured.ticks != expected_ticks {
        let text = format!("{} of {expected_ticks} ticks are in the log", reader.measured.ticks);
        reader.remark(text);
    }
    let mut measured = reader.finish();
    match timed_verification(&folder.join("run.mcap")) {
        Ok(_) => measured.0.replays = true,
        Err(cause) => measured.0.remarks.push(cause.message),
    }
    add_summary(&mut measured.0, folder);
    Ok(measured)
}

/// Adds the launcher's data.
fn add_summary(measured: &mut RunMeasurements, folder: &Path) {
    let text = std::fs::read_to_string(folder.join("summary.json")).unwrap_or_default();
    let Ok(summary) = serde_json::from_str::<Summary>(&text) else {
        measured.remarks.push("no summary.json".to_owned());
        return;
    };
    measured.real_time_factor = summary.real_time_factor;
    measured.frames_per_s = summary.drr.and_then(|drr| drr.frames_per_wall_s);
    let wall_s = (summary.wall_s + summary.startup_s).max(1e-9);
    let shares = summary.processor_s.into_iter().map(|(name, seconds)| (name, seconds / wall_s));
    measured.processor_share = shares.collect();
}

struct Reader {
    measured: RunMeasurements,
    curves: Curves,
    misses: Misses,
    all_misses: Vec<Miss>,
    dt_ns: u64,
}

impl Reader {
    fn remark(&mut self, text: String) {
        self.measured.log_complete = false;
        self.measured.remarks.push(text);
    }

    fn lane(&mut self, path: &Path) -> Result<(), run_log::LogError> {
        let mut stream = MessageStream::open(&LogFile::at(path), ReadOptions::default())?;
        self.dt_ns = stream.header().dt_ns;
        while let Some(message) = stream.next_message()? {
            match message.known {
                Some(Topic::Latched) => {
                    if let Ok(latched) = Latched::read_from_bytes(message.body) {
                        self.latched(&latched);
                    }
                }
                Some(Topic::TickTiming) => {
                    if let Ok(timing) = TickTiming::read_from_bytes(message.body) {
                        self.tick(&timing);
                    }
                }
                Some(Topic::RunStatus) => self.misses.take(message.known, message.body),
                Some(Topic::FrameTiming) => {
                    if let Ok(timing) = FrameTiming::read_from_bytes(message.body) {
                        self.curves.frame_age.add(timing.age_ticks.saturating_mul(self.dt_ns));
                    }
                }
                _ => {}
            }
        }
        let ending = stream.ending().clone();
        self.measured.dropped += ending.marker.as_ref().map_or(0, |marker| marker.lost.values().sum::<u64>());
        if !ending.is_complete() {
            self.remark(format!("{}: {}", path.display(), ending.describe()));
        }
        Ok(())
    }

    fn latched(&mut self, latched: &Latched) {
        self.measured.ticks += 1;
        for command in &latched.commands[..(latched.controller_count as usize).min(MAX_CONTROLLERS)] {
            self.curves.latch_age.add(command.age_ticks.saturating_mul(self.dt_ns));
        }
    }

    fn tick(&mut self, timing: &TickTiming) {
        let late_ns = timing.wake_lateness_ns.max(0) as u64;
        let time_ns = timing.tick.saturating_mul(self.dt_ns);
        self.curves.lateness.add(late_ns);
        self.curves.step.add(timing.step_ns);
        let answered = timing.round_trip_ns.into_iter().filter(|round_trip_ns| *round_trip_ns > 0);
        answered.for_each(|round_trip_ns| self.curves.round_trip.add(round_trip_ns));
        self.curves.latest.bin(time_ns).add(late_ns as f64 * 1e-3);
        self.curves.end_s = self.curves.end_s.max((time_ns + self.dt_ns) as f64 * 1e-9);
        if let Some(lost) = self.misses.add(timing) {
            let (time_s, late_us) = (time_ns as f64 * 1e-9, late_ns as f64 * 1e-3);
            self.all_misses.push(Miss { time_s, late_us, cause: lost.main_cause() });
        }
    }

    fn finish(mut self) -> (RunMeasurements, Curves) {
        let us = |distribution: &Distribution| distribution.quantiles(1e3);
        let (curves, misses) = (&mut self.curves, &self.misses);
        self.all_misses.sort_by(|a, b| b.late_us.total_cmp(&a.late_us));
        self.all_misses.truncate(DRAWN_MISSES);
        self.all_misses.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        curves.misses = self.all_misses;
        curves.period_us = self.dt_ns as f64 * 1e-3;
        let counted = misses.ticks + misses.not_recorded() - (misses.missed() - misses.not_stolen());
        let measured = RunMeasurements {
            lateness_us: us(&curves.lateness),
            step_us: us(&curves.step),
            latch_age_us: us(&curves.latch_age),
            round_trip_us: us(&curves.round_trip),
            frame_age_us: us(&curves.frame_age),
            missed: misses.missed(),
            misses: MissSummary::of(misses),
            on_time_share: 1.0 - misses.not_stolen() as f64 / counted.max(1) as f64,
            ..self.measured
        };
        (measured, self.curves)
    }
}
