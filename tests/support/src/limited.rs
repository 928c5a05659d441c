//! Runs programs with a time limit.

use std::io::{self, Read};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process, kill_process_group};

/// Limit for a command that does real work. Only a hang reaches it, even on a loaded machine.
pub const COMMAND_LIMIT: Duration = Duration::from_secs(600);
const LOOK: Duration = Duration::from_millis(5);
/// How long to wait for the remaining output of a program that has ended.
const OUTPUT_LIMIT: Duration = Duration::from_secs(10);

/// [`Command::output`] and [`Command::status`] with a limit.
pub trait Limited {
    /// Returns the command's output; standard input is empty.
    ///
    /// # Errors
    /// The program cannot be started.
    ///
    /// # Panics
    /// It has not ended within [`COMMAND_LIMIT`]: it is killed with all programs that it has started.
    fn limited_output(&mut self) -> io::Result<Output> {
        self.output_within(COMMAND_LIMIT)
    }

    /// Like [`Limited::limited_output`], with another limit.
    ///
    /// # Errors
    /// The program cannot be started.
    ///
    /// # Panics
    /// The limit is exceeded.
    fn output_within(&mut self, limit: Duration) -> io::Result<Output>;
}

impl Limited for Command {
    fn output_within(&mut self, limit: Duration) -> io::Result<Output> {
        // A separate process group, so that a kill reaches all programs started by this one.
        let child = self
            .process_group(0)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        Ok(limited_output_of(child, limit, &format!("{self:?}")))
    }
}

/// Returns the output of a child whose standard output and error are pipes. The child leads a process group
/// or has started nothing.
///
/// # Panics
/// It has not ended within the limit: it is killed.
pub fn limited_output_of(mut child: Child, limit: Duration, what: &str) -> Output {
    let out = child.stdout.take().map(read_all);
    let err = child.stderr.take().map(read_all);
    let status = poll(&mut child, limit);
    if status.is_none() {
        kill_with_group(&mut child);
    }
    let read = |pipe: Option<Receiver<Vec<u8>>>| {
        // A grandchild may hold the pipe longer than its parent lives.
        pipe.map(|pipe| pipe.recv_timeout(OUTPUT_LIMIT).unwrap_or_default()).unwrap_or_default()
    };
    let (stdout, stderr) = (read(out), read(err));
    let Some(status) = status else {
        panic!(
            "{what} did not end within {limit:?} and was killed; it had said:\n{}\n{}",
            String::from_utf8_lossy(&stdout),
            String::from_utf8_lossy(&stderr)
        );
    };
    Output { status, stdout, stderr }
}

/// Waits for a child and returns how it ended.
///
/// # Panics
/// It has not ended within the limit: it is killed.
pub fn end_within(child: &mut Child, limit: Duration, what: &str) -> ExitStatus {
    poll(child, limit).unwrap_or_else(|| {
        kill_with_group(child);
        panic!("{what} did not end within {limit:?} and was killed")
    })
}

fn poll(child: &mut Child, limit: Duration) -> Option<ExitStatus> {
    let end = Instant::now() + limit;
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return Some(status);
        }
        if Instant::now() >= end {
            return None;
        }
        std::thread::sleep(LOOK);
    }
}

/// Acts when a limit is exceeded, unless it is dropped before.
#[derive(Debug)]
pub struct Watchdog(Sender<()>);

/// Longer than the longest test on a loaded machine, those of the Python package: a quarter of an hour.
const TEST_LIMIT: Duration = Duration::from_secs(1800);

impl Watchdog {
    /// Kills a program, so that reading its output line by line cannot block for longer; drop it before
    /// waiting for the child.
    pub fn over(child: &Child, limit: Duration) -> Watchdog {
        let pid = Pid::from_child(child);
        Watchdog::after(limit, move || {
            let _ = kill_process(pid, Signal::KILL);
        })
    }

