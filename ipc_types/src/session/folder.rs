//! A session's folder: creates, locks, checks and removes it. All operations go through its handle, so that
//! what was checked is what is changed.
//!
//! The host holds a lock on the folder for as long as it lives, and the kernel releases it however the host
//! ends. The lock is the only proof that a session is alive: a process number may have been reused or belong
//! to another process in a container, and a name may have been removed (by a logout, or a cleaner of `/tmp`;
//! well-behaved ones leave locked folders alone). The marker file names the session; a folder without one is
//! not a session.

use std::ffi::CStr;
use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::time::Duration;

use foreign_text::foreign_line;
use rustix::fs::{
    AtFlags, CWD, Dir, FileType, FlockOperation, Mode, OFlags, flock, openat, statat, unlinkat,
};
use rustix::io::Errno;

use super::id::{PREFIX_LENGTH, SessionId};
use super::places::{PlaceError, SessionRoot, open_private, places};
use super::{SessionError, file_error};
use crate::messages::{Blame, EventCode};
use crate::shared_memory::{Identity, SharedMemory};

/// File with the session's name.
const MARKER: &str = "session.id";
/// File that identifies the `/dev/shm` that holds the session's memory: programs in two containers can share
/// the folder but not the memory.
const MEMORY: &str = "session.memory";
/// The folder that the transport creates below a session's folder for its nodes.
const NODES: &str = "nodes";
/// Longest socket name, bytes (unix(7)).
const MAX_SOCKET_NAME: usize = 108;
/// Digits of a listener's number in its socket name, in a process that has created ten thousand ports. With
/// more digits the transport refuses to create the listener.
const LISTENER_DIGITS: usize = 33;
/// The transport's sockets are `ROOT/PREFIX_NUMBER.event`.
pub(crate) const MAX_ROOT_PATH: usize =
    MAX_SOCKET_NAME - "/".len() - PREFIX_LENGTH - LISTENER_DIGITS - ".event".len();

/// The host's own folder; removed on drop.
#[derive(Debug)]
pub(crate) struct HostFolder {
    pub(crate) path: PathBuf,
    pub(crate) id: SessionId,
    /// Locked.
    handle: OwnedFd,
    /// The folder that holds all sessions.
    above: OwnedFd,
}

impl HostFolder {
    /// Creates a session folder in `place`. It starts unlocked and empty; without a marker it is not yet a
    /// session.
    pub(crate) fn create(place: &SessionRoot) -> Result<HostFolder, SessionError> {
        let above = place.open_or_make()?;
        loop {
            let id = SessionId::random()?;
            let path = place.path().join(id.to_string());
            let system = |cause: Errno| SessionError::File { path: path.clone(), cause: cause.into() };
            match rustix::fs::mkdirat(&above, id.to_string(), Mode::RWXU) {
                Ok(()) => {}
                Err(Errno::EXIST) => continue,
                Err(cause) => return Err(system(cause)),
            }
            let handle = match open_private(&above, Path::new(&id.to_string())) {
                // Another host saw it empty before it was locked and removed it.
                Err(PlaceError::Missing) => continue,
                other => other.map_err(|cause| SessionError::Unfit { path: path.clone(), cause })?,
            };
            flock(&handle, FlockOperation::LockExclusive).map_err(system)?;
            match create_whole(&handle, MARKER, id.to_string().as_bytes()) {
                Ok(()) => {
                    let host = HostFolder { path, id, handle, above };
                    // Written before there is any memory, and atomically, because a host could not interpret
                    // half a text. Without shared memory the session's first node fails and reports the
                    // reason.
                    if let Ok(here) = Identity::here() {
                        host.write(MEMORY, here.to_string().as_bytes())?;
                    }
                    return Ok(host);
                }
                // The same race, a moment later.
                Err(cause) if cause.kind() == io::ErrorKind::NotFound => {}
                Err(cause) => return Err(file_error(&path)(cause)),
            }
        }
    }

    pub(crate) fn handle(&self) -> &OwnedFd {
        &self.handle
    }

    /// Returns the system's reason for an error of the transport, which has none, if the folder's disk takes
    /// no more files.
    pub(crate) fn reason_of(&self, error: SessionError) -> SessionError {
        const PROBE: &str = ".probe";
        // More than any file of the transport has.
        const PROBE_BYTES: usize = 64 << 10;
        let SessionError::Transported { .. } = error else { return error };
        let tried = create_file(&self.handle, PROBE, &[0; PROBE_BYTES]);
        let _ = unlinkat(&self.handle, PROBE, AtFlags::empty());
        tried.err().map_or(error, file_error(&self.path))
    }

