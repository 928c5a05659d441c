//! One trial: a run, a fault in the middle of it, and the checks afterwards.

use std::path::{Path, PathBuf};
use std::process::Command as Program;
use std::time::{Duration, Instant};

use fastrand::Rng;
use ipc_types::messages::CONTROL_STOP;
use run_log::EndReason;
use rustix::process::{Pid, Resource, Rlimit, Signal, prlimit};

use crate::clock::stepping_clock;
use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{
    Ended, Place, Run, assert_nothing_left, kill_all, parts_of, session_folder, shared_memory_of, signal,
    wait_for,
};
use crate::common::scenes;
use crate::fault::{Fault, Victim};
use crate::guest::{Behaviour, Guest};
use crate::looks::{LOOK_LIMIT, Looks};
use crate::scarce::{disk_full, memory_full, memory_full_at_start};
use crate::table::Outcome;

/// Number of ticks after a fault for the run to count as continued.
const TICKS_AFTER: u64 = 200;
/// Ticks that a killed recorder may lose: 100 ms, plus its delay on a machine as loaded as these tests make
/// it.
const RECORDER_LOSS: u64 = 400;
/// A log's header is shorter: scene, calibration and schemas.
const HEADER_BYTES: u64 = 100_000;
const STOP_TIME: Duration = Duration::from_secs(2);

/// The scene of most trials, with every part and optionally a guest.
pub fn scene(lockstep: bool) -> String {
    let mode = if lockstep { "lockstep" } else { "realtime" };
    let guest =
        "\n[[controller]]\nname = \"guest\"\ndrives = [\"c_arm\"]\nexternal = true\noptional = true\n";
    // Long enough for a lockstep run to be running at the fault; late controllers are soon replaced or
    // reported.
    let keys = "seed = 7\nhold_ticks = 20\ncontroller_limit_ms = 1500.0";
    scenes::drill(mode, 600.0).replace("seed = 7", keys) + guest + &scenes::keyframes(0.25)
}

/// Performs a trial. Panics if a check fails.
pub fn make(fault: Fault, seed: u64) -> Outcome {
    let mut random = Rng::with_seed(seed);
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

    /// Returns the newest published tick.
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

    /// A log without any tick, of a recorder killed too early, has a separate test.
    fn wait_for_recorded_ticks(&self) {
        let length = || self.run.log().and_then(|log| log.metadata().ok()).map_or(0, |file| file.len());
        wait_for("the first ticks in the log", || (length() > HEADER_BYTES).then_some(()));
    }

    fn pid_of(&self, victim: Victim) -> u32 {
        match victim {
            Victim::Launcher => self.run.pid(),
            part => self.run.part(part.part()),
        }
    }
}

/// Signals a process according to the fault, calling `look` all the time.
fn disturb(fault: Fault, pid: u32, mut look: impl FnMut()) {
    match fault {
        Fault::Kill(_) => signal(pid, Signal::KILL),
        Fault::Stop(_) => {
            signal(pid, Signal::STOP);
            let end = Instant::now() + STOP_TIME;
            while Instant::now() < end {
                look();
            }
            signal(pid, Signal::CONT);
        }
        _ => {
            for _ in 0..40 {
                signal(pid, Signal::STOP);
                std::thread::sleep(Duration::from_millis(20));
                signal(pid, Signal::CONT);
                look();
            }
        }
    }
}

