//! The 1 kHz loop allocates no memory, and calls the kernel only to wait, to wake and to read its own
//! counters.
//!
//! Two counters: Rust's global allocator and, for allocations by C++ (Ruckig), a preloaded library that
//! counts the calls of `malloc` and its relatives in a process.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[allow(dead_code, reason = "these tests use a part of what the tests of processes share")]
#[path = "../processes/common/mod.rs"]
mod common;

use std::alloc::System;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::{Command as Program, Stdio};
use test_support::limited::{Limited, end_within};

use hub::latch::Latch;
use ipc_types::messages::{
    ARM_MOVE_CP, BURR_SPEED, CONTROL_STOP, Command, ControllerIndex, Reset, State, TENDON_SERVO_JF, Tick,
};
use ipc_types::scene::Scene;
use recorder_proc::log_file::LogFile;
use run_log::{MessageStream, ReadOptions, Topic};
use rustix::process::Signal;
use simulation::bone::{BoneField, BoneParameters, BurrState, GridGeometry};
use simulation::{CtView, Simulation};
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

use common::client::Pilot;
use common::program::{LIMIT, Place, Run, signal};
use common::scenes;

#[global_allocator]
static GLOBAL: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

const COUNTS: &str = "TRABECULA_MALLOC_COUNTS";
/// Number of ticks counted.
const TICKS: u64 = 10_000;

/// Number of ticks in which the arm feeds the burr into the bone, 4 mm deep.
const FEED: u64 = 2500;

/// Drills without moving the arm: fed into the bone first, then pulled sideways by the tendon, deeper with
/// every tick.
fn sideways(state: &State, command: &mut Command) {
    command.burr_mode = BURR_SPEED;
    command.burr_speed_rad_per_s = 800.0;
    command.tendon_mode = TENDON_SERVO_JF;
    command.tendon_force_n[0] = 2e-3 * state.tick.saturating_sub(FEED).min(TICKS) as f64;
    feed(state, command, 5e-3, 3e-3);
}

/// Sends the arm along the tool's axis, once.
fn feed(state: &State, command: &mut Command, distance_m: f64, speed_m_per_s: f64) {
    if state.tick == 1 {
        command.arm_mode = ARM_MOVE_CP;
        command.t_world_base = state.t_world_base;
        command.t_world_base.position_m[2] += distance_m;
        command.arm_speed_m_per_s = speed_m_per_s;
    }
}

/// Drills along a straight line: the arm moves in every tick.
fn straight(state: &State, command: &mut Command) {
    sideways(state, command);
    command.tendon_force_n[0] = 1.0;
    feed(state, command, 25e-3, 1.5e-3);
}

type Steer = fn(&State, &mut Command);

/// Counts over the ticks.
#[derive(Debug, Default)]
struct Counted {
    rust: usize,
    malloc: u64,
    removed: u64,
}

/// Steps through the drilling with a tool of these keys, or the standard one; `malloc` reads the other
/// counter.
fn drill(tool: &str, steer: Steer, malloc: impl Fn() -> u64) -> Counted {
    let text = scenes::piloted("lockstep", 30.0, "") + tool;
    let scene = Scene::parse(&text, Path::new("drilling.toml")).unwrap();
    // The block of the scene, of uniform bone.
    let dims = [80, 80, 120];
    let origin = nalgebra::Vector3::new(-19.75e-3, -19.75e-3, -29.75e-3);
    let hu = vec![400; dims.iter().product()];
    let ct = CtView { geometry: GridGeometry::axis_aligned(dims, [0.5e-3; 3], origin), hu: &hu };
    let mut simulation = Simulation::new(&scene, Some(ct)).unwrap();
    let mut latch = Latch::new(&scene);
    let mut counted = Counted::default();
    for tick in 0..FEED + TICKS {
        let mut command = Command { sequence: tick + 1, state_tick: tick, ..Command::zeroed() };
        steer(simulation.state(), &mut command);
        let before = simulation.state().removed_total;
        let (region, calls) = (Region::new(GLOBAL), malloc());
        latch.offer(ControllerIndex(0), &command, Tick(tick)).unwrap();
        let latched = latch.latch(Tick(tick), Reset::No);
        simulation.step(&latched).unwrap();
        let (change, more) = (region.change(), malloc() - calls);
        if tick >= FEED {
            counted.rust += change.allocations + change.deallocations + change.reallocations;
            counted.malloc += more;
            counted.removed += simulation.state().removed_total - before;
        }
    }
    counted
}

