//! The files of a flight recorder, in a folder into which other programs write too.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs)]

use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use recorder_proc::ring_files::{Disposal, LANES, LogFiles, RingFiles};

const LIMIT: Duration = Duration::from_secs(60);

fn saved(output: &Path, name: &str) -> Vec<u8> {
    LANES.iter().flat_map(|lane| std::fs::read(output.join(name).join(lane)).unwrap()).collect()
}

/// Waits for the files asked for.
fn created(ring: &RingFiles) -> LogFiles {
    let end = Instant::now() + LIMIT;
    loop {
        if let Some(files) = ring.asked().unwrap() {
            return files;
        }
        assert!(Instant::now() < end, "no files within {LIMIT:?}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Regression: a foreign `saved-1` or `ring-1` ended the run.
#[test]
fn a_log_whose_name_is_taken_gets_a_number_that_no_other_log_gets() {
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let output = folder.path();
    std::fs::create_dir(output.join("saved-1")).unwrap();
    for name in ["saved-4", "ring-2", "saved-1/notes.txt"] {
        std::fs::write(output.join(name), "a user's own").unwrap();
    }
    let ring = RingFiles::start(output, 3).unwrap();
    for number in 1..=3 {
        ring.ask(number);
        let mut files = created(&ring);
        for file in [&mut files.run, &mut files.timing] {
            file.write_all(&[number as u8]).unwrap();
        }
        ring.dispose(files, Disposal::Save(number));
    }
    ring.finish().unwrap();
    // 1 is taken, and so is 4, the first number that is not announced.
    assert_eq!(
        [saved(output, "saved-2"), saved(output, "saved-3"), saved(output, "saved-5")].concat(),
        [2, 2, 3, 3, 1, 1]
    );
    let mut left: Vec<_> = output.read_dir().unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["ring-2", "saved-1", "saved-2", "saved-3", "saved-4", "saved-5"]);
    for name in ["saved-4", "ring-2", "saved-1/notes.txt"] {
        assert_eq!(std::fs::read_to_string(output.join(name)).unwrap(), "a user's own");
    }
}
