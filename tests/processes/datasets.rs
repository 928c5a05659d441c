//! Data sets of labelled frames, as pycocotools, OpenCV and NumPy read them.

use std::fs;
use std::process::Command;

use test_support::python::or_skip;

use crate::common::program::{Place, trabecula};
use crate::common::scenes;
use crate::languages::{clients, output_of};

const FORMATS: [&str; 3] = ["coco", "yolo", "npz"];

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
    refused(&["--dataset", "voc"], "[possible values: coco, yolo, npz]");
    refused(&["--dataset", "npz", "--frames"], "cannot be used with");
    refused(&["--bone-from-hu", "200"], "--dataset <FORMAT>");
    refused(&["--dataset", "npz", "--bone-from-hu", "40000"], "40000");
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
