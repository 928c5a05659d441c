//! Disturbances of this thread between the starts of two ticks, as counted by the kernel.
//!
//! There are two samples per tick: [`Disturbances::work_ends`] before the thread goes to sleep,
//! [`Disturbances::tick_begins`] after the next tick has begun. Together they take about 1.5 µs
//! (`trabecula-lab bench readings`): two reads of the thread's CPU clock, one of `schedstat` through a file
//! kept open, one `getrusage`. The machine's steal counter is read only in late ticks, and ten times a second
//! as a baseline for them; the counters for what suspends the whole process (`held_back`) only after a long
//! gap.

use std::fs::File;
use std::os::unix::fs::FileExt;

use ipc_types::clock::now_ns;
use ipc_types::messages::TickTiming;
use nix::sys::resource::{UsageWho, getrusage};

use super::clock::thread_cpu_ns;
use super::held_back::SuspensionCounters;

/// Maximum number of cores with separate steal counts.
const MAX_CORES: usize = 256;
/// Unit of `/proc/stat` (`USER_HZ` is 100 on every architecture that we build for).
const STEAL_STEP_NS: u64 = 10_000_000;

/// Counters of this thread. Allocates all its memory when created.
#[derive(Debug)]
pub struct Disturbances {
    schedstat: Option<File>,
    steal: Steal,
    held_back: SuspensionCounters,
    counts: Counts,
    wait_ns: u64,
    begin_ns: u64,
    begin_cpu_ns: u64,
    work_end_ns: u64,
    work_end_cpu_ns: u64,
    virtual_machine: bool,
}

#[derive(Debug, Clone, Copy, Default)]
struct Counts {
    minor: u64,
    major: u64,
    voluntary: u64,
    involuntary: u64,
}

impl Counts {
    fn now() -> Counts {
        let Ok(usage) = getrusage(UsageWho::RUSAGE_THREAD) else { return Counts::default() };
        Counts {
            minor: usage.minor_page_faults() as u64,
            major: usage.major_page_faults() as u64,
            voluntary: usage.voluntary_context_switches() as u64,
            involuntary: usage.involuntary_context_switches() as u64,
        }
    }
}

/// The kind of tick that a sample belongs to. Only a late tick's sample reads the machine's steal counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sample {
    /// A tick that began on time.
    InTime,
    /// A tick that began late.
    Late,
}

impl Default for Disturbances {
    fn default() -> Disturbances {
        Disturbances::new()
    }
}

impl Disturbances {
    /// Takes the first sample; call it from the thread to watch.
    pub fn new() -> Disturbances {
        let cpuinfo = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let flags = cpuinfo.lines().find(|line| line.starts_with("flags")).unwrap_or_default();
        let mut new = Disturbances {
            schedstat: File::open("/proc/thread-self/schedstat").ok(),
            steal: Steal::new(),
            held_back: SuspensionCounters::new(),
            counts: Counts::now(),
            wait_ns: 0,
            begin_ns: now_ns(),
            begin_cpu_ns: thread_cpu_ns(),
            work_end_ns: now_ns(),
            work_end_cpu_ns: thread_cpu_ns(),
            virtual_machine: flags.split_whitespace().any(|flag| flag == "hypervisor"),
        };
        new.wait_ns = new.total_wait_ns().unwrap_or(0);
        new
    }

    /// Call when a tick's work is done, before the thread goes to sleep.
    pub fn work_ends(&mut self) {
        self.work_end_ns = now_ns();
        self.work_end_cpu_ns = thread_cpu_ns();
    }

    /// Call when a tick has begun at `start_ns`, `lateness_ns` after its deadline. Fills the counters into
    /// its timing.
    pub fn tick_begins(&mut self, start_ns: u64, lateness_ns: i64, tick: Sample, timing: &mut TickTiming) {
        let deadline_ns = start_ns as i64 - lateness_ns;
        timing.work_ns = self.work_end_ns.saturating_sub(self.begin_ns);
        timing.work_cpu_ns = self.work_end_cpu_ns.saturating_sub(self.begin_cpu_ns);
        timing.overrun_ns = self.work_end_ns as i64 - deadline_ns;
        timing.stolen_ns = match tick {
            Sample::Late => self.steal.since_last(),
            Sample::InTime => 0,
        };
        (timing.throttled_ns, timing.stopped_ns) = self.held_back.before(lateness_ns);
        timing.virtual_machine = u32::from(self.virtual_machine);
        self.count(timing);
        self.begin_ns = start_ns;
        self.begin_cpu_ns = thread_cpu_ns();
    }

