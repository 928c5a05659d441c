//! Sensors in a simulation, in the hub's own ticks, in a log and its replay: the same bits.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail")]

use std::path::Path;
use std::sync::{Arc, LazyLock};

use controllers::built_in;
use hub::in_process::{Answer, InProcess};
use messages::{Latched, Reset, SensorReading};
use recorder_proc::log_file::LogFile;
use run_log::segments::{SegmentOptions, keyframe_before, verify_segments};
use run_log::{LogReader, MessageStream, ReadOptions, Topic};
use sim::{Drive, SharedScene, Sim};
use simulation::{CtView, Simulation};
use test_support::scenes::{BLOCK, LATE_SENSORS};

/// Drills a curve on a shape that is 20 ms old; the other kinds of sensors are present but unused.
static SCENE: LazyLock<String> = LazyLock::new(|| {
    let run = "name = \"measured\"\nrun = { mode = \"lockstep\", duration_s = 0.6, seed = 7 }\n\
               recording = { keyframe_interval_s = 0.1 }\n";
    [run, BLOCK, LATE_SENSORS, OTHERS].concat()
});

const OTHERS: &str = r#"
[[sensor]]
name = "joints"
rate_hz = 125.0
encoders = {}
[[sensor]]
name = "tension"
rate_hz = 500.0
load_cell = { bias_n = 0.1 }
[[sensor]]
name = "wrist"
rate_hz = 1000.0
delay_ms = 1.0
force_torque = { drift_n = 0.1, low_pass_hz = 100.0 }
[[controller]]
name = "reference"
drives = ["tendon", "arm", "burr"]
sensors = ["shape", "tension"]
[controller.curved_drilling]
feed_mm_per_s = 10.0
insertion_mm = 20.0
tension_n = 6.0
ramp_start_mm = 1.0
ramp_end_mm = 15.0
burr_speed_rpm = 8000.0
target_mm = [5.0, 0.0, -12.0]
feedback = "shape"
guidance_gain_n_per_mm = 0.5
"#;

fn load(folder: &Path, text: &str) -> Arc<SharedScene> {
    std::fs::write(folder.join("scene.toml"), text).unwrap();
    SharedScene::load(Some(&folder.join("scene.toml")), &[], None).unwrap()
}

fn simulation(shared: &SharedScene) -> Simulation<'_> {
    let ct = CtView::from(&shared.ct().unwrap().volume);
    Simulation::new(shared.scene(), Some(ct)).unwrap()
}

