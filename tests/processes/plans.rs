//! Plans from 3D Slicer, and results for independent peers: `slicerio`, `trimesh`, `vtk`, `nibabel`.

use std::path::{Path, PathBuf};
use std::process::Command;

use parquet::file::reader::{FileReader, SerializedFileReader};
use serde_json::Value;
use test_support::python::or_skip;

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Ended, Place, Run, succeed, trabecula};
use crate::languages::output_within_limit;

/// Largest distance from its target at which a planned drilling may end, mm, as the issue requires.
const WITHIN_MM: f64 = 1.0;

fn slicer() -> Option<PathBuf> {
    let packages = ["slicerio==1.4.0", "trimesh==5.2.0", "vtk==9.5.2", "nibabel==5.4.2", "numpy==2.3.5"];
    or_skip("slicerio-1.4.0", &packages, "slicerio, trimesh, vtkmodules.vtkIOXML, nibabel")
}

fn peer(python: &Path, words: &[&dyn AsRef<std::ffi::OsStr>]) -> Value {
    let mut command = Command::new(python);
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/processes/plans.py"));
    words.iter().for_each(|word| _ = command.arg(word));
    serde_json::from_str(&output_within_limit(&mut command)).unwrap()
}

fn pelvis(place: &Place) -> PathBuf {
    let ct = place.path("pelvis.nrrd");
    succeed(&[&"phantom", &"pelvis", &"-o", &ct]);
    ct
}

fn three(value: &Value) -> [f64; 3] {
    serde_json::from_value(value.clone()).unwrap()
}

fn apart(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|axis| (a[axis] - b[axis]).powi(2)).sum::<f64>().sqrt()
}

