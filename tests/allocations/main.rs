//! The loop at 1 kHz asks nobody for memory and calls the kernel only to wait, to wake and to look at its own counters.
//!
//! Two counters: Rust's global allocator, and for what C++ (Ruckig) takes a library that counts the calls of `malloc` and
//! its relatives in a preloaded process.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[allow(dead_code, reason = "these tests use a part of what the tests of processes share")]
#[path = "../processes/common/mod.rs"]
mod common;

use std::alloc::System;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::Command as Program;

use controller_proc::built_in;
use ipc_types::messages::{CONTROL_STOP, Command};
use ipc_types::scene::Scene;
use physics_proc::bone::GridGeometry;
use physics_proc::latch::Latch;
use physics_proc::simulation::{CtView, Simulation};
use rustix::process::Signal;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

use common::client::Client;
use common::program::{Place, Run, signal};
use common::scenes;

#[global_allocator]
static GLOBAL: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

const COUNTS: &str = "TRABECULA_MALLOC_COUNTS";
/// Ticks before the counting begins: contacts, arm and burr have begun by then.
const WARM: u64 = 200;
const TICKS: u64 = 10_000;

/// Drilling for eleven seconds, without X-ray.
fn drilling(mode: &str) -> String {
    let scene = scenes::drill(mode, 11.0).replace("feed_mm_per_s = 8.0", "feed_mm_per_s = 1.8");
    let (before, x_ray) = scene.split_once("[drr]").unwrap();
    let (_, controller) = x_ray.split_once("[[controller]]").unwrap();
    format!("{before}[[controller]]{controller}")
}

/// What was counted over the ticks.
#[derive(Debug, Default)]
struct Counted {
    rust: usize,
    malloc: u64,
    removed: u64,
}

/// Steps through the drilling; `malloc` reads the other counter.
fn drill(malloc: impl Fn() -> u64) -> Counted {
    let scene = Scene::parse(&drilling("lockstep"), Path::new("drilling.toml")).unwrap();
    // The block of the scene, of uniform bone.
    let dims = [40, 40, 60];
    let origin = nalgebra::Vector3::new(-19.5e-3, -19.5e-3, -29.5e-3);
    let hu = vec![400; dims.iter().product()];
    let ct = CtView { geometry: GridGeometry::axis_aligned(dims, [1e-3; 3], origin), hu: &hu };
    let mut simulation = Simulation::new(&scene, Some(ct)).unwrap();
    let mut controller = built_in(&scene, "reference").unwrap().unwrap();
    let mut latch = Latch::new(&scene);
    let mut counted = Counted::default();
    for tick in 0..WARM + TICKS {
        let mut command = Command { sequence: tick + 1, state_tick: tick, ..Command::zeroed() };
        controller.step(simulation.state(), &mut command);
        let (region, before) = (Region::new(GLOBAL), malloc());
        latch.offer(0, &command, tick).unwrap();
        let latched = latch.latch(tick, false);
        simulation.step(&latched).unwrap();
        let (change, after) = (region.change(), malloc());
        if tick >= WARM {
            counted.rust += change.allocations + change.deallocations + change.reallocations;
            counted.malloc += after - before;
        }
    }
    counted.removed = simulation.state().removed_total;
    counted
}

#[test]
fn ten_thousand_ticks_of_drilling_allocate_nothing() {
    let counted = drill(|| 0);
    println!(
        "{TICKS} ticks of drilling, {} voxels: {} calls of Rust's allocator",
        counted.removed, counted.rust
    );
    assert!(counted.removed > 500, "it drills: {counted:?}");
    assert_eq!(counted.rust, 0);
}

/// The library that counts; the error is the reason why there is none.
fn counter() -> Result<PathBuf, String> {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/allocations/count_malloc.c");
    let library = tempfile::NamedTempFile::with_suffix_in(".so", env!("CARGO_TARGET_TMPDIR")).unwrap();
    let library = library.into_temp_path().keep().unwrap();
    let output = Program::new("cc")
        .args(["-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-Werror", "-o"])
        .args([&library, &source])
        .output()
        .map_err(|cause| format!("cc: {cause}"))?;
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Ok(library)
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
    println!("\ncounted {}", drill(|| calls.read()).malloc);
}

