//! Real-time runs under adverse scheduling, each replayed: SIGSTOP and SIGCONT, one core, niceness, busy
//! neighbours, controllers that are killed and restarted.
//!
//! Every schedule follows from its seed. The tests run a few; this command runs any number, and prints a
//! table:
//!
//! ```sh
//! TRABECULA_SCHEDULES=200 cargo test --release --test processes schedules -- --nocapture
//! ```

use std::path::Path;
use std::process::{Command as Program, Stdio};
use std::time::{Duration, Instant};

use controller_proc::process::run_controller;
use controllers::Controller;
use fastrand::Rng;
use ipc_types::messages::{
    ARM_HOLD, ARM_MOVE_CP, ARM_SERVO_JP, BURR_SPEED, Command, SOURCE_HELD, SOURCE_SAFE, State,
    TENDON_SERVO_JF,
};
use ipc_types::session::SESSION_VARIABLE;
use recorder_proc::log_file::LogFile;
use run_log::LogReader;
use rustix::process::{Pid, Signal, setpriority_process};
use rustix::thread::{CpuSet, sched_setaffinity};

use crate::common::logs::verify;
use crate::common::program::{BusyLoops, Guarded, Place, Run, assert_nothing_left, signal};
use crate::common::scenes;

const COUNT_VARIABLE: &str = "TRABECULA_SCHEDULES";
const PILOT_VARIABLE: &str = "TRABECULA_TEST_PILOT_SEED";
/// Number of schedules in an ordinary test run.
const FEW: u64 = 4;
const RUN_S: f64 = 1.0;

/// Drives everything at random, with answers that are sometimes late.
struct Erratic(Rng);

impl Controller for Erratic {
    fn step(&mut self, state: &State, command: &mut Command) {
        let random = &mut self.0;
        command.tendon_mode = TENDON_SERVO_JF;
        command.tendon_force_n[random.u64(..2) as usize] = random.u64(..60) as f64 * 0.1;
        command.burr_mode = BURR_SPEED;
        command.burr_speed_rad_per_s = random.u64(..900) as f64;
        match random.u64(..40) {
            0 => command.arm_mode = ARM_HOLD,
            1..=5 => {
                command.arm_mode = ARM_MOVE_CP;
                command.t_world_base = state.t_world_flange;
                command.t_world_base.position_m[2] += random.u64(..30) as f64 * 1e-4;
                command.arm_speed_m_per_s = 0.02;
            }
            6 => {
                command.arm_mode = ARM_SERVO_JP;
                command.arm_joint_position_rad = state.arm_joint_position_rad;
                command.arm_joint_position_rad[5] += 1e-3;
            }
            _ => {}
        }
        if random.u64(..50) == 0 {
            std::thread::sleep(Duration::from_millis(random.u64(..40)));
        }
    }
}

/// Not a test by itself: the program of the external controller, which [`Pilot`] starts from this test's own
/// file.
#[test]
fn pilot_program() {
    let Ok(seed) = std::env::var(PILOT_VARIABLE) else { return };
    let session = std::env::var_os(SESSION_VARIABLE).unwrap();
    let mut controller = Erratic(Rng::with_seed(seed.parse().unwrap()));
    // A run that has just ended cannot be joined.
    let _ = run_controller(Path::new(&session), "pilot", &mut controller);
}

/// The external controller in a separate process.
struct Pilot(Guarded);

impl Pilot {
    fn start(session: &Path, seed: u64) -> Pilot {
        let mut program = Program::new(std::env::current_exe().unwrap());
        program.args(["--exact", "schedules::pilot_program"]);
        program.env(SESSION_VARIABLE, session).env(PILOT_VARIABLE, seed.to_string());
        program.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        Pilot(Guarded(program.spawn().unwrap()))
    }

    fn pid(&self) -> u32 {
        self.0.0.id()
    }
}

/// A schedule and its results.
#[derive(Debug, Default)]
struct Row {
    neighbours: u64,
    one_core: bool,
    nice: bool,
    stops: u64,
    restarts: u64,
    ticks: u64,
    held: u64,
    safe: u64,
    removed: u64,
    lost: u64,
}

fn every_thread(pid: u32, act: impl Fn(Pid)) {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).map(|tasks| tasks.flatten().collect());
    let tasks: Vec<std::fs::DirEntry> = tasks.unwrap_or_default();
    let ids = tasks.iter().filter_map(|task| task.file_name().to_str()?.parse().ok());
    ids.filter_map(Pid::from_raw).for_each(act);
}

