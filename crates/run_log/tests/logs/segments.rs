//! Keyframes in a log: replaying from them, in parallel, and detecting bad ones.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::collections::BTreeMap;

use crate::common::*;
use messages::*;
use run_log::diff::diff;
use run_log::segments::{SegmentOptions, keyframe_before, step_segments, verify_segments};
use run_log::*;
use zerocopy::{FromBytes, IntoBytes};

const INTERVAL: u64 = 100;

/// A log with keyframes, each altered by `alter`.
fn log_with(ticks: u64, alter: impl Fn(u64, &mut Vec<u8>)) -> Vec<u8> {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    feed_with_keyframes(&mut log, &run_messages(ticks, Some(ticks / 2)), |state| {
        let mut bytes = state.as_bytes().to_vec();
        alter(state.tick, &mut bytes);
        (state.tick > 0 && state.tick.is_multiple_of(INTERVAL)).then_some(bytes)
    });
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1
}

fn options(threads: usize) -> SegmentOptions {
    SegmentOptions { start: None, to_tick: None, threads }
}

fn toy() -> Result<Toy, String> {
    Ok(Toy::new())
}

#[test]
fn segments_prove_the_whole_run_on_any_number_of_threads() {
    let bytes = log_with(900, |_, _| ());
    for threads in [1, 2, 4, 20] {
        let report = verify_segments(&mut open_bytes(&bytes).unwrap(), &toy, &options(threads));
        assert!(report.replay.is_identical() && report.replay.ending.is_complete());
        assert_eq!((report.replay.identical_ticks, report.replay.last_tick), (900, Tick(900)));
        assert_eq!((report.first_tick, report.identical_keyframes), (Tick::START, 9));
        let to = SegmentOptions { to_tick: Some(Tick(250)), ..options(threads) };
        let report = verify_segments(&mut open_bytes(&bytes).unwrap(), &toy, &to);
        assert_eq!((report.replay.identical_ticks, report.replay.is_identical()), (250, true));
    }
    // Without keyframes there is one segment.
    let plain = write_log(&run_messages(300, None));
    let report = verify_segments(&mut open_bytes(&plain).unwrap(), &toy, &options(4));
    assert_eq!((report.replay.identical_ticks, report.identical_keyframes), (300, 0));
}

/// Steps a log in one pass; returns the ticks, the last tick and the hash.
fn in_one_pass(bytes: &[u8], mut toy: Toy, to: u64) -> (u64, Tick, [u64; 2]) {
    let mut ticks = 0;
    for record in open_bytes(bytes).unwrap().map(Result::unwrap).take_while(|record| record.state.tick <= to)
    {
        toy.step(&record.latched).unwrap();
        ticks += 1;
    }
    (ticks, Tick(toy.state.tick), toy.state.hash)
}

#[test]
fn steps_between_keyframes_come_to_what_one_pass_comes_to_or_to_nothing() {
    let stepped =
        |bytes: &[u8], make: &(dyn Fn() -> Result<Toy, String> + Sync), options: &SegmentOptions| {
            let found = step_segments(&mut open_bytes(bytes).unwrap(), &make, options)?;
            assert!(found.identical_keyframes == 0 && found.gaps.is_empty(), "nothing is called compared");
            Some((found.replay.identical_ticks, found.replay.last_tick, found.replay.hash))
        };
    let bytes = log_with(950, |_, _| ());
    for threads in [1, 2, 4] {
        let all = options(threads);
        assert_eq!(stepped(&bytes, &toy, &all), Some(in_one_pass(&bytes, Toy::new(), u64::MAX)));
        let to = SegmentOptions { to_tick: Some(Tick(250)), ..options(threads) };
        assert_eq!(stepped(&bytes, &toy, &to), Some(in_one_pass(&bytes, Toy::new(), 250)));
        let start = keyframe_before(open_bytes(&bytes).unwrap(), Tick(350));
        let from = SegmentOptions { start, ..options(threads) };
        let (_, last, hash) = in_one_pass(&bytes, Toy::new(), u64::MAX);
        assert_eq!(stepped(&bytes, &toy, &from), Some((650, last, hash)));
        let plain = write_log(&run_messages(300, None));
        assert_eq!(stepped(&plain, &toy, &all), Some(in_one_pass(&plain, Toy::new(), u64::MAX)));

        // After the last keyframe the simulation's own hash counts, whatever the log's is.
        let late = || Ok(Toy { fault_tick: Some(950), ..Toy::new() });
        let own = in_one_pass(&bytes, late().unwrap(), u64::MAX);
        assert_ne!(own.2, hash);
        assert_eq!(stepped(&bytes, &late, &all), Some(own));

        // At a keyframe, the segment does not end where the next one begins. (A toy's own state forgets a
        // fault in the next tick.)
        let early = || Ok(Toy { fault_tick: Some(600), ..Toy::new() });
        assert_eq!(stepped(&bytes, &early, &all), None);
        let fails = || Ok(Toy { fail_tick: Some(777), ..Toy::new() });
        assert_eq!(stepped(&bytes, &fails, &all), None);
        assert_eq!(stepped(&bytes, &|| Err("no toy".to_string()), &all), None);
        for altered in [0, 2000] {
            let log = log_with(900, |tick, bytes| bytes[altered] ^= u8::from(tick == 400));
            assert_eq!(stepped(&log, &toy, &all), None, "byte {altered} of a keyframe");
        }
        let mut damaged = bytes.clone();
        damaged[bytes.len() * 3 / 4] ^= 1;
        assert_eq!(stepped(&damaged, &toy, &all), None);
        let lacks = |tick| move |step: &Step| !matches!(step, Step::State(state) if state.tick == tick);
        let gap: Vec<Step> = run_messages(300, None).into_iter().filter(lacks(120)).collect();
        assert_eq!(stepped(&write_log(&gap), &toy, &all), None);
    }
}

