//! The file that leads a browser to the viewer's page: the address holds the token, and every user of the machine may read the arguments
//! of every program. Only this user may read the file; it is removed with the viewer, or, if that was killed, by the next viewer or run.

use std::ffi::OsStr;
use std::fs::File;
use std::io::{Read, Write};
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use rustix::fs::{CWD, Mode, OFlags, openat};
use tempfile::NamedTempFile;

const PREFIX: &str = "trabecula-view-";
const SUFFIX: &str = ".html";
/// Letters and digits between them.
const RANDOM: usize = 12;
/// How each begins.
const HEAD: &str = "<!doctype html><meta charset=\"utf-8\"><title>Trabecula</title>\n";

/// The file, as long as the viewer lives: it holds a lock on it.
pub struct Doorway {
    _file: NamedTempFile,
}

impl Doorway {
    /// Asks the desktop to open one. None where there is no desktop, or no room for the file: the address has been printed.
    pub fn open(url: &str, folder: &Path) -> Option<Doorway> {
        if !["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some()) {
            return None;
        }
        // Of mode 0600, under a name that nobody can guess.
        let named =
            tempfile::Builder::new().prefix(PREFIX).suffix(SUFFIX).rand_bytes(RANDOM).tempfile_in(folder);
        let mut file = named.ok()?;
        // Before anything is in it: one that holds something and has no lock is a dead viewer's.
        file.as_file().try_lock().ok()?;
        let text = format!(
            "{HEAD}<meta http-equiv=\"refresh\" content=\"0; url={url}\">\n<a href=\"{url}\">The viewer</a>\n"
        );
        file.write_all(text.as_bytes()).ok()?;
        let quiet = Stdio::null;
        let mut opener = Command::new("xdg-open");
        let opener = opener.arg(file.path()).stdin(quiet()).stdout(quiet()).stderr(quiet());
        // In a group of its own: a browser that it becomes does not end with the viewer.
        let mut child = opener.process_group(0).spawn().ok()?;
        // Waited for, whenever it ends: it may be the browser itself.
        std::thread::spawn(move || child.wait());
        Some(Doorway { _file: file })
    }
}

/// Where the file of a viewer without a session lies.
pub fn folder() -> PathBuf {
    let named = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|folder| folder.is_absolute());
    named.unwrap_or_else(std::env::temp_dir)
}

/// Removes the files of dead viewers of this user from a folder.
pub fn sweep(folder: &Path) {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    for entry in entries.filter(|entry| has_our_name(&entry.file_name())) {
        if is_dead_viewers(&entry.path()) {
            // In a folder of all users only its owner can have put another file there meanwhile.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

fn has_our_name(name: &OsStr) -> bool {
    let middle = name.to_str().and_then(|name| name.strip_prefix(PREFIX)?.strip_suffix(SUFFIX));
    middle.is_some_and(|text| text.len() == RANDOM && text.bytes().all(|byte| byte.is_ascii_alphanumeric()))
}

/// Whether it is a file of this user alone, of one name, with what a viewer writes, on which no viewer holds the lock.
fn is_dead_viewers(path: &Path) -> bool {
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let Ok(file) = openat(CWD, path, flags, Mode::empty()).map(File::from) else { return false };
    let is_ours = file.metadata().is_ok_and(|it| {
        let is_own = it.is_file() && it.uid() == rustix::process::geteuid().as_raw();
        is_own && it.nlink() == 1 && it.mode() & 0o7777 == 0o600
    });
    let mut head = [0; HEAD.len()];
    is_ours && file.try_lock().is_ok() && (&file).read_exact(&mut head).is_ok() && head == *HEAD.as_bytes()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt, symlink};

    use super::*;

    #[test]
    fn only_what_a_dead_viewer_has_left_is_swept() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str, mode: u32| {
            let path = folder.path().join(name);
            std::fs::write(&path, text).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            path
        };
        let text = format!("{HEAD}<meta>");
        let dead = write("trabecula-view-abcDEF123456.html", &text, 0o600);
        let alive = write("trabecula-view-abcDEF123457.html", &text, 0o600);
        let lock = File::open(&alive).unwrap();
        lock.lock().unwrap();
        let others = [
            write("trabecula-view-abcDEF12345.html", &text, 0o600),
            write("trabecula-view-abcDEF12345_.html", &text, 0o600),
            write("trabecula-view-abcDEF123458.html.bak", &text, 0o600),
            write("my-trabecula-view-abcDEF123456.html", &text, 0o600),
            write("trabecula-view-abcDEF123459.html", &text, 0o644),
            write("trabecula-view-abcDEF123460.html", "a user's own page", 0o600),
            write("trabecula-view-abcDEF123461.html", "", 0o600),
        ];
        let (link, twice) = ("trabecula-view-abcDEF123462.html", "trabecula-view-abcDEF123463.html");
        let target = write("target", &text, 0o600);
        symlink(&target, folder.path().join(link)).unwrap();
        let linked = write("linked", &text, 0o600);
        std::fs::hard_link(&linked, folder.path().join(twice)).unwrap();
        std::fs::create_dir(folder.path().join("trabecula-view-abcDEF123464.html")).unwrap();
        let count = || std::fs::read_dir(folder.path()).unwrap().count();
        let before = count();
        sweep(folder.path());
        assert!(!dead.exists() && alive.exists() && target.exists() && linked.exists());
        others.iter().for_each(|path| assert!(path.exists(), "{}", path.display()));
        assert_eq!(count(), before - 1);
        drop(lock);
        sweep(folder.path());
        assert!(!alive.exists());
        assert_eq!(count(), before - 2);
    }
}
