//! One trial: a run, a fault in the middle of it, and what must hold afterwards.

use std::path::{Path, PathBuf};
use std::process::Command as Program;
use std::time::{Duration, Instant};

use ipc_types::messages::CONTROL_STOP;
use recorder_proc::EndReason;
use rustix::process::{Pid, Resource, Rlimit, Signal, prlimit};

use crate::clock::stepping_clock;
use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{
    Ended, Place, Run, assert_nothing_left, parts_of, session_folder, shared_memory_of, signal, wait_for,
};
use crate::common::scenes;
use crate::fault::{Fault, Victim};
use crate::guest::{Behaviour, Guest};
use crate::name_space::NameSpace;
use crate::random::Random;
use crate::table::Outcome;

/// Ticks that a run must make after a fault for it to have gone on.
const TICKS_AFTER: u64 = 200;
/// A killed recorder takes with it what it had not written: 100 ms, and on a machine as loaded as these tests make it what
/// it was late by.
const RECORDER_LOSS: u64 = 400;
const STOP_TIME: Duration = Duration::from_secs(2);

/// The scene of most trials: every part takes part, and a guest may.
fn scene(lockstep: bool) -> String {
    let mode = if lockstep { "lockstep" } else { "realtime" };
    let guest =
        "\n[[controller]]\nname = \"guest\"\ndrives = [\"c_arm\"]\nexternal = true\noptional = true\n";
    // Long enough for a lockstep run to be under way at the fault; late controllers are soon replaced or named.
    let keys = "seed = 7\nhold_ticks = 20\ncontroller_limit_ms = 2000.0";
    scenes::drill(mode, 600.0).replace("seed = 7", keys) + guest + &scenes::keyframes(0.25)
}

/// Makes a trial. It panics if something is not as it must be.
pub fn make(fault: Fault, seed: u64) -> Outcome {
    let mut random = Random(seed);
    let random = &mut random;
    let outcome = match fault {
        Fault::AwaitedJoinDeath => awaited_join_death(random),
        Fault::MemoryFullAtStart => memory_full_at_start(random),
        Fault::MemoryFull => memory_full(random),
        Fault::DiskFull => disk_full(random),
        _ => in_the_middle(fault, random),
    };
    match outcome {
        Ok(outcome) => outcome,
        Err(reason) => {
            println!("\n*** SKIPPED {}: {reason} ***\n", fault.name());
            Outcome { skipped: true, ..Outcome::default() }
        }
    }
}

/// A run with its observer.
struct Watched {
    place: Place,
    run: Run,
    client: Option<Client>,
    session: PathBuf,
    lockstep: bool,
    newest: u64,
}

impl Watched {
    fn start(lockstep: bool, environment: &[(&str, &Path)]) -> Watched {
        let place = Place::new();
        let file = place.scene(&scene(lockstep));
        let output = place.path("out");
        let mut command = Program::new(env!("CARGO_BIN_EXE_trabecula"));
        command.arg("run").arg(&file).arg("--output").arg(&output).arg("--quiet");
        environment.iter().for_each(|(name, value)| {
            command.env(name, value);
        });
        let run = Run::of(command, output);
        let session = run.session();
        let client = Some(Client::join(&session));
        Watched { place, run, client, session, lockstep, newest: 0 }
    }

    /// The newest tick that has been published.
    fn published(&mut self) -> u64 {
        let states = &self.client.as_ref().unwrap().states;
        while let Some(state) = states.receive().unwrap() {
            self.newest = state.message().tick;
        }
        self.newest
    }

    fn wait_for_tick(&mut self, tick: u64) {
        wait_for("a tick", || (self.published() >= tick).then_some(()));
    }

    fn pid_of(&self, victim: Victim) -> u32 {
        match victim {
            Victim::Launcher => self.run.pid(),
            part => self.run.part(part.part()),
        }
    }
}

/// Signals a process as the fault wants it.
fn disturb(fault: Fault, pid: u32) {
    match fault {
        Fault::Kill(_) => signal(pid, Signal::KILL),
        Fault::Stop(_) => {
            signal(pid, Signal::STOP);
            std::thread::sleep(STOP_TIME);
            signal(pid, Signal::CONT);
        }
        _ => {
            for _ in 0..40 {
                signal(pid, Signal::STOP);
                std::thread::sleep(Duration::from_millis(20));
                signal(pid, Signal::CONT);
                std::thread::sleep(Duration::from_millis(5));
            }
        }
    }
}

