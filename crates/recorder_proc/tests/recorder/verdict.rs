//! One verdict per log: all readers agree on every changed bit, every truncation and every gap.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use fastrand::Rng;
use std::collections::BTreeMap;
use std::path::Path;

use crate::common::*;
use messages::Tick;
use recorder_proc::exit_code::exit_code;
use recorder_proc::log_file::LogFile;
use recorder_proc::rewritten::repair;
use run_log::segments::SkippedGap;
use run_log::segments::{SegmentOptions, keyframe_before, verify_segments};
use run_log::*;
use zerocopy::IntoBytes;

/// Offsets of a whole file's records, and the file's length.
fn boundaries(bytes: &[u8]) -> Vec<usize> {
    let (mut at, mut found) = (8, vec![0]);
    while at < bytes.len() - 8 {
        found.push(at);
        at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
    }
    found.push(at);
    found.push(bytes.len());
    found
}

/// The content a reader gets from a log: the header, and the messages in order.
#[derive(PartialEq, Debug)]
struct Content {
    header: LogHeader,
    messages: Vec<(String, u64, Vec<u8>)>,
}

fn content(path: &Path) -> Option<Content> {
    let mut stream = MessageStream::open(&LogFile::at(path), ReadOptions::default()).ok()?;
    let mut messages = Vec::new();
    while let Ok(Some(message)) = stream.next_message() {
        messages.push((message.topic.to_owned(), message.log_time_ns, message.body.to_vec()));
    }
    Some(Content { header: stream.header().clone(), messages })
}

/// Returns the verdicts of info, replay and repair on a log; `None` where it is rejected.
fn said(folder: &Path, bytes: &[u8]) -> [Option<Verdict>; 3] {
    let log = save(folder, "in.mcap", bytes);
    let output = folder.join("out.mcap");
    let _ = std::fs::remove_file(&output);
    let info = info(&LogFile::at(&log), ReadOptions::default()).ok().map(|info| info.verdict);
    let replayed = LogReader::open(&LogFile::at(&log)).ok().map(|mut reader| {
        while reader.next().is_some() {
            while let Ok(Some(_)) = reader.go_on() {}
        }
        reader.stream().verdict()
    });
    let repaired = repair(&log, &output).ok();
    if let Some(report) = &repaired {
        // The result is a log without damage: intact, or with a gap that it declares.
        let after = verdict(&LogFile::at(&output), ReadOptions::default()).unwrap();
        assert_eq!(after, report.after);
        assert!(after.faults.iter().all(|fault| matches!(fault, Fault::Gap(_))), "{after}");
        let lost = report.topics.values().map(|count| count.lost).sum::<u64>();
        assert!(lost == 0 || !after.is_intact(), "{lost} lost: {after}");
    }
    [info, replayed, repaired.map(|report| report.before)]
}

/// Regression: 12 of 300 flipped bits gave "the log was intact", exit code 0; one in the header made a
/// whole log unreadable.
#[test]
fn every_flipped_bit_that_changes_what_a_reader_gets_is_named_by_all() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(60, None));
    let path = save(folder.path(), "whole.mcap", &bytes);
    let whole = content(&path).unwrap();
    let [info, replayed, repaired] = said(folder.path(), &bytes);
    for verdict in [info, replayed, repaired] {
        assert!(verdict.unwrap().is_intact(), "a whole log is intact");
    }
    let mut random = Rng::with_seed(20);
    let ends = boundaries(&bytes);
    // Anywhere, and all of the first bytes of each record, which hold its type and length.
    let mut flips: Vec<usize> = (0..1500).map(|_| random.usize(..8 * bytes.len())).collect();
    for at in &ends[..ends.len() - 2] {
        flips.extend((0..8 * 9).map(|bit| 8 * at + bit));
    }
    let (mut changed_content, mut refused, mut read_all) = (0, 0, 0);
    for bit in flips {
        let mut changed = bytes.clone();
        changed[bit / 8] ^= 1 << (bit % 8);
        let all = said(folder.path(), &changed);
        let differs = content(&folder.path().join("in.mcap")).is_none_or(|found| found != whole);
        changed_content += u32::from(differs);
        read_all += u32::from(!differs);
        for (who, verdict) in ["info", "replay", "repair"].into_iter().zip(&all) {
            match verdict {
                // Every changed bit is covered by a checksum or a length.
                Some(verdict) => {
                    assert!(!verdict.is_intact() && exit_code(verdict) != 0, "{who}: bit {bit}: {verdict}");
                }
                None => {
                    refused += 1;
                    assert!(who != "repair", "bit {bit}: repair refuses a log of which one bit is wrong");
                }
            }
        }
        let [info, replayed, _] = &all;
        assert!(replayed.is_none() || info == replayed, "bit {bit}: {info:?} {replayed:?}");
    }
    println!(
        "{changed_content} flips change what is read, {read_all} do not; {refused} times a log was refused"
    );
    assert!(changed_content > 500 && read_all > 500);
}

