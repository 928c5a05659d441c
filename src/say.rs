//! Standard output and error. Every answer of a command goes through here.
//!
//! Whoever reads may have had enough (`| head`), which is no failure; an answer that cannot be written is one, whatever the command
//! has done besides: [`unwritten`] says so at its end. What is printed may hold texts of strangers: nothing that a terminal would
//! obey leaves the program.

use std::io::{self, BufWriter, ErrorKind, Stdout, StdoutLock, Write};
use std::sync::OnceLock;

use foreign_text::{Plain, plain};

use crate::printer;

/// The first reason why standard output could not be written.
static UNWRITTEN: OnceLock<String> = OnceLock::new();

/// Standard output, which remembers that it could not be written.
#[derive(Debug)]
pub struct Noting<W>(W);

impl<W: Write> Write for Noting<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        note(self.0.write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        note(self.0.flush())
    }
}

/// Remembers what became of a text for standard output.
pub fn note<T>(written: io::Result<T>) -> io::Result<T> {
    if let Err(cause) = &written
        && !matches!(cause.kind(), ErrorKind::BrokenPipe | ErrorKind::Interrupted)
    {
        // The first reason stays.
        let _ = UNWRITTEN.set(cause.to_string());
    }
    written
}

/// Standard output past the printer.
#[allow(clippy::disallowed_methods, reason = "the one place")]
pub fn standard_output() -> Noting<Stdout> {
    Noting(io::stdout())
}

/// Standard output for long answers: buffered, without what a terminal would obey.
pub type Out<'a> = BufWriter<Plain<Noting<StdoutLock<'a>>>>;

/// Opens it.
pub fn out() -> Out<'static> {
    BufWriter::new(Plain::new(Noting(standard_output().0.lock())))
}

/// Writes a text and a line end to standard output in one piece.
pub fn answer(text: &str) {
    line(&mut printer::Answers, text);
}

/// Writes a text of our own as it is, such as a shell's completions.
pub fn verbatim(text: &str) {
    // What went wrong is remembered.
    let _ = standard_output().write_all(text.as_bytes());
}

/// Why an answer of this command could not be written; none if it was, or if nobody wanted more of it.
pub fn unwritten() -> Option<&'static str> {
    let _ = standard_output().flush();
    UNWRITTEN.get().map(String::as_str)
}

/// Writes a text and a line end in one piece.
pub fn line(out: &mut dyn Write, text: &str) {
    let mut text = plain(text);
    text.push('\n');
    // A closed pipe or terminal ends nothing: a run would lose its log's end.
    let _ = out.write_all(text.as_bytes());
}

/// As `println!`, but what cannot be written ends nothing before the command's own end, and texts of strangers are shown as
/// `foreign_text` shows them.
#[macro_export]
macro_rules! say {
    () => { $crate::say::answer("") };
    ($($arguments:tt)*) => { $crate::say::answer(&format!($($arguments)*)) };
}

/// As `eprintln!`, in the same way; what cannot be said there cannot be said.
#[macro_export]
macro_rules! tell {
    ($($arguments:tt)*) => { $crate::say::line(&mut $crate::printer::Words, &format!($($arguments)*)) };
}
