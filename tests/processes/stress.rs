//! The stress test, its neighbours, its output; priorities of the parts; the doctor.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use test_support::limited::end_within;

use ipc_types::process::ProcessorTime;
use rustix::process::{Pid, Signal, getpriority_process};
use serde_json::Value;

use crate::common::client::Client;
use crate::common::logs::assert_replays;
use crate::common::program::{Done, LIMIT, Place, processes_with, signal, succeed, trabecula, wait_for};
use crate::common::scenes;

/// Returns the report folders of a place, in the order of their names.
fn reports(place: &Place) -> Vec<PathBuf> {
    let mut folders: Vec<PathBuf> = fs::read_dir(place.path("out"))
        .map(|entries| entries.flatten().map(|entry| entry.path()).collect())
        .unwrap_or_default();
    folders.sort();
    folders
}

fn json(folder: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(folder.join("stress.json")).unwrap()).unwrap()
}

fn stress(place: &Place, more: &[&str]) -> Done {
    let (scene, out) = (place.path("scene.toml"), place.path("out"));
    let mut arguments: Vec<&dyn AsRef<std::ffi::OsStr>> = vec![&"stress", &scene, &"--output", &out];
    more.iter().for_each(|argument| arguments.push(argument));
    trabecula(&arguments)
}

/// Returns the sum of the numbers of a JSON object.
fn sum(object: &Value) -> f64 {
    object.as_object().unwrap().values().map(|value| value.as_f64().unwrap()).sum()
}

fn assert_measured(tested: &Value, ticks: u64) {
    let measured = &tested["measured"];
    assert_eq!(tested["failure"], Value::Null, "{tested:#}");
    assert_eq!((&measured["replays"], &measured["log_complete"]), (&true.into(), &true.into()), "{tested:#}");
    assert_eq!((&measured["ticks"], &measured["dropped"]), (&ticks.into(), &0.into()), "{tested:#}");
    for quantity in ["lateness_us", "step_us", "latch_age_us"] {
        let q = &measured[quantity];
        assert_eq!(q["count"], ticks, "{quantity} of {tested:#}");
        let values = ["p50", "p90", "p99", "p99_9", "max"].map(|name| q[name].as_f64().unwrap());
        assert!(values.is_sorted(), "{quantity}: {values:?}");
    }
    assert!(measured["round_trip_us"]["count"].as_u64().unwrap() > 0, "{tested:#}");
    assert!(measured["frame_age_us"]["count"].as_u64().unwrap() > 0, "{tested:#}");
    // Every miss has a cause.
    assert_eq!(sum(&measured["misses"]["by_cause"]), measured["missed"].as_f64().unwrap(), "{tested:#}");
    for part in ["physics", "reference", "recorder", "drr", "launcher"] {
        assert!(measured["processor_share"][part].is_number(), "{part} of {tested:#}");
    }
}

#[test]
fn a_stress_test_measures_replays_reports_and_compares() {
    let place = Place::new();
    place.scene(&scenes::drill("lockstep", 1.0));
    let few = ["--cores", "1", "--wait", "hybrid", "--seconds", "0.4"];
    let first = stress(&place, &[&few[..], &["--load", "none"]].concat());
    assert_eq!(first.code, Some(0), "{}{}", first.out, first.err);
    assert!(first.err.contains("[1/1] 1 core, load none, other, hybrid; about"), "{}", first.err);
    let old = reports(&place)[0].join("stress.json");
    let old = old.to_str().unwrap().to_owned();
    let more = ["--load", "none,spin:2", "--policy", "fifo,other", "--subset", "2", "--compare", &old];
    let second = stress(&place, &[&few[..], &more].concat());
    assert_eq!(second.code, Some(0), "{}{}", second.out, second.err);
    let folder = reports(&place).into_iter().find(|folder| !Path::new(&old).starts_with(folder)).unwrap();
    let report = json(&folder);
    let tested = report["tested"].as_array().unwrap();
    assert_eq!((report["planned"].as_u64(), tested.len()), (Some(2), 2));
    tested.iter().for_each(|tested| assert_measured(tested, 400));
    let loads: Vec<&str> = tested.iter().map(|t| t["combination"]["load"].as_str().unwrap()).collect();
    assert!(loads.contains(&"spin:2") && loads.contains(&"none"), "pairs are spread: {loads:?}");
    assert_eq!(report["machine"]["findings"].as_array().unwrap().len(), 12);

    let csv = fs::read_to_string(folder.join("stress.csv")).unwrap();
    let columns: Vec<usize> = csv.lines().map(|line| line.split(',').count()).collect();
    assert_eq!(columns, [15 + 5 * 5; 3], "{csv}");
    let page = fs::read_to_string(folder.join("index.html")).unwrap();
    assert_eq!(page.matches("<svg").count(), 3, "a map and a figure a combination");
    assert!(!page.contains("src=") && !page.contains("<link"), "it needs no other file");
    assert!(page.contains("Change since") && page.contains("preemption model") && !page.contains("NaN"));
    assert_eq!(fs::read_dir(&folder).unwrap().count(), 6, "page, JSON, CSV, map, two figures, and no logs");
}

