//! The writer thread: the same bytes with either kind of write, errors that reach the caller, a file with the
//! correct end.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use fastrand::Rng;
use std::collections::BTreeMap;
use std::io::{ErrorKind, Write};
use std::path::Path;

use crate::common::*;
use recorder_proc::background::{BackgroundFile, BackgroundOptions};
use recorder_proc::log_file::index_beside;
use run_log::*;

const SMALL: BackgroundOptions =
    BackgroundOptions { buffers: 2, buffer_bytes: 8192, direct: true, fresh: false };

fn folders() -> Vec<tempfile::TempDir> {
    // tmpfs (without O_DIRECT, or only pretending to have it) and the file system of the target folder
    // (usually on a disk).
    let shm = Path::new("/dev/shm");
    let mut folders = vec![tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap()];
    folders.extend(shm.is_dir().then(|| tempfile::tempdir_in(shm).unwrap()));
    folders
}

/// Random pieces and flushes: the file holds exactly the bytes, with or without direct writes. After a flush
/// it holds what was written, followed by less than a block of zeros.
#[test]
fn any_pieces_and_flushes_leave_the_same_bytes() {
    for folder in folders() {
        for (round, direct) in (0..6).flat_map(|round| [(round, true), (round, false)]) {
            let path = folder.path().join("file");
            let mut random = Rng::with_seed(round);
            let options = BackgroundOptions { direct, ..SMALL };
            let mut file = BackgroundFile::create(&path, options).unwrap();
            let mut wanted = Vec::new();
            for _ in 0..200 {
                let most = [3, 700, 9000, 30_000][random.usize(..4)];
                let piece: Vec<u8> = (0..random.usize(..most)).map(|_| random.u8(..) | 1).collect();
                file.write_all(&piece).unwrap();
                wanted.extend_from_slice(&piece);
                if random.usize(..3) == 0 {
                    file.flush().unwrap();
                }
            }
            file.flush().unwrap();
            file.written().wait(std::time::Duration::from_secs(60)).unwrap();
            let open = std::fs::read(&path).unwrap();
            assert!(open[wanted.len()..].iter().all(|byte| *byte == 0) && open.len() < wanted.len() + 4096);
            file.close().unwrap();
            assert!(std::fs::read(&path).unwrap() == wanted, "round {round}, direct {direct}");
        }
    }
}

#[test]
fn a_log_written_by_the_thread_is_the_log_written_at_once() {
    let steps = run_messages(1500, Some(700));
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let path = folder.path().join("run.mcap");
    let file = BackgroundFile::create(&path, SMALL).unwrap();
    let mut log = RunLog::create_named(file, &path, index_beside(&path), &header()).unwrap();
    feed(&mut log, &steps).unwrap();
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1.close().unwrap();
    assert!(std::fs::read(&path).unwrap() == write_log(&steps));
}

/// A recorder killed between two writes leaves zeros up to the end of a block. They mean a truncated log, not
/// damage; anything else after them, or more zeros, is damage.
#[test]
fn a_log_that_ends_in_a_block_of_zeros_is_cut() {
    let bytes = write_log(&run_messages(300, None));
    let whole = open_bytes(&bytes).unwrap().map(Result::unwrap).count();
    for (zeros, readable) in [(1, true), (9, true), (4000, true), (9000, false)] {
        // After the last complete chunk: the index and everything after it is not there yet.
        let cut = bytes.len() / 2;
        let mut reader = open_bytes(&bytes[..cut]).unwrap();
        let ticks = reader.by_ref().map(Result::unwrap).count();
        let end = reader.ending().cut.unwrap().offset as usize;
        let padded = [&bytes[..end], &vec![0; zeros]].concat();
        let mut reader = open_bytes(&padded).unwrap();
        let items: Vec<_> = reader.by_ref().collect();
        assert_eq!(items.iter().filter(|item| item.is_ok()).count(), ticks);
        assert_eq!(items.iter().all(Result::is_ok), readable, "{zeros} zeros");
        if readable {
            let found = reader.ending().cut.unwrap();
            assert_eq!((found.offset as usize, found.incomplete_bytes as usize), (end, zeros));
            let spoiled = [&padded[..], &[1]].concat();
            assert!(zeros < 9 || open_bytes(&spoiled).unwrap().any(|item| item.is_err()));
        }
        assert!(ticks < whole);
    }
}

#[test]
fn a_full_disk_is_an_error_with_the_systems_reason() {
    let path = Path::new("/dev/full");
    let mut log = RunLog::create_named(
        BackgroundFile::create(path, SMALL).unwrap(),
        path,
        index_beside(path),
        &header(),
    )
    .unwrap();
    let steps = run_messages(2000, None);
    let error = feed(&mut log, &steps).expect_err("the writer hears of it");
    assert!(matches!(&error, LogError::Write { source, .. } if source.kind() == ErrorKind::StorageFull));
    assert!(
        error.to_string().contains("/dev/full: cannot write the log: No space left on device"),
        "{error}"
    );
    assert!(log.finish(EndReason::Completed, &BTreeMap::new()).is_err());
}

#[test]
fn an_error_at_the_very_end_comes_back_from_close() {
    let mut file = BackgroundFile::create(Path::new("/dev/full"), SMALL).unwrap();
    file.write_all(b"few bytes").unwrap();
    assert_eq!(file.close().unwrap_err().kind(), ErrorKind::StorageFull);
}
