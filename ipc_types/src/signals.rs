//! The signals that the hub's processes handle: requests to end, resuming after a stop, and aborts; and the
//! state that a process inherits.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rustix::fs::Mode;
use rustix::process::{Resource, getrlimit, umask};
use signal_hook::consts::{SIGABRT, SIGCONT, SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::low_level::signal_name;

/// Signals within this time count as one request: `timeout` signals a process and then its group, and a
/// closing terminal sends SIGHUP twice.
const ONE_REQUEST: Duration = Duration::from_millis(300);

/// Ignored signals that stay ignored: SIGHUP by `nohup`, SIGINT and SIGQUIT in background commands of a shell
/// script, SIGPIPE by Rust's runtime, which gives its children the default.
const STAY_IGNORED: [i32; 4] = [libc::SIGHUP, libc::SIGINT, libc::SIGQUIT, libc::SIGPIPE];

/// Resets what a process inherits from its parent over `exec` and what would break it: signals, timers, and a
/// umask that takes the user's own rights to new files. Priority, cores, OOM score and limits are the user's
/// choice and stay. With a limit on the address space all threads share one allocation arena: each further
/// one takes 64 MiB of it. Call it before the first thread starts; threads and children inherit the result.
pub fn reset_inherited_state() {
    stop_inherited_timers();
    reset_inherited_signals();
    let inherited = umask(Mode::empty());
    umask(inherited - Mode::RWXU);
    if getrlimit(Resource::As).current.is_some() {
        // SAFETY: the call only sets a number of the C library's allocator, before the first thread starts.
        unsafe { libc::mallopt(libc::M_ARENA_MAX, 1) };
    }
}

/// Stops the timers of `setitimer` and `alarm`, which survive `exec`: their signals would kill the process.
/// One that was blocked and is pending is discarded: `SIG_IGN` does that.
fn stop_inherited_timers() {
    for (timer, signal) in [
        (libc::ITIMER_REAL, libc::SIGALRM),
        (libc::ITIMER_VIRTUAL, libc::SIGVTALRM),
        (libc::ITIMER_PROF, libc::SIGPROF),
    ] {
        // SAFETY: `itimerval` is a C structure of integers, for which zero is valid and stops the timer. The
        // call reads a whole structure that outlives it, and gets null for the previous value. With SIG_IGN
        // and SIG_DFL no code of this process runs on a signal.
        unsafe {
            let none: libc::itimerval = std::mem::zeroed();
            libc::setitimer(timer, &raw const none, std::ptr::null_mut());
            libc::signal(signal, libc::SIG_IGN);
            libc::signal(signal, libc::SIG_DFL);
        }
    }
}

/// Makes an abort end the process with this exit code instead of a signal. The cause has been printed by
/// then: the standard library aborts when memory runs out, the C++ library at an uncaught exception.
///
/// # Errors
/// If the system refuses to install a handler.
pub fn exit_on_abort(code: u8) -> std::io::Result<()> {
    let always = Arc::new(AtomicBool::new(true));
    signal_hook::flag::register_conditional_shutdown(SIGABRT, code.into(), always).map(drop)
}

/// Unblocks all signals, and gives those that the parent ignored their default action, except those that
/// are ignored by convention (`nohup`, background commands). Both survive `exec`: with SIGCHLD ignored no
/// child can be waited for, and a blocked SIGTERM is never delivered.
fn reset_inherited_signals() {
    for signal in 1..=libc::SIGRTMAX() {
        if !STAY_IGNORED.contains(&signal) && is_ignored(signal) {
            // SAFETY: with SIG_DFL no code of this process runs on a signal.
            unsafe { libc::signal(signal, libc::SIG_DFL) };
        }
    }
    // SAFETY: `sigemptyset` initializes the whole set before it is read, and the set outlives both calls.
    unsafe {
        let mut none: libc::sigset_t = std::mem::zeroed();
        libc::sigemptyset(&raw mut none);
        libc::pthread_sigmask(libc::SIG_SETMASK, &raw const none, std::ptr::null_mut());
    }
}

/// Set when the process is asked to end: SIGTERM, SIGINT (Ctrl-C), SIGHUP (a closed terminal, a dropped
/// connection).
#[derive(Debug, Clone, Default)]
pub struct EndRequest {
    asked: Arc<AtomicBool>,
    urged: Arc<AtomicBool>,
}

/// A request to end, with the name of its signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndSignal {
    /// The first request.
    First(&'static str),
    /// A repeated request: the user does not want to wait.
    Repeated(&'static str),
}

impl EndRequest {
    /// Installs handlers: from now on the signals set the flag instead of killing the process. An ignored
    /// SIGHUP (`nohup`) stays ignored.
    ///
    /// # Errors
    /// If the system refuses to install a handler.
    pub fn install() -> std::io::Result<EndRequest> {
        let request = EndRequest::default();
        for signal in heard_signals() {
            signal_hook::flag::register(signal, Arc::clone(&request.asked))?;
        }
        Ok(request)
    }

    /// As [`install`](EndRequest::install), with a thread that hands each request to `answer` at once,
    /// however busy the rest of the process is.
    ///
    /// # Errors
    /// If the system refuses to install a handler or to start the thread.
    pub fn answered(mut answer: impl FnMut(EndSignal) + Send + 'static) -> std::io::Result<EndRequest> {
        let mut signals = Signals::new(heard_signals())?;
        let request = EndRequest::install()?;
        let told = request.clone();
        std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
            let mut first: Option<Instant> = None;
            for signal in signals.forever() {
                let name = signal_name(signal).unwrap_or("a signal");
                match first {
                    None => {
                        first = Some(Instant::now());
                        answer(EndSignal::First(name));
                    }
                    Some(at) if signal != SIGHUP && at.elapsed() >= ONE_REQUEST => {
                        told.urged.store(true, Ordering::Relaxed);
                        answer(EndSignal::Repeated(name));
                    }
                    Some(_) => {}
                }
            }
        })?;
        Ok(request)
    }

    /// Returns whether the process has been asked to end.
    pub fn is_set(&self) -> bool {
        self.asked.load(Ordering::Relaxed)
    }

    /// Returns whether it has been asked again. SIGHUP never counts as the second request: the user has left
    /// and cannot be impatient.
    pub fn is_urgent(&self) -> bool {
        self.urged.load(Ordering::Relaxed)
    }
}