    /// Adds the counts since the last call.
    pub fn count(&mut self, timing: &mut TickTiming) {
        let (now, last) = (Counts::now(), self.counts);
        let since = |now: u64, last: u64| now.saturating_sub(last) as u32;
        timing.major_page_faults = since(now.major, last.major);
        timing.page_faults = since(now.minor, last.minor).saturating_add(timing.major_page_faults);
        timing.voluntary_switches = since(now.voluntary, last.voluntary);
        timing.involuntary_switches = since(now.involuntary, last.involuntary);
        self.counts = now;
        // A thread that never lost its core has not waited for one. Reading the file takes a microsecond, so
        // do it only after a context switch.
        timing.run_queue_wait_ns = 0;
        if timing.voluntary_switches + timing.involuntary_switches > 0 {
            let total_ns = self.total_wait_ns().unwrap_or(self.wait_ns);
            timing.run_queue_wait_ns = total_ns.saturating_sub(self.wait_ns);
            self.wait_ns = total_ns;
        }
    }

    /// Samples the steal counter, so that the next late tick sees only what came after.
    pub fn note_steal(&mut self) {
        self.steal.since_last();
    }

    fn total_wait_ns(&self) -> Option<u64> {
        let mut text = [0; 96];
        let length = self.schedstat.as_ref()?.read_at(&mut text, 0).ok()?;
        number(text[..length].split(|byte| *byte == b' ').nth(1)?)
    }
}

/// Steal time of each core.
#[derive(Debug)]
struct Steal {
    file: Option<File>,
    text: Box<[u8]>,
    last: Box<[u64; MAX_CORES]>,
}

impl Steal {
    fn new() -> Steal {
        let mut steal = Steal {
            file: File::open("/proc/stat").ok(),
            text: vec![0; 32 * 1024].into_boxed_slice(),
            last: Box::new([0; MAX_CORES]),
        };
        steal.since_last();
        steal
    }

    /// Returns the steal time of the current core since the last sample.
    fn since_last(&mut self) -> u64 {
        let length = self.file.as_ref().and_then(|file| file.read_at(&mut self.text, 0).ok()).unwrap_or(0);
        let core = rustix::thread::sched_getcpu();
        let mut since = 0;
        // cpuN user nice system idle iowait irq softirq steal … (proc_stat(5)).
        for line in self.text[..length].split(|byte| *byte == b'\n') {
            let Some(rest) = line.strip_prefix(b"cpu").filter(|rest| rest.first() != Some(&b' ')) else {
                continue;
            };
            let mut words = rest.split(|byte| *byte == b' ');
            let (index, steps) = (words.next().and_then(number), words.nth(7).and_then(number));
            let (Some(index), Some(steps)) = (index, steps) else { continue };
            let Some(last) = self.last.get_mut(index as usize) else { continue };
            if index as usize == core {
                since = steps.saturating_sub(*last);
            }
            *last = steps;
        }
        since.saturating_mul(STEAL_STEP_NS)
    }
}

pub(super) fn number(digits: &[u8]) -> Option<u64> {
    let one = |sum: u64, digit: &u8| {
        digit.is_ascii_digit().then(|| sum.wrapping_mul(10).wrapping_add(u64::from(digit - b'0')))
    };
    (!digits.is_empty()).then(|| digits.iter().try_fold(0, one)).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readings_of_a_thread_that_works_and_sleeps_say_so() {
        let mut readings = Disturbances::new();
        let mut timing = TickTiming::zeroed();
        readings.tick_begins(now_ns(), 0, Sample::Late, &mut timing);
        let began = thread_cpu_ns();
        while thread_cpu_ns() - began < 3_000_000 {
            std::hint::spin_loop();
        }
        readings.work_ends();
        std::thread::sleep(std::time::Duration::from_millis(2));
        let start_ns = now_ns();
        readings.tick_begins(start_ns, 500, Sample::InTime, &mut timing);
        assert!(timing.work_cpu_ns >= 3_000_000, "{timing:?}");
        assert!(timing.work_ns >= timing.work_cpu_ns, "{timing:?}");
        assert!(timing.voluntary_switches >= 1, "it slept: {timing:?}");
        assert!(timing.overrun_ns <= 500 - 2_000_000, "{timing:?}");
        assert_eq!(timing.stolen_ns, 0, "not read");
    }

    #[test]
    fn touched_memory_is_a_page_fault() {
        let mut readings = Disturbances::new();
        let mut timing = TickTiming::zeroed();
        readings.count(&mut timing);
        // `black_box`, or the compiler would remove the allocation.
        let fresh = std::hint::black_box(vec![1_u8; 8 << 20]);
        readings.count(&mut timing);
        assert!(timing.page_faults > 0 && fresh[4096] == 1, "{timing:?}");
    }

    #[test]
    fn numbers_are_read() {
        assert_eq!(number(b"0120"), Some(120));
        assert_eq!((number(b""), number(b"1a")), (None, None));
    }
}
