//! Replay, differences, and the user-facing tools.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use crate::common::*;
use messages::layout::Message;
use messages::*;
use run_log::cat::{CatOptions, cat};
use run_log::diff::{DiffReport, HeaderDifference, diff};
use run_log::fields::Scalar;
use run_log::segments::{SegmentOptions, SkippedGap, verify_segments};
use run_log::*;
use zerocopy::IntoBytes;

#[test]
fn a_run_replays_bit_for_bit() {
    let mut reader = open_bytes(&write_log(&run_messages(900, Some(400)))).unwrap();
    let report = verify(&mut reader, Toy::new, None);
    assert!(report.is_identical() && report.ending.is_complete());
    assert_eq!(
        (report.identical_ticks, report.last_tick, report.simulated_ns),
        (900, Tick(900), 900_000_000)
    );
    let mut reader = open_bytes(&write_log(&run_messages(50, None))).unwrap();
    let report = verify(&mut reader, Toy::new, Some(Tick(20)));
    assert_eq!((report.identical_ticks, report.is_identical()), (20, true));
}

#[test]
fn the_first_difference_is_named_with_its_bits() {
    let mut reader = open_bytes(&write_log(&run_messages(300, None))).unwrap();
    let toy = || Toy { fault_tick: Some(123), ..Toy::new() };
    let report = verify(&mut reader, toy, None);
    let divergence = report.divergence.unwrap();
    println!("{divergence}");
    assert_eq!((report.identical_ticks, divergence.tick), (122, Tick(123)));
    let first = &divergence.differences[0];
    assert_eq!(first.path, "t_world_link[7].position_m[2]");
    assert_eq!(first.ulps, Some(1));
    assert_eq!(first.recorded.unwrap().bits() + 1, first.replayed.unwrap().bits());
    // The other two are the words of the hash.
    assert_eq!(divergence.total, 3);
    assert_eq!(divergence.differences[1].path, "hash[0]");

    let mut reader = open_bytes(&write_log(&run_messages(300, None))).unwrap();
    let toy = || Toy { forget_tick: Some(52), ..Toy::new() };
    let divergence = verify(&mut reader, toy, None).divergence.unwrap();
    println!("{divergence}");
    assert_eq!((divergence.tick, divergence.differences[1].path.as_str()), (Tick(52), "removed_in_tick"));
}

/// A simulation that computes the right state but reports the wrong voxels.
struct WrongVoxels(Toy);

impl Plant for WrongVoxels {
    type Error = String;

    fn state(&self) -> &State {
        self.0.state()
    }
    fn step(&mut self, latched: &Latched) -> Result<(), String> {
        self.0.step(latched)?;
        if self.0.state.tick == 31 {
            self.0.removed[2] += 1;
        }
        Ok(())
    }
    fn removed(&self) -> &[u32] {
        self.0.removed()
    }
    fn predrilled(&self) -> &[u32] {
        self.0.predrilled()
    }
    fn refusals(&self) -> &[Refusal] {
        self.0.refusals()
    }
    fn write_keyframe(&self, buffer: &mut [u8]) -> Result<usize, String> {
        self.0.write_keyframe(buffer)
    }
    fn restore_keyframe(&mut self, keyframe: &[u8]) -> Result<(), String> {
        self.0.restore_keyframe(keyframe)
    }
}

#[test]
fn removed_voxels_are_compared_too() {
    let mut reader = open_bytes(&write_log(&run_messages(60, None))).unwrap();
    let divergence = verify(&mut reader, || WrongVoxels(Toy::new()), None).divergence.unwrap();
    println!("{divergence}");
    assert_eq!((divergence.topic, divergence.tick, divergence.total), (Topic::Removed, Tick(31), 1));
    assert_eq!(divergence.differences[0].path, "voxel_index[2]");
}

#[test]
fn a_replay_of_a_damaged_log_is_not_identical() {
    let steps = run_messages(300, None);
    let kept: Vec<Step> =
        steps.into_iter().filter(|s| !matches!(s, Step::State(m) if m.tick == 77)).collect();
    let mut reader = open_bytes(&write_log(&kept)).unwrap();
    let options = SegmentOptions { start: None, to_tick: None, threads: 1 };
    let report = verify_segments(&mut reader, &|| Ok(Toy::new()), &options);
    let gap = SkippedGap { after: Some(Tick(76)), resumed: None };
    assert_eq!((report.replay.identical_ticks, report.gaps), (76, vec![gap]));

    let mut reader = open_bytes(&write_log(&run_messages(60, None))).unwrap();
    let report = verify(&mut reader, || Toy { fail_tick: Some(31), ..Toy::new() }, None);
    assert_eq!(report.simulation_error, Some((Tick(31), "the toy is broken".to_string())));
    assert_eq!((report.identical_ticks, report.is_identical()), (30, false));
}

