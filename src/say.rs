//! Standard output and error. Every command prints through this module.
//!
//! A reader that stops early (`| head`) is not an error. Output that cannot be written always is:
//! [`unwritten`] reports it at the end. Output may contain untrusted text, so everything that a terminal
//! would interpret is escaped.

use std::io::{self, BufWriter, ErrorKind, Stdout, StdoutLock, Write};
use std::path::Path;
use std::sync::OnceLock;
use std::time::Duration;

use foreign_text::{EscapingWriter, plain};

use crate::printer;

/// The first reason why standard output could not be written.
static UNWRITTEN: OnceLock<String> = OnceLock::new();

/// A writer to standard output that remembers the first error.
#[derive(Debug)]
pub struct CheckedWriter<W>(W);

impl<W: Write> Write for CheckedWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        note(when_ready(|| self.0.write(bytes)))
    }

    fn flush(&mut self) -> io::Result<()> {
        note(when_ready(|| self.0.flush()))
    }
}

/// Interval between retries on a non-blocking stream.
const RETRY: Duration = Duration::from_millis(10);

/// Writes to a stream that may be non-blocking, because another program that shares it has made it so: waits
/// until it takes more, as a blocking one does.
pub fn when_ready<T>(mut write: impl FnMut() -> io::Result<T>) -> io::Result<T> {
    loop {
        match write() {
            Err(cause) if cause.kind() == ErrorKind::WouldBlock => std::thread::sleep(RETRY),
            written => return written,
        }
    }
}

/// Records the outcome of a write to standard output.
pub fn note<T>(written: io::Result<T>) -> io::Result<T> {
    if let Err(cause) = &written
        && !matches!(cause.kind(), ErrorKind::BrokenPipe | ErrorKind::Interrupted)
    {
        // Keep the first reason.
        let _ = UNWRITTEN.set(cause.to_string());
    }
    written
}

/// Standard output, bypassing the printer.
#[allow(clippy::disallowed_methods, reason = "the one place")]
pub fn standard_output() -> CheckedWriter<Stdout> {
    CheckedWriter(io::stdout())
}

/// Standard output for long results: buffered, with terminal control characters escaped.
pub type Out<'a> = BufWriter<EscapingWriter<CheckedWriter<StdoutLock<'a>>>>;

/// Opens buffered standard output.
pub fn out() -> Out<'static> {
    BufWriter::new(EscapingWriter::new(CheckedWriter(standard_output().0.lock())))
}

/// Writes a line to standard output in one piece.
pub fn answer(text: &str) {
    line(&mut printer::ResultOutput, text);
}

/// Output format of a command's results.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct Figures {
    /// Print the results as one JSON object, for scripts.
    #[arg(long)]
    pub json: bool,
}

impl Figures {
    /// Prints a result as text, or as JSON with `--json`.
    pub fn say(self, text: impl FnOnce() -> String, figures: impl FnOnce() -> serde_json::Value) {
        answer(&if self.json { figures().to_string() } else { text() });
    }
}

/// Returns a path for JSON, which holds only text: bytes that are not UTF-8 become U+FFFD. `json!` panics on
/// such a path.
pub fn path_text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

/// Adds the members of one JSON object to another.
pub fn merged(mut object: serde_json::Value, more: serde_json::Value) -> serde_json::Value {
    if let (Some(object), serde_json::Value::Object(more)) = (object.as_object_mut(), more) {
        object.extend(more);
    }
    object
}

/// Writes trusted text unescaped, such as shell completions.
pub fn verbatim(text: &str) {
    // `CheckedWriter` remembers a failure.
    let _ = standard_output().write_all(text.as_bytes());
}

/// Returns why standard output could not be written, or `None` if it was, or if the reader stopped early.
pub fn unwritten() -> Option<&'static str> {
    let _ = standard_output().flush();
    UNWRITTEN.get().map(String::as_str)
}

/// Writes a line in one piece.
pub fn line(out: &mut dyn Write, text: &str) {
    let mut text = plain(text);
    text.push('\n');
    // A closed pipe or terminal must not end the command: a run would lose its log's end.
    let _ = out.write_all(text.as_bytes());
}

/// Like `println!`, but a failed write is reported only when the command ends, and untrusted text is escaped
/// as by `foreign_text`.
#[macro_export]
macro_rules! say {
    () => { $crate::say::answer("") };
    ($($arguments:tt)*) => { $crate::say::answer(&format!($($arguments)*)) };
}

/// Like `eprintln!`, with the same escaping; write failures are ignored, since there is nowhere left to
/// report them.
#[macro_export]
macro_rules! tell {
    ($($arguments:tt)*) => { $crate::say::line(&mut $crate::printer::Diagnostics, &format!($($arguments)*)) };
}
