//! Splits the lost time of one late tick into causes, using that tick's own readings.

use messages::TickTiming;

use super::cause::{Cause, LostTime};

/// Cost of the first touch of a 4 KiB page: 1.8 to 2.0 µs, measured on a virtual machine whose host reclaims
/// free pages.
const PAGE_FAULT_NS: u64 = 2_000;
/// Granularity of the machine's steal counter.
pub(super) const STEAL_STEP_NS: u64 = 10_000_000;

/// Time still unexplained, and time already attributed.
struct Ledger {
    left_ns: u64,
    lost: LostTime,
}

impl Ledger {
    /// Attributes up to `evidence_ns` to a cause; returns the unused evidence.
    fn take(&mut self, cause: Cause, evidence_ns: u64) -> u64 {
        let taken_ns = evidence_ns.min(self.left_ns);
        self.left_ns -= taken_ns;
        self.lost.0[cause as usize] += taken_ns;
        evidence_ns - taken_ns
    }
}

/// Splits a tick's lost time using its own readings; returns `None` if the tick was on time. The parts sum to
/// its lateness. Time without any evidence is unknown: only the steal counter, read over many ticks, can show
/// whether it was stolen ([`Misses`](super::Misses)).
pub fn attribute(timing: &TickTiming) -> Option<LostTime> {
    if timing.missed == 0 {
        return None;
    }
    let late_ns = timing.wake_lateness_ns.max(0) as u64;
    let overrun_ns = (timing.overrun_ns.max(0) as u64).min(late_ns);
    let on_core_ns = timing.work_cpu_ns.min(timing.work_ns);
    let off_core_ns = timing.work_ns - on_core_ns;

    // Time that the work spent off its core, whether or not it made the tick late.
    let mut off = Ledger { left_ns: off_core_ns, lost: LostTime::default() };
    let throttled_ns = off.take(Cause::Throttled, timing.throttled_ns);
    // Some kernels count a throttled thread as waiting in the run queue, others do not. The quota is the
    // cause in both cases.
    let queued_ns = timing.run_queue_wait_ns.saturating_sub(timing.throttled_ns);
    let queued_ns = off.take(Cause::RunQueue, queued_ns);
    let stopped_ns = off.take(Cause::Stopped, timing.stopped_ns);
    // A thread that slept until its tick has thereby yielded its core once.
    let sleeps = u32::from(timing.overrun_ns < 0);
    let seen = match (timing.major_page_faults, timing.voluntary_switches > sleeps) {
        (1.., _) => Cause::PageFault,
        (_, true) => Cause::Blocked,
        _ => Cause::Unknown,
    };
    let rest_ns = off.left_ns;
    off.take(seen, rest_ns);

    let mut ledger = Ledger { left_ns: overrun_ns, lost: LostTime::default() };
    for cause in [Cause::Throttled, Cause::RunQueue, Cause::Stopped, seen] {
        ledger.take(cause, off.lost.of(cause));
    }
    let seen_ns = off_core_ns.saturating_add(STEAL_STEP_NS);
    ledger.take(Cause::Stolen, timing.stolen_ns.saturating_sub(seen_ns).min(on_core_ns));
    let faults_ns = u64::from(timing.page_faults).saturating_mul(PAGE_FAULT_NS).min(on_core_ns);
    ledger.take(Cause::PageFault, faults_ns);
    ledger.take(Cause::OwnComputation, on_core_ns - faults_ns);
    let unexplained_ns = ledger.left_ns;
    ledger.take(Cause::Unknown, unexplained_ns);

    // The time during which the thread was due but had not begun.
    ledger.left_ns = late_ns - overrun_ns;
    ledger.take(Cause::Recorder, timing.recorder_wait_ns);
    ledger.take(Cause::Throttled, throttled_ns);
    ledger.take(Cause::RunQueue, queued_ns);
    ledger.take(Cause::Controllers, timing.collect_ns);
    ledger.take(Cause::Stopped, stopped_ns);
    let rest_ns = ledger.left_ns;
    ledger.take(Cause::Unknown, rest_ns);
    Some(ledger.lost)
}
