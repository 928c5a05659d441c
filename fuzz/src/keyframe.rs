//! Keyframes: the physics' own bytes in a log, which may have been altered.

use std::cell::RefCell;
use std::panic::{self, AssertUnwindSafe};
use std::path::Path;

use ipc_types::messages::{
    ARM_MOVE_CP, BURR_SPEED, Command, Latched, LatchedCommand, SOURCE_FRESH, State, TENDON_SERVO_JF,
};
use ipc_types::scene::Scene;
use nalgebra::Vector3;
use simulation::bone::GridGeometry;
use simulation::{CtView, Simulation, SimulationSnapshot};
use test_support::scenes::TOOL;

/// Bone, bodies, elastic joints, and each kind of manipulator: everything that a keyframe can contain.
const SCENES: [&str; 5] = [
    r#"
name = "bone"
run = { mode = "lockstep", duration_s = 1.0 }
volume = { phantom = "block" }
"#,
    r#"
name = "bodies"
run = { mode = "lockstep", duration_s = 1.0 }
gravity_m_per_s2 = [0.0, 0.0, 9.81]
manipulator = { model = "spatial", links = 8 }
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
"#,
    r#"
name = "elastic"
run = { mode = "lockstep", duration_s = 1.0 }
manipulator = { model = "full", links = 6 }
[arm]
max_speed_mm_per_s = 10.0
max_acceleration_mm_per_s2 = 100.0
max_jerk_mm_per_s3 = 1000.0
tool_position_mm = [0.0, 0.0, 100.0]
tool_rotation_vector_deg = [0.0, 0.0, 0.0]
[arm.compliance]
joint_stiffness_nm_per_rad = [1e4, 1e4, 1e4, 1e3, 1e3, 1e3]
joint_damping_nms_per_rad = [10.0, 10.0, 10.0, 1.0, 1.0, 1.0]
"#,
    r#"
name = "arc"
run = { mode = "lockstep", duration_s = 1.0 }
manipulator = { model = "constant_curvature" }
"#,
    r#"
name = "modes"
run = { mode = "lockstep", duration_s = 1.0 }
manipulator = { model = "modal" }
"#,
];

/// Longest keyframe of these scenes in bytes.
const LONGEST: usize = 1 << 20;

struct World {
    // Boxed and built one at a time: four of 105 kB each, moved a few times, would overflow a thread's stack
    // of 2 MB.
    simulation: Box<Simulation<'static>>,
    initial: SimulationSnapshot,
    start: State,
    has_bodies: bool,
}

impl World {
    fn new(text: &str) -> World {
        let scene = Scene::parse(&format!("{text}{TOOL}"), Path::new("fuzz.toml")).unwrap();
        let ct = scene.volume.is_some().then(ct);
        let simulation = Box::new(Simulation::new(&scene, ct).unwrap());
        let (initial, start) = (simulation.snapshot(), *simulation.state());
        World { simulation, initial, start, has_bodies: !scene.body.is_empty() }
    }

    fn replay(&mut self, bytes: &[u8]) {
        self.simulation.restore(&self.initial).unwrap();
        if self.simulation.restore_keyframe(bytes).is_err() {
            return;
        }
        let mut again = vec![0; LONGEST];
        let length = self.simulation.write_keyframe(&mut again).unwrap();
        self.simulation.restore_keyframe(&again[..length]).unwrap();
        for tick in 0..3 {
            let latched = if tick == 1 { self.feed(tick) } else { Latched::zeroed() };
            if self.simulation.step(&latched).is_err() {
                return;
            }
        }
    }

    /// 3 mm/s along +z with the burr on and 3 N on tendon 0.
    fn feed(&self, tick: u64) -> Latched {
        let mut goal = self.start.t_world_flange;
        goal.position_m[2] += 0.02;
        let command = Command {
            sequence: 1,
            tendon_mode: TENDON_SERVO_JF,
            tendon_force_n: [3.0, 0.0, 0.0, 0.0],
            arm_mode: ARM_MOVE_CP,
            t_world_base: goal,
            arm_speed_m_per_s: 3e-3,
            burr_mode: BURR_SPEED,
            burr_speed_rad_per_s: 800.0,
            ..Command::zeroed()
        };
        let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
        latched.commands[0] =
            LatchedCommand { source: SOURCE_FRESH, controller_index: 0, age_ticks: 0, command };
        latched
    }
}

/// A few voxels of bone in front of the burr.
fn ct() -> CtView<'static> {
    static HU: [i16; 16 * 16 * 12] = [400; 16 * 16 * 12];
    let origin = Vector3::new(-3.75e-3, -3.75e-3, 3.4e-3);
    CtView { geometry: GridGeometry::axis_aligned([16, 16, 12], [0.5e-3; 3], origin), hu: &HU }
}

thread_local! {
    static WORLDS: RefCell<Vec<World>> = RefCell::new(SCENES.iter().map(|text| World::new(text)).collect());
}

/// The first byte selects the scene; the rest is the keyframe. An accepted keyframe leads to ticks, and is
/// written again as a keyframe that is accepted. The world of rigid bodies belongs to Rapier, and only Rapier
/// could check its tables: if it panics, a replay reports that and continues (`run_log::segments`), and so
/// does this target.
pub fn keyframe(data: &[u8]) {
    let Some((scene, bytes)) = data.split_first() else { return };
    WORLDS.with_borrow_mut(|worlds| {
        let index = usize::from(*scene) % worlds.len();
        let world = &mut worlds[index];
        if world.has_bodies {
            if quietly(|| world.replay(bytes)).is_err() {
                *world = World::new(SCENES[index]);
            }
        } else {
            world.replay(bytes);
        }
    });
}

/// Runs an action that may panic; libFuzzer's hook would end the process.
fn quietly(run: impl FnOnce()) -> std::thread::Result<()> {
    let hook = panic::take_hook();
    panic::set_hook(Box::new(|_| {}));
    let outcome = panic::catch_unwind(AssertUnwindSafe(run));
    panic::set_hook(hook);
    outcome
}

/// Seeds: keyframes of the scenes, initial and during the run.
pub fn seeds() -> Vec<Vec<u8>> {
    let mut all = Vec::new();
    for (index, text) in SCENES.iter().enumerate() {
        let mut world = World::new(text);
        let mut buffer = vec![0; LONGEST];
        for tick in 0..=600 {
            if matches!(tick, 0 | 30 | 600) {
                let length = world.simulation.write_keyframe(&mut buffer).unwrap();
                all.push([&[index as u8], &buffer[..length]].concat());
            }
            let latched = world.feed(tick);
            world.simulation.step(&latched).unwrap();
        }
    }
    all
}
