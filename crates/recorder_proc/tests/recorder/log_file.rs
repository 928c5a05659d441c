//! Logs in files: errors for a log that cannot be opened or written, and where the index of a long log is
//! kept.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::collections::BTreeMap;
use std::io::{Read, Seek, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::common::*;
use ipc_types::messages::{FrameTiming, Tick};
use recorder_proc::log_file::{LogFile, create_run, index_beside};
use run_log::*;
use zerocopy::{FromZeros, IntoBytes};

#[test]
fn errors_name_the_file_and_the_cause() {
    let folder = tempfile::tempdir().unwrap();
    let missing = folder.path().join("no/such/folder/run.mcap");
    let error = create_run(&missing, &header()).err().unwrap();
    assert!(matches!(error, LogError::Create { .. }) && error.to_string().contains("no/such/folder"));
    let error = LogReader::open(&LogFile::at(&missing)).err().unwrap();
    assert!(matches!(error, LogError::Open { .. }) && error.to_string().contains("no/such/folder"));
    let error = LogReader::open(&LogFile::at("/dev/null")).err().unwrap();
    assert!(error.to_string().contains("not a regular file"), "{error}");
}

/// `/dev/full` fails every write with ENOSPC, like a full disk.
#[test]
fn a_full_disk_is_an_error_with_the_path() {
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let path = Path::new("/somewhere/run.mcap");
    let index = index_beside(Path::new("run.mcap"));
    let result =
        RunLog::create_named(std::io::BufWriter::new(full), path, index, &header()).and_then(|mut log| {
            feed(&mut log, &run_messages(1000, None))?;
            log.finish(EndReason::Completed, &BTreeMap::new()).map(|_| ())
        });
    let error = result.unwrap_err();
    let LogError::Write { path, source } = &error else { panic!("{error}") };
    assert_eq!(
        (path.as_path(), source.kind()),
        (Path::new("/somewhere/run.mcap"), std::io::ErrorKind::StorageFull)
    );
}

/// Counts the bytes stored.
struct Watched {
    index: Box<dyn IndexStore>,
    bytes: Arc<AtomicU64>,
}

impl Write for Watched {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.bytes.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        self.index.write(bytes)
    }
    fn flush(&mut self) -> std::io::Result<()> {
        self.index.flush()
    }
}

impl Read for Watched {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        self.index.read(out)
    }
}

impl Seek for Watched {
    fn seek(&mut self, to: std::io::SeekFrom) -> std::io::Result<u64> {
        self.index.seek(to)
    }
}

/// This process's open files that lie in a folder but are unlinked.
fn nameless_files(folder: &Path) -> usize {
    let links = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
    let targets = links.filter_map(|link| std::fs::read_link(link.path()).ok());
    let is_nameless =
        |target: &Path| target.starts_with(folder) && target.to_string_lossy().ends_with("(deleted)");
    targets.filter(|target| is_nameless(target)).count()
}

/// Regression: with more indexes than fit in memory, the recorder grew by 0.7 MiB per minute.
#[test]
fn chunk_indexes_beyond_the_memory_go_to_the_disk_and_leave_no_file() {
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let path = folder.path().join("timing.mcap");
    let bytes = Arc::new(AtomicU64::new(0));
    let index = Watched { index: index_beside(&path), bytes: Arc::clone(&bytes) };
    let mut log = TimingLog::create_named(Vec::new(), &path, Box::new(index), &header()).unwrap();
    let (timing, mut chunks) = (FrameTiming::new_zeroed(), 0);
    while bytes.load(Ordering::Relaxed) < 1 << 20 {
        log.message(Topic::FrameTiming, Tick(chunks), timing.as_bytes()).unwrap();
        log.flush().unwrap();
        chunks += 1;
    }
    assert_eq!(nameless_files(folder.path()), 1);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "it has no name");
    let (_, bytes) = log.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert_eq!(summary.chunk_indexes.len() as u64, chunks);
    let messages = mcap::MessageStream::new(&bytes).unwrap();
    let times: Vec<u64> = messages.map(|message| message.unwrap().log_time / 1_000_000).collect();
    assert!(times.into_iter().eq(0..chunks));
    assert_eq!(nameless_files(folder.path()), 0);
}
