//! Why ticks began late: the lost time of each miss, split into causes by the readings in its [`TickTiming`].
//!
//! A miss is a tick that began more than a period behind its deadline; all of its lateness is lost, since the schedule
//! starts anew from there. The lateness has two parts. Up to the *overrun* the last tick's work was still going on;
//! behind it the thread was due and had not begun.
//!
//! | part | time | cause |
//! |---|---|---|
//! | overrun | off the core, in the run queue (`schedstat`) | run queue |
//! | overrun | off the core otherwise: a disk was waited for, the thread gave its core away, neither in a virtual machine, neither on a real one | page fault, blocked, stolen, unknown |
//! | overrun | on the core: 2 µs a page fault, then the rest | page fault, own computation |
//! | due | in the run queue | run queue |
//! | due | taking the controllers' commands | controllers |
//! | due | otherwise: the timer was late although nobody held the core; in a virtual machine, on a real one | stolen, unknown |
//!
//! The kernel leaves stolen time out of a thread's processor time (`CONFIG_PARAVIRT_TIME_ACCOUNTING`). One that does
//! not charges it to the thread; then what the machine's steal counter says beyond its step of 10 ms is taken from the
//! computation.

use ipc_types::messages::TickTiming;

/// First touch of a 4 KiB page: 1.8 to 2.0 µs were measured on a virtual machine whose host takes free pages back.
const PAGE_FAULT_NS: u64 = 2_000;
/// The machine's steal is counted in steps of this.
const STEAL_STEP_NS: u64 = 10_000_000;

/// Why time was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Cause {
    /// The last tick's own work took too long.
    OwnComputation,
    /// The thread could run, but others had its core.
    RunQueue,
    /// The hypervisor ran something else.
    Stolen,
    /// Memory had to be fetched or made.
    PageFault,
    /// The thread waited for something else than its tick.
    Blocked,
    /// Controllers' commands took long to take.
    Controllers,
    /// The readings do not say.
    Unknown,
}

impl Cause {
    /// All causes, in the order of [`LostTime`].
    pub const ALL: [Cause; 7] = [
        Cause::OwnComputation,
        Cause::RunQueue,
        Cause::Stolen,
        Cause::PageFault,
        Cause::Blocked,
        Cause::Controllers,
        Cause::Unknown,
    ];

    /// For people, and as a key in files.
    pub fn name(self) -> &'static str {
        match self {
            Cause::OwnComputation => "own computation",
            Cause::RunQueue => "run queue",
            Cause::Stolen => "stolen",
            Cause::PageFault => "page fault",
            Cause::Blocked => "blocked",
            Cause::Controllers => "late controller",
            Cause::Unknown => "unknown",
        }
    }

    /// Its mark in figures, so that colour is not needed.
    pub fn letter(self) -> char {
        match self {
            Cause::OwnComputation => 'O',
            Cause::RunQueue => 'Q',
            Cause::Stolen => 'S',
            Cause::PageFault => 'F',
            Cause::Blocked => 'B',
            Cause::Controllers => 'C',
            Cause::Unknown => 'U',
        }
    }
}

/// Time lost to each cause, ns, in the order of [`Cause::ALL`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LostTime(pub [u64; 7]);

impl LostTime {
    /// Time lost to a cause, ns.
    pub fn of(&self, cause: Cause) -> u64 {
        self.0[cause as usize]
    }

    /// All of it, ns.
    pub fn total_ns(&self) -> u64 {
        self.0.iter().fold(0, |sum, part| sum.saturating_add(*part))
    }

    /// The cause of most of it; of equal ones the first.
    pub fn main_cause(&self) -> Cause {
        let most = self.0.iter().copied().max().unwrap_or(0);
        Cause::ALL.into_iter().find(|cause| self.of(*cause) == most).unwrap_or(Cause::Unknown)
    }

    fn add(&mut self, other: &LostTime) {
        for (sum, part) in self.0.iter_mut().zip(other.0) {
            *sum = sum.saturating_add(part);
        }
    }
}

