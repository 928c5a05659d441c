//! Explains why ticks began late: splits the lost time of each miss into causes, using the readings in its
//! [`TickTiming`].
//!
//! A miss is a tick that began more than a period after its deadline. All of its lateness is lost, because
//! the schedule restarts from there. The lateness has two parts: the *overrun*, while the previous tick's
//! work was still running, and then the time during which the thread was due but had not begun.
//!
//! | part | time | cause |
//! |---|---|---|
//! | overrun | off the core, throttled by a quota (`cpu.stat`) | throttled |
//! | overrun | off the core, in the run queue (`schedstat`) | run queue |
//! | overrun | off the core, stopped or frozen (SIGCONT, `cgroup.stat.local`) | stopped |
//! | overrun | off the core otherwise: waiting for a disk, yielding voluntarily, or neither | page fault, blocked, no evidence |
//! | overrun | on the core: 2 µs per page fault, then the rest | page fault, own computation |
//! | due | waiting for the recorder, as the scene requires | recorder |
//! | due | throttled by a quota, in the run queue, stopped or frozen | throttled, run queue, stopped |
//! | due | collecting the controllers' commands | controllers |
//! | due | otherwise: the timer fired late although the core was free | no evidence |
//!
//! Time without evidence counts as stolen as far as the machine's steal counter covers it ([`Misses`]), and
//! as unknown beyond that. With `CONFIG_PARAVIRT_TIME_ACCOUNTING` the kernel excludes stolen time from a
//! thread's processor time. Other kernels charge stolen time to the thread; there, whatever the counter shows
//! beyond its step of 10 ms is subtracted from the computation.

use messages::{RunStatus, Tick, TickTiming};
use zerocopy::FromBytes;

use crate::topics::Topic;

mod attribution;
mod cause;

pub use attribution::attribute;
pub use cause::{Cause, LostTime};

use attribution::STEAL_STEP_NS;
use cause::CAUSES;

/// The deadline misses of a run.
///
/// On a virtual machine, unknown time counts as stolen as far as the machine's own counter (`/proc/stat`)
/// shows it: at that miss, or at earlier misses up to one counter step back, because the counter moves in
/// steps of 10 ms. The stolen total therefore never exceeds the counter.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Misses {
    /// Number of ticks.
    pub ticks: u64,
    /// Misses with recorded readings, hence with a cause.
    pub recorded: u64,
    /// Misses counted by the physics itself, from its status, since the log began.
    counted: u64,
    /// The physics' count before the log began; unknown until the first status of a log that begins late.
    counted_before: u64,
    is_before_unknown: bool,
    /// Misses by their main cause, in the order of [`Cause::ALL`].
    pub by_cause: [u64; CAUSES],
    /// Lost time over all misses.
    pub lost: LostTime,
    /// Time stolen from a late tick's core in up to 100 ms before it, summed over all misses, according to
    /// the machine's own counter (`/proc/stat`, in steps of 10 ms). Upper bound on the time counted as stolen
    /// here.
    pub steal_counter_ns: u64,
    /// Ticks with a late command from a controller. In real time this costs no time: the controller's last
    /// command holds.
    pub late_controller_ticks: u64,
    /// Unknown time that the counter's next step may confirm, and the misses that it dominates.
    pending_ns: u64,
    pending_misses: u64,
}

impl Misses {
    /// Returns no misses of a log that begins at this tick; the physics' count includes those before it.
    pub fn from_tick(first: Tick) -> Misses {
        Misses { is_before_unknown: first > Tick::START, ..Misses::default() }
    }

