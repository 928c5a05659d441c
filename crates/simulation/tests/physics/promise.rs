//! Foundations of replay: golden hashes of three short runs, and keyframes that continue bit for bit.
//!
//! The golden hashes are valid for one target and C library: Ruckig, which plans the arm's motion, takes
//! `cbrt`, `acos` and others from the C library. They change with the physics; the failing test prints the
//! new ones.
//!
//! The debug build gives the same hashes: `cargo test -p simulation --test physics promise` (about a minute
//! when cold).
#![allow(clippy::unwrap_used, missing_docs)]

use messages::{
    ARM_HOLD, ARM_MOVE_CP, ARM_MOVE_JP, Command, Latched, LatchedCommand, SOURCE_FRESH, SOURCE_HELD, State,
    TENDON_MOVE_JP, TENDON_SERVO_JF,
};
use scene::Scene;
use simulation::bone::GridGeometry;
use simulation::{CtView, Simulation};
use zerocopy::IntoBytes;

use crate::common::{TUNNEL, bone, feed_along_z, scene};

/// A loose block on a clamp in front of the burr, under gravity.
const BODIES: &str = r#"
name = "bodies"
run = { mode = "lockstep", duration_s = 1.0 }
gravity_m_per_s2 = [0.0, 0.0, 9.81]
[[body]]
name = "fragment"
cuboid = { half_extents_mm = [8.0, 8.0, 4.0] }
motion = "free"
position_mm = [1.0, 0.5, 7.6]
[[body]]
name = "clamp"
cuboid = { half_extents_mm = [20.0, 20.0, 5.0] }
motion = "fixed"
position_mm = [0.0, 0.0, 16.7]
"#;

/// Free space.
const FREE: &str = r#"
name = "free"
run = { mode = "lockstep", duration_s = 2.0 }
"#;

/// A short run: scene, whether in bone, commands, ticks, hash of the last state.
struct Golden {
    scene: &'static str,
    in_bone: bool,
    command: fn(u64, &State) -> Command,
    ticks: u64,
    hash: &'static str,
}

/// x86_64-unknown-linux-gnu, glibc.
const GOLDEN: [Golden; 3] = [
    Golden {
        scene: TUNNEL,
        in_bone: true,
        command: |_, start| feed_along_z(start),
        ticks: 1000,
        hash: "e46f95d702859a318a98a96742cce086",
    },
    Golden {
        scene: BODIES,
        in_bone: false,
        command: |_, start| feed_along_z(start),
        ticks: 600,
        hash: "1b7a719d953b69fa45e86a773229c657",
    },
    Golden {
        scene: FREE,
        in_bone: false,
        command: wander,
        ticks: 2000,
        hash: "dec4d82e09161db0acc069ddc29611d5",
    },
];

/// Joint moves, straight lines, stops, tendon moves: something new every 150 ticks.
fn wander(tick: u64, start: &State) -> Command {
    let leg = tick / 150;
    let sign = if leg.is_multiple_of(2) { 1.0 } else { -1.0 };
    let mut command = Command { sequence: leg + 1, tendon_mode: TENDON_SERVO_JF, ..Command::zeroed() };
    command.tendon_force_n[leg as usize % 2] = 1.0 + leg as f64;
    match leg % 4 {
        0 => {
            command.arm_mode = ARM_MOVE_JP;
            command.arm_joint_position_rad = start.arm_joint_position_rad;
            command.arm_joint_position_rad[2] += 0.05 * sign;
            command.arm_joint_position_rad[4] -= 0.1;
        }
        1 => {
            command.arm_mode = ARM_MOVE_CP;
            command.t_world_base = start.t_world_flange;
            command.t_world_base.position_m[0] += 0.01 * sign;
        }
        2 => {
            command.tendon_mode = TENDON_MOVE_JP;
            command.tendon_displacement_m = [2e-3, -2e-3, 0.0, 0.0];
        }
        _ => command.arm_mode = ARM_HOLD,
    }
    command
}

impl Golden {
    fn scene(&self) -> Scene {
        scene(self.scene)
    }

    fn simulation<'v>(&self, bone: &'v (GridGeometry, Vec<i16>)) -> Simulation<'v> {
        let ct = self.in_bone.then_some(CtView { geometry: bone.0, hu: &bone.1 });
        Simulation::new(&self.scene(), ct).unwrap()
    }

    /// u_k. Halfway through, the free-space run returns to its start.
    fn latched(&self, tick: u64, start: &State) -> Latched {
        let command = (self.command)(tick, start);
        let fresh = tick == 0 || command.sequence != (self.command)(tick - 1, start).sequence;
        let source = if fresh { SOURCE_FRESH } else { SOURCE_HELD };
        let reset = u32::from(self.scene == FREE && tick == self.ticks / 2);
        let mut latched = Latched { tick, controller_count: 1, reset, ..Latched::zeroed() };
        latched.commands[0] = LatchedCommand { source, controller_index: 0, age_ticks: 0, command };
        latched
    }

    /// Hash of the last state.
    fn run(&self) -> String {
        self.run_with(|_| {})
    }

    fn run_with(&self, prepare: impl FnOnce(&mut Simulation<'_>)) -> String {
        let bone = bone();
        let mut simulation = self.simulation(&bone);
        prepare(&mut simulation);
        let start = *simulation.state();
        let mut touched = false;
        for tick in 0..self.ticks {
            simulation.step(&self.latched(tick, &start)).unwrap();
            touched |= simulation.state().contact_count > 0;
        }
        let state = simulation.state();
        assert_eq!(touched, self.scene != FREE, "contacts");
        assert!(!self.in_bone || state.removed_total > 100, "{} voxels", state.removed_total);
        format!("{:016x}{:016x}", state.hash[1], state.hash[0])
    }
}

