//! Incomplete logs, read by every command: a gap, damage, an incorrect reply; and a replay's guarantees.

use std::fs;
use std::path::Path;

use ipc_types::messages::{DrrReply, Frame, Latched, State};
use zerocopy::{FromBytes, IntoBytes};

use crate::common::logs::{edited, recorded, rewrite_as, verify};
use crate::common::program::{Done, Place, trabecula};
use crate::common::scenes;

fn said(done: &Done, code: i32, words: &[&str]) {
    assert_eq!(done.code, Some(code), "{}\n{}", done.out, done.err);
    let text = format!("{}\n{}", done.out, done.err);
    words.iter().for_each(|word| assert!(text.contains(word), "`{word}` in: {text}"));
}

/// A recorder that stops for longer than its queues loses ticks in the middle; everything after is complete.
fn with_gap(from: &Path, to: &Path, ticks: std::ops::Range<u64>) {
    edited(from, to, |topic, body| match topic {
        "/latched" => !ticks.contains(&Latched::read_from_bytes(body).unwrap().tick),
        "/state" => !ticks.contains(&State::read_from_bytes(body).unwrap().tick),
        _ => true,
    });
}

#[test]
fn a_gap_costs_the_ticks_up_to_the_next_keyframe_and_is_named_by_every_command() {
    let place = Place::new();
    let scene = scenes::drill("lockstep", 0.8) + &scenes::keyframes(0.1);
    let whole = place.complete(&scene).folder.join("run.mcap");
    let log = place.path("gap.mcap");
    with_gap(&whole, &log, 230..275);
    let lost = "gap: missing messages: 45 of /latched, 45 of /state";
    let stretch = "ticks 230 to 275: 45 of /latched, 45 of /state";
    let passed = "not replayed: ticks 230 to 300; continued at the keyframe of tick 300";
    let verified = trabecula(&[&"replay", &log, &"--verify", &"--frames"]);
    said(&verified, 3, &["replayed 729 ticks, all identical; last tick 800", passed, lost, stretch]);
    // The bone after the gap is that of the keyframe.
    said(&verified, 3, &["re-rendered "]);
    said(&trabecula(&[&"replay", &log]), 3, &["replayed 729 ticks", passed, lost]);
    let behind = trabecula(&[&"replay", &log, &"--verify", &"--from", &"0.45s"]);
    said(&behind, 3, &["replayed 400 ticks from the keyframe of tick 400, all identical", lost]);
    let before = trabecula(&[&"replay", &log, &"--verify", &"--to", &"200"]);
    said(&before, 0, &["all identical; last tick 200"]);

    said(&trabecula(&[&"log", &"info", &log]), 3, &[lost, stretch]);
    let repaired = place.path("repaired.mcap");
    let done = trabecula(&[&"log", &"repair", &log, &"-o", &repaired]);
    said(&done, 3, &[lost]);
    assert!(!done.out.contains("the log was intact"), "{}", done.out);
    said(&verify(&repaired), 3, &["replayed 729 ticks, all identical", lost]);
    said(&trabecula(&[&"log", &"cat", &log, &"--topic", &"/removed"]), 3, &[lost]);
    said(&trabecula(&[&"log", &"export", &log, &"-o", &place.path("t.csv")]), 3, &[lost]);
    said(
        &trabecula(&[&"log", &"diff", &log, &log]),
        3,
        &["identical", "the first log: gap", "the second log: gap"],
    );
    let differs = trabecula(&[&"log", &"diff", &whole, &log]);
    said(&differs, 1, &["729 identical ticks", "71 ticks are only in", "the second log: gap"]);
    said(&trabecula(&[&"replay", &log, &"--output", &place.path("again")]), 1, &["gap at tick 230"]);
    assert!(!place.path("again").join("run.mcap").exists());
}

/// Regression: `log info` ended with 0 on 188 of 215 damaged logs.
#[test]
fn every_command_names_a_flipped_bit_and_does_not_end_with_0() {
    let place = Place::new();
    let folder = recorded(&place, &scenes::hold("lockstep", 0.4));
    let bytes = fs::read(folder.join("run.mcap")).unwrap();
    let (log, output) = (place.path("flipped.mcap"), place.path("r.mcap"));
    let mut random = fastrand::Rng::with_seed(17);
    for _ in 0..25 {
        let at = random.usize(..bytes.len());
        let mut changed = bytes.clone();
        changed[at] ^= 1 << random.usize(..8);
        fs::write(&log, &changed).unwrap();
        let _ = fs::remove_file(&output);
        let codes = [
            trabecula(&[&"log", &"info", &log]),
            trabecula(&[&"log", &"repair", &log, &"-o", &output]),
            verify(&log),
            trabecula(&[&"log", &"cat", &log]),
            trabecula(&[&"log", &"export", &log, &"-o", &place.path(&format!("{at}.csv"))]),
        ]
        .map(|done| done.code.unwrap());
        assert!(codes.iter().all(|code| (1..=3).contains(code)), "byte {at}: {codes:?}");
        assert!(!fs::exists(&output).unwrap() || verify(&output).code != Some(1), "byte {at}");
    }
}

