//! Repair of logs truncated or damaged anywhere: what is present is kept, what is lost is counted.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use fastrand::Rng;
use std::collections::BTreeMap;
use std::path::Path;

use crate::common::*;
use ipc_types::messages::Tick;
use recorder_proc::log_file::LogFile;
use recorder_proc::rewritten::repair;
use run_log::repair::RepairReport;
use run_log::*;
use zerocopy::IntoBytes;

/// Chunks of a whole file: start, end, and number of messages by topic.
fn chunks(bytes: &[u8]) -> Vec<(usize, usize, BTreeMap<String, u64>)> {
    let summary = mcap::Summary::read(bytes).unwrap().unwrap();
    let count = |chunk: &mcap::records::ChunkIndex| {
        let mut counts = BTreeMap::new();
        for message in summary.stream_chunk(bytes, chunk).unwrap() {
            *counts.entry(message.unwrap().channel.topic.clone()).or_default() += 1;
        }
        let (start, length) = (chunk.chunk_start_offset as usize, chunk.chunk_length as usize);
        (start, start + length, counts)
    };
    summary.chunk_indexes.iter().map(count).collect()
}

struct Repaired {
    report: RepairReport,
    bytes: Vec<u8>,
}

fn repaired(folder: &Path, bytes: &[u8]) -> Result<Repaired, LogError> {
    let input = save(folder, "in.mcap", bytes);
    let output = folder.join("out.mcap");
    let _ = std::fs::remove_file(&output);
    let report = repair(&input, &output)?;
    Ok(Repaired { report, bytes: std::fs::read(&output).unwrap() })
}

fn ticks_of(bytes: &[u8]) -> (u64, LogReader, Option<LogError>) {
    let mut reader = open_bytes(bytes).unwrap();
    let mut error = None;
    let mut ticks = 0;
    for item in reader.by_ref() {
        match item {
            Ok(_) => ticks += 1,
            Err(cause) => error = Some(cause),
        }
    }
    (ticks, reader, error)
}

/// A log truncated anywhere is complete after its repair: other readers find an index, every tick of the
/// truncated log is there, and the end marker describes what happened.
#[test]
fn a_cut_log_is_whole_after_its_repair() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(600, Some(333)));
    let all = messages(&bytes);
    let mut random = Rng::with_seed(21);
    let mut repaired_count = 0;
    for round in 0..120 {
        let cut = if round == 0 { bytes.len() - 1 } else { random.usize(..bytes.len()) };
        let Ok(mut reader) = open_bytes(&bytes[..cut]) else {
            // A log without its first state may still have a header; without a header it is not a log.
            match repaired(folder.path(), &bytes[..cut]) {
                Ok(found) => assert_eq!(found.report.complete_tick, None),
                Err(LogError::NotMcap { .. } | LogError::NoHeader { .. }) => {}
                Err(other) => panic!("cut at {cut}: {other}"),
            }
            continue;
        };
        let ticks = reader.by_ref().map(Result::unwrap).count() as u64;
        let found = repaired(folder.path(), &bytes[..cut]).unwrap();
        assert_eq!(found.report.complete_tick, Some(Tick(ticks)), "cut at {cut}");
        let kept = messages(&found.bytes);
        assert!(all.starts_with(&kept), "cut at {cut}");
        let summary = mcap::Summary::read(&found.bytes).unwrap().expect("an index");
        assert_eq!(summary.stats.unwrap().message_count, kept.len() as u64);
        let (again, reader, error) = ticks_of(&found.bytes);
        assert!(error.is_none() && again == ticks, "cut at {cut}: {error:?}");
        let marker = reader.ending().marker.clone().unwrap();
        assert!(matches!(marker.reason, EndReason::Repaired(_)), "{marker:?}");
        assert!(reader.ending().describe().starts_with("end marker: repaired"));
        assert_eq!(marker.last_tick, Some(Tick(ticks)));
        assert!(found.report.lost().is_empty() && found.report.cut.is_some());
        repaired_count += 1;
    }
    assert!(repaired_count > 80, "{repaired_count}");
}