/// Returns whether this process runs nothing else. Otherwise it has run the test of this name in such a
/// process: the counter counts the calls of all threads, and other tests run next to this one.
fn alone(test: &str) -> bool {
    const ALONE: &str = "TRABECULA_ALONE";
    if std::env::var_os(ALONE).is_some() {
        return true;
    }
    let words = ["--exact", test, "--nocapture", "--test-threads", "1"];
    let mut program = Program::new(std::env::current_exe().unwrap());
    let output = program.args(words).env(ALONE, "1").limited_output().unwrap();
    let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(output.status.success(), "{test}, alone: {}\n{}\n{}", output.status, said[0], said[1]);
    false
}

#[test]
fn ten_thousand_ticks_of_drilling_allocate_nothing() {
    if !alone("ten_thousand_ticks_of_drilling_allocate_nothing") {
        return;
    }
    let counted = drill("", sideways, || 0);
    println!(
        "{TICKS} ticks of drilling, {} voxels: {} calls of Rust's allocator",
        counted.removed, counted.rust
    );
    assert!(counted.removed > 100, "it drills: {counted:?}");
    assert_eq!(counted.rust, 0);
}

/// A notched tube with a cylinder of eight balls.
const LONG_CUTTER: &str = "
[manipulator.tool]
name = \"milling\"
[manipulator.tool.tube]
outer_diameter_mm = 6.0
inner_diameter_mm = 4.0
linear_density_kg_per_m = 0.1
[manipulator.tool.burr]
shape = \"cylinder\"
diameter_mm = 6.5
length_mm = 14.0
offset_mm = 12.0
mass_g = 3.0
[[manipulator.tool.tendon]]
toward_mm = 2.5
[[manipulator.tool.flexure]]
at_mm = 36.0
count = 24
pitch_mm = 1.3
stiffness_nm_per_deg = 0.0125
";

#[test]
fn ten_thousand_ticks_of_drilling_with_a_long_cutter_allocate_nothing() {
    if !alone("ten_thousand_ticks_of_drilling_with_a_long_cutter_allocate_nothing") {
        return;
    }
    let counted = drill(LONG_CUTTER, sideways, || 0);
    println!("{TICKS} ticks, {} voxels: {} calls of Rust's allocator", counted.removed, counted.rust);
    assert!(counted.removed > 100, "it drills: {counted:?}");
    assert_eq!(counted.rust, 0);
}

/// Ruckig returns a moving arm's position, velocity and acceleration as three vectors, and allocates as many
/// in C++ to create them. There are no other allocations.
#[test]
fn a_moving_arm_allocates_what_ruckig_hands_out_and_nothing_else() {
    if !alone("a_moving_arm_allocates_what_ruckig_hands_out_and_nothing_else") {
        return;
    }
    let counted = drill("", straight, || 0);
    println!("{TICKS} ticks with the arm in motion: {} calls of Rust's allocator", counted.rust);
    assert!(counted.removed > 100, "it drills: {counted:?}");
    assert_eq!(counted.rust as u64, 6 * TICKS, "three vectors made and dropped a tick");
}

/// The memory for partly cut voxels grows between ticks, never within one.
#[test]
fn a_burr_that_outgrows_its_first_memory_allocates_nothing_in_a_tick() {
    if !alone("a_burr_that_outgrows_its_first_memory_allocates_nothing_in_a_tick") {
        return;
    }
    let geometry = GridGeometry::axis_aligned([120, 120, 320], [6.0e-5; 3], nalgebra::Vector3::zeros());
    let hu = vec![600; geometry.voxel_count()];
    let mut field = BoneField::new(geometry, &hu, BoneParameters::default()).unwrap();
    let (first, mut calls) = (field.voxels().pool_bytes(), 0);
    for tick in 0..170 {
        let burr = BurrState {
            centre_m: nalgebra::Vector3::new(3.6e-3, 3.6e-3, f64::from(tick) * 1.0e-4),
            radius_m: 3.25e-3,
            speed_rad_s: 838.0,
            normal_force_n: 500.0,
        };
        let region = Region::new(GLOBAL);
        assert_eq!(field.grind(&hu, &burr, 1e-2).unwrap().refused_count, 0);
        let change = region.change();
        calls += change.allocations + change.deallocations + change.reallocations;
        field.make_room();
    }
    println!("{first} bytes at first, {} at the end; {calls} calls in ticks", field.voxels().pool_bytes());
    assert!(field.voxels().pool_bytes() > first, "the memory must grow in this test");
    assert_eq!(calls, 0);
}