/// Time that is still to be explained, and what has been.
struct Ledger {
    left_ns: u64,
    lost: LostTime,
}

impl Ledger {
    /// Explains up to `evidence_ns` by a cause.
    fn take(&mut self, cause: Cause, evidence_ns: u64) {
        let taken_ns = evidence_ns.min(self.left_ns);
        self.left_ns -= taken_ns;
        self.lost.0[cause as usize] += taken_ns;
    }
}

/// Splits the lost time of a tick; none if it was not missed. The parts' sum is its lateness.
pub fn attribute(timing: &TickTiming) -> Option<LostTime> {
    if timing.missed == 0 {
        return None;
    }
    let late_ns = timing.wake_lateness_ns.max(0) as u64;
    let overrun_ns = (timing.overrun_ns.max(0) as u64).min(late_ns);
    let on_core_ns = timing.work_cpu_ns.min(timing.work_ns);
    let off_core_ns = timing.work_ns - on_core_ns;
    let queued_at_work_ns = timing.run_queue_wait_ns.min(off_core_ns);
    let unnamed = if timing.virtual_machine != 0 { Cause::Stolen } else { Cause::Unknown };

    let mut ledger = Ledger { left_ns: overrun_ns, lost: LostTime::default() };
    ledger.take(Cause::RunQueue, queued_at_work_ns);
    // A thread that has slept for its tick has given its core away once.
    let sleeps = u32::from(timing.overrun_ns < 0);
    let off_core = match (timing.major_page_faults, timing.voluntary_switches > sleeps) {
        (1.., _) => Cause::PageFault,
        (_, true) => Cause::Blocked,
        _ => unnamed,
    };
    ledger.take(off_core, off_core_ns - queued_at_work_ns);
    let seen_ns = (off_core_ns - queued_at_work_ns).saturating_add(STEAL_STEP_NS);
    ledger.take(Cause::Stolen, timing.stolen_ns.saturating_sub(seen_ns).min(on_core_ns));
    let faults_ns = u64::from(timing.page_faults).saturating_mul(PAGE_FAULT_NS).min(on_core_ns);
    ledger.take(Cause::PageFault, faults_ns);
    ledger.take(Cause::OwnComputation, on_core_ns - faults_ns);
    let unexplained_ns = ledger.left_ns;
    ledger.take(Cause::Unknown, unexplained_ns);

    ledger.left_ns = late_ns - overrun_ns;
    ledger.take(Cause::RunQueue, timing.run_queue_wait_ns - queued_at_work_ns);
    ledger.take(Cause::Controllers, timing.collect_ns);
    let rest_ns = ledger.left_ns;
    ledger.take(unnamed, rest_ns);
    Some(ledger.lost)
}

/// The misses of a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Misses {
    /// Ticks.
    pub ticks: u64,
    /// Ticks that began more than a period late.
    pub missed: u64,
    /// Misses by the cause of most of their lost time, in the order of [`Cause::ALL`].
    pub by_cause: [u64; 7],
    /// Lost time of all misses.
    pub lost: LostTime,
    /// What the machine's own counter (`/proc/stat`, in steps of 10 ms) says was stolen from the core of a late tick in
    /// the up to 100 ms before it, over all misses: the check of what is called stolen here.
    pub steal_counter_ns: u64,
    /// Ticks in which a controller's command was late. No time is lost to it in real time: its last command holds.
    pub late_controller_ticks: u64,
}

impl Misses {
    /// Takes in a tick.
    pub fn add(&mut self, timing: &TickTiming) {
        self.ticks += 1;
        self.late_controller_ticks += u64::from(timing.late_controllers != 0);
        if let Some(lost) = attribute(timing) {
            self.missed += 1;
            self.by_cause[lost.main_cause() as usize] += 1;
            self.lost.add(&lost);
            self.steal_counter_ns = self.steal_counter_ns.saturating_add(timing.stolen_ns);
        }
    }

