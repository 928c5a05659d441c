//! What every process of the hub does alike: end when asked, end with its parent, send events.

use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};
use zerocopy::IntoBytes;

use crate::messages::{Event, SEVERITY_INFO};
use crate::ports::{PortError, Publisher};
use crate::scene::{Scene, SceneError};
use crate::services::{self, MAX_EVENT_TEXT};
use crate::session::{Session, SessionError};

/// Exit code of a run that failed.
pub const EXIT_FAILED: u8 = 1;
/// Exit code for bad input: nothing was written, nothing was lost.
pub const EXIT_BAD_INPUT: u8 = 2;

/// Set when the process has been asked to end (SIGTERM, SIGINT).
#[derive(Debug, Clone)]
pub struct EndRequest(Arc<AtomicBool>);

impl EndRequest {
    /// From now on the two signals set the flag instead of killing the process.
    ///
    /// # Errors
    /// The system refuses to install a handler.
    pub fn install() -> std::io::Result<EndRequest> {
        let flag = Arc::new(AtomicBool::new(false));
        for signal in [SIGTERM, SIGINT] {
            signal_hook::flag::register(signal, Arc::clone(&flag))?;
        }
        Ok(EndRequest(flag))
    }

    /// Whether the process has been asked to end.
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Has the kernel send SIGTERM to this process when its parent dies, so that a killed launcher leaves nothing running.
pub fn end_with_parent() {
    // Where the kernel refuses, the process still ends when its session's state stops.
    let _ = rustix::process::set_parent_process_death_signal(Some(rustix::process::Signal::TERM));
}

/// Has the kernel do the same to a program that is not ours, and keeps the terminal's Ctrl-C from it: the launcher
/// ends its parts in order.
pub fn bind_to_parent(command: &mut Command) -> &mut Command {
    command.process_group(0);
    // SAFETY: the closure runs between fork and exec, where only async-signal-safe calls are allowed; it makes one
    // system call (prctl), allocates nothing and takes no lock.
    unsafe {
        command.pre_exec(|| {
            end_with_parent();
            Ok(())
        })
    }
}

/// The scene of a session, as the launcher laid it into the session's folder.
///
/// # Errors
/// As [`Scene::load`].
pub fn session_scene(folder: &Path) -> Result<Scene, SceneError> {
    Scene::load(&folder.join("scene.toml"))
}

/// Sends a process's events.
#[derive(Debug)]
pub struct EventSender {
    publisher: Publisher<Event>,
    sender: u32,
    sequence: u64,
}

impl EventSender {
    /// Events of this sender (one of the `SENDER_` constants).
    ///
    /// # Errors
    /// As [`Session::publisher`].
    pub fn new(session: &Session, sender: u32) -> Result<EventSender, SessionError> {
        Ok(EventSender { publisher: session.publisher(&services::EVENT)?, sender, sequence: 0 })
    }

    /// Sends one event. Text beyond the limit is cut at a character.
    ///
    /// # Errors
    /// The transport's.
    pub fn send(&mut self, tick: u64, severity: u32, code: u32, text: &str) -> Result<(), PortError> {
        let mut end = text.len().min(MAX_EVENT_TEXT - 1);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        self.sequence += 1;
        let event = Event {
            tick,
            sequence: self.sequence,
            severity,
            code,
            sender: self.sender,
            text_length: end as u32 + 1,
        };
        self.publisher.send_parts(&[event.as_bytes(), &text.as_bytes()[..end], &[0]])
    }

    /// Sends a piece of information.
    ///
    /// # Errors
    /// The transport's.
    pub fn inform(&mut self, tick: u64, code: u32, text: &str) -> Result<(), PortError> {
        self.send(tick, SEVERITY_INFO, code, text)
    }
}
