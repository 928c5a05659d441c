//! A file that redirects the browser to the viewer's page. The page's address contains the token, and all
//! users of a machine can read the arguments of all programs, so the address must not be an argument. Only
//! this user can read the file. The viewer removes it, or, if the viewer was killed, the next viewer or run.

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
/// Number of random letters and digits in the file name.
const RANDOM: usize = 12;
/// First bytes of every redirect file.
const HEAD: &str = "<!doctype html><meta charset=\"utf-8\"><title>Trabecula</title>\n";

/// The redirect file, locked for the lifetime of the viewer.
pub struct RedirectFile {
    _file: NamedTempFile,
}

impl RedirectFile {
    /// Asks the desktop to open a new redirect file. Returns `None` without a desktop, or if the file cannot
    /// be written; the address has already been printed.
    pub fn open(url: &str, folder: &Path) -> Option<RedirectFile> {
        if !["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some()) {
            return None;
        }
        // Created with mode 0600, under an unguessable name.
        let named =
            tempfile::Builder::new().prefix(PREFIX).suffix(SUFFIX).rand_bytes(RANDOM).tempfile_in(folder);
        let mut file = named.ok()?;
        // Lock before writing: a file with content but no lock belongs to a dead viewer.
        file.as_file().try_lock().ok()?;
        let text = format!(
            "{HEAD}<meta http-equiv=\"refresh\" content=\"0; url={url}\">\n<a href=\"{url}\">The viewer</a>\n"
        );
        file.write_all(text.as_bytes()).ok()?;
        let quiet = Stdio::null;
        let mut opener = Command::new("xdg-open");
        let opener = opener.arg(file.path()).stdin(quiet()).stdout(quiet()).stderr(quiet());
        // In its own process group, because it may become the browser, which must outlive the viewer.
        let mut child = opener.process_group(0).spawn().ok()?;
        // Reap it when it ends, which may be late if it is the browser itself.
        // Without a thread it stays a zombie until the viewer ends.
        let _ = std::thread::Builder::new().spawn(move || child.wait());
        Some(RedirectFile { _file: file })
    }
}

/// Folder for the redirect file of a viewer without a session.
pub fn folder() -> PathBuf {
    let named = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|folder| folder.is_absolute());
    named.unwrap_or_else(std::env::temp_dir)
}

/// Removes redirect files left in a folder by this user's dead viewers.
pub fn sweep(folder: &Path) {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    for entry in entries.filter(|entry| has_our_name(&entry.file_name())) {
        if is_dead_viewers(&entry.path()) {
            // In a shared folder with the sticky bit, only the owner can have replaced the file meanwhile.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

fn has_our_name(name: &OsStr) -> bool {
    let middle = name.to_str().and_then(|name| name.strip_prefix(PREFIX)?.strip_suffix(SUFFIX));
    middle.is_some_and(|text| text.len() == RANDOM && text.bytes().all(|byte| byte.is_ascii_alphanumeric()))
}

/// Returns whether the file is private to this user, has one link, starts like a redirect file, and is not
/// locked by a viewer.
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
