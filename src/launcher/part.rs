//! Starts, watches and ends one process of a run.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Error, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ipc_types::process::{ProcessorTime, bind_to_parent, children, descendants};
use rustix::process::{
    Pid, Signal, WaitId, WaitIdOptions, WaitOptions, getpid, kill_process, kill_process_group,
    set_child_subreaper, waitid, waitpid,
};

use crate::keeper::{END_AT_ONCE, StartReport};
use crate::machine::memory::out_of_memory_kills;
use crate::printer::ForwardedOutput;

/// Number of a part's last output lines to keep.
const LAST_WORDS: usize = 20;
/// Longest line kept, in bytes; longer ones are split.
const LONGEST_LINE: u64 = 4096;
/// Timeout for the last output lines.
const WORDS_LIMIT: Duration = Duration::from_secs(1);
/// Timeout for a keeper to report that it has started its program.
const START_LIMIT: Duration = Duration::from_secs(20);
/// Timeout for a keeper to kill everything, after which it is killed itself.
const KEEPER_LIMIT: Duration = Duration::from_secs(3);

/// Number of consecutive checks that must find no orphan.
const LOOKS_WITHOUT_ORPHANS: u32 = 3;
/// Interval between checks for orphans of a killed keeper.
const ORPHAN_POLL_PERIOD: Duration = Duration::from_millis(2);

/// Every part not yet reaped, so that another thread can kill all of them ([`end_all_at_once`]).
static RUNNING: Mutex<Vec<KillHandle>> = Mutex::new(Vec::new());

/// Whether this process is the subreaper of its parts' descendants.
static IS_SUBREAPER: AtomicBool = AtomicBool::new(false);

/// Handle to kill a part.
#[derive(Debug, Clone)]
struct KillHandle {
    /// Leads its own process group (`bind_to_parent`).
    pid: Option<Pid>,
    /// Socket to the keeper, if the part has one.
    leash: Option<Arc<UnixStream>>,
}

impl KillHandle {
    /// Signals the part and its process group.
    fn signal(&self, signal: Signal) {
        // They may just have ended.
        let _ = self.pid.map(|pid| kill_process_group(pid, signal));
    }

    fn end_at_once(&self) {
        match &self.leash {
            // Wake a stopped keeper so that it reads the request.
            Some(leash) if leash.as_ref().write_all(&[END_AT_ONCE]).is_ok() => self.signal(Signal::CONT),
            _ => self.signal(Signal::KILL),
        }
    }
}

/// Kills every part of this process and all their descendants.
pub fn end_all_at_once() {
    // A part leaves the list before it is reaped, so its group number cannot have been reused.
    running().iter().for_each(KillHandle::end_at_once);
}

/// Makes this process the subreaper, so that orphans of a killed keeper become its children and are killed
/// too. Only for a process whose children are all parts. They must not include a viewer, whose orphan can be
/// the user's browser.
pub fn adopt() {
    IS_SUBREAPER.store(set_child_subreaper(Some(getpid())).is_ok(), Ordering::Relaxed);
}

/// Kills the orphans of a killed keeper; a keeper that exits normally leaves none. Repeats, because a scan of
/// `/proc` can miss a process spawned just before its parent ends.
fn kill_orphans() {
    let end = Instant::now() + KEEPER_LIMIT;
    let mut killed = Vec::new();
    let mut looks_without = 0;
    while IS_SUBREAPER.load(Ordering::Relaxed) && Instant::now() < end {
        let parts: Vec<Option<Pid>> = running().iter().map(|kill_handle| kill_handle.pid).collect();
        let left: Vec<Pid> = children().into_iter().filter(|pid| !parts.contains(&Some(*pid))).collect();
        looks_without = if left.is_empty() { looks_without + 1 } else { 0 };
        if looks_without == LOOKS_WITHOUT_ORPHANS {
            break;
        }
        for pid in left.iter().flat_map(|pid| descendants(*pid)).chain(left.iter().copied()) {
            // It may just have ended.
            let _ = kill_process(pid, Signal::KILL);
        }
        killed.extend(left);
        std::thread::sleep(ORPHAN_POLL_PERIOD);
    }
    for pid in killed {
        let _ = waitpid(Some(pid), WaitOptions::NOHANG);
    }
}

