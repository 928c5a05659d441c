//! Data sets of labelled frames, as pycocotools, OpenCV and NumPy read them.

use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;
use std::process::Command;

use test_support::python::or_skip;

use crate::common::program::{Place, trabecula};
use crate::common::scenes;
use crate::languages::{clients, output_of};

const FORMATS: [&str; 4] = ["coco", "yolo", "yolo-seg", "npz"];

/// A recorded run of the block in `run`.
fn recorded() -> Place {
    let place = Place::new();
    let folder = place.complete(&scenes::drill("lockstep", 0.6)).folder;
    fs::rename(folder, place.path("run")).unwrap();
    place
}

#[test]
fn pycocotools_opencv_and_numpy_find_in_a_data_set_what_is_in_its_log() {
    let packages = ["numpy==2.2.6", "opencv-python-headless==4.12.0.88", "pycocotools==2.0.10"];
    let Some(python) = or_skip("labels-1", &packages, "numpy, cv2, pycocotools.coco") else { return };
    let place = recorded();
    for format in FORMATS {
        let (log, output) = (place.path("run"), place.path(format));
        let done = trabecula(&[&"log", &"export", &log, &"-o", &output, &"--dataset", &format]);
        assert_eq!(done.code, Some(0), "{format}: {}{}", done.out, done.err);
    }
    let mut command = Command::new(python);
    command.arg(clients().join("python/tests/datasets.py")).arg(place.path(""));
    command.env("TRABECULA_PROGRAM", env!("CARGO_BIN_EXE_trabecula"));
    assert_eq!(output_of(&mut command), "done\n");
}

