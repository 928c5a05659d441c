//! Bounds the memory of the process, because rustdds allocates the sizes that datagrams claim.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Limit on the process's private memory, bytes. `docs/ros2.md` has what a bridge uses: a few per cent of it.
pub const MOST_MEMORY_BYTES: u64 = 1 << 30;

/// Limits this process to [`MOST_MEMORY_BYTES`]; call it before any thread starts. One datagram can claim a
/// message of 4 GiB, which rustdds (0.15) allocates before it has received it. With the limit that
/// allocation fails and the process aborts with a message, instead of taking the machine's memory from the
/// run. Shared memory does not count. An abort writes no core file.
pub fn bound_memory() {
    for (resource, most) in [(Resource::Data, MOST_MEMORY_BYTES), (Resource::Core, 0)] {
        let limit = getrlimit(resource);
        let current = Some(limit.current.map_or(most, |current| current.min(most)));
        // Lowering a soft limit is always permitted.
        let _ = setrlimit(resource, Rlimit { current, maximum: limit.maximum });
    }
}