#[test]
fn an_interrupted_stress_test_keeps_what_is_done_and_leaves_no_neighbour() {
    let place = Place::new();
    let scene = place.scene(&scenes::drill("lockstep", 1.0));
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("stress").arg(&scene).arg("--output").arg(place.path("out"));
    command.args([
        "--cores",
        "1",
        "--load",
        "memory,disk,fork,spin",
        "--wait",
        "spin,event",
        "--seconds",
        "0.2",
    ]);
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let report = wait_for("the first combination", || {
        reports(&place).into_iter().find(|folder| folder.join("index.html").exists())
    });
    signal(child.id(), Signal::INT);
    let status = wait_for("the end of the test", || child.try_wait().unwrap());
    assert_eq!(status.code(), Some(130));
    let kept = json(&report);
    let done = kept["tested"].as_array().unwrap();
    assert!(kept["planned"] == 8 && !done.is_empty() && done.len() < 8, "{} done", done.len());
    done.iter().for_each(|tested| assert_eq!(tested["measured"]["replays"], true, "{tested:#}"));
    let page = fs::read_to_string(report.join("index.html")).unwrap();
    assert!(page.contains(&format!("{} of 8 combinations (interrupted)", done.len())));
    assert_eq!(processes_with(&[report.to_str().unwrap()]).len(), 0);
}

/// Returns a number in a file of `/proc/PID`, after a name.
fn number_of(pid: u32, file: &str, name: &str) -> u64 {
    let text = fs::read_to_string(format!("/proc/{pid}/{file}")).unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix(name));
    line.and_then(|rest| rest.split_whitespace().next()?.parse().ok()).unwrap_or(0)
}

#[test]
fn each_neighbour_does_what_its_name_says_until_its_limit() {
    let place = Place::new();
    type Sign = fn(u32) -> bool;
    let kinds: [(&str, Sign); 4] = [
        ("spin", |pid| !processor_time(pid).own.is_zero()),
        ("memory", |pid| number_of(pid, "status", "VmRSS:") >= 64 << 10),
        ("disk", |pid| number_of(pid, "io", "write_bytes:") >= 1 << 20),
        // The processor time of its children.
        ("fork", |pid| !processor_time(pid).children.is_zero()),
    ];
    for (kind, sign) in kinds {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.args(["load", kind, "--seed", "7", "--limit-s", "1", "--folder"]).arg(place.path(""));
        let mut child = command.spawn().unwrap();
        wait_for(kind, || sign(child.id()).then_some(()));
        let status = wait_for("its limit", || child.try_wait().unwrap());
        assert_eq!(status.code(), Some(0), "{kind}");
    }
    assert_eq!(place.entries(), Vec::<String>::new(), "a load leaves no file");
}

fn processor_time(pid: u32) -> ProcessorTime {
    ProcessorTime::of(&pid.to_string()).expect("a process that runs")
}

#[test]
fn a_killed_stress_test_leaves_no_neighbour() {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 1.0));
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("stress").arg(&scene).arg("--output").arg(place.path("out"));
    command.args(["--cores", "1", "--load", "fork:2", "--seconds", "60"]);
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let folder = wait_for("the report's folder", || reports(&place).into_iter().next());
    let word = folder.to_str().unwrap().to_owned();
    // Two neighbours and a launcher with its parts.
    wait_for("its processes", || (processes_with(&[&word]).len() >= 3).then_some(()));
    child.kill().unwrap();
    end_within(&mut child, LIMIT, "the stress test");
    wait_for("the end of them all", || (processes_with(&[&word]).is_empty()).then_some(()));
}