    /// Writes a file atomically.
    pub(crate) fn write(&self, name: &str, content: &[u8]) -> Result<(), SessionError> {
        create_whole(&self.handle, name, content).map_err(file_error(&self.path.join(name)))
    }
}

impl Drop for HostFolder {
    fn drop(&mut self) {
        remove(&self.above, &self.id, &self.handle);
        // Closing the handle would not release the lock while a child that another thread has just forked
        // holds a copy of it, until its `exec`.
        let _ = flock(&self.handle, FlockOperation::Unlock);
    }
}

/// Creates a new file, readable only by this user.
pub(crate) fn create_file(folder: impl AsFd, name: &str, content: &[u8]) -> io::Result<()> {
    let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let file = openat(folder, name, flags, Mode::RUSR | Mode::WUSR)?;
    File::from(file).write_all(content)
}

/// Returns the name of a file while it is written.
fn draft_of(name: &str) -> String {
    format!(".{name}")
}

/// As [`create_file`], but the file has its name only once it is complete, and replaces an older one.
fn create_whole(folder: &OwnedFd, name: &str, content: &[u8]) -> io::Result<()> {
    let draft = draft_of(name);
    let written = create_file(folder, &draft, content)
        .and_then(|()| Ok(rustix::fs::renameat(folder, &draft, folder, name)?));
    if written.as_ref().is_err_and(|cause| cause.kind() != io::ErrorKind::AlreadyExists) {
        // Half a draft, as on a full disk, would make every later attempt fail.
        let _ = unlinkat(folder, &draft, AtFlags::empty());
    }
    written
}

/// Reads a file of a session's folder. Refuses links and anything a read could block on, and limits the
/// length to what a session's files can hold.
pub(crate) fn read_file(folder: impl AsFd, name: &str) -> io::Result<String> {
    const LONGEST: u64 = 1 << 20;
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = File::from(openat(folder, name, flags, Mode::empty())?);
    if !file.metadata()?.is_file() {
        return Err(io::Error::other("not a regular file"));
    }
    let mut text = String::new();
    file.take(LONGEST).read_to_string(&mut text)?;
    Ok(text)
}

/// Opens a session's folder by its path.
///
/// # Errors
/// [`SessionError::NoSession`] if it does not exist, [`SessionError::PlaceError`] if others can change it.
pub(crate) fn open(path: &Path) -> Result<OwnedFd, SessionError> {
    open_private(rustix::fs::CWD, path).map_err(|cause| match cause {
        PlaceError::Missing | PlaceError::NotAFolder => {
            SessionError::NoSession { searched: super::SearchedPlaces::folder(path) }
        }
        cause => SessionError::Unfit { path: path.to_owned(), cause },
    })
}

/// Returns whether the folder's host is running, that is, holds the lock. `folder` must not be the host's own
/// handle.
pub(crate) fn is_locked(folder: impl AsFd) -> bool {
    match flock(folder.as_fd(), FlockOperation::NonBlockingLockShared) {
        Ok(()) => {
            // No process waits for it, and closing the handle would release it anyway.
            let _ = flock(folder, FlockOperation::Unlock);
            false
        }
        Err(_) => true,
    }
}

/// Returns whether the host of the session in this folder is running.
pub fn host_is_alive(folder: &Path) -> bool {
    open(folder).is_ok_and(is_locked)
}

/// Lists the folders of this user's running sessions: those with this name, or all.
pub fn running_sessions(name: Option<&str>) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for place in places() {
        let Ok(sessions) = place.open() else { continue };
        for id in session_names(&sessions).filter(|id| name.is_none_or(|name| id.to_string() == name)) {
            let name = id.to_string();
            if open_private(&sessions, Path::new(&name)).is_ok_and(is_locked) {
                found.push(place.path().join(name));
            }
        }
    }
    found
}

/// Returns this user's only announced session, for a program that names none; `None` if none is running.
///
/// # Errors
/// [`SessionError::SeveralSessions`] if the choice is ambiguous.
pub fn only_session() -> Result<Option<PathBuf>, SessionError> {
    let mut running = announced_sessions();
    match running.len() {
        0 | 1 => Ok(running.pop()),
        _ => Err(SessionError::SeveralSessions { running }),
    }
}

