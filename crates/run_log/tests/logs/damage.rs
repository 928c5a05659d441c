//! Logs that are truncated, have flipped bits, or lack a message.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use fastrand::Rng;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use crate::common::*;
use messages::Tick;
use run_log::*;

/// Chunk ends of a whole file with the last state tick in each: found by walking the record lengths here and
/// by reading each prefix with the mcap crate's own reader.
fn chunk_ends(bytes: &[u8]) -> Vec<(usize, u64)> {
    let (mut at, mut ends) = (8, Vec::new());
    while at < bytes.len() - 8 {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        at += 9 + length;
        if bytes[at - 9 - length] == 6 {
            let options = enumset::EnumSet::only(mcap::read::Options::IgnoreEndMagic);
            let messages = mcap::MessageStream::new_with_options(&bytes[..at], options).unwrap();
            let states = messages.map(Result::unwrap).filter(|m| m.channel.topic == "/state").count();
            ends.push((at, states as u64));
        }
    }
    ends
}

#[test]
fn a_log_cut_anywhere_reads_up_to_the_last_complete_tick() {
    let bytes = write_log(&run_messages(1000, None));
    let ends = chunk_ends(&bytes);
    let mut random = Rng::with_seed(1);
    let mut cuts: Vec<usize> = (0..300).map(|_| random.usize(..bytes.len())).collect();
    cuts.extend(ends.iter().flat_map(|(end, _)| [end - 1, *end, end + 1]));
    cuts.extend(bytes.len() - 60..bytes.len());
    let (mut readable, mut complete) = (0, 0);
    for cut in cuts {
        let states = ends.iter().filter(|(end, _)| *end <= cut).map(|(_, states)| *states).max().unwrap_or(0);
        let mut reader = match open_bytes(&bytes[..cut]) {
            Ok(reader) => reader,
            Err(LogError::NotMcap { .. } | LogError::NoHeader { .. } | LogError::NoInitialState { .. }) => {
                assert_eq!(states, 0, "cut at {cut}");
                continue;
            }
            Err(other) => panic!("cut at {cut}: {other}"),
        };
        let ticks = reader.by_ref().map(Result::unwrap).count() as u64;
        assert_eq!(ticks + 1, states, "cut at {cut}");
        assert_eq!(reader.last_complete_tick(), Tick(ticks));
        let found = reader.ending().cut.expect("a cut file says so");
        assert_eq!(found.offset + found.incomplete_bytes, cut as u64);
        readable += 1;
        complete += u64::from(reader.ending().marker.is_some());
    }
    println!("{readable} cut logs readable, {complete} of them with all ticks and the end marker");
    assert!(readable > 300 && complete > 0);
}

#[derive(Clone, Default)]
struct Shared(Arc<Mutex<Vec<u8>>>);

impl std::io::Write for Shared {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().extend_from_slice(bytes);
        Ok(bytes.len())
    }
    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// `kill -9` leaves everything that has been flushed so far.
#[test]
fn a_killed_writer_loses_at_most_100_ms() {
    let file = Shared::default();
    let mut log = RunLog::create(file.clone(), &header()).unwrap();
    let mut worst = 0;
    let mut made = 0;
    for step in run_messages(1000, None) {
        made += u64::from(matches!(step, Step::State(_)));
        feed(&mut log, &[step]).unwrap();
        if made % 13 == 0 {
            // A log that cannot be opened loses everything.
            let read =
                open_bytes(&file.0.lock().unwrap()).map_or(0, |reader| reader.map(Result::unwrap).count());
            worst = worst.max(made.saturating_sub(1 + read as u64));
        }
    }
    println!("worst loss: {worst} ticks of 1 ms");
    assert!(worst <= 100);
}

