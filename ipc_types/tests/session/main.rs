//! A session: its services, its isolation, and what it leaves behind.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail the test")]

mod remains;

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use ipc_types::messages::services::{self, Service};
use ipc_types::messages::{Command, ControllerIndex, Event, Frame, Keyframe, Part, Removed, State, Volume};
use ipc_types::scene::{Policy, Wait};
use ipc_types::session::{Reader, Session, SessionError, SessionHost, SessionPlan, host_is_alive};

fn plan(controllers: &[&str]) -> SessionPlan {
    let controllers = controllers.iter().map(|name| (*name).to_owned()).collect();
    SessionPlan {
        controllers,
        volume_bytes: 4096,
        frame_bytes: 1024,
        sensors: false,
        tip_jacobian: false,
        recorder: true,
        wait: Wait::Hybrid,
        policy: Policy::Other,
    }
}

/// A host that plays the parts itself.
fn playing(plan: &SessionPlan) -> SessionHost {
    let host = SessionHost::create(plan).unwrap();
    host.announce().unwrap();
    host.session.claim(Part::Physics).unwrap();
    host.session.claim(Part::Drr).unwrap();
    host
}

fn name_of(folder: &Path) -> String {
    folder.file_name().unwrap().to_str().unwrap().to_owned()
}

fn shared_memory_of(session: &Path) -> usize {
    let name = format!("_{}_", name_of(session));
    let entries = std::fs::read_dir("/dev/shm").unwrap().flatten();
    entries.filter(|entry| entry.file_name().to_string_lossy().contains(&name)).count()
}

#[test]
fn messages_arrive_whole_and_nothing_stays_behind() {
    let host = playing(&plan(&["reference"]));
    let client = Session::join(host.session.folder()).unwrap();
    let publisher = host.session.publisher::<State>(&services::STATE).unwrap();
    let subscriber = client.subscriber::<State>(&services::STATE).unwrap();
    let mut state = State::zeroed();
    for tick in 0..3 {
        state.tick = tick;
        state.bend_rad = 0.5;
        publisher.send(&state).unwrap();
    }
    for tick in 0..3 {
        let received = subscriber.receive().unwrap().unwrap();
        assert_eq!(received.message().tick, tick);
        assert_eq!(received.message().bend_rad, 0.5);
    }
    assert!(subscriber.receive().unwrap().is_none());

    let removed = host.session.publisher::<Removed>(&services::REMOVED).unwrap();
    let listener = client.subscriber::<Removed>(&services::REMOVED).unwrap();
    let message = Removed { tick: 7, voxel_index_length: 2, ..Removed::zeroed() };
    removed.send_with_tail(&message, &[1, 0, 0, 0, 2, 0, 0, 0]).unwrap();
    assert_eq!(listener.receive().unwrap().unwrap().tail(), [1, 0, 0, 0, 2, 0, 0, 0]);

    let folder = host.session.folder().to_owned();
    assert!(shared_memory_of(client.folder()) > 0);
    drop((publisher, subscriber, removed, listener));
    let probe = Session::join(&folder).unwrap();
    drop(client);
    drop(host);
    assert!(!folder.exists());
    assert_eq!(shared_memory_of(probe.folder()), 0);
}

#[test]
fn a_late_joiner_receives_the_newest_state() {
    let host = playing(&plan(&[]));
    let publisher = host.session.publisher::<State>(&services::STATE).unwrap();
    publisher.send(&State { tick: 42, ..State::zeroed() }).unwrap();
    let client = Session::join(host.session.folder()).unwrap();
    let subscriber = client.subscriber::<State>(&services::STATE).unwrap();
    publisher.deliver_history().unwrap();
    assert_eq!(subscriber.receive().unwrap().unwrap().message().tick, 42);
}

