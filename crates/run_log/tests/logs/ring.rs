//! Logs that begin later than their run: where they are cut, which are saved, and that each replays.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use crate::common::*;
use fastrand::Rng;
use messages::*;
use run_log::ring::{Fate, Ring, Triggered};
use run_log::segments::{SegmentOptions, verify_segments};
use run_log::triggers::Triggers;
use run_log::*;
use zerocopy::IntoBytes;

fn begin(log: &mut RunLog<Vec<u8>>, from: u64) {
    log.begin_another(Tick(from), Vec::new(), Path::new("another.mcap"), Box::new(Cursor::new(Vec::new())));
}

/// Verifies a log by itself; returns its first tick and the hash of each state after it.
fn replayed(bytes: &[u8]) -> (u64, BTreeMap<u64, [u64; 2]>) {
    let mut reader = open_bytes(bytes).unwrap();
    let options = SegmentOptions { start: None, to_tick: None, threads: 2 };
    let report = verify_segments(&mut reader, &|| Ok(Toy::new()), &options);
    assert!(report.replay.is_identical(), "{:?}", report.replay);
    assert!(report.gaps.is_empty(), "{:?}", report.gaps);
    let verdict = reader.stream().verdict();
    assert!(verdict.is_intact(), "{verdict}");
    assert_eq!(report.first_tick, reader.header().first_tick);
    let mut images = frames(&named("test.mcap", bytes), ReadOptions::default()).unwrap();
    assert!(images.all(|frame| frame.unwrap().frame.tick >= report.first_tick.0));
    let states = open_bytes(bytes).unwrap().map(Result::unwrap).map(|record| record.state);
    (report.first_tick.0, states.map(|state| (state.tick, state.hash)).collect())
}

/// Cuts a run at random keyframes into overlapping logs, ends some of them early, and replays each.
#[test]
fn a_log_cut_at_any_keyframe_replays_by_itself() {
    for seed in 0..24 {
        let mut random = Rng::with_seed(seed);
        let (ticks, interval) = (random.u64(150..500), random.u64(5..60));
        let reset = Some(random.u64(1..ticks));
        let steps = run_messages(ticks, reset);
        let whole = {
            let mut log = RunLog::create(Vec::new(), &header()).unwrap();
            feed_with_keyframes(&mut log, &steps, |state| keyframe(state, interval));
            replayed(&log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1).1
        };
        let mut log = RunLog::create(Vec::new(), &header()).unwrap();
        let (mut ended, mut sequence) = (Vec::new(), 0);
        for step in &steps {
            feed(&mut log, std::slice::from_ref(step)).unwrap();
            let Step::State(state) = step else { continue };
            for part in
                keyframe(state, interval).map_or_else(Vec::new, |k| keyframe_parts(state, sequence, &k))
            {
                sequence += 1;
                log.keyframe(&part).unwrap();
            }
            if !log.has_next() && random.u8(..) < 20 {
                begin(&mut log, state.tick + random.u64(0..40));
            }
            if log.first_ticks().count() > 1 && random.u8(..) < 8 {
                let place = random.usize(..log.first_ticks().count());
                ended.push(log.end(place, EndReason::Saved("tick 1: a test".to_owned())).unwrap());
            }
        }
        log.drain().unwrap();
        while log.first_ticks().count() > 0 {
            ended.push(log.end(0, EndReason::Completed).unwrap());
        }
        assert!(ended.len() > 1, "seed {seed} cuts nothing");
        for (marker, bytes) in ended {
            let (first, hashes) = replayed(&bytes);
            assert!(first.is_multiple_of(interval) && marker.lost.is_empty(), "{marker:?}");
            let last = marker.last_tick.unwrap().0;
            let expected: BTreeMap<u64, [u64; 2]> =
                whole.range(first + 1..=last).map(|(k, h)| (*k, *h)).collect();
            assert_eq!(hashes, expected, "seed {seed}, ticks {first} to {last}");
        }
    }
}

fn keyframe(state: &State, interval: u64) -> Option<Vec<u8>> {
    (state.tick > 0 && state.tick.is_multiple_of(interval)).then(|| state.as_bytes().to_vec())
}

/// A log from tick 100 on, of 300 ticks.
fn late_log() -> Vec<u8> {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    begin(&mut log, 50);
    feed_with_keyframes(&mut log, &run_messages(300, None), |state| keyframe(state, 100));
    log.drain().unwrap();
    drop(log.discard(0));
    log.end(0, EndReason::Completed).unwrap().1
}

