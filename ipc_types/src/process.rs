//! What all of the hub's processes share: they end on request and with their parent, and send events.

use std::fmt;
use std::path::Path;
use std::time::{Duration, Instant};

use zerocopy::IntoBytes;

use crate::messages::services::{self, MAX_EVENT_TEXT};
use crate::messages::{Event, EventCode, Participant, Severity, Tick, Volume};
use crate::ports::{PortError, Publisher, ReceivedMessage, Subscriber};
use crate::scene::{Policy, Scene, SceneError};
use crate::session::{Session, SessionError};

pub use crate::family::{
    bind_to_parent, bind_to_parent_with, children, descendants, end_with_parent, is_alive,
};
pub use crate::signals::{EndRequest, EndSignal, ResumeFlag, exit_on_abort, reset_inherited_state};

/// Exit code of a run that failed.
pub const EXIT_FAILED: u8 = 1;
/// Exit code for bad input: nothing written, nothing lost.
pub const EXIT_BAD_INPUT: u8 = 2;
/// Exit code for finished work with an incomplete log: a gap, a truncation, or no end.
pub const EXIT_GAP: u8 = 3;
/// Exit code of a finished run with cautions, where these are to count as failures.
pub const EXIT_CAUTION: u8 = 4;

/// How long a process waits for the volume.
const VOLUME_LIMIT: Duration = Duration::from_secs(60);

/// Waits for the volume, which stays in shared memory as long as the return value lives.
///
/// # Errors
/// [`PortError::NoVolume`] if it did not arrive in time or the process was asked to end first; transport
/// errors.
pub fn await_volume(
    volumes: &Subscriber<Volume>,
    end: &EndRequest,
) -> Result<ReceivedMessage<Volume>, PortError> {
    let limit = Instant::now() + VOLUME_LIMIT;
    while Instant::now() < limit && !end.is_set() {
        if let Some(volume) = volumes.receive()? {
            return Ok(volume);
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    Err(PortError::NoVolume { limit_s: VOLUME_LIMIT.as_secs() })
}

/// CPU time that a process has used, user and system.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ProcessorTime {
    /// CPU time of all its threads.
    pub own: Duration,
    /// CPU time of child processes that have ended.
    pub children: Duration,
}

impl ProcessorTime {
    /// Returns the CPU time of the process with this number, or of `self`; `None` if it is gone.
    pub fn of(process: &str) -> Option<ProcessorTime> {
        let text = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
        // Fields 14 to 17 of the file, 11 to 14 after the name, which may contain anything
        // (proc_pid_stat(5)); in hundredths of a second.
        let (_, fields) = text.rsplit_once(')')?;
        let mut times = fields.split_whitespace().skip(11).map(|field| field.parse::<u64>().ok());
        let mut two = || Some(Duration::from_millis(10 * (times.next()?? + times.next()??)));
        Some(ProcessorTime { own: two()?, children: two()? })
    }
}

/// A part's role in the run, most urgent first. Under overload an earlier role preempts a later one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    /// Keeps the tick.
    Physics,
    /// Computes commands for the next tick.
    Controller,
    /// May be delayed, but must never starve: its queues hold
    /// [`RECORDER_QUEUE_TICKS`](crate::messages::services::RECORDER_QUEUE_TICKS).
    Recorder,
    /// Renders frames; the frame rate may drop.
    Drr,
    /// Shows progress to the user.
    Viewer,
}

/// How a part is scheduled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Priority {
    /// `SCHED_FIFO` priority; `None` for time-shared.
    pub fifo: Option<i32>,
    /// Nice value if time-shared: one step changes the share of the core by a quarter (sched(7)).
    pub nice: i32,
    /// Time slice to request if time-shared, instead of the kernel's default (about 3 ms). A thread with a
    /// short slice preempts one with a long slice as soon as it wakes (Linux 6.12, `PREEMPT_SHORT`). Needs no
    /// privilege.
    pub slice_ns: Option<u64>,
}

/// First words of the event with which the physics reports that it runs without the `SCHED_FIFO` that the
/// scene asks for.
pub const FIFO_REFUSED: &str = "SCHED_FIFO is not permitted";

impl fmt::Display for Priority {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.fifo {
            Some(fifo) => write!(f, "SCHED_FIFO {fifo}")?,
            None => write!(f, "nice {}", self.nice)?,
        }
        self.slice_ns.map_or(Ok(()), |ns| write!(f, " with a time slice of {} us", ns / 1000))
    }
}

impl Role {
    /// Returns this role's priority. FIFO priorities stay below 50, where the kernel's interrupt threads run.
    pub fn priority(self, policy: Policy) -> Priority {
        let (fifo, nice, slice_ns) = match self {
            Role::Physics => (Some(40), -15, Some(SHORTEST_SLICE_NS)),
            Role::Controller => (Some(30), -10, Some(2 * SHORTEST_SLICE_NS)),
            Role::Recorder => (None, -5, None),
            Role::Drr => (None, 5, None),
            Role::Viewer => (None, 10, None),
        };
        Priority { fifo: fifo.filter(|_| policy == Policy::Fifo), nice, slice_ns }
    }
}

/// The kernel's minimum time slice.
const SHORTEST_SLICE_NS: u64 = 100_000;