#[test]
fn ten_thousand_ticks_of_drilling_call_no_malloc_in_any_language() {
    let library = match counter() {
        Ok(library) => library,
        Err(reason) => return println!("\n*** SKIPPED: {reason} ***\n"),
    };
    let folder = tempfile::tempdir().unwrap();
    let mut program = Program::new(std::env::current_exe().unwrap());
    program.args(["--exact", "counted_program", "--nocapture"]);
    let output = program.env(COUNTS, folder.path()).env("LD_PRELOAD", &library).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    std::fs::remove_file(library).unwrap();
    let line = said.lines().find(|line| line.starts_with("counted ")).unwrap_or_else(|| panic!("{said}"));
    println!("{TICKS} ticks of drilling: {line} calls of malloc and its relatives");
    assert_eq!(line, "counted 0");
}

/// A run under way with a client that watches it.
fn watched(mode: &str, environment: &[(&str, &Path)]) -> (Place, Run, Client) {
    let place = Place::new();
    let scene = place.scene(&drilling(mode));
    let output = place.path("out");
    let mut command = Program::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("run").arg(scene).arg("--output").arg(&output).arg("--quiet");
    environment.iter().for_each(|(name, value)| {
        command.env(name, value);
    });
    let run = Run::of(command, output);
    let client = Client::join(&run.session());
    (place, run, client)
}

#[test]
fn the_loop_of_the_physics_process_calls_no_malloc() {
    let library = match counter() {
        Ok(library) => library,
        Err(reason) => return println!("\n*** SKIPPED: {reason} ***\n"),
    };
    let folder = tempfile::tempdir().unwrap();
    let (_place, run, client) =
        watched("lockstep", &[(COUNTS, folder.path()), ("LD_PRELOAD", library.as_path())]);
    let calls = Calls::of(folder.path(), run.part("physics"));
    let first = client.wait_for_state(|state| state.tick >= WARM);
    let before = calls.read();
    let last = client.wait_for_state(|state| state.tick >= TICKS);
    let after = calls.read();
    client.ask(CONTROL_STOP, 0);
    drop(client);
    let ended = run.end();
    std::fs::remove_file(library).unwrap();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    let ticks = last.tick - first.tick;
    println!("{ticks} ticks of the process: {} calls of malloc and its relatives", after - before);
    assert_eq!(after - before, 0);
}

/// What the loop may ask the kernel for: sleeping, waking and being woken, and its own counters.
const ALLOWED: [&str; 12] = [
    "clock_nanosleep",
    "clock_gettime",
    "getrusage",
    // Its own /proc/thread-self/schedstat, open since the start.
    "pread64",
    // Events of readers that sleep, and its own.
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
    if Program::new("strace").arg("-V").output().is_err() {
        return println!("\n*** SKIPPED: no strace ***\n");
    }
    let (place, run, client) = watched("realtime", &[]);
    let physics = run.part("physics");
    client.wait_for_state(|state| state.tick >= WARM);
    let file = place.path("calls");
    let mut strace = Program::new("strace")
        .args(["-f", "-o"])
        .arg(&file)
        .args(["-p", &physics.to_string()])
        .spawn()
        .unwrap();
    let first = client.wait_for_state(|_| file.metadata().is_ok_and(|meta| meta.len() > 0)).tick;
    client.wait_for_state(|state| state.tick >= first + 1000);
    signal(strace.id(), Signal::INT);
    let _ = strace.wait();
    client.ask(CONTROL_STOP, 0);
    drop(client);
    assert_eq!(run.end().code, Some(0));
    let text = std::fs::read_to_string(&file).unwrap();
    let mut counts = std::collections::BTreeMap::new();
    for line in text.lines().filter(|line| !line.contains("---") && !line.contains("resumed")) {
        let call = line.split_whitespace().nth(1).unwrap_or("").split('(').next().unwrap_or("");
        *counts.entry(call.to_owned()).or_insert(0) += 1;
    }
    println!("system calls of about 1000 ticks: {counts:?}");
    for call in counts.keys() {
        assert!(ALLOWED.contains(&call.as_str()), "{call} in the loop: {counts:?}");
    }
    assert!(counts.contains_key("clock_nanosleep"), "{counts:?}");
}