/// Distances by definition: the number of steps of the IEEE 754 total order between two values.
#[test]
fn ulp_distances_are_counted_across_signs_and_powers() {
    let distance = |a: f64, b: f64| Scalar::Float64(a).ulp_distance(&Scalar::Float64(b));
    assert_eq!(distance(1.0, 1.0), Some(0));
    assert_eq!(distance(1.0, 1.0 + f64::EPSILON), Some(1));
    assert_eq!(distance(1.0, 1.0 - f64::EPSILON / 2.0), Some(1));
    assert_eq!(distance(0.0, -0.0), Some(1));
    assert_eq!(distance(-f64::from_bits(1), f64::from_bits(1)), Some(3));
    assert_eq!(distance(1.0, 2.0), Some(1 << 52));
    assert_eq!(distance(f64::NAN, 1.0), None);
    assert_eq!(distance(f64::NEG_INFINITY, f64::INFINITY), Some(2 * 0x7ff0_0000_0000_0000 + 1));
    let single = |a: f32, b: f32| Scalar::Float32(a).ulp_distance(&Scalar::Float32(b));
    assert_eq!(single(1.0, 1.0 + f32::EPSILON), Some(1));
    assert_eq!(single(-1.0, 1.0), Some(2 * 0x3f80_0000 + 1));
    let mut x = -3.5e-310;
    for n in 0..2000 {
        assert_eq!(distance(-3.5e-310, x), Some(n));
        x = x.next_up();
    }
}

#[test]
fn diff_finds_the_first_difference_of_two_logs() {
    let steps = run_messages(300, None);
    let a = named("a.mcap", &write_log(&steps));
    let b = named("b.mcap", &write_log(&steps));
    let text = |report: &DiffReport| {
        let mut out = Vec::new();
        report.write(&mut out).unwrap();
        String::from_utf8(out).unwrap()
    };
    let report = diff(&a, &b, ReadOptions::default()).unwrap();
    assert!(report.same_run());
    assert_eq!(text(&report), "300 identical ticks, 7 identical frames\nidentical\n");

    let mut changed = steps.clone();
    for step in &mut changed {
        if let Step::Latched(m) = step
            && m.tick == 44
        {
            m.commands[0].command.tendon_force_n[1] = 2.5;
        }
        if let Step::Frame(bytes) = step
            && bytes[16] == 101
        {
            *bytes.last_mut().unwrap() ^= 1;
        }
    }
    let b = named("b.mcap", &write_log(&changed));
    let report = diff(&a, &b, ReadOptions::default()).unwrap();
    println!("{}", text(&report));
    let divergence = report.ticks.as_ref().unwrap();
    assert_eq!((divergence.topic, divergence.tick, report.identical_ticks), (Topic::Latched, Tick(44), 44));
    assert_eq!(divergence.differences[0].path, "commands[0].command.tendon_force_n[1]");
    assert_eq!(divergence.differences[0].ulps, Some(1 << 50));
    assert_eq!(report.frames.as_ref().unwrap().differences[0].path, "data[1279]");

    let short = named("short.mcap", &write_log(&steps[..400]));
    let report = diff(&a, &short, ReadOptions::default()).unwrap();
    println!("{}", text(&report));
    assert!(!report.same_run() && report.remarks[0].contains("continues"));

    let mut other = header();
    other.mode = RunMode::Lockstep;
    let mut log = RunLog::create(Vec::new(), &other).unwrap();
    feed(&mut log, &steps).unwrap();
    let bytes = log.finish(EndReason::Completed, &Default::default()).unwrap().1;
    let report = diff(&a, &named("c.mcap", &bytes), ReadOptions::default()).unwrap();
    assert!(report.same_run());
    let [name, first, second] = ["mode", "realtime", "lockstep"].map(str::to_owned);
    assert_eq!(report.header, [HeaderDifference { name, first, second }]);
}

