//! Remains of sessions: which are removed, by which host, and which never.

use std::fs::{self, File, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ipc_types::session::{Session, SessionHost, host_is_alive};
use rustix::fs::{FlockOperation, flock};
use tempfile::TempDir;

use crate::{name_of, plan, shared_memory_of};

/// The sessions folder, and the host whose session shows where it is.
fn sessions() -> (PathBuf, SessionHost) {
    let host = SessionHost::create(&plan(&[])).unwrap();
    (host.session.folder().parent().unwrap().to_owned(), host)
}

/// A private folder with a session's name, as a killed host leaves it, but changed by `change` before any
/// host can see it: until then it does not have a session's name. The hosts of other tests, which run at the
/// same time, would otherwise remove it.
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

/// A private folder with a session's name and its lock: once the lock is dropped, it is as a killed host
/// leaves it.
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

fn segment_of(folder: &Path) -> PathBuf {
    PathBuf::from(format!("/dev/shm/trabecula010_{}_x.data", name_of(folder)))
}

#[test]
fn the_session_of_a_dead_host_is_wiped_by_the_next_host() {
    let (sessions, first) = sessions();
    let [(stale, stale_lock), (marked, marked_lock), (joined, joined_lock)] =
        [(); 3].map(|()| locked(&sessions));
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
    // A host killed, or out of disk, while it wrote where its memory is.
    fs::write(stale.path().join(".session.memory"), "da4d").unwrap();
    // A host killed while it wrote its marker, which has its name only once it is complete.
    fs::write(marked.path().join(".session.id"), &name_of(marked.path())[..3]).unwrap();
    // A client killed while it joined a session that was being removed.
    fs::remove_file(joined.path().join("session.id")).unwrap();
    fs::create_dir(joined.path().join("nodes")).unwrap();
    drop((stale_lock, marked_lock, joined_lock));
    let _second = SessionHost::create(&plan(&[])).unwrap();
    let left = [stale.path(), &segment, marked.path(), joined.path()].map(Path::exists);
    assert_eq!(left, [false; 4]);
    assert_eq!(fs::read(home.path().join("letter")).unwrap(), b"dear");
    assert!(first.session.folder().join("wake.flags").exists(), "a living host's session is not touched");
    assert!(first.session.host_is_alive() && host_is_alive(first.session.folder()));
}

/// Regression: a program that checks whether a host is alive briefly holds a shared lock. A host that
/// searched for dead sessions in that moment left this one behind.
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
        // The host of another test may have started to remove it without finishing.
        let limit = Instant::now() + Duration::from_secs(5);
        while dead.path().exists() && Instant::now() < limit {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(!dead.path().exists());
    }
}

/// Only dead sessions may be removed, never other folders beside them, such as sources or homes behind links.
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
        println!("\n*** SKIPPED in part: only root can create another user's folder ***\n");
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

/// Regression: a hub in a container with its own `/dev/shm` but this machine's `/tmp` removed the folder of a
/// killed hub's session. Its memory, 130 MB, was then never removed.
#[test]
fn a_dead_session_is_left_to_a_host_that_sees_its_memory() {
    let (sessions, host) = sessions();
    let own = fs::read_to_string(host.session.folder().join("session.memory")).unwrap();
    let (boot, device) = own.split_once(' ').unwrap();
    let elsewhere = format!("{boot} {device}0");
    for (text, is_wiped) in [
        (elsewhere.as_str(), false),
        ("", false),
        (&own, true),
        (&format!("an-earlier-start {device}0"), true),
    ] {
        let dead = changed(&sessions, |folder, _| fs::write(folder.join("session.memory"), text).unwrap());
        let segment = segment_of(&dead.0);
        fs::write(&segment, b"left behind").unwrap();
        ipc_types::session::wipe_dead_sessions();
        assert_eq!((gone(&dead.0), gone(&segment)), (is_wiped, is_wiped), "{text}");
        let _ = fs::remove_file(segment);
    }
}

/// Returns whether the path disappears: the host of another test may have started to remove it without
/// finishing.
fn gone(path: &Path) -> bool {
    let limit = Instant::now() + Duration::from_millis(200);
    while path.exists() && Instant::now() < limit {
        std::thread::sleep(Duration::from_millis(1));
    }
    !path.exists()
}

/// Regression: a client's node creates the folder of nodes and a segment. If that happened during the
/// session's removal, they were never removed.
#[test]
fn clients_that_join_while_a_session_is_removed_leave_nothing() {
    const CLIENTS: u64 = 3;
    for round in 0..40 {
        let host = SessionHost::create(&plan(&[])).unwrap();
        host.announce().unwrap();
        let folder = host.session.folder().to_owned();
        std::thread::scope(|scope| {
            for client in 0..CLIENTS {
                let folder = &folder;
                scope.spawn(move || {
                    std::thread::sleep(Duration::from_micros(100 * (round * CLIENTS + client) % 4000));
                    drop(Session::join_within(folder, Duration::from_millis(20)));
                });
            }
            std::thread::sleep(Duration::from_millis(1));
            drop(host);
        });
        assert!(!folder.exists() && shared_memory_of(&folder) == 0, "round {round}: {}", folder.display());
    }
}
