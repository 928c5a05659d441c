//! A replay that only steps the ticks.

use std::path::Path;
use std::time::Instant;

use ipc_types::messages::Tick;
use run_log::segments::{SegmentOptions, SegmentReport, SkippedGap, step_segments, verify_segments};
use run_log::verify::ReplayReport;
use run_log::{LogError, SavedState, Verdict};

use super::{OpenedLog, Overrides};
use crate::failure::Failure;

/// Steps a log without comparing its ticks: on several threads from keyframe to keyframe if that provably
/// gives the same result as one pass, otherwise in one pass. With a different scene or build the states do
/// not match the keyframes, so one pass is used from the start.
///
/// # Errors
/// The log cannot be read, or the physics rejects the scene or a tick.
pub fn step(log: &OpenedLog, options: SegmentOptions) -> Result<(SegmentReport, Verdict), Failure> {
    if options.threads > 1 && log.label().is_empty() {
        let mut reader = log.reader()?;
        if let Some(report) = step_segments(&mut reader, &|| log.simulation(), &options) {
            return Ok((report, reader.stream().verdict()));
        }
    }
    in_one_pass(log, options.start.as_ref(), options.to_tick)
}

/// Steps tick by tick from the start or a keyframe.
fn in_one_pass(
    log: &OpenedLog,
    start: Option<&SavedState>,
    to: Option<Tick>,
) -> Result<(SegmentReport, Verdict), Failure> {
    let mut reader = log.reader()?;
    let mut simulation = log.simulation().map_err(Failure::failed)?;
    let mut gaps = Vec::from_iter(SkippedGap::before_first(&reader));
    if let Some(start) = start.or(reader.beginning()) {
        simulation.restore_keyframe(&start.bytes).map_err(Failure::failed)?;
    }
    let (first, mut ticks) = (Tick(simulation.state().tick), 0);
    while to.is_none_or(|to| Tick(simulation.state().tick) < to) {
        let record = match reader.next() {
            None => break,
            Some(Err(LogError::Gap { .. })) => {
                let (after, read) = (Tick(simulation.state().tick), reader.last_complete_tick());
                let behind = reader.go_on().map_err(Failure::failed)?;
                let resumed = behind.as_ref().map(|behind| Tick(behind.state.tick));
                // A gap before the start is skipped silently.
                if read >= first {
                    gaps.push(SkippedGap { after: Some(after), resumed });
                }
                let Some(behind) = behind else { break };
                if Tick(behind.state.tick) >= first {
                    simulation.restore_keyframe(&behind.keyframe.bytes).map_err(Failure::failed)?;
                }
                continue;
            }
            Some(record) => record.map_err(Failure::failed)?,
        };
        if Tick(record.latched.tick) >= first {
            simulation.step(&record.latched).map_err(Failure::failed)?;
            ticks += 1;
        }
    }
    let (tick, hash) = (Tick(simulation.state().tick), simulation.state().hash);
    // The simulation is unusable after its failure, so this is last.
    let failure = reader.failure();
    if let Some(failure) = &failure {
        failure
            .reproduce(&mut simulation)
            .map_err(|other| Failure::failed(format!("the simulation: {other}")))?;
    }
    let replay = ReplayReport {
        identical_ticks: ticks,
        last_tick: tick,
        simulated_ns: ticks.saturating_mul(reader.header().dt_ns),
        hash,
        divergence: None,
        simulation_error: None,
        failure: failure.map(|failure| failure.text),
        log_error: None,
        ending: reader.ending().clone(),
    };
    let report = SegmentReport { replay, first_tick: first, identical_keyframes: 0, gaps };
    Ok((report, reader.stream().verdict()))
}

/// Measures the time in seconds of a verification with one thread per core.
pub fn timed_verification(log: &Path) -> Result<(f64, usize), Failure> {
    let opened = OpenedLog::open(log, &Overrides::default())?;
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let began = Instant::now();
    let options = SegmentOptions { start: None, to_tick: None, threads };
    let report = verify_segments(&mut opened.reader()?, &|| opened.simulation(), &options);
    let found = report.replay;
    if let Some(gap) = report.gaps.first() {
        return Err(Failure::failed(format!("{}: {gap}", log.display())));
    }
    if !found.is_identical() {
        return Err(Failure::failed(format!("the replay differs after tick {}", found.last_tick)));
    }
    Ok((began.elapsed().as_secs_f64(), threads))
}