#[test]
fn the_first_difference_is_the_earliest_of_all_segments() {
    let bytes = log_with(900, |_, _| ());
    for threads in [1, 3] {
        let make = || Ok(Toy { fault_tick: Some(523), ..Toy::new() });
        let report = verify_segments(&mut open_bytes(&bytes).unwrap(), &make, &options(threads));
        let divergence = report.replay.divergence.expect("a difference");
        assert_eq!((divergence.tick, report.replay.identical_ticks), (Tick(523), 522));
        assert_eq!(divergence.differences[0].path, "t_world_link[7].position_m[2]");
        let make = || Ok(Toy { fail_tick: Some(777), ..Toy::new() });
        let report = verify_segments(&mut open_bytes(&bytes).unwrap(), &make, &options(threads));
        assert_eq!(report.replay.simulation_error, Some((Tick(777), "the toy is broken".to_string())));
        assert_eq!(report.replay.identical_ticks, 776);
        let make = || Err::<Toy, _>("no toy".to_string());
        let report = verify_segments(&mut open_bytes(&bytes).unwrap(), &make, &options(threads));
        assert_eq!(report.replay.simulation_error, Some((Tick::START, "no toy".to_string())));
    }
}

#[test]
fn a_replay_begins_at_the_last_keyframe_before_a_tick() {
    let bytes = log_with(900, |_, _| ());
    let at = |tick| keyframe_before(open_bytes(&bytes).unwrap(), Tick(tick)).map(|saved| saved.tick.0);
    let found: Vec<_> = [0, 99, 100, 101, 350, 899, 900, 5000].into_iter().map(at).collect();
    let wanted = [None, None, Some(100), Some(100), Some(300), Some(800), Some(900), Some(900)];
    assert_eq!(found, wanted);
    let start = keyframe_before(open_bytes(&bytes).unwrap(), Tick(350));
    let from = SegmentOptions { start, to_tick: Some(Tick(620)), threads: 2 };
    let report = verify_segments(&mut open_bytes(&bytes).unwrap(), &toy, &from);
    assert!(report.replay.is_identical());
    assert_eq!(
        (report.first_tick, report.replay.identical_ticks, report.replay.last_tick),
        (Tick(300), 320, Tick(620))
    );
    assert_eq!(report.identical_keyframes, 3);
}

/// The replay must neither wait for a dead worker nor call ticks proven that were not replayed.
#[test]
fn a_panic_while_a_simulation_is_built_is_a_simulation_error() {
    let panicked = Some((Tick::START, "the simulation panicked (its message is above)".to_string()));
    // A short log that fits into the queues, and a long one.
    for bytes in [write_log(&run_messages(20, None)), log_with(900, |_, _| ())] {
        for threads in [1, 3] {
            let make = || -> Result<Toy, String> { panic!("this toy cannot be built") };
            let report = verify_segments(&mut open_bytes(&bytes).unwrap(), &make, &options(threads));
            assert_eq!((&report.replay.simulation_error, report.replay.identical_ticks), (&panicked, 0));
            assert!(!report.replay.is_identical());
        }
    }
}

/// A differing keyframe or reply makes the logs different, whatever follows it.
#[test]
fn logs_whose_keyframes_or_replies_differ_are_not_identical() {
    let save = |name: &str, bytes: &[u8]| named(name, bytes);
    let first = save("a.mcap", &log_with(500, |_, _| ()));
    let compared = |bytes: &[u8]| diff(&first, &save("b.mcap", bytes), ReadOptions::default()).unwrap();
    assert!(compared(&log_with(500, |_, _| ())).same_run());
    let altered = compared(&log_with(500, |tick, bytes| bytes[200] ^= u8::from(tick == 300)));
    assert!(!altered.same_run() && altered.ticks.is_none() && altered.frames.is_none());
    assert_eq!((altered.messages[0].topic, altered.messages[0].tick), (Topic::Keyframe, Tick(300)));
    let without = compared(&write_log(&run_messages(500, Some(250))));
    assert!(!without.same_run() && without.messages.is_empty());
    assert!(without.remarks[0].ends_with("a.mcap has more messages of /keyframe"), "{:?}", without.remarks);

    let mut steps = run_messages(500, None);
    let plain = save("c.mcap", &write_log(&steps));
    for step in &mut steps {
        if let Step::Reply(reply) = step {
            reply.requester ^= u32::from(reply.frame_sequence == 4);
        }
    }
    let altered = diff(&plain, &save("d.mcap", &write_log(&steps)), ReadOptions::default()).unwrap();
    assert!(!altered.same_run() && altered.ticks.is_none());
    let differs = &altered.messages[0];
    assert_eq!((differs.topic, differs.differences[0].path.as_str()), (Topic::DrrReply, "requester"));
}