/// Truncates at every record boundary, and one byte off it.
#[test]
fn every_cut_is_named_by_all() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(150, Some(70)));
    let ends = boundaries(&bytes);
    let cuts =
        ends.iter().flat_map(|at| [at.saturating_sub(1), *at, at + 1]).filter(|cut| *cut < bytes.len());
    let mut named = 0;
    for cut in cuts {
        let all = said(folder.path(), &bytes[..cut]);
        for verdict in all.iter().flatten() {
            let cut_is_told =
                verdict.faults.iter().any(|fault| matches!(fault, Fault::Cut { .. } | Fault::Damaged { .. }));
            assert!(cut_is_told && exit_code(verdict) != 0, "cut at {cut}: {verdict}");
            named += 1;
        }
    }
    assert!(named > 3 * 20, "{named}");
}

/// Regression: the header was a single point of failure. Any flipped bit in it, or a lost block, made a whole
/// log unreadable.
#[test]
fn a_log_whose_first_or_second_header_is_destroyed_reads_as_before() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(120, None));
    let whole = content(&save(folder.path(), "whole.mcap", &bytes)).unwrap();
    let ends = boundaries(&bytes);
    let kind =
        |kind: u8| ends.iter().filter(|at| bytes.get(**at) == Some(&kind)).copied().collect::<Vec<_>>();
    // Attachments (9) and metadata (12): scene, calibration and header, twice; the end marker.
    let (attachments, metadata) = (kind(9), kind(12));
    assert_eq!((attachments.len(), metadata.len()), (4, 3));
    let first_chunk = kind(6)[0];
    assert!(metadata[0] < first_chunk && attachments[2] > first_chunk);
    let first = (attachments[0], first_chunk);
    let second = (attachments[2], ends[ends.iter().position(|at| *at == metadata[1]).unwrap() + 1]);
    let (in_first, in_second) = ((metadata[0] + 40, metadata[0] + 41), (metadata[1] + 40, metadata[1] + 41));
    let cases = [(first, HeaderCopy::First), (in_first, HeaderCopy::First), (in_second, HeaderCopy::Second)];
    for (range, copy) in cases {
        let mut changed = bytes.clone();
        changed[range.0..range.1].iter_mut().for_each(|byte| *byte = !*byte);
        let [info, replayed, repaired] = said(folder.path(), &changed);
        for verdict in [info, replayed, repaired] {
            let verdict = verdict.unwrap();
            let named =
                |fault: &Fault| matches!(fault, Fault::HeaderDamaged { copy: found, .. } if *found == copy);
            assert!(verdict.faults.len() == 1 && verdict.faults.iter().any(named), "{copy:?}: {verdict}");
        }
        assert!(content(&folder.path().join("in.mcap")).unwrap() == whole, "{copy:?}");
        // The repaired log has both copies again.
        let repaired = folder.path().join("out.mcap");
        assert!(verdict(&LogFile::at(&repaired), ReadOptions::default()).unwrap().is_intact());
        assert!(content(&repaired).unwrap() == whole);
    }
    // A lost block that includes the second copy: only a repair reads on after it.
    let mut changed = bytes.clone();
    changed[second.0..second.1].fill(0);
    let [info, _, repaired] = said(folder.path(), &changed);
    assert!(!info.unwrap().is_intact() && !repaired.unwrap().is_intact());
    assert!(content(&folder.path().join("out.mcap")).unwrap() == whole);
}

