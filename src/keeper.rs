//! `trabecula proc keep`: runs a third-party program, and kills all its descendants when the program or the
//! launcher ends.
//!
//! The kernel sends a parent-death signal to direct children only, and a daemon leaves its parent's group and
//! session. This process therefore sits between launcher and program as a subreaper: orphans of the program
//! become its children. Its standard input is a socket to the launcher, which closes however the launcher
//! dies.

use std::ffi::OsString;
use std::io::{Read, Write};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::process::{Command, ExitCode, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use ipc_types::process::{bind_to_parent_with, descendants};
use rustix::io::Errno;
use rustix::process::{
    Pid, Resource, Rlimit, Signal, WaitOptions, WaitStatus, getpid, kill_process, kill_process_group,
    set_child_subreaper, setrlimit, wait,
};
use signal_hook::consts::{SIGCHLD, SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use crate::failure::Failure;

/// The launcher sends this to kill everything at once.
pub const END_AT_ONCE: u8 = b'K';
/// Timeout for the program to end after the launcher has ended.
const GRACE_PERIOD: Duration = Duration::from_secs(2);
/// Timeout for killed processes to disappear, sufficient on a starved machine; processes stuck in an
/// uninterruptible system call are left to the kernel. A launcher that ends its run waits less.
const KILL_LIMIT: Duration = Duration::from_secs(10);
const KILL_POLL_PERIOD: Duration = Duration::from_millis(2);

/// The keeper's report to the launcher about the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StartReport {
    /// Started, with the program's process ID.
    As(u32),
    /// Not started, with the system's error number.
    Not(i32),
}

impl StartReport {
    fn bytes(self) -> [u8; 5] {
        let (kind, number) = match self {
            StartReport::As(pid) => (b'+', pid.to_le_bytes()),
            StartReport::Not(code) => (b'-', code.to_le_bytes()),
        };
        [kind, number[0], number[1], number[2], number[3]]
    }

    /// Reads the keeper's report.
    pub fn read(mut leash: &UnixStream) -> std::io::Result<StartReport> {
        let mut bytes = [0; 5];
        leash.read_exact(&mut bytes)?;
        let number = [bytes[1], bytes[2], bytes[3], bytes[4]];
        match bytes[0] {
            b'+' => Ok(StartReport::As(u32::from_le_bytes(number))),
            _ => Ok(StartReport::Not(i32::from_le_bytes(number))),
        }
    }
}

enum KeeperEvent {
    Signal(i32),
    /// The launcher is gone.
    Alone,
    EndAtOnce,
}

/// Runs a program until it ends, and exits with the program's status.
pub fn run(words: &[OsString]) -> Result<ExitCode, Failure> {
    let failed = |cause: std::io::Error| Failure::failed(format!("cannot supervise a program: {cause}"));
    let Some((program, arguments)) = words.split_first() else {
        return Err(Failure::bad_input("no program to supervise"));
    };
    let leash = std::io::stdin().as_fd().try_clone_to_owned().map(UnixStream::from).map_err(failed)?;
    set_child_subreaper(Some(getpid())).map_err(|cause| failed(cause.into()))?;
    let (sender, news) = channel();
    hear_signals(sender.clone()).map_err(failed)?;
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null());
    // If this process is killed, at least the program dies with it.
    let spawned = bind_to_parent_with(&mut command, Signal::KILL).spawn();
    let started = match &spawned {
        Ok(child) => StartReport::As(child.id()),
        Err(cause) => StartReport::Not(cause.raw_os_error().unwrap_or(0)),
    };
    // If the launcher is gone, the watch below notices.
    let _ = (&leash).write_all(&started.bytes());
    let StartReport::As(pid) = started else { return Ok(ExitCode::FAILURE) };
    hear_launcher(leash, sender).map_err(failed)?;
    let Some(program) = i32::try_from(pid).ok().and_then(Pid::from_raw) else {
        return Ok(ExitCode::FAILURE);
    };
    Ok(end_as(SupervisedProgram { program, status: None, kill_at: None }.watch(&news)))
}