/// Starts the run, makes the fault, and sees what comes of it.
fn in_the_middle(fault: Fault, random: &mut Random) -> Result<Outcome, String> {
    let lockstep = random.one_in(3);
    let preload = match fault {
        Fault::ClockStep => Some(stepping_clock()?),
        _ => None,
    };
    let environment: Vec<(&str, &Path)> = preload.iter().map(|path| ("LD_PRELOAD", path.as_path())).collect();
    let mut watched = Watched::start(lockstep, &environment);
    let mut guests = Vec::new();
    if fault.needs_guest() {
        guests.push(guest(&watched, Behaviour::Steady, random));
    }
    watched.wait_for_tick(100 + random.below(300));
    // In lockstep its silence would end the run.
    if fault.may_have_company() && !lockstep && random.one_in(3) {
        let behaviour = Behaviour::bad(random);
        guests.push(Guest::start(&watched.session, "guest", behaviour, random.next()));
        std::thread::sleep(Duration::from_millis(random.below(200)));
    }
    let published = watched.published();
    let began = Instant::now();
    act(fault, &mut watched, &mut guests, random);
    let (ended, went_on, named_after_ms) = observe(fault, &mut watched, began);
    let over_after_ms = (!went_on).then(|| began.elapsed().as_millis() as u64);
    drop(guests);
    Ok(judge(
        fault,
        &watched,
        &ended,
        published,
        Outcome { went_on, named_after_ms, over_after_ms, ..Outcome::default() },
    ))
}

fn guest(watched: &Watched, behaviour: Behaviour, random: &mut Random) -> Guest {
    let mut guest = Guest::start(&watched.session, "guest", behaviour, random.next());
    guest.ready().unwrap();
    guest
}

fn act(fault: Fault, watched: &mut Watched, guests: &mut Vec<Guest>, random: &mut Random) {
    match fault {
        Fault::Kill(Victim::Client) | Fault::Stop(Victim::Client) | Fault::Starve(Victim::Client) => {
            disturb(fault, guests[0].pid());
        }
        Fault::Kill(victim) | Fault::Stop(victim) | Fault::Starve(victim) => {
            disturb(fault, watched.pid_of(victim));
        }
        Fault::SlowReader => guests.push(guest(watched, Behaviour::Slow, random)),
        Fault::Flood => guests.push(guest(watched, Behaviour::Flood, random)),
        Fault::Garbage => guests.push(guest(watched, Behaviour::Garbage, random)),
        Fault::LoanDeath => guest(watched, Behaviour::Loan, random).kill(),
        Fault::JoinDeath => {
            killed_joining(&watched.session, "guest", random);
            guests.push(guest(watched, Behaviour::Steady, random));
        }
        Fault::FileLimit => {
            let recorder = Pid::from_raw(watched.pid_of(Victim::Recorder) as i32).unwrap();
            let limit = Some(3_000_000 + random.below(3_000_000));
            prlimit(Some(recorder), Resource::Fsize, Rlimit { current: limit, maximum: limit }).unwrap();
        }
        Fault::AllKilled => {
            signal(watched.run.pid(), Signal::STOP);
            for (_, pid) in parts_of(&watched.session) {
                signal(pid, Signal::KILL);
            }
            signal(watched.run.pid(), Signal::KILL);
        }
        Fault::TwoHubs => second_hub(random),
        Fault::OtherVersion => drop(guest(watched, Behaviour::OtherVersion, random)),
        // The clock steps all the time.
        Fault::ClockStep => std::thread::sleep(Duration::from_millis(300)),
        other => unreachable!("{other:?} has a trial of its own"),
    }
}

/// Clients that are killed at any moment of their joining.
fn killed_joining(session: &Path, name: &str, random: &mut Random) {
    for _ in 0..3 {
        let mut guest = Guest::start(session, name, Behaviour::Steady, random.next());
        std::thread::sleep(Duration::from_micros(random.below(30_000)));
        guest.kill();
    }
}

/// Another hub runs for a while; one of its processes is killed.
fn second_hub(random: &mut Random) {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 60.0));
    let session = run.session();
    let client = Client::join(&session);
    client.wait_for_state(|state| state.tick >= 100);
    drop(client);
    let launcher = random.one_in(2);
    signal(if launcher { run.pid() } else { run.part("physics") }, Signal::KILL);
    let ended = run.end();
    assert_eq!(ended.code, if launcher { None } else { Some(1) }, "{}", ended.err);
    wait_for("the end of its parts", || parts_of(&session).is_empty().then_some(()));
}

