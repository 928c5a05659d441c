//! Rate, delay, jitter, and pending readings.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail")]

use crate::common;

use crate::common::{read, scene, state};
use messages::SensorReading;
use scene::{Scene, SceneError};
use sensors::{SensorArray, SensorArrayState};
use std::path::Path;

/// A signal uncorrelated in time.
fn signal(tick: u64) -> f64 {
    counter_random::Key::of(99).normal(tick)
}

/// Lag at which the reader's latest value correlates best with the signal.
fn best_lag(readings: &[SensorReading], ticks: u64) -> u64 {
    let at = |tick: u64| {
        readings.iter().take_while(|reading| reading.tick <= tick).last().map_or(0.0, |r| r.value[0])
    };
    let held: Vec<f64> = (0..ticks).map(at).collect();
    let correlation =
        |lag: u64| (lag..ticks).map(|tick| held[tick as usize] * signal(tick - lag)).sum::<f64>();
    (0..100).max_by(|a, b| correlation(*a).total_cmp(&correlation(*b))).unwrap()
}

#[test]
fn the_delay_is_that_of_the_cross_correlation() {
    for (delay_ms, ticks) in [(0.0, 0), (0.6, 1), (1.0, 1), (20.4, 20), (57.0, 57)] {
        let keys = format!("rate_hz = 1000.0\ndelay_ms = {delay_ms}\nload_cell = {{ noise_n = 0.0 }}");
        assert_eq!(best_lag(&read(&scene(&keys), 3000, signal), 3000), ticks, "{delay_ms} ms");
    }
}

#[test]
fn the_rate_is_kept_over_time_also_where_its_period_is_no_whole_number_of_ticks() {
    for (rate, in_ten_seconds) in [(1000.0, 10_000), (100.0, 1000), (30.0, 300), (0.3, 3), (333.3, 3333)] {
        let all =
            read(&scene(&format!("rate_hz = {rate}\nload_cell = {{ noise_n = 0.0 }}")), 10_000, |_| 1.0);
        assert_eq!(all.len(), in_ten_seconds, "{rate} Hz");
        let even = |(number, reading): (usize, &SensorReading)| {
            let late = reading.sample_tick as f64 - number as f64 * 1000.0 / rate;
            assert!((-1e-6..1.0).contains(&late), "{rate} Hz: sample {number} at {}", reading.sample_tick);
        };
        all.iter().enumerate().for_each(even);
    }
}

#[test]
fn jitter_is_even_and_readings_do_not_overtake_each_other() {
    let keys = "rate_hz = 20.0\ndelay_ms = 5.0\njitter_ms = 40.0\nload_cell = { noise_n = 0.0 }";
    let all = read(&scene(keys), 200_000, |_| 1.0);
    let later: Vec<f64> =
        all.iter().map(|reading| (reading.tick - reading.sample_tick) as f64 - 5.0).collect();
    assert!(later.iter().all(|ticks| (0.0..=40.0).contains(ticks)));
    let error = 4.0 * 40.0 / 12.0_f64.sqrt() / (later.len() as f64).sqrt();
    assert!((common::mean(&later) - 20.0).abs() < error, "{}", common::mean(&later));
    let crowded = "rate_hz = 1000.0\njitter_ms = 40.0\nload_cell = { noise_n = 0.0 }";
    let all = read(&scene(crowded), 20_000, |_| 1.0);
    assert!(
        all.windows(2).all(|pair| pair[0].sample_tick < pair[1].sample_tick && pair[0].tick <= pair[1].tick)
    );
    assert!(all.iter().zip(1..).all(|(reading, number)| reading.sequence == number));
}

#[test]
fn a_delay_longer_than_the_run_delivers_nothing() {
    let keys = "rate_hz = 10.0\ndelay_ms = 10000.0\nload_cell = { noise_n = 0.0 }";
    assert!(read(&scene(keys), 10_000, |_| 1.0).is_empty());
}

