//! Texts of strangers as a terminal may show them.
//!
//! A name in a log, a field of a volume's header or the last words of a program may hold escape sequences that move the cursor,
//! change the window's title or answer as if the user had typed, line ends that forge a line of ours, or characters that reverse or
//! hide what stands beside them. Here they are shown as `\u001b`: harmless, visible, and within a JSON text still the same character.
//!
//! [`foreign`] shows one value within a line of ours. [`Plain`] is the last gate before the terminal: everything that a command
//! prints goes through it.
//!
//! **Boundary:** texts; it opens nothing and prints nothing itself. **Invariant:** what comes out holds no control character but line ends
//! and tabs that are ours, no character without width and no mark that turns the direction of writing; a value has a bounded length.
//!
//! ```
//! use foreign_text::foreign;
//!
//! assert_eq!(foreign("femur\u{1b}[2J\nend").to_string(), "femur\\u001b[2J\\u000aend");
//! ```

use std::fmt::{self, Display, Write as _};
use std::io::{self, Write};
use std::path::Path;

/// Most characters that are shown of a value.
pub const MOST_CHARACTERS: usize = 200;

/// Most characters that are shown of a line that a program wrote.
pub const MOST_OF_A_LINE: usize = 4096;

/// A value of a stranger's file, for one line of ours: no line ends, and no more than [`MOST_CHARACTERS`].
pub fn foreign(text: &str) -> Foreign<'_> {
    Foreign { text, most: MOST_CHARACTERS }
}

/// A path in which a stranger's names may stand, whole.
pub fn foreign_path(path: &Path) -> String {
    foreign_line(&path.to_string_lossy()).to_string()
}

/// A line that a stranger's program wrote: no more than [`MOST_OF_A_LINE`].
pub fn foreign_line(text: &str) -> Foreign<'_> {
    Foreign { text, most: MOST_OF_A_LINE }
}

/// A stranger's text; its `Display` is what may be shown of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Foreign<'a> {
    text: &'a str,
    most: usize,
}

impl Display for Foreign<'_> {
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

/// A text of ours, of any length, in which values of strangers may stand: keeps line ends and tabs, and shows every other character
/// that a terminal would obey, hide or turn round as its number.
pub fn plain(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for c in text.chars() {
        if matches!(c, '\n' | '\t') { shown.push(c) } else { push(&mut shown, c) }
    }
    shown
}

/// Appends a character, or its number in the spelling of JSON.
fn push(shown: &mut String, c: char) {
    if is_plain(c) {
        return shown.push(c);
    }
    for unit in c.encode_utf16(&mut [0; 2]) {
        let _ = write!(shown, "\\u{unit:04x}");
    }
}

/// Whether a character is seen as itself. The standard library knows which are not: controls, the marks of bidirectional text, what
/// has no width, and separators other than the space.
fn is_plain(c: char) -> bool {
    if c.is_ascii() {
        return !c.is_ascii_control();
    }
    // Behind a letter, since a combining mark at the beginning of a text is escaped, too.
    let mut bytes = [b'a'; 5];
    let length = c.encode_utf8(&mut bytes[1..]).len();
    std::str::from_utf8(&bytes[..=length]).is_ok_and(|text| text.escape_debug().nth(2).is_none())
}

/// Writes texts as [`plain`] shows them.
#[derive(Debug)]
pub struct Plain<W> {
    out: W,
    /// The beginning of a character whose end has not come yet.
    begun: Vec<u8>,
}

impl<W: Write> Plain<W> {
    /// In front of a writer.
    pub fn new(out: W) -> Plain<W> {
        Plain { out, begun: Vec::new() }
    }
}

impl<W: Write> Write for Plain<W> {
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
                    // No length: the end of the character is still to come.
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
    fn nothing_that_a_terminal_obeys_or_hides_is_shown_as_itself() {
        assert_eq!(
            foreign(HOSTILE).to_string(),
            "a\\u001b[2J\\u001b]0;owned\\u0007\\u000d\\u000aend marker: completed"
        );
        assert_eq!(plain(HOSTILE), "a\\u001b[2J\\u001b]0;owned\\u0007\\u000d\nend marker: completed");
        // C1 controls, bidirectional marks and isolates, zero widths, a tag, line separators, a private character.
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
        // A JSON writer escapes the controls below the space itself; these it leaves.
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
        let mut out = Plain::new(Vec::new());
        text.bytes().for_each(|byte| out.write_all(&[byte]).unwrap());
        assert_eq!(String::from_utf8(out.out).unwrap(), plain(text));
        let mut out = Plain::new(Vec::new());
        out.write_all(b"a\xff\x9b\xc3b\x1b").unwrap();
        assert_eq!(String::from_utf8(out.out).unwrap(), "a\u{fffd}\u{fffd}\u{fffd}b\\u001b");
    }
}