#[test]
fn a_data_set_takes_an_empty_folder_and_a_threshold_and_refuses_what_it_cannot_make() {
    let place = recorded();
    let (log, output) = (place.path("run"), place.path("set"));
    fs::create_dir(&output).unwrap();
    let refused = |words: &[&str], expected: &str| {
        let mut all: Vec<&dyn AsRef<std::ffi::OsStr>> = vec![&"log", &"export", &log, &"-o", &output];
        all.extend(words.iter().map(|word| word as &dyn AsRef<std::ffi::OsStr>));
        let done = trabecula(&all);
        assert!(
            done.code == Some(2) && done.err.contains(expected),
            "{words:?}: {:?} {}",
            done.code,
            done.err
        );
        assert_eq!(fs::read_dir(&output).unwrap().count(), 0, "{words:?} has written something");
    };
    refused(&["--dataset", "voc"], "[possible values: coco, yolo, yolo-seg, npz]");
    refused(&["--dataset", "npz", "--frames"], "cannot be used with");
    refused(&["--bone-from-hu", "200"], "--dataset <FORMAT>");
    refused(&["--dataset", "npz", "--bone-from-hu", "40000"], "40000");
    refused(&["--dataset", "npz", "--split", "train=0.5,val=0.4"], "0.9, expected 1");
    refused(&["--dataset", "npz", "--split", "train=0.5,test=0.5"], "2 parts of 1 different runs");
    refused(&["--dataset", "yolo", "--split", "train=1"], "needs a part `val`");
    refused(&["--split", "train=1"], "--dataset <FORMAT>");
    refused(&["--dataset", "npz", "--seed", "3"], "--split");
    refused(&["--dataset", "npz", "--from", "999999"], "no frames for these ticks");
    let npz = |more: &[&str]| {
        let mut all: Vec<&dyn AsRef<std::ffi::OsStr>> =
            vec![&"log", &"export", &log, &"-o", &output, &"--dataset", &"npz"];
        all.extend(more.iter().map(|word| word as &dyn AsRef<std::ffi::OsStr>));
        trabecula(&all)
    };
    let done = npz(&["--bone-from-hu", "-200", "--to", "100"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let about: serde_json::Value =
        serde_json::from_slice(&fs::read(output.join("dataset.json")).unwrap()).unwrap();
    assert_eq!(about["bone_from_hu"], -200);
    assert!(about["frames"].as_array().unwrap().iter().all(|frame| frame["tick"].as_u64().unwrap() <= 100));
    let done = npz(&[]);
    assert!(done.code == Some(2) && done.err.contains("already exists"), "{}", done.err);
}

/// Frames of one run look alike: whoever trains on some of them and judges by others is deceived.
#[test]
fn a_data_set_of_several_runs_is_split_by_runs() {
    let place = Place::new();
    // A place tells one run's folder.
    let runs = [0.2, 0.25, 0.3, 0.35].map(|duration_s| {
        let own = Place::new();
        let folder = own.complete(&scenes::drill("lockstep", duration_s)).folder;
        (folder, own)
    });
    let [first, second, third, fourth] = runs.each_ref().map(|(folder, _)| folder);
    let export = |name: &str, format: &str, seed: &str| {
        let output = place.path(name);
        let done = trabecula(&[
            &"log",
            &"export",
            first,
            second,
            third,
            fourth,
            &"-o",
            &output,
            &"--dataset",
            &format,
            &"--split",
            &"train=0.5,val=0.25,test=0.25",
            &"--seed",
            &seed,
        ]);
        assert_eq!(done.code, Some(0), "{}{}", done.out, done.err);
        output
    };
    let json =
        |path: PathBuf| -> serde_json::Value { serde_json::from_slice(&fs::read(path).unwrap()).unwrap() };
    let coco = export("coco", "coco", "1");
    let parts = [("train", 2), ("val", 1), ("test", 1)].map(|(part, count)| {
        let about = json(coco.join(format!("annotations_{part}.json")));
        let own: BTreeSet<u64> =
            about["images"].as_array().unwrap().iter().map(|image| image["run"].as_u64().unwrap()).collect();
        assert_eq!(own.len(), count, "{part}");
        for image in about["images"].as_array().unwrap() {
            let name = image["file_name"].as_str().unwrap();
            assert!(name.starts_with(&format!("run_{:04}_", image["run"].as_u64().unwrap())), "{name}");
            assert!(coco.join("images").join(name).is_file());
            assert_eq!(about["info"]["runs"][image["run"].as_u64().unwrap() as usize - 1]["part"], part);
        }
        let images: BTreeSet<u64> =
            about["images"].as_array().unwrap().iter().map(|image| image["id"].as_u64().unwrap()).collect();
        for annotation in about["annotations"].as_array().unwrap() {
            assert!(
                images.contains(&annotation["image_id"].as_u64().unwrap()),
                "{part}: of another part's image"
            );
        }
        own
    });
    assert_eq!(parts.iter().flatten().collect::<BTreeSet<_>>().len(), 4, "a run is in two parts: {parts:?}");
    assert!(!coco.join("annotations.json").exists());

    // The same runs in the same parts, whatever the format.
    let npz = export("npz", "npz", "1");
    let about = json(npz.join("dataset.json"));
    for frame in about["frames"].as_array().unwrap() {
        let (file, part) = (frame["file"].as_str().unwrap(), frame["part"].as_str().unwrap());
        assert!(npz.join(file).is_file() && file.starts_with(part), "{file}");
        let number = ["train", "val", "test"].iter().position(|name| *name == part).unwrap();
        assert!(parts[number].contains(&frame["run"].as_u64().unwrap()), "{file}");
    }
    let yolo = export("yolo", "yolo-seg", "1");
    let about = fs::read_to_string(yolo.join("data.yaml")).unwrap();
    for part in ["train", "val", "test"] {
        assert!(about.contains(&format!("\n{part}: images/{part}\n")), "{about}");
        let names = |of: &str| -> BTreeSet<String> {
            let entries = fs::read_dir(yolo.join(of).join(part)).unwrap().flatten();
            entries.map(|entry| entry.path().file_stem().unwrap().to_string_lossy().into_owned()).collect()
        };
        assert!(!names("images").is_empty() && names("images") == names("labels"), "{part}");
    }
    let other = json(export("other", "npz", "2").join("dataset.json"));
    assert_ne!(other["runs"], json(npz.join("dataset.json"))["runs"], "the seed changes nothing");
}
