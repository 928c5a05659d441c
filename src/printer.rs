//! Writes the launcher's output on a separate thread, so that a stopped terminal (Ctrl-S) or an unread pipe
//! delays neither the response to a signal nor the run. Before [`start`], and in every other command, output
//! is written directly.
//!
//! Output that does not fit the queue is dropped and counted. The command's result (standard output) is never
//! dropped: `finish` waits for it at the end, up to a limit, unless a signal cuts the wait short.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{Error, ErrorKind, Write, stderr};
use std::os::unix::fs::MetadataExt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use rustix::io::Errno;

use crate::say;

/// A controller's line or a progress update is dropped if more than this many bytes wait.
const ECHO_BYTES: usize = 64 << 10;
/// The same limit for the launcher's own messages, which are few.
const WORD_BYTES: usize = 2 * ECHO_BYTES;
/// How long the command waits at its end for its result to be read.
const ANSWER_LIMIT: Duration = Duration::from_secs(60);
/// The same limit if only other output is pending.
const WORD_LIMIT: Duration = Duration::from_secs(5);
/// The same limit after a signal.
const HURRIED_LIMIT: Duration = Duration::from_millis(500);

/// Printers of standard output and standard error; the same printer twice if both lead to the same place, to
/// keep the order.
static PRINTERS: OnceLock<[Arc<Printer>; 2]> = OnceLock::new();
static HURRIED: AtomicBool = AtomicBool::new(false);

/// Priority of a text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Priority {
    Echo,
    Word,
    Answer,
}

impl Priority {
    /// Queue limit in bytes for a text of this priority.
    fn limit_bytes(self) -> usize {
        match self {
            Priority::Echo => ECHO_BYTES,
            Priority::Word => WORD_BYTES,
            // A line every two seconds, and a table.
            Priority::Answer => usize::MAX,
        }
    }
}

#[derive(Debug)]
struct Piece {
    to: Arc<File>,
    priority: Priority,
    bytes: Vec<u8>,
}

#[derive(Debug, Default)]
struct Queue {
    /// The first one is being written.
    waiting: VecDeque<Arc<Piece>>,
    /// Total length of all pending texts.
    bytes: usize,
    /// Lines dropped and not yet reported.
    dropped: usize,
    /// Why the result could not be written.
    failed: Option<String>,
}

impl Queue {
    fn push(&mut self, to: &Arc<File>, priority: Priority, bytes: Vec<u8>) {
        self.bytes += bytes.len();
        self.waiting.push_back(Arc::new(Piece { to: Arc::clone(to), priority, bytes }));
    }

    fn report_dropped(&mut self, to: &Arc<File>) {
        if self.dropped > 0 {
            let text =
                format!("trabecula: {} lines dropped because nothing read standard error\n", self.dropped);
            self.dropped = 0;
            self.push(to, Priority::Word, text.into_bytes());
        }
    }
}

/// A queue and the thread that drains it.
#[derive(Debug)]
struct Printer {
    queue: Mutex<Queue>,
    changed: Condvar,
}

