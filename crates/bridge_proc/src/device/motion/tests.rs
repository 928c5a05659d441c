//! Motion by a device, against values worked out by hand.

use core::f64::consts::{FRAC_PI_2, PI};

use ipc_types::messages::{Pose, Tick};

use super::*;
use crate::device::event::{EV_ABS, EV_KEY, EV_REL, EventReader, record};
use crate::device::mapping::parsed;

const ALL: [Drives; 3] = [Drives::Arm, Drives::Tendon, Drives::Burr];
/// Clutch `BTN_0`, halt `BTN_2`; axes 0 to 5 are the six rates, and more.
const MAP: &str = "
clutch = \"BTN_0\"
halt = \"BTN_2\"
map = [
  { input = \"ABS_X\", output = \"x\", rate = 20.0, range = [-100, 0, 100] },
  { input = \"ABS_Y\", output = \"y\", rate = 20.0, range = [-100, 0, 100] },
  { input = \"ABS_Z\", output = \"z\", rate = 20.0, range = [-100, 0, 100] },
  { input = \"ABS_RX\", output = \"rx\", rate = 10.0, range = [-100, 0, 100] },
  { input = \"REL_Z\", output = \"z\", rate = 20.0, range = [-100, 0, 100] },
  { input = \"ABS_RY\", output = \"tendon_0\", rate = 4.0, range = [-100, 0, 100] },
  { input = \"ABS_RY\", output = \"tendon_0\", rate = 4.0, range = [-100, 0, 100] },
  { input = \"ABS_RY\", output = \"tendon_3\", rate = -4.0, range = [-100, 0, 100] },
  { input = \"BTN_1\", output = \"burr\", rate = 60000.0, toggle = true },
  { input = \"ABS_RZ\", output = \"burr\", rate = 60000.0, range = [0, 0, 100] },
]
";
const BUTTON_0: u16 = 0x100;

/// A hand on the device, and a tool whose base is turned by 90 degrees about the world's y, so that its z
/// points along the world's x and its x against the world's z; 0.1 m from base to burr.
struct Bench {
    motion: DeviceMotion,
    state: Box<State>,
    now_s: f64,
}

impl Bench {
    fn new(frame: &str) -> Bench {
        let mapping = parsed(&format!("frame = \"{frame}\"{MAP}")).unwrap();
        let mut state = Box::new(State::zeroed());
        let half = (FRAC_PI_2 / 2.0).sin();
        let turned = Pose { position_m: [0.0; 3], orientation_xyzw: [0.0, half, 0.0, half] };
        (state.t_world_flange, state.t_world_base) = (turned, turned);
        state.t_world_burr = Pose { position_m: [0.1, 0.0, 0.0], ..turned };
        state.tendon_count = 2;
        Bench { motion: DeviceMotion::new(mapping, &ALL), state, now_s: 50.0 }
    }

    fn event(&mut self, kind: u16, code: u16, value: i32) {
        self.motion.take(&InputEvent { time_s: 0.0, kind, code, value }, self.now_s);
    }

    /// Answers states for a time, 1 ms each, with a device that is there.
    fn pass(&mut self, ticks: u32) -> Command {
        let mut command = Command::zeroed();
        for _ in 0..ticks {
            self.motion.alive(self.now_s);
            command = self.answer();
        }
        command
    }

    fn answer(&mut self) -> Command {
        let mut command = Command::zeroed();
        self.state.sim_time_s += 1e-3;
        self.now_s += 1e-3;
        self.motion.fill(&self.state, self.now_s, &mut command);
        command
    }
}

fn assert_at(command: &Command, expected_mm: [f64; 3]) {
    assert_eq!(command.arm_mode(), Ok(ArmMode::ServoCp));
    let found = command.t_world_base.position_m;
    let near = found.iter().zip(expected_mm).all(|(found_m, mm)| (1e3 * found_m - mm).abs() < 1e-9);
    assert!(near, "{found:?} m, expected {expected_mm:?} mm");
}

/// Frames by hand: a C-arm at AP has rows along the world's x, columns against its z, and the source
/// toward its y (posterior).
#[test]
fn an_axis_moves_the_tool_along_the_axes_of_the_chosen_frame() {
    for (frame, expected) in [
        ("tool", [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
        ("patient", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        ("c_arm", [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    ] {
        for (axis, along) in (0..).zip(expected) {
            let mut bench = Bench::new(frame);
            bench.motion.turn_c_arm([1.0, 0.0, 0.0], [0.0, 0.0, -1.0]);
            bench.pass(5);
            bench.event(EV_KEY, BUTTON_0, 1);
            bench.event(EV_ABS, axis, 50);
            // 10 mm/s for 0.2 s.
            assert_at(&bench.pass(200), along.map(|part| 2.0 * part));
            bench.event(EV_ABS, axis, -100);
            assert_at(&bench.pass(100), [0.0; 3]);
        }
    }
}

#[test]
fn a_rotation_leaves_the_burr_where_it_is() {
    let mut bench = Bench::new("tool");
    bench.event(EV_KEY, BUTTON_0, 1);
    bench.event(EV_ABS, 3, 100);
    // Tick 0 has no time before it; then 10 deg/s for 0.5 s about the tool's x, the world's -z.
    let goal = isometry(&bench.pass(501).t_world_base);
    let burr_m = goal * nalgebra::Point3::new(0.0, 0.0, 0.1);
    assert!((burr_m.coords - Vector3::new(0.1, 0.0, 0.0)).norm() < 1e-12, "{burr_m}");
    let turned = goal.rotation * Vector3::z();
    let expected = Vector3::new((5.0 * PI / 180.0).cos(), -(5.0 * PI / 180.0).sin(), 0.0);
    assert!((turned - expected).norm() < 1e-12, "{turned}");
}

#[test]
fn nothing_moves_without_the_clutch_and_nothing_is_commanded_before_it() {
    let mut bench = Bench::new("tool");
    for code in 0..6 {
        bench.event(EV_ABS, code, 100);
    }
    bench.event(EV_KEY, BUTTON_0 + 1, 1);
    let command = bench.pass(10);
    assert_eq!((command.arm_mode, command.tendon_mode, command.burr_mode), (0, 0, 0));
    bench.event(EV_KEY, BUTTON_0, 1);
    let command = bench.pass(10);
    assert_eq!(command.arm_mode(), Ok(ArmMode::ServoCp));
    assert_eq!(command.tendon_velocity_m_per_s, [5e-3, 0.0, 0.0, 0.0], "the sum, in range");
    assert!((command.burr_speed_rad_per_s - 2000.0 * PI).abs() < 1e-9);
    for stop in [BUTTON_0 + 2, BUTTON_0] {
        let pressed = i32::from(stop != BUTTON_0);
        bench.event(EV_KEY, BUTTON_0, 1);
        bench.event(EV_KEY, stop, pressed);
        bench.event(EV_KEY, BUTTON_0, 2);
        assert_rest(&bench.pass(1));
    }
}

fn assert_rest(command: &Command) {
    assert_eq!((command.arm_mode(), command.tendon_mode()), (Ok(ArmMode::Hold), Ok(TendonMode::ServoJv)));
    assert_eq!((command.burr_mode(), command.burr_speed_rad_per_s), (Ok(BurrMode::Speed), 0.0));
    assert_eq!(command.tendon_velocity_m_per_s, [0.0; MAX_TENDONS]);
}

#[test]
fn a_toggle_holds_until_the_clutch_is_released() {
    let mut bench = Bench::new("tool");
    bench.event(EV_KEY, BUTTON_0, 1);
    let press = |bench: &mut Bench| {
        bench.event(EV_KEY, BUTTON_0 + 1, 1);
        bench.event(EV_KEY, BUTTON_0 + 1, 0);
        bench.pass(1).burr_speed_rad_per_s > 0.0
    };
    assert_eq!([press(&mut bench), press(&mut bench), press(&mut bench)], [true, false, true]);
    bench.event(EV_KEY, BUTTON_0, 0);
    bench.event(EV_KEY, BUTTON_0, 1);
    assert_eq!(bench.pass(1).burr_speed_rad_per_s, 0.0);
}

#[test]
fn rates_run_out_with_the_device_and_those_of_relative_axes_with_their_events() {
    let mut bench = Bench::new("tool");
    bench.event(EV_KEY, BUTTON_0, 1);
    bench.event(EV_REL, 2, 50);
    bench.event(EV_ABS, 5, 100);
    // 10 mm/s for 0.1 s, although the hand has let go.
    assert_at(&bench.pass(1000), [0.99, 0.0, 0.0]);
    assert!(bench.answer().burr_speed_rad_per_s > 0.0, "an absolute axis that is held sends nothing");
    let answers: Vec<Command> = (0..200).map(|_| bench.answer()).collect();
    let moving = answers.iter().filter(|command| command.burr_speed_rad_per_s > 0.0).count();
    assert!((98..=100).contains(&moving), "{moving} ms");
    bench.event(EV_ABS, 5, 90);
    assert_rest(&bench.pass(1));
    bench.event(EV_KEY, BUTTON_0, 1);
    assert!(bench.pass(1).burr_speed_rad_per_s > 0.0);
}

#[test]
fn events_that_the_kernel_lost_stop_everything() {
    let mut bench = Bench::new("tool");
    bench.event(EV_KEY, BUTTON_0, 1);
    bench.event(EV_ABS, 5, 100);
    bench.event(EV_SYN, SYN_DROPPED, 0);
    assert_rest(&bench.pass(1));
    bench.event(EV_KEY, BUTTON_0, 1);
    assert_rest(&bench.pass(1));
}

#[test]
fn the_goal_waits_for_an_arm_that_is_stuck_and_is_dropped_by_one_that_jumps() {
    let mut bench = Bench::new("patient");
    bench.event(EV_KEY, BUTTON_0, 1);
    bench.event(EV_ABS, 0, 100);
    let stuck = bench.pass(2000).t_world_base.position_m[0];
    assert!((0.0099..=LEAD_M).contains(&stuck), "{stuck} m");
    bench.event(EV_ABS, 0, -100);
    assert!(bench.pass(100).t_world_base.position_m[0] < 0.009);
    for pose in [&mut bench.state.t_world_flange, &mut bench.state.t_world_base] {
        pose.position_m[1] += 0.1;
    }
    assert_rest(&bench.pass(1));
    bench.event(EV_ABS, 0, 100);
    assert_rest(&bench.pass(1));
}

/// Regression: a program that had been stopped for half a second went on drilling when it continued.
#[test]
fn nothing_starts_again_by_itself_after_a_gap() {
    let mut bench = Bench::new("tool");
    bench.event(EV_KEY, BUTTON_0, 1);
    bench.event(EV_ABS, 5, 100);
    assert!(bench.pass(1).burr_speed_rad_per_s > 0.0);
    bench.state.sim_time_s += 0.2;
    assert_rest(&bench.pass(1));
    bench.event(EV_ABS, 5, 90);
    assert_rest(&bench.pass(1));
    bench.event(EV_KEY, BUTTON_0, 1);
    assert!(bench.pass(1).burr_speed_rad_per_s > 0.0);
}

/// A hostile device or file: whatever its bytes are, physics accepts the commands.
#[test]
fn any_bytes_give_commands_in_range() {
    let mut random = fastrand::Rng::with_seed(51);
    for round in 0..200 {
        let mut bench = Bench::new(["tool", "patient", "c_arm"][round % 3]);
        let mut reader = EventReader::default();

        for _ in 0..50 {
            let mut bytes: Vec<u8> = (0..random.usize(0..60)).map(|_| random.u8(..)).collect();
            if random.bool() {
                let kind = random.u16(0..4);
                let code = if kind == EV_KEY { BUTTON_0 + random.u16(0..3) } else { random.u16(0..7) };
                bytes = record(random.i64(..), kind, code, random.i32(..) >> random.u8(0..32));
            }
            let (motion, now_s) = (&mut bench.motion, bench.now_s);
            reader.feed(&bytes, |event| motion.take(&event, now_s));
            let mut command = bench.pass(random.u32(1..30));
            command.sequence = 1;
            hub::command_check::check(&command, &ALL, 0, Tick(0)).unwrap();
        }
    }
}