/// Regression: keyframes and frames were compared in order, so that those of a late log differed from the
/// first ones of its run.
#[test]
fn a_late_log_is_compared_with_its_part_of_the_run() {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    feed_with_keyframes(&mut log, &run_messages(300, None), |state| keyframe(state, 100));
    let whole = log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1;
    let (whole, late) = (named("whole.mcap", &whole), named("late.mcap", &late_log()));
    for (first, second) in [(&whole, &late), (&late, &whole)] {
        let report = run_log::diff::diff(first, second, ReadOptions::default()).unwrap();
        assert!(report.frames.is_none() && report.messages.is_empty(), "{report:?}");
        assert!(report.identical_ticks == 200 && report.identical_frames > 0, "{report:?}");
        assert_eq!(report.remarks, ["100 ticks are only in whole.mcap"]);
    }
}

/// The header says where a log begins: what is lost behind that is still a fault.
#[test]
fn a_late_log_that_lost_its_start_is_not_intact() {
    let bytes = late_log();
    assert_eq!(replayed(&bytes).0, 100);
    let log = named("late.mcap", &bytes);
    let mut repaired = repair::survey(Cursor::new(&bytes), Path::new("late.mcap")).unwrap();
    repaired.judge(&log, &log).unwrap();
    assert_eq!(repaired.complete_tick, Some(Tick(300)));
    let info = info(&named("late.mcap", &bytes), ReadOptions::default()).unwrap();
    let mut text = Vec::new();
    info.write(&mut text).unwrap();
    let text = String::from_utf8(text).unwrap();
    assert!(
        text.contains("0.200 s simulated, 200 ticks of 1000 us, from the keyframe of tick 100 (0.100 s)"),
        "{text}"
    );
    assert!(text.contains("verdict     intact"), "{text}");
    // One chunk after the other is made unreadable.
    let chunks: Vec<usize> = (8..bytes.len() - 9)
        .filter(|at| bytes[*at] == 6 && bytes[*at + 1 + 8..].starts_with(&100_000_000_u64.to_le_bytes()))
        .collect();
    assert!(chunks.len() >= 2, "the state and its keyframe have chunks of their own");
    for at in chunks {
        let mut broken = bytes.clone();
        broken[at + 120] ^= 1;
        assert!(!verdict(&named("broken.mcap", &broken), ReadOptions::default()).unwrap().is_intact());
    }
}

/// Regression in spirit: the log of a run that is shorter than the ring is an ordinary log.
#[test]
fn the_first_log_is_that_of_a_run_without_a_ring() {
    let steps = run_messages(250, Some(120));
    let of = |with_ring: bool| {
        let mut log = RunLog::create(Vec::new(), &header()).unwrap();
        if with_ring {
            begin(&mut log, 100);
        }
        feed_with_keyframes(&mut log, &steps, |state| keyframe(state, 50));
        log.drain().unwrap();
        log.end(0, EndReason::Completed).unwrap().1
    };
    assert_eq!(of(true), of(false));
}

/// A ring with random triggers, against what it promises.
#[test]
fn every_trigger_has_its_ticks_before_and_after_in_one_log_of_bounded_length() {
    for seed in 0..200 {
        let mut random = Rng::with_seed(seed);
        let (period, interval) = (random.u64(20..200), random.u64(1..20));
        let (ticks, rate) = (random.u64(1..6000), [0.0, 0.001, 0.02, 1.0][random.usize(..4)]);
        // The recorder reads triggers late, but its shortest period is longer than that.
        let late = random.u64(..=period);
        let mut ring = Ring::new(period, late, 1_000_000);
        let mut open = vec![0];
        // First tick, last tick, and the triggers that named the log, with their ticks after.
        let mut saved: BTreeMap<u64, (u64, u64)> = BTreeMap::new();
        let mut triggers: Vec<(u64, u64, u64)> = Vec::new();
        for tick in 1..=ticks {
            if tick.is_multiple_of(interval) && Tick(tick) >= ring.next_begin() && random.u8(..) > 10 {
                open.push(tick);
                ring.begun(Tick(tick));
            }
            if random.f64() < rate {
                let (after, met) = (random.u64(..=period), tick - random.u64(..=late.min(tick)));
                let Triggered::Saving { number, first_tick, .. } = ring.trigger(Tick(met), after, "x") else {
                    panic!("nothing is full");
                };
                assert!(open.contains(&first_tick.0), "seed {seed}: {first_tick} of {open:?}");
                triggers.push((met, after, number));
            }
            ring.unneeded(Tick(tick)).into_iter().for_each(|place| _ = open.remove(place));
            while let Some((place, save)) = ring.complete(Tick(tick)) {
                saved.insert(save.number, (open.remove(place), tick));
            }
            assert!(open.len() <= 8, "seed {seed}: {open:?}");
            assert!(tick - open[0] <= 6 * period + late + 6 * interval, "seed {seed}, tick {tick}: {open:?}");
        }
        let fates = ring.end(Tick(ticks));
        assert_eq!(fates.iter().filter(|fate| **fate == Fate::Last).count(), 1, "seed {seed}");
        for (first, fate) in open.iter().zip(fates) {
            match fate {
                Fate::Last => assert!(*first == 0 || first + period <= ticks, "seed {seed}: {first}"),
                Fate::Saved(save) => _ = saved.insert(save.number, (*first, ticks)),
                Fate::Dropped => {}
            }
        }
        for (tick, after, number) in triggers {
            // A log that is not among the saved ones is that of the end.
            let Some((first, last)) = saved.get(&number) else { continue };
            assert!(*first == 0 || first + period <= tick, "seed {seed}: {tick} in {first} to {last}");
            assert!(*last >= (tick + after).min(ticks), "seed {seed}: {tick} + {after} in {first} to {last}");
        }
    }
}

