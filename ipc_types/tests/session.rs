//! A session: its services, its isolation, and what it leaves behind.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail the test")]

use std::time::{Duration, Instant};

use ipc_types::messages::{Command, Event, Removed, State};
use ipc_types::scene::{Policy, Wait};
use ipc_types::services;
use ipc_types::session::{Reader, Session, SessionError, SessionHost, SessionPlan};

fn plan(controllers: &[&str]) -> SessionPlan {
    let controllers = controllers.iter().map(|name| (*name).to_owned()).collect();
    SessionPlan {
        controllers,
        volume_bytes: 4096,
        frame_bytes: 1024,
        recorder: true,
        wait: Wait::Hybrid,
        policy: Policy::Other,
    }
}

fn shared_memory_of(session: &Session) -> usize {
    let id = session.folder().file_name().unwrap().to_string_lossy().into_owned();
    let entries = std::fs::read_dir("/dev/shm").unwrap().flatten();
    entries.filter(|entry| entry.file_name().to_string_lossy().contains(&format!("_{id}_"))).count()
}

#[test]
fn messages_arrive_whole_and_nothing_stays_behind() {
    let host = SessionHost::create(&plan(&["reference"])).unwrap();
    host.announce().unwrap();
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
    assert!(shared_memory_of(&client) > 0);
    drop((publisher, subscriber, removed, listener));
    let probe = Session::join(&folder).unwrap();
    drop(client);
    drop(host);
    assert!(!folder.exists());
    assert_eq!(shared_memory_of(&probe), 0);
}

#[test]
fn a_late_joiner_receives_the_newest_state() {
    let host = SessionHost::create(&plan(&[])).unwrap();
    host.announce().unwrap();
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
    // A message of another type under a known name is refused as well.
    host.announce().unwrap();
    let client = Session::join(host.session.folder()).unwrap();
    assert!(client.subscriber::<Event>(&services::STATE).is_err());
    assert!(client.subscriber::<Command>(&services::EVENT).is_err());
}

#[test]
fn two_sessions_do_not_meet() {
    let first = SessionHost::create(&plan(&[])).unwrap();
    let second = SessionHost::create(&plan(&[])).unwrap();
    first.announce().unwrap();
    second.announce().unwrap();
    let publisher = first.session.publisher::<State>(&services::STATE).unwrap();
    let same = first.session.subscriber::<State>(&services::STATE).unwrap();
    let other = second.session.subscriber::<State>(&services::STATE).unwrap();
    publisher.send(&State::zeroed()).unwrap();
    assert!(same.receive().unwrap().is_some());
    assert!(other.receive().unwrap().is_none());
}

#[test]
fn a_sleeping_reader_is_woken() {
    let host = SessionHost::create(&plan(&[])).unwrap();
    host.announce().unwrap();
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

/// A wait whose deadline was less than a microsecond away never ended: the kernel was asked to wait for 0 µs, which it
/// takes for no limit. On a loaded machine the recorder slept through whole runs.
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
            // Around the end of the yielding, where the wait begins.
            let deadline = Instant::now() + ipc_types::wake::YIELD_TIME + Duration::from_nanos(nanoseconds);
            assert!(!waiter.wait_until(deadline, || false));
        }
        done.send(()).unwrap();
    });
    is_done.recv_timeout(Duration::from_secs(60)).expect("every wait ends");
}

#[test]
fn the_session_of_a_dead_host_is_wiped_by_the_next_host() {
    // No process has this number: the largest one allowed is 4194304.
    let stale = ipc_types::session::sessions_folder().join("4194305-0");
    // Makes the folder of all sessions, if this is the first.
    drop(SessionHost::create(&plan(&[])).unwrap());
    std::fs::create_dir_all(&stale).unwrap();
    let segment = std::path::Path::new("/dev/shm/trabecula010_4194305-0_x.data");
    std::fs::write(segment, b"left behind").unwrap();
    let _host = SessionHost::create(&plan(&[])).unwrap();
    assert!(!stale.exists() && !segment.exists());
}

/// A process number says little: it may be another's by now, or another process in a container's view.
#[test]
fn a_session_whose_host_is_gone_is_wiped_though_its_number_lives() {
    let first = SessionHost::create(&plan(&[])).unwrap();
    // Process 1 always runs; it holds no lock on this session.
    let stale = ipc_types::session::sessions_folder().join("1-0");
    std::fs::create_dir_all(&stale).unwrap();
    std::fs::write(stale.join("wake.flags"), [0; 2048]).unwrap();
    let _second = SessionHost::create(&plan(&[])).unwrap();
    assert!(!stale.exists());
    assert!(first.session.folder().join("wake.flags").exists(), "a living host's session is not touched");
}

/// A host that had looked at the lock of a session that just ended then wiped the next one, which had its name.
#[test]
fn a_session_does_not_have_the_name_of_an_earlier_one() {
    let folder = |host: SessionHost| host.session.folder().to_owned();
    let [first, second] = [(), ()].map(|()| folder(SessionHost::create(&plan(&[])).unwrap()));
    assert_ne!(first, second);
}

/// A host looks for dead sessions while another one is being made: what it finds half made is not dead.
#[test]
fn a_session_in_the_making_is_not_taken_for_a_dead_one() {
    let over = std::sync::atomic::AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !over.load(std::sync::atomic::Ordering::Relaxed) {
                ipc_types::session::wipe_dead_sessions();
            }
        });
        let intact: Vec<bool> = (0..40)
            .map(|_| {
                SessionHost::create(&plan(&[]))
                    .is_ok_and(|host| host.session.folder().join("wake.flags").exists())
            })
            .collect();
        over.store(true, std::sync::atomic::Ordering::Relaxed);
        assert_eq!(intact, vec![true; 40]);
    });
}