/// Waits until the run has ended, or has made enough ticks after the fault and is stopped.
fn observe(fault: Fault, watched: &mut Watched, began: Instant) -> (Ended, bool, Option<u64>) {
    let allowed = fault.allowed(watched.lockstep);
    let mut named = None;
    let mut target = None;
    let went_on = wait_for("the end of a disturbed run", || {
        if named.is_none() && allowed.errors.iter().any(|words| watched.run.said().contains(words)) {
            named = Some(began.elapsed().as_millis() as u64);
        }
        if watched.run.is_over() {
            return Some(false);
        }
        if !allowed.goes_on {
            return None;
        }
        let newest = watched.published();
        // What was in the queue does not count.
        let target = *target.get_or_insert(newest + TICKS_AFTER);
        (newest >= target).then_some(true)
    });
    // A launcher that is killed leaves its parts to the kernel's signal.
    if went_on {
        watched.client.as_ref().unwrap().ask(CONTROL_STOP, 0);
    }
    watched.client = None;
    let session = watched.session.clone();
    let run = std::mem::replace(&mut watched.run, Run::of(Program::new("true"), PathBuf::new()));
    let ended = run.end();
    wait_for("the end of all parts", || parts_of(&session).is_empty().then_some(()));
    if named.is_none() && allowed.errors.iter().any(|words| ended.err.contains(words)) {
        named = Some(began.elapsed().as_millis() as u64);
    }
    (ended, went_on, named)
}

/// What must hold after every fault.
fn judge(fault: Fault, watched: &Watched, ended: &Ended, published: u64, outcome: Outcome) -> Outcome {
    let said = format!("{}: exit {:?}\n{}\n{}", fault.name(), ended.code, ended.err, ended.out);
    let launcher_killed = matches!(fault, Fault::Kill(Victim::Launcher) | Fault::AllKilled);
    assert!(!ended.err.contains("panicked"), "{said}");
    if outcome.went_on {
        assert_eq!(ended.code, Some(0), "{said}");
    } else if launcher_killed {
        assert_eq!(ended.code, None, "{said}");
    } else {
        assert_eq!(ended.code, Some(1), "{said}");
        let errors = fault.allowed(watched.lockstep).errors;
        assert!(errors.iter().any(|words| ended.err.contains(words)), "{said}");
    }
    let log = read(&ended.folder);
    let ticks = log.ticks.len() as u64;
    let lost_before = published.saturating_sub(ticks);
    let recorder_killed = matches!(fault, Fault::Kill(Victim::Recorder) | Fault::AllKilled);
    let may_lose = if recorder_killed && !watched.lockstep { RECORDER_LOSS } else { 0 };
    if !(recorder_killed && watched.lockstep) && fault != Fault::FileLimit {
        assert!(lost_before <= may_lose, "{lost_before} of {published} published ticks lost: {said}");
    }
    let mut lost_counted = 0;
    match &log.marker {
        Some(marker) => {
            lost_counted = marker.lost.values().sum();
            assert!(marker.lost.is_empty(), "{:?}: {said}", marker.lost);
            assert_reason(fault, outcome.went_on, &marker.reason);
        }
        None => assert!(recorder_killed || fault == Fault::FileLimit, "no end marker: {said}"),
    }
    assert_replays(&ended.folder);
    next_run_starts(&watched.place);
    if launcher_killed {
        assert!(!session_folder(ended.pid).exists());
        assert_eq!(shared_memory_of(ended.pid), Vec::<String>::new());
    }
    assert_nothing_left(ended.pid);
    assert_no_hidden_file(&ended.folder);
    Outcome { ticks, lost_before, lost_counted, ..outcome }
}

fn assert_reason(fault: Fault, went_on: bool, reason: &EndReason) {
    match (fault, reason) {
        (_, EndReason::Completed) => assert!(went_on, "{fault:?}"),
        (Fault::Kill(victim), EndReason::PartDied(name)) => {
            let known = [victim.part(), "reference", "physics"];
            assert!(known.contains(&name.as_str()), "{fault:?}: {name}");
        }
        (_, EndReason::PartDied(_)) => assert!(!went_on, "{fault:?}"),
        other => panic!("{other:?}"),
    }
}

/// The way in which the launcher tells the recorder why the run ends.
fn assert_no_hidden_file(folder: &Path) {
    let hidden = |entry: &std::fs::DirEntry| entry.file_name().to_string_lossy().starts_with('.');
    let left: Vec<_> = std::fs::read_dir(folder).unwrap().flatten().filter(hidden).collect();
    assert!(left.is_empty(), "{left:?}");
}

fn next_run_starts(place: &Place) {
    let scene = place.path("next.toml");
    std::fs::write(&scene, scenes::hold("lockstep", 0.02)).unwrap();
    let ended = Run::start(&scene, place.path("next"), &[]).end();
    assert_eq!(ended.code, Some(0), "the next run: {}", ended.err);
}