/// Set when the process resumes after a stop (SIGSTOP, Ctrl-Z, a debugger's detach); the kernel then sends
/// SIGCONT.
#[derive(Debug, Clone, Default)]
pub struct ResumeFlag(Arc<AtomicBool>);

impl ResumeFlag {
    /// Installs a handler: from now on SIGCONT sets the flag; the process resumes as before.
    ///
    /// # Errors
    /// If the system refuses to install a handler.
    pub fn install() -> std::io::Result<ResumeFlag> {
        let flag = Arc::new(AtomicBool::new(false));
        signal_hook::flag::register(SIGCONT, Arc::clone(&flag))?;
        Ok(ResumeFlag(flag))
    }

    /// Returns whether the process has resumed since the last call.
    pub fn take(&self) -> bool {
        self.0.load(Ordering::Relaxed) && self.0.swap(false, Ordering::Relaxed)
    }
}

fn heard_signals() -> Vec<i32> {
    let mut signals = vec![SIGTERM, SIGINT];
    if !is_ignored(SIGHUP) {
        signals.push(SIGHUP);
    }
    signals
}

/// Returns whether this process ignores a signal. The C library refuses signals that it keeps for itself.
fn is_ignored(signal: i32) -> bool {
    // SAFETY: `sigaction` is a C structure of integers, a set of integers and an optional function, for all
    // of which zero is valid. The call gets a pointer to a whole structure that outlives it, and null, with
    // which it changes nothing.
    unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        libc::sigaction(signal, std::ptr::null(), &raw mut action) == 0
            && action.sa_sigaction == libc::SIG_IGN
    }
}