/// A chunk with changed bytes is skipped. Its messages are counted as lost by topic, everything after it is
/// kept, and every reader reports the gap.
#[test]
fn a_damaged_chunk_in_the_middle_is_counted_by_topic() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(800, None));
    let chunks = chunks(&bytes);
    for (index, damage) in [(3, 0), (5, 1), (chunks.len() - 2, 0)] {
        let (start, end, counts) = &chunks[index];
        let mut changed = bytes.clone();
        match damage {
            // In its data, or in its length.
            0 => changed[(start + end) / 2] ^= 0x10,
            _ => changed[start + 3] ^= 0x40,
        }
        let found = repaired(folder.path(), &changed).unwrap();
        assert_eq!(&found.report.lost(), counts, "chunk {index}");
        let before = found.report.marker.as_ref().expect("the marker is still there");
        for (topic, written) in &before.counts {
            let count = found.report.topics[topic];
            assert_eq!(count.recovered + count.lost, *written, "{topic}");
        }
        assert!(matches!(&found.report.pieces[..], [piece] if piece.offset == *start as u64));

        let (ticks, reader, error) = ticks_of(&found.bytes);
        if counts.contains_key("/state") {
            assert!(matches!(error, Some(LogError::Gap { .. })), "{error:?}");
            assert_eq!(found.report.complete_tick, Some(Tick(ticks)));
        } else {
            assert!(error.is_none() && ticks == 800);
            let marker = reader.ending().marker.clone().unwrap();
            assert_eq!(marker.reason, EndReason::Repaired(Some(Box::new(EndReason::Completed))));
        }
        let path = folder.path().join("out.mcap");
        let info = info(&LogFile::at(&path), ReadOptions::default()).unwrap();
        assert!(info.log_error.is_none(), "{:?}", info.log_error);
        let mut text = Vec::new();
        info.write(&mut text).unwrap();
        let text = String::from_utf8(text).unwrap();
        for (topic, count) in counts {
            assert_eq!(info.lost(topic), *count);
            let line = text.lines().find(|line| line.trim_start().starts_with(&format!("{topic} "))).unwrap();
            assert!(line.ends_with(&format!("{count} MISSING")), "{text}");
            let messages = if *count == 1 { "message" } else { "messages" };
            assert!(text.contains(&format!("{count} {messages} of {topic} to damage")), "{text}");
        }
        // Repairing a repaired log changes nothing.
        let again = repaired(folder.path(), &found.bytes).unwrap();
        assert!(again.report.pieces.is_empty() && again.report.lost() == *counts, "{:?}", again.report);
        assert!(again.report.before == again.report.after && !again.report.was_whole(), "{:?}", again.report);
        assert!(messages(&again.bytes) == messages(&found.bytes));
    }
}

