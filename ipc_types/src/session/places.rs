//! Where this user's sessions are: in a dedicated folder below the user's run-time folder, or below `/tmp`.
//!
//! A host takes the first usable place, and reports which one it skipped and why; a problem with the sessions
//! folder itself is an error. A client searches all places, because one user's programs (a desktop, an ssh
//! connection, cron) do not all have the same environment.

use std::ffi::{OsStr, OsString};
use std::fmt::{self, Display, Formatter};
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Component, Path, PathBuf};

use iceoryx2::prelude::SemanticString as _;
use rustix::fs::{AtFlags, CWD, FileType, Mode, OFlags, Stat};
use rustix::io::Errno;
use thiserror::Error;

use super::SessionError;
use super::folder::MAX_ROOT_PATH;
use super::id::SessionId;

/// Name of the folder that holds only sessions; chosen so that no clone of this repository and no user's
/// folder has it.
const NAME: &str = "trabecula-hubs";
const VARIABLE: &str = "XDG_RUNTIME_DIR";
/// Default run-time folder, for programs started without the environment variable.
const RUN_USER: &str = "/run/user";
const TEMPORARY: &str = "/tmp";

/// Why a folder cannot hold sessions.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum PlaceError {
    /// The variable is empty.
    #[error("it is empty")]
    Empty,
    /// The path is relative, so it depends on the working directory.
    #[error("it is not an absolute path")]
    Relative,
    /// The transport refuses some characters in paths.
    #[error("its path holds `{}`, which the transport does not allow", character.escape_debug())]
    Character {
        /// The first such character; U+FFFD for bytes that are not UTF-8.
        character: char,
    },
    /// It does not exist.
    #[error("it does not exist")]
    Missing,
    /// It is a link, whose target may change.
    #[error("it is a link")]
    Link,
    /// It is not a folder.
    #[error("it is not a folder")]
    NotAFolder,
    /// It belongs to another user, who could change its content.
    #[error("it belongs to user {owner}, but this program runs as user {user}")]
    NotOwn {
        /// Its owner.
        owner: u32,
        /// This process's user.
        user: u32,
    },
    /// Other users could read or change its content.
    #[error("its mode is {mode:o}, expected 700: other users can enter it")]
    NotPrivate {
        /// Its permissions.
        mode: u32,
    },
    /// Other users could remove or rename its content.
    #[error("its mode is {mode:o}, expected 1777: any user can remove other users' files there")]
    NotSticky {
        /// Its permissions.
        mode: u32,
    },
    /// The path is too long: the transport's socket names have at most 108 bytes.
    #[error("its path has {bytes} bytes; beyond {limit} bytes the socket paths inside it are too long")]
    TooLong {
        /// Length of the path, bytes.
        bytes: usize,
        /// Longest path allowed, bytes.
        limit: usize,
    },
    /// The system denies access.
    #[error("{0}")]
    System(Errno),
}

/// A place that can hold sessions.
#[derive(Debug, Clone)]
pub struct SessionRoot {
    /// The sessions folder.
    sessions: PathBuf,
    /// Its parent: a run-time folder, or `/tmp`.
    above: PathBuf,
    kind: Kind,
    /// Why it is skipped.
    unfit: Option<PlaceError>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// Named by the environment variable.
    Named,
    /// The default, not named by this process's environment.
    Usual,
    Temporary,
}

/// Checks that a folder belongs to this user and is closed to others.
fn private(stat: &Stat) -> Result<(), PlaceError> {
    let user = rustix::process::geteuid().as_raw();
    match FileType::from_raw_mode(stat.st_mode) {
        FileType::Directory => {}
        FileType::Symlink => return Err(PlaceError::Link),
        _ => return Err(PlaceError::NotAFolder),
    }
    if stat.st_uid != user {
        return Err(PlaceError::NotOwn { owner: stat.st_uid, user });
    }
    let mode = stat.st_mode & 0o7777;
    if mode & 0o077 == 0 { Ok(()) } else { Err(PlaceError::NotPrivate { mode }) }
}