/// A tampered keyframe is detected at its tick, before it can affect anything else.
#[test]
fn an_altered_keyframe_differs_at_its_tick() {
    let altered = log_with(900, |tick, bytes| {
        if tick == 400 {
            bytes[2000] ^= 1;
        }
    });
    let panics = log_with(900, |tick, bytes| {
        if tick == 400 {
            bytes[..5].copy_from_slice(b"panic");
        }
    });
    for (bytes, threads) in [(&altered, 1), (&altered, 3), (&panics, 1), (&panics, 3)] {
        let report = verify_segments(&mut open_bytes(bytes).unwrap(), &toy, &options(threads));
        let divergence = report.replay.divergence.expect("a difference");
        assert_eq!((divergence.topic, divergence.tick), (Topic::Keyframe, Tick(400)));
        assert_eq!(report.replay.identical_ticks, 400);
    }
}

#[test]
fn a_missing_part_of_a_keyframe_is_told_and_costs_no_tick() {
    let whole = run_messages(250, None);
    let write = |skip: usize| {
        let mut log = RunLog::create(Vec::new(), &header()).unwrap();
        for step in &whole {
            feed(&mut log, std::slice::from_ref(step)).unwrap();
            if let Step::State(state) = step
                && state.tick == 100
            {
                let parts = keyframe_parts(state, 0, state.as_bytes());
                assert!(parts.len() > 2);
                for (_, part) in parts.iter().enumerate().filter(|(index, _)| *index != skip) {
                    log.keyframe(part).unwrap();
                }
            }
        }
        log.finish(EndReason::Completed, &BTreeMap::new()).unwrap()
    };
    let (marker, bytes) = write(1);
    assert_eq!(marker.lost, BTreeMap::from([(Topic::Keyframe.name().to_string(), 1)]));
    let mut reader = open_bytes(&bytes).unwrap();
    let report = verify_segments(&mut reader, &toy, &options(2));
    assert!(report.replay.is_identical() && report.gaps.is_empty(), "{report:?}");
    assert_eq!((report.replay.identical_ticks, report.identical_keyframes), (250, 0));
    let verdict = reader.stream().verdict();
    let [Fault::Gap(gap)] = verdict.faults.as_slice() else { panic!("{verdict}") };
    assert_eq!(gap.lost, marker.lost);
}

/// Late frames and keyframes keep their places when a log is rewritten in its original order.
#[test]
fn a_log_written_again_in_its_order_has_the_same_bytes() {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    let mut late = Vec::new();
    for step in run_messages(1500, None) {
        if matches!(step, Step::Frame(_)) {
            late.push(step);
            continue;
        }
        let at_700 = |state: &State| (state.tick == 700).then(|| state.as_bytes().to_vec());
        feed_with_keyframes(&mut log, std::slice::from_ref(&step), at_700);
        let Step::State(state) = &step else { continue };
        // Some frames arrive up to 90 ticks late, others up to 600, which is past their place in the log.
        if state.tick % 600 == 0 || (state.tick % 90 == 0 && state.tick < 500) {
            feed(&mut log, &std::mem::take(&mut late)).unwrap();
        }
    }
    feed(&mut log, &late).unwrap();
    let bytes = log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1;
    let mut stream = stream(&bytes, ReadOptions::default()).unwrap();
    let mut again = RunLog::create(Vec::new(), stream.header()).unwrap();
    again.keep_places();
    let mut frame: Option<Vec<u8>> = None;
    let mut chunk = 1;
    while let Some(message) = stream.next_message().unwrap() {
        let body = message.body;
        if chunk != message.chunk && message.known != Some(Topic::DrrImage) {
            again.close_chunk().unwrap();
        }
        chunk = message.chunk;
        match message.known {
            Some(Topic::Latched) => again.latched(&Latched::read_from_bytes(body).unwrap()).unwrap(),
            Some(Topic::State) => again.state(&State::read_from_bytes(body).unwrap()).unwrap(),
            Some(Topic::Removed) => again.removed(body).unwrap(),
            Some(Topic::Keyframe) => again.keyframe(body).unwrap(),
            Some(Topic::DrrReply) => again.drr_reply(&DrrReply::read_from_bytes(body).unwrap()).unwrap(),
            Some(Topic::DrrFrame) => frame = Some(body.to_vec()),
            _ => again.frame(&[frame.take().unwrap(), body.to_vec()].concat()).unwrap(),
        }
    }
    let second = again.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1;
    assert!(bytes == second, "{} against {} bytes", bytes.len(), second.len());
}