/// Creates a scene from a plan, runs it, and returns the distance of the burr's end from the target, mm.
fn drilled(place: &Place, plan: &str, ct: &Path, target_mm: [f64; 3]) -> (Ended, f64) {
    let scene = place.path("scene.toml");
    let done =
        trabecula(&[&"scene", &"from-markups", &place.path(plan), &"--ct", &ct, &"-o", &scene, &"--json"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let said: Value = serde_json::from_str(&done.out).unwrap();
    // Sums of a few numbers of three digits round by less than a nanometre.
    assert!(apart(three(&said["target_mm"]), target_mm) < 1e-9, "{said}");
    succeed(&[&"scene", &"check", &scene]);
    let ended = Run::start(&scene, place.path("out"), &[]).end_well();
    let last = read(&ended.folder).ticks.last().unwrap().state;
    assert!(last.removed_total > 100, "{} voxels drilled", last.removed_total);
    let burr_mm = last.t_world_burr.position_m.map(|x| 1e3 * x);
    std::fs::remove_file(&scene).unwrap();
    (ended, apart(burr_mm, target_mm))
}

#[test]
fn a_plan_of_slicer_is_drilled_to_its_target_and_what_was_made_opens_there() {
    let Some(python) = slicer() else { return };
    let place = Place::new();
    let ct = pelvis(&place);
    let targets = peer(&python, &[&"plan", &place.path(""), &"RAS"]);
    let (ended, off_mm) = drilled(&place, "curve.mrk.json", &ct, three(&targets["curve"]));
    println!("curve on the phantom: {off_mm:.3} mm off");
    assert!(off_mm < WITHIN_MM, "{off_mm} mm off the target");
    assert_replays(&ended.folder);
    assert_exports(&python, &place, &ended.folder, three(&targets["curve"]), off_mm);

    peer(&python, &[&"plan", &place.path(""), &"LPS"]);
    for name in ["line", "deep"] {
        std::fs::remove_dir_all(place.path("out")).unwrap();
        let (_, off_mm) = drilled(&place, &format!("{name}.fcsv"), &ct, three(&targets[name]));
        println!("{name} on the phantom: {off_mm:.3} mm off");
        assert!(off_mm < WITHIN_MM, "{name}: {off_mm} mm off the target");
    }
}

/// Regression: a plan with entry and target exchanged was accepted, and the scene of a plan whose arm would
/// be in bone got a warning that named the value that cures it.
#[test]
fn exchanged_points_are_reported_and_the_arm_is_kept_out_of_bone() {
    let place = Place::new();
    let ct = place.path("pelvis.nrrd");
    let done = trabecula(&[&"phantom", &"pelvis", &"-o", &ct, &"--spacing-mm", &"2"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    // The line of `plans.py`, from the lateral cortex through the neck of the femur.
    let [outside, inside] = [[-150.2, -135.1, 101.5], [-112.3, -141.4, 112.7]];
    let made = |name: &str, entry: [f64; 3], target: [f64; 3]| {
        let point =
            |number, [x, y, z]: [f64; 3], name| format!("{number},{x},{y},{z},0,0,0,1,1,1,0,{name},,\n");
        let lines = [point(1, entry, "entry"), point(2, target, "target")].concat();
        let (plan, scene) = (place.path(&format!("{name}.fcsv")), place.path(&format!("{name}.toml")));
        std::fs::write(&plan, format!("# CoordinateSystem = LPS\n{lines}")).unwrap();
        // The checks are the subject; a prediction of a tool that starts inside bone takes minutes.
        let done =
            trabecula(&[&"scene", &"from-markups", &plan, &"--ct", &ct, &"-o", &scene, &"--no-simulate"]);
        assert_eq!(done.code, Some(0), "{name}: {}", done.err);
        (done.out + &done.err, std::fs::read_to_string(&scene).unwrap(), scene)
    };
    let (said, text, _) = made("usual", outside, inside);
    assert!(!said.contains("exchanged") && !text.contains("[arm]"), "{said}\n{text}");
    let (said, ..) = made("exchanged", inside, outside);
    assert!(said.contains("are entry and target exchanged?"), "{said}");
    // From below, where the arm's wrist would be in the femur.
    let (said, text, scene) = made("below", [-99.0, -143.0, 70.0], [-99.0, -143.0, 110.0]);
    assert!(!said.contains("arm.tool_position_mm"), "{said}");
    let line = text.lines().find(|line| line.starts_with("tool_position_mm = ")).expect("the arm is moved");
    std::fs::write(&scene, text.replace(line, "")).unwrap();
    let checked = trabecula(&[&"scene", &"check", &scene]);
    assert!(
        (checked.out + &checked.err).contains("`arm.tool_position_mm` is [0, 0, 0]"),
        "without it: {text}"
    );
}

/// Uses the position of the CT of `configs/pelvis_ct.toml`.
#[test]
fn a_plan_of_slicer_on_a_real_ct_is_drilled_to_its_target() {
    let data = std::env::var_os("TRABECULA_SHARED_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let ct = data.join("totalsegmentator_example/example_ct.nii.gz");
    if !ct.exists() {
        println!("\n*** SKIPPED: {} is absent; set TRABECULA_SHARED_DATA ***\n", ct.display());
        return;
    }
    let Some(python) = slicer() else { return };
    let place = Place::new();
    let targets = peer(&python, &[&"plan", &place.path(""), &"RAS"]);
    let (_, off_mm) = drilled(&place, "curve.mrk.json", &ct, three(&targets["curve"]));
    println!("curve on the real CT: {off_mm:.3} mm off");
    assert!(off_mm < WITHIN_MM, "{off_mm} mm off the target");
}

/// Exports everything in a log, and compares what the peers read.
fn assert_exports(python: &Path, place: &Place, log: &Path, target_mm: [f64; 3], off_mm: f64) {
    let folder = place.path("results");
    std::fs::create_dir(&folder).unwrap();
    let export = |what: &str, name: &str| {
        let done =
            trabecula(&[&"log", &"export", &log, &"-o", &folder.join(name), &"--geometry", &what, &"--json"]);
        assert_eq!(done.code, Some(0), "{name}: {}", done.err);
        serde_json::from_str::<Value>(&done.out).unwrap()
    };
    for ending in ["stl", "obj", "vtp"] {
        export("tool", &format!("tool.{ending}"));
        export("tunnel", &format!("tunnel.{ending}"));
    }
    let tunnel = export("tunnel", "again.stl");
    for (what, name) in [
        ("burr-path", "burr.mrk.json"),
        ("planned-path", "plan.fcsv"),
        ("deviation", "deviation.vtp"),
        ("deviation", "deviation.csv"),
    ] {
        export(what, name);
    }
    let deviation = export("deviation", "deviation.parquet");
    for name in ["drilled.nrrd", "drilled.nii.gz"] {
        succeed(&[&"volume", &"drilled", &log, &"-o", &folder.join(name)]);
    }
    let seen = peer(python, &[&"read", &folder]);
    println!("{tunnel}\n{deviation}\n{seen}");

    // The surface rounds off the edges of voxels: for voxels of 1 mm and a tunnel of 7 mm, by less than 8 %.
    let (removed_mm3, surface_mm3) =
        (tunnel["removed_volume_mm3"].as_f64().unwrap(), tunnel["surface_volume_mm3"].as_f64().unwrap());
    assert!((0.92..=1.0).contains(&(surface_mm3 / removed_mm3)), "{surface_mm3} of {removed_mm3} mm³");
    for ending in ["stl", "obj", "vtp"] {
        let theirs = seen[format!("tunnel.{ending}")]["volume_mm3"].as_f64().unwrap();
        // STL and trimesh use single precision; vtkMassProperties averages three projections.
        assert!((theirs / surface_mm3 - 1.0).abs() < 1e-3, "{ending}: {theirs} {surface_mm3}");
    }
    let volumes =
        ["stl", "obj", "vtp"].map(|ending| seen[format!("tool.{ending}")]["volume_mm3"].as_f64().unwrap());
    assert!(volumes.iter().all(|volume| (volume / volumes[0] - 1.0).abs() < 0.02), "{volumes:?}");
    assert_eq!(
        (&seen["burr.mrk.json"]["frame"], &seen["burr.mrk.json"]["type"]),
        (&"LPS".into(), &"Curve".into())
    );
    let burr_mm = three(&seen["burr.mrk.json"]["last_mm"]);
    assert!((apart(burr_mm, target_mm) - off_mm).abs() < 1e-9, "{burr_mm:?}");
    assert_eq!(seen["plan.fcsv"]["frame"], "LPS");
    assert!(apart(three(&seen["plan.fcsv"]["last_mm"]), target_mm) < 1e-9);
    assert_eq!((&seen["deviation"]["lines"], &seen["deviation"]["same"]), (&1.into(), &true.into()));
    assert!(
        seen["deviation"]["last_mm"].as_f64().unwrap() <= off_mm + 1e-9,
        "the way in ends nearest to the target"
    );
    let table = std::fs::File::open(folder.join("deviation.parquet")).unwrap();
    let rows = SerializedFileReader::new(table).unwrap().metadata().file_metadata().num_rows();
    assert_eq!((seen["deviation"]["rows"].as_i64(), deviation["rows"].as_i64()), (Some(rows), Some(rows)));
    assert_eq!(seen["drilled"]["same_voxels"], true);
    // Single precision of NIfTI at 0.3 m.
    assert!(seen["drilled"]["apart_mm"].as_f64().unwrap() < 1e-4, "{}", seen["drilled"]);
}

#[test]
fn a_segment_of_slicer_is_bone_by_its_name() {
    let Some(python) = slicer() else { return };
    let place = Place::new();
    let (ct, bones) = (place.path("ct.nrrd"), place.path("bones.seg.nrrd"));
    succeed(&[&"phantom", &"pelvis", &"-o", &ct, &"--spacing-mm", &"2"]);
    assert_eq!(peer(&python, &[&"segment", &ct, &bones])["segments"], serde_json::json!(["hip bone"]));
    peer(&python, &[&"plan", &place.path(""), &"LPS"]);
    let (plan, scene) = (place.path("curve.mrk.json"), place.path("seg.toml"));
    let from = |segment: &str| {
        trabecula(&[&"scene", &"from-markups", &plan, &"--ct", &bones, &"--segment", &segment, &"-o", &scene])
    };
    let done = from("femur");
    assert!(done.code == Some(2) && done.err.contains("hip bone") && !scene.exists(), "{}", done.err);
    let done = from("hip bone");
    assert_eq!(done.code, Some(0), "{}", done.err);
    let text = std::fs::read_to_string(&scene).unwrap();
    assert!(text.contains("mask = true") && text.contains("label = \"hip bone\""), "{text}");
    assert!(
        text.contains("path = \"bones.seg.nrrd\"") && text.contains("plan = \"curve.mrk.json\""),
        "{text}"
    );
    succeed(&[&"scene", &"check", &scene]);
    // Drilled, too: bone of the segment is removed, and the log replays from the same file.
    let ended = Run::start(&scene, place.path("out"), &["--set", "run.duration_s=3.0"]).end_well();
    assert!(read(&ended.folder).ticks.last().unwrap().state.removed_total > 0, "nothing was drilled");
    assert_replays(&ended.folder);
}
