//! The causes of late ticks, and how much time each one cost.

/// Number of causes.
pub(super) const CAUSES: usize = 10;

/// The cause of lost time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Cause {
    /// The previous tick's own work took too long.
    OwnComputation,
    /// The thread was runnable, but other threads had its core.
    RunQueue,
    /// The hypervisor ran something else, confirmed by the machine's steal counter.
    Stolen,
    /// The cgroup had used up its CPU quota.
    Throttled,
    /// The process was stopped or frozen.
    Stopped,
    /// A page had to be read from disk or allocated.
    PageFault,
    /// The thread blocked on something other than its tick.
    Blocked,
    /// Collecting the controllers' commands took too long.
    Controllers,
    /// The physics waited for the recorder, as the scene requires.
    Recorder,
    /// The readings do not show the cause.
    Unknown,
}

impl Cause {
    /// All causes, in the order of [`LostTime`].
    pub const ALL: [Cause; CAUSES] = [
        Cause::OwnComputation,
        Cause::RunQueue,
        Cause::Stolen,
        Cause::Throttled,
        Cause::Stopped,
        Cause::PageFault,
        Cause::Blocked,
        Cause::Controllers,
        Cause::Recorder,
        Cause::Unknown,
    ];

    /// The name shown to users and used as a key in files.
    pub fn name(self) -> &'static str {
        match self {
            Cause::OwnComputation => "own computation",
            Cause::RunQueue => "run queue",
            Cause::Stolen => "stolen",
            Cause::Throttled => "throttled",
            Cause::Stopped => "stopped",
            Cause::PageFault => "page fault",
            Cause::Blocked => "blocked",
            Cause::Controllers => "late controller",
            Cause::Recorder => "recorder",
            Cause::Unknown => "unknown",
        }
    }

    /// The cause's letter in figures, so that they do not rely on colour.
    pub fn letter(self) -> char {
        match self {
            Cause::OwnComputation => 'O',
            Cause::RunQueue => 'Q',
            Cause::Stolen => 'S',
            Cause::Throttled => 'T',
            Cause::Stopped => 'P',
            Cause::PageFault => 'F',
            Cause::Blocked => 'B',
            Cause::Controllers => 'C',
            Cause::Recorder => 'R',
            Cause::Unknown => 'U',
        }
    }
}

/// Time lost to each cause, ns, in the order of [`Cause::ALL`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LostTime(pub [u64; CAUSES]);

impl LostTime {
    /// Time lost to a cause, ns.
    pub fn of(&self, cause: Cause) -> u64 {
        self.0[cause as usize]
    }

    /// Total, ns.
    pub fn total_ns(&self) -> u64 {
        self.0.iter().fold(0, |sum, part| sum.saturating_add(*part))
    }

    /// The cause with the most lost time; on a tie, the first.
    pub fn main_cause(&self) -> Cause {
        let most = self.0.iter().copied().max().unwrap_or(0);
        Cause::ALL.into_iter().find(|cause| self.of(*cause) == most).unwrap_or(Cause::Unknown)
    }

    /// Moves up to `evidence_ns` from unknown to stolen; returns how much.
    pub(super) fn rename_unknown(&mut self, evidence_ns: u64) -> u64 {
        let stolen_ns = evidence_ns.min(self.of(Cause::Unknown));
        self.0[Cause::Unknown as usize] -= stolen_ns;
        self.0[Cause::Stolen as usize] = self.of(Cause::Stolen).saturating_add(stolen_ns);
        stolen_ns
    }

    pub(super) fn add(&mut self, other: &LostTime) {
        for (sum, part) in self.0.iter_mut().zip(other.0) {
            *sum = sum.saturating_add(part);
        }
    }
}
