//! The promise of `docs/replay.md`, point by point, with whole processes. Its other points: 1 in `schedules`,
//! 4 and 7 in `replay`, 5 and 10 besides in `crates/simulation/tests/physics/promise.rs`.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use ipc_types::messages::{DrrReply, Frame, ImagePrefix, Latched, State};
use recorder_proc::log_file::{LogFile, create_run};
use run_log::{EndReason, MessageStream, ReadOptions, Topic};
use zerocopy::{FromBytes, IntoBytes};

use crate::common::logs::{assert_replays, rewrite_as, verify};
use crate::common::program::{Done, Place, succeed, trabecula};
use crate::common::scenes;

const PROGRAM: &str = env!("CARGO_BIN_EXE_trabecula");

fn succeeded(done: &Done, words: &[&str]) {
    assert_eq!(done.code, Some(0), "{}{}", done.out, done.err);
    assert!(words.iter().all(|word| done.out.contains(word)), "{words:?} in: {}", done.out);
}

fn failed(done: &Done, code: i32, words: &[&str]) {
    assert_eq!(done.code, Some(code), "{}{}", done.out, done.err);
    assert!(words.iter().all(|word| done.err.contains(word)), "{words:?} in: {}", done.err);
}

#[test]
fn promise_2_file_identity_recording_a_replay_gives_the_same_file() {
    let place = Place::new();
    for (mode, frames) in [("lockstep", true), ("realtime", true), ("realtime", false)] {
        let scene = scenes::drill(mode, 0.7) + &scenes::keyframes(0.3);
        let folder = place.complete(&scene).folder;
        let again = place.path(&format!("{mode}-{frames}"));
        let mut words: Vec<&dyn AsRef<std::ffi::OsStr>> = vec![&"replay", &folder, &"--output", &again];
        if frames {
            words.push(&"--frames");
        }
        succeeded(&trabecula(&words), &["recorded 700 ticks", "the files are identical"]);
        let [first, second] = [&folder, &again].map(|folder| fs::read(folder.join("run.mcap")).unwrap());
        assert!(first == second, "{mode}: {} against {} bytes", first.len(), second.len());
        // Nothing is overwritten.
        failed(&trabecula(&words), 2, &["run.mcap: already exists"]);
        fs::remove_dir_all(place.path("out")).unwrap();
    }
}

/// Returns the command line of a controller of the log's own build, as one would start it by hand.
fn by_hand(name: &str) -> String {
    format!("'{PROGRAM}' proc controller --name {name}")
}

#[test]
fn promise_3_closed_loop_a_live_controller_answers_as_in_the_log() {
    let place = Place::new();
    // With frames, which the controller uses; and in real time.
    let drilled = place.complete(&scenes::drill("lockstep", 0.4)).folder.join("run.mcap");
    let command = by_hand("reference");
    for more in [&["--to", "0.4s"][..], &["--closed-loop"]] {
        let mut words: Vec<&dyn AsRef<std::ffi::OsStr>> =
            vec![&"replay", &drilled, &"--controller", &command];
        more.iter().for_each(|word| words.push(word));
        succeeded(&trabecula(&words), &["controller `reference`: 400 commands, all identical"]);
    }
    let other = Place::new();
    let held = other.complete(&scenes::hold("realtime", 0.3)).folder.join("run.mcap");
    let done = trabecula(&[&"replay", &held, &"--controller", &by_hand("holder")]);
    succeeded(&done, &["controller `holder`:", "commands, all identical"]);
}

#[test]
fn promise_3_closed_loop_stops_at_the_first_difference_and_names_it() {
    let place = Place::new();
    let original = place.complete(&scenes::hold("lockstep", 0.3)).folder.join("run.mcap");
    let changed = place.path("changed.mcap");
    let command = by_hand("holder");
    let live = |more: &[&'static str]| {
        let mut words: Vec<&dyn AsRef<std::ffi::OsStr>> =
            vec![&"replay", &changed, &"--controller", &command];
        more.iter().for_each(|word| words.push(word));
        trabecula(&words)
    };
    // One bit of one command in the log.
    let one_bit = |latched: &mut Latched| {
        if latched.tick == 123 {
            let tension_n = &mut latched.commands[0].command.tendon_force_n[0];
            *tension_n = f64::from_bits(tension_n.to_bits() + 1);
        }
    };
    rewrite_as(&original, &changed, |_| {}, one_bit, |_| {});
    let bits = ["(0x4000000000000001)", "(0x4000000000000000)", "1 ulp"];
    for more in [&[][..], &["--closed-loop"]] {
        let done = live(more);
        failed(&done, 1, &["first difference: tick 123, controller `holder`", "tendon_force_n[0]"]);
        failed(&done, 1, &bits);
    }
    // Another controller: the scene read by the live one requests 3 N, not 2 N.
    let stronger = |header: &mut run_log::LogHeader| {
        header.scene_toml = header.scene_toml.replace("tension_n = 2.0", "tension_n = 3.0");
    };
    rewrite_as(&original, &changed, stronger, |_| {}, |_| {});
    failed(&live(&[]), 1, &["first difference: tick 0, controller `holder`", "tendon_force_n[0]: 2e0"]);
    failed(&live(&["--closed-loop"]), 1, &["first difference: tick 0", "against 3e0"]);

    // Programs that are not controllers, and invalid names.
    let run = |text: &str| trabecula(&[&"replay", &original, &"--controller", &text]);
    failed(&run("false"), 1, &["tick 0: controller `holder` ended"]);
    failed(&run("/no/such/program"), 2, &["program `/no/such/program` not found"]);
    failed(&run("'unclosed"), 2, &["an unclosed quote"]);
}