/// Opens a folder that is not a link, so that later checks apply to what was opened.
fn open_folder(above: impl AsFd, path: &Path) -> Result<OwnedFd, PlaceError> {
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    rustix::fs::openat(above.as_fd(), path, flags, Mode::empty()).map_err(|cause| match cause {
        Errno::NOENT => PlaceError::Missing,
        Errno::LOOP | Errno::NOTDIR => match rustix::fs::statat(above, path, AtFlags::SYMLINK_NOFOLLOW) {
            Ok(stat) if FileType::from_raw_mode(stat.st_mode) == FileType::Symlink => PlaceError::Link,
            _ => PlaceError::NotAFolder,
        },
        other => PlaceError::System(other),
    })
}

/// Opens a folder if it belongs to this user, is not a link, and is closed to others.
///
/// # Errors
/// [`PlaceError`], the reason for refusing it.
pub fn open_private(above: impl AsFd, path: &Path) -> Result<OwnedFd, PlaceError> {
    let folder = open_folder(above, path)?;
    private(&rustix::fs::fstat(&folder).map_err(PlaceError::System)?)?;
    Ok(folder)
}

/// Returns the first character of a path that the transport refuses.
fn refused_character(path: &Path) -> Option<char> {
    let text = path.to_string_lossy();
    let is_refused = |c: &char| {
        let mut bytes = [0; 4];
        let name = ["x", c.encode_utf8(&mut bytes)].concat();
        *c == char::REPLACEMENT_CHARACTER || iceoryx2::prelude::Path::new(name.as_bytes()).is_err()
    };
    text.chars().find(is_refused)
}

impl SessionRoot {
    fn new(above: PathBuf, kind: Kind, user: u32) -> SessionRoot {
        let name = if kind == Kind::Temporary { format!("{NAME}-{user}") } else { NAME.to_owned() };
        let sessions = above.join(name);
        let mut place = SessionRoot { sessions, above, kind, unfit: None };
        place.unfit = place.open_above().err();
        place
    }

    /// Returns the sessions folder.
    pub fn path(&self) -> &Path {
        &self.sessions
    }

    fn open_above(&self) -> Result<OwnedFd, PlaceError> {
        let limit = MAX_ROOT_PATH
            - SessionId::LENGTH
            - 1
            - (self.sessions.as_os_str().len() - self.above.as_os_str().len());
        let bytes = self.above.as_os_str().len();
        if bytes == 0 {
            return Err(PlaceError::Empty);
        }
        if !self.above.is_absolute() {
            return Err(PlaceError::Relative);
        }
        if let Some(character) = refused_character(&self.above) {
            return Err(PlaceError::Character { character });
        }
        if bytes > limit {
            return Err(PlaceError::TooLong { bytes, limit });
        }
        if self.kind != Kind::Temporary {
            return open_private(CWD, &self.above);
        }
        // World-writable is safe as long as only a file's owner may remove it.
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        let above =
            rustix::fs::openat(CWD, &self.above, flags, Mode::empty()).map_err(|cause| match cause {
                Errno::NOENT => PlaceError::Missing,
                Errno::NOTDIR => PlaceError::NotAFolder,
                other => PlaceError::System(other),
            })?;
        let mode = rustix::fs::fstat(&above).map_err(PlaceError::System)?.st_mode & 0o7777;
        if mode & 0o022 != 0 && mode & 0o1000 == 0 { Err(PlaceError::NotSticky { mode }) } else { Ok(above) }
    }

    /// Opens the sessions folder.
    ///
    /// # Errors
    /// The reason for refusing it, or [`PlaceError::Missing`].
    pub(crate) fn open(&self) -> Result<OwnedFd, PlaceError> {
        let name = self.sessions.file_name().unwrap_or(OsStr::new(NAME));
        open_private(self.open_above()?, Path::new(name))
    }

    /// As [`open`](SessionRoot::open), but creates the folder if it does not exist.
    pub(crate) fn open_or_make(&self) -> Result<OwnedFd, SessionError> {
        let refused = |cause: PlaceError| SessionError::Unfit { path: self.sessions.clone(), cause };
        let above =
            self.open_above().map_err(|cause| SessionError::Unfit { path: self.above.clone(), cause })?;
        let name = Path::new(self.sessions.file_name().unwrap_or(OsStr::new(NAME)));
        match rustix::fs::mkdirat(&above, name, Mode::RWXU) {
            Ok(()) | Err(Errno::EXIST) => open_private(above, name).map_err(refused),
            Err(cause) => Err(refused(PlaceError::System(cause))),
        }
    }
}