    /// Adds a tick; returns its lost time if it missed its deadline.
    pub fn add(&mut self, timing: &TickTiming) -> Option<LostTime> {
        self.ticks += 1;
        self.late_controller_ticks += u64::from(timing.late_controllers != 0);
        let mut lost = attribute(timing)?;
        self.recorded += 1;
        self.steal_counter_ns = self.steal_counter_ns.saturating_add(timing.stolen_ns);
        // The tick's own readings have already used this much of the counter.
        let budget_ns = timing.stolen_ns.saturating_sub(lost.of(Cause::Stolen));
        let own_ns = lost.rename_unknown(budget_ns);
        self.confirm_earlier(budget_ns - own_ns);
        let main = lost.main_cause();
        self.by_cause[main as usize] += 1;
        self.lost.add(&lost);
        // The counter lags by less than one step; any larger amount would have shown by now.
        let room_ns = STEAL_STEP_NS.saturating_sub(self.pending_ns);
        let unknown_ns = lost.of(Cause::Unknown).min(room_ns);
        if timing.virtual_machine != 0 && unknown_ns > 0 {
            self.pending_ns += unknown_ns;
            let is_small = lost.of(Cause::Unknown) <= room_ns;
            self.pending_misses += u64::from(main == Cause::Unknown && is_small);
        }
        Some(lost)
    }

    /// Attributes the rest of a counter step to earlier misses.
    fn confirm_earlier(&mut self, budget_ns: u64) {
        let confirmed_ns = self.lost.rename_unknown(budget_ns.min(self.pending_ns));
        if confirmed_ns == 0 {
            return;
        }
        let share = u128::from(self.pending_misses) * u128::from(confirmed_ns) / u128::from(self.pending_ns);
        let misses = (share as u64).min(self.by_cause[Cause::Unknown as usize]);
        self.by_cause[Cause::Unknown as usize] -= misses;
        self.by_cause[Cause::Stolen as usize] += misses;
        self.pending_ns -= confirmed_ns;
        self.pending_misses -= misses;
    }

    /// Adds a message of the timing lane, on any topic.
    pub fn take(&mut self, topic: Option<Topic>, body: &[u8]) {
        match topic {
            Some(Topic::TickTiming) => {
                if let Ok(timing) = TickTiming::read_from_bytes(body) {
                    self.add(&timing);
                }
            }
            Some(Topic::RunStatus) => {
                if let Ok(status) = RunStatus::read_from_bytes(body) {
                    self.add_status(&status);
                }
            }
            _ => {}
        }
    }

    /// Adds the physics' own count, which also covers misses inside a gap of the log.
    pub fn add_status(&mut self, status: &RunStatus) {
        if std::mem::take(&mut self.is_before_unknown) {
            self.counted_before = status.missed_ticks.saturating_sub(self.recorded);
        }
        self.counted = self.counted.max(status.missed_ticks.saturating_sub(self.counted_before));
    }

    /// Ticks that began more than a period late, including those without readings.
    pub fn missed(&self) -> u64 {
        self.recorded.max(self.counted)
    }

    /// Misses inside a gap of the log; their cause is unknown.
    pub fn not_recorded(&self) -> u64 {
        self.missed() - self.recorded
    }

    /// Returns the share of the lost time with an identified cause; `None` without lost time. Misses without
    /// readings are excluded, because their lost time is unknown.
    pub fn confirmed_share(&self) -> Option<f64> {
        let total_ns = self.lost.total_ns();
        let named_ns = total_ns - self.lost.of(Cause::Unknown).min(total_ns);
        (total_ns > 0).then(|| named_ns as f64 / total_ns as f64)
    }

    /// Misses not caused by the hypervisor.
    pub fn not_stolen(&self) -> u64 {
        self.missed() - self.by_cause[Cause::Stolen as usize]
    }

