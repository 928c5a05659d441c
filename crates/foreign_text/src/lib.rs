//! Makes untrusted text safe to show on a terminal.
//!
//! A name in a log, a field of a volume's header or the output of a program may contain escape sequences that
//! move the cursor, change the window's title or inject input as if the user had typed it, line ends that
//! forge an output line, or characters that reverse or hide their neighbours. All of these are shown as
//! escapes like `\u001b`: harmless, visible, and the same character in JSON.
//!
//! [`foreign`] formats a single value within a line; [`nearest_name`] finds what a misspelled name may mean;
//! [`counted`] puts a noun after a count; [`line_at`]
//! finds the line of an error. [`EscapingWriter`] is the last filter before the
//! terminal: everything that a command prints goes through it.
//!
//! **Boundary:** text only; opens nothing and prints nothing. **Invariant:** the output holds no control
//! characters except our own line ends and tabs, no zero-width characters and no direction marks; a value has
//! a bounded length.
//!
//! ```
//! use foreign_text::foreign;
//!
//! assert_eq!(foreign("femur\u{1b}[2J\nend").to_string(), "femur\\u001b[2J\\u000aend");
//! ```

mod suggestion;

pub use suggestion::nearest_name;

use std::fmt::{self, Display, Write as _};
use std::io::{self, Write};
use std::path::Path;

/// Largest number of characters shown of a value.
pub const MOST_CHARACTERS: usize = 200;

/// Largest number of characters shown of a program's output line.
pub const MOST_OF_A_LINE: usize = 4096;

/// Formats an untrusted value for use within a line: no line ends, at most [`MOST_CHARACTERS`].
pub fn foreign(text: &str) -> EscapedText<'_> {
    EscapedText { text, most: MOST_CHARACTERS }
}

/// Formats a path that may contain untrusted names, in full.
pub fn foreign_path(path: &Path) -> String {
    foreign_line(&path.to_string_lossy()).to_string()
}

/// Formats a line from an untrusted program: at most [`MOST_OF_A_LINE`] characters.
pub fn foreign_line(text: &str) -> EscapedText<'_> {
    EscapedText { text, most: MOST_OF_A_LINE }
}

/// Returns the line, from 1, of a byte of a text.
pub fn line_at(text: &str, byte: usize) -> usize {
    text.bytes().take(byte).filter(|byte| *byte == b'\n').count() + 1
}

/// Formats a count with its noun, whose plural ends in `s`: "1 frame", "2 frames".
pub fn counted(count: impl Display, noun: &str) -> String {
    let count = count.to_string();
    let ending = if count == "1" { "" } else { "s" };
    format!("{count} {noun}{ending}")
}

/// Formats a number from a file: in scientific notation if it would be very long (1e300).
pub fn number(value: f64) -> String {
    let plain = value == 0.0 || !value.is_finite() || (1e-6..1e9).contains(&value.abs());
    if plain { value.to_string() } else { format!("{value:e}") }
}

/// An untrusted text; its `Display` is safe to show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EscapedText<'a> {
    text: &'a str,
    most: usize,
}

impl Display for EscapedText<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut shown = String::with_capacity(self.text.len().min(self.most));
        let mut rest = self.text.chars();
        rest.by_ref().take(self.most).for_each(|c| push(&mut shown, c));
        let left = rest.count();
        if left > 0 {
            // Writing to a String cannot fail.
            let _ = write!(shown, "… ({left} more characters)");
        }
        f.pad(&shown)
    }
}

/// Escapes our own text, of any length, which may contain untrusted values. Keeps line ends and tabs, and
/// escapes every other character that a terminal would interpret, hide or reverse.
pub fn plain(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for c in text.chars() {
        if matches!(c, '\n' | '\t') { shown.push(c) } else { push(&mut shown, c) }
    }
    shown
}

/// Appends a character, or its JSON escape.
fn push(shown: &mut String, c: char) {
    if is_plain(c) {
        return shown.push(c);
    }
    for unit in c.encode_utf16(&mut [0; 2]) {
        let _ = write!(shown, "\\u{unit:04x}");
    }
}

/// Whether a character is visible as itself. The standard library knows which are not: controls,
/// bidirectional marks, zero-width characters, and separators other than the space.
fn is_plain(c: char) -> bool {
    if c.is_ascii() {
        return !c.is_ascii_control();
    }
    // Placed after a letter, because a combining mark at the start of a text is escaped too.
    let mut bytes = [b'a'; 5];
    let length = c.encode_utf8(&mut bytes[1..]).len();
    std::str::from_utf8(&bytes[..=length]).is_ok_and(|text| text.escape_debug().nth(2).is_none())
}