impl Printer {
    fn start() -> std::io::Result<Arc<Printer>> {
        let printer = Arc::new(Printer { queue: Mutex::default(), changed: Condvar::new() });
        let of_thread = Arc::clone(&printer);
        std::thread::Builder::new().name("printer".to_owned()).spawn(move || of_thread.print())?;
        Ok(printer)
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn print(&self) {
        let mut queue = self.lock();
        loop {
            let Some(piece) = queue.waiting.front().cloned() else {
                queue = self.changed.wait(queue).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            drop(queue);
            let written = write_all(&*piece.to, &piece.bytes);
            queue = self.lock();
            if let Err(cause) = written
                && piece.priority == Priority::Answer
                && !is_gone(&cause)
            {
                queue.failed.get_or_insert(cause.to_string());
            }
            queue.waiting.pop_front();
            queue.bytes -= piece.bytes.len();
            self.changed.notify_all();
        }
    }

    fn push(&self, to: &Arc<File>, priority: Priority, bytes: &[u8]) {
        let mut queue = self.lock();
        if queue.bytes.saturating_add(bytes.len()) > priority.limit_bytes() {
            queue.dropped += bytes.iter().filter(|byte| **byte == b'\n').count();
            return;
        }
        queue.report_dropped(to);
        queue.push(to, priority, bytes.to_vec());
        self.changed.notify_all();
    }

    /// Waits until everything is written, up to the limit for the pending output.
    fn finish(&self, to: &Arc<File>, began: Instant, is_hurried: &dyn Fn() -> bool) -> Result<(), String> {
        let mut queue = self.lock();
        queue.report_dropped(to);
        self.changed.notify_all();
        while !queue.waiting.is_empty() {
            let answers = queue.waiting.iter().filter(|piece| piece.priority == Priority::Answer).count();
            let limit = match (is_hurried(), answers) {
                (true, _) => HURRIED_LIMIT,
                (false, 0) => WORD_LIMIT,
                (false, _) => ANSWER_LIMIT,
            };
            if began.elapsed() >= limit {
                return if answers > 0 { Err("no reader within the time limit".to_owned()) } else { Ok(()) };
            }
            let waited = self.changed.wait_timeout(queue, HURRIED_LIMIT / 10);
            queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        queue.failed.take().map_or(Ok(()), Err)
    }
}

/// Returns whether the reader has closed its pipe or terminal, which is not an error.
fn is_gone(cause: &Error) -> bool {
    cause.kind() == ErrorKind::BrokenPipe || cause.raw_os_error() == Some(Errno::IO.raw_os_error())
}

/// Writes everything, even if another program has made the terminal non-blocking.
fn write_all(mut to: impl Write, mut bytes: &[u8]) -> std::io::Result<()> {
    while !bytes.is_empty() {
        match say::when_ready(|| to.write(bytes)) {
            Ok(0) => return Err(Error::from(ErrorKind::WriteZero)),
            Ok(count) => bytes = &bytes[count..],
            Err(cause) if cause.kind() == ErrorKind::Interrupted => {}
            Err(cause) => return Err(cause),
        }
    }
    Ok(())
}

/// The two streams without the standard library's locks, which a blocked writer would hold.
static STREAMS: OnceLock<[Arc<File>; 2]> = OnceLock::new();

/// Starts writing this process's output on a separate thread.
///
/// # Errors
/// The thread cannot be started, or the stream handles cannot be duplicated.
pub fn start() -> std::io::Result<()> {
    let out = File::from(rustix::stdio::stdout().try_clone_to_owned()?);
    let err = File::from(rustix::stdio::stderr().try_clone_to_owned()?);
    let place = |file: &File| file.metadata().map(|it| (it.dev(), it.ino(), it.rdev()));
    let first = Printer::start()?;
    let second = if place(&out)? == place(&err)? { Arc::clone(&first) } else { Printer::start()? };
    let _ = STREAMS.set([Arc::new(out), Arc::new(err)]);
    let _ = PRINTERS.set([first, second]);
    Ok(())
}

/// Called on a signal, so that the end of the command does not wait for slow readers.
pub fn hurry() {
    HURRIED.store(true, Ordering::Relaxed);
}

/// Waits, up to the limit, until the command's result is written. Returns why it could not be.
pub fn finish_answers() -> Option<String> {
    finish(0).err()
}

/// Waits in the same way for all other output; gives up if it is not read.
pub fn finish_words() {
    let _ = finish(1);
}

fn finish(stream: usize) -> Result<(), String> {
    let (Some(printers), Some([_, words])) = (PRINTERS.get(), STREAMS.get()) else { return Ok(()) };
    printers[stream].finish(words, Instant::now(), &|| HURRIED.load(Ordering::Relaxed))
}

/// Exits after a signal, printing only what can be written within a moment.
pub fn leave(code: u8) -> ! {
    hurry();
    finish_answers();
    finish_words();
    std::process::exit(code.into());
}

/// Returns whether earlier output is still pending, so that a table drawn now would be outdated when it
/// appears.
pub fn is_behind() -> bool {
    PRINTERS.get().is_some_and(|printers| !printers[1].lock().waiting.is_empty())
}

fn put(stream: usize, priority: Priority, bytes: &[u8]) -> std::io::Result<usize> {
    match (PRINTERS.get(), STREAMS.get()) {
        (Some(printers), Some(streams)) => printers[stream].push(&streams[stream], priority, bytes),
        _ if stream == 0 => say::standard_output().write_all(bytes)?,
        _ => write_all(stderr(), bytes)?,
    }
    Ok(bytes.len())
}

/// Standard output: the command's result.
#[derive(Debug)]
pub struct ResultOutput;

/// Standard error: the command's own messages.
#[derive(Debug)]
pub struct Diagnostics;

/// Standard error: output of other programs, and the progress display.
#[derive(Debug)]
pub struct ForwardedOutput;

macro_rules! stream {
    ($name:ident, $stream:expr, $priority:expr) => {
        impl Write for $name {
            fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
                put($stream, $priority, bytes)
            }

            fn flush(&mut self) -> std::io::Result<()> {
                Ok(())
            }
        }
    };
}

stream!(ResultOutput, 0, Priority::Answer);
stream!(Diagnostics, 1, Priority::Word);
stream!(ForwardedOutput, 1, Priority::Echo);

#[cfg(test)]
mod tests {
    use test_support::limited::{read_all, text_within};

    use super::*;

    #[test]
    fn what_nobody_reads_is_left_out_and_counted_but_no_answer() {
        let (reader, writer) = std::io::pipe().unwrap();
        let to = Arc::new(File::from(std::os::fd::OwnedFd::from(writer)));
        let printer = Printer::start().unwrap();
        let line = [b"x".repeat(99), b"\n".to_vec()].concat();
        // More than a pipe and the queue hold; the exact amount depends on the printer's progress.
        let lines = 5000;
        (0..lines).for_each(|_| printer.push(&to, Priority::Echo, &line));
        printer.push(&to, Priority::Word, b"a word\n");
        printer.push(&to, Priority::Answer, b"the answer\n");
        // The pipe is not read.
        let finish = |hurried: bool| printer.finish(&to, Instant::now(), &|| hurried);
        assert!(finish(true).is_err());
        let reading = read_all(reader);
        assert_eq!(finish(false), Ok(()));
        drop(to);
        // The printer's handle is dropped with its last piece; the thread waits for more.
        let text = text_within(&reading, ANSWER_LIMIT, "the pipe");
        let shown = text.lines().filter(|line| line.starts_with('x')).count();
        // There may be several notices if the printer freed space in between; together they count all lines.
        let notice = |line: &str| -> Option<usize> {
            let told = line.strip_prefix("trabecula: ")?;
            told.strip_suffix(" lines dropped because nothing read standard error")?.parse().ok()
        };
        let counts: Vec<usize> = text.lines().filter_map(notice).collect();
        assert_eq!(shown + counts.len() + 2, text.lines().count(), "lines, notices, a word and the answer");
        assert!(
            !counts.is_empty() && counts.iter().sum::<usize>() == lines - shown,
            "{shown} shown, {counts:?}"
        );
        assert!(text.ends_with("a word\nthe answer\n"), "{}", &text[text.len() - 200..]);
    }

    #[test]
    fn a_stream_that_cannot_be_written_fails_the_answer_and_a_closed_pipe_does_not() {
        let full = Arc::new(File::options().write(true).open("/dev/full").unwrap());
        let printer = Printer::start().unwrap();
        let finish = |to: &Arc<File>| printer.finish(to, Instant::now(), &|| false);
        printer.push(&full, Priority::Word, b"a word\n");
        assert_eq!(finish(&full), Ok(()));
        printer.push(&full, Priority::Answer, b"the answer\n");
        assert!(finish(&full).unwrap_err().contains("No space left"));
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let closed = Arc::new(File::from(std::os::fd::OwnedFd::from(writer)));
        printer.push(&closed, Priority::Answer, b"the answer\n");
        assert_eq!(finish(&closed), Ok(()));
    }
}