/// Runs the schedule of a seed, and replays it.
fn play(seed: u64) -> Row {
    let mut random = Rng::with_seed(seed);
    let place = Place::new();
    let with_frames = random.u64(..2) == 0;
    let run = place.start(&scenes::scheduled(RUN_S, with_frames));
    let session = run.session();
    let mut row = Row { neighbours: random.u64(..4), one_core: random.u64(..2) == 0, ..Row::default() };
    let neighbours = BusyLoops::start(row.neighbours as usize);
    let mut pilot = Some(Pilot::start(&session, seed));
    let parts: Vec<u32> = ["physics", "recorder"].iter().map(|part| run.part(part)).collect();
    row.nice = random.u64(..2) == 0;
    let pilot_pid = pilot.as_ref().map(Pilot::pid);
    for pid in parts.iter().copied().chain(pilot_pid) {
        if row.one_core {
            let mut core = CpuSet::new();
            core.set(0);
            // A thread that has just ended, or a machine that forbids it, changes nothing.
            every_thread(pid, |thread| sched_setaffinity(Some(thread), &core).unwrap_or_default());
        }
        if row.nice && random.u64(..2) == 0 {
            let niceness = 1 + random.u64(..15) as i32;
            every_thread(pid, |thread| setpriority_process(Some(thread), niceness).unwrap_or_default());
        }
    }
    disturb(&mut random, &run, &session, &parts, &mut pilot, &mut row);
    let ended = run.end();
    drop((pilot, neighbours));
    assert_eq!(ended.code, Some(0), "seed {seed}: {}", ended.err);
    assert_nothing_left(ended.pid);
    check(seed, &ended.folder, &mut row);
    row
}

/// Stops, continues, kills and restarts until the run's time is nearly over.
fn disturb(
    random: &mut Rng,
    run: &Run,
    session: &Path,
    parts: &[u32],
    pilot: &mut Option<Pilot>,
    row: &mut Row,
) {
    let end = Instant::now() + Duration::from_secs_f64(RUN_S * 0.9);
    while Instant::now() < end && Path::new(&format!("/proc/{}", run.pid())).exists() {
        std::thread::sleep(Duration::from_millis(random.u64(..120)));
        let pause = Duration::from_millis(2 + random.u64(..90));
        if random.u64(..3) == 0 {
            // The physics waits for a controller only at the start; from then on it runs with or without.
            drop(pilot.take());
            std::thread::sleep(pause);
            *pilot = Some(Pilot::start(session, row.restarts + 1000));
            row.restarts += 1;
        } else {
            let pid = match random.u64(..3) {
                0 => pilot.as_ref().map(Pilot::pid),
                part => parts.get(part as usize - 1).copied(),
            };
            let Some(pid) = pid else { continue };
            signal(pid, Signal::STOP);
            std::thread::sleep(pause);
            signal(pid, Signal::CONT);
            row.stops += 1;
        }
    }
}

/// The log must replay to the identical hash at every tick without a gap: all, unless the recorder lost some.
fn check(seed: u64, folder: &Path, row: &mut Row) {
    let mut reader = LogReader::open(&LogFile::at(folder.join("run.mcap"))).unwrap();
    let mut gap = false;
    for tick in reader.by_ref() {
        let Ok(tick) = tick else {
            gap = true;
            break;
        };
        row.ticks += 1;
        let source = tick.latched.commands[0].source;
        row.held += u64::from(source == SOURCE_HELD);
        row.safe += u64::from(source == SOURCE_SAFE);
        row.removed = tick.state.removed_total;
    }
    let done = verify(folder);
    if gap {
        row.lost = 1;
        assert_eq!(done.code, Some(1), "seed {seed}: {}{}", done.out, done.err);
        let words = format!("cannot be read beyond tick {}:", row.ticks);
        assert!(done.err.contains(&words), "seed {seed}: {}", done.err);
        return;
    }
    assert_eq!(row.ticks, (RUN_S * 1e3) as u64, "seed {seed}");
    let all = format!("replayed {} ticks, all identical", row.ticks);
    assert_eq!(done.code, Some(0), "seed {seed}: {}{}", done.out, done.err);
    assert!(
        done.out.contains(&all) && done.out.contains("3 keyframes, all identical"),
        "seed {seed}: {}",
        done.out
    );
}

/// A real-time log of several preempted processes, with late, jittery, killed and restarted controllers,
/// replays.
#[test]
fn promise_1_replay_of_random_schedules_is_identical_at_every_tick() {
    let count = std::env::var(COUNT_VARIABLE).map_or(FEW, |text| text.parse().unwrap());
    println!(
        "| seed | neighbours | one core | nice | stops | restarts | ticks | held | safe | voxels | gap |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    let mut all = Row::default();
    let mut disturbed = 0;
    for seed in 1..=count {
        let row = play(seed);
        println!(
            "| {seed} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
            row.neighbours,
            row.one_core,
            row.nice,
            row.stops,
            row.restarts,
            row.ticks,
            row.held,
            row.safe,
            row.removed,
            row.lost
        );
        disturbed += u64::from(row.held + row.safe > 0);
        all.stops += row.stops;
        all.restarts += row.restarts;
        all.ticks += row.ticks;
        all.held += row.held;
        all.safe += row.safe;
        all.removed += row.removed;
        all.lost += row.lost;
    }
    println!("{count} schedules, {disturbed} with late commands: {all:?}");
    assert!(disturbed * 2 > count, "the schedules must disturb: {disturbed} of {count}");
    assert!(all.lost * 10 <= count, "{} logs of {count} have gaps", all.lost);
}
