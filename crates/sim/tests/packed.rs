//! Simulations as bytes: they continue bit for bit, and damaged or foreign bytes are refused.

#![allow(clippy::unwrap_used, reason = "tests fail")]

use std::sync::Arc;

use messages::{ArmMode, BurrMode, Command, TendonMode};
use sim::{Drive, SharedScene, Sim, SimError, Snapshot};
use test_support::scenes::{BLOCK, LATE_SENSORS, x_ray};
use xxhash_rust::xxh3::xxh3_64;

const DRILLS: &str = "
[controller.curved_drilling]
feed_mm_per_s = 15.0
insertion_mm = 20.0
tension_n = 6.0
ramp_start_mm = 1.0
ramp_end_mm = 15.0
burr_speed_rpm = 8000.0
target_mm = [4.0, 0.0, -16.0]
guidance_gain_n_per_mm = 2.0
";

/// The block, seen by a C-arm and by sensors, with a controller.
fn scene(controller: &str) -> Arc<SharedScene> {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("scene.toml");
    let run = "name = \"packed\"\nrun = { mode = \"lockstep\", duration_s = 1.0, seed = 7 }\n";
    let mine = "[[controller]]\nname = \"mine\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n";
    let text = [run, BLOCK, &x_ray(20.0, 64), LATE_SENSORS, mine, controller].concat();
    std::fs::write(&file, text).unwrap();
    SharedScene::load(Some(&file), &["contact.friction=0.25".to_owned()], Some(11)).unwrap()
}

/// Drills with a tension that rises.
fn pushing(tick: u64) -> Command {
    let mut command = Command {
        tendon_mode: TendonMode::ServoJf.code(),
        arm_mode: ArmMode::Insert.code(),
        arm_axis: [0.0, 0.0, 1.0],
        arm_depth_m: 0.012,
        arm_speed_m_per_s: 0.012,
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: 800.0,
        ..Command::zeroed()
    };
    command.tendon_force_n[0] = 0.005 * tick as f64;
    command
}

/// Runs one tick; returns what it leads to.
fn ticked(sim: &mut Sim) -> ([u64; 2], usize, Vec<f64>) {
    let command = pushing(sim.state().tick);
    let given = if sim.driven().is_empty() { &[][..] } else { std::slice::from_ref(&command) };
    sim.step(given, 1).unwrap();
    let readings = sim.readings().iter().flat_map(|reading| reading.values().to_vec()).collect();
    (sim.state().hash, sim.drilled().len(), readings)
}

#[test]
fn every_controller_continues_from_bytes_with_the_same_hashes_readings_and_voxels() {
    let controllers = [
        "external = true\n".to_owned(),
        format!("{DRILLS}feedback = \"image\"\n"),
        format!("sensors = [\"shape\", \"tracker\"]\n{DRILLS}feedback = \"shape\"\n"),
        "[controller.skiving]\ndepth_mm = 8.0\nfeed_mm_per_s = 12.0\ntension_n = 2.0\nburr_speed_rpm = 8000.0\n"
            .to_owned(),
        "[controller.tension_sweep]\nmost_n = 6.0\nstep_n = 1.0\nsettle_s = 0.04\n".to_owned(),
        "hold = { tension_n = 3.0 }\n".to_owned(),
    ];
    for controller in controllers {
        let shared = scene(&controller);
        let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
        let mut packed = Vec::new();
        let expected: Vec<_> = (0..1000)
            .map(|tick| {
                if [0, 1, 55, 700, 999].contains(&tick) {
                    packed.push((tick, sim.packed().unwrap(), sim.snapshot().packed().unwrap()));
                }
                ticked(&mut sim)
            })
            .collect();
        let drills = controller.contains("drilling") || controller.contains("external");
        assert!(!drills || sim.drilled().len() > 20, "{controller}: {} voxels", sim.drilled().len());
        for (tick, of_sim, of_snapshot) in packed {
            let mut continued = Sim::of_packed(&of_sim).unwrap();
            for (index, expected) in expected.iter().enumerate().skip(tick) {
                assert_eq!(&ticked(&mut continued), expected, "{controller} from {tick}, tick {index}");
            }
            assert_eq!(continued.drilled(), sim.drilled());
            continued.reset().unwrap();
            assert_eq!(ticked(&mut continued), expected[0], "{controller}");
            // A snapshot fits the simulation that it was taken from.
            sim.restore(&Snapshot::of_packed(&of_snapshot).unwrap()).unwrap();
            (tick..1000).for_each(|index| assert_eq!(ticked(&mut sim), expected[index], "{controller}"));
        }
    }
}

#[test]
fn a_reset_returns_to_the_start_that_the_bytes_hold() {
    let shared = scene("external = true\n");
    let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
    let folder = tempfile::tempdir().unwrap();
    sim.record(folder.path()).unwrap();
    (0..300).for_each(|_| drop(ticked(&mut sim)));
    sim.close_recording().unwrap();
    let mut middle = Sim::from_log(folder.path(), Some(200), &Drive::Nothing).unwrap();
    let hash = middle.state().hash;
    (0..50).for_each(|_| drop(ticked(&mut middle)));
    let mut continued = Sim::of_packed(&middle.packed().unwrap()).unwrap();
    assert_eq!(continued.state().hash, middle.state().hash);
    continued.reset().unwrap();
    assert_eq!((continued.state().tick, continued.state().hash), (200, hash));
}

#[test]
fn bytes_that_are_not_a_simulation_of_this_build_are_refused() {
    let shared = scene(&format!("{DRILLS}feedback = \"image\"\n"));
    let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
    sim.step(&[], 200).unwrap();
    let packed = sim.packed().unwrap();
    let summed = |mut bytes: Vec<u8>| {
        let sum = xxh3_64(&bytes[8..]).to_le_bytes();
        bytes[..8].copy_from_slice(&sum);
        bytes
    };
    let refused = |bytes: &[u8], part: &str| {
        let error = Sim::of_packed(bytes).map(|_| ()).unwrap_err();
        assert!(matches!(error, SimError::Packed(_)) && error.to_string().contains(part), "{error}");
    };
    for length in (0..packed.len()).step_by(packed.len() / 40) {
        refused(&packed[..length], "damaged");
        if length > 8 {
            assert!(Sim::of_packed(&summed(packed[..length].to_vec())).is_err(), "{length}");
        }
    }
    for at in (0..packed.len()).step_by(packed.len() / 100) {
        let mut changed = packed.clone();
        changed[at] ^= 1 << (at % 8);
        refused(&changed, "damaged");
        // With a right checksum, as an attacker would set it: an error or another state, and no panic.
        drop(Sim::of_packed(&summed(changed)));
    }
    let mut other = packed.clone();
    let version = other.windows(2).position(|pair| pair == b"0.").unwrap();
    other[version] = b'9';
    refused(&summed(other), "packed by another build (9.");
    let mut longer = packed.clone();
    longer.push(0);
    refused(&summed(longer), "1 byte too many");
    let elsewhere = Sim::new(&scene("external = true\n"), &Drive::Nothing).unwrap();
    let error = sim.restore_keyframe(&elsewhere.keyframe().unwrap()).unwrap_err();
    assert!(error.to_string().contains("of another scene"), "{error}");
    assert_eq!(sim.packed().unwrap(), packed, "a refusal changes nothing");
}