/// Starts the run, causes the fault, and observes the result.
fn in_the_middle(fault: Fault, random: &mut Rng) -> Result<Outcome, String> {
    let lockstep = random.u64(..3) == 0;
    let preload = match fault {
        Fault::ClockStep => Some(stepping_clock()),
        _ => None,
    };
    let environment: Vec<(&str, &Path)> = preload.iter().map(|path| ("LD_PRELOAD", path.as_path())).collect();
    let mut watched = Watched::start(lockstep, &environment);
    let mut guests = Vec::new();
    if fault.needs_guest() {
        guests.push(guest(&watched, Behaviour::Steady, random));
    }
    watched.wait_for_tick(100 + random.u64(..300));
    watched.wait_for_recorded_ticks();
    // In lockstep its silence would end the run.
    if fault.may_have_company() && !lockstep && random.u64(..3) == 0 {
        let behaviour = Behaviour::bad(random);
        guests.push(Guest::start(&watched.session, "guest", behaviour, random.u64(..)));
        std::thread::sleep(Duration::from_millis(random.u64(..200)));
    }
    let published = watched.published();
    let mut looks = Looks::new(fault.allowed(lockstep).errors);
    act(fault, &mut watched, &mut guests, random, &mut looks);
    if !matches!(fault, Fault::Kill(_) | Fault::Stop(_) | Fault::Starve(_)) {
        // The time to cause the fault does not count.
        looks.restart();
    }
    let (ended, went_on) = observe(fault, &mut watched, &mut looks);
    drop(guests);
    Ok(judge(fault, &watched, &ended, published, looks.outcome(went_on)))
}

fn guest(watched: &Watched, behaviour: Behaviour, random: &mut Rng) -> Guest {
    let mut guest = Guest::start(&watched.session, "guest", behaviour, random.u64(..));
    guest.ready().unwrap();
    guest
}

fn act(fault: Fault, watched: &mut Watched, guests: &mut Vec<Guest>, random: &mut Rng, looks: &mut Looks) {
    match fault {
        Fault::Kill(victim) | Fault::Stop(victim) | Fault::Starve(victim) => {
            let pid = match victim {
                Victim::Client => guests[0].pid(),
                part => watched.pid_of(part),
            };
            looks.restart();
            disturb(fault, pid, || looks.look(&watched.run));
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
            let limit = Some(3_000_000 + random.u64(..3_000_000));
            prlimit(Some(recorder), Resource::Fsize, Rlimit { current: limit, maximum: limit }).unwrap();
        }
        Fault::AllKilled => kill_all(watched.run.pid(), &watched.session),
        Fault::TwoHubs => second_hub(random),
        Fault::OtherVersion => drop(guest(watched, Behaviour::OtherVersion, random)),
        // The clock steps all the time.
        Fault::ClockStep => std::thread::sleep(Duration::from_millis(300)),
        other => unreachable!("{other:?} has a trial of its own"),
    }
}

/// Clients that are killed at any moment of their joining.
fn killed_joining(session: &Path, name: &str, random: &mut Rng) {
    for _ in 0..3 {
        let mut guest = Guest::start(session, name, Behaviour::Steady, random.u64(..));
        std::thread::sleep(Duration::from_micros(random.u64(..30_000)));
        guest.kill();
    }
}

/// Another hub runs for a while; one of its processes is killed.
fn second_hub(random: &mut Rng) {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 600.0));
    let session = run.session();
    let client = Client::join(&session);
    client.wait_for_state(|state| state.tick >= 100);
    drop(client);
    let launcher = random.u64(..2) == 0;
    signal(if launcher { run.pid() } else { run.part("physics") }, Signal::KILL);
    let ended = run.end();
    assert_eq!(ended.code, if launcher { None } else { Some(1) }, "{}", ended.err);
    wait_for("the end of its parts", || parts_of(&session).is_empty().then_some(()));
}

