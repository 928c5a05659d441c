//! Messages from clients: their lengths, commands, and X-ray requests.

use std::cell::RefCell;
use std::path::Path;

use hub::latch::Latch;
use ipc_types::messages::{
    self, ARM_HOLD, ARM_INSERT, ARM_MOVE_CP, ARM_MOVE_JP, ARM_RCM, ARM_SERVO_CP, ARM_SERVO_JV, BURR_SPEED,
    Command, ControllerIndex, DrrRequest, Reset, State, TENDON_MOVE_JP, TENDON_SERVO_JF, Tick,
};
use ipc_types::scene::Scene;
use simulation::{Simulation, SimulationSnapshot};
use test_support::scenes::TOOL;
use xray::message::c_arm_of;
use zerocopy::{FromBytes, IntoBytes};

const SCENE: &str = r#"
name = "commands"
run = { mode = "realtime", duration_s = 1.0, hold_ticks = 3 }
manipulator = { model = "planar", links = 8 }
"#;

/// Ticks after each command.
const TICKS: u64 = 6;

struct World {
    scene: Scene,
    simulation: Simulation<'static>,
    initial: SimulationSnapshot,
}

thread_local! {
    static WORLD: RefCell<World> = RefCell::new({
        let scene = Scene::parse(&format!("{SCENE}{TOOL}"), Path::new("fuzz.toml")).unwrap();
        let simulation = Simulation::new(&scene, None).unwrap();
        let initial = simulation.snapshot();
        World { scene, simulation, initial }
    });
}

/// The first byte selects the kind: a message of any service by its length, a request for an X-ray, or a
/// sequence of commands. Every tick after an accepted command is computed, and its state must contain only
/// finite numbers.
pub fn client_message(data: &[u8]) {
    let Some((kind, bytes)) = data.split_first() else { return };
    match kind {
        0 => {
            for description in messages::ALL {
                if description.check_length(bytes).is_ok() {
                    assert!(bytes.len() >= description.size);
                    run_log::cat::whole(description, bytes);
                }
            }
        }
        1 => {
            if let Ok((request, _)) = DrrRequest::read_from_prefix(bytes)
                && let Ok(c_arm) = c_arm_of(&request.geometry)
            {
                let camera = xray::message::projection_message(&c_arm, [0.0; 3]);
                assert!(camera.as_bytes().len() > c_arm.pixel_pitch_m.len());
                assert!(camera.intrinsics.iter().all(|number| number.is_finite()));
                assert!(c_arm.project([0.0; 3]).is_none_or(|place| place.depth_m.is_finite()));
            }
        }
        _ => WORLD.with_borrow_mut(|world| commands(world, bytes)),
    }
}

fn commands(world: &mut World, bytes: &[u8]) {
    world.simulation.restore(&world.initial).unwrap();
    let mut latch = Latch::new(&world.scene);
    let mut tick = 0;
    for bytes in bytes.chunks_exact(size_of::<Command>()).take(8) {
        let command = Command::read_from_bytes(bytes).unwrap();
        if latch.offer(ControllerIndex(0), &command, Tick(tick)).is_err() {
            continue;
        }
        for _ in 0..TICKS {
            let latched = latch.latch(Tick(tick), Reset::No);
            world.simulation.step(&latched).unwrap();
            tick += 1;
            assert!(is_finite(world.simulation.state()), "a number of the state is not finite");
        }
    }
}

fn is_finite(state: &State) -> bool {
    let numbers = [
        state.joint_position_rad.as_slice(),
        &state.joint_velocity_rad_per_s,
        &state.tendon_tension_n,
        &state.tendon_displacement_m,
        &state.t_world_tip.position_m,
        &state.t_world_tip.orientation_xyzw,
        &state.arm_joint_position_rad,
        &state.arm_joint_velocity_rad_per_s,
        &state.t_world_flange.position_m,
        &state.flange_wrench.force_n,
    ];
    numbers.into_iter().flatten().all(|number| number.is_finite())
}

/// Seeds: a command of each mode, some combined, a request, and each message filled with zeros.
pub fn seeds() -> Vec<Vec<u8>> {
    let scene = Scene::parse(&format!("{SCENE}{TOOL}"), Path::new("fuzz.toml")).unwrap();
    let start = *Simulation::new(&scene, None).unwrap().state();
    let base = Command {
        sequence: 1,
        t_world_base: start.t_world_base,
        arm_joint_position_rad: start.arm_joint_position_rad,
        arm_speed_m_per_s: 0.01,
        ..Command::zeroed()
    };
    let mut one = [
        Command { tendon_mode: TENDON_SERVO_JF, tendon_force_n: [3.0, 1.0, 0.0, 0.0], ..base },
        Command { tendon_mode: TENDON_MOVE_JP, tendon_displacement_m: [2e-3, -2e-3, 0.0, 0.0], ..base },
        Command { arm_mode: ARM_MOVE_JP, ..base },
        Command {
            arm_mode: ARM_SERVO_JV,
            arm_joint_velocity_rad_per_s: [0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.0],
            ..base
        },
        Command { arm_mode: ARM_SERVO_CP, ..base },
        Command { arm_mode: ARM_MOVE_CP, ..base },
        Command { arm_mode: ARM_INSERT, arm_axis: [0.0, 0.0, 1.0], arm_depth_m: 0.02, ..base },
        Command { arm_mode: ARM_RCM, arm_pivot_m: [0.0, 0.0, -0.01], ..base },
        Command { arm_mode: ARM_HOLD, burr_mode: BURR_SPEED, burr_speed_rad_per_s: 800.0, ..base },
    ];
    for command in &mut one {
        command.t_world_base.position_m[2] += 1e-3;
        command.arm_joint_position_rad[2] += 0.01;
    }
    let mut all: Vec<Vec<u8>> = one.iter().map(|command| [&[2], command.as_bytes()].concat()).collect();
    for (number, command) in one.iter_mut().enumerate() {
        (command.sequence, command.state_tick) = (number as u64 + 1, number as u64 * TICKS);
    }
    all.push([&[2], one[..4].as_bytes()].concat());
    all.push([&[2], one[4..8].as_bytes()].concat());
    all.push([&[1], DrrRequest::zeroed().as_bytes()].concat());
    let scene = crate::seeds::scene_file("curved_shape_feedback.toml");
    if let Some(c_arm) = scene.drr.as_ref().and_then(|drr| xray::from_scene::scene_c_arm(drr).ok()) {
        let geometry = xray::message::c_arm_message(&c_arm);
        all.push(
            [&[1], DrrRequest { geometry, use_geometry: 1, ..DrrRequest::zeroed() }.as_bytes()].concat(),
        );
    }
    all.extend(messages::ALL.iter().map(|description| vec![0; 1 + description.size]));
    all
}
