//! Cost of sampling the counters that explain late ticks.

use std::time::{Duration, Instant};

use ipc_types::messages::TickTiming;
use physics_proc::process::{Disturbances, Sample};

use super::samples::Samples;
use crate::sheet::Sheet;
use trabecula::machine::Machine;

/// Samples the counters of `ticks` ticks each, both after a short sleep, as in a run, and without one.
pub fn run(ticks: u64, sheet: &mut Sheet) {
    let machine = Machine::watch();
    let (mut slept, mut awake, mut late) = (Samples::default(), Samples::default(), Samples::default());
    let mut readings = Disturbances::new();
    for _ in 0..ticks {
        slept.add(one(&mut readings, Duration::from_micros(20), Sample::InTime));
        awake.add(one(&mut readings, Duration::ZERO, Sample::InTime));
        late.add(one(&mut readings, Duration::from_micros(20), Sample::Late));
    }
    sheet.line(&format!("readings of {ticks} ticks of each kind, both samples of a tick added\n"));
    sheet.samples("a tick on time, after a sleep", "slept", &slept);
    sheet.samples("a tick on time, never off its core", "awake", &awake);
    sheet.samples("a late tick, with the machine's steal", "late", &late);
    sheet.machine(&machine);
}

/// Returns the nanoseconds of both samples of a tick.
fn one(readings: &mut Disturbances, sleep: Duration, sample: Sample) -> u64 {
    let mut timing = TickTiming::zeroed();
    let began = Instant::now();
    readings.work_ends();
    let first = began.elapsed();
    if !sleep.is_zero() {
        std::thread::sleep(sleep);
    }
    let began = Instant::now();
    readings.tick_begins(0, 0, sample, &mut timing);
    (first + began.elapsed()).as_nanos() as u64
}
