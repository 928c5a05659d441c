//! A file written by its own thread, so that a stalled disk does not stall the recorder.
//!
//! Bytes go into preallocated, page-aligned buffers that are reused. The thread writes them with `O_DIRECT`
//! if the file system supports it. That skips the copy into the page cache, which takes a fraction of the
//! processor time and avoids long, non-preemptible copies in the kernel. Otherwise (tmpfs, FUSE) it uses
//! ordinary writes. The finished file is the same either way.
//!
//! During direct writes the file may end in up to one block of zeros, which pad its last block.
//!
//! The thread syncs to disk once a second (`fdatasync`) and before the file is closed, so a power failure
//! loses about the last second. The recorder does not wait for the sync either.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use memmap2::MmapMut;

mod disk;

use disk::{Disk, Medium, open};

/// Alignment of offsets, lengths and addresses that `O_DIRECT` accepts on every file system.
const BLOCK: usize = 4096;

const _: () =
    assert!(BLOCK as u64 <= run_log::PADDING_BYTES, "readers expect the zeros behind an unfinished log");
/// Wall time between syncs; data are safe on disk after this plus the duration of the sync.
pub const SYNC_PERIOD: Duration = Duration::from_secs(1);

/// Buffers of a background file, and how to open it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BackgroundOptions {
    /// Number of buffers.
    pub buffers: usize,
    /// Size of each buffer in bytes; a multiple of 4096.
    pub buffer_bytes: usize,
    /// Whether to try `O_DIRECT`.
    pub direct: bool,
    /// Whether to fail if the file exists.
    pub fresh: bool,
}

impl BackgroundOptions {
    /// 32 MiB, in buffers small enough that a flush every 10 ms does not use up the pool: half a second of 2
    /// MiB images at 30 Hz. Only buffers that are used become resident.
    pub const RUN: BackgroundOptions =
        BackgroundOptions { buffers: 64, buffer_bytes: 512 << 10, direct: true, fresh: true };
    /// 2 MiB: more than half a second of the timing lane.
    pub const TIMING: BackgroundOptions =
        BackgroundOptions { buffers: 16, buffer_bytes: 128 << 10, direct: true, fresh: true };
}

/// A buffer and the bytes in it.
struct Buffer {
    memory: MmapMut,
    /// File offset of its first byte; a multiple of [`BLOCK`].
    offset: u64,
    /// Bytes at its start that were already written with the previous buffer.
    carried: usize,
    length: usize,
}

struct State {
    /// A stack, so that as little memory as possible is touched.
    free: Vec<Buffer>,
    full: VecDeque<Buffer>,
    /// Number of buffers handed over but not in the file yet: those in `full`, and the one being written.
    unwritten: usize,
    failure: Option<(io::ErrorKind, Option<i32>, String)>,
    closed: bool,
}

impl State {
    /// Keeps only the first error.
    fn fail(&mut self, outcome: io::Result<()>) {
        if let (Err(cause), None) = (outcome, &self.failure) {
            self.failure = Some((cause.kind(), cause.raw_os_error(), cause.to_string()));
        }
    }
}

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>) -> MutexGuard<'a, State> {
        self.wait_for(state, None)
    }

    /// Waits for a change, up to `limit`.
    fn wait_for<'a>(&self, state: MutexGuard<'a, State>, limit: Option<Duration>) -> MutexGuard<'a, State> {
        match limit {
            None => self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
            Some(limit) => {
                let waited = self.changed.wait_timeout(state, limit);
                waited.unwrap_or_else(PoisonError::into_inner).0
            }
        }
    }
}

/// A file being written by its own thread.
///
/// `write` copies; it blocks only when all buffers are full. `flush` hands the data to the thread and does
/// not wait for the disk. An error of the thread is returned by the next call and by
/// [`close`](BackgroundFile::close).
pub struct BackgroundFile {
    shared: Arc<Shared>,
    current: Option<Buffer>,
    thread: Option<JoinHandle<()>>,
}

impl BackgroundFile {
    /// Creates the file, its buffers and its thread.
    ///
    /// # Errors
    /// The file cannot be created, or the system refuses the memory or the thread.
    pub fn create(path: &Path, options: BackgroundOptions) -> io::Result<BackgroundFile> {
        let (file, direct) = open(path, options)?;
        BackgroundFile::on(Box::new(file), BackgroundOptions { direct, ..options })
    }