#[test]
fn as_many_logs_are_saved_as_allowed() {
    let mut ring = Ring::new(10, 0, 1);
    let saving = |triggered| matches!(triggered, Triggered::Saving { number: 1, .. });
    assert!(saving(ring.trigger(Tick(5), 1, "a")) && saving(ring.trigger(Tick(6), 1, "b")));
    ring.begun(Tick(10));
    ring.begun(Tick(20));
    let (place, save) = ring.complete(Tick(20)).unwrap();
    assert_eq!((place, save.to_string().as_str()), (0, "tick 5: a; tick 6: b"));
    assert_eq!(ring.trigger(Tick(21), 1, "c"), Triggered::Full);
}

#[test]
fn triggers_fire_once_when_met_and_refuse_what_they_do_not_know() {
    let parse = |text: &str| Triggers::parse(&[text.to_owned()]);
    let mut above = parse("burr_force_n > 20").unwrap();
    let state = |force| State { burr_force_n: force, ..State::zeroed() };
    let fired: Vec<usize> = [19.0, 20.0, 20.5, 30.0, 1.0, 21.0, f64::NAN, 21.0]
        .map(|force| above.state(&state(force)).len())
        .into();
    assert_eq!(fired, [0, 0, 1, 0, 0, 1, 0, 1]);
    assert_eq!(above.state(&state(0.0)), Vec::<String>::new());
    assert_eq!(above.state(&state(25.0)), ["burr_force_n > 20 (25)"]);
    let mut element = parse("tendon_tension_n[1]>3").unwrap();
    let pulled = State { tendon_tension_n: [9.0, 4.0, 0.0, 0.0], ..State::zeroed() };
    assert_eq!(element.state(&pulled).len(), 1);
    assert_eq!(parse("tendon_tension_n < -1").unwrap().state(&pulled).len(), 0);
    let event = |code: EventCode| Event { code: code.code(), ..Event::zeroed() };
    let breach = parse("breach").unwrap();
    assert_eq!(breach.event(&event(EventCode::Breach)), Some("breach"));
    assert_eq!(breach.event(&event(EventCode::Reset)), None);
    let late = TickTiming {
        missed: 1,
        wake_lateness_ns: 5_000_000,
        recorder_wait_ns: 5_000_000,
        ..TickTiming::zeroed()
    };
    assert!(parse("missed_tick").unwrap().timing(&late).is_some());
    assert!(parse("missed_tick:recorder").unwrap().timing(&late).is_some());
    assert!(parse("missed_tick:stolen").unwrap().timing(&late).is_none());
    assert!(parse("missed_tick").unwrap().timing(&TickTiming::zeroed()).is_none());
    for (text, part) in [
        ("breech", "trigger `breech`: unknown (did you mean `breach`?); expected a field"),
        ("log_saved", "unknown"),
        ("burr_force > 2", "State has no field 'burr_force' (did you mean 'burr_force_n'?)"),
        ("burr_force_n > lots", "`lots` is not a number"),
        ("burr_force_n > nan", "`nan` is not a number"),
        ("t_world_tip > 1", "`t_world_tip` is not a number; name one of its fields"),
        ("tendon_tension_n[9] > 1", "index 9 is out of range"),
        ("missed_tick:moon", "unknown cause `moon`; expected one of own_computation, run_queue"),
        ("", "unknown"),
    ] {
        let error = parse(text).unwrap_err();
        assert!(error.contains(part), "{text}: {error}");
    }
}