#[test]
fn info_says_what_a_log_holds_and_where_it_ends() {
    let bytes = write_log(&run_messages(1000, None));
    let text = |bytes: &[u8]| {
        let mut out = Vec::new();
        let info = info(&named("run.mcap", bytes), ReadOptions::default()).unwrap();
        info.write(&mut out).unwrap();
        String::from_utf8(out).unwrap()
    };
    let whole = text(&bytes);
    println!("{whole}");
    for expected in [
        "scene       toy",
        "512 x 400 x 3",
        "realtime, controllers: a, b-2",
        "1.000 s simulated, 1000 ticks of 1000 us",
        "/state                       1001 messages",
        "end marker: completed",
        "last tick 1000, hash ",
    ] {
        assert!(whole.contains(expected), "{expected}");
    }
    let cut = text(&bytes[..bytes.len() / 2]);
    println!("{}", cut.lines().last().unwrap());
    assert!(cut.contains("no end marker") && cut.contains("truncated after byte"));
    let mut flipped = bytes.clone();
    flipped[bytes.len() / 2] ^= 4;
    assert!(text(&flipped).contains("damaged at byte"));
}

#[test]
fn cat_writes_selected_fields_as_json() {
    let path = named("run.mcap", &write_log(&run_messages(100, None)));
    let lines = |options: &CatOptions| -> Vec<serde_json::Value> {
        let mut out = Vec::new();
        cat(&path, options, &mut out).unwrap();
        out.split(|b| *b == b'\n')
            .filter(|l| !l.is_empty())
            .map(|l| serde_json::from_slice(l).unwrap())
            .collect()
    };
    let mut toy = Toy::new();
    (0..51).for_each(|k| toy.step(&latched(k)).unwrap());
    let options = CatOptions {
        topics: vec!["/state".to_string()],
        fields: vec!["t_world_link[7].position_m".to_string(), "removed_total".to_string()],
        ticks: TickRange { first: Tick(51), last: Some(Tick(53)) },
        ..CatOptions::default()
    };
    let found = lines(&options);
    assert_eq!(found.len(), 3);
    assert_eq!((&found[0]["topic"], &found[0]["tick"]), (&"/state".into(), &51.into()));
    let position = &found[0]["message"]["t_world_link[7].position_m"];
    // JSON text preserves every bit of a finite f64.
    let bits: Vec<u64> = position.as_array().unwrap().iter().map(|v| v.as_f64().unwrap().to_bits()).collect();
    assert_eq!(bits, toy.state.t_world_link[7].position_m.map(f64::to_bits));
    assert_eq!(found[0]["message"]["removed_total"], toy.state.removed_total);

    let all = lines(&CatOptions {
        ticks: TickRange { first: Tick(3), last: Some(Tick(3)) },
        ..CatOptions::default()
    });
    let topics: Vec<&str> = all.iter().map(|line| line["topic"].as_str().unwrap()).collect();
    assert_eq!(topics, ["/removed", "/state", "/latched"]);
    assert_eq!(all[0]["message"]["voxel_index"], serde_json::json!([300, 301, 302, 303, 304]));
    assert_eq!(all[1]["message"]["hash"].as_array().unwrap().len(), 2);
    assert_eq!(all[2]["message"]["commands"][0]["command"]["sequence"], 4);

    for bad in ["t_world_link[99].position_m", "nonsense", "bend_rad.x", "contacts.gap_m"] {
        let options = CatOptions { fields: vec![bad.to_string()], ..CatOptions::default() };
        let error = cat(&path, &options, &mut Vec::new()).unwrap_err();
        println!("{error}");
        assert!(matches!(error, LogError::NoSuchField { .. }));
    }
}

/// Every scalar of every message is found under its path, at its offset.
#[test]
fn differences_of_one_byte_name_one_field() {
    for description in messages::ALL {
        let zeros = vec![0u8; description.size];
        for at in 0..description.size {
            let mut changed = zeros.clone();
            changed[at] = 1;
            let found = difference::compare(Topic::State, Tick(0), description, &zeros, &changed).unwrap();
            // The count of a missing tail is a field like any other.
            assert_eq!(found.total, 1, "{} byte {at}", description.name);
            let place = fields::find(description, &found.differences[0].path).unwrap();
            assert!((place.offset..place.offset + place.size).contains(&at));
        }
    }
    let state = State::zeroed();
    assert!(
        difference::compare(Topic::State, Tick(0), State::DESCRIPTION, state.as_bytes(), state.as_bytes())
            .is_none()
    );
}
