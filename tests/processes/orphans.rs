//! A killed launcher leaves nothing running, and a complete log.

use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::process::{Command, Stdio};
use std::time::Duration;

use fastrand::Rng;
use run_log::EndReason;
use rustix::process::Signal;
use test_support::limited::{COMMAND_LIMIT, limited_output_of};

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{
    Place, Run, parts_of, processes_with, session_folder, shared_memory_of, signal, wait_for,
};
use crate::common::scenes;

/// Returns a number of seconds that no other process sleeps.
fn unmistakable(kind: u32) -> String {
    format!("8{kind}{:05}.{:03}", std::process::id() % 100_000, fastrand::u32(..1000))
}

/// A program that starts others in every way that leaves its group, its session, its parent or its
/// environment.
fn with_descendants(mode: &str, times: &[String; 4]) -> String {
    let [child, daemon, bare, own] = times;
    let script = format!(
        "sleep {child} & (setsid sh -c 'sleep {daemon} & exit' &) ; (env -i setsid sleep {bare} &) ; sleep {own}; :"
    );
    let program = format!(
        "[[controller]]\nname = \"guest\"\ndrives = []\noptional = true\ncommand = [\"sh\", \"-c\", {script:?}]\n"
    );
    scenes::hold(mode, 600.0) + &program
}

/// Starts a run with such a program, and waits for all that it starts.
fn started(place: &Place, times: &[String; 4]) -> (Run, Client) {
    let run = place.start(&with_descendants("realtime", times));
    let client = Client::at(&run, 100);
    for time in times {
        wait_for("what the program starts", || {
            let sleeps = processes_with(&[format!("sleep {time} ")]);
            sleeps.iter().any(|(_, line)| line.starts_with("sleep")).then_some(())
        });
    }
    (run, client)
}

/// Regression: a parent-death signal reaches one generation; a controller's own children stayed.
fn descendants_end(end: impl Fn(&Run)) {
    let times = [0, 1, 2, 3].map(unmistakable);
    let place = Place::new();
    let (run, client) = started(&place, &times);
    drop(client);
    end(&run);
    let session = session_folder(run.pid());
    run.end();
    wait_for("the end of all that the program has started", || {
        (processes_with(&times).is_empty() && parts_of(&session).is_empty()).then_some(())
    });
}

#[test]
fn a_grandchild_ends_with_a_killed_launcher() {
    descendants_end(|run| signal(run.pid(), Signal::KILL));
}

#[test]
fn a_grandchild_ends_with_an_interrupted_run() {
    descendants_end(|run| signal(run.pid(), Signal::INT));
}

/// Regression: it was reparented to init, and stayed forever.
#[test]
fn a_grandchild_ends_with_a_killed_keeper_and_the_run_goes_on() {
    let times = [0, 1, 2, 3].map(unmistakable);
    let place = Place::new();
    let (run, client) = started(&place, &times);
    let all = processes_with(&times);
    let (keeper, _) = all.into_iter().find(|(_, line)| line.contains(" proc keep ")).unwrap();
    signal(keeper, Signal::KILL);
    for _ in 0..4000 {
        std::thread::sleep(Duration::from_millis(5));
        if processes_with(&times).is_empty() {
            break;
        }
    }
    let left = processes_with(&times);
    // A failing test leaves nothing, either.
    left.iter().for_each(|(pid, _)| signal(*pid, Signal::KILL));
    assert!(left.is_empty(), "{left:?} of the keeper {keeper}");
    let tick = client.wait_for_state(|_| true).tick;
    client.wait_for_state(|state| state.tick >= tick + 100);
    drop(client);
    signal(run.pid(), Signal::INT);
    let ended = run.end();
    assert_eq!(ended.code, Some(130), "{}", ended.err);
    assert_replays(&ended.folder);
}

#[test]
fn a_grandchild_ends_with_its_program_and_the_run_goes_on() {
    let times = [0, 1, 2, 3].map(unmistakable);
    let place = Place::new();
    let (_run, client) = started(&place, &times);
    let is_shell =
        |pid: u32| std::fs::read_to_string(format!("/proc/{pid}/comm")).is_ok_and(|it| it == "sh\n");
    let (program, _) = processes_with(&times[3..]).into_iter().find(|(pid, _)| is_shell(*pid)).unwrap();
    signal(program, Signal::KILL);
    wait_for("the end of what it started", || processes_with(&times).is_empty().then_some(()));
    let tick = client.wait_for_state(|_| true).tick;
    client.wait_for_state(|state| state.tick >= tick + 200);
    let said = wait_for("the event", || {
        client.events().into_iter().map(|(_, text)| text).find(|text| text.contains("guest"))
    });
    assert!(said.contains("ended (signal: 9 (SIGKILL))"), "{said}");
}

