//! Logs recompressed, joined and split: the same messages in the same order.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use crate::common::*;
use recorder_proc::log_file::LogFile;
use recorder_proc::rewritten::{Sizes, cat_files, compress, split};
use run_log::diff::diff;
use run_log::*;

#[test]
fn a_packed_log_holds_the_same_run() {
    let folder = tempfile::tempdir().unwrap();
    let input = save(folder.path(), "in.mcap", &write_log(&run_messages(700, Some(200))));
    let mut sizes = Vec::new();
    for packing in [Packing::None, Packing::Lz4(0), Packing::Lz4(9), Packing::Zstd(1), Packing::Zstd(19)] {
        let output = folder.path().join(format!("{packing:?}.mcap"));
        let Sizes { before, after } = compress(&input, &output, packing).unwrap();
        assert_eq!(after, std::fs::metadata(&output).unwrap().len());
        sizes.push((packing, before, after));
        let report = diff(&LogFile::at(&input), &LogFile::at(&output), ReadOptions::default()).unwrap();
        assert!(report.same_run() && report.header.is_empty() && report.identical_ticks == 700);
        let mut reader = LogReader::open(&LogFile::at(&output)).unwrap();
        let replayed = verify(&mut reader, Toy::new, None);
        assert!(replayed.is_identical() && replayed.last_tick.0 == 700);
        assert_eq!(replayed.ending.describe(), "end marker: completed");
        let bytes = std::fs::read(&output).unwrap();
        assert!(messages(&bytes) == messages(&std::fs::read(&input).unwrap()));
        assert!(matches!(compress(&input, &output, packing), Err(LogError::Exists { .. })));
    }
    println!("{sizes:?}");
    assert!(sizes[4].2 < sizes[0].2);
    // With the recorder's compression the result equals the recorder's file, so nothing else has changed.
    assert!(std::fs::read(folder.path().join("Lz4(0).mcap")).unwrap() == std::fs::read(&input).unwrap());
}

#[test]
fn a_log_that_is_not_whole_is_not_packed_or_joined() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(200, None));
    let cut = save(folder.path(), "cut.mcap", &bytes[..bytes.len() - 30]);
    let whole = save(folder.path(), "whole.mcap", &bytes);
    let mut flipped = bytes.clone();
    flipped[bytes.len() / 2] ^= 1;
    let flipped = save(folder.path(), "flipped.mcap", &flipped);
    let output = folder.path().join("out.mcap");
    for input in [&cut, &flipped] {
        let error = compress(input, &output, Packing::None).unwrap_err();
        assert!(
            matches!(error, LogError::NotWhole { .. }) && error.to_string().contains("repair"),
            "{error}"
        );
        let error = cat_files(&[whole.clone(), input.clone()], &output).unwrap_err();
        assert!(matches!(error, LogError::NotWhole { .. }), "{error}");
        assert!(!output.exists(), "a failed command leaves nothing");
    }
}

#[test]
fn joined_logs_split_into_what_they_were() {
    let folder = tempfile::tempdir().unwrap();
    let runs = [write_log(&run_messages(300, None)), write_log(&run_messages(450, Some(100)))];
    let inputs = [save(folder.path(), "a.mcap", &runs[0]), save(folder.path(), "b.mcap", &runs[1])];
    let joined = folder.path().join("joined.mcap");
    cat_files(&inputs, &joined).unwrap();

    // Another reader sees both runs.
    let bytes = std::fs::read(&joined).unwrap();
    let states = |prefix: &str| {
        messages(&bytes).iter().filter(|(topic, _, _)| *topic == format!("{prefix}/state")).count()
    };
    assert_eq!((states("/run1"), states("/run2")), (301, 451));
    // Our reader does not mistake it for one run.
    let error = LogReader::open(&LogFile::at(&joined)).err().unwrap();
    assert!(
        matches!(error, LogError::SeveralRuns { .. }) && error.to_string().contains("log split"),
        "{error}"
    );
    let error = cat_files(&[joined.clone(), inputs[0].clone()], &folder.path().join("c.mcap")).unwrap_err();
    assert!(matches!(error, LogError::SeveralRuns { .. }), "{error}");

    let out = folder.path().join("runs");
    let paths = split(&joined, &out).unwrap();
    assert_eq!(paths, [out.join("run1.mcap"), out.join("run2.mcap")]);
    for (path, original) in paths.iter().zip(&runs) {
        assert!(std::fs::read(path).unwrap() == *original, "{}", path.display());
    }
    assert!(matches!(split(&inputs[0], &out), Err(LogError::OneRun { .. })));
    // If one run cannot be written, none is, and existing files stay as they were.
    std::fs::remove_file(&paths[0]).unwrap();
    assert!(matches!(split(&joined, &out), Err(LogError::Exists { path }) if path == paths[1]));
    assert!(!paths[0].exists() && std::fs::read(&paths[1]).unwrap() == runs[1]);
}