#[test]
fn promise_5_save_and_restore_a_new_process_begins_at_a_keyframe() {
    let place = Place::new();
    let scene = scenes::drill("lockstep", 0.6) + &scenes::keyframes(0.1);
    let folder = place.complete(&scene).folder;
    let whole = assert_replays(&folder);
    assert!(whole.contains("6 keyframes, all identical"), "{whole}");
    let hash = whole.split("hash ").nth(1).unwrap().split(';').next().unwrap();
    let from = trabecula(&[&"replay", &folder, &"--verify", &"--from", &"0.455s"]);
    succeeded(&from, &["replayed 200 ticks from the keyframe of tick 400, all identical", hash]);
    let bare = trabecula(&[&"replay", &folder, &"--from", &"599"]);
    succeeded(&bare, &["replayed 100 ticks from the keyframe of tick 500", hash]);
    let part = trabecula(&[&"replay", &folder, &"--verify", &"--from", &"250", &"--to", &"310"]);
    succeeded(&part, &["replayed 110 ticks from the keyframe of tick 200, all identical; last tick 310"]);
    failed(&trabecula(&[&"replay", &folder, &"--from", &"9", &"--to", &"3"]), 2, &["before --from"]);
    failed(&trabecula(&[&"replay", &folder, &"--from", &"soon"]), 2, &["seconds such as 1.5s"]);
}

/// Writes a log with one frame's hash and one image's pixel altered.
fn alter_frames(from: &Path, to: &Path, hash_of: u64, pixel_of: u64) {
    let mut stream = MessageStream::open(&LogFile::at(from), ReadOptions::default()).unwrap();
    let mut log = create_run(to, stream.header()).unwrap();
    log.keep_places();
    let mut frame = Frame::zeroed();
    while let Some(message) = stream.next_message().unwrap() {
        let body = message.body;
        match message.known {
            Some(Topic::Latched) => log.latched(&Latched::read_from_bytes(body).unwrap()).unwrap(),
            Some(Topic::State) => log.state(&State::read_from_bytes(body).unwrap()).unwrap(),
            Some(Topic::Removed) => log.removed(body).unwrap(),
            Some(Topic::Keyframe) => log.keyframe(body).unwrap(),
            Some(Topic::DrrReply) => log.drr_reply(&DrrReply::read_from_bytes(body).unwrap()).unwrap(),
            Some(Topic::DrrFrame) => {
                frame = Frame::read_from_bytes(body).unwrap();
                frame.pixel_hash[0] ^= u64::from(frame.sequence == hash_of);
            }
            _ => {
                let mut image = body.to_vec();
                let at = size_of::<ImagePrefix>() + (5 * 64 + 9) * 2;
                image[at] ^= u8::from(frame.sequence == pixel_of);
                log.frame(&[frame.as_bytes(), &image].concat()).unwrap();
            }
        }
    }
    log.finish(EndReason::Completed, &std::collections::BTreeMap::new()).unwrap();
}

#[test]
fn promise_6_frames_are_rendered_again_bit_for_bit_with_any_number_of_threads() {
    let place = Place::new();
    let log = place.complete(&scenes::drill("realtime", 0.6)).folder.join("run.mcap");
    for threads in ["1", "2", "4"] {
        let done = trabecula(&[&"replay", &log, &"--verify", &"--frames", &"--threads", &threads]);
        let on = if threads == "1" { "1 thread".to_owned() } else { format!("{threads} threads") };
        succeeded(&done, &[&format!("frames on {on}, all identical")]);
        assert!(!done.out.contains("rendered 0 frames"), "{}", done.out);
    }
    let changed = place.path("changed.mcap");
    alter_frames(&log, &changed, 3, 0);
    let done = trabecula(&[&"replay", &changed, &"--frames"]);
    failed(&done, 1, &["frame 3:", "/drr/frame", "pixel_hash[0]"]);
    alter_frames(&log, &changed, 0, 2);
    let done = trabecula(&[&"replay", &changed, &"--frames"]);
    failed(&done, 1, &["frame 2:", "/drr/image", "1 pixels differ, first at row 5, column 9"]);
}