    /// Uses an open medium; `options.direct` tells how it was opened.
    fn on(medium: Box<dyn Medium>, options: BackgroundOptions) -> io::Result<BackgroundFile> {
        let bytes = options.buffer_bytes.next_multiple_of(BLOCK).max(2 * BLOCK);
        let buffer = |_| -> io::Result<Buffer> {
            Ok(Buffer { memory: MmapMut::map_anon(bytes)?, offset: 0, carried: 0, length: 0 })
        };
        let mut free = (0..options.buffers.max(2)).map(buffer).collect::<io::Result<Vec<Buffer>>>()?;
        let full = VecDeque::with_capacity(free.len());
        let current = free.pop();
        let state = State { free, full, unwritten: 0, failure: None, closed: false };
        let shared = Arc::new(Shared { state: Mutex::new(state), changed: Condvar::new() });
        let of_thread = Arc::clone(&shared);
        let disk = Disk { medium, direct: options.direct, written: 0, unsynced: None };
        let thread = std::thread::Builder::new().name("log writer".to_owned());
        let thread = thread.spawn(move || disk.serve(&of_thread))?;
        Ok(BackgroundFile { shared, current, thread: Some(thread) })
    }

    /// Returns a handle that waits for flushed data.
    pub fn written(&self) -> FlushWaiter {
        FlushWaiter(Arc::clone(&self.shared))
    }

    /// Writes the remaining data, sets the file's exact length, and waits until everything is on disk.
    ///
    /// # Errors
    /// The first error of the disk.
    pub fn close(mut self) -> io::Result<()> {
        let flushed = self.flush();
        self.join();
        flushed.and(check(&self.shared.lock()))
    }

    fn join(&mut self) {
        self.shared.lock().closed = true;
        self.shared.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            // The thread does not panic; if it did, the state would hold its error or its unwritten data.
            let _ = thread.join();
        }
    }

    /// Hands over the current buffer and starts the next one with its last, incomplete block.
    fn submit(&mut self) -> io::Result<()> {
        let mut state = self.shared.lock();
        let mut next = loop {
            check(&state)?;
            match state.free.pop() {
                Some(buffer) => break buffer,
                None => state = self.shared.wait(state),
            }
        };
        if let Some(done) = self.current.take() {
            let whole = done.length / BLOCK * BLOCK;
            let rest = done.length - whole;
            next.memory[..rest].copy_from_slice(&done.memory[whole..done.length]);
            (next.offset, next.carried, next.length) = (done.offset + whole as u64, rest, rest);
            state.full.push_back(done);
            state.unwritten += 1;
        }
        drop(state);
        self.shared.changed.notify_all();
        self.current = Some(next);
        Ok(())
    }
}

/// Waits for the writes of a [`BackgroundFile`], which another owner may hold by then.
pub struct FlushWaiter(Arc<Shared>);

impl FlushWaiter {
    /// Waits until all flushed data are in the file, where they survive this process being killed.
    ///
    /// # Errors
    /// The first error of the disk; [`io::ErrorKind::TimedOut`] if it has not written everything within the
    /// limit.
    pub fn wait(&self, limit: Duration) -> io::Result<()> {
        let end = Instant::now() + limit;
        let mut state = self.0.lock();
        while state.unwritten > 0 {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                let waited = format!("the disk has not written {} buffers within {limit:?}", state.unwritten);
                return Err(io::Error::new(io::ErrorKind::TimedOut, waited));
            }
            state = self.0.wait_for(state, Some(left));
        }
        check(&state)
    }
}

impl Write for BackgroundFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.current.as_ref().is_none_or(|buffer| buffer.length == buffer.memory.len()) {
            self.submit()?;
        }
        let Some(buffer) = &mut self.current else { return Ok(0) };
        let count = bytes.len().min(buffer.memory.len() - buffer.length);
        buffer.memory[buffer.length..buffer.length + count].copy_from_slice(&bytes[..count]);
        buffer.length += count;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.current.as_ref().is_some_and(|buffer| buffer.length > buffer.carried) {
            return self.submit();
        }
        check(&self.shared.lock())
    }
}

impl Drop for BackgroundFile {
    fn drop(&mut self) {
        if self.thread.is_some() {
            // The error can no longer be reported; write what was accepted, if possible.
            let _ = self.flush();
            self.join();
        }
    }
}