impl Display for SessionRoot {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match (&self.unfit, self.open()) {
            (Some(cause), _) => write!(f, "{} (not used: {cause})", self.above_as_named()),
            (None, Err(PlaceError::Missing)) => write!(f, "{} (does not exist)", self.sessions.display()),
            (None, Err(cause)) => write!(f, "{} (not used: {cause})", self.sessions.display()),
            (None, Ok(_)) => write!(f, "{}", self.sessions.display()),
        }
    }
}

impl SessionRoot {
    fn above_as_named(&self) -> String {
        match self.kind {
            Kind::Named => format!("{VARIABLE}=\"{}\"", self.above.display()),
            Kind::Usual | Kind::Temporary => self.above.display().to_string(),
        }
    }
}

/// Lists every place, in the order in which a host tries them.
pub fn places() -> Vec<SessionRoot> {
    places_of(std::env::var_os(VARIABLE), rustix::process::geteuid().as_raw())
}

fn places_of(variable: Option<OsString>, user: u32) -> Vec<SessionRoot> {
    // Drops a trailing `/`, which would make the system follow a link.
    let plain = |path: &Path| path.components().collect::<PathBuf>();
    let named = variable.map(|folder| plain(Path::new(&folder)));
    let usual = Path::new(RUN_USER).join(user.to_string());
    let is_usual = named.as_ref().is_some_and(|folder| *folder == usual);
    let mut all = Vec::new();
    all.extend(named.map(|folder| SessionRoot::new(folder, Kind::Named, user)));
    all.extend((!is_usual && usual.exists()).then(|| SessionRoot::new(usual, Kind::Usual, user)));
    all.push(SessionRoot::new(PathBuf::from(TEMPORARY), Kind::Temporary, user));
    all
}

/// Returns the place that a host takes, and a note about the one it skipped.
///
/// Never takes a folder that the environment does not name: a run started by cron would lose it when the
/// user's last login ends.
pub(crate) fn choose(all: &[SessionRoot]) -> Option<(&SessionRoot, Option<String>)> {
    let chosen = all.iter().find(|place| place.kind != Kind::Usual && place.unfit.is_none())?;
    let passed = all.iter().find(|place| place.kind == Kind::Named).and_then(|place| {
        let cause = place.unfit.as_ref()?;
        let (named, sessions) = (place.above_as_named(), chosen.sessions.display());
        Some(format!("{named} is not used: {cause}; the session is in {sessions}"))
    });
    Some((chosen, passed))
}

/// Returns a note about a run-time folder that the environment names but that cannot hold sessions.
pub fn passed_over() -> Option<String> {
    choose(&places()).and_then(|(_, passed)| passed)
}

/// The places searched for a session, and their states.
#[derive(Debug, Clone)]
pub struct SearchedPlaces {
    name: Option<String>,
    places: Vec<SessionRoot>,
}

impl SearchedPlaces {
    /// Lists all places of this user; `name` is the session's, if given.
    pub fn places(name: Option<&str>) -> SearchedPlaces {
        SearchedPlaces { name: name.map(str::to_owned), places: places() }
    }

    /// Lists a single folder.
    pub fn folder(folder: &Path) -> SearchedPlaces {
        SearchedPlaces { name: Some(folder.display().to_string()), places: Vec::new() }
    }
}

impl Display for SearchedPlaces {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str("no running session")?;
        self.name.iter().try_for_each(|name| write!(f, " `{name}`"))?;
        if !self.places.is_empty() {
            let places: Vec<String> = self.places.iter().map(SessionRoot::to_string).collect();
            write!(f, " in {}", places.join(", nor in "))?;
        }
        let user = rustix::process::geteuid().as_raw();
        write!(
            f,
            "; start one with `trabecula run SCENE` as this user ({user}): sessions of other users, and \
             those whose folder was removed, cannot be joined"
        )
    }
}