#[test]
fn promise_8_refusal_of_another_build_layout_volume_or_scene() {
    let place = Place::new();
    let volume = place.path("block.nrrd");
    let make = |to: &PathBuf, spacing: &str| {
        succeed(&[&"phantom", &"block", &"-o", to, &"--spacing-mm", &spacing]);
    };
    make(&volume, "1");
    let text = scenes::drill_in_file("lockstep", 0.2, "block.nrrd");
    let log = place.complete(&text).folder.join("run.mcap");
    let changed = place.path("changed.mcap");
    let allowed = |log: &Path, label: &str| {
        let done = trabecula(&[&"replay", &log, &"--verify", &"--allow-mismatch"]);
        succeeded(&done, &["all identical (MISMATCH ALLOWED:", label]);
    };
    // Another build.
    let older = |header: &mut run_log::LogHeader| header.build.version = "0.0.7+abc".to_owned();
    rewrite_as(&log, &changed, older, |_| {}, |_| {});
    let told =
        ["build: the log was written by 0.0.7+abc for", "this is", "pip install trabecula-0.0.7-*.whl"];
    failed(&verify(&changed), 2, &told);
    allowed(&changed, "build: the log was written by 0.0.7+abc");
    // Another layout: one digit of a hash in the header's text.
    let mut bytes = fs::read(&log).unwrap();
    let name = b"layout/TickTiming";
    let at = bytes.windows(name.len()).position(|window| window == name).unwrap() + name.len() + 4;
    bytes[at] = if bytes[at] == b'0' { b'1' } else { b'0' };
    // Without the record's own checksum, as in a log of an earlier build: this is not damage.
    let seal = b"\x05\0\0\0crc32";
    let at = bytes.windows(seal.len()).position(|window| window == seal).unwrap();
    bytes[at + 4] = b'x';
    fs::write(&changed, &bytes).unwrap();
    failed(&verify(&changed), 2, &["TickTiming"]);
    // Another scene.
    let other = place.path("other.toml");
    fs::write(&other, text.replace("feed_mm_per_s = 8.0", "feed_mm_per_s = 9.0")).unwrap();
    let in_scene = |scene: &Path| trabecula(&[&"replay", &log, &"--verify", &"--scene", &scene]);
    failed(
        &in_scene(&other),
        2,
        &["scene:", "other.toml differs from the `drill` that the log was recorded with"],
    );
    succeeded(&in_scene(&place.path("scene.toml")), &["all identical; last"]);
    // A volume that was moved, and another one in its place.
    let moved = place.path("moved.nrrd");
    fs::rename(&volume, &moved).unwrap();
    failed(&verify(&log), 2, &["block.nrrd", "give its path with --volume"]);
    let with = |volume: &Path| trabecula(&[&"replay", &log, &"--verify", &"--volume", &volume]);
    succeeded(&with(&moved), &["all identical; last"]);
    make(&volume, "0.8");
    failed(&with(&volume), 2, &["volume: SHA-256 was"]);
}

/// Prints both times; a figure on a quiet machine comes from `trabecula-lab bench step`.
#[test]
fn promise_9_speed_a_replay_states_how_much_faster_than_real_time_it_was() {
    let place = Place::new();
    let began = Instant::now();
    let folder = place.complete(&scenes::drill("lockstep", 1.5)).folder;
    let run = began.elapsed();
    let began = Instant::now();
    let said = assert_replays(&folder);
    let replay = began.elapsed();
    println!("run {run:?}, replay {replay:?}");
    // "1.500 s simulated in 0.123 s, 12.2 times real time", rounded to a millisecond and a tenth.
    let words: Vec<&str> = said.split_whitespace().collect();
    let at = words.windows(3).position(|w| w == ["times", "real", "time"]).unwrap();
    let [wall_s, factor]: [f64; 2] = [words[at - 3], words[at - 1]].map(|word| word.parse().unwrap());
    assert!(wall_s > 0.0 && wall_s <= replay.as_secs_f64(), "{said}, in {replay:?}");
    assert!((factor - 1.5 / wall_s).abs() < 0.06 + 0.6e-3 * factor / wall_s, "{said}");
}
