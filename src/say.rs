//! Standard output and error for people: whoever reads them may have had enough (`| head`), which is no failure. What is printed may
//! hold texts of strangers: nothing that a terminal would obey leaves the program.

use std::io::Write;

use foreign_text::plain;

/// Writes a text and a line end in one piece.
pub fn line(out: &mut dyn Write, text: &str) {
    let mut text = plain(text);
    text.push('\n');
    // A closed pipe or terminal ends nothing: a run would lose its log's end.
    let _ = out.write_all(text.as_bytes());
}

/// As `println!`, but a closed pipe ends nothing, and texts of strangers are shown as `foreign_text` shows them.
macro_rules! say {
    () => { $crate::say::line(&mut std::io::stdout(), "") };
    ($($arguments:tt)*) => { $crate::say::line(&mut std::io::stdout(), &format!($($arguments)*)) };
}

/// As `eprintln!`, in the same way.
macro_rules! tell {
    ($($arguments:tt)*) => { $crate::say::line(&mut std::io::stderr(), &format!($($arguments)*)) };
}
