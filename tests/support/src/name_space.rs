//! A mount namespace with its own file systems, so that a full one disturbs no other program.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use crate::limited::{Limited, Watchdog, end_within};

/// For a command that mounts.
const LIMIT: Duration = Duration::from_secs(90);

/// A namespace held by a sleeping process, with which it is removed.
#[derive(Debug)]
pub struct NameSpace {
    holder: Child,
    has_own_user: bool,
}

impl NameSpace {
    /// Creates a tmpfs of this size at a place that only this namespace sees; the error says why that is not
    /// possible.
    pub fn with_tmpfs(at: &Path, bytes: u64) -> Result<NameSpace, String> {
        NameSpace::with(false, at, &format!("size={bytes}"))
    }

    /// The same with any options, in a user namespace in which the user is root.
    pub fn of_own_user(at: &Path, options: &str) -> Result<NameSpace, String> {
        NameSpace::with(true, at, options)
    }

    fn with(has_own_user: bool, at: &Path, options: &str) -> Result<NameSpace, String> {
        let script = format!("mount -t tmpfs -o {options} tmpfs \"$0\" && echo mounted && exec sleep 600");
        let mut unshare = Command::new("unshare");
        unshare.args(has_own_user.then_some(["--user", "--map-root-user"]).iter().flatten());
        unshare.args(["--mount", "sh", "-c", &script]).arg(at);
        let mut child = unshare
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|cause| format!("unshare: {cause}"))?;
        let watchdog = Watchdog::over(&child, LIMIT);
        let mut said = String::new();
        std::io::BufRead::read_line(&mut std::io::BufReader::new(child.stdout.take().unwrap()), &mut said)
            .unwrap();
        drop(watchdog);
        if said.trim() == "mounted" {
            return Ok(NameSpace { holder: child, has_own_user });
        }
        end_within(&mut child, LIMIT, "unshare");
        Err("this user may not mount in a namespace of its own".to_owned())
    }

    /// Returns a command that runs the program in its arguments inside the namespace.
    pub fn command(&self) -> Command {
        let mut command = Command::new("nsenter");
        let space = |kind: &str, name: &str| format!("--{kind}=/proc/{}/ns/{name}", self.holder.id());
        command.args(self.has_own_user.then(|| space("user", "user")));
        command.arg(space("mount", "mnt")).arg("--");
        command
    }

    /// Returns the path outside of a path in the namespace.
    pub fn path(&self, inside: &Path) -> PathBuf {
        Path::new(&format!("/proc/{}/root", self.holder.id())).join(inside.strip_prefix("/").unwrap())
    }

    /// Resizes the tmpfs.
    pub fn resize(&self, at: &Path, bytes: u64) {
        let mut mount = self.command();
        mount.args(["mount", "-o", &format!("remount,size={bytes}")]).arg(at);
        assert!(mount.limited_output().unwrap().status.success());
    }

    /// Fills a folder's file system to the last byte, and returns when done.
    pub fn fill(&self, folder: &Path) -> PathBuf {
        let path = self.path(folder).join("filler");
        let mut file = std::fs::File::create(&path).unwrap();
        while std::io::Write::write_all(&mut file, &[1; 4096]).is_ok() {}
        path
    }
}

impl Drop for NameSpace {
    fn drop(&mut self) {
        let _ = self.holder.kill();
        let _ = self.holder.wait();
    }
}
