//! Sensor readings in a log: their place, and missing ones.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail")]

use std::collections::BTreeMap;

use crate::common::{header, open_bytes, stream};
use messages::{Latched, SensorReading, State, Tick};
use run_log::{EndReason, LogError, ReadOptions, RunLog, Topic};

/// A log of six states. Each but the first has a reading with one of these numbers, passed as early as the
/// recorder may receive it.
fn log(sequences: [u64; 5]) -> Vec<u8> {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    let reading =
        |tick: u64| SensorReading { tick, sequence: sequences[tick as usize - 1], ..SensorReading::zeroed() };
    log.state(&State::zeroed()).unwrap();
    for tick in 1..=5 {
        log.latched(&Latched { tick: tick - 1, ..Latched::zeroed() }).unwrap();
        // The reading of the next tick may already be there.
        if tick == 1 {
            log.reading(&reading(1)).unwrap();
        }
        if tick < 5 {
            log.reading(&reading(tick + 1)).unwrap();
        }
        log.state(&State { tick, ..State::zeroed() }).unwrap();
    }
    let lost = log.lost().get(Topic::Sensor.name()).copied();
    assert_eq!(lost, (sequences[4] > 5).then(|| sequences[4] - 5));
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1
}

#[test]
fn a_reading_stands_before_the_state_with_which_it_arrives() {
    let bytes = log([1, 2, 3, 4, 5]);
    let (mut order, mut stream) = (Vec::new(), stream(&bytes, ReadOptions::default()).unwrap());
    while let Some(message) = stream.next_message().unwrap() {
        order.push((message.topic.to_owned(), message.log_time_ns / 1_000_000));
    }
    let expected: Vec<(String, u64)> = [("/state", 0)]
        .into_iter()
        .chain((1..=5).flat_map(|tick| [("/latched", tick - 1), ("/sensor", tick), ("/state", tick)]))
        .map(|(topic, tick)| (topic.to_owned(), tick))
        .collect();
    assert_eq!(order, expected);
    let ticks: Vec<_> = open_bytes(&bytes).unwrap().map(Result::unwrap).collect();
    assert_eq!(ticks.len(), 5);
    assert!(ticks.iter().all(|tick| tick.readings.len() == 1 && tick.readings[0].tick == tick.state.tick));
}

#[test]
fn a_missing_reading_is_a_gap_and_is_counted() {
    let bytes = log([1, 2, 4, 5, 6]);
    let error = open_bytes(&bytes).unwrap().find_map(Result::err);
    assert!(matches!(error, Some(LogError::Gap { topic: Topic::Sensor, tick: Tick(3), .. })), "{error:?}");
    let mut whole = stream(&bytes, ReadOptions::default()).unwrap();
    while whole.next_message().unwrap().is_some() {}
    assert_eq!(whole.ending().marker.as_ref().unwrap().lost, BTreeMap::from([("/sensor".to_owned(), 1)]));
}

/// A scene without sensors has no new topic in its log.
#[test]
fn a_log_without_readings_has_no_topic_for_them() {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    log.state(&State::zeroed()).unwrap();
    let (marker, bytes) = log.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    assert!(!marker.counts.contains_key("/sensor"));
    assert!(!bytes.windows(7).any(|window| window == b"/sensor"));
}