/// Damage in the chunk that declares every topic loses only that chunk. The declarations are taken from the
/// summary, wherever it now is, or, in a log that is also truncated, from the fixed order in which every run
/// lane declares its topics.
#[test]
fn damage_in_the_chunk_that_declares_the_topics_takes_no_other_chunk() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(600, None));
    let all = messages(&bytes);
    let chunks = chunks(&bytes);
    let (start, end, first) = &chunks[0];
    assert_eq!(first["/state"], 1, "the chunk of the initial state");
    let mut flipped = bytes.clone();
    flipped[(start + end) / 2] ^= 1;
    let mut moved = flipped.clone();
    let between = chunks[3].1;
    moved.splice(between..between, [0_u8; 37]);
    let cut = &flipped[..flipped.len() - 40];
    for (what, changed) in [("summary", &flipped[..]), ("moved", &moved[..]), ("cut", cut)] {
        let found = repaired(folder.path(), changed).unwrap();
        let kept = messages(&found.bytes);
        let lost = first.values().sum::<u64>() as usize;
        assert_eq!(kept.len(), all.len() - lost, "{what}");
        assert!(all.ends_with(&kept), "{what}");
        assert_eq!(found.report.topics["/state"], repair::TopicRepair { recovered: 600, lost: 1 }, "{what}");
        assert_eq!((found.report.undeclared, found.report.last_tick), (0, Some(Tick(600))), "{what}");
        // The schemas are present too, and the log can be read up to its gap.
        let summary = mcap::Summary::read(&found.bytes).unwrap().unwrap();
        let original = mcap::Summary::read(&bytes).unwrap().unwrap();
        for channel in summary.channels.values() {
            let of_topic = |other: &&std::sync::Arc<mcap::Channel<'_>>| other.topic == channel.topic;
            let before = original.channels.values().find(of_topic).unwrap();
            let schema = |channel: &mcap::Channel<'_>| {
                channel.schema.as_ref().map(|schema| (schema.name.clone(), schema.data.to_vec()))
            };
            assert!(schema(channel).is_some() && schema(channel) == schema(before), "{what}");
            assert_eq!(channel.metadata, before.metadata, "{what}");
        }
        let path = folder.path().join("out.mcap");
        let mut stream = MessageStream::open(&LogFile::at(&path), ReadOptions::default()).unwrap();
        let mut count = 0;
        while stream.next_message().unwrap().is_some() {
            count += 1;
        }
        assert_eq!(count, kept.len(), "{what}");
    }

    // In the timing lane, a topic is declared with its first message.
    let bytes = write_timing(&[("/command/a", 500), ("/command/b", 900), ("/command/a", 1300)]);
    let all = messages(&bytes);
    let mut flipped = bytes.clone();
    let (start, end, _) = self::chunks(&bytes)[0];
    flipped[(start + end) / 2] ^= 1;
    let found = repaired(folder.path(), &flipped).unwrap();
    assert!(messages(&found.bytes) == all[1..] && found.report.lost()["/command/a"] == 1);
    // Without the summary nothing identifies the topic of the remaining messages, and the repair reports
    // that.
    let data_end = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes[2].clone();
    let cut = (data_end.chunk_start_offset + data_end.chunk_length) as usize;
    let found = repaired(folder.path(), &flipped[..cut]).unwrap();
    assert_eq!(found.report.undeclared, 1, "{:?}", found.report);
    let mut text = Vec::new();
    found.report.write(&mut text).unwrap();
    assert!(String::from_utf8(text).unwrap().contains("1 message of undeclared topics"));
}

/// A timing lane with one chunk per message.
fn write_timing(messages: &[(&str, u64)]) -> Vec<u8> {
    let mut log = TimingLog::create(Vec::new(), &header()).unwrap();
    for (topic, tick) in messages {
        let command = ipc_types::messages::Command { state_tick: *tick, ..zerocopy::FromZeros::new_zeroed() };
        let timing: ipc_types::messages::FrameTiming = zerocopy::FromZeros::new_zeroed();
        match Topic::of_name(topic) {
            Some(topic) => log.message(topic, Tick(*tick), timing.as_bytes()).unwrap(),
            None => log.command(topic, Tick(*tick), command.as_bytes()).unwrap(),
        }
    }
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1
}

/// MCAP writes a schema only once, possibly in a chunk that the reader skips.
#[test]
fn a_topic_whose_schema_lies_in_a_chunk_that_is_passed_over_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_timing(&[
        ("/timing/frame", 100),
        ("/command/a", 500),
        ("/command/b", 900),
        ("/timing/frame", 1300),
    ]);
    assert_eq!(chunks(&bytes).len(), 4);
    let path = save(folder.path(), "timing.mcap", &bytes);
    for (topic, count) in [("/command/a", 1), ("/command/b", 1), ("/timing/frame", 2), ("/command/c", 0)] {
        let mut stream =
            MessageStream::open_topics(&LogFile::at(&path), &[topic.to_owned()], ReadOptions::default())
                .unwrap();
        for _ in 0..count {
            assert_eq!(stream.next_message().unwrap().unwrap().topic, topic);
        }
        assert!(stream.next_message().unwrap().is_none() && stream.ending().is_complete(), "{topic}");
    }
}

/// Without the repair record at its start, a jump in the numbers is damage.
#[test]
fn a_gap_that_no_repair_has_told_is_damage() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(500, None));
    let (start, end, _) = chunks(&bytes)[2].clone();
    // The chunk is cut out cleanly: every length and every chunk's checksum is correct.
    let spliced = [&bytes[..start], &bytes[end..]].concat();
    let (_, _, error) = ticks_of(&spliced);
    assert!(matches!(error, Some(LogError::Damaged { .. })), "{error:?}");
    let found = repaired(folder.path(), &spliced).unwrap();
    assert!(found.report.pieces.is_empty() && !found.report.lost().is_empty());
    let (_, _, error) = ticks_of(&found.bytes);
    assert!(matches!(error, Some(LogError::Gap { .. })), "{error:?}");
}