/// Builds the counting library.
fn counter() -> PathBuf {
    common::preload::library("allocations/count_malloc.c")
}

/// A process's counter.
struct Calls(File);

impl Calls {
    fn of(folder: &Path, pid: u32) -> Calls {
        Calls(File::open(folder.join(pid.to_string())).unwrap())
    }

    fn read(&self) -> u64 {
        let mut bytes = [0; 8];
        self.0.read_exact_at(&mut bytes, 0).unwrap();
        u64::from_le_bytes(bytes)
    }
}

/// Not a test by itself: drills in a process that preloads the counter.
#[test]
fn counted_program() {
    let Some(folder) = std::env::var_os(COUNTS) else { return };
    let calls = Calls::of(Path::new(&folder), std::process::id());
    let before = calls.read();
    drop(std::hint::black_box(Box::new([before; 100])));
    assert!(calls.read() > before, "the counter counts");
    println!("\ncounted {}", drill("", sideways, || calls.read()).malloc);
    println!("moving {}", drill("", straight, || calls.read()).malloc);
}

#[test]
fn ten_thousand_ticks_of_drilling_call_no_malloc_in_any_language() {
    let library = counter();
    let folder = tempfile::tempdir().unwrap();
    let mut program = Program::new(std::env::current_exe().unwrap());
    program.args(["--exact", "counted_program", "--nocapture"]);
    let output = program.env(COUNTS, folder.path()).env("LD_PRELOAD", &library).limited_output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    std::fs::remove_file(library).unwrap();
    let line = said.lines().find(|line| line.starts_with("counted ")).unwrap_or_else(|| panic!("{said}"));
    let moving = said.lines().find(|line| line.starts_with("moving ")).unwrap();
    println!("{TICKS} ticks of drilling, calls of malloc and its relatives: {line}; arm in {moving}");
    assert_eq!(line, "counted 0");
}

/// Starts a run driven by this test, at its first tick.
fn piloted(mode: &str, environment: &[(&str, &Path)]) -> (Place, Run, Pilot) {
    let place = Place::new();
    let scene = place.scene(&scenes::piloted(mode, 30.0, ""));
    let output = place.path("out");
    let mut command = Program::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("run").arg(scene).arg("--output").arg(&output).arg("--quiet");
    environment.iter().for_each(|(name, value)| {
        command.env(name, value);
    });
    let run = Run::of(command, output);
    let pilot = Pilot::join(&run.session(), "pilot");
    (place, run, pilot)
}

fn steered(state: &State) -> Command {
    let mut command = Command::zeroed();
    sideways(state, &mut command);
    command
}

/// Returns the messages of the ticks after a tick, by topic, in a lane.
fn messages_behind(from: u64, log: &Path, topics: &[&str]) -> u64 {
    let mut stream = MessageStream::open(&LogFile::at(log), ReadOptions::default()).unwrap();
    let mut count = 0;
    while let Some(message) = stream.next_message().unwrap() {
        let tick = message.log_time_ns / 1_000_000;
        let counted = (from + 1..=from + TICKS).contains(&tick) && topics.contains(&message.topic);
        count += u64::from(counted);
    }
    count
}

