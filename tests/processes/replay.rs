//! Logs that are altered, truncated, from something else, or not logs at all.

use std::fs;
use std::path::{Path, PathBuf};

use ipc_types::messages::SOURCE_HELD;
use serde_json::{Value, json};

use crate::common::logs::{assert_replays, read, recorded, rewrite, verify};
use crate::common::program::{Place, succeed, trabecula};
use crate::common::scenes;

fn drilled(place: &Place) -> PathBuf {
    let scene = scenes::drill("lockstep", 0.4) + &scenes::keyframes(0.1);
    place.complete(&scene).folder.join("run.mcap")
}

fn assert_differs(log: &Path, words: &[&str]) {
    let done = verify(log);
    assert_eq!(done.code, Some(1), "{}{}", done.out, done.err);
    assert!(words.iter().all(|word| done.err.contains(word)), "{words:?} in: {}", done.err);
    assert!(!done.out.contains("identical"), "{}", done.out);
}

/// Regression: `--verify --frames` and several `--controller` wrote a JSON object each; scripts read only
/// one.
#[test]
fn figures_of_a_replay_are_one_document() {
    let figures = |words: &[&dyn AsRef<std::ffi::OsStr>]| -> Value {
        let done = succeed(&[&[&"replay" as &dyn AsRef<std::ffi::OsStr>], words, &[&"--json"]].concat());
        serde_json::from_str(&done.out).unwrap_or_else(|cause| panic!("{}: {cause}", done.out))
    };
    let place = Place::new();
    let drilled = drilled(&place);
    let verified = figures(&[&drilled, &"--verify"]);
    assert_eq!((&verified["ticks"], &verified["verified"]), (&json!(400), &json!(true)));
    assert_eq!(verified.get("frames"), None);
    for more in
        [&[&drilled as &dyn AsRef<std::ffi::OsStr>, &"--verify", &"--frames"][..], &[&drilled, &"--frames"]]
    {
        let figures = figures(more);
        assert_eq!((&figures["ticks"], &figures["hash"]), (&verified["ticks"], &verified["hash"]));
        // 10 Hz for 0.4 s, and the initial one.
        let frames = ["identical", "in_gaps", "without_request"].map(|name| &figures["frames"][name]);
        assert_eq!(frames, [&json!(5), &json!(0), &json!(0)], "{figures}");
    }
    let other = Place::new();
    let two = scenes::hold("lockstep", 0.1).replace(r#"["tendon", "arm", "burr"]"#, r#"["tendon"]"#)
        + "[[controller]]\nname = \"second\"\ndrives = [\"burr\"]\nhold = { tension_n = 0.0 }\n";
    let held = recorded(&other, &two);
    let program = env!("CARGO_BIN_EXE_trabecula");
    let [first, second] =
        ["holder", "second"].map(|name| format!("{name}='{program}' proc controller --name {name}"));
    let compared = figures(&[&held, &"--controller", &first, &"--controller", &second]);
    let of = |name: &str| json!({"name": name, "identical_commands": 100});
    assert_eq!(compared, json!({"controllers": [of("holder"), of("second")]}));
}

#[test]
fn promise_4_divergence_report_names_the_tick_and_field_of_one_altered_bit() {
    let place = Place::new();
    let original = drilled(&place);
    let changed = place.path("changed.mcap");
    rewrite(&original, &changed, |_| {}, |_| {});
    assert_replays(&changed);

    let flip = |value: &mut f64| *value = f64::from_bits(value.to_bits() ^ 1);
    rewrite(
        &original,
        &changed,
        |_| {},
        |state| {
            if state.tick == 173 {
                flip(&mut state.t_world_link[5].position_m[1]);
            }
        },
    );
    assert_differs(&changed, &["173", "t_world_link[5].position_m[1]"]);

    rewrite(&original, &changed, |_| {}, |state| state.hash[1] ^= u64::from(state.tick == 90));
    assert_differs(&changed, &["90", "hash"]);

    // A command from which the recorded states do not follow.
    rewrite(
        &original,
        &changed,
        |latched| {
            if latched.tick == 250 {
                latched.commands[0].command.burr_speed_rad_per_s += 1.0;
            }
        },
        |_| {},
    );
    assert_differs(&changed, &["251"]);
}

#[test]
fn a_bit_flipped_in_the_file_itself_is_found_by_its_checksum() {
    let place = Place::new();
    let original = drilled(&place);
    let mut bytes = fs::read(&original).unwrap();
    let at = bytes.len() / 2;
    bytes[at] ^= 4;
    fs::write(place.path("flipped.mcap"), &bytes).unwrap();
    let done = verify(&place.path("flipped.mcap"));
    assert_eq!(done.code, Some(1), "{}{}", done.out, done.err);
    assert!(done.err.contains("cannot be read beyond tick"), "{}", done.err);
}

/// On several threads, a replay that compares nothing gives the same output as on one, whatever is wrong with
/// the log.
#[test]
fn a_replay_without_comparison_says_the_same_on_any_number_of_threads() {
    let place = Place::new();
    let original = drilled(&place);
    let bytes = fs::read(&original).unwrap();
    let [cut, flipped, altered] = ["cut.mcap", "flip.mcap", "altered.mcap"].map(|name| place.path(name));
    fs::write(&cut, &bytes[..bytes.len() * 2 / 3]).unwrap();
    let mut flip = bytes.clone();
    flip[bytes.len() / 2] ^= 4;
    fs::write(&flipped, &flip).unwrap();
    let faster = |latched: &mut ipc_types::messages::Latched| {
        latched.commands[0].command.burr_speed_rad_per_s += if latched.tick == 150 { 1.0 } else { 0.0 };
    };
    // The states after tick 150 and the keyframes no longer follow from its commands.
    rewrite(&original, &altered, faster, |_| {});
    let mut hashes = Vec::new();
    for (log, code) in [(&original, 0), (&cut, 3), (&flipped, 1), (&altered, 0)] {
        for more in [&[][..], &[&"--from" as &dyn AsRef<std::ffi::OsStr>, &"250", &"--to", &"380"]] {
            let said = ["1", "2", "5"].map(|threads| {
                let words = [&[&"replay" as &dyn AsRef<std::ffi::OsStr>, log, &"--threads", &threads], more];
                let done = trabecula(&words.concat());
                // The wall-clock time.
                let out = done.out.split(" simulated in ").next().unwrap_or_default().to_owned();
                let rest = done.out.split_once('\n').unwrap_or_default().1.to_owned();
                (done.code, out, rest, done.err)
            });
            assert!(said.iter().all(|one| *one == said[0]), "{said:?}");
            if more.is_empty() {
                assert_eq!(said[0].0, Some(code), "{said:?}");
                hashes.push(said[0].1.clone());
            }
        }
    }
    assert_ne!(hashes[0], hashes[3], "another command, another hash");
}

#[test]
fn promise_7_truncation_a_cut_log_replays_to_its_last_complete_tick_and_says_so() {
    let place = Place::new();
    let original = recorded(&place, &scenes::hold("lockstep", 1.0)).join("run.mcap");
    let bytes = fs::read(&original).unwrap();
    let (cut_log, mut random, mut last) = (place.path("cut.mcap"), 12_345_u64, 0);
    let mut cuts: Vec<usize> = (0..6)
        .map(|_| {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            bytes.len() / 8 + (random >> 33) as usize % (bytes.len() * 7 / 8)
        })
        .collect();
    cuts.sort_unstable();
    for cut in cuts {
        fs::write(&cut_log, &bytes[..cut]).unwrap();
        let said = assert_replays(&cut_log);
        let ticks: usize = said.split(' ').nth(1).unwrap().parse().unwrap();
        assert!(said.contains(&format!("last tick {ticks},")), "{said}");
        assert!(
            said.contains("no end marker") || said.contains("end marker: completed; truncated after"),
            "{said}"
        );
        // Chunks are closed every 100 ticks; only that much (and the index at the end) is lost.
        assert!(
            ticks >= last && ticks + 250 >= 1000 * cut / bytes.len(),
            "cut at {cut} of {}: {said}",
            bytes.len()
        );
        last = ticks;
    }
}

/// "All identical" requires that something was compared.
#[test]
fn a_replay_that_would_compare_nothing_says_so() {
    let place = Place::new();
    let held = recorded(&place, &scenes::hold("lockstep", 0.1)).join("run.mcap");
    let other = Place::new();
    let drilled = other.complete(&scenes::drill("lockstep", 0.2)).folder.join("run.mcap");
    let unheard = place.path("unheard.mcap");
    rewrite(&held, &unheard, |latched| latched.commands[0].source = SOURCE_HELD, |_| {});
    let cases: [(&Path, &[&str], &str); 3] = [
        (&held, &["--verify", "--frames"], "the scene has no X-ray"),
        (&drilled, &["--frames", "--from", "110", "--to", "120"], "no frames in this range of ticks"),
        (&unheard, &["--controller", "/bin/true"], "--controller `holder`:"),
    ];
    for (log, more, said) in cases {
        let mut words: Vec<&dyn AsRef<std::ffi::OsStr>> = vec![&"replay", &log];
        more.iter().for_each(|word| words.push(word));
        let done = trabecula(&words);
        assert!(done.code == Some(2) && done.err.contains(said), "{more:?}: {}{}", done.out, done.err);
        assert!(!done.out.contains("re-rendered"), "{more:?}: {}", done.out);
    }
}

#[test]
fn a_recorded_replay_that_differs_leaves_no_file() {
    let place = Place::new();
    let original = recorded(&place, &scenes::hold("lockstep", 0.1)).join("run.mcap");
    let changed = place.path("changed.mcap");
    rewrite(&original, &changed, |_| {}, |state| state.hash[0] ^= u64::from(state.tick == 70));
    let again = place.path("again");
    let done = trabecula(&[&"replay", &changed, &"--output", &again]);
    assert!(done.code == Some(1) && done.err.contains("tick 70"), "{}", done.err);
    assert!(!again.join("run.mcap").exists());
    // So that the same name can be used again, with a correct log.
    succeed(&[&"replay", &original, &"--output", &again]);
}

#[test]
fn a_timing_log_is_not_replayed_as_a_run() {
    let place = Place::new();
    let folder = place.complete(&scenes::hold("lockstep", 0.1)).folder;
    let done = verify(&folder.join("timing.mcap"));
    assert_eq!(done.code, Some(2), "{}{}", done.out, done.err);
    assert_eq!(read(&folder).ticks.len(), 100);
}