fn without(steps: &[Step], drop: impl Fn(&Step) -> bool) -> (LogError, u64, EndMarker) {
    let kept: Vec<Step> = steps.iter().filter(|step| !drop(step)).cloned().collect();
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    feed(&mut log, &kept).unwrap();
    let (marker, bytes) = log.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    let mut reader = open_bytes(&bytes).unwrap();
    let error = reader.by_ref().find_map(Result::err).expect("a gap is never silent");
    assert!(reader.next().is_none());
    println!("{error}");
    (error, reader.last_complete_tick().0, marker)
}

#[test]
fn a_missing_message_is_named_and_counted() {
    let steps = run_messages(300, None);
    let (error, last, marker) = without(&steps, |s| matches!(s, Step::Latched(m) if m.tick == 120));
    assert!(matches!(error, LogError::Gap { topic: Topic::Latched, tick: Tick(120), .. }));
    assert_eq!((last, marker.lost), (120, BTreeMap::from([("/latched".to_string(), 1)])));

    let (error, last, marker) =
        without(&steps, |s| matches!(s, Step::State(m) if (50..53).contains(&m.tick)));
    assert!(matches!(error, LogError::Gap { topic: Topic::State, tick: Tick(50), .. }));
    assert_eq!((last, marker.lost), (49, BTreeMap::from([("/state".to_string(), 3)])));

    // Removals happen at ticks 3, 10, 17, …, after the two messages of tick 0.
    let steps_17 = removed_bytes(17, 5, 19, &[1700, 1701, 1702, 1703, 1704]);
    let (error, last, marker) = without(&steps, |s| matches!(s, Step::Removed(m) if *m == steps_17));
    assert!(matches!(error, LogError::Gap { topic: Topic::Removed, tick: Tick(17), .. }));
    assert_eq!((last, marker.lost), (16, BTreeMap::from([("/removed".to_string(), 1)])));

    let both = |s: &Step| match s {
        Step::Latched(m) => m.tick == 200,
        Step::State(m) => m.tick == 201,
        _ => false,
    };
    let (error, last, marker) = without(&steps, both);
    assert!(matches!(error, LogError::Gap { topic: Topic::Latched, tick: Tick(200), .. }));
    let lost = BTreeMap::from([("/latched".to_string(), 1), ("/state".to_string(), 1)]);
    assert_eq!((last, marker.lost), (200, lost));

    let initial: Vec<Step> = steps[3..].to_vec();
    let error = open_bytes(&write_log(&initial)).err().unwrap();
    assert!(matches!(error, LogError::Gap { topic: Topic::State, tick: Tick(0), .. }), "{error}");
}

/// An untrusted log may compress endless removals into few bytes and never write a state.
#[test]
fn removals_that_no_volume_can_hold_are_refused() {
    let log = |dimensions: [u32; 3], messages: u64, voxels: usize| {
        let header = LogHeader { volume_dimensions: dimensions, ..header() };
        let mut log = TimingLog::create(Vec::new(), &header).unwrap();
        let indices: Vec<u32> = vec![7; voxels];
        for sequence in 1..=messages {
            let bytes = removed_bytes(0, sequence, sequence * voxels as u64, &indices);
            log.message(Topic::Removed, Tick::START, &bytes).unwrap();
        }
        log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1
    };
    let refused = |bytes: &[u8], word: &str| {
        let error = open_bytes(bytes).err().unwrap();
        assert!(matches!(error, LogError::Damaged { .. }) && error.to_string().contains(word), "{error}");
    };
    // More than a tick can publish, more than the volume has, and messages without voxels.
    refused(&log([512, 400, 3], 1, 4097), "/removed of 16420 bytes, at most 16416");
    let endless = log([100, 10, 3], 5000, 600);
    refused(&endless, "removals of 3600 voxels in a tick, the volume has 3000");
    refused(&log([4, 4, 4], 1000, 0), "removals of 66 voxels in a tick, the volume has 64");
    // As many as the volume has are accepted.
    let error = open_bytes(&log([100, 10, 3], 5, 600)).err().unwrap();
    assert!(matches!(error, LogError::NoStates { .. }), "{error}");
}