#[test]
fn a_second_controller_of_the_same_name_is_refused_by_name() {
    let host = SessionHost::create(&plan(&["left"])).unwrap();
    host.announce().unwrap();
    let first = Session::join(host.session.folder()).unwrap();
    let second = Session::join(host.session.folder()).unwrap();
    let _publisher = first.command_publisher("left").unwrap();
    let refusal = second.command_publisher("left").unwrap_err();
    assert!(matches!(&refusal, SessionError::ControllerTaken { name } if name == "left"), "{refusal}");
    let unknown = second.command_publisher("right").unwrap_err();
    assert!(unknown.to_string().contains("it has: left"), "{unknown}");
}

#[test]
fn a_client_of_another_layout_is_refused_with_both_layouts() {
    let host = SessionHost::create(&plan(&["left"])).unwrap();
    let mut announcement = host.session.announcement().clone();
    announcement.layouts.insert("state".to_owned(), "0123456789abcdef".to_owned());
    std::fs::write(host.session.folder().join("session.json"), serde_json::to_string(&announcement).unwrap())
        .unwrap();
    let refusal = Session::join(host.session.folder()).unwrap_err().to_string();
    assert!(refusal.contains("0123456789abcdef") && refusal.contains("State"), "{refusal}");
    // A message of another type under a known name must be refused as well.
    host.announce().unwrap();
    let client = Session::join(host.session.folder()).unwrap();
    assert!(client.subscriber::<Event>(&services::STATE).is_err());
    assert!(client.subscriber::<Command>(&services::EVENT).is_err());
}

#[test]
fn two_sessions_do_not_meet() {
    let [first, second] = [(), ()].map(|()| playing(&plan(&[])));
    let publisher = first.session.publisher::<State>(&services::STATE).unwrap();
    let same = first.session.subscriber::<State>(&services::STATE).unwrap();
    let other = second.session.subscriber::<State>(&services::STATE).unwrap();
    publisher.send(&State::zeroed()).unwrap();
    assert!(same.receive().unwrap().is_some());
    assert!(other.receive().unwrap().is_none());
}

#[test]
fn a_sleeping_reader_is_woken() {
    let host = playing(&plan(&[]));
    let folder = host.session.folder().to_owned();
    let reader = std::thread::spawn(move || {
        let session = Session::join(&folder).unwrap();
        let subscriber = session.subscriber::<State>(&services::STATE).unwrap();
        let waiter = session.waiter(Reader::Drr).unwrap();
        let limit = Instant::now() + Duration::from_secs(20);
        let mut ticks = Vec::new();
        while ticks.len() < 200 && waiter.wait_until(limit, || subscriber.has_message()) {
            ticks.extend(subscriber.receive().unwrap().map(|received| received.message().tick));
        }
        ticks
    });
    let publisher = host.session.publisher::<State>(&services::STATE).unwrap();
    let waker = host.session.waker(Reader::Drr).unwrap();
    std::thread::sleep(Duration::from_millis(100));
    for tick in 0..200 {
        publisher.send(&State { tick, ..State::zeroed() }).unwrap();
        waker.wake();
        if tick % 7 == 0 {
            std::thread::sleep(Duration::from_micros(500));
        }
    }
    assert_eq!(reader.join().unwrap(), (0..200).collect::<Vec<_>>());
}

/// A wait shorter than a microsecond must end: passed to the kernel as 0 µs it would mean no limit, and on a
/// loaded machine the recorder would sleep through whole runs.
#[test]
fn a_wait_ends_however_near_its_deadline_is() {
    let host = SessionHost::create(&plan(&[])).unwrap();
    host.announce().unwrap();
    let folder = host.session.folder().to_owned();
    let (done, is_done) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let session = Session::join(&folder).unwrap();
        let waiter = session.waiter(Reader::Recorder).unwrap();
        for nanoseconds in (0..20_000).step_by(40) {
            // Around the end of the yielding phase, where the sleep begins.
            let deadline = Instant::now() + ipc_types::wake::YIELD_TIME + Duration::from_nanos(nanoseconds);
            assert!(!waiter.wait_until(deadline, || false));
        }
        done.send(()).unwrap();
    });
    is_done.recv_timeout(Duration::from_secs(60)).expect("every wait ends");
}

