//! The renderer's interface to the machine, implemented by the caller.

use zerocopy::{FromBytes, Immutable, IntoBytes};

/// Threads, a clock and memory. None of them changes a bit of a frame. They affect only how long it takes,
/// and whether a volume that is too large is refused.
pub trait Machine: Sync {
    /// A pool of `threads` worker threads.
    ///
    /// # Errors
    /// The system's reason why they cannot be started.
    fn workers(&self, threads: usize) -> Result<rayon::ThreadPool, String>;

    /// Monotonic time in nanoseconds, from any origin. Used only to predict whether an update or a full sum
    /// is faster; with a constant clock, as in this default, the renderer always updates.
    fn now_ns(&self) -> u64 {
        0
    }

    /// Free memory in bytes; `None`, the default, if unknown: then nothing is refused in advance.
    fn available_bytes(&self) -> Option<u64> {
        None
    }

    /// At least this many zero bytes, aligned to 64 bytes; `None` if there is not enough memory. The default
    /// uses the heap; huge pages make the sums faster.
    fn zeroed(&self, bytes: usize) -> Option<Box<dyn Memory>> {
        let (mut lines, count) = (Vec::new(), bytes.div_ceil(LINE));
        lines.try_reserve_exact(count).ok()?;
        lines.resize(count, Line([0; LINE]));
        Some(Box::new(Heap(lines)))
    }
}

/// A block of bytes, freed on drop.
pub trait Memory: Send + Sync {
    /// The bytes.
    fn bytes(&self) -> &[u8];
    /// The bytes, writable.
    fn bytes_mut(&mut self) -> &mut [u8];
}

const LINE: usize = 64;

/// A cache line: aligned for the widest vectors.
#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable)]
#[repr(C, align(64))]
struct Line([u8; LINE]);

struct Heap(Vec<Line>);

impl Memory for Heap {
    fn bytes(&self) -> &[u8] {
        self.0.as_bytes()
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        self.0.as_mut_bytes()
    }
}