fn running() -> MutexGuard<'static, Vec<KillHandle>> {
    RUNNING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A running part.
#[derive(Debug)]
pub struct PartProcess {
    /// Its name in messages.
    pub name: String,
    child: Child,
    kill_handle: KillHandle,
    /// The process to measure; for a part with a keeper, its program.
    process: u32,
    words: Arc<Mutex<VecDeque<String>>>,
    /// Threads that read the part's output; they end when the output closes.
    listeners: Vec<JoinHandle<()>>,
    status: Option<ExitStatus>,
    /// Peak memory so far.
    pub memory: Memory,
    /// Processor time it has used so far.
    pub processor: Duration,
    /// The kernel's count of processes killed because memory ran out, when the part was started.
    memory_kills: u64,
}

/// Memory of a process in bytes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Memory {
    /// Peak resident memory, including shared memory.
    pub peak_resident: u64,
    /// Peak private memory: resident, excluding shared memory.
    pub peak_private: u64,
    /// Private memory at the last measurement.
    pub private: u64,
}

impl Memory {
    /// Updates the values from a process, given as a process ID or `self`. Does nothing if the process has
    /// ended.
    pub fn measure(&mut self, process: &str) {
        let Ok(text) = std::fs::read_to_string(format!("/proc/{process}/status")) else { return };
        // A zombie has no such lines.
        if !text.contains("RssAnon:") {
            return;
        }
        let field = |name: &str| {
            let line = text.lines().find(|line| line.starts_with(name))?;
            line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib * 1024)
        };
        let private = field("RssAnon:").unwrap_or(0) + field("RssFile:").unwrap_or(0);
        self.peak_resident = self.peak_resident.max(field("VmHWM:").unwrap_or(0));
        self.peak_private = self.peak_private.max(private);
        self.private = private;
    }
}

/// Handling of a program's output, apart from keeping its last lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgramOutput {
    /// Print it, each line prefixed with the program's name.
    Shown,
    /// Discard it.
    Hidden,
}

impl PartProcess {
    /// Starts a program. Keeps its last output lines.
    pub fn start(name: &str, command: &mut Command, output: ProgramOutput) -> std::io::Result<PartProcess> {
        PartProcess::start_with(name, command.stdin(Stdio::null()), None, output)
    }

    /// Starts a program through its keeper's command line (`src/keeper.rs`).
    pub fn start_kept(
        name: &str,
        keeper: &mut Command,
        output: ProgramOutput,
    ) -> std::io::Result<PartProcess> {
        let (ours, its) = UnixStream::pair()?;
        ours.set_read_timeout(Some(START_LIMIT))?;
        let leash = Arc::new(ours);
        let keeper = keeper.stdin(OwnedFd::from(its));
        let mut part = PartProcess::start_with(name, keeper, Some(Arc::clone(&leash)), output)?;
        // Drop the command's copy, so that our side of the socket closes when the keeper ends.
        keeper.stdin(Stdio::null());
        match StartReport::read(&leash)? {
            StartReport::As(process) => part.process = process,
            StartReport::Not(code) => return Err(Error::from_raw_os_error(code)),
        }
        Ok(part)
    }

    fn start_with(
        name: &str,
        command: &mut Command,
        leash: Option<Arc<UnixStream>>,
        output: ProgramOutput,
    ) -> std::io::Result<PartProcess> {
        let mut child = bind_to_parent(command.stdout(Stdio::piped()).stderr(Stdio::piped())).spawn()?;
        let kill_handle = KillHandle { pid: i32::try_from(child.id()).ok().and_then(Pid::from_raw), leash };
        running().push(kill_handle.clone());
        let words = Arc::new(Mutex::new(VecDeque::new()));
        let shown_as = (output == ProgramOutput::Shown).then(|| name.to_owned());
        let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
        // Dropped, and so killed, if no thread can be started.
        let mut part = PartProcess {
            name: name.to_owned(),
            process: child.id(),
            child,
            kill_handle,
            words: Arc::clone(&words),
            listeners: Vec::new(),
            status: None,
            memory: Memory::default(),
            processor: Duration::ZERO,
            memory_kills: out_of_memory_kills(),
        };
        if let Some(output) = stdout {
            part.listeners.push(listen(output, Arc::clone(&words), shown_as.clone())?);
        }
        if let Some(output) = stderr {
            part.listeners.push(listen(output, words, shown_as)?);
        }
        Ok(part)
    }