fn hear_signals(sender: Sender<KeeperEvent>) -> std::io::Result<()> {
    let mut signals = Signals::new([SIGCHLD, SIGTERM, SIGINT, SIGHUP])?;
    std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
        for signal in signals.forever() {
            if sender.send(KeeperEvent::Signal(signal)).is_err() {
                return;
            }
        }
    })?;
    Ok(())
}

fn hear_launcher(mut leash: UnixStream, sender: Sender<KeeperEvent>) -> std::io::Result<()> {
    std::thread::Builder::new().name("leash".to_owned()).spawn(move || {
        let mut byte = [0];
        let said = match leash.read(&mut byte) {
            Ok(1) if byte[0] == END_AT_ONCE => KeeperEvent::EndAtOnce,
            _ => KeeperEvent::Alone,
        };
        // The receiver lives as long as the process.
        let _ = sender.send(said);
    })?;
    Ok(())
}

struct SupervisedProgram {
    program: Pid,
    status: Option<WaitStatus>,
    kill_at: Option<Instant>,
}

impl SupervisedProgram {
    /// Watches until the program and all its descendants have ended.
    fn watch(mut self, news: &Receiver<KeeperEvent>) -> Option<WaitStatus> {
        loop {
            let _ = self.reap();
            if self.status.is_some() {
                break;
            }
            let said = match self.kill_at {
                None => news.recv().map_err(|_| RecvTimeoutError::Disconnected),
                Some(at) => news.recv_timeout(at.saturating_duration_since(Instant::now())),
            };
            match said {
                Ok(KeeperEvent::Signal(SIGCHLD)) => {}
                Ok(KeeperEvent::Signal(_)) => self.ask_to_end(),
                Ok(KeeperEvent::Alone) => {
                    self.ask_to_end();
                    self.kill_at = Some(Instant::now() + GRACE_PERIOD);
                }
                Ok(KeeperEvent::EndAtOnce) | Err(_) => break,
            }
        }
        self.end_all();
        self.status
    }

    fn ask_to_end(&self) {
        // The program leads its own group; it may just have ended, or be stopped.
        let _ = kill_process_group(self.program, Signal::TERM);
        let _ = kill_process_group(self.program, Signal::CONT);
    }

    /// Reaps ended children; returns whether any are left.
    fn reap(&mut self) -> bool {
        loop {
            match wait(WaitOptions::NOHANG) {
                Ok(Some((pid, status))) if pid == self.program => self.status = Some(status),
                Ok(Some(_)) | Err(Errno::INTR) => {}
                Ok(None) => return true,
                Err(_) => return false,
            }
        }
    }

    /// Kills descendants until the kernel reports no children: an orphan becomes a child of this subreaper at
    /// once, so no children means no descendants. A scan of `/proc` cannot tell, because it misses a process
    /// spawned after the process IDs were listed by a parent that ended before its entry was read.
    fn end_all(&mut self) {
        let end = Instant::now() + KILL_LIMIT;
        while self.reap() && Instant::now() < end {
            descendants(getpid()).iter().for_each(|pid| {
                // It may just have ended.
                let _ = kill_process(*pid, Signal::KILL);
            });
            std::thread::sleep(KILL_POLL_PERIOD);
        }
    }
}

/// Ends this process the way the program ended, so that the launcher sees the program's status.
fn end_as(status: Option<WaitStatus>) -> ExitCode {
    let code = status.and_then(WaitStatus::exit_status);
    if let Some(code) = code.and_then(|code| u8::try_from(code).ok()) {
        return ExitCode::from(code);
    }
    let signal = status.and_then(WaitStatus::terminating_signal).unwrap_or(Signal::KILL.as_raw());
    // The program has already dumped its own core, if enabled.
    let _ = setrlimit(Resource::Core, Rlimit { current: Some(0), maximum: Some(0) });
    let _ = signal_hook::low_level::emulate_default_handler(signal);
    ExitCode::FAILURE
}