/// A writer that passes text through [`plain`].
#[derive(Debug)]
pub struct EscapingWriter<W> {
    out: W,
    /// The first bytes of an incomplete character.
    begun: Vec<u8>,
}

impl<W: Write> EscapingWriter<W> {
    /// Wraps a writer.
    pub fn new(out: W) -> EscapingWriter<W> {
        EscapingWriter { out, begun: Vec::new() }
    }
}

impl<W: Write> Write for EscapingWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.begun.extend_from_slice(bytes);
        let mut shown = String::with_capacity(self.begun.len());
        let mut rest = self.begun.as_slice();
        let begun = loop {
            match std::str::from_utf8(rest) {
                Ok(text) => {
                    shown += &plain(text);
                    break Vec::new();
                }
                Err(error) => {
                    let (good, bad) = rest.split_at(error.valid_up_to());
                    shown += &plain(&String::from_utf8_lossy(good));
                    // No length: the rest of the character has not arrived yet.
                    let Some(length) = error.error_len() else { break bad.to_vec() };
                    shown.push(char::REPLACEMENT_CHARACTER);
                    rest = &bad[length..];
                }
            }
        };
        self.begun = begun;
        self.out.write_all(shown.as_bytes())?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;

    /// Clears the screen, sets the title, and overwrites the line.
    const HOSTILE: &str = "a\x1b[2J\x1b]0;owned\x07\r\nend marker: completed";

    #[test]
    fn a_count_of_one_has_a_singular() {
        assert_eq!([0, 1, 2].map(|n| counted(n, "frame")), ["0 frames", "1 frame", "2 frames"]);
    }

    #[test]
    fn nothing_that_a_terminal_obeys_or_hides_is_shown_as_itself() {
        assert_eq!(
            foreign(HOSTILE).to_string(),
            "a\\u001b[2J\\u001b]0;owned\\u0007\\u000d\\u000aend marker: completed"
        );
        assert_eq!(plain(HOSTILE), "a\\u001b[2J\\u001b]0;owned\\u0007\\u000d\nend marker: completed");
        // C1 controls, bidirectional marks and isolates, zero widths, a tag, line separators, a private
        // character.
        for c in
            "\u{7f}\u{9b}\u{85}\u{202e}\u{2066}\u{200b}\u{200f}\u{feff}\u{ad}\u{e0041}\u{2028}\u{a0}\u{e000}"
                .chars()
        {
            let shown = foreign(&format!("x{c}y")).to_string();
            assert!(shown.is_ascii() && shown.starts_with("x\\u") && shown.ends_with('y'), "{c:?}: {shown}");
        }
        for text in ["Ganzkörper µm × … −1", "患者 ребро हड्डी", "e\u{301}", "\"quoted\" \\ 'so'", "👍"]
        {
            assert_eq!((foreign(text).to_string(), plain(text)), (text.to_owned(), text.to_owned()));
        }
    }

    #[test]
    fn a_value_of_any_length_takes_a_line() {
        let long = "x".repeat(1_000_000);
        let shown = foreign(&long).to_string();
        assert_eq!(shown, format!("{}… (999800 more characters)", "x".repeat(200)));
        assert!(foreign_line(&long).to_string().len() < 4200);
        assert_eq!(format!("{:<6}|{:>4}", foreign("ab"), foreign("c")), "ab    |   c");
    }

    #[test]
    fn an_escaped_json_text_is_the_same_text() {
        // A JSON writer escapes only the controls below the space; it leaves these.
        let value = "\u{7f}\u{9b}31m\u{202e}\u{e0041}\u{1f44d}";
        let line = plain(&format!("{{\"text\":\"{value}\"}}"));
        assert!(!line.contains('\u{9b}') && !line.contains('\u{e0041}'), "{line}");
        let units: Vec<u16> =
            line.split("\\u").skip(1).map(|hex| u16::from_str_radix(&hex[..4], 16).unwrap()).collect();
        assert_eq!(units, [0x7f, 0x9b, 0x202e, 0xdb40, 0xdc41], "pairs of surrogates, as JSON has them");
    }

    #[test]
    fn characters_and_bytes_that_come_in_pieces_are_shown_whole() {
        let text = "ä\u{9b}患\x1b👍\u{e0041}";
        let mut out = EscapingWriter::new(Vec::new());
        text.bytes().for_each(|byte| out.write_all(&[byte]).unwrap());
        assert_eq!(String::from_utf8(out.out).unwrap(), plain(text));
        let mut out = EscapingWriter::new(Vec::new());
        out.write_all(b"a\xff\x9b\xc3b\x1b").unwrap();
        assert_eq!(String::from_utf8(out.out).unwrap(), "a\u{fffd}\u{fffd}\u{fffd}b\\u001b");
    }
}