    /// Returns whether the kernel has killed a process since the part's start because memory ran out.
    pub fn may_have_lacked_memory(&self) -> bool {
        out_of_memory_kills() > self.memory_kills
    }

    /// Process ID of the part.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns the exit status if the part has ended. All its descendants end with it.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        if self.status.is_none() && self.is_to_be_reaped() {
            self.kill_handle.signal(Signal::KILL);
            self.reap();
        }
        self.status
    }

    /// Returns whether the part is still running; once ended, it cannot be measured.
    pub fn is_running(&self) -> bool {
        self.status.is_none() && !self.is_to_be_reaped()
    }

    fn is_to_be_reaped(&self) -> bool {
        let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
        self.kill_handle.pid.is_some_and(|pid| !matches!(waitid(WaitId::Pid(pid), options), Ok(None)))
    }

    /// Reaps the process, which has ended or been killed.
    fn reap(&mut self) {
        running().retain(|kill_handle| kill_handle.pid != self.kill_handle.pid);
        self.status = self.child.wait().ok();
        if self.kill_handle.leash.is_some() {
            kill_orphans();
        }
    }

    /// Returns the last output lines of a part that has ended.
    pub fn last_words(&self) -> Vec<String> {
        // Output may still be in the pipe, and an orphan may keep the pipe open.
        let end = Instant::now() + WORDS_LIMIT;
        while self.listeners.iter().any(|listener| !listener.is_finished()) && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(2));
        }
        self.words.lock().unwrap_or_else(PoisonError::into_inner).iter().cloned().collect()
    }

    /// Reads the part's memory and processor time.
    pub fn measure(&mut self) {
        let process = self.process.to_string();
        self.memory.measure(&process);
        self.processor = ProcessorTime::of(&process).map_or(self.processor, |time| time.own);
    }

    /// Asks the part to end (SIGTERM).
    pub fn ask_to_end(&mut self) {
        if self.ended().is_none() {
            self.kill_handle.signal(Signal::TERM);
        }
    }

    /// Kills the part and all its descendants.
    pub fn kill(&mut self) {
        if self.ended().is_some() {
            return;
        }
        self.kill_handle.end_at_once();
        if self.kill_handle.leash.is_some() && self.ends_within(KEEPER_LIMIT) {
            return;
        }
        self.kill_handle.signal(Signal::KILL);
        self.reap();
    }

    /// Waits for the part to end and kills it after the limit. Returns whether it ended on its own.
    pub fn wait(&mut self, limit: Duration) -> bool {
        let ended = self.ends_within(limit);
        if !ended {
            self.kill();
        }
        ended
    }

    /// Waits for the part to end; returns whether it has.
    pub fn ends_within(&mut self, limit: Duration) -> bool {
        let end = Instant::now() + limit;
        while self.ended().is_none() {
            if Instant::now() >= end {
                return false;
            }
            self.measure();
            std::thread::sleep(Duration::from_millis(2));
        }
        true
    }
}

impl Drop for PartProcess {
    fn drop(&mut self) {
        // Also reaps it, so that no zombie stays.
        self.kill();
    }
}

fn listen(
    output: impl Read + Send + 'static,
    words: Arc<Mutex<VecDeque<String>>>,
    shown_as: Option<String>,
) -> std::io::Result<JoinHandle<()>> {
    std::thread::Builder::new().name("listener".to_owned()).spawn(move || {
        let mut output = BufReader::new(output);
        let mut bytes = Vec::new();
        // Read to the end, whatever the bytes; otherwise SIGPIPE would kill the part at its next write.
        while output.by_ref().take(LONGEST_LINE).read_until(b'\n', &mut bytes).is_ok_and(|count| count > 0) {
            let line = String::from_utf8_lossy(&bytes).trim_end_matches(['\n', '\r']).to_owned();
            bytes.clear();
            if let Some(name) = &shown_as {
                crate::say::line(&mut ForwardedOutput, &format!("[{name}] {line}"));
            }
            let mut words = words.lock().unwrap_or_else(PoisonError::into_inner);
            if words.len() == LAST_WORDS {
                words.pop_front();
            }
            words.push_back(line);
        }
    })
}