/// Regression: a frame's geometry was compared with itself, not with the reply, which gives the frame's tick
/// and pose.
#[test]
fn replies_and_the_geometry_of_frames_take_part_in_a_check_of_frames() {
    let place = Place::new();
    let log = place.complete(&scenes::drill("lockstep", 0.4)).folder.join("run.mcap");
    let changed = place.path("changed.mcap");
    let frames = |log: &Path| trabecula(&[&"replay", &log, &"--verify", &"--frames"]);
    edited(&log, &changed, |_, _| true);
    said(&frames(&changed), 0, &["re-rendered "]);
    let reply = |edit: &dyn Fn(&mut DrrReply)| {
        edited(&log, &changed, |topic, body| {
            if topic == "/drr/reply" {
                let mut reply = DrrReply::read_from_bytes(body).unwrap();
                if reply.frame_sequence == 2 {
                    edit(&mut reply);
                }
                *body = reply.as_bytes().to_vec();
            }
            true
        });
        frames(&changed)
    };
    said(&reply(&|reply| reply.tick += 1), 1, &["frame 2: ", "/drr/reply", "tick: "]);
    said(&reply(&|reply| reply.requester = 1), 1, &["frame 2: ", "/drr/reply", "requester: "]);
    said(&reply(&|reply| reply.geometry.source_m[0] += 1e-3), 1, &["frame 2: ", "geometry.source_m[0]: "]);
    said(&reply(&|reply| reply.frame_sequence = 1), 1, &["frame 2: ", "/drr/reply has no reply for it"]);
    // Frame and reply agree on a C-arm other than the scene's.
    edited(&log, &changed, |topic, body| {
        match topic {
            "/drr/reply" => {
                let mut reply = DrrReply::read_from_bytes(body).unwrap();
                reply.geometry.source_m[0] += 1e-3;
                *body = reply.as_bytes().to_vec();
            }
            "/drr/frame" => {
                let mut frame = Frame::read_from_bytes(body).unwrap();
                frame.geometry.source_m[0] += 1e-3;
                *body = frame.as_bytes().to_vec();
            }
            _ => {}
        }
        true
    });
    said(&frames(&changed), 1, &["frame 1: ", "geometry.source_m[0]: "]);
}

/// A log's scene may name a program; only `trabecula run` starts it.
#[test]
fn a_replay_starts_none_of_a_logs_programs() {
    let place = Place::new();
    let text = scenes::hold("lockstep", 0.2);
    let trace = place.path("trace");
    let program = format!("command = [\"sh\", \"-c\", \"touch {}\"]", trace.display());
    let evil = text.replace("hold = { tension_n = 2.0 }", &program);
    assert_ne!(evil, text);
    let log = place.path("log.mcap");
    let original = recorded(&place, &text).join("run.mcap");
    rewrite_as(&original, &log, |header| header.scene_toml.clone_from(&evil), |_| {}, |_| {});
    said(&verify(&log), 0, &["replayed 200 ticks, all identical"]);
    said(&trabecula(&[&"replay", &log]), 0, &["replayed 200 ticks"]);
    said(&trabecula(&[&"replay", &log, &"--output", &place.path("again")]), 0, &["the files are identical"]);
    let holder = format!("holder={} proc controller --name holder", env!("CARGO_BIN_EXE_trabecula"));
    let live = trabecula(&[&"replay", &log, &"--controller", &holder]);
    assert_ne!(live.code, Some(0), "a program that the log does not give it cannot hold: {}", live.out);
    said(&trabecula(&[&"log", &"info", &log]), 0, &["verdict     intact"]);
    let scene = place.path("evil.toml");
    fs::write(&scene, &evil).unwrap();
    said(&trabecula(&[&"scene", &"check", &scene]), 0, &[]);
    said(&trabecula(&[&"plan", &"--list", &scene]), 0, &[]);
    assert!(!fs::exists(&trace).unwrap(), "the log's program was started");
    // A run does start it, which leaves the trace.
    let _ = trabecula(&[&"run", &scene, &"--output", &place.path("out"), &"--quiet"]);
    assert!(fs::exists(&trace).unwrap());
}