/// iceoryx2 allocates one small object (an `Rc` of 48 bytes, `port/details/chunk_mut_shared_state.rs`) for
/// every sample that it loans, and drops it when the sample is sent: three per tick for state, commands and
/// timing, and one each for the status, ten times per second of wall time, and removed voxels. A loan without
/// it is not possible. Nothing else calls malloc, except for some hundred calls when a program connects: on a
/// busy machine the launcher may do so late, so the counter is read twice.
#[test]
fn the_loop_of_the_physics_process_calls_no_malloc_but_for_its_loans() {
    let library = counter();
    let folder = tempfile::tempdir().unwrap();
    let (_place, run, mut pilot) =
        piloted("lockstep", &[(COUNTS, folder.path()), ("LD_PRELOAD", library.as_path())]);
    let mut state = pilot.drive_to(FEED, steered);
    let calls = Calls::of(folder.path(), run.part("physics"));
    let looks = [FEED, FEED + TICKS].map(|from| {
        // It waits for an answer: nothing moves while the counter is read.
        let before = calls.read();
        pilot.answer(&state, steered(&state));
        state = pilot.drive_to(from + TICKS, steered);
        (from, calls.read() - before)
    });
    pilot.client.ask(CONTROL_STOP, 0);
    drop(pilot);
    let ended = run.end();
    std::fs::remove_file(library).unwrap();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    let of_ticks =
        [Topic::State.name(), Topic::Latched.name(), Topic::Removed.name(), Topic::Keyframe.name()];
    let of_time = [Topic::TickTiming.name(), Topic::RunStatus.name(), Topic::Event.name()];
    let more = looks.map(|(from, calls)| {
        let sent = messages_behind(from, &ended.folder.join("run.mcap"), &of_ticks)
            + messages_behind(from, &ended.folder.join("timing.mcap"), &of_time);
        println!("{TICKS} ticks of the process: {sent} messages, {calls} calls of malloc and free");
        assert!(sent > 3 * TICKS, "state, commands, timing, and removed voxels: {sent}");
        calls.abs_diff(2 * sent)
    });
    // When the counter is read, the last messages of its tick, the timing and a status, may still be in
    // transit.
    assert!(more.iter().any(|more| *more <= 2 * 2 * 2), "{more:?} calls more or less than for messages");
}

/// Kernel calls that the loop may make: sleeping, waking and being woken, and reading its own counters.
const ALLOWED: [&str; 12] = [
    "clock_nanosleep",
    "clock_gettime",
    "getrusage",
    // Its own /proc/thread-self/schedstat, open since the start.
    "pread64",
    // Events of sleeping readers, and its own.
    "sendto",
    "recvfrom",
    "recvmsg",
    "sendmsg",
    "setsockopt",
    "ppoll",
    "sched_yield",
    "restart_syscall",
];

#[test]
fn the_loop_of_the_physics_process_opens_no_file_and_takes_no_lock() {
    if Program::new("strace").arg("-V").limited_output().is_err() {
        return println!("\n*** SKIPPED: no strace ***\n");
    }
    let (place, run, mut pilot) = piloted("realtime", &[]);
    let physics = run.part("physics");
    pilot.drive_to(200, steered);
    let file = place.path("calls");
    let mut strace = Program::new("strace")
        .args(["-f", "-o"])
        .arg(&file)
        .args(["-p", &physics.to_string()])
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let states = &pilot.client;
    let first = states.wait_for_state(|_| file.metadata().is_ok_and(|meta| meta.len() > 0)).tick;
    states.wait_for_state(|state| state.tick >= first + 1000);
    signal(strace.id(), Signal::INT);
    end_within(&mut strace, LIMIT, "strace");
    states.ask(CONTROL_STOP, 0);
    drop(pilot);
    assert_eq!(run.end().code, Some(0));
    let text = std::fs::read_to_string(&file).unwrap();
    // Each line begins with the thread's number. Other threads of the process may lock files: the loop does
    // not wait for them.
    let sleeps = text.lines().find(|line| line.contains("clock_nanosleep(")).expect("the loop sleeps");
    let thread = sleeps.split_whitespace().next().unwrap();
    let of_the_loop = |line: &&str| line.split_whitespace().next() == Some(thread);
    let mut counts = std::collections::BTreeMap::new();
    for line in
        text.lines().filter(of_the_loop).filter(|line| !line.contains("---") && !line.contains("resumed"))
    {
        let call = line.split_whitespace().nth(1).unwrap_or("").split('(').next().unwrap_or("");
        *counts.entry(call.to_owned()).or_insert(0) += 1;
    }
    println!("system calls of about 1000 ticks: {counts:?}");
    for call in counts.keys() {
        assert!(ALLOWED.contains(&call.as_str()), "{call} in the loop: {counts:?}");
    }
    assert!(counts.contains_key("clock_nanosleep"), "{counts:?}");
}