/// Pending readings, drift and filter belong to the state.
#[test]
fn a_restored_array_goes_on_as_the_original_does() {
    let scene = scene(
        "rate_hz = 100.0\ndelay_ms = 25.0\njitter_ms = 9.0\ndropout = 0.2\n\
         force_torque = { drift_n = 0.1, low_pass_hz = 30.0 }\n\
         [[sensor]]\nname = \"b\"\nrate_hz = 1000.0\ndelay_ms = 3.0\nload_cell = { bias_n = 0.1 }",
    );
    let (mut original, mut copy) = (SensorArray::new(&scene), SensorArray::new(&scene));
    for tick in 0..=737 {
        original.see(&state(tick, signal(tick)));
    }
    let saved = original.state();
    assert!(copy.fits(&saved));
    copy.restore(&saved);
    assert_eq!(copy.readings(), original.readings(), "readings of the same tick");
    for tick in 738..2000 {
        original.see(&state(tick, signal(tick)));
        copy.see(&state(tick, signal(tick)));
        assert_eq!(copy.readings(), original.readings(), "tick {tick}");
    }
    assert_eq!(copy.state(), original.state());
    let other: SensorArrayState = SensorArray::new(&common::scene("rate_hz = 1.0\nencoders = {}")).state();
    assert!(!copy.fits(&other));
}

#[test]
fn a_reset_leaves_nothing_underway_and_numbers_go_on() {
    let scene = scene("rate_hz = 100.0\ndelay_ms = 25.0\nload_cell = { noise_n = 0.0 }");
    let mut sensors = SensorArray::new(&scene);
    let mut last = 0;
    for tick in 0..100 {
        sensors.see(&state(tick, 1.0));
        last = sensors.readings().last().map_or(last, |reading| reading.sequence);
    }
    sensors.reset();
    for tick in 100..200 {
        sensors.see(&state(tick, 2.0));
        for reading in sensors.readings() {
            assert!(reading.sample_tick >= 100 && reading.value[0] == 2.0, "{reading:?}");
            last += 1;
            assert_eq!(reading.sequence, last);
        }
    }
    assert!(last > 10);
}

fn refused(keys: &str) -> String {
    let text = format!(
        "name = \"t\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\n\
         burr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\n\
         bend_toward = [1.0, 0.0, 0.0]\n{keys}\n"
    );
    let error: SceneError = Scene::parse(&text, Path::new("t.toml")).unwrap_err();
    error.to_string()
}

#[test]
fn a_sensor_that_cannot_be_is_refused_with_key_value_and_range() {
    let sensor = |keys: &str| format!("[[sensor]]\nname = \"s\"\n{keys}");
    for (keys, words) in [
        (sensor("rate_hz = 2000.0\nencoders = {}"), ["sensor.rate_hz", "2000", "1000"]),
        (sensor("rate_hz = 0.0\nencoders = {}"), ["sensor", "rate_hz", "0.1"]),
        (sensor("rate_hz = nan\nencoders = {}"), ["sensor.rate_hz", "allowed", "0.1"]),
        (sensor("rate_hz = 1000.0\ndelay_ms = 300.0\nencoders = {}"), ["sensor.delay_ms", "300 ms", "256"]),
        (sensor("rate_hz = 10.0"), ["sensor `s`", "exactly one", "fbg"]),
        (sensor("rate_hz = 10.0\nencoders = {}\nload_cell = {}"), ["sensor `s`", "exactly one", "fbg"]),
        (sensor("rate_hz = 10.0\nfbg = { nodes = 17 }"), ["nodes", "17", "16"]),
        (
            sensor("rate_hz = 10.0\ntracker = { marker_faces = [0.0, 0.0, 0.0] }"),
            ["marker_faces", "is 0", "allowed"],
        ),
        (sensor("rate_hz = 1.0\nencoders = {}").repeat(2), ["sensor.name", "`s`", "duplicate"]),
        (sensor("rate_hz = 1.0\nencoders = {}\n").repeat(9), ["sensor", "9", "8"]),
        (
            "[[controller]]\nname = \"c\"\ndrives = [\"tendon\"]\nsensors = [\"x\"]\n\
             hold = { tension_n = 1.0 }"
                .to_owned(),
            ["controller.sensors", "`x`", "not a `[[sensor]]`"],
        ),
        (
            "[[controller]]\nname = \"c\"\ndrives = [\"tendon\"]\nsensors = [\"x\"]\nexternal = true"
                .to_owned(),
            ["controller.sensors", "built-in", "every sensor"],
        ),
    ] {
        let keys = keys.replacen(
            "[[sensor]]\nname = \"s\"\nrate_hz = 1.0\nencoders = {}[[",
            "[[sensor]]\nname = \"s\"\nrate_hz = 1.0\nencoders = {}\n[[",
            1,
        );
        let error = refused(&keys);
        assert!(words.iter().all(|word| error.contains(word)), "{keys}\n{error}");
    }
}