    /// Ends the test program and names this thread's test if it has not ended within half an hour: cargo's
    /// test runner has no limit of its own, and waits for a hung test without naming it.
    pub fn over_test() -> Watchdog {
        Watchdog::of_test(TEST_LIMIT, |name| {
            eprintln!("the test `{name}` did not end within {TEST_LIMIT:?}");
            std::process::exit(101);
        })
    }

    fn of_test(limit: Duration, exceeded: impl FnOnce(&str) + Send + 'static) -> Watchdog {
        let name = std::thread::current().name().unwrap_or("without a name").to_owned();
        Watchdog::after(limit, move || exceeded(&name))
    }

    fn after(limit: Duration, exceeded: impl FnOnce() + Send + 'static) -> Watchdog {
        let (sender, receiver) = channel();
        std::thread::spawn(move || {
            if receiver.recv_timeout(limit) == Err(RecvTimeoutError::Timeout) {
                exceeded();
            }
        });
        Watchdog(sender)
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        // The thread may have ended.
        let _ = self.0.send(());
    }
}

/// Sets a flag when it is dropped, also in a panic: a scope waits for its threads, and they for the flag.
#[derive(Debug)]
pub struct SetAtEnd<'f>(pub &'f AtomicBool);

impl Drop for SetAtEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Kills a child, and its group if it leads one.
fn kill_with_group(child: &mut Child) {
    // No such group: the child leads none, and is killed alone.
    let _ = kill_process_group(Pid::from_child(child), Signal::KILL);
    let _ = child.kill();
    let _ = child.wait();
}

/// Reads a pipe to its end in a separate thread; the receiver then gets the content.
pub fn read_all(mut pipe: impl Read + Send + 'static) -> Receiver<Vec<u8>> {
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = pipe.read_to_end(&mut bytes);
        // There is no receiver any more if the limit was exceeded.
        let _ = sender.send(bytes);
    });
    receiver
}

/// Returns everything that [`read_all`] reads from a pipe, as text.
///
/// # Panics
/// The pipe has not ended within the limit.
pub fn text_within(pipe: &Receiver<Vec<u8>>, limit: Duration, what: &str) -> String {
    let bytes = pipe.recv_timeout(limit).unwrap_or_else(|_| panic!("{what} did not end within {limit:?}"));
    String::from_utf8_lossy(&bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_that_ends_gives_its_output() {
        let output =
            Command::new("sh").args(["-c", "echo out; echo err >&2; exit 3"]).limited_output().unwrap();
        assert_eq!(
            (output.status.code(), &*output.stdout, &*output.stderr),
            (Some(3), &b"out\n"[..], &b"err\n"[..])
        );
    }

    #[test]
    #[should_panic(expected = "did not end within")]
    fn a_program_that_hangs_is_killed_with_what_it_started() {
        let script = "echo begun; sleep 1000 & sleep 1000";
        let _ = Command::new("sh").args(["-c", script]).output_within(Duration::from_millis(300));
    }

    #[test]
    fn a_reader_of_a_silent_program_is_freed() {
        let mut child = Command::new("sleep").arg("1000").stdout(Stdio::piped()).spawn().unwrap();
        let watchdog = Watchdog::over(&child, Duration::from_millis(100));
        let mut said = String::new();
        child.stdout.take().unwrap().read_to_string(&mut said).unwrap();
        drop(watchdog);
        assert!(!end_within(&mut child, COMMAND_LIMIT, "sleep").success());
    }

    #[test]
    fn a_test_that_hangs_is_named() {
        let (sender, receiver) = channel();
        let limit =
            Watchdog::of_test(Duration::from_millis(20), move |name| sender.send(name.to_owned()).unwrap());
        assert!(receiver.recv_timeout(COMMAND_LIMIT).unwrap().ends_with("a_test_that_hangs_is_named"));
        drop(limit);
    }

    #[test]
    fn more_output_than_a_pipe_holds_stops_nobody() {
        let output = Command::new("sh").args(["-c", "head -c 1000000 /dev/zero"]).limited_output().unwrap();
        assert_eq!(output.stdout.len(), 1_000_000);
    }
}
