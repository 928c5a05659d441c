//! The writer thread: writes the file and syncs it to disk.

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind};
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::Path;
use std::time::Instant;

use rustix::fs::OFlags;

use super::{BLOCK, BackgroundOptions, Buffer, SYNC_PERIOD, Shared};

/// Opens the file; also returns whether it uses direct writes.
pub(super) fn open(path: &Path, wanted: BackgroundOptions) -> io::Result<(File, bool)> {
    let mut options = OpenOptions::new();
    options.write(true);
    if wanted.fresh {
        options.create_new(true)
    } else {
        options.create(true).truncate(true)
    };
    if wanted.direct {
        let flags = OFlags::DIRECT.bits() as i32;
        match options.clone().custom_flags(flags).open(path) {
            // File systems without `O_DIRECT` fail here or at the first write. Some have created the file by
            // then; it is ours.
            Err(cause) if is_invalid(&cause) => {
                options.create_new(false).create(true).truncate(true);
            }
            other => return other.map(|file| (file, true)),
        }
    }
    options.open(path).map(|file| (file, false))
}

fn is_invalid(cause: &io::Error) -> bool {
    cause.raw_os_error() == Some(rustix::io::Errno::INVAL.raw_os_error())
}

/// The destination of the writes.
pub(super) trait Medium: Send {
    fn write_all_at(&self, bytes: &[u8], offset: u64) -> io::Result<()>;
    /// Switches from direct writes to the page cache.
    fn write_through_cache(&self) -> io::Result<()>;
    fn set_length(&self, length: u64) -> io::Result<()>;
    /// Syncs written data to the disk.
    fn sync(&self) -> io::Result<()>;
}

impl Medium for File {
    fn write_all_at(&self, bytes: &[u8], offset: u64) -> io::Result<()> {
        FileExt::write_all_at(self, bytes, offset)
    }

    fn write_through_cache(&self) -> io::Result<()> {
        Ok(rustix::fs::fcntl_setfl(self, OFlags::empty())?)
    }

    fn set_length(&self, length: u64) -> io::Result<()> {
        match self.set_len(length) {
            // A device has no length.
            Err(cause) if is_invalid(&cause) => Ok(()),
            outcome => outcome,
        }
    }

    fn sync(&self) -> io::Result<()> {
        // Otherwise a removed file would go unnoticed until the end of the run.
        if rustix::fs::fstat(self)?.st_nlink == 0 {
            return Err(io::Error::new(ErrorKind::NotFound, "the file has been removed"));
        }
        match self.sync_data() {
            // Some devices cannot be synced, and need not be.
            Err(cause) if is_invalid(&cause) => Ok(()),
            outcome => outcome,
        }
    }
}

/// State of the writer thread.
pub(super) struct Disk {
    pub medium: Box<dyn Medium>,
    pub direct: bool,
    /// Bytes of the file written so far.
    pub written: u64,
    /// Time since when there has been data that a power failure would lose.
    pub unsynced: Option<Instant>,
}

impl Disk {
    pub fn serve(mut self, shared: &Shared) {
        let mut state = shared.lock();
        loop {
            let failed = state.failure.is_some();
            let sync_in = self.unsynced.map(|since| SYNC_PERIOD.saturating_sub(since.elapsed()));
            if sync_in.is_some_and(|left| left.is_zero()) && !failed {
                drop(state);
                let outcome = self.sync();
                state = shared.lock();
                state.fail(outcome);
            } else if let Some(mut buffer) = state.full.pop_front() {
                drop(state);
                // After an error write nothing more, so that the file has no hole.
                let outcome = if failed { Ok(()) } else { self.put(&mut buffer) };
                state = shared.lock();
                state.free.push(buffer);
                state.unwritten -= 1;
                state.fail(outcome);
                shared.changed.notify_all();
            } else if state.closed {
                break;
            } else {
                state = shared.wait_for(state, sync_in.filter(|_| !failed));
            }
        }
        drop(state);
        // Truncates the padding of the last block and any remains of a failed write.
        let outcome = self.medium.set_length(self.written).and_then(|()| self.sync());
        shared.lock().fail(outcome);
    }

    fn sync(&mut self) -> io::Result<()> {
        self.unsynced = None;
        self.medium.sync()
    }

    fn put(&mut self, buffer: &mut Buffer) -> io::Result<()> {
        self.unsynced.get_or_insert_with(Instant::now);
        let end = buffer.offset + buffer.length as u64;
        if self.direct {
            let padded = buffer.length.next_multiple_of(BLOCK);
            buffer.memory[buffer.length..padded].fill(0);
            match self.medium.write_all_at(&buffer.memory[..padded], buffer.offset) {
                Err(cause) if is_invalid(&cause) => {
                    self.medium.write_through_cache()?;
                    self.direct = false;
                }
                other => {
                    other?;
                    self.written = end;
                    return Ok(());
                }
            }
        }
        // Rewrite a block from its start if an earlier direct write padded it with zeros.
        let new = if self.written > buffer.offset { buffer.carried } else { 0 };
        self.medium.write_all_at(&buffer.memory[new..buffer.length], buffer.offset + new as u64)?;
        self.written = end;
        Ok(())
    }
}