/// The hub must not be reported gone when only its folder's name is gone.
#[test]
fn a_host_whose_folder_was_removed_is_alive_to_its_clients_and_cannot_be_joined() {
    let host = SessionHost::create(&plan(&["left"])).unwrap();
    host.announce().unwrap();
    let client = Session::join(host.session.folder()).unwrap();
    let folder = host.session.folder().to_owned();
    fs::remove_dir_all(&folder).unwrap();
    assert!(client.host_is_alive() && !host_is_alive(&folder));
    let refusal = Session::join(&folder).unwrap_err().to_string();
    let words = ["no running session", &name_of(&folder), "whose folder was removed"];
    assert!(words.iter().all(|word| refusal.contains(word)), "{refusal}");
    drop(host);
    assert!(!client.host_is_alive());
    assert_eq!(shared_memory_of(client.folder()), 0);
}

/// The memory required for a port follows from what it reserves: not less, and hardly more.
#[test]
fn a_port_asks_for_the_memory_that_it_reserves() {
    let plan = SessionPlan { volume_bytes: 20_000_000, frame_bytes: 300_000, ..plan(&["left"]) };
    let host = playing(&plan);
    let segments = || {
        let prefix = format!("trabecula010_{}_", name_of(host.session.folder()));
        let entries = fs::read_dir("/dev/shm").unwrap().flatten();
        let ours = entries.filter(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            name.starts_with(&prefix) && name.ends_with(".data")
        });
        ours.map(|entry| entry.metadata().unwrap().len()).sum::<u64>()
    };
    let reckoned = |service: Service, before: u64| {
        let (made, need) = (segments() - before, service.reserved_bytes());
        assert!(
            made > 0 && made <= need && need <= made + made / 10 + (1 << 14),
            "{}: {made} of {need}",
            service.name
        );
    };
    let before = segments();
    let _volume = host.session.publisher::<Volume>(&services::VOLUME).unwrap();
    reckoned(Service { max_bytes: plan.volume_bytes, ..services::VOLUME }, before);
    let before = segments();
    let _frames = host.session.publisher::<Frame>(&services::FRAME).unwrap();
    reckoned(Service { max_bytes: plan.frame_bytes, ..services::FRAME }, before);
    let before = segments();
    let _keyframes = host.session.publisher::<Keyframe>(&services::KEYFRAME).unwrap();
    reckoned(services::KEYFRAME, before);
    let before = segments();
    let _commands = host.session.command_publisher("left").unwrap();
    reckoned(services::COMMAND, before);
    let before = segments();
    let _events = host.session.publisher::<Event>(&services::EVENT).unwrap();
    reckoned(services::EVENT, before);
}

/// Another program must not be able to take the port of an absent part and have its messages accepted.
#[test]
fn a_port_of_a_part_is_refused_to_others_and_what_they_send_is_passed_over() {
    let host = SessionHost::create(&plan(&["left"])).unwrap();
    host.announce().unwrap();
    let [physics, stranger] = [(), ()].map(|()| Session::join(host.session.folder()).unwrap());
    physics.claim(Part::Physics).unwrap();
    physics.claim(Part::Physics).unwrap();
    let taken = stranger.claim(Part::Physics).unwrap_err();
    assert!(matches!(taken, SessionError::PartTaken { part: Part::Physics }), "{taken}");
    let refusal = stranger.publisher::<Keyframe>(&services::KEYFRAME).unwrap_err();
    assert!(refusal.to_string().contains("only the physics may write to service `keyframe`"), "{refusal}");
    // With the transport alone, bypassing our library.
    let service =
        stranger.node().service_builder(&"keyframe".try_into().unwrap()).publish_subscribe::<[u8]>();
    let port = service.open().unwrap().publisher_builder().initial_max_slice_len(64).create().unwrap();
    let reader = host.session.lossless_subscriber::<Keyframe>(&services::KEYFRAME).unwrap();
    for _ in 0..3 {
        port.loan_slice_uninit(7).unwrap().write_from_fn(|_| 0x5a).send().unwrap();
    }
    assert!(reader.receive().unwrap().is_none());
    assert_eq!(reader.foreign_messages(), 3);
    drop(port);
    let keyframes = physics.publisher::<Keyframe>(&services::KEYFRAME).unwrap();
    keyframes.send(&Keyframe { tick: 9, ..Keyframe::zeroed() }).unwrap();
    let received = reader.receive().unwrap().unwrap();
    assert_eq!(
        (received.message().tick, received.part(), reader.foreign_messages()),
        (9, Some(Part::Physics), 3)
    );
}

