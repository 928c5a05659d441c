//! Simulations in this process against the hub's own ticks, their logs, and each other.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail")]

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, LazyLock};

use controllers::built_in;
use hub::in_process::{Answer, InProcess};
use messages::{ArmMode, BurrMode, Command, State, TendonMode, Tick};
use recorder_proc::log_file::LogFile;
use run_log::LogReader;
use sim::{Batch, Drive, SharedScene, Sim, SimError, View};
use simulation::Simulation;
use tempfile::TempDir;
use test_support::scenes::{BLOCK, OPEN_LOOP, TOOL, x_ray};

/// The block, seen by a C-arm, and a controller that drills a curve into it.
static DRILL: LazyLock<String> = LazyLock::new(|| {
    let run = "name = \"drill\"\nrun = { mode = \"realtime\", duration_s = 0.8, seed = 7 }\n\
               recording = { keyframe_interval_s = 0.1 }\n";
    [run, BLOCK, &x_ray(10.0, 64), OPEN_LOOP].concat()
});

struct Place(TempDir);

impl Place {
    fn with(scene: &str) -> Place {
        let place = Place(tempfile::tempdir().unwrap());
        std::fs::write(place.path("scene.toml"), scene).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn scene(&self) -> Arc<SharedScene> {
        SharedScene::load(Some(&self.path("scene.toml")), &[], None).unwrap()
    }
}

/// The caller's command at a tick: pushes into the bone while the tension rises.
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

/// Steps with [`pushing`] up to a tick.
fn push(sim: &mut Sim, to: u64) -> [u64; 2] {
    while sim.state().tick < to {
        let command = pushing(sim.state().tick);
        sim.step(&[command], 1).unwrap();
    }
    sim.state().hash
}

fn hash_at(states: &[State], tick: u64) -> [u64; 2] {
    states[tick as usize].hash
}

#[test]
fn built_in_controllers_lead_to_the_hubs_own_ticks() {
    let place = Place::with(&DRILL);
    let shared = place.scene();
    let scene = shared.scene();
    let ct = simulation::CtView::from(&shared.ct().unwrap().volume);
    let mut run = InProcess::new(scene, Simulation::new(scene, Some(ct)).unwrap());
    let mut controller = built_in(scene, "reference", &|_| panic!("no calibration")).unwrap().unwrap();
    let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
    assert_eq!(sim.state().hash, [0; 2]);
    for _ in 0..800 {
        run.tick(|_, state, command| {
            controller.step(state, command);
            Answer::Command
        })
        .unwrap();
        sim.step(&[], 1).unwrap();
        assert_eq!(sim.state().hash, run.plant().state().hash, "tick {}", sim.state().tick);
    }
    assert!(sim.state().removed_total > 20 && sim.drilled().len() as u64 == sim.state().removed_total);
}

#[test]
fn a_snapshot_brings_back_every_later_tick_in_this_and_other_simulations() {
    let place = Place::with(&DRILL);
    let shared = place.scene();
    let mut sim = Sim::new(&shared, &Drive::Everything).unwrap();
    let mut taken = Vec::new();
    for tick in [0, 150, 500] {
        push(&mut sim, tick);
        taken.push(sim.snapshot());
    }
    let end = push(&mut sim, 700);
    let drilled = sim.drilled().to_vec();
    assert!(taken[2].state().removed_total > 0 && drilled.len() > taken[2].state().removed_total as usize);
    // Forward and backward, with an image in between.
    for index in [2, 0, 1, 2, 1] {
        sim.restore(&taken[index]).unwrap();
        assert_eq!(sim.state().hash, taken[index].state().hash);
        sim.render(View::Scene).unwrap();
        assert_eq!(push(&mut sim, 700), end, "from snapshot {index}");
        assert_eq!(sim.drilled(), drilled);
    }
    let mut other = Sim::new(&place.scene(), &Drive::Everything).unwrap();
    other.restore(&taken[1]).unwrap();
    let mut branch = other.branch().unwrap();
    assert_eq!([push(&mut other, 700), push(&mut branch, 700)], [end; 2]);
    branch.reset().unwrap();
    assert_eq!((branch.state().tick, push(&mut branch, 700)), (0, end));
}

#[test]
fn built_in_controllers_are_part_of_a_snapshot() {
    let place = Place::with(&DRILL);
    let mut sim = Sim::new(&place.scene(), &Drive::Nothing).unwrap();
    sim.step(&[], 300).unwrap();
    let here = sim.snapshot();
    sim.step(&[], 300).unwrap();
    let end = sim.state().hash;
    sim.restore(&here).unwrap();
    sim.step(&[], 300).unwrap();
    assert_eq!(sim.state().hash, end);
    let mut driven = Sim::new(&place.scene(), &Drive::Everything).unwrap();
    assert!(matches!(driven.restore(&here), Err(SimError::OtherScene)));
}

/// Creates a simulation with these settings; on the heap, because several fill a test's stack.
fn simulation_with(place: &Place, settings: &[&str]) -> Box<Sim> {
    let settings: Vec<String> = settings.iter().map(|line| (*line).to_owned()).collect();
    let shared = SharedScene::load(Some(&place.path("scene.toml")), &settings, None).unwrap();
    Box::new(Sim::new(&shared, &Drive::Everything).unwrap())
}

fn vector_bits(sim: &Sim) -> Vec<u64> {
    sim.snapshot().vector().iter().map(|value| value.to_bits()).collect()
}

const STIFFER: &str = "truth.manipulator.stiffness_scale=1.2";

/// A model that follows a plant with a softer tool. Without bone, of which the state vector has nothing, its
/// ticks are those of a simulation whose state vector was set to the plant's.
#[test]
fn a_model_goes_on_from_the_state_of_a_plant_with_its_own_parameters() {
    let run = "name = \"free\"\nrun = { mode = \"lockstep\", duration_s = 1.0 }\n";
    for model in ["planar", "spatial"] {
        let place = Place::with(&format!("{run}manipulator.model = \"{model}\"\n{TOOL}"));
        let mut plant = simulation_with(&place, &[]);
        push(&mut plant, 150);
        let mut followed = simulation_with(&place, &[STIFFER]);
        let mut set = simulation_with(&place, &[STIFFER]);
        followed.restore(&plant.snapshot()).unwrap();
        assert_eq!((vector_bits(&followed), followed.state().tick), (vector_bits(&plant), 150));
        assert_ne!(followed.state().hash, plant.state().hash, "no run leads here");
        push(&mut set, 150);
        assert_ne!(vector_bits(&set), vector_bits(&plant), "a stiffer tool bends less");
        let here = set.snapshot();
        set.restore_vector(&here, plant.snapshot().vector()).unwrap();
        for tick in [151, 300] {
            [&mut plant, &mut followed, &mut set].into_iter().for_each(|sim| {
                push(sim, tick);
            });
            assert_eq!(vector_bits(&followed), vector_bits(&set), "{model}: tick {tick}");
            assert_ne!(vector_bits(&followed), vector_bits(&plant));
        }
    }
}

/// In bone that the plant has drilled; and what does not fit.
#[test]
fn a_model_takes_over_the_drilled_bone_and_refuses_what_does_not_fit() {
    let place = Place::with(&DRILL);
    let mut plant = simulation_with(&place, &[]);
    push(&mut plant, 700);
    let (there, drilled) = (plant.snapshot(), plant.drilled().to_vec());
    let mut model = simulation_with(&place, &[STIFFER]);
    model.restore(&there).unwrap();
    assert!(!drilled.is_empty() && model.drilled() == drilled);
    let mut branch = Box::new(model.branch().unwrap());
    assert_eq!(push(&mut model, 800), push(&mut branch, 800));
    assert_ne!(push(&mut plant, 800), model.state().hash);
    model.reset().unwrap();
    assert_eq!((model.state().tick, model.state().hash), (0, [0; 2]));
    plant.reset().unwrap();
    model.restore(&plant.snapshot()).unwrap();
    let late = model.record(&place.path("no run begins so"));
    assert!(matches!(late, Err(SimError::RecordingElsewhere)), "{late:?}");
    let given = ["manipulator.model=\"modal\"", "truth.manipulator.stiffness_scale=1.0"];
    let modal = simulation_with(&place, &given[..1]);
    simulation_with(&place, &given).restore(&modal.snapshot()).unwrap();
    for (model, setting, key) in [
        ("planar", "truth.registration_error_mm=[0.5,0,0]", "truth.registration_error_mm"),
        ("planar", "truth.manipulator.burr_stall_torque_nmm=20", "truth.manipulator.burr_stall_torque_nmm"),
        ("spatial", "truth.drilling.side_force=true", "truth.drilling.side_force"),
        ("modal", STIFFER, "truth.manipulator.stiffness_scale"),
    ] {
        let model = format!("manipulator.model=\"{model}\"");
        let plant = simulation_with(&place, &[&model]);
        let mut other = simulation_with(&place, &[&model, setting]);
        let refused = other.restore(&plant.snapshot());
        assert!(matches!(&refused, Err(SimError::OtherTruth { .. })), "{setting}: {refused:?}");
        assert!(refused.unwrap_err().to_string().contains(key), "{setting}");
        assert_eq!(other.state().hash, [0; 2], "nothing has changed");
    }
    let other = simulation_with(&place, &["run.seed=8"]).restore(&there);
    assert!(matches!(other, Err(SimError::OtherScene)), "{other:?}");
}

#[test]
fn no_number_of_threads_changes_a_bit() {
    let place = Place::with(&DRILL);
    let shared = place.scene();
    let mut alone: Vec<Sim> = (0..5).map(|_| Sim::new(&shared, &Drive::Everything).unwrap()).collect();
    let command = |index: usize, tick: u64| {
        let mut command = pushing(tick);
        command.arm_speed_m_per_s *= 1.0 + 0.1 * index as f64;
        command
    };
    for (index, sim) in alone.iter_mut().enumerate() {
        for tick in (0..600).step_by(20) {
            sim.step(&[command(index, tick)], 20).unwrap();
        }
    }
    let hashes: Vec<_> = alone.iter().map(|sim| sim.state().hash).collect();
    assert!(hashes.windows(2).all(|pair| pair[0] != pair[1]));
    for threads in [1, 2, 3, 8] {
        let batch = Batch::new(&vec![Arc::clone(&shared); 5], &Drive::Everything, threads).unwrap();
        assert_eq!(batch.threads(), threads.min(5));
        for tick in (0..600).step_by(20) {
            let commands: Vec<_> = (0..5).map(|index| command(index, tick)).collect();
            batch.step(Some(commands), 20).unwrap();
        }
        assert_eq!(
            batch.states().unwrap().iter().map(|state| state.hash).collect::<Vec<_>>(),
            hashes,
            "{threads} threads"
        );
        // Restore all to the state of one.
        let one = batch.with(3, |sim| Ok(sim.snapshot())).unwrap();
        batch.restore(vec![one]).unwrap();
        assert!(batch.states().unwrap().iter().all(|state| state.hash == hashes[3]));
    }
    // One of several refuses its snapshot: the others keep their state.
    let moved = ["truth.registration_error_mm=[0.0,0.0,1.0]".to_owned()];
    let moved = SharedScene::load(Some(&place.path("scene.toml")), &moved, None).unwrap();
    let mixed = Batch::new(&[Arc::clone(&shared), moved], &Drive::Everything, 2).unwrap();
    let start = mixed.with(0, |sim| Ok(sim.snapshot())).unwrap();
    mixed.step(None, 10).unwrap();
    assert!(matches!(mixed.restore(vec![start]), Err(SimError::OtherTruth { .. })));
    assert!(mixed.states().unwrap().iter().all(|state| state.tick == 10));
}

#[test]
fn a_recording_is_a_log_that_leads_to_the_same_ticks_from_any_tick_on() {
    let place = Place::with(&DRILL);
    let shared = place.scene();
    for (drive, folder) in [(Drive::Everything, "driven"), (Drive::Nothing, "own")] {
        let mut sim = Sim::new(&shared, &drive).unwrap();
        let folder = place.path(folder);
        sim.record(&folder).unwrap();
        assert!(matches!(sim.record(&folder), Err(SimError::Recording { .. })));
        assert!(matches!(sim.reset(), Err(SimError::Recording { .. })));
        let mut states = vec![*sim.state()];
        for tick in 0..600 {
            let commands = if drive == Drive::Everything { vec![pushing(tick)] } else { Vec::new() };
            sim.step(&commands, 1).unwrap();
            states.push(*sim.state());
        }
        assert!(sim.close_recording().unwrap() && !sim.close_recording().unwrap());
        let mut reader = LogReader::open(&LogFile::at(folder.join("run.mcap"))).unwrap();
        let ticks: Vec<_> = reader.by_ref().map(Result::unwrap).collect();
        assert!(reader.ending().is_complete());
        assert!(ticks.iter().map(|tick| tick.state.hash).eq(states[1..].iter().map(|state| state.hash)));
        for from in [0, 1, 250, 600] {
            let mut branch = Sim::from_log(&folder, Some(from), &drive).unwrap();
            assert_eq!(branch.state().hash, hash_at(&states, from));
            let start = branch.drilled().len();
            if drive == Drive::Everything {
                push(&mut branch, 600);
            } else {
                branch.step(&[], 600 - from).unwrap();
            }
            assert_eq!(branch.state().hash, hash_at(&states, 600), "{drive:?} from tick {from}");
            assert_eq!(branch.drilled(), sim.drilled());
            branch.reset().unwrap();
            assert_eq!((branch.state().tick, branch.drilled().len()), (from, start));
        }
        let given_up = Sim::from_log_unless(&folder, None, &drive, &AtomicBool::new(true)).err().unwrap();
        assert!(matches!(given_up, SimError::GivenUp { tick: Tick(0) }), "{given_up}");
        let beyond = Sim::from_log(&folder, Some(601), &drive).err().unwrap().to_string();
        assert!(beyond.contains("tick 601 is not in") && beyond.contains("0 to 600"), "{beyond}");
        assert!(matches!(
            Sim::from_log(Path::new("/nowhere"), None, &drive),
            Err(SimError::Input(_) | SimError::Log(_))
        ));
    }
    let mut late = Sim::new(&shared, &Drive::Nothing).unwrap();
    late.step(&[], 1).unwrap();
    assert!(matches!(late.record(&place.path("late")), Err(SimError::RecordingLate { .. })));
    assert!(!place.path("late").exists());
    let mut again = Sim::new(&shared, &Drive::Nothing).unwrap();
    assert!(matches!(again.record(&place.path("own")), Err(SimError::Output(_))));
}

#[test]
fn a_recording_that_nobody_closes_is_whole() {
    let place = Place::with(&DRILL);
    let mut sim = Sim::new(&place.scene(), &Drive::Nothing).unwrap();
    sim.record(&place.path("out")).unwrap();
    sim.step(&[], 10).unwrap();
    assert!(!place.path("out/run.mcap").exists());
    drop(sim);
    let mut reader = LogReader::open(&LogFile::at(place.path("out/run.mcap"))).unwrap();
    assert_eq!(reader.by_ref().count(), 10);
    assert!(reader.ending().is_complete());
}

#[test]
fn a_refused_command_changes_nothing() {
    let place = Place::with(&DRILL);
    let shared = place.scene();
    let mut sim = Sim::new(&shared, &Drive::Everything).unwrap();
    let mut other = Sim::new(&shared, &Drive::Everything).unwrap();
    push(&mut sim, 50);
    push(&mut other, 50);
    let mut wrong = pushing(50);
    wrong.tendon_force_n[0] = 61.0;
    let said = sim.step(&[wrong], 5).unwrap_err().to_string();
    assert_eq!(said, "tick 50: controller `reference`: `tendon_force_n[0]` is 61; allowed: 0 to 60");
    assert!(matches!(sim.step(&[], 1), Err(SimError::CommandCount { given: 0, .. })));
    assert_eq!(push(&mut sim, 120), push(&mut other, 120));
    let said = Sim::new(&shared, &Drive::These(vec!["nobody".to_owned()])).err().unwrap().to_string();
    assert_eq!(said, "no controller `nobody`, expected one of the scene's: `reference`");
}

#[test]
fn an_optional_controller_joins_with_its_first_command() {
    let second = "[[controller]]\nname = \"later\"\ndrives = []\nexternal = true\noptional = true\n";
    let place = Place::with(&format!("{}{second}", *DRILL));
    let mut sim = Sim::new(&place.scene(), &Drive::Everything).unwrap();
    sim.record(&place.path("out")).unwrap();
    sim.step(&[pushing(0), Command::zeroed()], 3).unwrap();
    sim.close_recording().unwrap();
    let reader = LogReader::open(&LogFile::at(place.path("out/run.mcap"))).unwrap();
    let sequences = reader.map(|record| {
        let [first, second, ..] = record.unwrap().latched.commands;
        (first.command.sequence, second.command.sequence)
    });
    assert_eq!(sequences.collect::<Vec<_>>(), [(1, 0), (2, 0), (3, 0)]);
}

/// Regression: an image of an earlier state showed holes that were drilled later.
#[test]
fn a_picture_after_a_jump_is_that_of_a_simulation_that_never_jumped() {
    let place = Place::with(&DRILL);
    let shared = place.scene();
    let picture = |sim: &mut Sim| sim.render(View::Scene).unwrap().pixels;
    let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
    sim.step(&[], 500).unwrap();
    let (here, before) = (sim.snapshot(), picture(&mut sim));
    sim.step(&[], 300).unwrap();
    let after = picture(&mut sim);
    assert_ne!(before, after);
    sim.restore(&here).unwrap();
    assert_eq!(picture(&mut sim), before);
    let aside = sim.render(View::Angles { primary_deg: 30.0, secondary_deg: -10.0 }).unwrap();
    assert_eq!(sim.render(View::Geometry(aside.frame.geometry)).unwrap().pixels, aside.pixels);
    assert_eq!(picture(&mut sim), before);
    sim.step(&[], 300).unwrap();
    assert_eq!(picture(&mut sim), after);
}

#[test]
fn pictures_from_many_c_arms_are_those_from_each_and_change_nothing() {
    let place = Place::with(&DRILL);
    let shared = place.scene();
    let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
    let angles = |primary_deg: f64, secondary_deg: f64| View::Angles { primary_deg, secondary_deg };
    let from =
        [angles(30.0, -10.0), View::Scene, angles(-75.0, 5.0), angles(30.0, -10.0), angles(160.0, 40.0)];
    for _ in 0..2 {
        // Drilling continues between the two.
        sim.step(&[], 400).unwrap();
        let (state, scenes) = (*sim.state(), sim.render(View::Scene).unwrap());
        let many = sim.render_many(&from).unwrap();
        let sequences: Vec<u64> = many.iter().map(|one| one.frame.sequence).collect();
        let next = scenes.frame.sequence + 1;
        assert_eq!(sequences, (next..next + 5).collect::<Vec<u64>>());
        for (view, got) in from.iter().zip(&many) {
            let want = sim.render(*view).unwrap();
            assert!(got.pixels == want.pixels, "{view:?}");
            assert_eq!(got.frame.pixel_hash, want.frame.pixel_hash);
            assert_eq!(got.frame.geometry, want.frame.geometry);
        }
        assert!(*sim.state() == state && sim.render(View::Scene).unwrap().pixels == scenes.pixels);
    }
    let refused = sim.render_many(&[View::Scene, angles(f64::NAN, 0.0)]).unwrap_err().to_string();
    assert!(refused.contains("frame 1 of the batch"), "{refused}");
    assert!(sim.render_many(&[]).unwrap().is_empty());
}

/// Regression: in Python, Ctrl-C was delayed until the last of many frames.
#[test]
fn many_pictures_are_given_up_when_asked_to_and_their_number_changes_none() {
    let place = Place::with(&DRILL);
    let mut sim = Sim::new(&place.scene(), &Drive::Nothing).unwrap();
    sim.step(&[], 400).unwrap();
    let view = |n: usize| View::Angles { primary_deg: n as f64, secondary_deg: 0.0 };
    let from: Vec<View> = (0..150).map(view).collect();
    let given_up = sim.render_many_unless(&from, &AtomicBool::new(true)).unwrap_err();
    assert!(matches!(given_up, SimError::GivenUp { .. }), "{given_up}");
    // Drilling has continued: the next images must show the voxels of that state.
    sim.step(&[], 400).unwrap();
    let many = sim.render_many(&from).unwrap();
    assert!(many.windows(2).all(|pair| pair[1].frame.sequence == pair[0].frame.sequence + 1));
    for n in [0, 63, 64, 149] {
        assert!(many[n].pixels == sim.render(from[n]).unwrap().pixels, "frame {n}");
    }
    let wrong = [&from[..], &[View::Angles { primary_deg: f64::NAN, secondary_deg: 0.0 }]].concat();
    let refused = sim.render_many(&wrong).unwrap_err().to_string();
    assert!(refused.contains("frame 150 of the batch"), "{refused}");
}

#[test]
fn scenes_of_the_same_synthetic_volume_share_it() {
    let place = Place::with(&DRILL);
    let (one, other) = (place.scene(), place.scene());
    assert!(std::ptr::eq(one.hu(), other.hu()));
    let settings = ["volume.spacing_mm=1.5".to_owned()];
    let coarser = SharedScene::load(Some(&place.path("scene.toml")), &settings, None).unwrap();
    assert!(coarser.hu().len() < one.hu().len());
}