/// Waits until the run has ended, or has computed enough ticks after the fault and is stopped. It must report
/// the error, or compute a tick, within the limit of polls.
fn observe(fault: Fault, watched: &mut Watched, looks: &mut Looks) -> (Ended, bool) {
    let allowed = fault.allowed(watched.lockstep);
    let log =
        |watched: &Watched| watched.run.log().and_then(|log| log.metadata().ok()).map(|meta| meta.len());
    let mut length = None;
    // Queued states do not count.
    let newest = watched.published();
    let (before, mut first) = (looks.count(), None);
    let went_on = loop {
        looks.look(&watched.run);
        if watched.run.is_over() {
            break false;
        }
        if fault == Fault::FileLimit && length != log(watched) {
            // The fault has not occurred yet.
            length = log(watched);
            looks.restart();
        }
        if !allowed.goes_on {
            continue;
        }
        let made = watched.published() - newest;
        if made > 0 {
            first.get_or_insert(looks.count() - before);
        }
        if made >= TICKS_AFTER {
            break true;
        }
    };
    if went_on {
        assert!(first <= Some(LOOK_LIMIT), "{}: the next tick came after {first:?} looks", fault.name());
        watched.client.as_ref().unwrap().ask(CONTROL_STOP, 0);
    }
    watched.client = None;
    let session = watched.session.clone();
    let run = std::mem::replace(&mut watched.run, Run::of(Program::new("true"), PathBuf::new()));
    let ended = run.end();
    // The parts of a killed launcher are ended by the kernel's signal.
    wait_for("the end of all parts", || parts_of(&session).is_empty().then_some(()));
    looks.end(&ended.err);
    if !went_on && !is_launcher_killed(fault) {
        looks.assert_in_time(&format!("the error after {}", fault.name()));
    }
    (ended, went_on)
}

/// No process is left to report anything; the log's end names the launcher.
fn is_launcher_killed(fault: Fault) -> bool {
    matches!(fault, Fault::Kill(Victim::Launcher) | Fault::AllKilled)
}

/// Checks that must hold after every fault.
fn judge(fault: Fault, watched: &Watched, ended: &Ended, published: u64, outcome: Outcome) -> Outcome {
    let said = format!("{}: exit {:?}\n{}\n{}", fault.name(), ended.code, ended.err, ended.out);
    let launcher_killed = is_launcher_killed(fault);
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
        // Another trial's host may have found it, and may not have finished.
        wait_for("the removal of the dead session", || (!session_folder(ended.pid).exists()).then_some(()));
        assert_eq!(shared_memory_of(ended.pid), Vec::<String>::new());
    }
    assert_nothing_left(ended.pid);
    assert_no_hidden_file(&ended.folder);
    Outcome { ticks, lost_before, lost_counted, ..outcome }
}

fn assert_reason(fault: Fault, went_on: bool, reason: &EndReason) {
    match (fault, reason) {
        (_, EndReason::Completed | EndReason::Stopped) => assert!(went_on, "{fault:?}"),
        (Fault::Kill(victim), EndReason::PartDied(name)) => {
            let known = [victim.part(), "reference", "physics"];
            assert!(known.contains(&name.as_str()), "{fault:?}: {name}");
        }
        (_, EndReason::PartDied(_) | EndReason::ControllerLate(_)) => assert!(!went_on, "{fault:?}"),
        other => panic!("{other:?}"),
    }
}

/// Asserts that the file with the end reason, from the launcher to the recorder, is gone.
fn assert_no_hidden_file(folder: &Path) {
    let hidden = |entry: &std::fs::DirEntry| entry.file_name().to_string_lossy().starts_with('.');
    let left: Vec<_> = std::fs::read_dir(folder).unwrap().flatten().filter(hidden).collect();
    assert!(left.is_empty(), "{left:?}");
}

pub fn next_run_starts(place: &Place) {
    let scene = place.path("next.toml");
    std::fs::write(&scene, scenes::hold("lockstep", 0.02)).unwrap();
    let ended = Run::start(&scene, place.path("next"), &[]).end();
    assert_eq!(ended.code, Some(0), "the next run: {}", ended.err);
}

/// The controller awaited at the start dies while it joins, and returns.
fn awaited_join_death(random: &mut Rng) -> Result<Outcome, String> {
    let place = Place::new();
    let mode = if random.u64(..2) == 0 { "lockstep" } else { "realtime" };
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