    /// Share of the lost time that has a named cause; none without lost time.
    pub fn explained_share(&self) -> Option<f64> {
        let total_ns = self.lost.total_ns();
        let named_ns = total_ns - self.lost.of(Cause::Unknown).min(total_ns);
        (total_ns > 0).then(|| named_ns as f64 / total_ns as f64)
    }

    /// The same if only so much is called stolen as the machine's own counter shows.
    pub fn confirmed_share(&self) -> Option<f64> {
        let (total_ns, stolen_ns) = (self.lost.total_ns(), self.lost.of(Cause::Stolen));
        let doubted_ns = stolen_ns.saturating_sub(self.steal_counter_ns);
        self.explained_share().map(|share| (share - doubted_ns as f64 / total_ns as f64).max(0.0))
    }

    /// Misses that no hypervisor caused.
    pub fn not_stolen(&self) -> u64 {
        self.missed - self.by_cause[Cause::Stolen as usize]
    }

    /// One line: `12 missed (0.10 %): 8 run queue, 4 stolen; 31.2 ms lost, 99.1 % explained`.
    pub fn describe(&self) -> String {
        let share = 100.0 * self.missed as f64 / self.ticks.max(1) as f64;
        let mut text = format!("{} missed ({share:.2} %)", self.missed);
        let named = Cause::ALL.into_iter().zip(self.by_cause).filter(|(_, count)| *count > 0);
        let named: Vec<String> = named.map(|(cause, count)| format!("{count} {}", cause.name())).collect();
        if let Some(explained) = self.explained_share() {
            let lost_ms = self.lost.total_ns() as f64 * 1e-6;
            text += &format!(
                ": {}; {lost_ms:.1} ms lost, {:.1} % explained",
                named.join(", "),
                100.0 * explained
            );
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: u64 = 1_000_000;

    /// A miss whose last tick ended its work `overrun_ms` behind the deadline and which began `late_ms` behind it.
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

    #[test]
    fn a_tick_in_time_has_lost_nothing() {
        assert_eq!(attribute(&TickTiming { missed: 0, ..missed(3, -1) }), None);
    }

    #[test]
    fn each_cause_has_its_evidence() {
        // Asleep when due, and then in the run queue.
        let queued = TickTiming { run_queue_wait_ns: 3 * MS, ..missed(3, -1) };
        assert_eq!(attribute(&queued).unwrap().of(Cause::RunQueue), 3 * MS);
        // The timer was late, nobody held the core.
        assert_eq!(main_cause(&missed(3, -1)), Cause::Stolen);
        assert_eq!(main_cause(&TickTiming { virtual_machine: 0, ..missed(3, -1) }), Cause::Unknown);
        // The work took 4 ms of the core.
        assert_eq!(main_cause(&missed(3, 3)), Cause::OwnComputation);
        // It took 1 ms of the core and 3 ms in the run queue.
        let off = TickTiming { work_cpu_ns: MS, ..missed(3, 3) };
        assert_eq!(main_cause(&TickTiming { run_queue_wait_ns: 3 * MS, ..off }), Cause::RunQueue);
        assert_eq!(main_cause(&off), Cause::Stolen);
        assert_eq!(main_cause(&TickTiming { voluntary_switches: 1, ..off }), Cause::Blocked);
        assert_eq!(main_cause(&TickTiming { major_page_faults: 1, page_faults: 1, ..off }), Cause::PageFault);
        // 1,400 pages were touched.
        assert_eq!(main_cause(&TickTiming { page_faults: 1400, ..missed(3, 3) }), Cause::PageFault);
        // A kernel that charges stolen time to the thread.
        assert_eq!(main_cause(&TickTiming { stolen_ns: 40 * MS, ..missed(30, 30) }), Cause::Stolen);
        // Commands without end.
        assert_eq!(main_cause(&TickTiming { collect_ns: 3 * MS, ..missed(3, -1) }), Cause::Controllers);
    }

    #[test]
    fn run_queue_time_of_an_earlier_part_explains_no_late_timer() {
        // Work: 0.4 ms of the core, 0.3 ms in the run queue, done in time; then the timer was 2 ms late.
        let timing = TickTiming {
            work_ns: 700_000,
            work_cpu_ns: 400_000,
            run_queue_wait_ns: 300_000,
            ..missed(2, -1)
        };
        let lost = attribute(&timing).unwrap();
        assert_eq!((lost.of(Cause::RunQueue), lost.of(Cause::Stolen)), (0, 2 * MS));
    }

    #[test]
    fn a_run_says_its_misses_in_a_line() {
        let mut misses = Misses::default();
        misses.add(&TickTiming::zeroed());
        assert_eq!(misses.describe(), "0 missed (0.00 %)");
        misses.add(&missed(3, -1));
        misses.add(&TickTiming { late_controllers: 2, ..missed(1, 1) });
        assert_eq!(
            misses.describe(),
            "2 missed (66.67 %): 1 own computation, 1 stolen; 4.0 ms lost, 100.0 % explained"
        );
        assert_eq!((misses.not_stolen(), misses.late_controller_ticks), (1, 1));
    }

    #[test]
    fn what_is_called_stolen_is_held_against_the_machines_counter() {
        let mut misses = Misses::default();
        assert_eq!(misses.confirmed_share(), None);
        misses.add(&missed(30, -1));
        misses.add(&TickTiming { run_queue_wait_ns: 10 * MS, ..missed(10, -1) });
        // 30 of 40 ms are called stolen, and the counter shows nothing: a quarter is sure.
        assert_eq!((misses.explained_share(), misses.confirmed_share()), (Some(1.0), Some(0.25)));
        misses.add(&TickTiming { stolen_ns: 20 * MS, ..missed(0, -1) });
        assert_eq!(misses.confirmed_share(), Some(0.75));
        misses.add(&TickTiming { stolen_ns: 90 * MS, ..missed(0, -1) });
        assert_eq!(misses.confirmed_share(), Some(1.0));
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

        /// Whatever the readings: the parts' sum is the lateness, and no cause is given more than its evidence.
        #[test]
        fn parts_sum_to_the_lateness(
            late in -10_i64..50_000_000, overrun in -2_000_000_i64..60_000_000,
            work in 0_u64..60_000_000, cpu in 0_u64..70_000_000, queue in 0_u64..80_000_000,
            collect in 0_u64..60_000_000, stolen in 0_u64..5, faults in 0_u32..5000, major in 0_u32..3,
            voluntary in 0_u32..4, virtual_machine in 0_u32..2,
        ) {
            let timing = TickTiming {
                wake_lateness_ns: late, overrun_ns: overrun, work_ns: work, work_cpu_ns: cpu,
                run_queue_wait_ns: queue, collect_ns: collect, stolen_ns: stolen * STEAL_STEP_NS,
                page_faults: faults + major, major_page_faults: major, voluntary_switches: voluntary,
                missed: 1, virtual_machine, ..TickTiming::zeroed()
            };
            let lost = attribute(&timing).unwrap();
            prop_assert_eq!(lost.total_ns(), late.max(0) as u64);
            prop_assert!(lost.of(Cause::RunQueue) <= queue);
            prop_assert!(lost.of(Cause::OwnComputation) <= cpu);
            prop_assert!(lost.of(Cause::Controllers) <= collect);
            prop_assert!(virtual_machine == 1 || lost.of(Cause::Stolen) <= timing.stolen_ns);
        }

        /// Extreme readings overflow nothing.
        #[test]
        fn any_bits_are_split(late in any::<i64>(), overrun in any::<i64>(), r in any::<[u64; 5]>(), c in any::<[u32; 4]>()) {
            let timing = TickTiming {
                wake_lateness_ns: late, overrun_ns: overrun, work_ns: r[0], work_cpu_ns: r[1],
                run_queue_wait_ns: r[2], collect_ns: r[3], stolen_ns: r[4], page_faults: c[0],
                major_page_faults: c[1], voluntary_switches: c[2], virtual_machine: c[3], missed: 1,
                ..TickTiming::zeroed()
            };
            prop_assert_eq!(attribute(&timing).unwrap().total_ns(), late.max(0) as u64);
        }
    }
}