#[test]
fn a_missing_frame_is_named_and_counted() {
    let mut count = 0;
    let steps: Vec<Step> = run_messages(300, None)
        .into_iter()
        .filter(|s| {
            count += u32::from(matches!(s, Step::Frame(_)));
            !(matches!(s, Step::Frame(_)) && count == 3)
        })
        .collect();
    let path = named("run.mcap", &write_log(&steps));
    let items: Vec<_> = frames(&path, ReadOptions::default()).unwrap().collect();
    assert_eq!(items.len(), 3);
    assert!(matches!(items[2], Err(LogError::Gap { topic: Topic::DrrFrame, tick: Tick(141), .. })));
    let info = info(&path, ReadOptions::default()).unwrap();
    assert_eq!(info.ending.marker.unwrap().lost["/drr/frame"], 1);
}

/// A flipped byte in a chunk is found by its CRC before any of its messages is returned; elsewhere by a
/// length, a number, or the data section's CRC. Everything read before is correct, and nothing panics.
#[test]
fn flipped_bytes_never_panic_and_never_pass() {
    let bytes = write_log(&run_messages(400, None));
    let whole: Vec<TickRecord> = open_bytes(&bytes).unwrap().map(Result::unwrap).collect();
    let summary_start = {
        let footer = bytes.len() - 8 - 20;
        u64::from_le_bytes(bytes[footer..footer + 8].try_into().unwrap()) as usize
    };
    let mut random = Rng::with_seed(5);
    let (mut refused, mut stopped) = (0, 0);
    for _ in 0..2500 {
        let mut changed = bytes.clone();
        let at = random.usize(..changed.len());
        changed[at] ^= 1 << random.usize(..8);
        let mut reader = match open_bytes(&changed) {
            Ok(reader) => reader,
            Err(_) => {
                refused += 1;
                continue;
            }
        };
        let (mut read, mut error) = (0, false);
        for item in reader.by_ref() {
            match item {
                Ok(tick) => {
                    assert_eq!(tick, whole[read], "byte {at}");
                    read += 1;
                }
                Err(_) => error = true,
            }
        }
        assert_eq!(reader.last_complete_tick(), Tick(read as u64), "byte {at}");
        if error || !reader.stream().verdict().is_intact() {
            stopped += 1;
        } else {
            panic!("byte {at} changed (the summary begins at {summary_start}) and was not seen");
        }
    }
    println!("2500 flips: {refused} refused at opening, {stopped} named");
    assert!(stopped > 1500, "{stopped}");
}

/// Several changes at once, splices, and noise after a genuine start.
#[test]
fn garbage_never_panics() {
    let bytes = write_log(&run_messages(120, None));
    let mut random = Rng::with_seed(9);
    for round in 0..1500 {
        let mut changed = bytes.clone();
        for _ in 0..1 + random.usize(..6) {
            let at = random.usize(..changed.len());
            match random.usize(..5) {
                0 => changed[at] = random.u8(..),
                1 => changed.truncate(at.max(1)),
                2 => {
                    let until = (at + 1 + random.usize(..40)).min(changed.len());
                    changed.drain(at..until);
                }
                3 => {
                    let noise: Vec<u8> = (0..random.usize(..40)).map(|_| random.u8(..)).collect();
                    changed.splice(at..at, noise);
                }
                _ => {
                    let end = (at + 8).min(changed.len());
                    changed[at..end].fill(if round % 2 == 0 { 0xff } else { 0 });
                }
            }
            if changed.is_empty() {
                changed.push(0x89);
            }
        }
        if let Ok(reader) = open_bytes(&changed) {
            let _ = reader.count();
        }
    }
    for round in 0..500 {
        let mut noise = bytes[..9 + random.usize(..3000)].to_vec();
        noise.extend((0..2000).map(|_| random.u8(..) >> (round % 8)));
        if let Ok(reader) = open_bytes(&noise) {
            let _ = reader.count();
        }
    }
}