/// Lists the folders of this user's sessions that can be joined.
pub fn announced_sessions() -> Vec<PathBuf> {
    let mut running = running_sessions(None);
    running.retain(|folder| folder.join(super::ANNOUNCEMENT_FILE).exists());
    running
}

/// File in which the physics stores why it ends a run.
const BLAME_FILE: &str = "blame";

/// Stores why the physics ends a run in the session's folder, before the end is announced.
///
/// # Errors
/// Any system error.
pub(crate) fn write_blame(folder: impl AsFd, blame: &Blame) -> io::Result<()> {
    let Blame { code, controller, text } = blame;
    let content = format!("{}\n{}\n{text}", code.code(), controller.as_deref().unwrap_or_default());
    create_file(folder, BLAME_FILE, content.as_bytes())
}

/// Reads the stored reason from the session's folder, if any.
pub(crate) fn read_blame(folder: impl AsFd) -> Option<Blame> {
    let content = read_file(folder, BLAME_FILE).ok()?;
    let (code, rest) = content.split_once('\n')?;
    let (controller, text) = rest.split_once('\n')?;
    let code = EventCode::try_from(code.parse::<u32>().ok()?).ok()?;
    // No controller's name is empty.
    let controller = Some(controller.to_owned()).filter(|name| !name.is_empty());
    Some(Blame { code, controller, text: foreign_line(text).to_string() })
}

/// Removes the sessions of hosts that are no longer running, in all of this user's places. Returns their
/// number.
pub fn wipe_dead_sessions() -> usize {
    places().iter().filter_map(|place| place.open().ok()).map(|sessions| wipe_dead_in(&sessions)).sum()
}

fn wipe_dead_in(sessions: &OwnedFd) -> usize {
    session_names(sessions).map(|id| wipe_if_dead(sessions, &id)).filter(|wiped| *wiped).count()
}

/// Removes a session's folder and memory if it is safe to: a real folder of this user, closed to others,
/// whose lock is free and whose marker holds its own name; or an empty one, left by a host killed before it
/// wrote the marker. A session whose memory this program does not see is left to a host that does: without
/// the folder the memory would never be removed.
fn wipe_if_dead(sessions: &OwnedFd, id: &SessionId) -> bool {
    let name = id.to_string();
    let Ok(folder) = open_private(sessions, Path::new(&name)) else { return false };
    if !lock_if_dead(&folder) {
        return false;
    }
    match read_file(&folder, MARKER) {
        Ok(text) if text == name && has_its_memory_here(&folder) => {
            remove(sessions, id, &folder);
            true
        }
        Err(cause) if cause.kind() == io::ErrorKind::NotFound => remove_empty(sessions, id, &folder),
        _ => false,
    }
}

/// Returns whether a session's memory is in the `/dev/shm` that this program sees, or no longer exists: its
/// host was killed before it created any, or during its removal.
fn has_its_memory_here(folder: &OwnedFd) -> bool {
    match (read_file(folder, MEMORY), Identity::here()) {
        (Ok(there), Ok(here)) => here.holds_what_remains_of(&there),
        (Err(cause), _) => cause.kind() == io::ErrorKind::NotFound,
        (Ok(_), Err(_)) => false,
    }
}

/// Removes a folder that is empty or contains only the draft of a marker, as left by a killed host, or an
/// empty folder of nodes, as left by a killed client ([`ClientLeftovers`]). The system refuses to remove a
/// folder that is not empty.
fn remove_empty(sessions: &OwnedFd, id: &SessionId, folder: &OwnedFd) -> bool {
    let _ = unlinkat(folder, draft_of(MARKER), AtFlags::empty());
    let _ = unlinkat(folder, NODES, AtFlags::REMOVEDIR);
    let is_removed = unlinkat(sessions, id.to_string(), AtFlags::REMOVEDIR).is_ok();
    if is_removed {
        SharedMemory::remove_all(&id.shared_memory_prefix());
    }
    is_removed
}

/// Locks a session's folder unless its host is alive. A host's lock is exclusive; that of a program that only
/// checks ([`is_locked`]) is shared and released within microseconds, so the session is still dead and the
/// lock is retried.
fn lock_if_dead(folder: &OwnedFd) -> bool {
    const TRIES: u32 = 50;
    const PAUSE: Duration = Duration::from_millis(1);
    for _ in 0..TRIES {
        if flock(folder, FlockOperation::NonBlockingLockExclusive).is_ok() {
            return true;
        }
        if is_locked(folder) {
            return false;
        }
        std::thread::sleep(PAUSE);
    }
    false
}