#[test]
fn a_measured_run_is_the_same_in_a_simulation_in_the_hub_and_in_its_replay() {
    let place = tempfile::tempdir().unwrap();
    let shared = load(place.path(), &SCENE);
    let mut run = InProcess::new(shared.scene(), simulation(&shared));
    let mut controller =
        built_in(shared.scene(), "reference", &|_| panic!("no calibration")).unwrap().unwrap();
    let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
    sim.record(&place.path().join("log")).unwrap();
    let mut seen: Vec<SensorReading> = sim.readings();
    for _ in 0..600 {
        run.plant().readings().iter().for_each(|reading| controller.reading(reading));
        run.tick(|_, state, command| {
            controller.step(state, command);
            Answer::Command
        })
        .unwrap();
        sim.step(&[], 1).unwrap();
        assert_eq!(sim.state().hash, run.plant().state().hash, "tick {}", sim.state().tick);
        assert_eq!(sim.readings(), run.plant().readings(), "tick {}", sim.state().tick);
        seen.extend(run.plant().readings());
    }
    assert!(sim.state().tendon_tension_n[0] > 1.0, "the controller drives on what it measures");
    assert!(sim.close_recording().unwrap());

    let log = LogFile::at(place.path().join("log/run.mcap"));
    let mut logged: Vec<SensorReading> = Vec::new();
    let mut stream = MessageStream::open(&log, ReadOptions::default()).unwrap();
    while let Some(message) = stream.next_message().unwrap() {
        if message.known == Some(Topic::Sensor) {
            logged.push(zerocopy::FromBytes::read_from_bytes(message.body).unwrap());
        }
    }
    assert_eq!(logged, seen);
    for index in 0..5 {
        assert!(seen.iter().any(|reading| reading.sensor_index == index), "sensor {index}");
    }

    // Every segment from its keyframe, with the readings underway in it.
    let make = || Ok::<_, String>(simulation(&shared));
    for from in [None, Some(250)] {
        let start =
            from.and_then(|tick| keyframe_before(LogReader::open(&log).unwrap(), messages::Tick(tick)));
        assert_eq!(start.is_some(), from.is_some());
        let options = SegmentOptions { start, to_tick: None, threads: 2 };
        let report = verify_segments(&mut LogReader::open(&log).unwrap(), &make, &options);
        assert!(report.replay.is_identical(), "{:?}", report.replay);
        assert_eq!(report.replay.last_tick.0, 600);
        assert!(report.identical_keyframes >= 3);
    }

    // A replay whose readings differ is detected by the first of them; no state differs.
    let other = load(place.path(), &SCENE.replace("low_pass_hz", "noise_n = 0.03, low_pass_hz"));
    let (make, options) =
        (|| Ok::<_, String>(simulation(&other)), SegmentOptions { start: None, to_tick: None, threads: 1 });
    let report = verify_segments(&mut LogReader::open(&log).unwrap(), &make, &options);
    let divergence = report.replay.divergence.unwrap();
    assert_eq!((divergence.topic, divergence.differences[0].path.as_str()), (Topic::Sensor, "value[0]"));
}

#[test]
fn readings_underway_are_part_of_a_snapshot() {
    let place = tempfile::tempdir().unwrap();
    let shared = load(place.path(), &SCENE);
    let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
    sim.step(&[], 210).unwrap();
    let here = sim.snapshot();
    sim.step(&[], 300).unwrap();
    let (hash, readings) = (sim.state().hash, sim.readings());
    assert!(readings.len() > 400, "{}", readings.len());
    sim.restore(&here).unwrap();
    sim.step(&[], 300).unwrap();
    assert_eq!((sim.state().hash, sim.readings()), (hash, readings.clone()));
    let mut other = Sim::new(&shared, &Drive::Nothing).unwrap();
    other.restore(&here).unwrap();
    other.step(&[], 300).unwrap();
    assert_eq!((other.state().hash, other.readings()), (hash, readings));
}

/// A reset returns to the start with no readings underway; ticks and the readings' numbers continue.
#[test]
fn a_reset_clears_what_is_underway() {
    let place = tempfile::tempdir().unwrap();
    let shared = load(place.path(), &SCENE);
    let mut plant = simulation(&shared);
    let mut last = 0;
    for tick in 0..400 {
        let latched = Latched { tick, reset: u32::from(tick == 200), ..Latched::zeroed() };
        assert_eq!(latched.reset() == Reset::Yes, tick == 200);
        for reading in plant.readings() {
            assert_eq!(reading.sequence, last + 1);
            last = reading.sequence;
            assert!(tick <= 200 || reading.sample_tick > 200, "{reading:?}");
        }
        plant.step(&latched).unwrap();
    }
    assert!(last > 500);
}

/// Sensors must not change the world.
#[test]
fn a_scene_with_sensors_that_nobody_uses_has_the_hash_of_one_without() {
    let place = tempfile::tempdir().unwrap();
    let unused = SCENE.replace("sensors = [\"shape\", \"tension\"]", "");
    let (start, end) = (unused.find("[[sensor]]").unwrap(), unused.find("[[controller]]").unwrap());
    let none = format!("{}{}", &unused[..start], &unused[end..]);
    let hash = |text: &str| {
        let mut sim = Sim::new(&load(place.path(), text), &Drive::Nothing).unwrap();
        sim.step(&[], 600).unwrap();
        assert_eq!(sim.readings().is_empty(), text == none);
        sim.state().hash
    };
    assert_eq!(hash(&unused), hash(&none));
}