/// A reader killed in its sleep leaves its flag raised; that must not cost every message a system call.
#[test]
fn a_killed_sleeping_reader_costs_its_writers_nothing() {
    const SLEEPER: &str = "TRABECULA_TEST_SLEEPER";
    if let Some(folder) = std::env::var_os(SLEEPER) {
        let session = Session::join(Path::new(&folder)).unwrap();
        let waiter = session.waiter(Reader::Controller(ControllerIndex(0))).unwrap();
        println!("asleep");
        waiter.wait_until(Instant::now() + Duration::from_secs(60), || false);
    }
    let host = SessionHost::create(&plan(&["left"])).unwrap();
    host.announce().unwrap();
    let waker = host.session.waker(Reader::Controller(ControllerIndex(0))).unwrap();
    let mut sleeper = std::process::Command::new(std::env::current_exe().unwrap());
    sleeper.args(["a_killed_sleeping_reader_costs_its_writers_nothing", "--exact", "--nocapture"]);
    let sleeper = sleeper.env(SLEEPER, host.session.folder()).stdout(std::process::Stdio::piped());
    let mut sleeper = sleeper.spawn().unwrap();
    let mut said = std::io::BufReader::new(sleeper.stdout.take().unwrap());
    let mut line = String::new();
    while !line.contains("asleep") {
        line.clear();
        assert!(std::io::BufRead::read_line(&mut said, &mut line).unwrap() > 0, "the reader is there");
    }
    // Time to fall asleep.
    std::thread::sleep(Duration::from_millis(200));
    sleeper.kill().unwrap();
    sleeper.wait().unwrap();
    let calls = (0..1000).filter(|_| waker.try_to_wake()).count();
    assert!(calls <= 1000 / 64 + 2, "{calls} system calls for 1000 messages to no reader");
    // A reader that reconnects is woken immediately.
    let back = Session::join(host.session.folder()).unwrap();
    let _waiter = back.waiter(Reader::Controller(ControllerIndex(0))).unwrap();
    assert!(waker.try_to_wake());
}

/// Regression: the launcher wrote a run's log path, and the reason for its end, in two steps. A viewer that
/// looked in between waited for a log without a name, and a recorder could report a stopped run as complete.
#[test]
fn a_file_of_the_host_is_seen_whole_or_not_at_all() {
    const FILES: usize = 500;
    let host = SessionHost::create(&plan(&[])).unwrap();
    let folder = host.session.folder().to_owned();
    let limit = Instant::now() + Duration::from_secs(60);
    let reader = std::thread::spawn(move || {
        let mut seen = 0;
        while seen < FILES && Instant::now() < limit {
            match fs::read_to_string(folder.join(format!("file{seen}"))) {
                Ok(text) => {
                    assert_eq!(text, "all of it");
                    seen += 1;
                }
                Err(cause) => assert_eq!(cause.kind(), std::io::ErrorKind::NotFound),
            }
        }
        seen
    });
    for number in 0..FILES {
        host.write(&format!("file{number}"), b"all of it").unwrap();
    }
    assert_eq!(reader.join().unwrap(), FILES);
}
