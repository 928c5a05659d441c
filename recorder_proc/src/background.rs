//! A file that a thread of its own writes, so that a disk that stalls stops nobody who has something to record.
//!
//! Bytes go into preallocated, page-aligned buffers that are used again and again. The thread writes them with
//! `O_DIRECT` where the file system can: the data is not copied into the page cache, which costs a fraction of the
//! processor time (`examples/disk_cost.rs` measures it) and keeps the kernel from long copies that nothing preempts.
//! Elsewhere (tmpfs, FUSE) it writes as usual. The finished file is the same in either way.
//!
//! While it is written directly, a file may end in up to one block of zeros: the rest of the last block.

use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use memmap2::MmapMut;
use rustix::fs::OFlags;

/// Alignment of offsets, lengths and addresses that every file system's `O_DIRECT` takes.
const BLOCK: usize = 4096;

/// How much may wait for the disk, and how it is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BackgroundOptions {
    /// Buffers.
    pub buffers: usize,
    /// Bytes of each; a multiple of 4096.
    pub buffer_bytes: usize,
    /// Tries `O_DIRECT`.
    pub direct: bool,
}

impl BackgroundOptions {
    /// 32 MiB, in pieces small enough that a flush every 10 ms takes no more than its share: half a second of images
    /// of 2 MiB at 30 Hz. Only buffers that are used become resident.
    pub const RUN: BackgroundOptions =
        BackgroundOptions { buffers: 64, buffer_bytes: 512 << 10, direct: true };
    /// 2 MiB: more than half a second of the timing lane.
    pub const TIMING: BackgroundOptions =
        BackgroundOptions { buffers: 16, buffer_bytes: 128 << 10, direct: true };
}

/// A buffer and the bytes in it.
struct Buffer {
    memory: MmapMut,
    /// Offset of its first byte in the file; a multiple of [`BLOCK`].
    offset: u64,
    /// Bytes at its start that have been written with the buffer before.
    carried: usize,
    length: usize,
}

struct State {
    /// Last in, first out, so that no more memory is touched than is needed at a time.
    free: Vec<Buffer>,
    full: VecDeque<Buffer>,
    failure: Option<(io::ErrorKind, Option<i32>, String)>,
    closed: bool,
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
        self.changed.wait(state).unwrap_or_else(PoisonError::into_inner)
    }
}

/// A file being written by a thread of its own.
///
/// `write` copies; it waits only when all buffers are full. `flush` hands what is there to the thread and does not wait
/// for the disk. An error of the thread comes back from the next call and from [`close`](BackgroundFile::close).
pub struct BackgroundFile {
    shared: Arc<Shared>,
    current: Option<Buffer>,
    thread: Option<JoinHandle<()>>,
    direct: bool,
}

impl BackgroundFile {
    /// Creates the file, its buffers and its thread.
    ///
    /// # Errors
    /// The file cannot be created, or there is no memory or no thread to be had.
    pub fn create(path: &Path, options: BackgroundOptions) -> io::Result<BackgroundFile> {
        let (file, direct) = open(path, options.direct)?;
        let bytes = options.buffer_bytes.next_multiple_of(BLOCK).max(2 * BLOCK);
        let buffer = |_| -> io::Result<Buffer> {
            Ok(Buffer { memory: MmapMut::map_anon(bytes)?, offset: 0, carried: 0, length: 0 })
        };
        let mut free = (0..options.buffers.max(2)).map(buffer).collect::<io::Result<Vec<Buffer>>>()?;
        let full = VecDeque::with_capacity(free.len());
        let current = free.pop();
        let state = State { free, full, failure: None, closed: false };
        let shared = Arc::new(Shared { state: Mutex::new(state), changed: Condvar::new() });
        let of_thread = Arc::clone(&shared);
        let disk = Disk { file, direct, written: 0 };
        let thread = std::thread::Builder::new().name("log writer".to_owned());
        let thread = thread.spawn(move || disk.serve(&of_thread))?;
        Ok(BackgroundFile { shared, current, thread: Some(thread), direct })
    }

    /// Whether the file was opened for `O_DIRECT`.
    pub fn is_direct(&self) -> bool {
        self.direct
    }

    /// Writes what is left, gives the file its exact length, and waits for both.
    ///
    /// # Errors
    /// What the disk said first.
    pub fn close(mut self) -> io::Result<()> {
        let flushed = self.flush();
        self.join();
        flushed.and(check(&self.shared.lock()))
    }

    fn join(&mut self) {
        self.shared.lock().closed = true;
        self.shared.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            // It does not panic; a panic would have left its error or its data behind.
            let _ = thread.join();
        }
    }

    /// Hands the present buffer over and begins the next one with its last, incomplete block.
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
        }
        drop(state);
        self.shared.changed.notify_all();
        self.current = Some(next);
        Ok(())
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
            // Nobody is left to hear of an error; what was taken is written if it can be.
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

fn open(path: &Path, direct: bool) -> io::Result<(File, bool)> {
    let mut options = OpenOptions::new();
    options.write(true).create(true).truncate(true);
    if direct {
        let flags = OFlags::DIRECT.bits() as i32;
        match options.clone().custom_flags(flags).open(path) {
            // File systems without it say so here, or at the first write.
            Err(cause) if cause.raw_os_error() == Some(rustix::io::Errno::INVAL.raw_os_error()) => {}
            other => return other.map(|file| (file, true)),
        }
    }
    options.open(path).map(|file| (file, false))
}

/// The thread's side.
struct Disk {
    file: File,
    direct: bool,
    /// Bytes of the file that are surely there.
    written: u64,
}

impl Disk {
    fn serve(mut self, shared: &Shared) {
        let mut state = shared.lock();
        loop {
            if let Some(mut buffer) = state.full.pop_front() {
                let failed = state.failure.is_some();
                drop(state);
                // After an error nothing more is written, so that the file has no hole.
                let outcome = if failed { Ok(()) } else { self.put(&mut buffer) };
                state = shared.lock();
                state.free.push(buffer);
                if let Err(cause) = outcome {
                    state.failure = Some((cause.kind(), cause.raw_os_error(), cause.to_string()));
                }
                shared.changed.notify_all();
            } else if state.closed {
                break;
            } else {
                state = shared.wait(state);
            }
        }
        drop(state);
        // Takes off the rest of the last block, and what a failed write may have left. A device has no length.
        let _ = self.file.set_len(self.written);
    }

    fn put(&mut self, buffer: &mut Buffer) -> io::Result<()> {
        let end = buffer.offset + buffer.length as u64;
        if self.direct {
            let padded = buffer.length.next_multiple_of(BLOCK);
            buffer.memory[buffer.length..padded].fill(0);
            match self.file.write_all_at(&buffer.memory[..padded], buffer.offset) {
                Err(cause) if cause.raw_os_error() == Some(rustix::io::Errno::INVAL.raw_os_error()) => {
                    rustix::fs::fcntl_setfl(&self.file, OFlags::empty())?;
                    self.direct = false;
                }
                other => {
                    other?;
                    self.written = end;
                    return Ok(());
                }
            }
        }
        // A block that an earlier direct write has filled up with zeros is written again from its start.
        let new = if self.written > buffer.offset { buffer.carried } else { 0 };
        self.file.write_all_at(&buffer.memory[new..buffer.length], buffer.offset + new as u64)?;
        self.written = end;
        Ok(())
    }
}