/// Gives this thread, and the threads it starts from now on, a role's priority, as far as the system permits.
/// Raising it needs a privilege (`CAP_SYS_NICE`, or RLIMIT_NICE and RLIMIT_RTPRIO), lowering it does not.
/// Returns the priority in effect.
///
/// Linux shares a core between sessions first, and only then between a session's threads (autogroup,
/// sched(7)). A session leader therefore sets the same nice value for its session; otherwise the value would
/// count only among its own threads.
pub fn prioritise(role: Role, policy: Policy) -> Priority {
    let wanted = role.priority(policy);
    let own = |nice: i32| rustix::process::setpriority_process(None, nice).is_ok();
    let nice = if own(wanted.nice) { wanted.nice } else { 0 };
    if rustix::process::getsid(None).is_ok_and(|leader| leader == rustix::process::getpid()) {
        // Kernels without autogroups have no such file and need none.
        let _ = std::fs::write("/proc/self/autogroup", nice.to_string());
    }
    let slice_ns = wanted.slice_ns.filter(|slice_ns| set_slice(*slice_ns, nice).is_ok());
    let fifo = wanted.fifo.filter(|priority| set_fifo(*priority).is_ok());
    Priority { fifo, nice, slice_ns }
}

/// `struct sched_attr`, first version (sched_setattr(2)).
#[repr(C)]
struct SchedulingAttributes {
    size: u32,
    policy: u32,
    flags: u64,
    nice: i32,
    priority: u32,
    runtime_ns: u64,
    deadline_ns: u64,
    period_ns: u64,
}

/// Requests a time slice for this thread, which is time-shared with this nice value. Kernels before 6.12
/// ignore it.
///
/// # Errors
/// If the system does not permit it.
pub fn set_slice(slice_ns: u64, nice: i32) -> std::io::Result<()> {
    let mut attributes = SchedulingAttributes {
        size: size_of::<SchedulingAttributes>() as u32,
        policy: libc::SCHED_OTHER as u32,
        flags: 0,
        nice,
        priority: 0,
        runtime_ns: slice_ns,
        deadline_ns: 0,
        period_ns: 0,
    };
    // SAFETY: 0 names the calling thread. The pointer is to a whole `sched_attr` of the size it states, which
    // outlives the call; the kernel writes only its own size to it, if it knows a smaller one. The last
    // argument is flags, none set.
    let outcome = unsafe { libc::syscall(libc::SYS_sched_setattr, 0, &raw mut attributes, 0) };
    if outcome == 0 { Ok(()) } else { Err(std::io::Error::last_os_error()) }
}

/// Puts this thread under `SCHED_FIFO`, but not the threads it starts later (`SCHED_RESET_ON_FORK`).
///
/// # Errors
/// If the system does not permit it.
pub fn set_fifo(priority: i32) -> std::io::Result<()> {
    let parameters = libc::sched_param { sched_priority: priority };
    // SAFETY: 0 names the calling thread. The second pointer is to a whole `sched_param` that outlives the
    // call, and the kernel only reads it.
    let outcome =
        unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &parameters) };
    if outcome == 0 { Ok(()) } else { Err(std::io::Error::last_os_error()) }
}

/// Loads a session's scene from the file that the launcher put into the session's folder.
///
/// # Errors
/// As [`crate::scene_file::load`].
pub fn session_scene(folder: &Path) -> Result<Scene, SceneError> {
    crate::scene_file::load(&folder.join("scene.toml"))
}

/// Sends a process's events.
#[derive(Debug)]
pub struct EventSender {
    publisher: Publisher<Event>,
    sender: Participant,
    sequence: u64,
}

impl EventSender {
    /// Creates the sender of this process's events.
    ///
    /// # Errors
    /// As [`Session::publisher`].
    pub fn new(session: &Session, sender: Participant) -> Result<EventSender, SessionError> {
        Ok(EventSender { publisher: session.publisher(&services::EVENT)?, sender, sequence: 0 })
    }

    /// Sends one event. Text over the limit is truncated at a character boundary.
    ///
    /// # Errors
    /// Transport errors.
    pub fn send(
        &mut self,
        tick: Tick,
        severity: Severity,
        code: EventCode,
        text: &str,
    ) -> Result<(), PortError> {
        let mut end = text.len().min(MAX_EVENT_TEXT - 1);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        self.sequence += 1;
        let event = Event {
            tick: tick.0,
            sequence: self.sequence,
            severity: severity.code(),
            code: code.code(),
            sender: self.sender.code(),
            text_length: end as u32 + 1,
        };
        self.publisher.send_parts(&[event.as_bytes(), &text.as_bytes()[..end], &[0]])
    }

    /// Sends a warning.
    ///
    /// # Errors
    /// Transport errors.
    pub fn warn(&mut self, tick: Tick, code: EventCode, text: &str) -> Result<(), PortError> {
        self.send(tick, Severity::Warning, code, text)
    }

    /// Sends an informational event.
    ///
    /// # Errors
    /// Transport errors.
    pub fn inform(&mut self, tick: Tick, code: EventCode, text: &str) -> Result<(), PortError> {
        self.send(tick, Severity::Info, code, text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_part_gives_way_to_those_before_it() {
        let order = [Role::Physics, Role::Controller, Role::Recorder, Role::Drr, Role::Viewer];
        for pair in order.windows(2) {
            let nice = |role: Role| role.priority(Policy::Other).nice;
            assert!(nice(pair[0]) < nice(pair[1]), "{pair:?}");
            let slice = |role: Role| role.priority(Policy::Other).slice_ns.unwrap_or(u64::MAX);
            assert!(slice(pair[0]) <= slice(pair[1]), "{pair:?}");
            let fifo = |role: Role| role.priority(Policy::Fifo).fifo.unwrap_or(0);
            assert!(fifo(pair[0]) >= fifo(pair[1]), "{pair:?}");
        }
        assert!(order.iter().all(|role| role.priority(Policy::Other).fifo.is_none()));
    }

    #[test]
    fn less_weight_is_always_permitted() {
        let got = std::thread::spawn(|| prioritise(Role::Viewer, Policy::Fifo)).join().unwrap();
        assert_eq!(got, Priority { fifo: None, nice: 10, slice_ns: None });
    }
}