/// One after the other, two at once, four at once: a run does not depend on other work in its process.
#[test]
fn promise_10_machines_golden_hashes_of_three_scenes_for_1_2_and_4_threads() {
    let wanted = GOLDEN.map(|golden| golden.hash.to_owned());
    assert_eq!(GOLDEN.map(|golden| golden.run()), wanted, "on one thread");
    for threads in [2, 4] {
        let found = std::thread::scope(|scope| {
            let run = |index: usize| scope.spawn(move || GOLDEN[index % 3].run());
            let handles: Vec<_> = (0..threads).map(run).collect();
            handles.into_iter().map(|handle| handle.join().unwrap()).collect::<Vec<_>>()
        });
        for (index, hash) in found.iter().enumerate() {
            assert_eq!(*hash, wanted[index % 3], "thread {index} of {threads}");
        }
    }
}

/// Runs the loops that are compiled per instruction set with the oldest one.
#[test]
fn vector_instructions_change_no_golden_hash() {
    for golden in &GOLDEN {
        assert_eq!(
            golden.run_with(|simulation| simulation.use_plain_instructions()),
            golden.hash,
            "{}",
            golden.scene().name
        );
    }
}

/// A keyframe restored in a fresh simulation gives the same states, removed voxels and later keyframes.
#[test]
fn promise_5_save_and_restore_a_keyframe_at_any_tick_continues_bit_for_bit() {
    let bone = bone();
    for golden in &GOLDEN {
        let mut simulation = golden.simulation(&bone);
        let start = *simulation.state();
        let (mut saved, mut last) = (vec![0; 1 << 20], vec![0; 1 << 20]);
        let mut states = Vec::new();
        let mut keyframes = Vec::new();
        for tick in 0..golden.ticks {
            simulation.step(&golden.latched(tick, &start)).unwrap();
            states.push((*simulation.state(), simulation.removed().to_vec()));
            // No common divisor with the period of the commands.
            if tick % 97 == 13 {
                let length = simulation.write_keyframe(&mut saved).unwrap();
                keyframes.push((tick, saved[..length].to_vec()));
            }
        }
        let length = simulation.write_keyframe(&mut last).unwrap();
        let longest = keyframes.iter().map(|(_, bytes)| bytes.len()).max().unwrap();
        println!("{}: {} keyframes of {longest} bytes at most", golden.scene().name, keyframes.len());
        for (at, bytes) in &keyframes {
            let mut other = golden.simulation(&bone);
            other.restore_keyframe(bytes).unwrap();
            assert_eq!(other.state().as_bytes(), states[*at as usize].0.as_bytes());
            // Every fourth runs to the end; the others until the next keyframe.
            let end = if at % 4 == 1 { golden.ticks } else { golden.ticks.min(at + 98) };
            for tick in at + 1..end {
                other.step(&golden.latched(tick, &start)).unwrap();
                let (state, removed) = &states[tick as usize];
                assert_eq!(other.state().as_bytes(), state.as_bytes(), "from {at} to {tick}");
                assert_eq!(other.removed(), removed, "from {at} to {tick}");
            }
            if end == golden.ticks {
                let again = other.write_keyframe(&mut saved).unwrap();
                assert!(saved[..again] == last[..length], "from {at}: the last keyframe differs");
            }
        }
    }
}

#[test]
fn bytes_that_are_no_keyframe_of_the_scene_are_refused() {
    let bone = bone();
    let [drilling, bodies, free] = &GOLDEN;
    let mut buffer = vec![0; 1 << 20];
    let length = drilling.simulation(&bone).write_keyframe(&mut buffer).unwrap();
    let keyframe = &buffer[..length];
    for other in [bodies, free] {
        let refused = other.simulation(&bone).restore_keyframe(keyframe).unwrap_err().to_string();
        assert!(refused.contains("do not match this scene"), "{refused}");
    }
    for cut in (0..length).step_by(41) {
        assert!(drilling.simulation(&bone).restore_keyframe(&keyframe[..cut]).is_err(), "cut at {cut}");
    }
    let mut longer = keyframe.to_vec();
    longer.push(0);
    assert!(drilling.simulation(&bone).restore_keyframe(&longer).is_err());
    let short = drilling.simulation(&bone).write_keyframe(&mut [0; 1000]).unwrap_err().to_string();
    assert!(short.contains("larger than the 1000 bytes"), "{short}");
}