    /// Describes the misses in one line: `12 missed (0.10 %): 8 run queue, 3 stolen, 1 not recorded; 31.2 ms
    /// lost, 99.1 % confirmed`.
    pub fn describe(&self) -> String {
        let ticks = self.ticks.max(1) + self.not_recorded();
        let share = 100.0 * self.missed() as f64 / ticks as f64;
        let mut text = format!("{} missed ({share:.2} %)", self.missed());
        let named = Cause::ALL.into_iter().zip(self.by_cause).filter(|(_, count)| *count > 0);
        let mut named: Vec<String> =
            named.map(|(cause, count)| format!("{count} {}", cause.name())).collect();
        if self.not_recorded() > 0 {
            named.push(format!("{} not recorded", self.not_recorded()));
        }
        if !named.is_empty() {
            text += &format!(": {}", named.join(", "));
        }
        if let Some(confirmed) = self.confirmed_share() {
            let lost_ms = self.lost.total_ns() as f64 * 1e-6;
            text += &format!("; {lost_ms:.1} ms lost, {:.1} % confirmed", 100.0 * confirmed);
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: u64 = 1_000_000;

    /// A miss: the previous tick's work ended `overrun_ms` after the deadline, and the tick began `late_ms`
    /// after it.
    fn missed(late_ms: u64, overrun_ms: i64) -> TickTiming {
        let mut timing = TickTiming::zeroed();
        timing.missed = 1;
        timing.virtual_machine = 1;
        timing.wake_lateness_ns = (late_ms * MS) as i64;
        timing.overrun_ns = overrun_ms * MS as i64;
        timing.voluntary_switches = u32::from(overrun_ms < 0);
        timing.work_ns = (1 + overrun_ms).max(0) as u64 * MS;
        timing.work_cpu_ns = timing.work_ns;
        timing
    }

    fn main_cause(timing: &TickTiming) -> Cause {
        attribute(timing).unwrap().main_cause()
    }

    fn all(timings: &[TickTiming]) -> Misses {
        let mut misses = Misses::default();
        for timing in timings {
            misses.add(timing);
        }
        misses
    }

    #[test]
    fn a_tick_in_time_has_lost_nothing() {
        assert_eq!(attribute(&TickTiming { missed: 0, ..missed(3, -1) }), None);
    }

    #[test]
    fn each_cause_has_its_evidence() {
        // Asleep when due, then waiting in the run queue.
        let queued = TickTiming { run_queue_wait_ns: 3 * MS, ..missed(3, -1) };
        assert_eq!(attribute(&queued).unwrap().of(Cause::RunQueue), 3 * MS);
        // The timer fired late, the core was free, and nothing explains it.
        assert_eq!(main_cause(&missed(3, -1)), Cause::Unknown);
        // The work used 4 ms on the core.
        assert_eq!(main_cause(&missed(3, 3)), Cause::OwnComputation);
        // It used 1 ms on the core and 3 ms in the run queue.
        let off = TickTiming { work_cpu_ns: MS, ..missed(3, 3) };
        assert_eq!(main_cause(&TickTiming { run_queue_wait_ns: 3 * MS, ..off }), Cause::RunQueue);
        assert_eq!(main_cause(&off), Cause::Unknown);
        assert_eq!(main_cause(&TickTiming { voluntary_switches: 1, ..off }), Cause::Blocked);
        assert_eq!(main_cause(&TickTiming { major_page_faults: 1, page_faults: 1, ..off }), Cause::PageFault);
        // The work touched 1,400 pages.
        assert_eq!(main_cause(&TickTiming { page_faults: 1400, ..missed(3, 3) }), Cause::PageFault);
        // A kernel that charges stolen time to the thread.
        assert_eq!(main_cause(&TickTiming { stolen_ns: 40 * MS, ..missed(30, 30) }), Cause::Stolen);
        // Collecting commands took 3 ms.
        assert_eq!(main_cause(&TickTiming { collect_ns: 3 * MS, ..missed(3, -1) }), Cause::Controllers);
        // The scene makes the physics wait for the recorder.
        assert_eq!(main_cause(&TickTiming { recorder_wait_ns: 3 * MS, ..missed(3, -1) }), Cause::Recorder);
    }

    /// Holds whether the thread slept or worked. Regression: a SIGSTOP of 600 ms was reported as 652 ms
    /// "stolen".
    #[test]
    fn a_stop_is_stopped_and_a_quota_is_throttled() {
        for at in [missed(600, -1), TickTiming { work_cpu_ns: MS, voluntary_switches: 1, ..missed(600, 600) }]
        {
            let stopped = TickTiming { stopped_ns: 600 * MS, ..at };
            assert_eq!(attribute(&stopped).unwrap().of(Cause::Stopped), 600 * MS, "{at:?}");
            // Some kernels count a throttled thread as waiting in the run queue, others do not.
            for run_queue_wait_ns in [0, 600 * MS] {
                let throttled = TickTiming { throttled_ns: 600 * MS, run_queue_wait_ns, ..at };
                assert_eq!(attribute(&throttled).unwrap().of(Cause::Throttled), 600 * MS, "{at:?}");
            }
        }
    }

    #[test]
    fn what_no_evidence_names_is_not_called_stolen() {
        let misses = all(&[missed(652, -1)]);
        assert_eq!((misses.lost.of(Cause::Stolen), misses.lost.of(Cause::Unknown)), (0, 652 * MS));
        assert_eq!(misses.describe(), "1 missed (100.00 %): 1 unknown; 652.0 ms lost, 0.0 % confirmed");
        // A later counter step covers only what the counter was behind by, and no more.
        let misses = all(&[missed(652, -1), TickTiming { stolen_ns: 100 * MS, ..missed(2, -1) }]);
        assert_eq!(misses.lost.of(Cause::Stolen), 2 * MS + STEAL_STEP_NS);
    }

    #[test]
    fn run_queue_time_of_an_earlier_part_explains_no_late_timer() {
        // Work: 0.4 ms on the core, 0.3 ms in the run queue, finished in time; then the timer fired 2 ms
        // late.
        let timing = TickTiming {
            work_ns: 700_000,
            work_cpu_ns: 400_000,
            run_queue_wait_ns: 300_000,
            ..missed(2, -1)
        };
        let lost = attribute(&timing).unwrap();
        assert_eq!((lost.of(Cause::RunQueue), lost.of(Cause::Unknown)), (0, 2 * MS));
    }

    #[test]
    fn a_run_says_its_misses_in_a_line() {
        let mut misses = Misses::default();
        misses.add(&TickTiming::zeroed());
        assert_eq!(misses.describe(), "0 missed (0.00 %)");
        misses.add(&TickTiming { stolen_ns: STEAL_STEP_NS, ..missed(3, -1) });
        misses.add(&TickTiming { late_controllers: 2, ..missed(1, 1) });
        assert_eq!(
            misses.describe(),
            "2 missed (66.67 %): 1 own computation, 1 stolen; 4.0 ms lost, 100.0 % confirmed"
        );
        assert_eq!((misses.not_stolen(), misses.late_controller_ticks), (1, 1));
    }

    /// Regression: the physics counted 436 misses, the report showed 355 and called them "100 % explained".
    #[test]
    fn misses_that_fell_into_a_gap_are_said() {
        let queued = TickTiming { run_queue_wait_ns: 3 * MS, ..missed(3, -1) };
        let mut misses = all(&[queued; 355]);
        misses.add_status(&RunStatus { missed_ticks: 436, ..RunStatus::zeroed() });
        misses.add_status(&RunStatus { missed_ticks: 400, ..RunStatus::zeroed() });
        assert_eq!((misses.missed(), misses.not_recorded()), (436, 81));
        let said = misses.describe();
        assert!(said.contains("436 missed") && said.contains("355 run queue, 81 not recorded"), "{said}");
    }

    /// Regression: the misses before a log that begins late were called "not recorded".
    #[test]
    fn misses_before_a_late_log_are_not_its_own() {
        let queued = TickTiming { run_queue_wait_ns: 3 * MS, ..missed(3, -1) };
        let mut misses = Misses::from_tick(Tick(100));
        let status = |missed_ticks| RunStatus { missed_ticks, ..RunStatus::zeroed() };
        misses.add(&queued);
        misses.add_status(&status(101));
        assert_eq!((misses.missed(), misses.not_recorded()), (1, 0));
        misses.add(&queued);
        misses.add_status(&status(105));
        assert_eq!((misses.missed(), misses.not_recorded()), (5, 3));
    }

    #[test]
    fn what_is_called_stolen_is_held_against_the_machines_counter() {
        assert_eq!(Misses::default().confirmed_share(), None);
        // The counter shows 20 of the 30 ms.
        let misses = all(&[TickTiming { stolen_ns: 20 * MS, ..missed(30, -1) }]);
        assert_eq!(misses.confirmed_share(), Some(20.0 / 30.0));
        assert_eq!(misses.by_cause[Cause::Stolen as usize], 1);
        // The counter moves in steps: of ten misses of 1 ms, the last one sees the time of all ten.
        let mut timings = [missed(1, -1); 10];
        timings[9].stolen_ns = 10 * MS;
        let misses = all(&timings);
        assert_eq!((misses.confirmed_share(), misses.by_cause[Cause::Stolen as usize]), (Some(1.0), 10));
        // On a physical machine nothing can be stolen.
        timings.iter_mut().for_each(|timing| (timing.virtual_machine, timing.stolen_ns) = (0, 0));
        assert_eq!(all(&timings).confirmed_share(), Some(0.0));
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

        /// For any readings, the parts sum to the lateness, and no cause gets more than its evidence.
        #[test]
        fn parts_sum_to_the_lateness(
            late in -10_i64..50_000_000, overrun in -2_000_000_i64..60_000_000,
            work in 0_u64..60_000_000, cpu in 0_u64..70_000_000, queue in 0_u64..80_000_000,
            collect in 0_u64..60_000_000, stolen in 0_u64..5, faults in 0_u32..5000, major in 0_u32..3,
            voluntary in 0_u32..4, virtual_machine in 0_u32..2,
            throttled in 0_u64..60_000_000, stopped in 0_u64..60_000_000, recorder in 0_u64..60_000_000,
        ) {
            let timing = TickTiming {
                wake_lateness_ns: late, overrun_ns: overrun, work_ns: work, work_cpu_ns: cpu,
                run_queue_wait_ns: queue, collect_ns: collect, stolen_ns: stolen * STEAL_STEP_NS,
                page_faults: faults + major, major_page_faults: major, voluntary_switches: voluntary,
                missed: 1, virtual_machine, throttled_ns: throttled, stopped_ns: stopped, recorder_wait_ns: recorder,
                ..TickTiming::zeroed()
            };
            let lost = attribute(&timing).unwrap();
            prop_assert_eq!(lost.total_ns(), late.max(0) as u64);
            prop_assert!(lost.of(Cause::RunQueue) <= queue);
            prop_assert!(lost.of(Cause::OwnComputation) <= cpu);
            prop_assert!(lost.of(Cause::Controllers) <= collect);
            prop_assert!(lost.of(Cause::Throttled) <= throttled);
            prop_assert!(lost.of(Cause::Stopped) <= stopped);
            prop_assert!(lost.of(Cause::Recorder) <= recorder);
            prop_assert!(lost.of(Cause::Stolen) <= timing.stolen_ns);
            // The same over any two ticks.
            let misses = all(&[timing, TickTiming { stolen_ns: STEAL_STEP_NS, ..timing }]);
            prop_assert!(misses.lost.of(Cause::Stolen) <= misses.steal_counter_ns);
            prop_assert_eq!(misses.lost.total_ns(), 2 * late.max(0) as u64);
            prop_assert_eq!(misses.by_cause.iter().sum::<u64>(), 2);
        }

        /// Extreme readings cause no overflow.
        #[test]
        fn any_bits_are_split(late in any::<i64>(), overrun in any::<i64>(), r in any::<[u64; 8]>(), c in any::<[u32; 4]>()) {
            let timing = TickTiming {
                wake_lateness_ns: late, overrun_ns: overrun, work_ns: r[0], work_cpu_ns: r[1],
                run_queue_wait_ns: r[2], collect_ns: r[3], stolen_ns: r[4], page_faults: c[0],
                major_page_faults: c[1], voluntary_switches: c[2], virtual_machine: c[3], missed: 1,
                throttled_ns: r[5], stopped_ns: r[6], recorder_wait_ns: r[7], ..TickTiming::zeroed()
            };
            prop_assert_eq!(attribute(&timing).unwrap().total_ns(), late.max(0) as u64);
        }
    }
}