/// The controller that the start waits for dies while it joins, and comes back.
fn awaited_join_death(random: &mut Random) -> Result<Outcome, String> {
    let place = Place::new();
    let mode = if random.one_in(2) { "lockstep" } else { "realtime" };
    let run = place.start(&scenes::piloted(mode, 0.3, ""));
    let session = run.session();
    killed_joining(&session, "pilot", random);
    let mut pilot = Guest::start(&session, "pilot", Behaviour::Steady, 1);
    let ready = pilot.ready();
    let ended = run.end();
    assert_eq!((ended.code, ready), (Some(0), Ok(())), "{}", ended.err);
    assert_nothing_left(ended.pid);
    assert_replays(&ended.folder);
    let ticks = read(&ended.folder).ticks.len() as u64;
    assert_eq!(ticks, 300);
    Ok(Outcome { went_on: true, ticks, ..Outcome::default() })
}

const MEMORY: &str = "/dev/shm";

/// Runs the hold scene in a namespace.
fn start_in(space: &NameSpace, place: &Place, output: &Path, scene: &str) -> Run {
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

fn memory_left(space: &NameSpace) -> Vec<String> {
    let entries = std::fs::read_dir(space.path(Path::new(MEMORY))).unwrap().flatten();
    entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

/// A session finds too little shared memory, by any amount; with enough, the same scene runs.
fn memory_full_at_start(random: &mut Random) -> Result<Outcome, String> {
    let bytes = (1 << random.below(28)).max(4096) + random.below(1 << 16) * 4096 % (1 << 24);
    let space = NameSpace::with_tmpfs(Path::new(MEMORY), bytes)?;
    let place = Place::new();
    let output = place.path("out");
    let began = Instant::now();
    let ended = start_in(&space, &place, &output, &scenes::hold("lockstep", 0.02)).end();
    let over_after_ms = Some(began.elapsed().as_millis() as u64);
    let said = format!("{bytes} bytes: exit {:?}\n{}\n{}", ended.code, ended.err, ended.out);
    assert!(!ended.err.contains("panicked"), "{said}");
    let went_on = ended.code == Some(0);
    assert!(went_on || (ended.code == Some(1) && ended.err.contains(MEMORY)), "{said}");
    assert_eq!(memory_left(&space), Vec::<String>::new(), "{said}");
    assert!(!session_folder(ended.pid).exists(), "{said}");
    space.resize(Path::new(MEMORY), 1 << 30);
    let ended = start_in(&space, &place, &output, &scenes::hold("lockstep", 0.02)).end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    Ok(Outcome {
        went_on,
        named_after_ms: over_after_ms.filter(|_| !went_on),
        over_after_ms,
        ..Outcome::default()
    })
}

/// All shared memory is taken in the middle of a run, and clients try to join: the run goes on.
fn memory_full(random: &mut Random) -> Result<Outcome, String> {
    let space = NameSpace::with_tmpfs(Path::new(MEMORY), 1 << 30)?;
    let place = Place::new();
    let run = start_in(&space, &place, &place.path("out"), &scene(false));
    let session = run.session();
    let log = || {
        let folder = std::fs::read_dir(place.path("out")).ok()?.flatten().next()?.path();
        std::fs::metadata(folder.join("run.mcap")).ok().map(|meta| meta.len())
    };
    wait_for("a log", || log().filter(|bytes| *bytes > 1_000_000 + random.below(1_000_000)));
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
fn disk_full(random: &mut Random) -> Result<Outcome, String> {
    let place = Place::new();
    let output = place.path("out");
    std::fs::create_dir(&output).unwrap();
    let bytes = 2_000_000 + random.below(6_000_000);
    let space = NameSpace::with_tmpfs(&output, bytes)?;
    let began = Instant::now();
    let mut run = start_in(&space, &place, &output, &scene(false));
    wait_for("the end of the run", || run.is_over().then_some(()));
    let over_after_ms = Some(began.elapsed().as_millis() as u64);
    let ended = run.end();
    let said = format!("{bytes} bytes: exit {:?}\n{}\n{}", ended.code, ended.err, ended.out);
    let errors = Fault::DiskFull.allowed(false).errors;
    assert_eq!(ended.code, Some(1), "{said}");
    assert!(errors.iter().any(|words| ended.err.contains(words)), "{said}");
    assert!(!ended.err.contains("panicked"), "{said}");
    assert_nothing_left(ended.pid);
    let folder = std::fs::read_dir(space.path(&output)).unwrap().flatten().next().unwrap().path();
    let ticks = read(&folder).ticks.len() as u64;
    assert_replays(&folder);
    next_run_starts(&place);
    Ok(Outcome { ticks, over_after_ms, ..Outcome::default() })
}
