//! What the renderer needs of the machine that it runs on; its caller provides it.

use zerocopy::{FromBytes, Immutable, IntoBytes};

/// Threads, a clock and memory. None of them changes a bit of a frame: they decide only how long it takes, and whether a volume that is
/// too large is refused.
pub trait Machine: Sync {
    /// A pool of this many worker threads.
    ///
    /// # Errors
    /// Why they cannot be started, in the system's words.
    fn workers(&self, threads: usize) -> Result<rayon::ThreadPool, String>;

    /// Monotonic time in nanoseconds, from any origin. It only decides whether an update or a full sum is expected to be faster; with a
    /// clock that stands still, as here, it is always the update.
    fn now_ns(&self) -> u64 {
        0
    }

    /// Bytes of memory that are free; `None`, as here, if that is unknown: then nothing is refused in advance.
    fn available_bytes(&self) -> Option<u64> {
        None
    }

    /// At least this many bytes of zeros, aligned to 64 bytes; `None` if there is not enough memory. Here they come from the heap; huge
    /// pages make the sums faster.
    fn zeroed(&self, bytes: usize) -> Option<Box<dyn Memory>> {
        let (mut lines, count) = (Vec::new(), bytes.div_ceil(LINE));
        lines.try_reserve_exact(count).ok()?;
        lines.resize(count, Line([0; LINE]));
        Some(Box::new(Heap(lines)))
    }
}

/// A block of bytes that is freed when it is dropped.
pub trait Memory: Send + Sync {
    /// The bytes.
    fn bytes(&self) -> &[u8];
    /// The same, to be written.
    fn bytes_mut(&mut self) -> &mut [u8];
}

const LINE: usize = 64;

/// A cache line: its alignment is that of the widest vectors.
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