/// A gap costs only the ticks up to the next keyframe: the full replay, partial replays and the repaired log
/// all resume there.
#[test]
fn a_replay_goes_on_behind_each_gap_at_the_next_keyframe() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    let gaps = [100..150_u64, 320..321, 470..490];
    let is_lost = |step: &Step| match step {
        Step::Latched(m) => gaps.iter().any(|gap| gap.contains(&m.tick)),
        // The states of the first gap come slightly later than its commands.
        Step::State(m) => gaps.iter().any(|gap| gap.contains(&(m.tick - u64::from(m.tick > 0)))),
        _ => false,
    };
    let mut steps = run_messages(600, None);
    steps.retain(|step| !is_lost(step));
    feed_with_keyframes(&mut log, &steps, |state| keyframe_from(100, state));
    let bytes = log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1;
    let passed = |after, tick| SkippedGap { after: Some(Tick(after)), resumed: Some(Tick(tick)) };
    let expected = [passed(100, 200), passed(320, 400), passed(470, 500)];
    let verified = |bytes: &[u8], start: Option<SavedState>| {
        let options = SegmentOptions { start, to_tick: None, threads: 2 };
        let mut reader = open_bytes(bytes).unwrap();
        let report = verify_segments(&mut reader, &|| Ok(Toy::new()), &options);
        assert!(report.replay.is_identical(), "{report:?}");
        report
    };
    let report = verified(&bytes, None);
    assert_eq!(report.gaps, expected);
    assert_eq!((report.replay.identical_ticks, report.replay.last_tick), (100 + 120 + 70 + 100, Tick(600)));
    assert_eq!(
        report.identical_keyframes, 3,
        "200, 400 and 500 begin a part; 100, 300 and 600 are made again"
    );
    // Starting after a gap, and inside one: the replay begins at the keyframe before it.
    for (from, keyframe, ticks) in
        [(450, 400, 70 + 100), (330, 300, 20 + 70 + 100), (120, 100, 120 + 70 + 100)]
    {
        let start = keyframe_before(open_bytes(&bytes).unwrap(), Tick(from));
        assert_eq!(start.as_ref().map(|saved| saved.tick), Some(Tick(keyframe)));
        assert_eq!(verified(&bytes, start).replay.identical_ticks, ticks, "from {from}");
    }
    // Once repaired, a damaged chunk is a gap, even at the start.
    let path = save(folder.path(), "in.mcap", &write_keyframes(600));
    let whole = std::fs::read(&path).unwrap();
    let chunks: Vec<usize> = boundaries(&whole).into_iter().filter(|at| whole.get(*at) == Some(&6)).collect();
    for (chunk, first_tick) in [(0, 200), (4, 0)] {
        let mut changed = whole.clone();
        changed[chunks[chunk] + 60] ^= 1;
        let all = said(folder.path(), &changed);
        assert!(all.iter().flatten().all(|verdict| !verdict.is_intact()));
        let repaired = std::fs::read(folder.path().join("out.mcap")).unwrap();
        let report = verified(&repaired, None);
        assert_eq!((report.gaps.len(), report.replay.last_tick), (1, Tick(600)), "{report:?}");
        assert_eq!(report.first_tick, Tick(first_tick), "chunk {chunk}: {report:?}");
    }
}

/// Every 100 ticks, starting at a tick.
fn keyframe_from(first: u64, state: &messages::State) -> Option<Vec<u8>> {
    (state.tick.is_multiple_of(100) && state.tick >= first).then(|| state.as_bytes().to_vec())
}

/// A log with a keyframe every 100 ticks, starting at tick 200.
fn write_keyframes(ticks: u64) -> Vec<u8> {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    feed_with_keyframes(&mut log, &run_messages(ticks, None), |state| keyframe_from(200, state));
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1
}

/// Regression: a stalled recorder's gap of 886 missing messages gave "the log was intact".
#[test]
fn a_gap_is_named_by_all_with_its_ticks_and_topics() {
    let folder = tempfile::tempdir().unwrap();
    let steps = run_messages(400, None);
    let kept = steps.iter().filter(|step| match step {
        Step::Latched(m) => !(100..150).contains(&m.tick) && !(300..302).contains(&m.tick),
        Step::State(m) => !(110..160).contains(&m.tick) && m.tick != 301,
        _ => true,
    });
    let bytes = write_log(&kept.cloned().collect::<Vec<_>>());
    let all = said(folder.path(), &bytes);
    for verdict in all.iter().flatten() {
        let [Fault::Gap(gap)] = verdict.faults.as_slice() else { panic!("{verdict}") };
        let lost = [("/latched".to_string(), 52), ("/state".to_string(), 51)];
        assert_eq!(gap.lost, BTreeMap::from(lost));
        let told: Vec<_> = gap.stretches.iter().map(|s| (s.first_tick.0, s.last_tick.0)).collect();
        assert_eq!(told, [(101, 159), (301, 302)]);
        assert_eq!(exit_code(verdict), ipc_types::process::EXIT_GAP);
        let text = verdict.to_string();
        assert!(text.contains("ticks 101 to 159: 50 of /latched, 50 of /state"), "{text}");
    }
    assert_eq!(all.iter().flatten().count(), 3);
}