/// Whatever bytes are changed, moved or removed: the repair terminates, everything it keeps was in the log,
/// and its counts add up.
#[test]
fn any_damage_is_repaired_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(150, None));
    let all = messages(&bytes);
    let chunks = chunks(&bytes);
    let mut random = Rng::with_seed(77);
    let (mut refused, mut kept_all) = (0, 0);
    for _ in 0..400 {
        let mut changed = bytes.clone();
        for _ in 0..1 + random.usize(..4) {
            let at = random.usize(..changed.len());
            match random.usize(..4) {
                0 => changed[at] ^= 1 << random.usize(..8),
                1 => {
                    let end = (at + random.usize(..60)).min(changed.len());
                    changed.drain(at..end);
                }
                2 => {
                    let noise: Vec<u8> = (0..random.usize(..60)).map(|_| random.u8(..)).collect();
                    changed.splice(at..at, noise);
                }
                _ => changed.truncate(changed.len() - random.usize(..60)),
            }
        }
        let found = match repaired(folder.path(), &changed) {
            Ok(found) => found,
            Err(LogError::NotMcap { .. } | LogError::NoHeader { .. }) => {
                assert!(!folder.path().join("out.mcap").exists(), "a refused repair leaves nothing");
                refused += 1;
                continue;
            }
            Err(other) => panic!("{other}"),
        };
        let kept = messages(&found.bytes);
        let mut rest = all.iter();
        assert!(kept.iter().all(|message| rest.any(|original| original == message)));
        // Untouched chunks are kept, whatever else is lost.
        let there = |(start, end, _): &&(usize, usize, _)| {
            changed.windows(end - start).any(|window| window == &bytes[*start..*end])
        };
        let untouched: u64 = chunks.iter().filter(there).flat_map(|(_, _, counts)| counts.values()).sum();
        let told = found.report.undeclared;
        assert!(kept.len() as u64 + told >= untouched, "{} of {untouched} kept", kept.len());
        if found.report.marker.is_some() {
            let lost: u64 = found.report.lost().values().sum();
            assert_eq!(kept.len() as u64 + lost, all.len() as u64);
        }
        kept_all += u32::from(kept.len() == all.len());
    }
    println!("400 damaged logs: {refused} without a header refused, {kept_all} kept every message");
    assert!(refused < 150 && kept_all > 20);
}

/// Reading one topic skips the other chunks and gives the same messages; a gap in that topic is still damage.
#[test]
fn one_topic_is_read_without_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = write_log(&run_messages(900, None));
    let path = save(folder.path(), "run.mcap", &bytes);
    let all = messages(&bytes);
    for topic in ["/state", "/drr/image", "/drr/frame", "/removed", "/no/such/topic"] {
        let wanted = [topic.to_owned()];
        let mut stream =
            MessageStream::open_topics(&LogFile::at(&path), &wanted, ReadOptions::default()).unwrap();
        let mut found = Vec::new();
        while let Some(message) = stream.next_message().unwrap() {
            found.push((message.topic.to_owned(), message.sequence, [&[0, 1, 0, 0], message.body].concat()));
        }
        assert!(found.iter().eq(all.iter().filter(|(name, _, _)| name == topic)), "{topic}");
        assert!(stream.ending().is_complete(), "{topic}");
    }
    let (start, end, counts) = chunks(&bytes).into_iter().find(|c| c.2.contains_key("/drr/image")).unwrap();
    assert_eq!(counts.len(), 1);
    let mut flipped = bytes.clone();
    flipped[(start + end) / 2] ^= 1;
    let path = save(folder.path(), "flipped.mcap", &flipped);
    let read = |topic: &str| {
        let mut stream =
            MessageStream::open_topics(&LogFile::at(&path), &[topic.to_owned()], ReadOptions::default())
                .unwrap();
        loop {
            match stream.next_message() {
                Ok(Some(_)) => {}
                Ok(None) => break true,
                Err(_) => break false,
            }
        }
    };
    assert!(read("/state"), "the damage lies in a chunk that is not read");
    assert!(!read("/drr/image"));
}
