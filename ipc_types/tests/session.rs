//! A session: its services, its isolation, and what it leaves behind.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail the test")]

use std::fs::{self, File, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ipc_types::messages::{Command, ControllerIndex, Event, Frame, Keyframe, Part, Removed, State, Volume};
use ipc_types::scene::{Policy, Wait};
use ipc_types::services::{self, Service};
use ipc_types::session::{Reader, Session, SessionError, SessionHost, SessionPlan, host_is_alive};
use rustix::fs::{FlockOperation, flock};
use tempfile::TempDir;

fn plan(controllers: &[&str]) -> SessionPlan {
    let controllers = controllers.iter().map(|name| (*name).to_owned()).collect();
    SessionPlan {
        controllers,
        volume_bytes: 4096,
        frame_bytes: 1024,
        sensors: false,
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

fn shared_memory_of(session: &Session) -> usize {
    let id = session.folder().file_name().unwrap().to_string_lossy().into_owned();
    let entries = std::fs::read_dir("/dev/shm").unwrap().flatten();
    entries.filter(|entry| entry.file_name().to_string_lossy().contains(&format!("_{id}_"))).count()
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

/// A wait shorter than a microsecond must end: passed to the kernel as 0 µs it would mean no limit, and on a loaded machine the recorder
/// would sleep through whole runs.
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

/// The sessions folder, and the host whose session shows where it is.
fn sessions() -> (PathBuf, SessionHost) {
    let host = SessionHost::create(&plan(&[])).unwrap();
    (host.session.folder().parent().unwrap().to_owned(), host)
}

/// A private folder with a session's name, as a killed host leaves it, but changed by `change` before any host can see it: until then its
/// name is none of a session's. The hosts of other tests, which run at the same time, would remove it.
fn changed(sessions: &Path, change: impl FnOnce(&Path, &str)) -> Placed {
    let hidden = tempfile::Builder::new().prefix("hidden-").rand_bytes(11).tempdir_in(sessions).unwrap();
    let name = name_of(hidden.path()).replace("hidden-", "");
    fs::set_permissions(hidden.path(), Permissions::from_mode(0o700)).unwrap();
    fs::write(hidden.path().join("session.id"), &name).unwrap();
    change(hidden.path(), &name);
    let placed = Placed(sessions.join(name));
    fs::rename(hidden.keep(), &placed.0).unwrap();
    placed
}

/// A folder that is removed on drop.
struct Placed(PathBuf);

impl Drop for Placed {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A private folder with a session's name and its lock: once the lock is dropped it is as a killed host leaves it.
fn locked(sessions: &Path) -> (TempDir, File) {
    let folder = tempfile::Builder::new().prefix("").rand_bytes(11).tempdir_in(sessions).unwrap();
    let lock =
        File::open(folder.path()).ok().filter(|lock| flock(lock, FlockOperation::LockExclusive).is_ok());
    let Some(lock) = lock.filter(|_| folder.path().exists()) else {
        // Another test's host was quicker than the lock.
        return locked(sessions);
    };
    fs::set_permissions(folder.path(), Permissions::from_mode(0o700)).unwrap();
    fs::write(folder.path().join("session.id"), name_of(folder.path())).unwrap();
    (folder, lock)
}

fn name_of(folder: &Path) -> String {
    folder.file_name().unwrap().to_str().unwrap().to_owned()
}

fn segment_of(folder: &Path) -> PathBuf {
    PathBuf::from(format!("/dev/shm/trabecula010_{}_x.data", name_of(folder)))
}

#[test]
fn the_session_of_a_dead_host_is_wiped_by_the_next_host() {
    let (sessions, first) = sessions();
    let [(stale, stale_lock), (marked, marked_lock)] = [(); 2].map(|()| locked(&sessions));
    let segment = segment_of(stale.path());
    fs::write(&segment, b"left behind").unwrap();
    // A link's target does not belong to the session.
    let home = tempfile::tempdir().unwrap();
    fs::write(home.path().join("letter"), "dear").unwrap();
    fs::create_dir(stale.path().join("services")).unwrap();
    std::os::unix::fs::symlink(home.path(), stale.path().join("services/link")).unwrap();
    std::os::unix::fs::symlink(home.path(), stale.path().join("link")).unwrap();
    // A host killed before it could mark its folder.
    fs::remove_file(marked.path().join("session.id")).unwrap();
    drop((stale_lock, marked_lock));
    let _second = SessionHost::create(&plan(&[])).unwrap();
    assert!(!stale.path().exists() && !segment.exists() && !marked.path().exists());
    assert_eq!(fs::read(home.path().join("letter")).unwrap(), b"dear");
    assert!(first.session.folder().join("wake.flags").exists(), "a living host's session is not touched");
    assert!(first.session.host_is_alive() && host_is_alive(first.session.folder()));
}

/// Whoever looks whether a host is alive holds a shared lock for a moment. A host that looked for dead sessions in that moment left this one
/// behind.
#[test]
fn a_dead_session_that_somebody_looks_at_is_wiped_all_the_same() {
    let (sessions, _host) = sessions();
    for _ in 0..20 {
        let (dead, lock) = locked(&sessions);
        drop(lock);
        let onlooker = File::open(dead.path()).unwrap();
        flock(&onlooker, FlockOperation::LockShared).unwrap();
        std::thread::scope(|scope| {
            scope.spawn(move || {
                std::thread::sleep(Duration::from_millis(3));
                drop(onlooker);
            });
            ipc_types::session::wipe_dead_sessions();
        });
        // The host of another test may have begun to remove it, and not finished.
        let limit = Instant::now() + Duration::from_secs(5);
        while dead.path().exists() && Instant::now() < limit {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(!dead.path().exists());
    }
}

/// Only dead sessions may be removed, never other folders beside them: sources, homes behind links.
#[test]
fn a_folder_of_the_users_is_never_wiped() {
    let (sessions, first) = sessions();
    let write = |folder: &Path, name: &str, text: &str| fs::write(folder.join(name), text).unwrap();
    let source = |folder: &Path, name: &str| {
        write(folder, "main.rs", "source");
        fs::write(segment_of(Path::new(name)), "segment").unwrap();
    };
    // A source folder with any name.
    let sources = tempfile::Builder::new().prefix("src").tempdir_in(&sessions).unwrap();
    source(sources.path(), &name_of(sources.path()));
    let unmarked = changed(&sessions, |folder, name| {
        source(folder, name);
        fs::remove_file(folder.join("session.id")).unwrap();
    });
    let renamed = changed(&sessions, |folder, name| {
        source(folder, name);
        write(folder, "session.id", &name.chars().rev().collect::<String>());
    });
    let open = changed(&sessions, |folder, name| {
        source(folder, name);
        fs::set_permissions(folder, Permissions::from_mode(0o755)).unwrap();
    });
    let mut lock = None;
    let locked = changed(&sessions, |folder, name| {
        source(folder, name);
        lock = File::open(folder).ok().filter(|lock| lock.lock().is_ok());
    });
    assert!(lock.is_some());
    let mut all = vec![sources.path(), &unmarked.0, &renamed.0, &open.0, &locked.0];
    let foreign;
    if rustix::process::geteuid().is_root() {
        foreign = changed(&sessions, |folder, name| {
            source(folder, name);
            std::os::unix::fs::chown(folder, Some(65_534), None).unwrap();
        });
        all.push(&foreign.0);
    } else {
        println!("\n*** SKIPPED in part: only root can make another user's folder ***\n");
    }
    // A link with a session's name, to a folder with everything that a session has.
    let home = tempfile::tempdir().unwrap();
    write(home.path(), "main.rs", "home");
    let real = tempfile::Builder::new().prefix("").rand_bytes(11).tempdir_in(home.path()).unwrap();
    fs::set_permissions(real.path(), Permissions::from_mode(0o700)).unwrap();
    write(real.path(), "session.id", &name_of(real.path()));
    let link = sessions.join(name_of(real.path()));
    std::os::unix::fs::symlink(real.path(), &link).unwrap();
    let file = tempfile::Builder::new().prefix("").rand_bytes(11).tempfile_in(&sessions).unwrap();
    drop(SessionHost::create(&plan(&[])).unwrap());
    drop(first);
    for folder in &all {
        assert_eq!(fs::read(folder.join("main.rs")).unwrap(), b"source", "{}", folder.display());
        assert_eq!(fs::read(segment_of(folder)).unwrap(), b"segment", "{}", folder.display());
        fs::remove_file(segment_of(folder)).unwrap();
    }
    let kept = [real.path().join("session.id"), home.path().join("main.rs"), file.path().to_owned()];
    assert_eq!(kept.each_ref().map(|path| path.exists()), [true; 3], "{kept:?}");
    fs::remove_file(link).unwrap();
}

/// A host that has checked the lock of a session that just ended must not remove a new one of the same name.
#[test]
fn a_session_does_not_have_the_name_of_an_earlier_one() {
    let folder = |host: SessionHost| host.session.folder().to_owned();
    let [first, second] = [(), ()].map(|()| folder(SessionHost::create(&plan(&[])).unwrap()));
    assert_ne!(first, second);
}

/// A host looks for dead sessions while another is being created; a half-made session is not dead.
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

/// The hub must not be reported gone when only its folder's name is.
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
    assert_eq!(shared_memory_of(&client), 0);
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

/// Another program must not be able to take the port of an absent part and have its messages believed.
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
    assert!(refusal.to_string().contains("only the physics may write service `keyframe`"), "{refusal}");
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
    assert!(calls <= 1000 / 64 + 2, "{calls} system calls for 1000 messages to nobody");
    // A reader that comes back is woken at once.
    let back = Session::join(host.session.folder()).unwrap();
    let _waiter = back.waiter(Reader::Controller(ControllerIndex(0))).unwrap();
    assert!(waker.try_to_wake());
}

/// The launcher wrote where a run is recorded in two steps, and why it ended likewise: a viewer that looked in between waited for a log of no
/// name, and a recorder could call a stopped run complete.
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