/// Programs that each start the next and end. Regression: a scan of `/proc` misses a program that was started
/// after the listing by one that ended before its entry was read: 6 of 200 such chains kept running.
#[test]
fn a_relay_of_programs_ends_with_the_program_that_began_it() {
    let folder = tempfile::tempdir().unwrap();
    let relay = folder.path().join("relay.sh");
    let script = "[ $1 -gt 0 ] && { sh $0 $(( $1 - 1 )) $2 & exit; }\nexec sleep $2\n";
    std::fs::write(&relay, script).unwrap();
    for trial in 0..6 {
        let time = unmistakable(4);
        let begin = format!(
            "for i in 1 2 3 4 5 6 7 8; do sh {} 400 {time} & done; sleep 0.0{}",
            relay.display(),
            2 + trial % 5
        );
        let (_launcher, leash) = UnixStream::pair().unwrap();
        let mut keeper = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        keeper.args(["proc", "keep", "--", "sh", "-c", &begin]).stdin(OwnedFd::from(leash));
        let keeper = keeper.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let ended = limited_output_of(keeper, COMMAND_LIMIT, "the keeper");
        let left = processes_with(std::slice::from_ref(&time));
        assert!(ended.status.success() && left.is_empty(), "trial {trial}: {ended:?}, left: {left:?}");
    }
}

/// Killed at any line of its start, the launcher leaves nothing running, and the next run removes the rest.
#[test]
fn a_launcher_that_is_killed_while_it_starts_leaves_nothing() {
    let mut random = Rng::with_seed(9);
    for trial in 0..6 {
        let times = [0, 1, 2, 3].map(unmistakable);
        let place = Place::new();
        let run = place.start(&with_descendants("lockstep", &times));
        let wait_us = random.u64(..400_000);
        std::thread::sleep(Duration::from_micros(wait_us));
        let launcher = run.pid();
        signal(launcher, Signal::KILL);
        run.end();
        let session = session_folder(launcher);
        wait_for(&format!("the end of all parts, trial {trial}, killed after {wait_us} us"), || {
            (processes_with(&times).is_empty() && parts_of(&session).is_empty()).then_some(())
        });
        if trial == 5 {
            place.complete(&scenes::hold("lockstep", 0.05));
            assert!(!session.exists() && shared_memory_of(launcher).is_empty());
        }
    }
}

/// Stops a process while it computes rather than waits: a physics is then most likely in its step. If the
/// system does not show that (proc_pid_syscall(5)), at any moment.
fn stop_at_work(process: u32, random: &mut Rng) {
    for _ in 0..1000 {
        std::thread::sleep(Duration::from_micros(random.u64(..3_000)));
        signal(process, Signal::STOP);
        let place = wait_for("a stopped process", || {
            let place = std::fs::read_to_string(format!("/proc/{process}/syscall"));
            place.map_or_else(
                |_| Some("-1".to_owned()),
                |place| Some(place).filter(|place| place != "running\n"),
            )
        });
        if place.starts_with("-1") {
            return;
        }
        signal(process, Signal::CONT);
    }
}

/// Regression: recorder and physics were ended at the same moment, and the last tick was in no log.
#[test]
fn a_killed_launcher_costs_no_published_tick() {
    let mut random = Rng::with_seed(22);
    for trial in 0..6 {
        let mode = ["realtime", "lockstep", "lockstep"][trial % 3];
        let place = Place::new();
        let run = place.start(&scenes::hold(mode, 600.0));
        let session = run.session();
        let client = Client::join(&session);
        client.wait_for_state(|state| state.tick >= 100);
        let physics = run.part("physics");
        stop_at_work(physics, &mut random);
        signal(run.pid(), Signal::KILL);
        let ended = run.end();
        std::thread::sleep(Duration::from_millis(300));
        signal(physics, Signal::CONT);
        let mut published = 0;
        wait_for("the end of all parts", || {
            while let Some(state) = client.states.receive().unwrap() {
                published = state.message().tick;
            }
            parts_of(&session).is_empty().then_some(())
        });
        while let Some(state) = client.states.receive().unwrap() {
            published = state.message().tick;
        }
        let log = read(&ended.folder);
        assert_eq!(log.ticks.len() as u64, published, "{mode}, trial {trial}");
        assert_eq!(log.marker.unwrap().reason, EndReason::PartDied("launcher".to_owned()));
        assert_replays(&ended.folder);
    }
}