fn check(state: &State) -> io::Result<()> {
    match &state.failure {
        None => Ok(()),
        Some((_, Some(code), _)) => Err(io::Error::from_raw_os_error(*code)),
        Some((kind, None, text)) => Err(io::Error::new(*kind, text.clone())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: Duration = Duration::from_secs(60);

    /// A disk with a volatile cache, which a power failure empties.
    #[derive(Default)]
    struct Volatile {
        cache: Vec<u8>,
        disk: Vec<u8>,
        syncs: u64,
        refuses: bool,
    }

    impl Medium for Arc<Mutex<Volatile>> {
        fn write_all_at(&self, bytes: &[u8], offset: u64) -> io::Result<()> {
            let mut this = self.lock().unwrap();
            let (begin, end) = (offset as usize, offset as usize + bytes.len());
            if this.cache.len() < end {
                this.cache.resize(end, 0);
            }
            this.cache[begin..end].copy_from_slice(bytes);
            Ok(())
        }

        fn write_through_cache(&self) -> io::Result<()> {
            Ok(())
        }

        fn set_length(&self, length: u64) -> io::Result<()> {
            self.lock().unwrap().cache.truncate(length as usize);
            Ok(())
        }

        fn sync(&self) -> io::Result<()> {
            let mut this = self.lock().unwrap();
            this.syncs += 1;
            if this.refuses {
                return Err(io::Error::from_raw_os_error(rustix::io::Errno::IO.raw_os_error()));
            }
            this.disk = this.cache.clone();
            Ok(())
        }
    }

    fn file() -> (Arc<Mutex<Volatile>>, BackgroundFile) {
        let disk = Arc::new(Mutex::new(Volatile::default()));
        let options = BackgroundOptions { buffers: 4, buffer_bytes: 8192, direct: true, fresh: true };
        (
            Arc::clone(&disk),
            BackgroundFile::on(Box::new(Arc::clone(&disk)), BackgroundOptions { direct: true, ..options })
                .unwrap(),
        )
    }

    fn wait_for(what: &str, mut done: impl FnMut() -> bool) {
        let end = Instant::now() + LIMIT;
        while !done() {
            assert!(Instant::now() < end, "{what} did not happen");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Regression: nothing was ever synced, so a machine that crashed right after "completed" had an empty
    /// log.
    #[test]
    fn a_closed_file_survives_a_crash_of_the_machine() {
        let (disk, mut file) = file();
        let bytes: Vec<u8> = (0..100_000_u32).map(|i| i as u8).collect();
        file.write_all(&bytes).unwrap();
        file.close().unwrap();
        assert!(disk.lock().unwrap().disk == bytes);
    }

    #[test]
    fn what_was_written_is_soon_on_the_disk_and_an_idle_file_is_left_alone() {
        let (disk, mut file) = file();
        file.write_all(&[7; 5000]).unwrap();
        file.flush().unwrap();
        wait_for("the first sync", || disk.lock().unwrap().disk.starts_with(&[7; 5000]));
        let before = disk.lock().unwrap().syncs;
        std::thread::sleep(2 * SYNC_PERIOD);
        assert_eq!(disk.lock().unwrap().syncs, before);
        drop(file);
    }

    #[test]
    fn what_was_flushed_is_in_the_file_after_the_wait() {
        let (disk, mut file) = file();
        for length in [1, 5000, 30_000] {
            file.write_all(&vec![7; length]).unwrap();
            file.flush().unwrap();
            file.written().wait(LIMIT).unwrap();
            assert!(disk.lock().unwrap().cache.iter().filter(|byte| **byte == 7).count() >= length);
        }
    }

    #[test]
    fn a_disk_that_cannot_keep_the_bytes_is_told() {
        let (disk, mut file) = file();
        disk.lock().unwrap().refuses = true;
        file.write_all(b"lost").unwrap();
        assert_eq!(file.close().unwrap_err().raw_os_error(), Some(rustix::io::Errno::IO.raw_os_error()));
    }

    #[test]
    fn a_file_that_is_removed_while_it_is_written_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut file = BackgroundFile::create(&path, BackgroundOptions::TIMING).unwrap();
        std::fs::remove_file(&path).unwrap();
        file.write_all(b"for nobody").unwrap();
        wait_for("the error", || file.flush().is_err());
        assert!(file.close().unwrap_err().to_string().contains("has been removed"));
    }

    #[test]
    fn a_file_that_is_there_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        std::fs::write(&path, "another run").unwrap();
        assert!(BackgroundFile::create(&path, BackgroundOptions::RUN).is_err());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "another run");
    }
}
