//! Records the machine's load and steal during a measurement, without which a timing means little.

use std::time::Instant;

/// Counts of `/proc/stat`, in clock ticks over all cores.
#[derive(Debug, Clone, Copy, Default)]
struct CpuTimes {
    all: u64,
    idle: u64,
    stolen: u64,
}

impl CpuTimes {
    fn now() -> CpuTimes {
        let text = std::fs::read_to_string("/proc/stat").unwrap_or_default();
        // cpu user nice system idle iowait irq softirq steal (proc_stat(5)); guest time is part of user time.
        let first = text.lines().next().unwrap_or_default();
        let fields: Vec<u64> =
            first.split_whitespace().skip(1).take(8).map_while(|field| field.parse().ok()).collect();
        let field = |index: usize| fields.get(index).copied().unwrap_or(0);
        CpuTimes { all: fields.iter().sum(), idle: field(3) + field(4), stolen: field(7) }
    }
}

/// Measures the machine's load from the start of a measurement.
#[derive(Debug)]
pub struct Machine {
    began: Instant,
    before: CpuTimes,
}

impl Machine {
    /// Starts the measurement.
    pub fn watch() -> Machine {
        Machine { began: Instant::now(), before: CpuTimes::now() }
    }

    /// Returns busy and stolen time since the start, in percent of all cores' time.
    pub fn shares_percent(&self) -> (f64, f64) {
        let now = CpuTimes::now();
        let all = now.all.saturating_sub(self.before.all).max(1) as f64;
        let percent = |now: u64, before: u64| 100.0 * now.saturating_sub(before) as f64 / all;
        (100.0 - percent(now.idle, self.before.idle), percent(now.stolen, self.before.stolen))
    }

    /// Returns the seconds since the start.
    pub fn seconds(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    /// Formats cores, load and steal since the start.
    pub fn summary(&self) -> String {
        let (busy, stolen) = self.shares_percent();
        let cores = std::thread::available_parallelism().map_or(0, usize::from);
        format!("{cores} cores, {busy:.0} % busy, {stolen:.2} % stolen, {:.1} s", self.seconds())
    }
}
