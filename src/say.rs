//! Standard output and error for people: whoever reads them may have had enough (`| head`), which is no failure.

/// As `println!`, but a closed pipe ends nothing.
macro_rules! say {
    ($($arguments:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout(), $($arguments)*);
    }};
}

/// As `eprintln!`, but a closed pipe or terminal ends nothing: a run would lose its log's end.
macro_rules! tell {
    ($($arguments:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr(), $($arguments)*);
    }};
}
