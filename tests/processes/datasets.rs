//! Data sets of labelled frames: what the command accepts, rejects and splits.
//! `clients/python/tests/test_datasets.py` reads them.

use std::fs;

use crate::common::program::{Place, Run, as_words, trabecula};
use crate::common::scenes;

/// A recorded run of the block in `run`.
fn recorded() -> Place {
    let place = Place::new();
    let folder = place.complete(&scenes::drill("lockstep", 0.6)).folder;
    fs::rename(folder, place.path("run")).unwrap();
    place
}

#[test]
fn a_data_set_takes_an_empty_folder_and_a_threshold_and_refuses_what_it_cannot_make() {
    let place = recorded();
    let (log, output) = (place.path("run"), place.path("set"));
    fs::create_dir(&output).unwrap();
    let export = |more: &[&str]| {
        let export: [&dyn AsRef<std::ffi::OsStr>; 5] = [&"log", &"export", &log, &"-o", &output];
        trabecula(&[&export[..], &as_words(more)].concat())
    };
    let refused = |words: &[&str], expected: &str| {
        let done = export(words);
        assert!(
            done.code == Some(2) && done.err.contains(expected),
            "{words:?}: {:?} {}",
            done.code,
            done.err
        );
        assert_eq!(fs::read_dir(&output).unwrap().count(), 0, "{words:?} has written something");
    };
    refused(&["--dataset", "voc"], "[possible values: coco, yolo, yolo-segment, npz, lerobot]");
    refused(&["--dataset", "npz", "--frames"], "cannot be used with");
    refused(&["--bone-from-hu", "200"], "--dataset <FORMAT>");
    refused(&["--dataset", "npz", "--bone-from-hu", "40000"], "40000");
    refused(&["--dataset", "npz", "--from", "999999"], "no frames in this range of ticks");
    refused(&["--dataset", "npz", "--split", "train=0.8,val=0.1"], "the shares add up to 0.9");
    refused(&["--dataset", "npz", "--split", "dev=1"], "unknown part `dev`");
    refused(&["--split", "train=1"], "--dataset <FORMAT>");
    refused(&["--frames", "--split", "train=1"], "cannot be used with");
    refused(&["--dataset", "npz", "--seed", "1"], "--split <NAME=SHARE,...>");
    refused(&["--frames", "another"], "another: expected a single log; only --dataset accepts several");
    refused(&["--dataset", "npz", "--task", "drill"], "--task needs --dataset lerobot");
    refused(&["--dataset", "npz", "--rate", "10"], "--rate needs --foxglove or --dataset lerobot");
    let lerobot = |flag: &str, value: &str, expected: &str| {
        refused(&["--dataset", "lerobot", flag, value], expected);
    };
    lerobot("--observation", "tensoin", "tensoin");
    lerobot("--action", "t_world_tip", "t_world_tip");
    lerobot("--controller", "nobody", "no controller `nobody`; the scene has reference");
    lerobot("--rate", "2.5", "--rate is 2.5; allowed: a whole number, 1 to 1000");
    lerobot("--split", "train=1", "--dataset lerobot does not use --split");
    lerobot("--from", "999999", "the logs have no rows in this range of ticks");
    let npz = |more: &[&str]| export(&[&["--dataset", "npz"], more].concat());
    let done = npz(&["--bone-from-hu", "-200", "--to", "100"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let about: serde_json::Value =
        serde_json::from_slice(&fs::read(output.join("dataset.json")).unwrap()).unwrap();
    assert_eq!(about["bone_from_hu"], -200);
    // 10 Hz.
    let frames = about["frames"].as_array().unwrap().iter().map(|frame| frame["tick"].as_u64().unwrap());
    assert_eq!(frames.collect::<Vec<_>>(), [0, 100]);
    let done = npz(&[]);
    assert!(done.code == Some(2) && done.err.contains("already exists"), "{}", done.err);
}

/// Runs of two scenes, one of them twice: runs that look alike go to the same part, in any order.
#[test]
fn a_data_set_of_several_runs_is_split_by_run() {
    let place = Place::new();
    let labels = "[drr.labels]\nbone_from_hu = 200\nimages = [\"bone_m\"]\n";
    let scenes = [(0.31, 'a'), (0.32, 'b'), (0.31, 'c'), (0.33, 'd'), (0.34, 'e'), (0.35, 'f')];
    for (duration_s, name) in scenes {
        let folder = place.complete(&(scenes::drill("lockstep", duration_s) + labels)).folder;
        fs::rename(folder, place.path(&name.to_string())).unwrap();
    }
    let export = |names: &str, set: &str, more: &[&str]| {
        let logs: Vec<_> = names.chars().map(|name| place.path(&name.to_string())).collect();
        let output = place.path(set);
        let export: [&dyn AsRef<std::ffi::OsStr>; 4] = [&"log", &"export", &"-o", &output];
        let done = trabecula(&[&export[..], &as_words(&logs), &as_words(more)].concat());
        assert_eq!(done.code, Some(0), "{}{}", done.out, done.err);
        output
    };
    let split = ["--split", "train=0.5,val=0.5", "--seed", "5"];
    let parts_of = |set: &std::path::Path| -> std::collections::BTreeMap<String, Vec<String>> {
        let text = fs::read(set.join("dataset.json")).unwrap();
        let about: serde_json::Value = serde_json::from_slice(&text).unwrap();
        assert_eq!(about["bone_from_hu"], 200);
        let mut parts = std::collections::BTreeMap::<String, Vec<String>>::new();
        for frame in about["frames"].as_array().unwrap() {
            let of = |key: &str| frame[key].as_str().unwrap().to_owned();
            assert!(of("file").starts_with(&of("split")) && set.join(of("file")).is_file());
            let of_run = parts.entry(of("run")).or_default();
            of_run.push(of("split"));
            of_run.dedup();
        }
        parts
    };
    let npz = [&["--dataset", "npz"], &split[..]].concat();
    let (some, all) = (parts_of(&export("abc", "some", &npz)), parts_of(&export("fedcab", "all", &npz)));
    // Two of three scenes, five of six; each stays in its part when others are added.
    assert_eq!((some.len(), all.len()), (2, 5));
    assert!(all.values().all(|parts| parts.len() == 1), "{all:?}");
    assert!(some.iter().all(|(run, part)| all[run] == *part), "{some:?} {all:?}");
    for name in ["train", "val"] {
        assert!(all.values().any(|parts| parts == &[name]), "seed 5 leaves {name} empty: {all:?}");
    }
    // The same bytes again, with the scene's label images and no others.
    let again = export("fedcab", "again", &npz);
    let file = "dataset.json";
    let bytes = |set: &std::path::Path, file: &str| fs::read(set.join(file)).unwrap();
    assert_eq!(bytes(&again, file), bytes(&place.path("all"), file));
    let frame: serde_json::Value = serde_json::from_slice(&bytes(&again, file)).unwrap();
    let first = frame["frames"][0]["file"].as_str().unwrap();
    let archive = bytes(&again, first);
    assert_eq!(archive, bytes(&place.path("all"), first));
    let holds = |name: &[u8]| archive.windows(name.len()).any(|window| window == name);
    assert!(holds(b"bone_m.npy") && !holds(b"tunnel_m.npy"));
    // One file per part; COCO's numbers restart in each.
    let coco = export("ab", "coco", &[&["--dataset", "coco"], &split[..]].concat());
    let mut images = 0;
    for name in ["train", "val"] {
        let text = bytes(&coco, &format!("annotations_{name}.json"));
        let about: serde_json::Value = serde_json::from_slice(&text).unwrap();
        for (index, image) in about["images"].as_array().unwrap().iter().enumerate() {
            assert_eq!(image["id"], index + 1);
            assert!(coco.join("images").join(image["file_name"].as_str().unwrap()).is_file());
            images += 1;
        }
    }
    assert_eq!(images, 10, "two runs of five frames");
    let yolo = export("ab", "yolo", &[&["--dataset", "yolo-segment"], &split[..]].concat());
    let about = String::from_utf8(bytes(&yolo, "data.yaml")).unwrap();
    assert!(
        about.contains("train: images/train\nval: images/val\n") && !about.contains("kpt_shape"),
        "{about}"
    );
}

/// Regression: a second log that was not accepted was detected only after the first one's files were written.
#[test]
fn a_log_that_cannot_be_taken_refuses_the_export_before_its_first_file() {
    let place = recorded();
    let (log, output, absent) = (place.path("run"), place.path("set"), place.path("absent"));
    let other = Place::new();
    let blind = other.complete(&scenes::drill_unseen("lockstep", 0.05)).folder;
    for (second, expected) in [(&absent, "cannot open the log"), (&blind, "the scene has no X-ray")] {
        let done = trabecula(&[&"log", &"export", &log, second, &"-o", &output, &"--dataset", &"coco"]);
        assert!(done.code == Some(2) && done.err.contains(expected), "{:?} {}", done.code, done.err);
        assert!(!output.exists(), "{expected}: something is left");
    }
}

/// The bead phantom of the example: the projection of each bead by the camera beside it.
#[test]
fn markers_are_in_both_descriptions_of_a_data_set_where_its_camera_puts_them() {
    let scene = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/examples/drr_objects.toml");
    let place = Place::new();
    let ended = Run::start(&scene, place.path("out"), &["--set", "run.duration_s=0.3"]).end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    for (format, file, frames) in [("npz", "dataset.json", "frames"), ("coco", "annotations.json", "images")]
    {
        let output = place.path(format);
        let done = trabecula(&[&"log", &"export", &ended.folder, &"-o", &output, &"--dataset", &format]);
        assert_eq!(done.code, Some(0), "{}", done.err);
        let about: serde_json::Value = serde_json::from_slice(&fs::read(output.join(file)).unwrap()).unwrap();
        let frame = &about[frames][0];
        let number = |value: &serde_json::Value| value.as_f64().unwrap();
        let row = |name: &str, i: usize, v: [f64; 3]| -> f64 {
            (0..3).map(|j| number(&frame["camera"][name][i][j]) * v[j]).sum()
        };
        let markers = frame["markers"].as_array().unwrap();
        assert_eq!(markers.len(), 6);
        for (marker, count) in markers.iter().zip(1..) {
            let centre_m = [0, 1, 2].map(|i| number(&marker["position_m"][i]));
            let shift = |i: usize| number(&frame["camera"]["translation_m"][i]);
            let seen = [0, 1, 2].map(|i| row("rotation", i, centre_m) + shift(i));
            let [u, v, s] = [0, 1, 2].map(|i| row("intrinsics", i, seen));
            let (column, line) = (number(&marker["column"]), number(&marker["row"]));
            assert!((column - u / s).abs() < 1e-9 && (line - v / s).abs() < 1e-9, "{format}: {marker}");
            assert_eq!(marker["name"], format!("bead_{count}"));
            assert_eq!(marker["visibility"], 2, "{format}: {marker}");
        }
    }
}