fn session_names(sessions: &OwnedFd) -> impl Iterator<Item = SessionId> {
    names(sessions).into_iter().filter_map(|(name, _)| SessionId::parse(name.to_str().ok()?))
}

/// Names and types of a folder's entries.
fn names(folder: impl AsFd) -> Vec<(Box<CStr>, FileType)> {
    let entries = Dir::read_from(folder).into_iter().flatten().flatten();
    let others = entries.filter(|entry| !matches!(entry.file_name().to_bytes(), b"." | b".."));
    others.map(|entry| (entry.file_name().into(), entry.file_type())).collect()
}

/// Removes a session's shared memory and folder, the marker last, so that the next host can finish an
/// interrupted removal. Anything already gone is not an error.
fn remove(sessions: &OwnedFd, id: &SessionId, folder: &OwnedFd) {
    SharedMemory::remove_all(&id.shared_memory_prefix());
    remove_content(folder, Some(MARKER));
    let _ = unlinkat(folder, MARKER, AtFlags::empty());
    remove_empty(sessions, id, folder);
}

/// What a client that joins a session during its removal recreates: the folder of nodes, and a segment for
/// all nodes. Removed on drop, after the client's node, if the session is gone and no other client is left in
/// it.
#[derive(Debug)]
pub(crate) struct ClientLeftovers {
    path: PathBuf,
    id: SessionId,
    /// Shows whether the session is gone.
    handle: OwnedFd,
}

impl ClientLeftovers {
    pub(crate) fn of(path: &Path, id: &SessionId, handle: &OwnedFd) -> io::Result<ClientLeftovers> {
        Ok(ClientLeftovers { path: path.to_owned(), id: id.clone(), handle: handle.try_clone()? })
    }
}

impl Drop for ClientLeftovers {
    fn drop(&mut self) {
        let is_gone = matches!(statat(&self.handle, MARKER, AtFlags::SYMLINK_NOFOLLOW), Err(Errno::NOENT));
        if !is_gone {
            return;
        }
        // The system refuses to remove folders that are not empty.
        let _ = unlinkat(CWD, self.path.join(NODES), AtFlags::REMOVEDIR);
        let is_last = !matches!(unlinkat(CWD, &self.path, AtFlags::REMOVEDIR), Err(Errno::NOTEMPTY));
        // A host continues even if another program has removed its folder.
        if is_last && !is_locked(&self.handle) {
            SharedMemory::remove_all(&self.id.shared_memory_prefix());
        }
    }
}

/// Removes the content of an open folder without following links.
fn remove_content(folder: &OwnedFd, kept: Option<&str>) {
    for (name, kind) in names(folder) {
        if kept.is_some_and(|kept| name.to_bytes() == kept.as_bytes()) {
            continue;
        }
        if kind == FileType::Directory {
            let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
            if let Ok(inner) = openat(folder, &*name, flags, Mode::empty()) {
                remove_content(&inner, None);
            }
            let _ = unlinkat(folder, &*name, AtFlags::REMOVEDIR);
        } else {
            let _ = unlinkat(folder, &*name, AtFlags::empty());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A client took a host that had ended for alive, and left the session's memory, while another thread of
    /// the host's process was starting a program.
    #[test]
    fn the_lock_ends_with_its_host_though_a_forked_child_has_a_copy_of_the_handle() {
        let all = places();
        let (place, _) = super::super::places::choose(&all).unwrap();
        let host = HostFolder::create(place).unwrap();
        let client = open(&host.path).unwrap();
        // The same open file description, as in the child.
        let copy = host.handle.try_clone().unwrap();
        assert!(is_locked(&client));
        drop(host);
        assert!(!is_locked(&client));
        drop(copy);
    }

    /// The unfinished draft of a file made every later attempt fail with "File exists".
    #[test]
    fn a_file_that_could_not_be_written_can_be_written_later() {
        let all = places();
        let (place, _) = super::super::places::choose(&all).unwrap();
        let host = HostFolder::create(place).unwrap();
        rustix::fs::mkdirat(&host.handle, "file", Mode::RWXU).unwrap();
        host.write("file", b"draft").unwrap_err();
        unlinkat(&host.handle, "file", AtFlags::REMOVEDIR).unwrap();
        host.write("file", b"all of it").unwrap();
        assert_eq!(read_file(&host.handle, "file").unwrap(), "all of it");
    }
}