#[test]
fn bad_stress_arguments_are_refused_with_what_is_allowed() {
    let place = Place::new();
    place.scene(&scenes::hold("lockstep", 1.0));
    let external = place.path("external.toml");
    fs::write(&external, scenes::piloted("realtime", 1.0, "")).unwrap();
    fs::write(place.path("list.json"), "[\"milk\"]").unwrap();
    let before = place.entries();
    let list = place.path("list.json").to_str().unwrap().to_owned();
    let cases: [(&[&str], &str); 11] = [
        (&["--cores", "0"], "--cores is 0; allowed on this machine: 1 to"),
        (&["--cores", "1,9999"], "--cores is 9999; allowed on this machine: 1 to"),
        (&["--load", "burn"], "unknown load `burn`; expected `none`, `spin`"),
        (&["--load", "none,spin:0"], "unknown load `spin:0`"),
        (&["--policy", "rr"], "[possible values: other, fifo]"),
        (&["--wait", "sleep"], "[possible values: spin, event, hybrid]"),
        (&["--seconds", "0"], "--seconds is 0; allowed: 0.1 to 3600"),
        (&["--seconds", "nan"], "--seconds is NaN; allowed: 0.1 to 3600"),
        (&["--subset", "0"], "--subset"),
        (&["--compare", "/no/such.json"], "--compare /no/such.json: No such file"),
        (&["--compare", &list], "expected the stress.json of a stress test"),
    ];
    for (arguments, words) in cases {
        let done = stress(&place, arguments);
        assert_eq!(done.code, Some(2), "{arguments:?}: {}", done.err);
        assert!(done.err.contains(words), "{arguments:?}: {words} in {}", done.err);
    }
    let done = trabecula(&[&"stress", &external, &"--output", &place.path("out")]);
    assert_eq!(done.code, Some(2), "{}", done.err);
    assert!(done.err.contains("controller `pilot` is external"), "{}", done.err);
    let done = trabecula(&[&"doctor", &"--seconds", &"-1"]);
    assert_eq!(done.code, Some(2), "{}", done.err);
    assert_eq!(place.entries(), before, "something was written");
}

/// Under overload a part yields to those before it: physics, controller, recorder, DRR, launcher.
#[test]
fn parts_in_real_time_have_priorities_in_their_order_and_misses_have_causes() {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    let client = Client::at(&run, 50);
    let nice = |pid: u32| getpriority_process(Pid::from_raw(pid as i32)).unwrap();
    let parts = ["physics", "controller", "recorder", "drr"].map(|name| nice(run.part(name)));
    let launcher = nice(run.pid());
    // Without autogroups there is no such file, or one group for all.
    let group = |name: &str| fs::read_to_string(format!("/proc/{}/autogroup", run.part(name)));
    let switched_on =
        fs::read_to_string("/proc/sys/kernel/sched_autogroup_enabled").is_ok_and(|on| on.trim() == "1");
    if switched_on {
        for (name, nice) in ["physics", "controller", "recorder", "drr"].into_iter().zip(parts) {
            let group = group(name).unwrap();
            assert!(group.trim().ends_with(&format!(" nice {nice}")), "{name}: {group}");
        }
    }
    drop(client);
    signal(run.pid(), Signal::INT);
    let ended = run.end();
    assert_eq!(ended.code, Some(130), "{}", ended.err);
    // Without the right to more weight the first three have 0.
    assert!(parts == [-15, -10, -5, 5] || parts == [0, 0, 0, 5], "{parts:?}");
    assert_eq!(launcher, 10);
    assert_replays(&ended.folder);
    let info = trabecula(&[&"log", &"info", &ended.folder]);
    assert!(info.out.contains("late ticks  ") && info.out.contains(" missed ("), "{}", info.out);
    let timing = &ended.summary()["timing"];
    assert_eq!(sum(&timing["misses"]["by_cause"]), timing["missed_ticks"].as_f64().unwrap(), "{timing:#}");
}

#[test]
fn the_doctor_says_what_each_thing_costs_and_what_grants_it() {
    let done = succeed(&[&"doctor", &"--json", &"--seconds", &"0.05"]);
    let facts: Value = serde_json::from_str(&done.out).unwrap();
    let findings = facts["findings"].as_array().unwrap();
    let names: Vec<&str> = findings.iter().map(|finding| finding["name"].as_str().unwrap()).collect();
    let expected = [
        "SCHED_FIFO",
        "nice below 0",
        "mlockall",
        "affinity",
        "control groups",
        "huge pages",
        "/dev/shm",
        "address space",
        "memory",
        "clock source",
        "preemption model",
        "steal",
    ];
    assert_eq!(names, expected);
    for finding in findings {
        for key in ["found", "cost", "grant"] {
            assert!(!finding[key].as_str().unwrap().is_empty(), "{key} of {finding}");
        }
    }
    let people = trabecula(&[&"doctor", &"--seconds", &"0"]);
    assert!(names.iter().all(|name| people.out.contains(&format!("{name}: "))), "{}", people.out);
}
