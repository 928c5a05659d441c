//! The machine services that the renderer uses: threads, the monotonic clock, free memory, huge pages.

use std::sync::LazyLock;
use std::time::Instant;

use memmap2::MmapMut;
use xray::{Machine, Memory};

/// The machine that this process runs on.
#[derive(Debug, Clone, Copy)]
pub struct ThisMachine;

impl Machine for ThisMachine {
    fn workers(&self, threads: usize) -> Result<rayon::ThreadPool, String> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|i| format!("drr-{i}"));
        pool.build().map_err(|cause| cause.to_string())
    }

    /// Uses the standard library's clock, which also works under valgrind (`trabecula-lab bench
    /// instructions`).
    fn now_ns(&self) -> u64 {
        static START: LazyLock<Instant> = LazyLock::new(Instant::now);
        START.elapsed().as_nanos() as u64
    }

    /// Returns `MemAvailable` of `/proc/meminfo` (proc_meminfo(5)); `None` if it is missing.
    fn available_bytes(&self) -> Option<u64> {
        let text = std::fs::read_to_string("/proc/meminfo").ok()?;
        let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
        line.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
    }

    /// Allocates huge pages where the kernel grants them.
    fn zeroed(&self, bytes: usize) -> Option<Box<dyn Memory>> {
        // The system refuses empty mappings.
        let map = MmapMut::map_anon(bytes.max(1)).ok()?;
        // A kernel without huge pages refuses this; small pages are only slower.
        #[cfg(target_os = "linux")]
        map.advise(memmap2::Advice::HugePage).ok();
        Some(Box::new(Mapping(map)))
    }
}

/// An anonymous mapping; it is page-aligned, which satisfies every alignment.
struct Mapping(MmapMut);

impl Memory for Mapping {
    fn bytes(&self) -> &[u8] {
        &self.0
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        &mut self.0
    }
}