/// Returns the path's last component, if it is a plain name.
pub(crate) fn last_name(path: &Path) -> Option<&str> {
    match path.components().next_back()? {
        Component::Normal(name) => name.to_str(),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, Permissions};
    use std::os::unix::ffi::OsStrExt;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn chosen(variable: Option<&OsStr>) -> (PathBuf, Option<String>) {
        let user = rustix::process::geteuid().as_raw();
        let all = places_of(variable.map(OsStr::to_owned), user);
        let (place, said) = choose(&all).unwrap();
        (place.path().to_owned(), said)
    }

    /// A run-time folder that does not belong to this user is skipped with its reason, and never created.
    #[test]
    fn a_run_time_folder_that_is_not_the_users_own_is_passed_over() {
        let temporary = PathBuf::from(format!("/tmp/{NAME}-{}", rustix::process::geteuid().as_raw()));
        assert_eq!(chosen(None), (temporary.clone(), None));
        let base = tempfile::Builder::new().prefix("t").rand_bytes(4).tempdir_in("/tmp").unwrap();
        fs::set_permissions(base.path(), Permissions::from_mode(0o700)).unwrap();
        let own = base.path();
        assert_eq!(chosen(Some(own.as_os_str())), (own.join(NAME), None));
        let (link, file) = (own.join("l"), own.join("f"));
        std::os::unix::fs::symlink(own, &link).unwrap();
        fs::write(&file, "").unwrap();
        let open = own.join("o");
        fs::create_dir(&open).unwrap();
        fs::set_permissions(&open, Permissions::from_mode(0o750)).unwrap();
        let with_slash = PathBuf::from(format!("{}/", link.display()));
        let long = own.join("x".repeat(100));
        for (given, reason) in [
            (Path::new(""), "it is empty"),
            (Path::new("run"), "it is not an absolute path"),
            (&own.join(OsStr::from_bytes(b"gr\xfcn")), "its path holds `\u{fffd}`"),
            (&own.join("a>b"), "its path holds `>`"),
            (&own.join("n"), "it does not exist"),
            (&link, "it is a link"),
            (&with_slash, "it is a link"),
            (&file, "it is not a folder"),
            (&open, "its mode is 750, expected 700"),
            (
                Path::new("/tmp"),
                if rustix::process::geteuid().is_root() { "mode is 1777" } else { "belongs to user" },
            ),
            (&long, "the socket paths inside it are too long"),
        ] {
            let (place, said) = chosen(Some(given.as_os_str()));
            assert_eq!(place, temporary, "{}", given.display());
            let said = said.unwrap();
            assert!(said.contains(reason) && said.contains(VARIABLE), "{}: {said}", given.display());
        }
        assert!(!own.join("n").exists(), "nothing is created on the way");
    }

    /// A run from cron, `sudo` or ssh lacks the variable that a desktop has: each must be found where the
    /// other would create it.
    #[test]
    fn every_place_is_looked_in_and_named() {
        let user = rustix::process::geteuid().as_raw();
        let paths = |variable: Option<&str>| -> Vec<PathBuf> {
            places_of(variable.map(OsString::from), user)
                .iter()
                .map(|place| place.path().to_owned())
                .collect()
        };
        let (usual, temporary) =
            (PathBuf::from(format!("/run/user/{user}/{NAME}")), PathBuf::from(format!("/tmp/{NAME}-{user}")));
        let mut expected = vec![PathBuf::from("/elsewhere").join(NAME)];
        expected.extend(Path::new("/run/user").join(user.to_string()).exists().then(|| usual.clone()));
        expected.push(temporary.clone());
        assert_eq!(paths(Some("/elsewhere")), expected);
        assert_eq!(paths(None), expected[1..]);
        assert_eq!(paths(Some(&format!("/run/user/{user}/"))), [usual, temporary.clone()]);
        let all = places_of(Some("/elsewhere".into()), user);
        let said = SearchedPlaces { name: Some("left".to_owned()), places: all }.to_string();
        for word in [
            "`left`",
            "XDG_RUNTIME_DIR=\"/elsewhere\" (not used: it does not exist)",
            temporary.to_str().unwrap(),
        ] {
            assert!(said.contains(word), "{said}");
        }
        assert!(said.contains(&format!("this user ({user})")), "{said}");
    }
}
