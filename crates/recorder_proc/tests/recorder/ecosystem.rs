//! Common programs for opening logs: rosbags, rerun, pandas' Parquet reader, Lichtblick's layout, the guide.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use test_support::limited::Limited;

use crate::common::*;
use messages::TickRange;
use recorder_proc::log_file::LogFile;
use recorder_proc::parquet_file::Parquet;
use run_log::columns::{Rows, columns, description_of_topic, read_rows};
use run_log::{RUN_TOPICS, Topic, fields};
use serde_json::Value;
use test_support::python::or_skip;

/// The first two read a log in Python; `docs/logs.md` names them.
pub const PACKAGES: [&str; 5] =
    ["mcap==1.6.0", "mcap-ros2-support==0.6.0", "rosbags==0.11.9", "rerun-sdk==0.41.0", "pyarrow==26.0.1"];

/// A Python with all of the packages.
pub fn python() -> Option<PathBuf> {
    let modules = "mcap_ros2.reader, mcap_ros2.decoder, rosbags.highlevel, rerun, pyarrow";
    or_skip("log-readers", &PACKAGES, modules)
}

fn text(output: Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// A single test, so that the environment is created once.
#[test]
fn rosbags_rerun_pyarrow_and_the_guides_five_lines_read_a_log() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let steps = run_messages(250, None);
    let path = save(folder.path(), "run.mcap", &write_log(&steps));
    let states: Vec<_> =
        steps.iter().filter_map(|step| if let Step::State(s) = step { Some(s) } else { None }).collect();

    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/ecosystem.py");
    let output = Command::new(&python).arg(&script).arg(&path).arg(folder.path()).limited_output().unwrap();
    let printed = text(output);
    let lines: BTreeSet<&str> = printed.lines().collect();
    for reader in ["rosbags", "rerun"] {
        for (topic, count) in
            [("/state", 251), ("/latched", 250), ("/removed", 38), ("/drr/frame", 6), ("/drr/image", 6)]
        {
            assert!(
                lines.contains(format!("{reader} {topic} {count}").as_str()),
                "{reader} {topic}: {printed}"
            );
        }
    }
    for (number, state) in states.iter().enumerate() {
        let bits = state.t_world_link[7].position_m[2].to_bits();
        let line = format!("rosbags /state {number} {} {bits:016x}", state.tick);
        assert!(lines.contains(line.as_str()), "{line}");
    }
    assert!(lines.contains("rosbags /drr/image 0 mono16 20 32 1280"), "{printed}");

    parquet_is_read_by_pyarrow(&python, folder.path(), &path, states.len());
    the_guides_five_lines_run_as_written(&python, folder.path(), states.len());
}

fn parquet_is_read_by_pyarrow(python: &Path, folder: &Path, log: &Path, rows: usize) {
    let wanted = ["t_world_tip.position_m".to_owned(), "hash".to_owned()];
    let columns = columns(description_of_topic(&LogFile::at(log), "/state").unwrap(), &wanted).unwrap();
    let out = folder.join("state.parquet");
    let mut table = Parquet::new(std::fs::File::create(&out).unwrap(), &columns).unwrap();
    read_rows(&LogFile::at(log), "/state", &columns, TickRange::ALL, &mut table).unwrap();
    table.finish().unwrap();
    let script = "import sys, pyarrow.parquet as p; t = p.read_table(sys.argv[1]); \
                  print(t.num_rows, t.column_names, t['log_tick'][9].as_py())";
    let printed = text(Command::new(python).args(["-c", script]).arg(&out).limited_output().unwrap());
    let names = "['log_tick', 'log_time_ns', 't_world_tip.position_m[0]', 't_world_tip.position_m[1]', \
                 't_world_tip.position_m[2]', 'hash[0]', 'hash[1]']";
    assert_eq!(printed.trim_end(), format!("{rows} {names} 9"));
}

/// The first Python block of docs/logs.md, run beside a `run.mcap`.
fn the_guides_five_lines_run_as_written(python: &Path, folder: &Path, states: usize) {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/logs.md");
    let page = std::fs::read_to_string(page).unwrap();
    let block = page.split("```python\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    assert!(block.lines().filter(|line| !line.trim().is_empty()).count() <= 5, "five lines: {block}");
    for package in &PACKAGES[..2] {
        assert!(page.contains(package), "docs/logs.md names {package}");
    }
    let printed =
        text(Command::new(python).args(["-c", block]).current_dir(folder).limited_output().unwrap());
    assert_eq!(printed.lines().count(), states);
    assert!(printed.lines().last().unwrap().starts_with("0.25 "), "{printed}");
}

fn strings<'a>(value: &'a Value, out: &mut Vec<&'a str>) {
    match value {
        Value::String(text) => out.push(text),
        Value::Array(items) => items.iter().for_each(|item| strings(item, out)),
        Value::Object(map) => map.values().for_each(|item| strings(item, out)),
        _ => {}
    }
}

/// Every message path in the shipped layout names a topic and a field of this build.
#[test]
fn the_lichtblick_layout_names_topics_and_fields_that_exist() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../viewer_proc/lichtblick-layout.json");
    let layout: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let mut all = Vec::new();
    strings(&layout, &mut all);
    let (mut topics_seen, mut fields_seen) = (0, 0);
    for text in all.iter().filter(|text| text.starts_with('/')) {
        let (topic, field) =
            text.split_once('.').map_or((*text, None), |(topic, field)| (topic, Some(field)));
        let found = Topic::of_name(topic).filter(|found| RUN_TOPICS.contains(found));
        let description = found.unwrap_or_else(|| panic!("no topic {topic}")).description();
        topics_seen += 1;
        if let Some(field) = field {
            let place = fields::find(description, field).unwrap_or_else(|cause| panic!("{text}: {cause}"));
            assert!(place.array_length.is_none(), "{text} is a whole array: a plot needs one number");
            fields_seen += 1;
        }
    }
    assert!(topics_seen >= 8 && fields_seen >= 6);
    // Every panel of the arrangement is configured, and no others.
    let panels: BTreeSet<&str> =
        layout["configById"].as_object().unwrap().keys().map(String::as_str).collect();
    let mut arranged = Vec::new();
    strings(&layout["layout"], &mut arranged);
    let arranged: BTreeSet<&str> = arranged.into_iter().filter(|text| text.contains('!')).collect();
    assert_eq!(arranged, panels);
}

/// Each channel's metadata gives units, frame and layout; scene and calibration are attached.
#[test]
fn channels_say_their_units_and_layouts() {
    let bytes = write_log(&run_messages(5, None));
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    for channel in summary.channels.values() {
        let description = Topic::of_name(&channel.topic).unwrap().description();
        assert_eq!(channel.metadata["layout_hash"], description.layout_hash());
        assert!(channel.metadata["frame"].starts_with("world: patient, LPS"));
    }
    let state = summary.channels.values().find(|channel| channel.topic == "/state").unwrap();
    let units: BTreeSet<&str> = state.metadata["units"].lines().collect();
    for line in ["sim_time_s: s", "joint_velocity_rad_per_s: rad/s", "t_world_tip.position_m: m"] {
        assert!(units.contains(line), "{line} in {units:#?}");
    }
    let names: BTreeSet<&str> = summary.attachment_indexes.iter().map(|a| a.name.as_str()).collect();
    assert_eq!(names, BTreeSet::from(["calibration.json", "scene.toml"]));
    assert_eq!(open_bytes(&bytes).unwrap().header(), &header());
}
