//! Reads the same files in another language: `mcap-ros2-support` for Python.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use fastrand::Rng;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;
use test_support::limited::Limited;

use crate::common::*;
use crate::ecosystem::{PACKAGES, python};
use ipc_types::messages::layout::{Description, Element, Message};
use ipc_types::messages::*;
use run_log::*;
use zerocopy::{FromBytes, IntoBytes};

/// The scalars of a message as the Python script prints them, read from the struct's bytes using its
/// description.
fn expected(description: &'static Description, bytes: &[u8], prefix: &str, out: &mut BTreeSet<String>) {
    for field in description.schema_fields() {
        let size = field.size / field.array_length.unwrap_or(1);
        for i in 0..field.array_length.unwrap_or(1) {
            let index = field.array_length.map_or(String::new(), |_| format!("[{i}]"));
            let path = format!("{prefix}{}{index}", field.name);
            let part = &bytes[field.offset + i * size..field.offset + (i + 1) * size];
            let text = match field.element {
                Element::Message(nested) => {
                    expected(nested, part, &format!("{path}."), out);
                    continue;
                }
                Element::Scalar("float64") => {
                    format!("{:016x}", u64::from_le_bytes(part.try_into().unwrap()))
                }
                Element::Scalar("uint64") => u64::from_le_bytes(part.try_into().unwrap()).to_string(),
                Element::Scalar("uint32") => u32::from_le_bytes(part.try_into().unwrap()).to_string(),
                Element::Scalar(other) => panic!("{other}: say here how Python prints it"),
            };
            out.insert(format!("{path} {text}"));
        }
    }
}

/// A state with random bits in every field. Exponents stay below that of infinity and NaN.
fn random_state(random: &mut Rng, tick: u64, removed: u32) -> State {
    let words: Vec<u64> = (0..State::DESCRIPTION.size / 8).map(|_| random.u64(..) & !(1 << 62)).collect();
    let mut state = State::read_from_bytes(words.as_bytes()).unwrap();
    (state.tick, state.removed_in_tick) = (tick, removed);
    state
}

fn add(out: &mut BTreeSet<String>, prefix: &str, fields: BTreeSet<String>) {
    out.extend(fields.into_iter().map(|field| format!("{prefix} {field}")));
}

#[test]
fn python_decodes_every_field_of_states_removals_and_images() {
    let Some(python) = python() else { return };
    let mut random = Rng::with_seed(3);
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    let mut wanted = BTreeSet::new();
    for tick in 0..4u64 {
        let voxels: Vec<u32> = (0..tick).map(|_| random.u64(..) as u32).collect();
        let mut state = random_state(&mut random, tick, voxels.len() as u32);
        state.removed_total = tick << 40;
        if tick > 0 {
            log.latched(&latched(tick - 1)).unwrap();
            log.removed(&removed_bytes(tick, tick, tick << 40, &voxels)).unwrap();
            let prefix = format!("/removed {}", tick - 1);
            wanted.insert(format!("{prefix} tick {tick}"));
            wanted.insert(format!("{prefix} removed_total {}", tick << 40));
            wanted.extend(voxels.iter().enumerate().map(|(i, v)| format!("{prefix} voxel_index[{i}] {v}")));
            let mut fields = BTreeSet::new();
            expected(Latched::DESCRIPTION, latched(tick - 1).as_bytes(), "", &mut fields);
            add(&mut wanted, &format!("/latched {}", tick - 1), fields);
        }
        log.state(&state).unwrap();
        let mut fields = BTreeSet::new();
        expected(State::DESCRIPTION, state.as_bytes(), "", &mut fields);
        add(&mut wanted, &format!("/state {tick}"), fields);
        wanted.insert(format!("/state {tick} log_time {}", tick * 1_000_000));
    }
    let payload = frame_bytes(1, 3, 5, 3);
    log.frame(&payload).unwrap();
    let image = "/drr/image 0";
    wanted.insert(format!("{image} header.frame_id \"c_arm_0\""));
    wanted.insert(format!("{image} header.stamp.nanosec 3000000"));
    for (name, value) in
        [("height", "3"), ("width", "5"), ("encoding", "\"mono16\""), ("is_bigendian", "0"), ("step", "10")]
    {
        wanted.insert(format!("{image} {name} {value}"));
    }
    let pixels = &payload[payload.len() - 30..];
    wanted.extend(pixels.iter().enumerate().map(|(i, byte)| format!("{image} data[{i}] {byte}")));
    wanted.insert("/drr/frame 0 sequence 1".to_string());
    wanted.insert("/drr/frame 0 geometry.columns 5".to_string());
    wanted.insert("metadata end".to_string());
    wanted.insert("metadata trabecula".to_string());
    wanted.insert(format!("attachment scene.toml {}", header().scene_toml.len()));

    let folder = tempfile::tempdir().unwrap();
    let bytes = log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1;
    let path = save(folder.path(), "run.mcap", &bytes);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/read_log.py");
    let output = Command::new(&python).arg(script).arg(&path).limited_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let printed: BTreeSet<String> =
        String::from_utf8(output.stdout).unwrap().lines().map(str::to_string).collect();
    let missing: Vec<&String> = wanted.difference(&printed).take(10).collect();
    assert!(missing.is_empty(), "Python does not see {missing:#?}");
    println!(
        "{} values agree bit for bit with {:?}; {} lines printed",
        wanted.len(),
        &PACKAGES[..2],
        printed.len()
    );
}
