//! Trials with too little shared memory or disk.

use std::path::Path;

use fastrand::Rng;
use rustix::process::Signal;
use test_support::name_space::NameSpace;

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, Run, assert_nothing_left, session_folder, signal, wait_for};
use crate::common::scenes;
use crate::fault::Fault;
use crate::guest::{Behaviour, Guest};
use crate::looks::Looks;
use crate::table::Outcome;
use crate::trial::{next_run_starts, scene};

pub const MEMORY: &str = "/dev/shm";

/// Runs the hold scene in a namespace.
pub fn start_in(space: &NameSpace, place: &Place, output: &Path, scene: &str) -> Run {
    let file = place.scene(scene);
    let mut command = space.command();
    command
        .arg(env!("CARGO_BIN_EXE_trabecula"))
        .arg("run")
        .arg(file)
        .arg("--output")
        .arg(output)
        .arg("--quiet");
    Run::of(command, output.to_owned())
}

pub fn memory_left(space: &NameSpace) -> Vec<String> {
    let entries = std::fs::read_dir(space.path(Path::new(MEMORY))).unwrap().flatten();
    entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

/// A session finds too little shared memory, by any amount; with enough, the same scene runs.
pub fn memory_full_at_start(random: &mut Rng) -> Result<Outcome, String> {
    let bytes = (1 << random.u64(..28)).max(4096) + random.u64(..1 << 16) * 4096 % (1 << 24);
    let space = NameSpace::with_tmpfs(Path::new(MEMORY), bytes)?;
    let place = Place::new();
    let output = place.path("out");
    let mut looks = Looks::new([MEMORY, MEMORY]);
    let mut run = start_in(&space, &place, &output, &scenes::hold("lockstep", 0.02));
    while !run.is_over() {
        looks.look(&run);
    }
    let ended = run.end();
    looks.end(&ended.err);
    let said = format!("{bytes} bytes: exit {:?}\n{}\n{}", ended.code, ended.err, ended.out);
    assert!(!ended.err.contains("panicked"), "{said}");
    let went_on = ended.code == Some(0);
    assert!(went_on || (ended.code == Some(2) && ended.err.contains(MEMORY)), "{said}");
    if !went_on {
        looks.assert_in_time("the error of a start without memory");
    }
    assert_eq!(memory_left(&space), Vec::<String>::new(), "{said}");
    assert!(!session_folder(ended.pid).exists(), "{said}");
    space.resize(Path::new(MEMORY), 1 << 30);
    let ended = start_in(&space, &place, &output, &scenes::hold("lockstep", 0.02)).end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    Ok(looks.outcome(went_on))
}

/// All shared memory is used up in the middle of a run, and clients try to join: the run continues.
pub fn memory_full(random: &mut Rng) -> Result<Outcome, String> {
    let space = NameSpace::with_tmpfs(Path::new(MEMORY), 1 << 30)?;
    let place = Place::new();
    let run = start_in(&space, &place, &place.path("out"), &scene(false));
    let session = run.session();
    let log = || {
        let folder = std::fs::read_dir(place.path("out")).ok()?.flatten().next()?.path();
        std::fs::metadata(folder.join("run.mcap")).ok().map(|meta| meta.len())
    };
    wait_for("a log", || log().filter(|bytes| *bytes > 1_000_000 + random.u64(..1_000_000)));
    let filler = space.fill(Path::new(MEMORY));
    let guest = |behaviour| {
        let mut command = space.command();
        command.arg(std::env::current_exe().unwrap());
        Guest::of(command, &session, "guest", behaviour, 1)
    };
    for _ in 0..3 {
        let refused = guest(Behaviour::Steady).ready();
        let said = refused.expect_err("a client needs memory");
        assert!(said.contains(MEMORY), "{said}");
    }
    let before = log();
    wait_for("a log that grows", || log().filter(|bytes| Some(*bytes) > before.map(|b| b + 1_000_000)));
    std::fs::remove_file(filler).unwrap();
    guest(Behaviour::Steady).ready().unwrap();
    signal(run.pid(), Signal::INT);
    let ended = run.end();
    assert_eq!(ended.code, Some(130), "{}", ended.err);
    assert_eq!(memory_left(&space), Vec::<String>::new());
    assert!(!session_folder(ended.pid).exists());
    let whole = read(&ended.folder);
    assert!(whole.marker.unwrap().lost.is_empty());
    assert_replays(&ended.folder);
    Ok(Outcome { went_on: true, ticks: whole.ticks.len() as u64, ..Outcome::default() })
}

/// The file system of the log is full.
pub fn disk_full(random: &mut Rng) -> Result<Outcome, String> {
    let place = Place::new();
    let output = place.path("out");
    std::fs::create_dir(&output).unwrap();
    let bytes = 2_000_000 + random.u64(..6_000_000);
    let space = NameSpace::with_tmpfs(&output, bytes)?;
    let errors = Fault::DiskFull.allowed(false).errors;
    let mut looks = Looks::new(errors);
    let mut run = start_in(&space, &place, &output, &scene(false));
    let left = || rustix::fs::statvfs(space.path(&output)).map_or(0, |info| info.f_bavail);
    let mut before = left();
    while !run.is_over() {
        looks.look(&run);
        if std::mem::replace(&mut before, left()) != before {
            // It is not full yet.
            looks.restart();
        }
    }
    let ended = run.end();
    looks.end(&ended.err);
    looks.assert_in_time("the error of a full disk");
    let said = format!("{bytes} bytes: exit {:?}\n{}\n{}", ended.code, ended.err, ended.out);
    assert_eq!(ended.code, Some(1), "{said}");
    assert!(errors.iter().any(|words| ended.err.contains(words)), "{said}");
    assert!(!ended.err.contains("panicked"), "{said}");
    assert_nothing_left(ended.pid);
    let folder = std::fs::read_dir(space.path(&output)).unwrap().flatten().next().unwrap().path();
    let ticks = read(&folder).ticks.len() as u64;
    assert_replays(&folder);
    next_run_starts(&place);
    Ok(Outcome { ticks, ..looks.outcome(false) })
}
