//! The causes of late ticks, and how much time is lost to each.

/// Number of causes.
pub(super) const CAUSES: usize = 10;

/// Why time was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Cause {
    /// The last tick's own work took too long.
    OwnComputation,
    /// The thread could run, but others had its core.
    RunQueue,
    /// The hypervisor ran something else, as the machine's counter confirms.
    Stolen,
    /// The control group had used up its quota.
    Throttled,
    /// The process was stopped or frozen.
    Stopped,
    /// Memory had to be fetched or made.
    PageFault,
    /// The thread waited for something else than its tick.
    Blocked,
    /// Controllers' commands took long to take.
    Controllers,
    /// The physics waited for the recorder, as the scene wants it.
    Recorder,
    /// The readings do not say.
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

    /// For people, and as a key in files.
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

    /// Its mark in figures, so that colour is not needed.
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

    /// All of it, ns.
    pub fn total_ns(&self) -> u64 {
        self.0.iter().fold(0, |sum, part| sum.saturating_add(*part))
    }

    /// The cause of most of it; of equal ones the first.
    pub fn main_cause(&self) -> Cause {
        let most = self.0.iter().copied().max().unwrap_or(0);
        Cause::ALL.into_iter().find(|cause| self.of(*cause) == most).unwrap_or(Cause::Unknown)
    }

    /// Calls up to `evidence_ns` of what is unknown stolen; returns how much that is.
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
